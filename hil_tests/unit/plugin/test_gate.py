"""A test that cannot run on a radar leaves no line to it open."""

from __future__ import annotations

import pytest

from hil_tests.plugin.bench import Bench
from hil_tests.plugin.gate import findings_of, gate
from hil_tests.plugin.radar_targets import TappedTransport
from hil_tests.plugin.specs import parse_specs


@pytest.mark.requires("profiles")
def test_a_line_is_closed_where_the_firmware_turns_out_to_lack_something(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = []
    close = TappedTransport.close

    def noted(line: TappedTransport) -> None:
        closed.append(line)
        close(line)

    monkeypatch.setattr(TappedTransport, "close", noted)
    bench = Bench(parse_specs(["emu:?firmware=xep"]))
    with pytest.raises((pytest.skip.Exception, pytest.fail.Exception), match="needs profiles"):
        gate(request, bench, tuple(bench.specs))
    assert len(closed) == 1
    findings = findings_of(request.node)
    findings.names, findings.radars, findings.reason = (), (), None  # not a test of that radar

"""Times in the artefacts of a test are those at which bytes passed."""

from pathlib import Path

import pytest
from mcap.reader import make_reader

from hil_tests.plugin.artifacts import write_bundle
from hil_tests.plugin.findings import Findings
from hil_tests.plugin.radar_specs import parse_specs
from hil_tests.plugin.radar_targets import WireTap, target_of
from hil_tests.plugin.session_radars import RadarUnderTest
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.connection import Connection, Role

pytest.importorskip("rerun")

from rerun.chunk import RrdReader

MS = 1_000_000


def test_times_count_from_the_moment_at_which_the_tap_began(tmp_path: Path) -> None:
    (spec,) = parse_specs(["emu:lab"])
    radar = RadarUnderTest(target_of(spec))
    radar.close()
    moments_ns = iter([1_000 * MS, 3_500 * MS, 3_750 * MS])
    tap = radar.tap = WireTap(clock_ns=lambda: next(moments_ns))
    for _ in range(2):
        tap.note("tx", Connection(Role.HOST).send(m.Ping()))
    write_bundle(tmp_path, Findings(radars=[radar]), {})

    with (tmp_path / "wire.mcap").open("rb") as stream:
        logged_ns = [message.log_time for _, _, message in make_reader(stream).iter_messages()]
    assert [t_ns - tap.started_unix_ns for t_ns in logged_ns] == [2_500 * MS, 2_750 * MS]

    batches = [
        chunk.to_record_batch()
        for chunk in RrdReader(tmp_path / "session.rrd").stream()
        if str(chunk.entity_path).endswith("/tx")
    ]
    shown = [stamp.value for batch in batches for stamp in batch["time"]]
    assert shown == [2_500 * MS, 2_750 * MS]
    # times are those of the driver's clock
    assert all("log_time" not in batch.schema.names for batch in batches)

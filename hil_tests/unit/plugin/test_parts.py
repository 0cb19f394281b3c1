"""Locks, taps, measurements, frame rates, and a test that cannot run on a radar."""

import math
import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from hil_tests.plugin import power, radar_targets
from hil_tests.plugin.findings import Limit, Measure, findings_of
from hil_tests.plugin.power import PowerCommand, PowerError
from hil_tests.plugin.radar_specs import parse_specs
from hil_tests.plugin.radar_targets import TappedTransport, WireTap
from hil_tests.plugin.requirements import gate
from hil_tests.plugin.session_radars import Bench, PortBusyError, PortLock


def test_a_lock_is_for_one_process(tmp_path: Path) -> None:
    port = tmp_path / "port"
    port.touch()
    link = tmp_path / "by-id"
    link.symlink_to(port)
    program = f"from hil_tests.plugin.session_radars import PortLock; PortLock({str(link)!r})"
    lock = PortLock(str(port))
    refused = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert refused.returncode == 1
    assert f"tested by another session (process {os.getpid()})" in refused.stderr
    lock.release()
    subprocess.run([sys.executable, "-c", program], check=True)


@pytest.mark.parametrize("prefix", ["", "h" * 5000], ids=["path", "long"])
def test_a_lock_is_not_given_twice(tmp_path: Path, prefix: str) -> None:
    target = f"{prefix}{tmp_path}"
    lock = PortLock(target)
    with pytest.raises(PortBusyError):
        PortLock(target)
    lock.release()
    PortLock(target).release()


def test_a_lock_follows_no_link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a folder where anybody may write, a link could lead to a file of ours."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (folder := tmp_path / "xethru-hil-locks").mkdir()
    (ours := tmp_path / "ours").write_text("not to be lost")
    (folder / "radar.lock").symlink_to(ours)
    with pytest.raises(OSError, match="symbolic links"):
        PortLock("radar")
    assert ours.read_text() == "not to be lost"


def test_locks_of_others_are_not_removed_and_not_shown_as_they_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    lock = PortLock("radar")
    folder = tmp_path / "xethru-hil-locks"
    assert stat.S_IMODE(folder.stat().st_mode) == 0o1777  # sticky, as the one above it
    (path := folder / "radar.lock").write_bytes(b"\xff\xfe\x1b[2J")
    with pytest.raises(PortBusyError, match=r"another session \(process unknown\)"):
        PortLock("radar")
    lock.release()
    path.unlink()
    folder.chmod(0o777)  # as older versions left it
    PortLock("radar").release()
    assert folder.stat().st_mode & stat.S_ISVTX
    path.unlink()
    folder.rmdir()
    folder.symlink_to(tmp_path)
    with pytest.raises(PortBusyError):
        PortLock("radar")


def test_a_tap_forgets_the_oldest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(radar_targets, "MOST_BYTES", 10)
    wire = WireTap(clock_ns=lambda: 5)
    for data in (b"abcd", b"efgh", b"ijkl"):
        wire.note("rx", data)
    assert [passed.data for passed in wire.passed] == [b"efgh", b"ijkl"]
    assert wire.forgotten_bytes == 4


def test_measurements_reach_the_report() -> None:
    properties: list[tuple[str, object]] = []
    measure = Measure(properties)
    measure("jitter", 4.5, unit="ms", limit=(None, 5.0))
    assert properties == [("measurement jitter", "4.5 ms (at most 5)")]
    (taken,) = measure.taken
    rest = {"unit": "ms", "low": None, "high": 5.0, "within": True}
    assert taken.as_json() == {"name": "jitter", "value": 4.5, **rest}


@pytest.mark.parametrize(
    ("value", "limit", "said"),
    [
        (5.1, (1.0, 5.0), "5.1 ms (at least 1, at most 5)"),
        (0.9, (1.0, 5.0), "0.9 ms (at least 1, at most 5)"),
        # also without limits: a test that computed NaN has measured nothing
        (math.nan, (None, None), "nan ms"),
        (math.nan, (0.0, None), "nan ms (at least 0)"),
        (math.nan, (None, 0.0), "nan ms (at most 0)"),
        (math.nan, (-math.inf, math.inf), "nan ms (at least -inf, at most inf)"),
    ],
)
def test_measurements_beyond_their_limits_fail(value: float, limit: Limit, said: str) -> None:
    properties: list[tuple[str, object]] = []
    measure = Measure(properties)
    with pytest.raises(pytest.fail.Exception) as failed:
        measure("jitter", value, unit="ms", limit=limit)
    assert failed.value.msg == f"jitter is {said}"
    assert properties == [("measurement jitter", said)], "reported all the same"
    assert len(measure.taken) == 1


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


def test_power_is_switched_off_and_on_with_a_pause(tmp_path: Path) -> None:
    log = tmp_path / "log"
    script = f'echo "$0 $1 $2" >> "{log}"'
    slept: list[float] = []
    command = PowerCommand(f"sh -c '{script}' {{action}} {{port}} {{serial}}")
    command.cycle("/dev/ttyACM0", "202611210001", 1.5, slept.append)
    rest = "/dev/ttyACM0 202611210001"
    assert log.read_text().splitlines() == [f"off {rest}", f"on {rest}"]
    assert slept == [1.5]


def test_power_comes_back_after_an_interrupted_pause(tmp_path: Path) -> None:
    log = tmp_path / "log"
    command = PowerCommand(f"sh -c 'echo {{action}} >> \"{log}\"'")

    def interrupted(seconds: float) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        command.cycle("port", "", 1.0, interrupted)
    assert log.read_text().split() == ["off", "on"]


def test_a_fault_that_is_cleared_unused_was_not_injected() -> None:
    (spec,) = parse_specs(["emu:?line=pty"])
    target = radar_targets.ProcessTarget(spec)
    try:
        fault = target.inject("bad_checksum", {"count": 3})
        fault.clear()
        assert fault.injected() == 0
    finally:
        target.close()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("sh -c 'echo busy; exit 3'", "ended with 3: busy"),
        ("no-such-hub {action}", "cannot be started: No such file"),
        ("sh -c 'sleep 60'", "did not end within 0.1 s"),
    ],
)
def test_a_power_command_that_fails_is_one_line(
    monkeypatch: pytest.MonkeyPatch, text: str, says: str
) -> None:
    monkeypatch.setattr(power, "LIMIT_S", 0.1 if "sleep" in text else 30.0)
    with pytest.raises(PowerError, match=says) as failure:
        PowerCommand(text).cycle("port", "", 0.0, lambda seconds: None)
    assert "\n" not in str(failure.value)

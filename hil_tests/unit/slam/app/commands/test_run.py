"""The command uwb-slam run: its arguments, and its session wherever the disk ends."""

import os
import signal
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hil_tests.patience import seconds
from hil_tests.unit.slam.app.sessions import (
    Listener,
    NoSlam,
    scan,
    session_info,
    smoothed_run,
    source_of_scans,
)
from slam.app.commands import run
from slam.app.commands.run import PromptSteps, SmoothingRequests, parse_clock
from slam.app.errors import UsageError
from slam.app.odometry.live import parse_source
from slam.app.run.live_source import LiveLog
from slam.app.run.runner import execute
from slam.app.session.writer import CannotWriteError, SessionLog
from slam.frames import RadarFrame
from slam.live.odometry_track import OdometryTrack, TumSample, read_tum
from slam.live.session.reader import open_session
from slam.live.session_records import Scan
from slam.results import PoseAt, SmoothedRun
from xethru_protocol.operating_system import StopFlag


def pose(number: int) -> TumSample:
    return TumSample(t_ns=number, x_m=float(number), y_m=0.0, qz=0.0, qw=1.0)


def refuse(*_: object) -> None:
    raise CannotWriteError("session.mcap: cannot be written: No space left on device")


def test_odometry_from_before_the_log_is_in_it_once_and_in_order(tmp_path: Path) -> None:
    listener = LiveLog()
    listener.on_odometry(pose(1))
    listener.on_odometry(pose(2))
    listener.begin(SessionLog(tmp_path / "session.mcap", session_info()), 0)
    listener.on_odometry(pose(3))
    listener.close()
    recorded = open_session(tmp_path / "session.mcap").records()
    assert [row.t_ns for row in recorded if isinstance(row, TumSample)] == [1, 2, 3]
    assert not listener.failure


@pytest.mark.parametrize("refused", ["on_odometry", "on_scan"])
def test_a_disk_that_fills_up_is_said_once_and_the_run_goes_on(
    refused: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where it is full as soon as what was kept for the log is written."""
    listener, heard = LiveLog(), Listener()
    listener.on_odometry(pose(1))
    listener.on_odometry(pose(2))
    log = SessionLog(tmp_path / "session.mcap", session_info())
    monkeypatch.setattr(log, refused, refuse)
    listener.begin(log, 0)
    listener.attach(heard)
    for number in range(3):
        listener.on_odometry(pose(3 + number))
        listener.take(scan(number))
    listener.close()
    log.close()
    (line,) = heard.lines
    assert line.warning
    assert line.text.endswith("No space left on device; the run goes on and is not recorded")
    assert listener.failure.endswith("No space left on device")


def test_a_last_chunk_that_does_not_fit_is_told_and_nothing_raised(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    listener = LiveLog()
    log = SessionLog(tmp_path / "session.mcap", session_info())
    listener.begin(log, 0)
    with monkeypatch.context() as full:
        full.setattr(log, "close", refuse)
        listener.close()
    assert listener.failure.endswith("No space left on device")
    log.close()


@pytest.mark.parametrize("text", ["9" * 5000, "9" * 19, "²", "-5", ""])
def test_a_clock_that_is_none_is_wrong_usage(text: str) -> None:
    with pytest.raises(UsageError):
        parse_clock(text, parse_source("-"))


def test_a_unix_clock_shows_the_seconds_since_1970(monkeypatch: pytest.MonkeyPatch) -> None:
    """The host was started 100 s ago, 1 700 000 000 s after 1970."""
    monkeypatch.setattr(time, "monotonic_ns", lambda: 100_000_000_000)
    monkeypatch.setattr(time, "time_ns", lambda: 1_700_000_100_000_000_007)
    clock = parse_clock("unix", parse_source("-"))
    assert clock is not None
    assert clock.nominal_ns(105_000_000_000) == 1_700_000_105_000_000_007


class StubbornSlam(NoSlam):
    """SLAM whose second step takes so long, and which has a state left at the end."""

    def __init__(self, slow_s: float) -> None:
        self._slow_s = slow_s
        self.n_steps = self.n_flushed = 0

    def step(self, frames: Sequence[RadarFrame], pose_at: PoseAt, t_ns: int) -> tuple[()]:
        self.n_steps += 1
        if self.n_steps == 2:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(self._slow_s)
        return ()

    def flush(self) -> tuple[()]:
        self.n_flushed += 1
        return ()


def test_sigusr1_writes_the_path_smoothed_so_far(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Twice: before there is a smoothed path, and after; the end of the run is no answer."""
    made, notes = smoothed_run(6), list[str]()
    monkeypatch.setattr(run, "note", notes.append)

    class Smooths(StubbornSlam):
        def step(self, frames: Sequence[RadarFrame], pose_at: PoseAt, t_ns: int) -> tuple[()]:
            self.n_steps += 1
            return ()

        def smoothed(self) -> SmoothedRun | None:
            return made if self.n_steps > 3 else None

    def scans() -> Iterator[Scan]:
        for number in range(6):
            if number in {1, 4}:
                os.kill(os.getpid(), signal.SIGUSR1)
            yield scan(number)

    before = signal.getsignal(signal.SIGUSR1)
    requests = SmoothingRequests(tmp_path)
    with requests.caught():
        track = OdometryTrack([pose(0), pose(10**10)])
        source = source_of_scans(scans(), track, Smooths(0.0))
        record = execute(replace(source, smoothing_asked=requests.asked), [requests])
        caught = signal.getsignal(signal.SIGUSR1)
    assert caught not in {before, signal.SIG_DFL}  # while results are written
    assert signal.getsignal(signal.SIGUSR1) is before
    assert record.smoothed is made
    written = read_tum(tmp_path / "smoothed.tum")
    assert np.array_equal(written.stamps_ns, made.t_ns)
    np.testing.assert_allclose(written.poses, made.poses, rtol=1e-12)
    none, whole = notes
    assert none.endswith("there is no smoothed path")
    assert "smoothed.tum has 6 states, solved for in" in whole


@pytest.mark.parametrize(("slow_s", "used"), [(0.0, True), (seconds(60), False)])
def test_a_step_that_takes_long_after_a_signal_is_given_up_and_its_scan_is_not_used(
    slow_s: float, used: bool
) -> None:
    slam, heard, stop = StubbornSlam(slow_s), Listener(), StopFlag()

    def scans() -> Iterator[Scan]:
        for number in range(9):
            if stop.received is None:
                yield scan(number)

    alarm = signal.getsignal(signal.SIGALRM)
    began_s = time.monotonic()
    with stop, PromptSteps(slam, stop) as prompt:
        track = OdometryTrack([pose(0), pose(10**10)])
        execute(replace(source_of_scans(scans(), track, slam), step=prompt.step), [heard])
    assert time.monotonic() - began_s < seconds(30)
    assert [one.used for one in heard.scans] == [True, used]
    assert prompt.n_given_up == (not used)
    assert slam.n_flushed == used  # it is in the middle of a step otherwise
    assert signal.getsignal(signal.SIGALRM) is alarm
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)

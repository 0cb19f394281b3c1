"""The session of a run, wherever the disk ends."""

from __future__ import annotations

from pathlib import Path

import pytest

from hil_tests.unit.slam.app.sessions import scan, session_info
from slam.app.odometry.tum import TumSample
from slam.app.records import LogLine, SessionObserver
from slam.app.run.live_source import LiveLog
from slam.app.session.log import SessionLog
from slam.app.session.mcap import CannotWriteError
from slam.app.session.reader import open_session


class Heard(SessionObserver):
    """Keeps the lines that a user would see."""

    def __init__(self) -> None:
        self.lines: list[LogLine] = []

    def on_log(self, line: LogLine) -> None:
        """Keep it."""
        self.lines.append(line)


def pose(number: int) -> TumSample:
    return TumSample(t_ns=number, x_m=float(number), y_m=0.0, qz=0.0, qw=1.0)


def refuse(*_: object) -> None:
    raise CannotWriteError("session.mcap: cannot be written: No space left on device")


def test_odometry_from_before_the_log_is_in_it_once_and_in_order(tmp_path: Path) -> None:
    listener = LiveLog()
    listener.on_odometry(pose(1))
    listener.on_odometry(pose(2))
    listener.begin(SessionLog(tmp_path / "session.mcap", session_info()))
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
    listener, heard = LiveLog(), Heard()
    listener.on_odometry(pose(1))
    listener.on_odometry(pose(2))
    log = SessionLog(tmp_path / "session.mcap", session_info())
    monkeypatch.setattr(log, refused, refuse)
    listener.begin(log)
    listener.attach(heard)
    for number in range(3):
        listener.on_odometry(pose(3 + number))
        listener.on_scan(scan(number))
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
    listener.begin(log)
    with monkeypatch.context() as full:
        full.setattr(log, "close", refuse)
        listener.close()
    assert listener.failure.endswith("No space left on device")
    log.close()

"""The threads of a run: what they tell, a radar that is lost and found, an end without hanging."""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hil_tests.patience import seconds
from slam.app.odometry.live import parse_source
from slam.app.rig.sources import RadarLink
from slam.app.run import live_source as run_readers
from slam.app.run.live_source import (
    Event,
    FrameArrived,
    Inbox,
    OdometryEnded,
    OdometryLine,
    RadarBack,
    RadarLost,
    Readers,
)
from slam.geometry import Mount
from xethru_protocol.driver.frames import Frame, FrameGeometry
from xethru_protocol.wire.errors import Disconnected, ResponseTimeout

GEOMETRY = FrameGeometry(range_start_m=0.2, bin_length_m=0.0064, n_bins=4, downconversion=False)


class ScriptedDriver:
    """Does what a list says, one entry a call; at its end it is silent."""

    port = "somewhere else"

    def __init__(self, *steps: object) -> None:
        self.steps = list(steps)
        self.reconnects: list[object] = []

    def read_frame(self, timeout_s: float) -> Frame:
        if not self.steps:
            threading.Event().wait(0.01)
            raise ResponseTimeout("silent")
        step = self.steps.pop(0)
        if isinstance(step, BaseException):
            raise step
        assert isinstance(step, int)
        samples = np.zeros(4, dtype=np.float32)
        return Frame(counter=step, samples=samples, geometry=GEOMETRY, arrival_ns=step)

    def reconnect(self, timeout_s: float) -> str:
        answer = self.reconnects.pop(0) if self.reconnects else Disconnected("gone")
        if isinstance(answer, BaseException):
            raise answer
        return self.port


def link_of(driver: ScriptedDriver) -> RadarLink:
    mount = Mount(name="left", x_m=0.0, y_m=0.0, yaw_rad=0.0)
    return RadarLink(mount=mount, port="p", serial="s", driver=driver)  # type: ignore[arg-type]


def told_until(
    links: list[RadarLink], source: Path, done: Callable[[list[Event]], bool]
) -> list[Event]:
    inbox: Inbox = queue.SimpleQueue()
    events: list[Event] = []
    with Readers(links, parse_source(str(source)), inbox):
        while not done(events):
            events.append(inbox.get(timeout=seconds(10)))
    return events


@pytest.fixture
def silent_fifo(tmp_path: Path) -> Path:
    os.mkfifo(path := tmp_path / "fifo")
    return path


def test_a_radar_that_vanishes_is_looked_for_until_it_is_back(
    silent_fifo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_readers, "_LOOK_AGAIN_S", 0.001)
    driver = ScriptedDriver(7, 8, Disconnected("unplugged"), 9)
    driver.reconnects = [Disconnected("not yet"), Disconnected("not yet"), "found"]
    events = told_until([link_of(driver)], silent_fifo, lambda events: len(events) == 5)
    assert [e.frame.counter for e in events if isinstance(e, FrameArrived)] == [7, 8, 9]
    assert events[2] == RadarLost(radar=0, text="unplugged")
    assert events[3] == RadarBack(radar=0, port="somewhere else")


def test_a_radar_that_falls_silent_is_lost_and_one_never_found_hinders_no_end(
    silent_fifo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_readers, "SILENCE_S", 0.05)
    events = told_until(
        [link_of(ScriptedDriver(1)), link_of(ScriptedDriver())],
        silent_fifo,
        lambda events: sum(isinstance(e, RadarLost) for e in events) == 2,
    )
    assert {e.text for e in events if isinstance(e, RadarLost)} == {"no frame for 0.05 s"}
    ours = {"radar left", "odometry"}
    assert not [thread.name for thread in threading.enumerate() if thread.name in ours]


def test_odometry_comes_line_by_line_and_its_end_is_told(tmp_path: Path) -> None:
    (path := tmp_path / "drive.tum").write_text("a\nb\n")
    events = told_until([], path, lambda events: len(events) == 3)
    assert [e.text for e in events if isinstance(e, OdometryLine)] == ["a", "b"]
    assert events[2] == OdometryEnded(trouble="")


def test_odometry_that_breaks_off_is_told_with_the_reason(tmp_path: Path) -> None:
    (path := tmp_path / "noise").write_bytes(b"x" * 10_000)
    (event,) = told_until([], path, lambda events: len(events) == 1)
    assert isinstance(event, OdometryEnded)
    assert "without a line end" in event.trouble


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_reader_that_fails_is_told_of(silent_fifo: Path) -> None:
    driver = ScriptedDriver(ZeroDivisionError("a bug"))
    (event,) = told_until([link_of(driver)], silent_fifo, lambda events: len(events) == 1)
    assert event == RadarLost(radar=0, text="its reader failed: ZeroDivisionError('a bug')")

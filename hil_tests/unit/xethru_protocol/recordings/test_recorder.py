"""A recorder takes what a driver receives, and leaves the driver as it was."""

import threading
import time
from collections.abc import Iterator
from datetime import UTC
from pathlib import Path

import pytest

from emulator.chip import Pace
from emulator.loopback import LoopbackTransport
from hil_tests.patience import seconds
from hil_tests.unit.emulator.doubles import ramp_device
from hil_tests.unit.xethru_protocol.recordings.messages import frame
from xethru_protocol.driver.matching import Listeners
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.recordings import (
    Recorder,
    RecordingError,
    Split,
    read_recording,
    recording_facts,
)
from xethru_protocol.wire import messages as m


@pytest.fixture
def line() -> LoopbackTransport:
    return LoopbackTransport(ramp_device(Pace.REALTIME))


@pytest.fixture
def radar(line: LoopbackTransport) -> Iterator[X4M300]:
    with X4M300(line, clock=line.clock_ns) as radar:
        radar.configure_raw()
        yield radar


def counters(directory: Path | None) -> list[int]:
    assert directory is not None
    messages = [message for message, _ in read_recording(directory)]
    return [message.info for message in messages if isinstance(message, m.DataFloat)]


def test_frames_are_recorded_while_the_program_reads_them(
    radar: X4M300, line: LoopbackTransport, tmp_path: Path
) -> None:
    heard: list[int] = []
    radar.listener = listener = lambda message, t_ns: heard.append(t_ns)
    before_ns = time.time_ns()
    with Recorder(radar, tmp_path, clock=line.clock_ns, session_id="one", timezone=UTC) as recorder:
        assert recorder.is_recording()
        assert recorder.is_recording(m.DataFloat)
        assert not recorder.is_recording(m.Ack)
        radar.start(5.0)
        frames = list(radar.frames(4))
        radar.stop()
    assert not recorder.is_recording()
    assert radar.listener is listener
    assert len(heard) >= 4  # answers, too
    assert recorder.messages == 4
    assert recorder.failure is None
    directory = recorder.directory
    assert directory is not None
    assert directory.parent == tmp_path
    assert directory.name.startswith("xethru_recording_2")
    assert directory.name.endswith("_one")
    assert counters(directory) == [frame.counter for frame in frames]
    times = [t_ns for _, t_ns in read_recording(directory)]
    assert times[0] is not None
    assert times[3] is not None
    assert times[0] >= before_ns - 10**6
    arrivals = [frame.arrival_ns for frame in frames]
    assert times[3] - times[0] == pytest.approx(arrivals[3] - arrivals[0], abs=1e6)


def test_only_the_kinds_that_are_wanted_are_recorded(
    radar: X4M300, line: LoopbackTransport, tmp_path: Path
) -> None:
    with Recorder(radar, tmp_path, kinds=[m.BasebandIq], clock=line.clock_ns) as recorder:
        assert not recorder.is_recording(m.DataFloat)
        radar.start(5.0)
        next(radar.frames(1))
    assert recorder.messages == 0
    with pytest.raises(RecordingError):
        Recorder(radar, tmp_path, kinds=[m.Ack])


def test_two_recordings_have_directories_of_their_own(
    radar: X4M300, line: LoopbackTransport, tmp_path: Path
) -> None:
    recorder = Recorder(radar, tmp_path, clock=line.clock_ns, split=Split(records=1))
    found = []
    for _ in range(2):
        recorder.start()
        with pytest.raises(RecordingError):
            recorder.start()
        radar.start(5.0)
        frames = list(radar.frames(2))
        radar.stop()
        recorder.stop()
        recorder.stop()
        assert counters(recorder.directory) == [frame.counter for frame in frames]
        assert recorder.directory is not None
        found.append(recording_facts(recorder.directory).session_id)
    assert len(set(found)) == 2
    assert all(len(session_id) == 36 for session_id in found)


def test_a_listener_set_meanwhile_stays(
    radar: X4M300, line: LoopbackTransport, tmp_path: Path
) -> None:
    def later(message: m.Response, arrival_ns: int) -> None:
        """Hear nothing."""

    with Recorder(radar, tmp_path, clock=line.clock_ns):
        radar.listener = later
    assert radar.listener is later


@pytest.mark.parametrize("order", ["abAa", "abBb", "abAaBb", "abcBbACca"])
def test_recorders_of_one_radar_start_and_stop_in_any_order(tmp_path: Path, order: str) -> None:
    """Each stores every frame of its time once; a capital letter stops one."""
    radar = Radar()
    heard: list[m.Response] = []
    radar.listeners.add(lambda message, t_ns: heard.append(message))
    recorders = {name: Recorder(radar, tmp_path / name) for name in "abc"}
    wanted: dict[str, list[int]] = {}
    for counter, action in enumerate(order):
        recorder = recorders[action.lower()]
        if action.islower():
            recorder.start()
            wanted[action] = []
        else:
            recorder.stop()
            assert counters(recorder.directory) == wanted[action.lower()]
        radar.listeners(frame(counter), counter * 10**9)
        for name, each in recorders.items():
            if each.is_recording():
                wanted[name].append(counter)
    assert heard == [frame(counter) for counter in range(len(order))]
    for name, counted in wanted.items():
        recorders[name].stop()
        assert counters(recorders[name].directory) == counted


def test_a_listener_that_raises_costs_a_recording_nothing(tmp_path: Path) -> None:
    def fail(message: m.Response, arrival_ns: int) -> None:
        raise ValueError("a listener's")

    radar = Radar()
    radar.listeners.add(fail)
    with Recorder(radar, tmp_path) as recorder:
        with pytest.raises(ValueError, match="a listener's"):
            radar.listeners(frame(1), 10**9)
        radar.listeners.remove(fail)
        radar.listeners(frame(2), 2 * 10**9)
    assert counters(recorder.directory) == [1, 2]


def test_another_thread_stops_a_recorder_between_two_records(tmp_path: Path) -> None:
    radar = Radar()
    stops: list[threading.Thread] = []

    def stop_meanwhile(kind: type[m.Response], path: Path) -> None:
        if not stops:
            stops.append(threading.Thread(target=recorder.stop))
            stops[0].start()
            stops[0].join(0.1)

    recorder = Recorder(radar, tmp_path, split=Split(seconds=1), on_file=stop_meanwhile)
    recorder.start()
    for second in (1, 3):
        radar.listeners(frame(second), second * 10**9)
    stops[0].join(seconds(30))
    assert recorder.failure is None
    assert radar.listeners.all == ()
    assert counters(recorder.directory) == [1, 3]


class Radar:
    """Something that is listened to."""

    def __init__(self) -> None:
        self.listeners = Listeners[m.Response, int]()


def test_an_error_ends_the_recording_and_not_the_driver(
    radar: X4M300, line: LoopbackTransport, tmp_path: Path
) -> None:
    errors: list[RecordingError] = []
    split = Split(records=1)
    recorder = Recorder(radar, tmp_path, clock=line.clock_ns, split=split, on_error=errors.append)
    with recorder:
        radar.start(5.0)
        next(radar.frames(1))
        assert recorder.directory is not None
        for path in recorder.directory.iterdir():
            path.unlink()
        recorder.directory.rmdir()
        assert len(list(radar.frames(3))) == 3
        assert not recorder.is_recording()
    assert len(errors) == 1
    assert recorder.failure is errors[0]
    assert "cannot be written: No such file or directory" in str(errors[0])
    assert recorder.messages == 1

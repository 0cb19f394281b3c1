"""A recording made on real hardware goes through an emulated module's port, byte for byte."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from emulator.loopback import LoopbackTransport
from emulator.playback import played_radars
from hil_tests.device.emulator_process import Served, emulator, open_radar
from hil_tests.paths import real_raw_recording, real_recording
from xethru_protocol.cli import main
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.recordings import read_recording
from xethru_protocol.wire.codes import PongCode
from xethru_protocol.wire.messages import BasebandIq, DataFloat

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def recording() -> Path:
    return real_recording()


@pytest.fixture(scope="module")
def recorded(recording: Path) -> list[BasebandIq]:
    messages = [message for message, _ in read_recording(recording)]
    assert all(isinstance(message, BasebandIq) for message in messages)
    return [message for message in messages if isinstance(message, BasebandIq)]


@pytest.fixture(scope="module")
def player(recording: Path) -> Iterator[Served]:
    with emulator("play", recording, "--rate", "0") as served:
        yield served


def test_every_counter_and_every_sample_arrives(player: Served, recorded: list[BasebandIq]) -> None:
    with open_radar(player.paths[0]) as driver:
        frames = list(driver.frames(len(recorded), timeout_s=5.0))
        assert (driver.frames_lost, driver.fault_count) == (0, 0)
    assert len(frames) == 514
    assert [frame.counter for frame in frames] == [message.counter for message in recorded]
    for frame, message in zip(frames, recorded, strict=True):
        assert frame.samples.real.tobytes() == message.i.tobytes()
        assert frame.samples.imag.tobytes() == message.q.tobytes()
        assert frame.geometry.n_bins == 54
    # module metres, from the recording's own description
    assert frames[0].geometry.range_start_m == pytest.approx(0.3343, abs=1e-4)


def test_raw_frames_of_an_x4m03_arrive(tmp_path: Path) -> None:
    """By the driver as complex bins, and by whoever only listens to the wire.

    The driver asks on a line with the time of the module: on a busy machine half a second may
    pass between two of its commands, and then playing begins before it starts the radar.
    """
    recording = real_raw_recording()
    recorded = [message for message, _ in read_recording(recording)]
    (radar,) = played_radars(recording, rate=0, on_fault=lambda fault: pytest.fail(fault.reason))
    line = LoopbackTransport(radar.device)
    with X4M300(line, clock=line.clock_ns) as driver:
        driver.configure_raw(RawConfig(downconversion=True))
        driver.start(17)
        frames = list(driver.frames(len(recorded), timeout_s=5.0))
        assert (driver.frames_lost, driver.fault_count) == (0, 0)
    with emulator("play", recording, "--rate", "0") as served:
        listen = ["record", "--port", served.paths[0], "--profile", "none"]
        listen += ["--count", str(len(recorded)), "--wire", str(tmp_path / "port.xtwire")]
        assert main(listen) == 0
    assert len(frames) == 1518
    for frame, message in zip(frames, recorded, strict=True):
        assert isinstance(message, DataFloat)
        assert frame.counter == message.info
        assert frame.samples.real.tobytes() == message.values[:91].tobytes()
        assert frame.samples.imag.tobytes() == message.values[91:].tobytes()
    heard = [message for message, _ in read_recording(tmp_path / "port.xtwire")]
    assert heard[: len(recorded)] == recorded


def test_a_host_that_asks_first_hears_it_all_too(
    player: Served, recorded: list[BasebandIq]
) -> None:
    for _ in range(2):
        with open_radar(player.paths[0]) as driver:
            assert driver.ping() is PongCode.XTS_SPRP_READY
            assert driver.info().order_code == "X4M300"
            counters = [frame.counter for frame in driver.frames(len(recorded), timeout_s=5.0)]
        assert counters == [message.counter for message in recorded]


def test_real_time_is_kept(recording: Path, recorded: list[BasebandIq]) -> None:
    """At ten times the recorded speed, 30 s take 3 s, by the clock of the module's own line."""
    (radar,) = played_radars(
        recording,
        rate=10,
        on_fault=lambda fault: pytest.fail(fault.reason),
    )
    line = LoopbackTransport(radar.device)
    with X4M300(line, clock=line.clock_ns) as driver:
        frames = list(driver.frames(len(recorded), timeout_s=5.0))
    elapsed_s = (frames[-1].arrival_ns - frames[0].arrival_ns) / 1e9
    # The meta file's stamps of the first and the last record are 29.967 s apart.
    assert elapsed_s == pytest.approx(2.9967, abs=1e-3)


def test_a_loop_begins_again(recording: Path, recorded: list[BasebandIq]) -> None:
    with (
        emulator("play", recording, "--rate", "0", "--loop") as served,
        open_radar(served.paths[0]) as driver,
    ):
        counters = [frame.counter for frame in driver.frames(1200, timeout_s=5.0)]
        assert served.end() == 0
    expected = [message.counter for message in recorded]
    assert counters == (expected * 3)[:1200]

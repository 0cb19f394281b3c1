"""A recording made on real hardware goes through an emulated module's port, byte for byte."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.loopback import LoopbackTransport
from emulator.playback import played_radars
from hil_tests.device.serving import Served, emulator, open_radar
from hil_tests.paths import real_recording
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.recordings import read_recording
from xethru_protocol.wire.codes import PongCode
from xethru_protocol.wire.messages import BasebandIq

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


def phase_stability(iq: NDArray[np.complex64]) -> tuple[int, float, float, float]:
    """Describe the strongest reflector of a recording.

    Parameters
    ----------
    iq
        Shape (n_frames, n_bins), complex.

    Returns
    -------
    Bin with the largest mean amplitude, that amplitude, standard deviation of its unwrapped
    phase [rad], and the part of it that is white from frame to frame [rad]: for white noise the
    difference of neighbours has twice the variance.
    """
    amplitude = np.abs(iq).mean(axis=0)
    strongest = int(np.argmax(amplitude))
    phase = np.unwrap(np.angle(iq[:, strongest].astype(np.complex128)))
    return (
        strongest,
        float(amplitude[strongest]),
        float(np.std(phase)),
        float(np.std(np.diff(phase)) / np.sqrt(2)),
    )


def test_every_counter_and_every_sample_arrives(
    player: Served,
    recorded: list[BasebandIq],
    record_property: Callable[[str, object], None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    with open_radar(player.paths[0]) as driver:
        frames = list(driver.frames(len(recorded), timeout_s=5.0))
        assert (driver.frames_lost, driver.fault_count) == (0, 0)
    assert len(frames) == 514
    assert [frame.counter for frame in frames] == [message.counter for message in recorded]
    for frame, message in zip(frames, recorded, strict=True):
        assert frame.samples.real.tobytes() == message.i.tobytes()
        assert frame.samples.imag.tobytes() == message.q.tobytes()
        assert frame.geometry.n_bins == 54
    geometry = frames[0].geometry
    iq = np.stack([frame.samples for frame in frames]).astype(np.complex64)
    strongest, amplitude, total_rad, white_rad = phase_stability(iq)
    range_m = geometry.range_start_m + strongest * geometry.bin_length_m
    record_property("strongest_bin", strongest)
    record_property("strongest_range_m", range_m)
    record_property("mean_amplitude", amplitude)
    record_property("phase_std_rad", total_rad)
    record_property("phase_white_std_rad", white_rad)
    with capsys.disabled():
        print(  # noqa: T201 - the numbers are what this test is run for
            f"\n{len(frames)} real frames: strongest reflector in bin {strongest} "
            f"at {range_m:.4f} m (module metres), mean amplitude {amplitude:.4f}, "
            f"phase std {total_rad:.4f} rad, white part {white_rad:.4f} rad"
        )
    # the recording's own description
    assert strongest == 0
    assert range_m == pytest.approx(0.3343, abs=1e-4)
    assert amplitude == pytest.approx(0.0294, abs=1e-4)
    assert total_rad == pytest.approx(0.032, abs=1e-3)
    assert white_rad == pytest.approx(0.0056, abs=2e-4)


def test_phase_stability_of_a_known_signal() -> None:
    """A random walk of step s has differences of standard deviation s: white part s/sqrt 2."""
    rng = np.random.default_rng(7)
    phase = np.cumsum(rng.normal(0, 0.01, 20_000))
    iq = np.stack([np.full(20_000, 0.1 + 0j), 3 * np.exp(1j * phase)], axis=1)
    strongest, amplitude, _, white_rad = phase_stability(iq.astype(np.complex64))
    assert strongest == 1
    assert amplitude == pytest.approx(3, rel=1e-5)
    assert white_rad == pytest.approx(0.01 / np.sqrt(2), rel=0.03)


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

"""A module whose clock is fast or slow: when its frames come, and what is in them."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from emulator.chip import Pace
from emulator.chip.chip import CaptureSettings, EchoSource, ModuleClock
from emulator.device import radar_device
from emulator.echo.echo import echo_source
from emulator.loopback import LoopbackTransport
from emulator.scene.scene import LeakageSpec, NoiseSpec, PathSpec, RadarSpec, Scene, TargetSpec
from hil_tests.unit.emulator.doubles import IDENTITY, BareHost, RampSource
from xethru_protocol.driver.frames import Frame
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.x4 import frame_time_ns, real_frame_rate

SECOND = 1_000_000_000
PPM = 50.0
SKEW_NS = 190_000_000


def true_ns(nominal_ns: int, ppm: float = PPM, skew_ns: int = 0) -> Fraction:
    """Return when a clock that is ppm fast shows a time: earlier than a perfect one."""
    return Fraction(nominal_ns) / (1 + Fraction(ppm) / 10**6) + skew_ns


@settings(max_examples=40)
@given(st.floats(-1000, 1000), st.integers(0, 10**10), st.integers(0, 10**13), st.integers(2, 300))
def test_in_real_time_a_stream_begins_with_the_first_frame_still_ahead(
    ppm: float, skew_ns: int, start_ns: int, fps: int
) -> None:
    clock = ModuleClock(skew_ns=skew_ns, ppm=ppm)
    device = radar_device(IDENTITY, RampSource(), Pace.REALTIME, clock=clock)
    host = BareHost(device)
    host.enter_manual()
    host.now_ns = start_ns
    host.set(X4Setting.FPS, float(fps))
    due_ns = device.wake_ns(host.now_ns)
    assert due_ns is not None
    host.now_ns = due_ns
    device.advance(host.now_ns)
    counter = host.frames(1)[0].info

    def frame_ns(counter: int) -> Fraction:
        return true_ns(frame_time_ns(counter, real_frame_rate(float(fps))), ppm, skew_ns)

    assert abs(due_ns - frame_ns(counter)) <= 1
    assert due_ns >= start_ns
    assert counter == 0 or frame_ns(counter - 1) < start_ns + 1


class AtTrueTimes:
    """A perfect module's source, asked at the times when a fast module takes its frames."""

    def __init__(self, source: EchoSource) -> None:
        self._source = source

    def rf_counters(
        self,
        capture: CaptureSettings,
        frame_counters: NDArray[np.int64],
        scene_times_ns: NDArray[np.int64],
    ) -> NDArray[np.int64]:
        times_ns = np.array([round(true_ns(t_ns)) for t_ns in scene_times_ns.tolist()])
        return self._source.rf_counters(capture, frame_counters, times_ns)


def approaching(ppm: float) -> Scene:
    """Return a robot that drives 1 m/s towards a rod for 100 s, and hears nothing else."""
    radar = RadarSpec(
        name="ahead", serial="000000000001", x_m=0.0, y_m=0.0, yaw_deg=0.0, clock_ppm=ppm
    )
    rod = TargetSpec(name="rod", kind="rod", x_m=101.5, y_m=0.0)
    return Scene(
        name="approach",
        environment="lab",
        description="Towards a rod.",
        radars=(radar,),
        targets=(rod,),
        path=PathSpec(waypoints_m=((0.0, 0.0), (100.0, 0.0)), laps=("forward",), speed_mps=1.0),
        noise=NoiseSpec(rf_sigma=0.0),
        leakage=LeakageSpec(amplitude=0.0),
    )


def frames_of(source: EchoSource, pace: Pace, ppm: float) -> list[Frame]:
    """Return 100 frames, about one a second, heard by the driver in virtual time."""
    device = radar_device(IDENTITY, source, pace, clock=ModuleClock(ppm=ppm))
    line = LoopbackTransport(device)
    with X4M300(line, clock=line.clock_ns) as driver:
        driver.configure_raw(RawConfig())
        driver.start(1.0)
        return list(driver.frames(100, timeout_s=5.0))


def test_a_fast_modules_frames_are_a_perfect_ones_at_an_earlier_time() -> None:
    """After 97 s at 50 ppm the robot is 4.8 mm less far: a quarter of a carrier period."""
    fast = frames_of(echo_source(approaching(PPM), 0, 0), Pace.ASAP, PPM)
    perfect = echo_source(approaching(0.0), 0, 0)
    right = frames_of(AtTrueTimes(perfect), Pace.ASAP, 0.0)
    late = frames_of(perfect, Pace.ASAP, 0.0)
    for counter in (96, 97, 98):  # 5.3 to 3.3 m from the rod
        echo = fast[counter].samples
        loudness = np.abs(echo).max()
        assert loudness > 1e-3
        # What is left is the length of its bins, 50 ppm of the range.
        assert np.abs(echo - right[counter].samples).max() < 0.1 * loudness
        assert np.abs(echo - late[counter].samples).max() > 0.8 * loudness


def test_a_fast_module_sends_the_same_frames_under_both_paces_and_in_real_time_early() -> None:
    source = echo_source(approaching(PPM), 0, 0)
    asap, realtime = (frames_of(source, pace, PPM) for pace in Pace)
    by_counter = {frame.counter: frame for frame in asap}
    assert list(by_counter) == list(range(100))
    rate_hz = real_frame_rate(1.0)
    for frame in realtime:
        if frame.counter in by_counter:
            assert frame.samples.tobytes() == by_counter[frame.counter].samples.tobytes()
        nominal_ns = frame_time_ns(frame.counter, rate_hz)
        assert abs(frame.arrival_ns - true_ns(nominal_ns)) <= 1
        assert frame.counter < 90 or nominal_ns - frame.arrival_ns > 4_000_000

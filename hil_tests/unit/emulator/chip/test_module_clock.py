"""A module's clock: when it samples and how short its bins are; and how loud its receiver is."""

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from emulator.chip import Pace
from emulator.chip.chip import EchoSource, ModuleClock
from emulator.echo.echo import SceneEcho, echo_source
from emulator.loopback import LoopbackTransport
from emulator.scene.scene import LeakageSpec, NoiseSpec, PathSpec, RadarSpec, Scene
from emulator.x4m300 import radar_device
from hil_tests.property.examples import examples
from hil_tests.unit.emulator.doubles import IDENTITY, BareHost, RampSource
from hil_tests.unit.emulator.rooms import PAPER, radar_at, room, target
from xethru_protocol.driver.frames import Frame
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.x4 import frame_time_ns, real_frame_rate

DAY_NS = 86_400_000_000_000
PPM = 50.0
CAPTURE = replace(PAPER, first_sample_m=0.0, n_samples=1400, dac_min=0, dac_max=2047)


def true_ns(nominal_ns: int, ppm: float = PPM, skew_ns: int = 0) -> Fraction:
    """Return when a clock that is ppm fast shows a time: earlier than a perfect one."""
    return Fraction(nominal_ns) / (1 + Fraction(ppm) / 10**6) + skew_ns


@given(
    nominal_ns=st.integers(0, DAY_NS),
    skew_ns=st.integers(0, 10_000_000_000),
    ppm=st.floats(-1000, 1000),
)
def test_a_frame_is_taken_when_the_modules_clock_says_so(
    nominal_ns: int, skew_ns: int, ppm: float
) -> None:
    """Against exact fractions; and the clock shows the same time when it is read back."""
    clock = ModuleClock(skew_ns=skew_ns, ppm=ppm)
    exact = true_ns(nominal_ns, ppm, skew_ns)
    assert abs(clock.scene_time_ns(nominal_ns) - exact) <= Fraction(51, 100)
    assert abs(clock.nominal_ns(clock.scene_time_ns(nominal_ns)) - nominal_ns) <= 1
    many = clock.scene_times_ns(np.array([nominal_ns, 0]))
    assert many.tolist() == [clock.scene_time_ns(nominal_ns), skew_ns]


def test_a_perfect_clock_changes_no_bit() -> None:
    times = np.array([0, 1, DAY_NS - 1, DAY_NS])
    np.testing.assert_array_equal(ModuleClock(skew_ns=7).scene_times_ns(times), times + 7)


def driving(radar: RadarSpec, target_x_m: float) -> Scene:
    path = PathSpec(waypoints_m=((0.0, 0.0), (50.0, 0.0)), laps=("forward",), speed_mps=0.05)
    return room(radar, path=path, targets=(target(target_x_m, 0.0, amplitude_1m=5.0),))


def test_a_fast_module_samples_earlier_with_shorter_bins() -> None:
    """A frame at +100 ppm is a perfect module's of T / 1.0001, on bins shorter by 1.0001.

    After 900 s of its own it is 0.09 s early; the target 7 m ahead seems 0.7 mm farther, by a
    carrier that is as much shorter: to the bin, an echo from there.
    """
    perfect, fast = radar_at(0, 0, 0), radar_at(0, 0, 0, clock_ppm=100.0)
    nominal_ns, earlier_ns = np.array([900_090_000_000]), np.array([900_000_000_000])
    got = SceneEcho(driving(fast, 52.0), fast, 0).echo(CAPTURE, nominal_ns)[0]
    ahead_m = 52.0 - 0.05 * 900
    stretched = driving(perfect, 52.0 + ahead_m * 1e-4)
    same = SceneEcho(stretched, perfect, 0).echo(CAPTURE, earlier_ns)[0]
    np.testing.assert_allclose(got * 1.0001**-2, same, atol=1e-9)
    assert np.abs(got).max() > 0.05
    late = SceneEcho(stretched, perfect, 0).echo(CAPTURE, nominal_ns)[0]
    assert np.abs(got - late).max() > 0.1 * np.abs(got).max()


@pytest.mark.parametrize("gain_db", [-6.0, 3.0])
def test_gain_scales_what_arrives_and_not_the_noise(gain_db: float) -> None:
    now = np.array([0])
    scene = room(radar_at(0, 0, 0), targets=(target(1.0, 0.0),)).model_copy(
        update={"leakage": LeakageSpec(amplitude=0.01), "noise": NoiseSpec(rf_sigma=1e-3)}
    )
    plain, loud = radar_at(0, 0, 0), radar_at(0, 0, 0, gain_db=gain_db)
    factor = 10 ** (gain_db / 20)
    expected = factor * SceneEcho(scene, plain, 0).echo(CAPTURE, now)
    np.testing.assert_allclose(SceneEcho(scene, loud, 0).echo(CAPTURE, now), expected, atol=1e-9)
    silent = scene.model_copy(update={"targets": (), "leakage": LeakageSpec(amplitude=0.0)})
    np.testing.assert_array_equal(
        SceneEcho(silent, loud, 0).rf_counters(CAPTURE, now, now),
        SceneEcho(silent, plain, 0).rf_counters(CAPTURE, now, now),
    )


def test_the_phase_of_a_frame_turns_all_of_its_echoes() -> None:
    """A quarter turn each for two frames a half turn apart: the signal changes its sign."""
    scene = room(radar_at(0, 0, 0), targets=(target(1.0, 0.0), target(2.0, 0.3, name="other")))
    source = SceneEcho(scene, scene.radars[0], 0)
    two = source.echo(CAPTURE, np.array([0, 0]), np.array([0.3, 0.3 + math.pi]))
    np.testing.assert_allclose(two[0], -two[1], atol=1e-15)
    assert not np.array_equal(two[0], source.echo(CAPTURE, np.array([0]))[0])


@settings(max_examples=examples(40))
@given(st.floats(-1000, 1000), st.integers(0, 10**10), st.integers(0, 10**13), st.integers(2, 300))
@example(ppm=0.0, skew_ns=0, start_ns=1, fps=2)
def test_in_real_time_a_stream_begins_with_the_first_frame_still_ahead(
    ppm: float, skew_ns: int, start_ns: int, fps: int
) -> None:
    clock = ModuleClock(skew_ns=skew_ns, ppm=ppm)
    source = RampSource()
    device = radar_device(IDENTITY, source, Pace.REALTIME, clock=clock)
    host = BareHost(device)
    host.enter_manual()
    source.scene_times_ns.clear()  # of the profile, which runs from power-up on
    host.now_ns = start_ns
    host.set(X4Setting.FPS, float(fps))
    due_ns = device.wake_ns(host.now_ns)
    assert due_ns is not None
    host.now_ns = due_ns
    device.advance(host.now_ns)
    assert host.frames(1)[0].info == 1
    index = min(source.scene_times_ns)
    rate_hz = real_frame_rate(float(fps))

    def frame_ns(index: int) -> Fraction:
        return true_ns(frame_time_ns(index, rate_hz), ppm, skew_ns)

    # a source that knows the clock itself is asked for nominal times
    assert source.scene_times_ns[index] == frame_time_ns(index, rate_hz)
    assert abs(due_ns - frame_ns(index)) <= 1
    assert due_ns >= start_ns
    assert index == 0 or frame_ns(index - 1) < start_ns + 1


def frames_of(source: EchoSource, pace: Pace) -> list[Frame]:
    """Return 100 frames, about one a second, heard by the driver in virtual time."""
    device = radar_device(IDENTITY, source, pace, clock=ModuleClock(ppm=PPM))
    line = LoopbackTransport(device)
    with X4M300(line, clock=line.clock_ns) as driver:
        driver.configure_raw(RawConfig())
        driver.start(1.0)
        return list(driver.frames(100, timeout_s=5.0))


def test_a_fast_module_sends_the_same_frames_under_both_paces_and_in_real_time_early() -> None:
    """The robot drives 1 m/s towards a rod for 100 s."""
    path = PathSpec(waypoints_m=((0.0, 0.0), (100.0, 0.0)), laps=("forward",), speed_mps=1.0)
    scene = room(radar_at(0, 0, 0, clock_ppm=PPM), path=path, targets=(target(101.5, 0.0),))
    source = echo_source(scene, 0, 0)
    asap, realtime = (frames_of(source, pace) for pace in Pace)
    by_counter = {frame.counter: frame for frame in asap}
    assert list(by_counter) == list(range(1, 101))
    rate_hz = real_frame_rate(1.0)
    for frame in realtime:
        if frame.counter in by_counter:
            assert frame.samples.tobytes() == by_counter[frame.counter].samples.tobytes()
        nominal_ns = frame_time_ns(frame.counter - 1, rate_hz)
        assert abs(frame.arrival_ns - true_ns(nominal_ns)) <= 1
        assert frame.counter < 90 or nominal_ns - frame.arrival_ns > 4_000_000

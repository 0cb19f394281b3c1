"""Echoes against closed forms: where they are, how strong, in which phase, in which counts."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import hilbert

from emulator.echo.echo import SceneEcho, echo_source
from emulator.echo.paths import (
    BEAM_EXPONENT,
    beam_gain,
    direct_reflections,
    reflection_phase_rad,
    target_scatterers,
    viewpoint,
)
from emulator.scene.scene import (
    LeakageSpec,
    PathSpec,
    RadarSpec,
    TargetSpec,
    empty_room,
)
from hil_tests.unit.emulator.rooms import PAPER, radar_at, room

BIN_M = 1.5e8 / 23.328e9
C_MPS = 299_792_458.0
NOW = np.array([0])
CAPTURE = replace(PAPER, first_sample_m=0.18 + 3 * BIN_M)
FORWARD = radar_at(0, 0, 0)


def target(x_m: float, y_m: float = 0.0, **changes: object) -> TargetSpec:
    values = {"name": "rod", "kind": "rod", "x_m": x_m, "y_m": y_m, "amplitude_1m": 0.015}
    return TargetSpec.model_validate(values | changes)


def quiet(
    *targets: TargetSpec, radar: RadarSpec = FORWARD, path: PathSpec | None = None
) -> SceneEcho:
    return SceneEcho(room(radar, targets=targets, path=path or PathSpec()), radar, seed=0)


def envelope(frame: NDArray[np.float64]) -> NDArray[np.float64]:
    magnitude: NDArray[np.float64] = np.abs(hilbert(frame))
    return magnitude


def peak(frame: NDArray[np.float64]) -> tuple[float, float]:
    """Return position (in samples, parabola through the log envelope) and height of the echo."""
    e = envelope(frame)
    k = int(e.argmax())
    before, top, after = np.log(e[k - 1 : k + 2])
    shift = 0.5 * (before - after) / (before - 2 * top + after)
    return k + shift, math.exp(top - 0.25 * (before - after) * shift)


@pytest.mark.parametrize("range_m", [0.6, 1.0, 2.7182, 9.0])
def test_echo_lies_at_its_two_way_delay(range_m: float) -> None:
    position, _ = peak(quiet(target(range_m)).echo(CAPTURE, NOW)[0])
    label_m = CAPTURE.first_sample_m + position * BIN_M
    # Labels are module metres: they take light to be 3.0e8 m/s fast.
    assert label_m * C_MPS / 3.0e8 == pytest.approx(range_m, abs=2e-6)


@pytest.mark.parametrize("offset_m", [-0.02, 0.02, 0.3])
def test_a_range_offset_moves_the_echo(offset_m: float) -> None:
    radar = FORWARD.model_copy(update={"range_offset_m": offset_m})
    there = quiet(target(1.0), radar=radar).echo(CAPTURE, NOW)[0]
    moved, _ = peak(there)
    plain, height = peak(quiet(target(1.0)).echo(CAPTURE, NOW)[0])
    assert (moved - plain) * BIN_M * C_MPS / 3.0e8 == pytest.approx(offset_m, abs=2e-6)
    assert peak(there)[1] == pytest.approx(height, rel=1e-4)


@pytest.mark.parametrize("bins", [-3, 1, 40])
def test_first_sample_moves_the_window_over_the_same_echo(bins: int) -> None:
    still = quiet(target(1.0)).echo(CAPTURE, NOW)[0]
    later = replace(CAPTURE, first_sample_m=CAPTURE.first_sample_m + bins * BIN_M)
    moved = quiet(target(1.0)).echo(later, NOW)[0]
    common = slice(100, 1300)
    shifted = slice(100 + bins, 1300 + bins)
    np.testing.assert_allclose(moved[common], still[shifted], atol=1e-13)


@pytest.mark.parametrize(("kind", "exponent"), [("rod", 1.5), ("point", 2.0)])
@pytest.mark.parametrize("range_m", [0.5, 1.0, 2.0, 4.0])
def test_amplitude_falls_with_range(kind: str, exponent: float, range_m: float) -> None:
    _, height = peak(quiet(target(range_m, kind=kind)).echo(CAPTURE, NOW)[0])
    assert height == pytest.approx(0.015 * range_m**-exponent, rel=1e-4)


def test_beam_is_65_degrees_wide_at_minus_3_db_two_way() -> None:
    edge = math.cos(math.radians(32.5))
    assert edge**BEAM_EXPONENT == pytest.approx(math.sqrt(0.5), rel=1e-12)
    gains = beam_gain(np.array([1.0, edge, 0.0, -0.5, -1.0]))
    np.testing.assert_allclose(gains, [1, math.sqrt(0.5), 0, 0, 0], rtol=1e-12)


@pytest.mark.parametrize("angle_deg", [0, 10, -32.5, 32.5, 60, -80])
def test_echo_follows_the_beam(angle_deg: float) -> None:
    angle = math.radians(angle_deg)
    echo = quiet(target(math.cos(angle), math.sin(angle))).echo(CAPTURE, NOW)[0]
    expected = 0.015 * math.cos(angle) ** (
        math.log(0.5) / 2 / math.log(math.cos(math.radians(32.5)))
    )
    assert peak(echo)[1] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("angle_deg", [90, 120, 180, -135])
def test_nothing_is_heard_from_behind(angle_deg: float) -> None:
    angle = math.radians(angle_deg)
    assert not quiet(target(math.cos(angle), math.sin(angle))).echo(CAPTURE, NOW).any()


@pytest.mark.parametrize("distance_m", [0.0, 0.01])
def test_a_target_on_the_antenna_is_finite(distance_m: float) -> None:
    assert np.isfinite(quiet(target(distance_m)).echo(CAPTURE, NOW)).all()


def test_carrier_phase_follows_the_range() -> None:
    """Demodulated at the echo's own delay, the phase is the reflection's, at every range."""
    samples = np.arange(CAPTURE.n_samples)
    for range_m in np.linspace(0.9, 1.1, 41):
        frame = quiet(target(range_m)).echo(CAPTURE, NOW)[0]
        delay = 2 * range_m / C_MPS - 2 * CAPTURE.first_sample_m / 3.0e8
        carrier = np.exp(-2j * np.pi * 7.29e9 * (samples / 23.328e9 - delay))
        # The conjugate image at twice the carrier cancels over the smooth envelope.
        got = np.angle((frame * carrier * envelope(frame)).sum())
        assert math.remainder(got - reflection_phase_rad("rod"), math.tau) == pytest.approx(
            0, abs=1e-3
        )


def test_reflection_phases_are_spread_and_fixed() -> None:
    phases = [reflection_phase_rad(f"rod_{k:02d}") for k in range(100)]
    assert abs(np.exp(1j * np.array(phases)).mean()) < 0.25
    # SHA-256("abc") begins with ba7816bf (FIPS 180-2).
    assert reflection_phase_rad("abc") == pytest.approx(math.tau * 0xBA7816BF / 2**32)


def test_mount_and_robot_pose_place_the_radar() -> None:
    """Robot at (1, 0) heading 90 deg after 1 m and a left turn; the mount looks to its left."""
    path = PathSpec(
        waypoints_m=((0.0, 0.0), (1.0, 0.0), (1.0, 9.0)),
        laps=("forward",),
        speed_mps=0.1,
        turn_rate_deg_per_s=90.0,
    )
    radar = FORWARD.model_copy(update={"x_m": 0.1, "y_m": 0.2, "yaw_deg": 90.0})
    # Body (0.1, 0.2) is world (1 - 0.2, 0 + 0.1); its boresight is the world's -x.
    echo = quiet(target(0.8 - 0.7, 0.1), radar=radar, path=path)
    position, height = peak(echo.echo(CAPTURE, np.array([11_000_000_000]))[0])
    range_m = (CAPTURE.first_sample_m + position * BIN_M) * C_MPS / 3.0e8
    assert range_m == pytest.approx(0.7, abs=2e-6)
    assert height == pytest.approx(0.015 * 0.7**-1.5, rel=1e-4)


def test_start_skew_samples_the_robot_later() -> None:
    path = PathSpec(waypoints_m=((0.0, 0.0), (5.0, 0.0)), laps=("forward",), speed_mps=0.5)
    skewed = FORWARD.model_copy(update={"start_skew_ms": 190.0})
    times = np.array([0, 1_000_000_000])
    got = quiet(target(6.0), radar=skewed, path=path).echo(CAPTURE, times)
    expected = quiet(target(6.0), path=path).echo(CAPTURE, times + 190_000_000)
    np.testing.assert_array_equal(got, expected)
    assert not np.array_equal(got, quiet(target(6.0), path=path).echo(CAPTURE, times))


@pytest.mark.parametrize(("power", "factor"), [(0, 0.0), (1, 0.5**0.5), (2, 1.0), (3, 2**0.5)])
def test_tx_power_scales_the_echo(power: int, factor: float) -> None:
    echo = quiet(target(1.0))
    got = echo.echo(replace(CAPTURE, tx_power=power), NOW)
    np.testing.assert_allclose(got, factor * echo.echo(CAPTURE, NOW), atol=1e-15)


def test_the_higher_carrier_is_8_748_ghz() -> None:
    frame = quiet(target(1.0)).echo(replace(CAPTURE, tx_center_frequency=4), NOW)[0]
    spectrum = np.abs(np.fft.rfft(frame, 1 << 16))
    assert np.fft.rfftfreq(1 << 16, 1 / 23.328e9)[spectrum.argmax()] == pytest.approx(
        8.748e9, abs=2e6
    )


def test_leakage_is_a_pulse_at_its_own_range() -> None:
    scene = empty_room().model_copy(update={"leakage": LeakageSpec(amplitude=0.05, range_m=0.6)})
    frame = SceneEcho(scene, scene.radars[0], seed=0).echo(CAPTURE, NOW)[0]
    position, height = peak(frame)
    assert (CAPTURE.first_sample_m + position * BIN_M) * C_MPS / 3.0e8 == pytest.approx(
        0.6, abs=2e-6
    )
    assert height == pytest.approx(0.05, rel=1e-4)


@pytest.mark.parametrize("dac_step", [0, 2])
@pytest.mark.parametrize(("dac_min", "dac_max"), [(949, 1100), (0, 2047)])
def test_counts_are_the_rounded_signal(dac_min: int, dac_max: int, dac_step: int) -> None:
    capture = replace(CAPTURE, dac_min=dac_min, dac_max=dac_max, dac_step=dac_step)
    source = quiet(target(1.0))
    counts = source.rf_counters(capture, NOW, NOW)
    assert counts.dtype == np.int64
    # Back through the normalisation of protocol reference 9.7.
    quantum = 2**dac_step / (16 * 300) / 1024
    back = counts * quantum - (dac_max - dac_min + 1) / 2048
    np.testing.assert_allclose(back, source.echo(capture, NOW), atol=quantum * 0.501)


def test_a_strong_echo_saturates_at_the_ends_of_the_counter() -> None:
    source = quiet(target(0.5, amplitude_1m=5.0))
    counts = source.rf_counters(CAPTURE, NOW, NOW)
    # iterations x pulses x (1100 - 949 + 1) levels: protocol reference 9.7.
    assert (counts.min(), counts.max()) == (0, 16 * 300 * 152)


def test_silence_is_half_the_counter() -> None:
    counts = quiet().rf_counters(CAPTURE, np.arange(3), np.arange(3))
    assert counts.shape == (3, 1431)
    assert set(counts.ravel().tolist()) == {16 * 300 * 152 // 2}


@pytest.mark.parametrize(
    ("iterations", "pulses"), [(16, 300), (16, 10), (64, 87), (4, 1200), (32, 26)]
)
def test_noise_is_white_and_falls_with_the_root_of_the_pulses(iterations: int, pulses: int) -> None:
    capture = replace(
        CAPTURE, iterations=iterations, pulses_per_step=pulses, dac_min=0, dac_max=2047
    )
    scene = empty_room().model_copy(update={"leakage": LeakageSpec(amplitude=0.0)})
    counters = np.arange(100)
    counts = echo_source(scene, 0, seed=5).rf_counters(capture, counters, counters)
    signal = counts / (iterations * pulses) / 1024 - 1
    expected = 5e-4 * math.sqrt(16 * 300 / (iterations * pulses))
    n = signal.size
    # Rounding to counts adds its own variance, q**2 / 12.
    quantum = 1 / (iterations * pulses) / 1024
    sigma = math.hypot(expected, quantum / math.sqrt(12))
    assert signal.std() == pytest.approx(sigma, rel=4 / math.sqrt(2 * n))
    assert abs(signal.mean()) < 4 * sigma / math.sqrt(n)
    neighbours = (signal[:, 1:] * signal[:, :-1]).mean() / sigma**2
    assert abs(neighbours) < 4 / math.sqrt(n)


@pytest.mark.parametrize(("kind", "exponent"), [("rod", 1.5), ("point", 2.0)])
def test_the_amplitude_law_is_held_at_5_cm(kind: str, exponent: float) -> None:
    here = np.zeros((1, 3))

    def strength(range_m: float) -> float:
        scatterers = target_scatterers((target(range_m, kind=kind),))
        reflections = direct_reflections(scatterers, viewpoint(FORWARD, here))
        assert reflections.range_m[0, 0] == pytest.approx(range_m)
        return float(reflections.amplitude[0, 0])

    for range_m in (0.05, 0.06, 1.0):
        assert strength(range_m) == pytest.approx(0.015 * range_m**-exponent)
    for range_m in (0.0, 1e-9, 0.01, 0.049):
        assert strength(range_m) <= strength(0.05)

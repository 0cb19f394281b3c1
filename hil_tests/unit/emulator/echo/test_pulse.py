"""The pulse has the stated spectrum, and frames are exact sums of shifted pulses."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.echo.pulse import (
    BANDWIDTH_HZ,
    CARRIER_CYCLES_PER_SAMPLE,
    HALF_WINDOW,
    NOMINAL_PULSE,
    SIGMA_S,
    sum_of_pulses,
)
from emulator.scene.scene import PulseSpec

SAMPLING_RATE_HZ = 23.328e9
CARRIER_HZ = {3: 7.290e9, 4: 8.748e9}


def formula(
    position: float, amplitude: float, phase_rad: float, setting: int, n_samples: int
) -> NDArray[np.float64]:
    t = (np.arange(n_samples) - position) / SAMPLING_RATE_HZ
    wave: NDArray[np.float64] = (
        amplitude
        * np.exp(-0.5 * (t / SIGMA_S) ** 2)
        * np.cos(2 * np.pi * CARRIER_HZ[setting] * t + phase_rad)
    )
    return wave


def one_pulse(
    position: float,
    amplitude: float,
    phase_rad: float,
    setting: int,
    n_samples: int,
    *,
    pulse: PulseSpec = NOMINAL_PULSE,
) -> NDArray[np.float64]:
    frames = sum_of_pulses(
        frame=np.array([0]),
        position=np.array([position]),
        amplitude=np.array([amplitude]),
        phase_rad=np.array([phase_rad]),
        tx_center_frequency=setting,
        shape=(1, n_samples),
        pulse=pulse,
    )
    frame: NDArray[np.float64] = frames[0]
    return frame


def test_sigma_is_the_papers_pulse() -> None:
    assert pytest.approx(0.34501e-9, abs=5e-15) == SIGMA_S
    # Envelope over range: c/2 * sigma.
    assert pytest.approx(51.7e-3, abs=5e-5) == 299_792_458 / 2 * SIGMA_S


@pytest.mark.parametrize(("setting", "width"), [(3, 1.0), (4, 1.0), (3, 1.1)])
def test_bandwidth_at_minus_10_db_is_1_4_ghz_over_the_width(setting: int, width: float) -> None:
    n, shape = 1 << 16, PulseSpec(width=width)
    power = np.abs(np.fft.rfft(one_pulse(700.0, 1.0, 0.3, setting, 1400, pulse=shape), n)) ** 2
    frequency_hz = np.fft.rfftfreq(n, 1 / SAMPLING_RATE_HZ)
    inside = frequency_hz[power >= power.max() / 10]
    assert frequency_hz[power.argmax()] == pytest.approx(CARRIER_HZ[setting], abs=2e6)
    assert inside[-1] - inside[0] == pytest.approx(BANDWIDTH_HZ / width, abs=2e6)


@pytest.mark.parametrize("setting", [3, 4])
def test_carrier_fractions_are_exact(setting: int) -> None:
    cycles, samples = CARRIER_CYCLES_PER_SAMPLE[setting]
    assert SAMPLING_RATE_HZ * cycles / samples == CARRIER_HZ[setting]


@pytest.mark.parametrize("setting", [3, 4])
@pytest.mark.parametrize("position", [200.0, 200.5, 199.50001, 312.123, 0.0, 399.0])
@pytest.mark.parametrize("phase_rad", [0.0, 1.0, 4.7])
def test_pulse_is_its_formula(setting: int, position: float, phase_rad: float) -> None:
    got = one_pulse(position, 1.0, phase_rad, setting, 400)
    # 1.6e-8 is the cut at six sigma, 2e-9 the series.
    np.testing.assert_allclose(got, formula(position, 1.0, phase_rad, setting, 400), atol=2e-8)


@pytest.mark.parametrize("position", [-20.0, -HALF_WINDOW + 0.4, 399 + HALF_WINDOW - 0.4, 410.7])
def test_pulses_reach_in_from_outside_the_frame(position: float) -> None:
    got = one_pulse(position, 1.0, 0.2, 3, 400)
    np.testing.assert_allclose(got, formula(position, 1.0, 0.2, 3, 400), atol=2e-8)


@pytest.mark.parametrize("position", [-1e9, -49.0, 448.0, 1e9])
def test_pulses_beyond_reach_leave_the_frame_empty(position: float) -> None:
    assert not one_pulse(position, 1.0, 0.0, 3, 400).any()


def test_frames_are_sums_of_their_own_pulses() -> None:
    rng = np.random.default_rng(1)
    frame = np.array([0, 0, 2, 2, 2])
    position = rng.uniform(0, 300, 5)
    amplitude = rng.uniform(0, 1, 5)
    phase_rad = rng.uniform(0, math.tau, 5)
    got = sum_of_pulses(
        frame=frame,
        position=position,
        amplitude=amplitude,
        phase_rad=phase_rad,
        tx_center_frequency=3,
        shape=(3, 300),
    )
    expected = np.zeros((3, 300))
    for f, p, a, phi in zip(frame, position, amplitude, phase_rad, strict=True):
        expected[f] += formula(p, a, phi, 3, 300)
    np.testing.assert_allclose(got, expected, atol=6e-8)
    assert got.dtype == np.float64


def test_no_pulses_give_zeros_of_the_right_type() -> None:
    nothing = np.array([])
    got = sum_of_pulses(
        frame=np.array([], dtype=np.int64),
        position=nothing,
        amplitude=nothing,
        phase_rad=nothing,
        tx_center_frequency=3,
        shape=(2, 30),
    )
    assert got.shape == (2, 30)
    assert got.dtype == np.float64
    assert not got.any()


@pytest.mark.parametrize("position", [200.0, 199.7, 200.5])
def test_a_modules_own_pulse_is_two_sided_and_rings(position: float) -> None:
    """Widths w (1 -+ s) before and after the peak; r of it 3.2 sigma later, 1 rad ahead."""
    w, s, r, phase_rad = 1.15, 0.2, 0.25, 0.7
    shape = PulseSpec(width=w, skew=s, ringing=r)
    got = one_pulse(position, 2.0, phase_rad, 3, 400, pulse=shape)
    t = (np.arange(400) - position) / SAMPLING_RATE_HZ

    def pulse(t: NDArray[np.floating], ahead_rad: float) -> NDArray[np.float64]:
        sigma = np.where(t < 0, w * (1 - s), w * (1 + s)) * SIGMA_S
        wave: NDArray[np.float64] = np.exp(-(t**2) / (2 * sigma**2)) * np.cos(
            2 * np.pi * CARRIER_HZ[3] * t + phase_rad + ahead_rad
        )
        return wave

    expected = 2.0 * pulse(t, 0.0)
    expected += 2.0 * r * pulse(t - 3.2 * SIGMA_S, 1.0)
    np.testing.assert_allclose(got, expected, atol=6e-8)


@pytest.mark.parametrize("position", [200.0, 199.50001, 312.123])
def test_a_pulse_with_an_offset_of_its_carrier_is_its_formula(position: float) -> None:
    got = one_pulse(position, 1.0, 0.7, 3, 400, pulse=PulseSpec(carrier_offset_hz=-1.9e8))
    t_s = (np.arange(400) - position) / SAMPLING_RATE_HZ
    expected = np.exp(-0.5 * (t_s / SIGMA_S) ** 2) * np.cos(2 * np.pi * 7.1e9 * t_s + 0.7)
    np.testing.assert_allclose(got, expected, atol=2e-8)

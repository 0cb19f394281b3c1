"""Range profiles against integrals over the spectrum of an echo, and the statistics of noise."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from slam.front_end.pulse import ModulePulse, PulseModel
from slam.imaging.range_profiles import ProfileFilter, StaticPart, baseband_profiles

Array = NDArray[np.float64]

C_MPS = 299_792_458.0
BIN_M = C_MPS / (2 * 23.328e9)
CARRIER_HZ = 7.29e9
WAVE_NUMBER = 4 * math.pi * CARRIER_HZ / C_MPS
# -10 dB at half of 1.4 GHz: exp(-(2 pi 0.7e9 s)**2) = 0.1, and c / 2 metres of range per second
SIGMA_M = math.sqrt(math.log(10)) / (2 * math.pi * 0.7e9) * C_MPS / 2
START_M, N_BINS = 0.2, 400


def rf_echo(range_m: float, phase_rad: float = 0.0, n_bins: int = N_BINS) -> Array:
    x = START_M + BIN_M * np.arange(n_bins) - range_m
    return np.asarray(np.exp(-0.5 * (x / SIGMA_M) ** 2) * np.cos(WAVE_NUMBER * x + phase_rad))


def make_filter(taps: Array | None = None, n_bins: int = N_BINS) -> ProfileFilter:
    return ProfileFilter(ModulePulse(model=PulseModel(), error=0.1, equaliser=taps), n_bins, BIN_M)


def envelope(offsets_m: Array) -> Array:
    """Return the echo behind the filter by quadrature over wave numbers around the carrier."""
    kappa = np.linspace(-8, 8, 4001) / SIGMA_M
    p = np.exp(-0.5 * (kappa * SIGMA_M) ** 2)
    shape = p * p**1.94 / (p**2 + 0.01)
    waves = np.cos(kappa[None, :] * offsets_m[:, None])
    return np.asarray((waves * shape).sum(axis=1) / shape.sum())


def test_the_profile_of_an_echo_is_the_integral_over_its_filtered_spectrum() -> None:
    range_m = START_M + 150.3 * BIN_M
    profiles = make_filter().apply(rf_echo(range_m, 0.7)[None], START_M)
    expected = envelope(profiles.ranges_m - range_m) * np.exp(1j * (0.7 - WAVE_NUMBER * range_m))
    # 1e-3: what the echo's spectrum at negative frequencies and the cut at 6 sigma leave
    np.testing.assert_allclose(profiles.values[0], expected, atol=1e-3)


def test_an_echo_stays_nearly_as_short_as_its_pulse() -> None:
    values = np.abs(make_filter().apply(rf_echo(1.5)[None], START_M).values[0])
    fine = np.interp(np.arange(0, N_BINS, 0.01), np.arange(N_BINS), values)
    width_m = 0.01 * BIN_M * np.count_nonzero(fine > fine.max() * math.exp(-0.5))
    # The matched filter alone would make it sqrt(2) times as long.
    assert width_m / 2 < 1.1 * SIGMA_M


def test_an_equaliser_acts_on_the_samples_before_the_filter() -> None:
    taps = np.array([0.3, 1.0, -0.2])
    samples = rf_echo(1.5, 0.3)
    behind = np.convolve(samples, taps, mode="same")
    expected = make_filter().apply(behind[None], START_M).values
    np.testing.assert_allclose(
        make_filter(taps).apply(samples[None], START_M).values, expected, atol=1e-6
    )


def test_what_an_equaliser_moves_beyond_the_last_bin_does_not_come_back_at_the_first() -> None:
    taps, n_bins = np.zeros(301), 340
    taps[-1] = 1.0  # 150 bins later
    last = rf_echo(START_M + (n_bins - 1) * BIN_M, n_bins=n_bins)
    values = make_filter(taps, n_bins).apply(last[None], START_M).values
    np.testing.assert_allclose(values[0, :100], 0.0, atol=1e-4)


def test_filtering_is_linear() -> None:
    one, other = rf_echo(0.9), rf_echo(1.4, 1.0)
    first, second, both = (
        make_filter().apply(np.array([one, other, 2 * one + other]), START_M).values
    )
    np.testing.assert_allclose(both, 2 * first + second, atol=1e-6)


def test_profiles_times_range_make_a_falling_echo_level() -> None:
    ranges_m = np.array([0.8, 1.6])
    rows = np.array([rf_echo(r) / r**1.5 for r in ranges_m])
    levelled = make_filter().apply(rows, START_M).times_range(1.5).values
    peaks = np.abs(levelled).max(axis=1)
    # Beside the peak the law rises by 1.5 / r: the maximum is 1 + (1.5 s / r)**2 / 2 at most.
    assert peaks == pytest.approx([1, 1], rel=0.006)


def test_baseband_frames_give_the_profiles_of_rf_frames() -> None:
    range_m, step = 1.43, 8
    x = START_M + BIN_M * step * np.arange(50) - range_m
    # Downconverted from its first sample on: exp(j k (r - R)) exp(-j k (r - r_0))
    samples = np.exp(-0.5 * (x / SIGMA_M) ** 2) * np.exp(1j * WAVE_NUMBER * (START_M - range_m))
    profiles = baseband_profiles(
        samples[None], START_M, step * BIN_M, carrier_hz=CARRIER_HZ, sigma_m=SIGMA_M
    )
    assert profiles.bin_length_m <= SIGMA_M / 3
    offsets_m = profiles.ranges_m - range_m
    # Relative to one fixed phase, that of r_0; 0.5 % is what the band of eight bins cuts off
    turned = profiles.values[0] * np.exp(-1j * WAVE_NUMBER * START_M)
    expected = np.exp(-0.5 * (offsets_m / SIGMA_M) ** 2) * np.exp(-1j * WAVE_NUMBER * range_m)
    np.testing.assert_allclose(turned, expected, atol=5e-3)


class TestStaticPart:
    def test_a_robot_that_stands_adds_nothing(self) -> None:
        static = StaticPart()
        for _ in range(50):
            static.add(np.array([1.0, 9.0]), np.zeros(2))
        for step in range(1, 10):
            static.add(np.array([1.0, -1.0]), np.array([0.01 * step, 0.0]))
        assert static.samples is not None
        np.testing.assert_allclose(static.samples, [1.0, 0.0], atol=1e-12)

    def test_the_mean_keeps_what_all_frames_have_in_common(self) -> None:
        rng = np.random.default_rng(3)
        leakage, static = rng.normal(size=20), StaticPart()
        for step in range(300):
            static.add(leakage + rng.normal(size=20), np.array([0.0, 0.02 * step, 0.0]))
        assert static.samples is not None
        assert np.abs(static.samples - leakage).max() < 5 / math.sqrt(300)

    def test_behind_its_memory_it_follows_what_changes(self) -> None:
        static = StaticPart(memory=20)
        for step in range(400):
            level = 0.0 if step < 200 else 1.0
            static.add(np.full(3, level), np.array([step, 0.0]))
        assert static.samples is not None
        # 200 frames of 1: what is left of 0 is (1 - 1/20)**200
        np.testing.assert_allclose(static.samples, 1 - (1 - 1 / 20) ** 200, rtol=1e-9)

    def test_a_complex_frame_stays_complex(self) -> None:
        static = StaticPart()
        static.add(np.array([3.0, 1 + 2j]), np.zeros(2))
        assert static.samples is not None
        np.testing.assert_array_equal(static.samples, [3, 1 + 2j])

    def test_a_wall_beside_the_legs_of_a_square_fades_no_more_than_the_turns_between_them(
        self,
    ) -> None:
        # The wall's echo is the same on every leg; turns are few, but take most of the headings.
        static, leakage, wall = StaticPart(), np.array([1.0, 0.0]), np.array([0.0, 1.0])
        rng, place = np.random.default_rng(5), 0
        for corner in range(4):
            legs = [(corner * math.pi / 2 + 0.05, leakage + wall)] * 200
            angles = corner * math.pi / 2 + np.arange(0.1, 1.6, 0.1)
            turns = [(angle, leakage + wall * rng.normal(0.0, 0.1)) for angle in angles]
            for heading, samples in legs + turns:
                place += 1
                static.add(samples, np.array([0.01 * place, 0.0]), heading)
        assert static.samples is not None
        np.testing.assert_allclose(static.samples, leakage, atol=0.1)
        one_heading = StaticPart(memory=10_000)
        for step in range(800):
            one_heading.add(leakage + wall, np.array([0.01 * step, 0.0]))
        assert one_heading.samples is not None
        np.testing.assert_allclose(one_heading.samples, leakage + wall)

    def test_headings_count_modulo_a_turn(self) -> None:
        static = StaticPart()
        for step, heading in enumerate((-0.05, math.tau - 0.05, 3 * math.tau - 0.05, 0.05)):
            static.add(np.array([float(step)]), np.array([step, 0.0]), heading)
        assert static.samples is not None
        np.testing.assert_allclose(static.samples, [(1.0 + 3.0) / 2])

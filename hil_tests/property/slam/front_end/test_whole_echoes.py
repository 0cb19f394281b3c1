"""The joint fit in closed form against its definitions and against the fit sample by sample."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from slam.front_end.matched_filter import BINS_PER_STEP, PulseFilter
from slam.front_end.overlapping import (
    Correlation,
    EchoFit,
    KnownPulse,
    SplitTest,
    _Fit,
    fit_echoes,
    fit_whole_echoes,
)
from slam.front_end.pulse import PulseModel

Array = NDArray[np.float64]

BIN_M = 299_792_458 / (2 * 23.328e9)
MODEL = PulseModel()
SIGMA = MODEL.sigma_bins(BIN_M)
CARRIER = MODEL.carrier_rad(BIN_M)
N_BINS = 240
FIRST, LAST = 90.0, 150.0
FILTER = PulseFilter(MODEL, N_BINS, BIN_M, false_alarms=0.1, noise_is_told=True)
MARGIN = round(1.5 * SIGMA)


@st.composite
def clusters(draw: st.DrawFn) -> tuple[Array, Array, Array]:
    """Draw one to four echoes at least 1.3 envelope sigmas apart: positions, amplitudes, phases."""
    n = draw(st.integers(1, 4))
    gaps = draw(st.lists(st.floats(1.3, 2.0), min_size=n, max_size=n))
    positions = 92.0 + SIGMA * np.cumsum([0.0, *gaps[1:]]) + draw(st.floats(0, 3))
    amplitudes = draw(st.lists(st.floats(0.5, 2.0), min_size=n, max_size=n))
    phases = draw(st.lists(st.floats(-math.pi, math.pi), min_size=n, max_size=n))
    return positions, np.array(amplitudes), np.array(phases)


def signal(positions: Array, amplitudes: Array, phases: Array) -> Array:
    x = np.arange(N_BINS) - positions[:, np.newaxis]
    pulses = np.exp(-0.5 * (x / SIGMA) ** 2) * np.cos(CARRIER * x + phases[:, np.newaxis])
    total: Array = amplitudes @ pulses
    return total


def correlation(samples: Array, noise_sigma: float) -> Correlation:
    n = BINS_PER_STEP * np.arange(N_BINS // BINS_PER_STEP)
    return Correlation(
        FILTER.apply(samples) * np.exp(-1j * CARRIER * n),
        step_bins=BINS_PER_STEP,
        sigma_bins=SIGMA,
        sigma_y=FILTER.noise_gain * noise_sigma,
    )


def phase(fit: EchoFit) -> float:
    return fit.phase_rad + CARRIER * fit.position_bins


@settings(max_examples=30)
@given(clusters())
def test_echoes_without_noise_are_recovered(cluster: tuple[Array, Array, Array]) -> None:
    fits = fit_whole_echoes(
        correlation(signal(*cluster), 1e-3), FIRST, LAST, SplitTest(model_error=0.0)
    )
    positions, amplitudes, phases = cluster
    assert len(fits) == len(positions)
    for fit, position in zip(fits, positions, strict=True):
        # far less than the noise that the fit was told of, 1e-3, would move them
        assert abs(fit.position_bins - position) < 0.1 * fit.sigma_bins
    assert [fit.amplitude for fit in fits] == pytest.approx(amplitudes, rel=2e-4)
    turns = [
        math.remainder(phase(fit) - told, math.tau) for fit, told in zip(fits, phases, strict=True)
    ]
    assert np.abs(turns).max() < 2e-3


@settings(max_examples=40)
@given(clusters(), st.floats(1e-3, 0.1), st.integers(0, 2**32 - 1))
def test_the_closed_form_finds_what_the_samples_tell(
    cluster: tuple[Array, Array, Array], sigma: float, seed: int
) -> None:
    samples = signal(*cluster) + sigma * np.random.default_rng(seed).standard_normal(N_BINS)
    known = fit_echoes(
        samples,
        pulse=KnownPulse(envelope_sigma_bins=SIGMA, carrier_rad_per_bin=CARRIER),
        noise_sigma=sigma,
        search_bins=(FIRST, LAST),
    )
    fits = fit_whole_echoes(correlation(samples, sigma), FIRST, LAST, SplitTest())
    assert len(fits) == len(known)
    for one, other in zip(fits, known, strict=True):
        assert abs(one.position_bins - other.position_bins) < 0.3 * other.sigma_bins
        assert one.sigma_bins == pytest.approx(other.sigma_bins, rel=0.1)
        assert one.amplitude == pytest.approx(other.amplitude, rel=0.1)


@settings(max_examples=30)
@given(clusters(), st.floats(-3, 3))
def test_gradient_and_information_are_derivatives_of_what_is_explained(
    cluster: tuple[Array, Array, Array], off: float
) -> None:
    data = correlation(signal(*cluster), 1e-3)
    positions = (cluster[0] + off * np.arange(1, len(cluster[0]) + 1) / 4).tolist()
    fit = _Fit(data, positions)
    for k in range(len(positions)):
        shifted = [
            [*positions[:k], positions[k] + step, *positions[k + 1 :]] for step in (-1e-4, 1e-4)
        ]
        below, above = (_Fit(data, each).explained for each in shifted)
        slope = (above - below) / 4e-4
        assert fit.gradient[k] == pytest.approx(slope, abs=1e-3 * fit.explained / SIGMA)
    np.testing.assert_allclose(fit.information, np.transpose(fit.information), rtol=1e-9)
    # at the truth nothing is left, so the Gauss-Newton matrix is minus half the Hessian
    true = cluster[0].tolist()
    at_truth = _Fit(data, true)
    for k in range(len(true)):
        climb = [
            _Fit(data, [*true[:k], true[k] + step, *true[k + 1 :]]).gradient[k]
            for step in (-1e-2, 1e-2)
        ]
        bend = (climb[0] - climb[1]) / 2e-2
        assert at_truth.information[k][k] == pytest.approx(bend, rel=2e-2)


def test_interval_too_short_for_two_gives_one() -> None:
    samples = signal(np.array([118.0, 124.0]), np.array([1.0, 1.0]), np.array([0.0, 2.0]))
    fits = fit_whole_echoes(correlation(samples, 1e-3), 120.0, 122.0, SplitTest())
    assert len(fits) == 1
    assert 120.0 <= fits[0].position_bins <= 122.0


def test_nothing_gives_one_echo_of_nothing() -> None:
    (fit,) = fit_whole_echoes(correlation(np.zeros(N_BINS), 1e-3), FIRST, LAST, SplitTest())
    assert fit.amplitude == 0.0
    assert math.isinf(fit.sigma_bins)

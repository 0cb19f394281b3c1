"""Laws of the joint fit of close echoes, by windows and by whole frames."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hil_tests.property.examples import examples
from slam.front_end import kernels
from slam.front_end.kernels import (
    CLIMB,
    COLUMNS,
    INFORMATION,
    MAX_ECHOES,
    ROWS,
    U,
)
from slam.front_end.matched_filter import PulseFilter
from slam.front_end.overlapping import (
    _TAYLOR,
    EchoFit,
    KnownPulse,
    SplitTest,
    fit_echoes,
    fit_whole_echoes,
    split_threshold,
)
from slam.front_end.pulse import ModulePulse, PulseModel

Array = NDArray[np.float64]

# 1.4 GHz at -10 dB and 7.29 GHz, sampled at 23.328 GHz
SIGMA = math.sqrt(math.log(10)) / (math.pi * 1.4e9) * 23.328e9
CARRIER = math.tau * 7.29 / 23.328
PULSE = KnownPulse(envelope_sigma_bins=SIGMA, carrier_rad_per_bin=CARRIER)
EXACT = SplitTest(model_error=0.0)
BIN_M = 299_792_458 / (2 * 23.328e9)
N_BINS = 110


def signal(
    positions: Array, amplitudes: Array, phases: Array, *, n_bins: int = N_BINS, wide: float = 1.0
) -> Array:
    """Return sums of pulses, shape (..., n_bins), from echoes of shape (..., k)."""
    x = np.arange(n_bins) - positions[..., np.newaxis]
    envelope = amplitudes[..., np.newaxis] * np.exp(-0.5 * (x / (wide * SIGMA)) ** 2)
    total: Array = (envelope * np.cos(CARRIER * x + phases[..., np.newaxis])).sum(axis=-2)
    return total


@st.composite
def clusters(draw: st.DrawFn) -> tuple[Array, Array, Array]:
    """Draw one to four echoes at least 1.3 envelope sigmas apart: positions, amplitudes, phases."""
    n = draw(st.integers(1, 4))
    gaps = draw(st.lists(st.floats(1.3, 2.2), min_size=n, max_size=n))
    positions = SIGMA * (2.0 + np.cumsum(gaps)) + draw(st.floats(0, 1))
    amplitudes = draw(st.lists(st.floats(0.5, 2.0), min_size=n, max_size=n))
    phases = draw(st.lists(st.floats(-math.pi, math.pi), min_size=n, max_size=n))
    return positions, np.array(amplitudes), np.array(phases)


def fit_exactly(samples: Array) -> tuple[EchoFit, ...]:
    return fit_echoes(samples, pulse=PULSE, noise_sigma=1e-6, split=EXACT)


def turn(one: float, other: float) -> float:
    return abs(math.remainder(one - other, math.tau))


@settings(max_examples=examples(25))
@given(clusters())
def test_echoes_without_noise_are_recovered(cluster: tuple[Array, Array, Array]) -> None:
    positions, amplitudes, phases = cluster
    fits = fit_exactly(signal(*cluster))
    assert [fit.position_bins for fit in fits] == pytest.approx(positions, abs=1e-5)
    assert [fit.amplitude for fit in fits] == pytest.approx(amplitudes, rel=1e-5)
    assert max(turn(f.phase_rad, p) for f, p in zip(fits, phases, strict=True)) < 1e-4


@settings(max_examples=examples(12))
@given(clusters(), st.integers(1, 20), st.integers(0, 2**32 - 1))
def test_whole_bins_of_delay_shift_the_echoes_and_nothing_else(
    cluster: tuple[Array, Array, Array], shift: int, seed: int
) -> None:
    samples = signal(*cluster) + 0.03 * np.random.default_rng(seed).standard_normal(N_BINS)
    usable = np.arange(N_BINS + shift) < N_BINS
    early = np.concatenate([samples, np.zeros(shift)])
    fits = [
        fit_echoes(
            np.roll(early, by),
            pulse=PULSE,
            noise_sigma=0.03,
            usable=np.roll(usable, by),
            search_bins=(12 + by, N_BINS - 13 + by),
        )
        for by in (0, shift)
    ]
    assert len(fits[0]) == len(fits[1])
    for before, after in zip(*fits, strict=True):
        # the search starts from another grid, and ends a hundredth of a sigma from the optimum
        assert after.position_bins - shift == pytest.approx(
            before.position_bins, abs=0.05 * before.sigma_bins
        )
        assert after.amplitude == pytest.approx(before.amplitude, rel=1e-2)
        assert turn(after.phase_rad, before.phase_rad) < 0.05


@settings(max_examples=examples(12))
@given(clusters(), st.floats(1e-4, 1e4), st.integers(0, 2**32 - 1))
def test_amplitudes_scale_with_the_samples_and_positions_do_not(
    cluster: tuple[Array, Array, Array], scale: float, seed: int
) -> None:
    samples = signal(*cluster) + 0.03 * np.random.default_rng(seed).standard_normal(N_BINS)
    plain = fit_echoes(samples, pulse=PULSE, noise_sigma=0.03)
    scaled = fit_echoes(scale * samples, pulse=PULSE, noise_sigma=scale * 0.03)
    assert [f.position_bins for f in scaled] == pytest.approx([f.position_bins for f in plain])
    assert [f.sigma_bins for f in scaled] == pytest.approx([f.sigma_bins for f in plain])
    assert [f.amplitude / scale for f in scaled] == pytest.approx([f.amplitude for f in plain])


@settings(max_examples=examples(12))
@given(clusters(), st.floats(-math.pi, math.pi))
def test_a_common_phase_turns_every_echo_and_moves_none(
    cluster: tuple[Array, Array, Array], phase: float
) -> None:
    positions, amplitudes, phases = cluster
    plain = fit_exactly(signal(*cluster))
    turned = fit_exactly(signal(positions, amplitudes, phases + phase))
    for before, after in zip(plain, turned, strict=True):
        assert after.position_bins == pytest.approx(before.position_bins, abs=1e-5)
        assert turn(after.phase_rad - before.phase_rad, phase) < 1e-4


@settings(max_examples=examples(25))
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from(["nothing", "flat", "noise", "one bin", "step", "tone", "huge", "tiny"]),
    st.integers(1, 4),
    st.sampled_from([0.0, 0.3, 0.97, 1.0]),
)
def test_whatever_the_samples_no_nan_and_no_more_echoes_than_asked(
    seed: int, kind: str, max_echoes: int, lost: float
) -> None:
    rng = np.random.default_rng(seed)
    samples = {
        "nothing": np.zeros(N_BINS),
        "flat": np.ones(N_BINS),
        "noise": rng.standard_normal(N_BINS),
        "one bin": (np.arange(N_BINS) == 40) * 1.0,
        "step": np.sign(np.arange(N_BINS) - 55.0),
        "tone": np.cos(CARRIER * np.arange(N_BINS)),
        "huge": 1e12 * rng.standard_normal(N_BINS),
        "tiny": 1e-12 * rng.standard_normal(N_BINS),
    }[kind]
    fits = fit_echoes(
        samples,
        pulse=PULSE,
        noise_sigma=0.01,
        usable=rng.random(N_BINS) >= lost,
        split=SplitTest(max_echoes=max_echoes, model_error=0.0),
    )
    assert 1 <= len(fits) <= max_echoes
    for fit in fits:
        assert 0 <= fit.position_bins <= N_BINS - 1
        assert fit.sigma_bins > 0  # false for NaN
        assert all(map(math.isfinite, (fit.amplitude, fit.phase_rad)))
    positions = [fit.position_bins for fit in fits]
    assert positions == sorted(positions)


@settings(max_examples=examples(12))
@given(clusters(), st.floats(1e-3, 0.03))
def test_sigma_is_the_bound_of_the_whole_fisher_matrix(
    cluster: tuple[Array, Array, Array], noise_sigma: float
) -> None:
    """The oracle differentiates the signal numerically in all 3 K parameters."""
    n = len(cluster[0])
    values = np.concatenate(cluster)
    step = 1e-5
    jacobian = np.stack(
        [
            (signal(*np.split(values + bump, 3)) - signal(*np.split(values - bump, 3))) / (2 * step)
            for bump in step * np.eye(3 * n)
        ]
    )
    bound = noise_sigma * np.sqrt(np.diag(np.linalg.inv(jacobian @ jacobian.T)))[:n]
    fits = fit_echoes(signal(*cluster), pulse=PULSE, noise_sigma=noise_sigma, split=EXACT)
    assume(len(fits) == n)  # near the resolution limit noise this strong may hide one
    assert [fit.sigma_bins for fit in fits] == pytest.approx(bound, rel=1e-3)


def singles(n: int, snr: float, *, wide: float = 1.0, seed: int = 0) -> Array:
    """Return windows of one echo of amplitude 1, each with another place, phase and noise."""
    rng = np.random.default_rng(seed)
    at = 30 + rng.uniform(0, 1, (n, 1))
    windows = signal(at, np.ones((n, 1)), rng.uniform(0, math.tau, (n, 1)), n_bins=62, wide=wide)
    return windows + rng.standard_normal(windows.shape) / snr


def split_share(windows: Array, snr: float, split: SplitTest) -> float:
    fits = [fit_echoes(each, pulse=PULSE, noise_sigma=1 / snr, split=split) for each in windows]
    return float(np.mean([len(fit) > 1 for fit in fits]))


@pytest.mark.parametrize("snr", [16.0, pytest.param(64.0, marks=pytest.mark.rare)])
def test_noise_splits_a_single_echo_as_rarely_as_stated(snr: float) -> None:
    often = SplitTest(model_error=0.0, false_split=0.05)
    # 1000 trials; the stated probability is an upper bound that the search nearly reaches
    assert 0.005 < split_share(singles(1000, snr), snr, often) < 0.05 + 3 * math.sqrt(0.05 / 1000)
    assert split_share(singles(1000, snr), snr, SplitTest()) <= 0.01


@pytest.mark.parametrize("wide", [0.9, 1.1])
@pytest.mark.parametrize("snr", [30.0, 250.0])
def test_a_pulse_ten_percent_too_wide_or_narrow_stays_one_echo(wide: float, snr: float) -> None:
    windows = singles(300, snr, wide=wide)
    assert split_share(windows, snr, SplitTest()) <= 0.01
    assert split_share(windows, snr, SplitTest(model_error=0.0)) > 0.5


def test_two_equal_echoes_ten_centimetres_apart_are_told_apart() -> None:
    rng = np.random.default_rng(5)
    n, apart = 1000, 0.1 / BIN_M
    at = 30 + rng.uniform(0, 1, (n, 1)) + apart * np.array([0.0, 1.0])
    windows = signal(at, np.full((n, 2), 0.015), rng.uniform(0, math.tau, (n, 2)), n_bins=78)
    windows += 5e-4 * rng.standard_normal(windows.shape)
    fits = [fit_echoes(each, pulse=PULSE, noise_sigma=5e-4) for each in windows]
    resolved = [
        len(fit) == 2
        and max(abs(f.position_bins - u) for f, u in zip(fit, true, strict=True)) * BIN_M <= 0.02
        for fit, true in zip(fits, at, strict=True)
    ]
    assert np.mean(resolved) >= 0.99  # the bar is 0.9
    pulls = [
        (f.position_bins - u) / f.sigma_bins
        for fit, true, good in zip(fits, at, resolved, strict=True)
        if good
        for f, u in zip(fit, true, strict=True)
    ]
    assert np.std(pulls) == pytest.approx(1.0, abs=0.1)


def test_clipped_samples_are_left_out() -> None:
    whole = signal(np.array([40.0, 56.0]), np.array([4.0, 1.0]), np.array([0.3, 2.0]))
    clipped = np.clip(whole, -1.0, 1.0)
    fits = fit_echoes(clipped, pulse=PULSE, noise_sigma=1e-6, usable=np.abs(whole) < 1, split=EXACT)
    assert [fit.position_bins for fit in fits] == pytest.approx([40, 56], abs=1e-4)
    assert [fit.amplitude for fit in fits] == pytest.approx([4, 1], rel=1e-4)


def test_threshold_bounds_what_noise_reaches() -> None:
    """Oracle: the maximum of white complex noise behind the pulse's matched filter, finely."""
    rng = np.random.default_rng(1)
    length, step = 4.0, 0.05  # in sigmas
    x = np.arange(-4.0, length + 4.0, step)
    grid = np.arange(0.0, length, step)
    kernel = np.exp(-0.5 * (grid[:, np.newaxis] - x) ** 2)
    kernel /= np.sqrt((kernel**2).sum(axis=1, keepdims=True))
    noise = rng.standard_normal((2, 4000, len(x)))
    highest = ((noise @ kernel.T) ** 2).sum(axis=0).max(axis=1)
    for probability in (0.1, 0.01):
        exceeded = float(np.mean(highest > split_threshold(probability, length)))
        band = 3 * math.sqrt(probability / 4000)
        assert 0.7 * probability - band <= exceeded <= probability + band


MODEL = PulseModel()
MODEL_SIGMA = MODEL.sigma_bins(BIN_M)
MODEL_CARRIER = MODEL.carrier_rad(BIN_M)
N_WHOLE = 240
FIRST, LAST = 90.0, 150.0
FILTER = PulseFilter(
    ModulePulse(model=MODEL, error=0.0), N_WHOLE, BIN_M, false_alarms=0.1, noise_is_known=True
)


@st.composite
def whole_clusters(draw: st.DrawFn) -> tuple[Array, Array, Array]:
    """Draw one to four echoes at least 1.3 envelope sigmas apart: positions, amplitudes, phases."""
    n = draw(st.integers(1, 4))
    gaps = draw(st.lists(st.floats(1.3, 2.0), min_size=n, max_size=n))
    positions = 92.0 + MODEL_SIGMA * np.cumsum([0.0, *gaps[1:]]) + draw(st.floats(0, 3))
    amplitudes = draw(st.lists(st.floats(0.5, 2.0), min_size=n, max_size=n))
    phases = draw(st.lists(st.floats(-math.pi, math.pi), min_size=n, max_size=n))
    return positions, np.array(amplitudes), np.array(phases)


def whole_signal(positions: Array, amplitudes: Array, phases: Array) -> Array:
    x = np.arange(N_WHOLE) - positions[:, np.newaxis]
    pulses = np.exp(-0.5 * (x / MODEL_SIGMA) ** 2) * np.cos(
        MODEL_CARRIER * x + phases[:, np.newaxis]
    )
    total: Array = amplitudes @ pulses
    return total


def fit_whole(
    samples: Array,
    noise_sigma: float,
    split: SplitTest,
    limits: tuple[float, float] = (FIRST, LAST),
) -> list[EchoFit]:
    table = fit_whole_echoes(
        FILTER.apply(samples),
        limits,
        others=np.empty((0, COLUMNS)),
        pulse=KnownPulse(envelope_sigma_bins=MODEL_SIGMA, carrier_rad_per_bin=MODEL_CARRIER),
        sigma_y=FILTER.noise_gain * noise_sigma,
        split=split,
    )
    return [EchoFit(*row) for row in table[:, :4].tolist()]


@settings(max_examples=examples(30))
@given(whole_clusters())
def test_whole_echoes_without_noise_are_recovered(cluster: tuple[Array, Array, Array]) -> None:
    fits = fit_whole(whole_signal(*cluster), 1e-3, SplitTest(model_error=0.0))
    positions, amplitudes, phases = cluster
    assert len(fits) == len(positions)
    for fit, position in zip(fits, positions, strict=True):
        # far less than the noise that the fit was told of, 1e-3, would move them
        assert abs(fit.position_bins - position) < 0.1 * fit.sigma_bins
    assert [fit.amplitude for fit in fits] == pytest.approx(amplitudes, rel=2e-4)
    turns = [turn(fit.phase_rad, phase) for fit, phase in zip(fits, phases, strict=True)]
    assert max(turns) < 2e-3


@settings(max_examples=examples(40))
@given(whole_clusters(), st.floats(1e-3, 0.1), st.integers(0, 2**32 - 1))
def test_the_closed_form_finds_what_the_samples_tell(
    cluster: tuple[Array, Array, Array], sigma: float, seed: int
) -> None:
    samples = whole_signal(*cluster) + sigma * np.random.default_rng(seed).standard_normal(N_WHOLE)
    known = fit_echoes(
        samples,
        pulse=KnownPulse(envelope_sigma_bins=MODEL_SIGMA, carrier_rad_per_bin=MODEL_CARRIER),
        noise_sigma=sigma,
        search_bins=(FIRST, LAST),
    )
    fits = fit_whole(samples, sigma, SplitTest())
    assert len(fits) == len(known)
    for one, other in zip(fits, known, strict=True):
        assert abs(one.position_bins - other.position_bins) < 0.3 * other.sigma_bins
        assert one.sigma_bins == pytest.approx(other.sigma_bins, rel=0.1)
        assert one.amplitude == pytest.approx(other.amplitude, rel=0.1)


def evaluated(data: kernels.ComplexArray, positions: list[float]) -> tuple[float, Array, Array]:
    """Return what echoes at some positions explain, its gradient, and the information."""
    state, n = np.zeros((ROWS, MAX_ECHOES)), len(positions)
    state[U, :n] = positions
    explained = kernels.evaluate(data, MODEL_SIGMA, state, n)
    return explained, state[CLIMB, :n], state[INFORMATION : INFORMATION + n, :n]


def polynomials(samples: Array) -> kernels.ComplexArray:
    """Return z of a whole frame of samples as the kernels take it."""
    y = FILTER.apply(samples)
    around = np.empty((y.size - 8, 9), dtype=np.complex128)
    no_others = np.empty((0, COLUMNS))
    kernels.interpolate(
        y, no_others, 0, MODEL_SIGMA, MODEL_CARRIER, _TAYLOR, np.empty_like(y), around
    )
    return around


def window(samples: Array) -> kernels.ComplexArray:
    """Return a window of samples as the kernels take it, a fifth of it unknown."""
    turned = np.exp(1j * MODEL_CARRIER * np.arange(N_WHOLE))
    columns: kernels.ComplexArray = np.stack([samples + 0j, turned], axis=1)
    columns[100:105] = 0.0
    return columns


@settings(max_examples=examples(30))
@given(whole_clusters(), st.floats(-3, 3))
@pytest.mark.parametrize("of", [polynomials, window])
def test_gradient_and_information_are_derivatives_of_what_is_explained(
    of: Callable[[Array], kernels.ComplexArray], cluster: tuple[Array, Array, Array], off: float
) -> None:
    data = of(whole_signal(*cluster))
    positions = (cluster[0] + off * np.arange(1, len(cluster[0]) + 1) / 4).tolist()
    explained, gradient, information = evaluated(data, positions)
    for k in range(len(positions)):
        shifted = [
            [*positions[:k], positions[k] + step, *positions[k + 1 :]] for step in (-1e-4, 1e-4)
        ]
        below, above = (evaluated(data, each)[0] for each in shifted)
        slope = (above - below) / 4e-4
        assert gradient[k] == pytest.approx(slope, abs=1e-3 * explained / MODEL_SIGMA)
    np.testing.assert_allclose(information, information.T, rtol=1e-9)
    # at the truth nothing is left, so the Gauss-Newton matrix is minus half the Hessian
    true = cluster[0].tolist()
    at_truth = evaluated(data, true)[2]
    for k in range(len(true)):
        climb = [
            evaluated(data, [*true[:k], true[k] + step, *true[k + 1 :]])[1][k]
            for step in (-1e-2, 1e-2)
        ]
        bend = (climb[0] - climb[1]) / 2e-2
        assert at_truth[k][k] == pytest.approx(bend, rel=2e-2)


def test_interval_too_short_for_two_gives_one() -> None:
    samples = whole_signal(np.array([118.0, 124.0]), np.array([1.0, 1.0]), np.array([0.0, 2.0]))
    fits = fit_whole(samples, 1e-3, SplitTest(), (120.0, 122.0))
    assert len(fits) == 1
    assert 120.0 <= fits[0].position_bins <= 122.0


def test_nothing_gives_one_echo_of_nothing() -> None:
    (fit,) = fit_whole(np.zeros(N_WHOLE), 1e-3, SplitTest())
    assert fit.amplitude == 0.0
    assert math.isinf(fit.sigma_bins)

"""The front ends and the study `limits` against what statistics allows."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.special import eval_genlaguerre
from scipy.stats import ncx2

from hil_tests.paths import study
from hil_tests.property.examples import examples
from hil_tests.unit.slam.simulation import BIN_LENGTH_M as BIN_M
from hil_tests.unit.slam.simulation import frame_of
from slam.config import SlamConfig, load_preset, override
from slam.frames import RadarFrame, StepInputError
from slam.front_end import make_detector
from slam.front_end.matched_filter import _MEDIAN_EFFICIENCY

Array = NDArray[np.float64]

limits = study("limits")

TRIALS = 2000
AMPLITUDE, NOISE_SIGMA = 0.015, 5e-4
N_BINS, START_M = 1431, 0.2
# 1.4 GHz at -10 dB and 7.29 GHz, sampled at 23.328 GHz
S = math.sqrt(math.log(10)) / (math.pi * 1.4e9) * 23.328e9
CARRIER = math.tau * 7.29 / 23.328
# Several trials share a frame, 20 envelope sigmas apart: that much do they cost less.
PLACES_M = 0.9 + 1.05 * np.arange(8)
REACH_M = 0.4


def frames_of(
    true_m: Array, amplitude: float, rng: np.random.Generator, *, wide: float = 1.0
) -> list[RadarFrame]:
    """Return noisy frames of echoes of random phase; true metres, shape (n, k)."""
    samples = NOISE_SIGMA * rng.standard_normal((len(true_m), N_BINS))
    for row, position in zip(samples, (true_m - START_M) / BIN_M, strict=True):
        x = np.arange(N_BINS) - position[:, np.newaxis]
        turn = rng.uniform(0, math.tau, (len(position), 1))
        pulses = amplitude * np.exp(-0.5 * (x / (wide * S)) ** 2) * np.cos(CARRIER * x + turn)
        row += pulses.sum(axis=0)
    return [
        frame_of(row, t_ns=200_000_000 * counter, counter=counter)
        for counter, row in enumerate(samples.astype(np.float32))
    ]


def detect(
    frames: list[RadarFrame], front_end: str, *, rate: float = 1e-3, told_sigma: float = 0.0
) -> list[Array]:
    config = override(
        SlamConfig(),
        {
            "detection.front_end": front_end,
            "detection.min_range_m": 0.0,
            "detection.max_range_m": 20.0,
            "matched_filter.false_alarms_per_frame": rate,
            "matched_filter.noise_sigma": told_sigma,
        },
    )
    found = make_detector(config).detect_many(frames, [0.0] * len(frames))
    return [np.array([detection.range_m for detection in each]) for each in found]


def places(rng: np.random.Generator, trials: int = TRIALS) -> Array:
    """Return a range per trial anywhere between bins, shape (frames, trials per frame)."""
    shape = trials // len(PLACES_M), len(PLACES_M)
    return PLACES_M + rng.uniform(-0.1, 0.1, shape)


def by_trial(found: list[Array]) -> list[Array]:
    """Return the detected ranges around each place of each frame, in the order of `places`."""
    return [each[np.abs(each - place) < REACH_M] for each in found for place in PLACES_M]


def share_error(share: float) -> float:
    return math.sqrt(share * (1 - share) / TRIALS)


@pytest.mark.parametrize("wide", [0.9, 1.0, 1.1])
@pytest.mark.parametrize("front_end", ["matched_filter", "joint"])
def test_one_echo_is_ranged_at_the_cramer_rao_bound(front_end: str, wide: float) -> None:
    """Bound with amplitude and phase unknown, 2 sigma / A sqrt(s / sqrt(pi)), in bins.

    A pulse ten percent too narrow or wide is still one echo, without bias, near its own bound.
    """
    rng = np.random.default_rng(6)
    true_m = places(rng)
    found = by_trial(detect(frames_of(true_m, AMPLITUDE, rng, wide=wide), front_end))
    assert np.mean([len(each) == 1 for each in found]) >= 0.99
    errors = np.array(
        [each[np.abs(each - r).argmin()] - r for each, r in zip(found, true_m.flat, strict=True)]
    )
    bound_m = 2 * NOISE_SIGMA / AMPLITUDE * math.sqrt(wide * S / math.sqrt(math.pi)) * BIN_M
    # 2000 trials tell a standard deviation to 1.6 %, and none is less than the bound
    assert 0.95 * bound_m <= errors.std(ddof=1) <= 1.1 * bound_m
    assert abs(errors.mean()) < 1e-4


@pytest.mark.parametrize("amplitude", [0.01, 0.02, 0.05])
@pytest.mark.parametrize("wide", [0.9, 1.0, 1.05, 1.1])
def test_a_pulse_ten_percent_off_explains_an_echo_however_strong(
    wide: float, amplitude: float
) -> None:
    """Behind the filter the relative error of a width 10 % off is 3.4 % near the peak."""
    rng = np.random.default_rng(7)
    frames = frames_of(places(rng, 400), amplitude, rng, wide=wide)
    config = override(SlamConfig(), {"detection.front_end": "joint", "detection.max_range_m": 20.0})
    found = make_detector(config).detect_many(frames, [0.0] * len(frames))
    misfits = np.array([echo.misfit for each in found for echo in each])
    assert len(misfits) == pytest.approx(400, rel=0.01)
    assert np.mean(misfits < 1.5) >= 0.9


def test_one_pulse_fitted_to_two_echoes_has_a_misfit() -> None:
    """They are 8 cm apart, 1.5 sigmas; at some phases one pulse does explain both."""
    rng = np.random.default_rng(8)
    first_m = places(rng, 80)
    frames = frames_of(np.hstack([first_m, first_m + 0.08]), 0.02, rng)
    config = override(
        SlamConfig(), {"detection.front_end": "matched_filter", "detection.max_range_m": 20.0}
    )
    found = make_detector(config).detect_many(frames, [0.0] * len(frames))
    misfits = np.array([echo.misfit for each in found for echo in each])
    assert np.median(misfits) > 1.5


def test_the_deviation_grows_by_what_a_wrong_pulse_of_a_neighbour_leaves() -> None:
    """Two echoes 4.3 sigmas apart, one 20 times as strong: 5 % of its height at the other count."""
    row = np.zeros(N_BINS)
    x = np.arange(N_BINS)
    for range_m, amplitude in ((0.9, 0.005), (1.12, 0.1)):
        at = (range_m - START_M) / BIN_M
        row += amplitude * np.exp(-0.5 * ((x - at) / S) ** 2) * np.cos(CARRIER * (x - at))
    row += 1e-4 * np.random.default_rng(9).standard_normal(N_BINS)
    config = override(
        SlamConfig(), {"detection.front_end": "joint", "matched_filter.noise_sigma": 1e-4}
    )
    weak, _ = make_detector(config).detect(frame_of(row.astype(np.float32)))
    rho = math.exp(-0.25 * (0.22 / (S * BIN_M)) ** 2)
    sigma_y = 1e-4 * math.sqrt(2 / (S * math.sqrt(math.pi)))
    bound_m = math.sqrt(2) * S * BIN_M * sigma_y / 0.005
    expected = math.hypot(1.0, 0.05 * 0.1 * rho / sigma_y)
    assert expected > 1.5
    assert weak.sigma_m == pytest.approx(bound_m * expected, rel=0.02)


def test_two_equal_echoes_ten_centimetres_apart_are_resolved() -> None:
    rng = np.random.default_rng(2)
    first_m = places(rng, 600)  # a share of 0.9 to 1.2 %
    frames = frames_of(np.hstack([first_m, first_m + 0.1]), AMPLITUDE, rng)

    def resolved(front_end: str) -> float:
        found = by_trial(detect(frames, front_end))
        good = [
            len(each) == 2 and bool(np.all(np.abs(each - [r, r + 0.1]) <= 0.02))
            for each, r in zip(found, first_m.flat, strict=True)
        ]
        return float(np.mean(good))

    assert resolved("joint") >= 0.9
    # what the joint fit is for: maxima of the filter's output do not tell them apart
    assert resolved("matched_filter") < 0.5


@pytest.mark.parametrize("rate", [0.01, 0.1])
def test_noise_alone_is_taken_for_echoes_as_often_as_configured(rate: float) -> None:
    frames = frames_of(np.empty((TRIALS, 0)), 0.0, np.random.default_rng(3))
    # rare upcrossings come independently: a frame is without one with probability exp(-rate)
    expected = 1 - math.exp(-rate)
    band = 3 * share_error(expected)

    def alarms(told_sigma: float) -> float:
        found = detect(frames, "matched_filter", rate=rate, told_sigma=told_sigma)
        return float(np.mean([len(each) > 0 for each in found]))

    assert alarms(NOISE_SIGMA) == pytest.approx(expected, abs=band)
    # the threshold allows for the scatter of a sigma that is estimated from the frame
    assert alarms(0.0) == pytest.approx(expected, abs=band)


@pytest.mark.parametrize("snr_db", [3.0, 5.0, 7.0])
def test_an_echo_is_found_as_often_as_marcum_says(snr_db: float) -> None:
    """Marcum's Q holds at the echo's own place; the best one nearby adds a degree of freedom."""
    rng = np.random.default_rng(4)
    snr, rate = 10 ** (snr_db / 20), 1e-2
    true_m = places(rng)
    frames = frames_of(true_m, snr * NOISE_SIGMA, rng)
    found = by_trial(detect(frames, "matched_filter", rate=rate, told_sigma=NOISE_SIGMA))
    hits = [
        bool(np.any(np.abs(each - r) <= 0.1)) for each, r in zip(found, true_m.flat, strict=True)
    ]
    r = 4.0
    for _ in range(50):  # Rice: N / (2 sqrt(pi) s) r exp(-r**2 / 2) = rate
        r = math.sqrt(2 * math.log(N_BINS / (2 * math.sqrt(math.pi) * S) * r / rate))
    noncentrality = snr**2 * S * math.sqrt(math.pi) / 2
    marcum, nearby = (float(ncx2.sf(r**2, freedom, noncentrality)) for freedom in (2, 3))
    low, high = marcum - 3 * share_error(marcum), nearby + 3 * share_error(nearby)
    assert low <= np.mean(hits) <= high


KNOWN_SIGMA, KNOWN_CARRIER = limits.SIGMA_BINS, limits.CARRIER_RAD
MIDDLE = 60


def echoes(values: Array) -> Array:
    """Return the samples of echoes; positions, amplitudes, phases one after the other."""
    position, amplitude, phase = values.reshape(3, -1, 1)
    x = np.arange(3 * MIDDLE) - position
    pulses = amplitude * np.exp(-0.5 * (x / KNOWN_SIGMA) ** 2) * np.cos(KNOWN_CARRIER * x + phase)
    total: Array = pulses.sum(axis=0)
    return total


@settings(max_examples=examples(30))
@given(st.floats(0.5, 4.0), st.floats(0.2, 1.0), st.floats(0.0, math.tau), st.floats(0.0, math.tau))
def test_pair_bound_is_that_of_the_whole_fisher_matrix(
    apart: float, ratio: float, one: float, other: float
) -> None:
    values = np.array([MIDDLE, MIDDLE + apart * KNOWN_SIGMA, 1.0, ratio, one, other])
    step = 1e-5
    jacobian = np.stack(
        [
            (echoes(values + bump) - echoes(values - bump)) / (2 * step)
            for bump in step * np.eye(values.size)
        ]
    )
    snr = 30.0
    whole = np.linalg.inv(snr**2 * jacobian @ jacobian.T)[:2, :2]
    turn = other - one - KNOWN_CARRIER * apart * KNOWN_SIGMA
    bound = limits.pair_covariance(
        np.array([apart * KNOWN_SIGMA]),
        ratio,
        np.array([turn]),
        snr=snr,
        envelope_sigma=KNOWN_SIGMA,
    )[0]
    # the closed form takes cosine and sine of the carrier as orthogonal
    assert np.diag(bound) == pytest.approx(np.diag(whole), rel=0.02)


def test_marcum_is_what_a_correlation_with_the_pulse_exceeds() -> None:
    rng = np.random.default_rng(1)
    n, snr, threshold = 20_000, 1.8, 4.5
    cosine, sine = (echoes(np.array([MIDDLE, 1.0, phase])) for phase in (0.0, -math.pi / 2))
    norm = math.sqrt(KNOWN_SIGMA * math.sqrt(math.pi) / 2)
    samples = snr * cosine + rng.standard_normal((n, cosine.size))
    height = np.hypot(samples @ cosine, samples @ sine) / norm
    expected = float(limits.detection_probability(np.array(snr), threshold, KNOWN_SIGMA))
    assert 0.2 < expected < 0.8
    error = math.sqrt(expected * (1 - expected) / n)
    assert np.mean(height > threshold) == pytest.approx(expected, abs=4 * error)


def test_what_counts_as_found_and_as_resolved() -> None:
    true_m = np.array([1.0, 1.0, 1.0, 1.0])
    found = [np.array([1.002]), np.array([0.998, 2.0]), np.array([]), np.array([1.2])]
    np.testing.assert_allclose(limits.errors_m(found, true_m), [0.002, -0.002, math.nan, math.nan])

    pairs = np.tile([1.0, 1.1], (4, 1))
    split = [
        np.array([1.01, 1.09]),
        np.array([1.0, 1.13]),
        np.array([1.0]),
        np.array([1.0, 1.1, 1.2]),
    ]
    assert limits.resolved(split, pairs) == 25.0


def test_the_scatter_of_the_estimated_noise_is_that_of_a_median_of_correlated_powers() -> None:
    """Powers of complex noise that correlate by q have joint density sum q**k L_k L_k exp exp.

    So do the indicators of being above the median m = ln 2, with coefficients
    c_k = int_m^inf L_k(p) exp(-p) dp = m exp(-m) L^1_(k-1)(m) / k, and a median varies by the sum
    of their covariances over the squared density there, 1/2.
    """
    spacing = 0.75  # of the cells that are looked at, in envelope sigmas
    median = math.log(2)
    k = np.arange(1, 2001)
    c = median * math.exp(-median) * eval_genlaguerre(k - 1, 1, median) / k
    lags = spacing * np.arange(-30, 31)
    covariances = np.sum(c**2 @ np.exp(-0.5 * np.outer(k, lags**2)))
    covariances += 0.25 - np.sum(c**2)  # higher orders: lag 0 alone
    cells = 4 * covariances / median**2  # relative variance of the estimate, times their number
    mean = math.sqrt(math.tau) / spacing  # the same of a mean of powers
    assert mean / cells == pytest.approx(_MEDIAN_EFFICIENCY, abs=2e-3)


@pytest.mark.parametrize(
    ("preset", "n_bins"),
    [("paper", 1), ("paper", 14), ("robust", 0), ("robust", 1), ("robust", 30)],
)
def test_a_frame_that_is_too_short_is_refused(preset: str, n_bins: int) -> None:
    frame = RadarFrame(
        radar=0,
        t_ns=0,
        counter=1,
        samples=np.full(n_bins, 1e-3, dtype=np.float32),
        range_start_m=0.2,
        bin_length_m=BIN_M,
    )
    with pytest.raises(StepInputError, match=f"a frame of {n_bins} bins is shorter than"):
        make_detector(load_preset(preset)).detect(frame)

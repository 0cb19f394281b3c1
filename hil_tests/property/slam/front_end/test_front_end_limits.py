"""The front ends against what statistics allows; frames and bounds are closed forms of our own."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import ncx2

from slam.config import SlamConfig, override
from slam.frames import RadarFrame
from slam.front_end import make_detector

Array = NDArray[np.float64]

TRIALS = 2000
AMPLITUDE, NOISE_SIGMA = 0.015, 5e-4
N_BINS, START_M = 1431, 0.2
BIN_M = 299_792_458 / (2 * 23.328e9)
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
        RadarFrame(
            radar=0,
            t_ns=200_000_000 * counter,
            counter=counter,
            samples=row,
            range_start_m=START_M,
            bin_length_m=BIN_M,
        )
        for counter, row in enumerate(samples.astype(np.float32))
    ]


def detect(
    frames: list[RadarFrame], front_end: str, *, rate: float = 1e-3, told_sigma: float = 0.0
) -> list[Array]:
    """Return the detected ranges of each frame."""
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
    """Return the standard error of a share of the trials."""
    return math.sqrt(share * (1 - share) / TRIALS)


@pytest.mark.parametrize("front_end", ["matched_filter", "joint"])
def test_one_echo_is_ranged_at_the_cramer_rao_bound(front_end: str) -> None:
    """Bound with amplitude and phase unknown: 2 sigma / A sqrt(s / sqrt(pi)), in bins."""
    rng = np.random.default_rng(1)
    true_m = places(rng)
    found = by_trial(detect(frames_of(true_m, AMPLITUDE, rng), front_end))
    assert all(len(each) > 0 for each in found)
    errors = np.array(
        [each[np.abs(each - r).argmin()] - r for each, r in zip(found, true_m.flat, strict=True)]
    )
    bound_m = 2 * NOISE_SIGMA / AMPLITUDE * math.sqrt(S / math.sqrt(math.pi)) * BIN_M
    # 2000 trials tell a standard deviation to 1.6 %, and none is less than the bound
    assert 0.95 * bound_m <= errors.std(ddof=1) <= 1.1 * bound_m
    assert abs(errors.mean()) < 1e-4
    assert np.mean([len(each) == 1 for each in found]) >= 0.99


@pytest.mark.parametrize("wide", [0.9, 1.1])
@pytest.mark.parametrize("front_end", ["matched_filter", "joint"])
def test_a_pulse_that_is_not_quite_ours_costs_little(front_end: str, wide: float) -> None:
    """Ten percent too narrow or wide: still one echo, without bias, near its own bound."""
    rng = np.random.default_rng(6)
    true_m = places(rng)
    found = by_trial(detect(frames_of(true_m, AMPLITUDE, rng, wide=wide), front_end))
    assert np.mean([len(each) == 1 for each in found]) >= 0.99
    errors = np.array(
        [each[np.abs(each - r).argmin()] - r for each, r in zip(found, true_m.flat, strict=True)]
    )
    bound_m = 2 * NOISE_SIGMA / AMPLITUDE * math.sqrt(wide * S / math.sqrt(math.pi)) * BIN_M
    assert 0.95 * bound_m <= errors.std(ddof=1) <= 1.1 * bound_m
    assert abs(errors.mean()) < 1e-4


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

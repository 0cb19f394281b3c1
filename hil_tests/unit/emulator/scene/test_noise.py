"""Noise is Gaussian as far as its page says, and a function of (seed, stream, counter) alone."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from emulator.scene.philox import (
    LARGEST_UNITS,
    MAX_SAMPLES,
    UNITS_PER_SIGMA,
    frame_noise_units,
    standard_normals,
)

SEED = 20230507


def normals(n_frames: int, *, stream: int = 1, seed: int = SEED) -> NDArray[np.float64]:
    counters = np.arange(n_frames, dtype=np.int64)
    units = frame_noise_units(counters, MAX_SAMPLES, seed=seed, stream=stream)
    x: NDArray[np.float64] = units / UNITS_PER_SIGMA
    return x


def test_philox_is_the_published_one() -> None:
    # Known-answer test of Random123 for philox4x64-10, key 0 and counter 0; NumPy increments the
    # counter before it draws, hence all ones.
    words = np.random.Philox(key=0, counter=2**256 - 1).random_raw(4)
    expected = [0x16554D9ECA36314C, 0xDB20FE9D672D0FDC, 0xD7E772CEE186176B, 0x7E68B68AEC7BA23B]
    assert [int(word) for word in words] == expected


def test_first_values_follow_from_the_published_bits() -> None:
    # Worked by hand from the module's words: quantile of two half-words, 1536 apart.
    words = np.random.Philox(key=np.array([5, 9], np.uint64), counter=0).random_raw(768)
    halves = [(int(words[i // 4]) >> (16 * (i % 4))) & 0xFFFF for i in range(3072)]
    values = [
        stats.norm.ppf((halves[n] + 0.5) / 65536) + stats.norm.ppf((halves[1536 + n] + 0.5) / 65536)
        for n in range(100)
    ]
    units = frame_noise_units(np.array([0]), 100, seed=5, stream=9)
    np.testing.assert_allclose(units[0] / 2**20, values, atol=1.01 / 2**20)


def test_moments_are_those_of_the_normal_distribution() -> None:
    x = normals(400).ravel()
    n = x.size
    assert abs(x.mean()) < 4 / np.sqrt(n)
    assert abs(x.var() - 1) < 4 * np.sqrt(2 / n)
    assert abs(stats.skew(x)) < 4 * np.sqrt(6 / n)
    assert abs(stats.kurtosis(x) + 3.8e-4) < 4 * np.sqrt(24 / n)


def test_distribution_is_normal() -> None:
    # Kolmogorov-Smirnov on a fixed seed: a wrong shape by 1 % would give p < 1e-6.
    assert stats.kstest(normals(100).ravel(), "norm").pvalue > 0.01


@pytest.mark.parametrize(("sigmas", "share"), [(3, 0.9995), (4, 0.984), (5, 0.833)])
def test_tails_are_as_stated(sigmas: float, share: float) -> None:
    # Exact: convolve the quantile table with itself, in place of waiting for rare events.
    entries = np.sort(stats.norm.ppf((np.arange(65536) + 0.5) / 65536)) * 2**20 / UNITS_PER_SIGMA
    above = 65536 - np.searchsorted(entries, sigmas - entries, side="right")
    assert above.sum() / 65536**2 / stats.norm.sf(sigmas) == pytest.approx(share, abs=1e-3)
    assert pytest.approx(6.116, abs=1e-3) == LARGEST_UNITS / UNITS_PER_SIGMA


@pytest.mark.parametrize("lag", [1, 2, 3, 4, 8, 1535])
def test_samples_are_uncorrelated(lag: int) -> None:
    x = normals(200)
    products = x[:, :-lag] * x[:, lag:]
    assert abs(products.mean()) < 4 / np.sqrt(products.size)


def test_frames_streams_and_seeds_are_uncorrelated() -> None:
    x = normals(200)
    for other in (normals(201)[1:], normals(200, stream=2), normals(200, seed=SEED + 1)):
        assert abs((x * other).mean()) < 4 / np.sqrt(x.size)


@pytest.mark.parametrize("order", [[7, 8, 9, 12], [9, 7, 12, 8], [8], [2**32 - 1, 0, 8, 8], []])
def test_a_frame_depends_on_its_counter_alone(order: list[int]) -> None:
    block = frame_noise_units(np.array(order, dtype=np.int64), 300, seed=3, stream=4)
    for row, counter in enumerate(order):
        alone = frame_noise_units(np.array([counter]), 300, seed=3, stream=4)[0]
        np.testing.assert_array_equal(block[row], alone)
    assert block.shape == (len(order), 300)


def test_a_shorter_frame_is_the_start_of_a_longer_one() -> None:
    long = frame_noise_units(np.array([5]), 1431, seed=0, stream=0)
    short = frame_noise_units(np.array([5]), 40, seed=0, stream=0)
    np.testing.assert_array_equal(short, long[:, :40])


def test_standard_normals_continue_over_frames() -> None:
    x = standard_normals(2 * MAX_SAMPLES + 7, seed=1, stream=2)
    assert x.shape == (2 * MAX_SAMPLES + 7,)
    np.testing.assert_array_equal(x[:9], standard_normals(9, seed=1, stream=2))


@pytest.mark.parametrize(
    ("counter", "n_samples", "seed", "words"),
    [
        (0, 1537, 0, "longest frame"),
        (-1, 8, 0, "negative"),
        (0, 8, -1, "seed -1"),
        (0, 8, 2**64, "0 ... 2"),
    ],
)
def test_impossible_requests_are_refused(
    counter: int, n_samples: int, seed: int, words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        frame_noise_units(np.array([counter]), n_samples, seed=seed, stream=0)

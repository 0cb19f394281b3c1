"""Reproducible random numbers: fixed maps of Philox bits to integers, uniforms and Gaussian noise.

NumPy guarantees the bit stream of Philox but not how its generators turn bits into normals, and
their transcendental functions may differ in the last bit between processors. So the map is ours
and integer: a 16 bit half-word selects the midpoint quantile ``ndtri((k + 1/2) / 2**16)``, rounded
to 2**-20; one normal is the sum of two such entries. The sum is what makes the tails: they hold
98 % of a true normal's probability beyond 4 sigma, 83 % beyond 5, and end at
``LARGEST_UNITS / UNITS_PER_SIGMA`` = 6.1 sigma; the excess kurtosis is -4e-4.

A stream is keyed by (seed, stream number). Frame ``k`` owns the k-th block of a stream, so its
noise depends neither on how many frames are asked for at once nor on their order. The streams of a
module or a target are numbered by `stream_of`.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import IntEnum
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from xethru_protocol.wire.x4 import FRAME_SAMPLES

MAX_SAMPLES = FRAME_SAMPLES

_TABLE_BITS = 16
_QUANTILES = (np.arange(1 << _TABLE_BITS) + 0.5) / (1 << _TABLE_BITS)
_TABLE: NDArray[np.int32] = np.rint(ndtri(_QUANTILES) * 2.0**20).astype(np.int32)
# Integer sum of squares: exact, so the scale is the same on every machine.
_TABLE_VARIANCE = int((_TABLE.astype(np.int64) ** 2).sum()) / (1 << _TABLE_BITS)

UNITS_PER_SIGMA = (2 * _TABLE_VARIANCE) ** 0.5
"""Standard deviation of a noise value in its integer units."""
LARGEST_UNITS = 2 * int(_TABLE[-1])
"""Largest magnitude a noise value can take, in its integer units."""

WORDS_PER_BLOCK = 4
"""64 bit words of one block of Philox."""
# Two 16 bit words per sample.
_WORDS_PER_FRAME = 2 * MAX_SAMPLES * _TABLE_BITS // 64
_BLOCKS_PER_FRAME = _WORDS_PER_FRAME // WORDS_PER_BLOCK

_FRAMES_AT_ONCE = 16  # their bits stay in the processor's cache

_UNIFORMS_PER_NORMAL = 12  # their sum has variance 1


class Purpose(IntEnum):
    """What the random streams of a module or a target are for."""

    RECEIVER_NOISE = 0
    JITTER_WHITE = 1
    JITTER_SLOW = 2
    CLUTTER = 3
    STAMPS = 4
    BURSTS = 5
    SCINTILLATION = 6
    PERSON = 7
    JITTER_AMPLITUDE = 8
    WANDER = 4096  # not 7: published results hold these streams


def stream_of(serial: int, purpose: Purpose, part: int = 0) -> int:
    """Return the number of a stream; ``part``, 0 ... 255, numbers those of one purpose.

    ``serial`` is a module's serial number, a target's place in its scene, from 0, or a number below
    2**40 made of a person's name: what belongs to a target or a person is the same for all radars.

    >>> stream_of(202305070101, Purpose.RECEIVER_NOISE)
    202305070101
    """
    # twelve decimal digits take 40 bits; bit 63 is the odometry's
    return purpose << 48 | part << 40 | serial


def frame_noise_units(
    indices: NDArray[np.int64], n_samples: int, *, seed: int, stream: int
) -> NDArray[np.int32]:
    """Return white Gaussian noise of frames, each selected by its index alone.

    Parameters
    ----------
    indices
        Shape (n,), int64, each >= 0, in any order.
    n_samples
        Values per frame, at most ``MAX_SAMPLES``.
    seed, stream
        Key of the stream, each 0 ... 2**64 - 1.

    Returns
    -------
    Shape (n, n_samples), int32, mean 0, standard deviation ``UNITS_PER_SIGMA``.
    """
    if n_samples > MAX_SAMPLES:
        raise ValueError(f"{n_samples} samples: the longest frame has {MAX_SAMPLES}")
    noise = np.empty((len(indices), n_samples), dtype=np.int32)
    second = np.empty((min(len(indices), _FRAMES_AT_ONCE), n_samples), dtype=np.int32)
    for start, stop in _runs(indices):
        philox = _philox(seed, stream, int(indices[start]) * _BLOCKS_PER_FRAME)
        for first in range(start, stop, _FRAMES_AT_ONCE):
            rows = noise[first : min(first + _FRAMES_AT_ONCE, stop)]
            halves = _half_words(philox.random_raw(len(rows) * _WORDS_PER_FRAME))
            halves = halves.reshape(len(rows), 2, MAX_SAMPLES)
            np.take(_TABLE, halves[:, 0, :n_samples], out=rows, mode="clip")
            rows += np.take(_TABLE, halves[:, 1, :n_samples], out=second[: len(rows)], mode="clip")
    return noise


def standard_normals(count: int, *, seed: int, stream: int) -> NDArray[np.float64]:
    """Return the first ``count`` normals of a stream: shape (count,), mean 0, variance 1."""
    n_frames = -(-count // MAX_SAMPLES)
    units = frame_noise_units(
        np.arange(n_frames, dtype=np.int64), MAX_SAMPLES, seed=seed, stream=stream
    )
    normals: NDArray[np.float64] = units.ravel()[:count] / UNITS_PER_SIGMA
    return normals


def counter_normals(counters: NDArray[np.int64], *, seed: int, stream: int) -> NDArray[np.float64]:
    """Return one normal for each counter: shape (n,), mean 0, variance 1.

    ``counters`` is as ``indices`` in `frame_noise_units`; each selects its normal alone.
    """
    units = np.empty(len(counters), dtype=np.int32)
    for start, stop in _runs(counters):
        words = _philox(seed, stream, int(counters[start])).random_raw(
            WORDS_PER_BLOCK * (stop - start)
        )
        halves = _half_words(words).reshape(stop - start, -1)
        units[start:stop] = _TABLE[halves[:, 0]] + _TABLE[halves[:, 1]]
    normals: NDArray[np.float64] = units / UNITS_PER_SIGMA
    return normals


def uniforms(count: int, *, seed: int, stream: int, block: int = 0) -> NDArray[np.float64]:
    """Return numbers in [0, 1), shape (count,): those of a stream from a block on.

    A number takes one of the `WORDS_PER_BLOCK` words of a block.
    """
    words: NDArray[np.uint64] = _philox(seed, stream, block).random_raw(count)
    return (words >> np.uint64(11)).astype(np.float64) * 2.0**-53


def _runs(counters: NDArray[np.int64]) -> Iterator[tuple[int, int]]:
    """Yield start and end of each run of counters that follow each other."""
    breaks = np.flatnonzero(np.diff(counters) != 1) + 1
    for start, stop in pairwise([0, *breaks.tolist(), len(counters)]):
        if start < stop:
            yield start, stop


def _philox(seed: int, stream: int, counter: int = 0) -> np.random.Philox:
    largest = (1 << 64) - 1
    if not (0 <= seed <= largest and 0 <= stream <= largest):
        raise ValueError(f"seed {seed} and stream {stream} must each lie in 0 ... 2**64 - 1")
    if counter < 0:
        raise ValueError("frame indices must not be negative")
    return np.random.Philox(key=np.array([seed, stream], dtype=np.uint64), counter=counter)


def _half_words(words: NDArray[np.uint64]) -> NDArray[np.uint16]:
    """Split 64 bit words into 16 bit ones, lowest first on any machine."""
    return words.astype("<u8", copy=False).view("<u2")


class Rng:
    """One stream of random numbers."""

    def __init__(self, seed: int, stream: int = 0) -> None:
        self._bits = _philox(seed, stream)
        self._walked = 0.0

    def below(self, count: int) -> int:
        """Return a whole number 0 ... count - 1; ``count`` is at least 1."""
        return int(self._bits.random_raw()) % count

    def uniform(self) -> float:
        """Return a number in [0, 1)."""
        return (int(self._bits.random_raw()) >> 11) * 2.0**-53

    def chance(self, probability: float) -> bool:
        return self.uniform() < probability

    def normal(self) -> float:
        """Return a nearly normal number, mean 0, standard deviation 1, within +-6."""
        return sum(self.uniform() for _ in range(_UNIFORMS_PER_NORMAL)) - _UNIFORMS_PER_NORMAL / 2

    def walk(self, sigma: float) -> float:
        """Take a normal step of a random walk that began at 0; return where it is now."""
        self._walked += sigma * self.normal()
        return self._walked

    def data(self, count: int) -> bytes:
        return bytes(self.below(256) for _ in range(count))

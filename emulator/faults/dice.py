"""Reproducible chance: Philox bits and fixed maps of them, as `emulator.noise` has for frames.

NumPy guarantees the bits of Philox on every machine, not what its generators make of them.
"""

from __future__ import annotations

import numpy as np

__all__ = ["Dice"]

_UNIFORMS_PER_NORMAL = 12  # their sum has variance 1


class Dice:
    """One stream of random numbers.

    Parameters
    ----------
    seed, stream
        Key of the stream, each 0 ... 2**64 - 1.
    """

    def __init__(self, seed: int, stream: int = 0) -> None:
        self._bits = np.random.Philox(key=np.array([seed, stream], dtype=np.uint64))
        self._walked = 0.0

    def below(self, count: int) -> int:
        """Return a whole number 0 ... count - 1; ``count`` is at least 1."""
        return int(self._bits.random_raw()) % count

    def uniform(self) -> float:
        """Return a number in [0, 1)."""
        return (int(self._bits.random_raw()) >> 11) * 2.0**-53

    def chance(self, probability: float) -> bool:
        """Return True with a probability."""
        return self.uniform() < probability

    def normal(self) -> float:
        """Return a nearly normal number, mean 0, standard deviation 1, within +-6."""
        return sum(self.uniform() for _ in range(_UNIFORMS_PER_NORMAL)) - _UNIFORMS_PER_NORMAL / 2

    def walk(self, sigma: float) -> float:
        """Take a normal step of a random walk that began at 0; return where it is now."""
        self._walked += sigma * self.normal()
        return self._walked

    def data(self, count: int) -> bytes:
        """Return random bytes."""
        return bytes(self.below(256) for _ in range(count))

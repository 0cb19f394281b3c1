"""A module's own clock: when it truly takes the frame that it believes to take at a given time.

Its frame timer and its sampler run from one crystal (protocol reference 9.1). A clock that is
``ppm`` millionths fast counts 1 + ppm 1e-6 of its seconds in a true one, so what it takes for an
interval T is over after ``T / (1 + ppm 1e-6)``: its frames come early, and its bins are short.
The error is constant: temperature and ageing are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["ModuleClock"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ModuleClock:
    """Nominal time of a counter to scene time, and back.

    Attributes
    ----------
    skew_ns
        Scene time at which the module takes the frame of nominal time 0.
    ppm
        How fast its clock is, in millionths; negative: slow.

    >>> ModuleClock(skew_ns=5, ppm=100.0).scene_time_ns(10_001_000_000)
    10000000005
    """

    skew_ns: int = 0
    ppm: float = 0.0

    @property
    def rate(self) -> float:
        """Return the module's seconds per true second."""
        return 1.0 + self.ppm * 1e-6

    def scene_times_ns(self, nominal_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the true times of frames, shape (n,), int64, from the module's own."""
        early = np.rint(nominal_ns * self._lead).astype(np.int64)
        times: NDArray[np.int64] = nominal_ns - early + self.skew_ns
        return times

    def scene_time_ns(self, nominal_ns: int) -> int:
        """Return the true time of one frame: `scene_times_ns` of a single number."""
        return nominal_ns - round(nominal_ns * self._lead) + self.skew_ns

    def nominal_ns(self, scene_time_ns: int) -> int:
        """Return what the module's clock shows at a scene time, to within 1 ns."""
        elapsed_ns = scene_time_ns - self.skew_ns
        return elapsed_ns + round(elapsed_ns * (self.ppm * 1e-6))

    @property
    def _lead(self) -> float:
        """By how much a frame comes early, of its nominal time; a difference keeps 0 ppm exact."""
        return self.ppm * 1e-6 / self.rate

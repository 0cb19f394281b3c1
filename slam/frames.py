"""The narrow door into SLAM: one radar frame in true metres, stamped in session time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RadarFrame:
    """One raw RF frame of one radar, with everything a front end needs to turn bins into metres.

    Attributes
    ----------
    radar
        Index of the radar's mount in the rig.
    t_ns
        Session time at which this radar really took the frame, int64 nanoseconds; radars are not
        synchronised, so those of one scan differ.
    counter
        Frame counter of the module; gaps show lost frames.
    samples
        shape (n_bins,), float32, signed normalised RF amplitude.
    range_start_m
        Range label of sample 0 in *true* metres (light at 299 792 458 m/s), before the mount's
        own ``range_offset_m`` is removed.
    bin_length_m
        Spacing of the samples in true metres.
    limits
        Smallest and largest value the module's sampler can give, normalised RF amplitude; a
        sample at one of them was cut off there. None where nobody knows.
    """

    radar: int
    t_ns: int
    counter: int
    samples: NDArray[np.float32]
    range_start_m: float
    bin_length_m: float
    limits: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        """Refuse anything that is not one real-valued frame."""
        if self.samples.ndim != 1 or self.samples.dtype != np.float32:
            raise ValueError(
                f"a radar frame is one row of float32 samples, not shape {self.samples.shape} "
                f"of {self.samples.dtype}; raw RF mode (no downconversion) gives that"
            )
        if not self.bin_length_m > 0:
            raise ValueError(f"bin_length_m is {self.bin_length_m}, must be positive")

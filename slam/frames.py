"""What every front end does: raw frames in, the ranges of their echoes out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slam.geometry import Rig

# A sampler's limit is reached when this part of its span is missing: it comes as float32.
_LIMIT_TOLERANCE = 1e-6


class StepInputError(ValueError):
    """A pipeline was given something that it cannot be stepped with; it stays as it was."""


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
        Shape (n_bins,), float32, signed normalised RF amplitude.
    range_start_m, bin_length_m
        Range label of sample 0, before the mount's own ``range_offset_m`` is removed, and spacing
        of the samples: *true* metres (light at 299 792 458 m/s).
    limits
        Smallest and largest value the module's sampler can give; a sample at one of them was cut
        off there. None if unknown.
    stream
        Counters follow on each other within a stream only; a new one begins wherever the module's
        counter may have begun anew.
    """

    radar: int
    t_ns: int
    counter: int
    samples: NDArray[np.float32]
    range_start_m: float
    bin_length_m: float
    limits: tuple[float, float] | None = None
    stream: int = 0

    def __post_init__(self) -> None:
        if self.samples.ndim != 1 or self.samples.dtype != np.float32:
            raise ValueError(
                f"a radar frame is one row of float32 samples, not shape {self.samples.shape} "
                f"of {self.samples.dtype}; raw RF mode (no downconversion) gives that"
            )
        if self.radar < 0 or not (
            math.isfinite(self.range_start_m) and 0 < self.bin_length_m < math.inf
        ):
            raise ValueError(
                f"radar {self.radar}, range_start_m {self.range_start_m}, bin_length_m "
                f"{self.bin_length_m}: the first must be the index of a mount, the others finite, "
                "the last positive"
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Detection:
    """One echo seen by one radar: a range without a direction."""

    radar: int  # index of the mount
    t_ns: int  # session time of the frame
    range_m: float  # true metres from the antenna, the mount's range offset removed
    # Normalised RF units: of the pulse, or of the smoothed peak under the paper's front end
    amplitude: float
    # Carrier phase of the echo at ``range_m``, in [-pi, pi]; NaN where the front end has none
    phase_rad: float = math.nan
    # Predicted standard deviation of ``range_m``; NaN where the front end predicts none
    sigma_m: float = math.nan
    # Energy near the peak that the fitted pulse leaves over what noise would leave: about 1 for one
    # pulse alone; NaN where the front end fits none
    misfit: float = math.nan
    saturated: bool = False  # whether samples of the echo lay at a limit of the module's sampler

    def __post_init__(self) -> None:
        is_possible = self.radar >= 0 and math.isfinite(self.range_m)
        if not is_possible or self.sigma_m <= 0 or self.misfit < 0:
            raise ValueError(
                f"radar {self.radar}, range_m {self.range_m}, sigma_m {self.sigma_m}, misfit "
                f"{self.misfit}: the first must be the index of a mount, the second finite, the "
                "others positive, or NaN where they are not known"
            )


class Detector(Protocol):
    """A front end; frames of one radar are given in the order of their counters."""

    def detect(self, frame: RadarFrame, range_offset_m: float = 0.0) -> tuple[Detection, ...]:
        """Return the echoes of one frame inside the range limits, nearest first.

        The limits are those of `DetectionConfig`: what SLAM expects there and is not given counts
        as missed.

        ``range_offset_m`` is what this module measures too long (``Mount.range_offset_m``).
        """
        ...

    def detect_many(
        self, frames: Sequence[RadarFrame], offsets_m: Sequence[float]
    ) -> list[tuple[Detection, ...]]:
        """Return what ``detect`` returns, for each frame, of any radar, with its range offset."""
        ...


def detect_all(detector: Detector, frames: Sequence[RadarFrame], rig: Rig) -> tuple[Detection, ...]:
    offsets_m = [rig.mounts[frame.radar].range_offset_m for frame in frames]
    found = detector.detect_many(frames, offsets_m)
    for frame, detections in zip(frames, found, strict=True):
        for each in detections:
            if (each.radar, each.t_ns) != (frame.radar, frame.t_ns):
                raise StepInputError(
                    f"the front end found a range of radar {each.radar} at {each.t_ns} ns in the "
                    f"frame of radar {frame.radar} at {frame.t_ns} ns"
                )
    return tuple(detection for of_frame in found for detection in of_frame)


def usable_samples(frame: RadarFrame) -> NDArray[np.bool_]:
    """Return which samples are known (not NaN) and inside the frame's limits, shape (n_bins,)."""
    usable: NDArray[np.bool_] = ~np.isnan(frame.samples)
    if frame.limits is not None:
        low, high = _inner_limits(frame.limits)
        usable &= (frame.samples > low) & (frame.samples < high)
    return usable


def reaches_limits(frame: RadarFrame, lowest: float, highest: float) -> bool:
    """Return whether a frame with these extreme samples is cut off at its limits."""
    if frame.limits is None:
        return False
    low, high = _inner_limits(frame.limits)
    return lowest <= low or highest >= high


def _inner_limits(limits: tuple[float, float]) -> tuple[float, float]:
    margin = _LIMIT_TOLERANCE * (limits[1] - limits[0])
    return limits[0] + margin, limits[1] - margin

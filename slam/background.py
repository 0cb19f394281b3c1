"""What moves with the radar: leakage, its ringing, the housing. Estimated and subtracted.

Per radar and sample a running mean of past frames, forgotten exponentially, is subtracted before
detection. It is taken over the signed RF samples: where the robot moves, an echo turns by a full
period of the carrier every 20.56 mm and averages out, while what is fixed to the radar stays.

Only the near zone is touched. A mean over the whole frame removes leakage as well, and with it any
wall that the robot drives along at constant range: it is as constant as leakage. Odometry cannot
tell the two apart either, except while the robot turns, so an estimate from turns only would be
missing until the first corner. Leakage is near and walls that are driven along are not; hence the
limit in range, below which an echo at constant range is lost.

The limit must lie beyond the last of the leakage, and an echo at constant range a pulse beyond the
limit. Measured, leakage 0.5 at 0.15 m with two echoes of ringing 6 cm apart and 12 dB down each, a
wall at 0.5 m beside the drive, false detections per frame from 0.2 to 1.5 m (clipped or not):

====================  ==================  ======================  ======================
limit                 paper               ``matched_filter``      ``joint``
====================  ==================  ======================  ======================
no filter             1 or 2              0                       3.4 or 4
0.35 m                1                   1                       2 or 3
0.45 m                0                   0                       0
0.6 m                 1, wall lost        1, wall lost            1, wall 11 mm off
====================  ==================  ======================  ======================

At 0.35 m the fade leaves leakage that looks like an echo. At 0.45 m such a wall moves by 1 to 3 mm,
one at 0.55 m by 0.3 mm at most, and one at 0.45 m is 6 to 13 mm off. There is nothing to gain where
leakage stays short of the range limits (0.06 or 0.5 at 0.05 m: 0 false detections under every front
end without the filter), nor for ``matched_filter``, which finds nothing false here without it.
Hence off by default.

It costs noise, sigma sqrt(1 + 1 / (2 memory - 1)) with the mean's own, the zone of each radar's
first frame, and echoes nearer than the limit while the robot stands still - of which the pipeline
takes no frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.config import LeakageConfig
from slam.detector import Detection, Detector, usable_samples
from slam.frames import RadarFrame

Array = NDArray[np.float64]

# The subtraction fades out over this length before its limit, about one pulse: a step would ring.
_FADE_M = 0.1


@dataclass(slots=True, kw_only=True)
class _Estimate:
    """Running mean of one radar, of the samples within the limit."""

    grid: tuple[float, float, int]  # start, spacing and number of the frame's bins
    share: Array  # of the mean that is subtracted, 1 near, 0 at the limit
    mean: Array
    count: Array  # frames that went into it


class LeakageRemover:
    """Subtracts from each radar's frames what stays the same in its near zone.

    Parameters
    ----------
    config
        How far the zone reaches and how long it remembers.
    """

    def __init__(self, config: LeakageConfig) -> None:
        self.config = config
        self._estimates: dict[int, _Estimate] = {}

    def remove(self, frame: RadarFrame) -> RadarFrame:
        """Return the frame without its leakage, and learn from it.

        Samples about which nothing is known become NaN: those at a limit of the sampler, and those
        of which no earlier frame told the mean. A frame on another grid of bins starts anew.
        """
        estimate = self._estimates.get(frame.radar)
        grid = (frame.range_start_m, frame.bin_length_m, frame.samples.size)
        if estimate is None or estimate.grid != grid:
            estimate = self._estimates[frame.radar] = self._start(grid)
        zone = slice(estimate.mean.size)
        raw = frame.samples[zone].astype(np.float64)
        known = usable_samples(frame)[zone]
        told = known & (estimate.count > 0)
        samples = frame.samples.copy()
        samples[zone] = np.where(told, raw - estimate.share * estimate.mean, np.nan)
        estimate.count += known
        gain = 1.0 / np.clip(estimate.count, 1.0, self.config.memory_frames)
        estimate.mean += np.where(known, gain * (raw - estimate.mean), 0.0)
        return replace(frame, samples=samples)

    def _start(self, grid: tuple[float, float, int]) -> _Estimate:
        start_m, bin_length_m, n_bins = grid
        short_of_m = self.config.max_range_m - start_m - bin_length_m * np.arange(n_bins)
        share = np.clip(short_of_m[short_of_m > 0] / _FADE_M, 0.0, 1.0)
        return _Estimate(
            grid=grid, share=share, mean=np.zeros(share.size), count=np.zeros(share.size)
        )


class LeakageFreeDetector:
    """A front end behind a :class:`LeakageRemover`; frames must come in the order of their time.

    Parameters
    ----------
    detector
        The front end.
    config
        Of the leakage filter.
    """

    def __init__(self, detector: Detector, config: LeakageConfig) -> None:
        self._detector = detector
        self._remover = LeakageRemover(config)

    def detect(self, frame: RadarFrame, range_offset_m: float = 0.0) -> tuple[Detection, ...]:
        """Return the echoes of one frame; see ``Detector``."""
        return self._detector.detect(self._remover.remove(frame), range_offset_m)

    def detect_many(
        self, frames: Sequence[RadarFrame], offsets_m: Sequence[float]
    ) -> list[tuple[Detection, ...]]:
        """Return the echoes of each frame; see ``Detector``."""
        return self._detector.detect_many([self._remover.remove(f) for f in frames], offsets_m)

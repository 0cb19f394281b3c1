"""Echoes over range, and which of them stand out of the noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Detections:
    """What stands out of a profile.

    Attributes
    ----------
    bins
        Shape (n_detections,): bins whose amplitude is above the threshold, ascending.
    threshold
        Shape (n_bins,), float64: amplitude that a bin must have.
    """

    bins: NDArray[np.intp]
    threshold: NDArray[np.float64]


def range_profile(iq: ArrayLike) -> NDArray[np.float64]:
    """Return the amplitude of each bin, shape (n_bins,): ``sqrt(mean_t |x[t, m]|**2)``.

    ``iq`` has the shape (n_frames, n_bins), or (n_bins,) for one frame; complex or RF.
    """
    power = np.abs(np.atleast_2d(np.asarray(iq))).astype(np.float64) ** 2
    return np.asarray(np.sqrt(power.mean(axis=0)), dtype=np.float64)


def cfar(
    profile: ArrayLike,
    *,
    false_alarm_rate: float = 1e-3,
    training_bins: int = 8,
    guard_bins: int = 2,
) -> Detections:
    """Return the bins that stand out of their neighbours at a constant false-alarm rate.

    Cell-averaging CFAR: the threshold on power is ``alpha`` times the mean power of the N training
    bins, ``alpha = N (P**(-1/N) - 1)``. P is the share of bins of noise alone that are found, if
    the noise is complex Gaussian, equal in these bins and new in each of them: its power in one
    frame, or one row of a range-Doppler map, is exponential. Of the mean over several frames, less
    than P are found. Finn and Johnson, "Adaptive detection mode with threshold control as a
    function of spatially sampled clutter-level estimates", RCA Review 29 (1968) 414; Richards,
    "Fundamentals of Radar Signal Processing", 2nd ed., section 6.5.

    Parameters
    ----------
    profile
        Shape (n_bins,): amplitudes, as of `range_profile`.
    false_alarm_rate
        P, between 0 and 1.
    training_bins
        On either side; at the ends of the profile those that there are, and N with them.
    guard_bins
        Between a bin and its training bins on either side, left out because the pulse reaches
        over them.

    Raises
    ------
    ValueError
        For a profile with bins without a single training bin, or an argument out of its range.
    """
    power = np.abs(np.asarray(profile, dtype=np.float64)) ** 2
    if not 0 < false_alarm_rate < 1:
        raise ValueError(f"false_alarm_rate {false_alarm_rate:g}: must be between 0 and 1")
    if training_bins < 1 or guard_bins < 0:
        raise ValueError(
            f"{training_bins} training_bins and {guard_bins} guard_bins: must be at least 1 and 0"
        )
    if power.ndim != 1 or len(power) < 2 * guard_bins + 2:
        raise ValueError(
            f"a profile of shape {power.shape}: it must have one dimension, and with "
            f"{guard_bins} guard_bins at least {2 * guard_bins + 2} bins"
        )
    sums = np.concatenate([[0.0], np.cumsum(power)])
    bins = np.arange(len(power))

    def total(start: NDArray[np.intp], end: NDArray[np.intp]) -> tuple[NDArray[np.float64], ...]:
        start, end = np.clip(start, 0, len(power)), np.clip(end, 0, len(power))
        return sums[end] - sums[start], (end - start).astype(np.float64)

    before, n_before = total(bins - guard_bins - training_bins, bins - guard_bins)
    after, n_after = total(bins + guard_bins + 1, bins + guard_bins + 1 + training_bins)
    n = n_before + n_after
    alpha = n * (false_alarm_rate ** (-1 / n) - 1)
    # a difference of sums can fall below 0 by rounding
    threshold = np.maximum(alpha * (before + after) / n, 0.0)
    return Detections(bins=np.flatnonzero(power > threshold), threshold=np.sqrt(threshold))

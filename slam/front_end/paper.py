"""Front end of the paper: one raw frame in, the ranges of its echoes out.

Magnitude, background to zero, Savitzky-Golay, local maxima with a least height and prominence
(paper, section Signal Processing). Source of the order: the paper's caption of the raw
observations, where the magnitude comes first.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from slam.config import BackgroundFilter, DetectionConfig, PeakPosition
from slam.frames import Detection, RadarFrame, StepInputError

Array = NDArray[np.float64]


class PaperDetector:
    """The paper's front end."""

    def __init__(self, config: DetectionConfig) -> None:
        self.config = config
        self._smoother = SavitzkyGolay(config.smoothing_length_bins, config.smoothing_order)

    def detect(self, frame: RadarFrame, range_offset_m: float = 0.0) -> tuple[Detection, ...]:
        """Return the echoes of one frame inside the range limits, nearest first.

        Peaks are searched in the whole frame, so an echo's prominence never depends on the limits.
        The frame must be longer than the smoothing filter; samples that are NaN count as zero.
        """
        bins, beyond, heights = self._peaks(self.smooth(frame.samples))
        return self._in_range(frame, bins + beyond, heights, range_offset_m)

    def detect_many(
        self, frames: Sequence[RadarFrame], offsets_m: Sequence[float]
    ) -> list[tuple[Detection, ...]]:
        results: list[tuple[Detection, ...]] = [()] * len(frames)
        for n_bins in {frame.samples.size for frame in frames}:
            chosen = [index for index, frame in enumerate(frames) if frame.samples.size == n_bins]
            # All frames end to end: a wall between two does what the end of a single one does.
            walled = np.full((len(chosen), n_bins + 1), np.inf)
            walled[:, :-1] = self.smooth(np.stack([frames[index].samples for index in chosen]))
            bins, beyond, heights = self._peaks(walled.ravel()[:-1])
            row, bins = np.divmod(bins, n_bins + 1)
            starts = np.searchsorted(row, np.arange(1, len(chosen)))
            places, heights_of = np.split(bins + beyond, starts), np.split(heights, starts)
            for index, place, height in zip(chosen, places, heights_of, strict=True):
                results[index] = self._in_range(frames[index], place, height, offsets_m[index])
        return results

    def smooth(self, samples: NDArray[np.float32]) -> Array:
        """Return the magnitude, background set to zero, smoothed; shapes (..., n_bins).

        Each frame on its own, to the same bits however many.
        """
        magnitude = np.abs(samples, dtype=np.float64)
        mean = magnitude.mean(axis=-1, keepdims=True)
        if np.isnan(mean).any():
            magnitude = np.nan_to_num(magnitude, nan=0.0)
            mean = magnitude.mean(axis=-1, keepdims=True)
        if self.config.background is BackgroundFilter.BELOW_MEAN_TO_ZERO:
            magnitude *= magnitude >= mean
        return self._smoother.smooth(magnitude)

    def _peaks(self, smoothed: Array) -> tuple[NDArray[np.intp], Array, Array]:
        """Return the bin of each peak, how far beyond it the peak lies [bins], and its height."""
        # Here, as in `SavitzkyGolay`: scipy.signal takes half a second to load, and only this
        # front end needs it.
        from scipy.signal import find_peaks

        config = self.config
        peaks, properties = find_peaks(
            smoothed,
            height=(config.min_peak_height, np.finfo(np.float64).max),
            prominence=config.min_peak_prominence,
            width=config.min_peak_width_bins or None,
        )
        beyond = np.zeros(peaks.size)
        if config.peak_position is PeakPosition.PARABOLA:
            beyond = _vertex_offsets(smoothed, peaks)
        return peaks, beyond, properties["peak_heights"]

    def _in_range(
        self, frame: RadarFrame, positions: Array, heights: Array, range_offset_m: float
    ) -> tuple[Detection, ...]:
        config = self.config
        ranges_m = frame.range_start_m + positions * frame.bin_length_m - range_offset_m
        return tuple(
            Detection(radar=frame.radar, t_ns=frame.t_ns, range_m=range_m, amplitude=amplitude)
            for range_m, amplitude in zip(ranges_m.tolist(), heights.tolist(), strict=True)
            if config.min_range_m <= range_m <= config.max_range_m
        )


class SavitzkyGolay:
    """``scipy.signal.savgol_filter`` with ``mode="interp"``, its coefficients computed once.

    In the middle a fixed kernel, at each end the polynomial fitted to the last ``length`` samples,
    an odd number.
    """

    def __init__(self, length: int, order: int) -> None:
        # The filter is linear: its answers to unit impulses are its matrix.
        from scipy.signal import savgol_filter

        response: Array = np.asarray(savgol_filter(np.eye(2 * length), length, order, axis=0))
        half = length // 2
        self.length = length
        self._head = response[:half, :length].copy()
        self._tail = response[-half:, -length:].copy()
        # Row `length` of the matrix is an inner one: the kernel, centred on column `length`.
        self._kernel = response[length, length - half : length + half + 1].copy()

    def smooth(self, samples: Array) -> Array:
        """Return smoothed samples, shape (..., n), n at least the filter's length."""
        if samples.shape[-1] < self.length:
            raise StepInputError(
                f"a frame of {samples.shape[-1]} bins is shorter than the smoothing filter "
                f"({self.length}); ask the module for a longer frame area"
            )
        smoothed: Array = correlate1d(samples, self._kernel, axis=-1, mode="constant")
        half = self.length // 2
        # Sums of products rather than matrix products: those round by the number of frames.
        first = samples[..., np.newaxis, : self.length]
        last = samples[..., np.newaxis, -self.length :]
        smoothed[..., :half] = (self._head * first).sum(axis=-1)
        smoothed[..., -half:] = (self._tail * last).sum(axis=-1)
        return smoothed


def _vertex_offsets(smoothed: Array, peaks: NDArray[np.intp]) -> Array:
    """Return the bins from each peak to the vertex through it and its neighbours."""
    before, at, after = smoothed[peaks - 1], smoothed[peaks], smoothed[peaks + 1]
    curvature = before - 2 * at + after
    # A plateau has no curvature and its middle bin is the answer already.
    flat = curvature >= 0
    return np.where(flat, 0.0, 0.5 * (before - after) / np.where(flat, 1.0, curvature))

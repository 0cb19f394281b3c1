"""What frames of a standing radar do over slow time: the statistics of the recording experiment.

Everything is per baseband component (I or Q), the mean of each bin over time taken off. Of a record
of finite length all estimates are biased alike for slow processes, so records are compared with
records of the same length and rate, never with the parameters of a model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.signal import welch

Array = NDArray[np.float64]

FAR_BINS = 10
"""The farthest bins, taken for empty."""
SEGMENT = 128
"""Frames of a spectrum's segments, and of the quietest stretch."""
FLOOR_FROM_HZ = 6.0
"""The noise floor is read from here upwards; at 17 frames/s spectra end at 8.5 Hz."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SlowTime:
    """Frames of a standing radar.

    Attributes
    ----------
    iq
        Shape (n_frames, n_bins), complex128: baseband.
    rate_hz
        Frames per second.
    first_bin_m, bin_length_m
        Where the bins lie, module metres.
    """

    iq: NDArray[np.complex128]
    rate_hz: float
    first_bin_m: float
    bin_length_m: float

    @property
    def amplitude(self) -> Array:
        """Return the mean amplitude of each bin, shape (n_bins,)."""
        mean: Array = np.abs(self.iq).mean(axis=0)
        return mean

    @property
    def strongest(self) -> int:
        """Return the bin of the largest mean amplitude."""
        return int(np.argmax(self.amplitude))

    @property
    def sigma(self) -> Array:
        """Return the standard deviation of each bin over time, per component, shape (n_bins,)."""
        sigma: Array = np.sqrt(self.iq.var(axis=0) / 2)
        return sigma

    @property
    def phase_rad(self) -> Array:
        """Return the strongest bin's phase about its mean, unwrapped, shape (n_frames,)."""
        phase: Array = np.unwrap(np.angle(self.iq[:, self.strongest]))
        phase -= phase.mean()
        return phase

    @property
    def far(self) -> NDArray[np.complex128]:
        """Return the farthest bins about their means, shape (n_frames, FAR_BINS)."""
        far = self.iq[:, -FAR_BINS:]
        centred: NDArray[np.complex128] = far - far.mean(axis=0)
        return centred

    def autocorrelation(self, n_lags: int) -> Array:
        """Return the far bins' autocorrelation at lags 0 ... n_lags - 1, shape (n_lags,)."""
        far, n = self.far, len(self.iq)
        products = [float((far[: n - lag].conj() * far[lag:]).real.mean()) for lag in range(n_lags)]
        return np.array(products) / products[0]

    def spectrum(self, bins: slice) -> tuple[Array, Array]:
        """Return frequencies [Hz] and amplitude spectral density per component [1/sqrt Hz].

        Positive and negative frequencies and all the bins are averaged in power. Both of shape
        (SEGMENT // 2,): without frequency 0, which is the mean's, and without the last.
        """
        frequency, density = welch(
            self.iq[:, bins],
            fs=self.rate_hz,
            window="hann",
            nperseg=SEGMENT,
            detrend="constant",
            return_onesided=False,
            axis=0,
        )
        # of a component: half the complex value's; of one side: the sum of both
        one_sided = (density + density[-np.arange(SEGMENT)]).mean(axis=1) / 2
        use = slice(1, SEGMENT // 2)
        return frequency[use], np.sqrt(one_sided[use])

    def phase_increments_rad(self, lags: NDArray[np.int64]) -> Array:
        """Return the standard deviation of the phase's change over lags, shape of ``lags``."""
        phase = self.phase_rad
        return np.array([float(np.std(phase[lag:] - phase[:-lag])) for lag in lags.tolist()])

    def quietest(self) -> SlowTime:
        """Return the stretch of `SEGMENT` frames whose far bins change least between frames."""
        power = (np.abs(np.diff(self.far, axis=0)) ** 2).mean(axis=1)
        total = np.convolve(power, np.ones(SEGMENT - 1), mode="valid")
        start = int(np.argmin(total))
        return replace(self, iq=self.iq[start : start + SEGMENT])

    def numbers(self) -> Mapping[str, float]:
        """Return the figures of the table, by the names in `TITLES`."""
        far = self.far
        frequency, density = self.spectrum(slice(-FAR_BINS, None))
        floor = float(np.sqrt((density[frequency >= FLOOR_FROM_HZ] ** 2).mean()))
        change = np.diff(self.phase_rad)
        fast = np.diff(far, n=3, axis=0)
        return {
            "amplitude": float(self.amplitude[self.strongest]),
            "phase_rad": float(self.phase_rad.std()),
            "phase_white_rad": float(change.std() / np.sqrt(2)),
            "far_sigma": _component(far),
            "far_lag_1": float(self.autocorrelation(2)[1]),
            "far_white": _component(np.diff(far, axis=0)) / np.sqrt(2),
            "far_floor": floor * np.sqrt(self.rate_hz / 2),
            "far_neighbours": _neighbours(far),
            "far_neighbours_fast": _neighbours(fast),
        }


TITLES: Mapping[str, str] = {
    "amplitude": "strongest bin: mean amplitude",
    "phase_rad": "strongest bin: phase, std [rad]",
    "phase_white_rad": "  of it new with each frame [rad]",
    "far_sigma": "ten farthest bins: std per component",
    "far_lag_1": "  autocorrelation at one frame",
    "far_white": "  of it new with each frame",
    "far_floor": f"  floor of the spectrum, as white noise (> {FLOOR_FROM_HZ:.0f} Hz)",
    "far_neighbours": "  correlation of neighbouring bins",
    "far_neighbours_fast": "  the same of its fast part (third differences)",
}
"""Names and titles of the figures, in the table's order."""


def _component(values: NDArray[np.complex128]) -> float:
    return float(np.sqrt((np.abs(values) ** 2).mean() / 2))


def _neighbours(values: NDArray[np.complex128]) -> float:
    """Return the mean magnitude of the correlation between bins that lie side by side."""
    sigma = np.sqrt((np.abs(values) ** 2).mean(axis=0))
    products = np.abs((values[:, 1:].conj() * values[:, :-1]).mean(axis=0))
    return float((products / (sigma[1:] * sigma[:-1])).mean())


def spread_of(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the 10th percentile, the median and the 90th percentile."""
    low, middle, high = np.percentile(values, (10, 50, 90))
    return float(low), float(middle), float(high)

"""Movement by its Doppler frequency: range-Doppler maps and spectrograms of complex baseband.

The phase of an echo at range R is ``-4 pi R / wavelength`` (protocol reference 9.8), so what comes
nearer at v metres per second has the frequency ``f = 2 v / wavelength``: positive frequencies and
velocities are approaching. Power is that of a complex tone: one of amplitude A at one of the
frequencies reads A**2, whatever the window.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from xethru_protocol.processing.monitor import check_rate

SPEED_OF_LIGHT_MPS = 299_792_458.0
CARRIER_HZ = 7.29e9
"""Carrier at TXCENTERFREQUENCY 3; at 4 it is 8.748 GHz. Protocol reference 9.2."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RangeDoppler:
    """Power over Doppler frequency and range.

    Attributes
    ----------
    power
        Shape (n_frequencies, n_bins), float64, squared units of the frames.
    frequencies_hz
        Shape (n_frequencies,), ascending.
    velocities_mps
        Shape (n_frequencies,): radial velocity of each frequency, approaching positive.
    """

    power: NDArray[np.float64]
    frequencies_hz: NDArray[np.float64]
    velocities_mps: NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Spectrogram:
    """Power of one bin over time and Doppler frequency.

    Attributes
    ----------
    power
        Shape (n_times, n_frequencies), float64, squared units of the frames.
    times_s
        Shape (n_times,): middle of each window, from the first frame on.
    frequencies_hz, velocities_mps
        Shape (n_frequencies,), as those of `RangeDoppler`.
    """

    power: NDArray[np.float64]
    times_s: NDArray[np.float64]
    frequencies_hz: NDArray[np.float64]
    velocities_mps: NDArray[np.float64]


def range_doppler(
    iq: ArrayLike,
    frame_rate_hz: float,
    *,
    n_frequencies: int | None = None,
    carrier_hz: float = CARRIER_HZ,
) -> RangeDoppler:
    """Return the range-Doppler map of some frames: a Fourier transform of each bin over time.

    ``power[f, m] = |sum_t w_t x[t, m] exp(-2 pi j f t / rate)|**2 / (sum_t w_t)**2`` with the
    periodic Hann window w (Harris, Proc. IEEE 66 (1978) 51). What stands still is at 0 Hz and, by
    the window, one step of ``rate / n_frames`` on either side; `remove_clutter` takes it away.

    Parameters
    ----------
    iq
        Shape (n_frames, n_bins), complex, at least two frames.
    n_frequencies
        At least the number of frames, which it is if left out; more interpolate.
    carrier_hz
        For the velocities.

    Raises
    ------
    ValueError
        For another shape or an argument out of its range.
    """
    frames = np.asarray(iq)
    check_rate(frame_rate_hz)
    if frames.ndim != 2:
        raise ValueError(f"frames of shape {frames.shape}: must have (n_frames, n_bins)")
    if not 0 < carrier_hz < math.inf:
        raise ValueError(f"carrier_hz {carrier_hz:g}: must be above 0")
    length = _transform_length(len(frames), n_frequencies)
    window = hann(len(frames))
    weighted = frames * (window / window.sum())[:, np.newaxis]
    spectrum = np.fft.fftshift(np.fft.fft(weighted, length, axis=0), axes=0)
    frequencies_hz = np.fft.fftshift(np.fft.fftfreq(length, 1 / frame_rate_hz))
    return RangeDoppler(
        power=np.asarray(spectrum.real**2 + spectrum.imag**2, dtype=np.float64),
        frequencies_hz=frequencies_hz,
        velocities_mps=frequencies_hz * (SPEED_OF_LIGHT_MPS / (2 * carrier_hz)),
    )


def spectrogram(
    iq_bin: ArrayLike,
    frame_rate_hz: float,
    *,
    window: int = 64,
    step: int | None = None,
    n_frequencies: int | None = None,
    carrier_hz: float = CARRIER_HZ,
) -> Spectrogram:
    """Return the power of one bin over time and frequency: `range_doppler` of window by window.

    Parameters
    ----------
    iq_bin
        Shape (n_frames,), complex: one column of the frames.
    window
        Frames per transform, at least 2.
    step
        Frames from one window to the next; a quarter of the window if left out. Frames at the end
        that fill no window are left out.
    n_frequencies, carrier_hz
        As in `range_doppler`.

    Raises
    ------
    ValueError
        For fewer frames than a window, another shape or an argument out of its range.
    """
    values = np.asarray(iq_bin)
    if values.ndim != 1:
        raise ValueError(f"a bin of shape {values.shape}: must have (n_frames,), as iq[:, k]")
    if window < 2:
        raise ValueError(f"window {window}: must be at least 2 frames")
    if step is not None and step < 1:
        raise ValueError(f"step {step}: must be at least 1 frame")
    if len(values) < window:
        raise ValueError(f"{len(values)} frames: a window has {window}")
    step = max(window // 4, 1) if step is None else step
    windows = np.lib.stride_tricks.sliding_window_view(values, window)[::step]
    found = range_doppler(
        windows.T, frame_rate_hz, n_frequencies=n_frequencies, carrier_hz=carrier_hz
    )
    times_s = (np.arange(len(windows)) * step + window / 2) / frame_rate_hz
    return Spectrogram(
        power=np.ascontiguousarray(found.power.T),
        times_s=np.asarray(times_s, dtype=np.float64),
        frequencies_hz=found.frequencies_hz,
        velocities_mps=found.velocities_mps,
    )


def hann(n_frames: int) -> NDArray[np.float64]:
    """Return the periodic Hann window, shape (n_frames,)."""
    window: NDArray[np.float64] = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(n_frames) / n_frames)
    return window


def _transform_length(n_frames: int, n_frequencies: int | None) -> int:
    if n_frames < 2:
        raise ValueError(f"{n_frames} frames: a transform over time needs at least 2")
    length = n_frames if n_frequencies is None else n_frequencies
    if length < n_frames:
        raise ValueError(f"n_frequencies {length}: must be at least the {n_frames} frames")
    return length

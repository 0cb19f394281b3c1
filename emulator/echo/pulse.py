"""The X4's transmit pulse, and frames made of shifted copies of it.

One pulse is ``A exp(-(t - tau)**2 / (2 sigma**2)) cos(2 pi fc (t - tau) + phase)``: a Gaussian
envelope on a carrier, sampled at 23.328 GHz. The carrier is an exact fraction of the sampling
rate, 5/16 or 3/8 (protocol reference 9.2). The -10 dB bandwidth of 1.4 GHz is assumed, as that
reference proposes; the real pulse is not symmetric and rings a little, which is left out.

Arithmetic is float64 additions and multiplications per sample; cosines are taken once per pulse.
"""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from xethru_protocol.wire.x4 import CARRIER_HZ, SAMPLING_RATE_HZ

__all__ = [
    "BANDWIDTH_HZ",
    "CARRIER_CYCLES_PER_SAMPLE",
    "HALF_WINDOW",
    "SIGMA_S",
    "sum_of_pulses",
]

BANDWIDTH_HZ = 1.4e9
"""Full width of the power spectrum at -10 dB."""
SIGMA_S = math.sqrt(math.log(10)) / (math.pi * BANDWIDTH_HZ)
"""Envelope's standard deviation in time: the spectrum exp(-(2 pi f sigma)**2) is 0.1 at B/2."""
CARRIER_CYCLES_PER_SAMPLE = {
    setting: (Fraction(carrier_hz) / Fraction(SAMPLING_RATE_HZ)).as_integer_ratio()
    for setting, carrier_hz in CARRIER_HZ.items()
}
"""TX centre frequency setting -> carrier / sampling rate as a fraction: 7.290 and 8.748 GHz."""

_SIGMA_SAMPLES = SIGMA_S * SAMPLING_RATE_HZ
HALF_WINDOW = math.ceil(6 * _SIGMA_SAMPLES)
"""Samples evaluated on either side of a pulse; beyond, it is below 1.6e-8 of its amplitude."""

_OFFSETS = np.arange(-HALF_WINDOW, HALF_WINDOW + 1)
_SHIFT_ORDER = 5


def _envelope_series() -> list[NDArray[np.float64]]:
    """Return the coefficients of the envelope's Taylor series in the shift, in samples.

    ``exp(-(x - h)**2 / 2) = sum_k He_k(x) h**k / k! exp(-x**2 / 2)`` with the probabilists'
    Hermite polynomials. For half a sample, h = 0.062, order 5 leaves 2e-9 of the amplitude.
    """
    x = _OFFSETS / _SIGMA_SAMPLES
    hermite = [np.ones_like(x), x]
    for k in range(1, _SHIFT_ORDER):
        hermite.append(x * hermite[k] - k * hermite[k - 1])
    bell = np.exp(-0.5 * x * x)
    return [
        polynomial * bell / (math.factorial(k) * _SIGMA_SAMPLES**k)
        for k, polynomial in enumerate(hermite)
    ]


_ENVELOPE = _envelope_series()


def _carrier(fraction: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return cosine and sine of the carrier at whole samples; the phase is reduced in integers."""
    cycles, samples = fraction
    phase_rad = math.tau * ((cycles * _OFFSETS) % samples) / samples
    return np.cos(phase_rad), np.sin(phase_rad)


_CARRIER = {setting: _carrier(fraction) for setting, fraction in CARRIER_CYCLES_PER_SAMPLE.items()}


def sum_of_pulses(
    *,
    frame: NDArray[np.int64],
    position: NDArray[np.float64],
    amplitude: NDArray[np.float64],
    phase_rad: NDArray[np.float64],
    tx_center_frequency: int,
    shape: tuple[int, int],
) -> NDArray[np.float64]:
    """Return frames that are sums of pulses.

    Parameters
    ----------
    frame
        Shape (p,), int64: the frame each pulse belongs to. Pulses of one frame are added in the
        order given, so a frame's rounding does not depend on the other frames.
    position
        Shape (p,), float64: where the pulse is centred, in samples from the frame's first; any
        real number, also outside the frame.
    amplitude
        Shape (p,), float64: peak of the envelope.
    phase_rad
        Shape (p,), float64: phase of the carrier at the pulse's centre.
    tx_center_frequency
        A key of ``CARRIER_CYCLES_PER_SAMPLE``.
    shape
        (n_frames, n_samples) of the result.

    Returns
    -------
    Shape ``shape``, float64.
    """
    n_frames, n_samples = shape
    # Half a window of padding on either side takes every pulse that reaches into the frame.
    touches = (position > -HALF_WINDOW) & (position < n_samples - 1 + HALF_WINDOW)
    frame, position = frame[touches], position[touches]
    amplitude, phase_rad = amplitude[touches], phase_rad[touches]

    # floor, not rint: ties must fall alike for odd and even bins, so that a shift is exact.
    nearest = np.floor(position + 0.5)
    shift = position - nearest
    cycles, samples = CARRIER_CYCLES_PER_SAMPLE[tx_center_frequency]
    centre_phase = phase_rad - math.tau * cycles / samples * shift

    h = shift[:, np.newaxis]
    wave = h * _ENVELOPE[-1]
    for coefficients in _ENVELOPE[-2:0:-1]:
        wave += coefficients
        wave *= h
    wave += _ENVELOPE[0]
    cosine, sine = _CARRIER[tx_center_frequency]
    carrier = (amplitude * np.cos(centre_phase))[:, np.newaxis] * cosine
    carrier -= (amplitude * np.sin(centre_phase))[:, np.newaxis] * sine
    wave *= carrier

    padding = 2 * HALF_WINDOW
    width = n_samples + 2 * padding
    first = frame * width + padding + nearest.astype(np.int64)
    bins = first[:, np.newaxis] + _OFFSETS
    padded: NDArray[np.float64] = np.bincount(
        bins.ravel(), weights=wave.ravel(), minlength=n_frames * width
    ).astype(np.float64, copy=False)  # without any pulse, bincount answers integers
    return padded.reshape(n_frames, width)[:, padding : padding + n_samples]

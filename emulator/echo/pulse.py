"""The pulse that a module sends, and frames that are sums of such pulses.

One pulse is ``A exp(-(t - tau)**2 / (2 sigma**2)) cos(2 pi fc (t - tau) + phase)``: a Gaussian
envelope on a carrier, sampled at 23.328 GHz. The carrier is an exact fraction of the sampling
rate, 5/16 or 3/8 (protocol reference 9.2). The -10 dB bandwidth of 1.4 GHz is assumed, as that
reference proposes. `PulseSpec` holds how a module's own pulse differs from that.

Arithmetic is float64 additions and multiplications per sample; cosines are taken once per pulse.
"""

from __future__ import annotations

import functools
import math
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from emulator.scene.scene import PulseSpec
from xethru_protocol.wire.x4 import CARRIER_HZ, SAMPLING_RATE_HZ

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

_SHIFT_ORDER = 5
_PULSES_AT_ONCE = 128


def _envelope_series() -> list[NDArray[np.float64]]:
    """Return the coefficients of the envelope's Taylor series in the shift, in samples.

    ``exp(-(x - h)**2 / 2) = sum_k He_k(x) h**k / k! exp(-x**2 / 2)`` with the probabilists'
    Hermite polynomials. For half a sample, h = 0.062, order 5 leaves 2e-9 of the amplitude.
    """
    x = np.arange(-HALF_WINDOW, HALF_WINDOW + 1) / _SIGMA_SAMPLES
    hermite = [np.ones_like(x), x]
    for k in range(1, _SHIFT_ORDER):
        hermite.append(x * hermite[k] - k * hermite[k - 1])
    bell = np.exp(-0.5 * x * x)
    return [
        polynomial * bell / (math.factorial(k) * _SIGMA_SAMPLES**k)
        for k, polynomial in enumerate(hermite)
    ]


_ENVELOPE = _envelope_series()

RINGING_SIGMAS = 3.2
"""How much later than the pulse its ringing copy comes, in the nominal pulse's sigma."""
RINGING_PHASE_RAD = 1.0
"""How far the carrier of the copy is ahead."""


NOMINAL_PULSE = PulseSpec()


def _deviations(pulse: PulseSpec) -> tuple[float, float]:
    """Return the envelope's standard deviations before and after its peak, in the nominal one's."""
    return pulse.width * (1 - pulse.skew), pulse.width * (1 + pulse.skew)


def _half_window(pulse: PulseSpec) -> int:
    """Return the samples evaluated on either side; beyond, it is below 1.6e-8 of its amplitude."""
    return math.ceil(6 * _SIGMA_SAMPLES * max(_deviations(pulse)))


def _envelope(pulse: PulseSpec, shift: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the envelopes of pulses ``shift`` samples after a whole sample.

    Shape (p, 2 half_window + 1), without the ringing; ``shift`` has the shape (p, 1) and lies
    within +-0.5.
    """
    before, after = _deviations(pulse)
    if before == after == 1.0:
        wave = shift * _ENVELOPE[-1]
        for coefficients in _ENVELOPE[-2:0:-1]:
            wave += coefficients
            wave *= shift
        wave += _ENVELOPE[0]
        return wave
    after_peak = _offsets(_half_window(pulse)) - shift
    after_peak /= _SIGMA_SAMPLES * np.where(after_peak < 0, before, after)
    bell: NDArray[np.float64] = np.exp(-0.5 * after_peak * after_peak)
    return bell


def _offsets(half_window: int) -> NDArray[np.int64]:
    return np.arange(-half_window, half_window + 1)


@functools.cache
def _carrier(
    tx_center_frequency: int, half_window: int, offset_rad: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return cosine and sine of the carrier at whole samples; the phase is reduced in integers.

    ``offset_rad`` is what an offset of its frequency adds from sample to sample.
    """
    cycles, samples = CARRIER_CYCLES_PER_SAMPLE[tx_center_frequency]
    phase_rad = math.tau * ((cycles * _offsets(half_window)) % samples) / samples
    phase_rad += offset_rad * _offsets(half_window)
    return np.cos(phase_rad), np.sin(phase_rad)


def sum_of_pulses(
    *,
    frame: NDArray[np.int64],
    position: NDArray[np.float64],
    amplitude: NDArray[np.float64],
    phase_rad: NDArray[np.float64],
    tx_center_frequency: int,
    shape: tuple[int, int],
    pulse: PulseSpec = NOMINAL_PULSE,
) -> NDArray[np.float64]:
    """Return frames that are sums of pulses, of a shape (n_frames, n_samples), float64.

    Parameters
    ----------
    frame
        Shape (p,), int64, ascending: the frame each pulse belongs to. Pulses of one frame are added
        in the order given, so a frame's rounding does not depend on the other frames.
    position
        Shape (p,), float64: where the pulse is centred, in samples from the frame's first; any
        real number, also outside the frame.
    amplitude
        Shape (p,), float64: peak of the envelope.
    phase_rad
        Shape (p,), float64: phase of the carrier at the pulse's centre.
    """
    n_frames, n_samples = shape
    half_window = _half_window(pulse)
    offset_rad = math.tau * pulse.carrier_offset_hz / SAMPLING_RATE_HZ
    if pulse.ringing:
        frame = np.repeat(frame, 2)
        later = RINGING_SIGMAS * _SIGMA_SAMPLES
        position = np.column_stack([position, position + later]).ravel()
        amplitude = np.column_stack([amplitude, pulse.ringing * amplitude]).ravel()
        phase_rad = np.column_stack([phase_rad, phase_rad + RINGING_PHASE_RAD]).ravel()
    # Half a window of padding on either side takes every pulse that reaches into the frame.
    touches = (position > -half_window) & (position < n_samples - 1 + half_window)
    frame, position = frame[touches], position[touches]
    amplitude, phase_rad = amplitude[touches], phase_rad[touches]

    # floor, not rint: ties must fall alike for odd and even bins, so that a shift is exact.
    nearest = np.floor(position + 0.5)
    shift = position - nearest
    cycles, samples = CARRIER_CYCLES_PER_SAMPLE[tx_center_frequency]
    centre_phase = phase_rad - (math.tau * cycles / samples + offset_rad) * shift
    in_phase, quadrature = amplitude * np.cos(centre_phase), amplitude * np.sin(centre_phase)
    first = nearest.astype(np.int64) + 2 * half_window

    width = n_samples + 4 * half_window
    frames = np.empty((n_frames, n_samples))
    # whole frames at a time: what is added stays in the processor's cache, a block does not
    ends = np.searchsorted(frame, np.arange(1, n_frames + 1)).tolist()
    begin = done = 0
    for n_done, end in enumerate(ends, 1):
        if end - begin < _PULSES_AT_ONCE and n_done < n_frames:
            continue
        part = slice(begin, end)
        bins = ((frame[part] - done) * width + first[part])[:, np.newaxis] + _offsets(half_window)
        waves = _envelope(pulse, shift[part, np.newaxis])
        cosine, sine = _carrier(tx_center_frequency, half_window, offset_rad)
        waves *= _on_carrier(in_phase[part], quadrature[part], cosine, sine)
        padded = np.bincount(
            bins.ravel(), weights=waves.ravel(), minlength=(n_done - done) * width
        ).reshape(-1, width)
        frames[done:n_done] = padded[:, 2 * half_window : 2 * half_window + n_samples]
        begin, done = end, n_done
    return frames


def _on_carrier(
    in_phase: NDArray[np.float64],
    quadrature: NDArray[np.float64],
    cosine: NDArray[np.float64],
    sine: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return carriers about the whole samples nearest to pulses, (p, 2 half_window + 1)."""
    carrier: NDArray[np.float64] = in_phase[:, np.newaxis] * cosine
    carrier -= quadrature[:, np.newaxis] * sine
    return carrier

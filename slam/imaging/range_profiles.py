"""Raw frames as complex range profiles, and the part of them that moves with the robot.

An echo A Re{p(r - R) exp(j phi)} at range R, p(x) = exp(-x**2 / (2 s**2)) exp(j k x), has behind a
filter for its positive frequencies, and with the carrier exp(j k r) removed, the profile

    z(r) = A q(r - R) exp(j (phi - k R)),   k = 4 pi f_c / c

q is real and has its peak 1 at 0. So z changes slowly from bin to bin, and z(R) exp(j k R) is the
same for every antenna that sees one reflector at its own R: these values are what an image sums.

Filter
    The matched filter alone would widen an echo by sqrt(2). With P, 0 to 1, the spectrum of the
    pulse over its largest value, profiles have the spectrum of the echo times

        H = P**_WHITENING / (P**2 + _NOISE_SHARE) P

    which gives back nearly the pulse, and fades where noise is above the pulse (Wiener).
Static part
    Leakage from transmitter to receiver and echoes of the robot itself are the same in all frames
    of a radar; echoes of the room turn their phase with every few millimetres of way. The mean of
    frames that were taken at different places keeps the former alone, and the median of such means
    at different headings leaves out walls that the robot drove along.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.front_end.pulse import ModulePulse

Array = NDArray[np.float64]
Profiles = NDArray[np.complex64]
Samples = NDArray[Any]  # RF: float64; I/Q: complex128

_SPEED_OF_LIGHT_MPS = 299_792_458.0
_WHITENING = 0.94
_NOISE_SHARE = 0.01
# Samples of an echo per bin of a profile
_ECHO_STEPS = 8
# Linear interpolation between bins needs this many of them per envelope sigma.
_BINS_PER_SIGMA = 3.0
# Of the static part: headings that it is learnt for, and how far the antenna goes between frames
_HEADINGS, _SPACING_M = 36, 0.005


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RangeProfiles:
    """Range profiles of one radar, their carrier removed.

    Attributes
    ----------
    values
        Shape (n_frames, n_bins), complex64.
    range_start_m, bin_length_m
        Range of bin 0, true metres from the antenna, and spacing of the bins.
    wave_number_rad_per_m
        k = 4 pi f_c / c: how fast the phase of an echo turns with its range.
    echo
        q, the profile of an echo of amplitude 1, at 0, 1/8, 2/8 ... bins from its peak; it is even,
        and 0 beyond. None: not known.
    """

    values: Profiles
    range_start_m: float
    bin_length_m: float
    wave_number_rad_per_m: float
    echo: Array | None = None

    @property
    def ranges_m(self) -> Array:
        """Return the ranges of the bins, shape (n_bins,)."""
        return np.asarray(self.range_start_m + self.bin_length_m * np.arange(self.values.shape[1]))

    def times(self, weights: Array) -> RangeProfiles:
        """Return each profile times its weight; ``weights`` has shape (n_frames,)."""
        return replace(self, values=(self.values * weights[:, None]).astype(np.complex64))

    def times_range(self, power: float) -> RangeProfiles:
        """Return profiles times range**power: the law by which echoes fall is made up for.

        The power is 2 for points and 1.5 for rods; ranges below 0 count as 0.
        """
        law = np.maximum(self.ranges_m, 0.0) ** power
        return replace(self, values=(self.values * law).astype(np.complex64))


class ProfileFilter:
    """Makes range profiles of the RF frames of one module.

    ``pulse`` is the module's, nominal or learnt; ``n_bins`` and ``bin_length_m`` are those of its
    frames. The bins of profiles are those of the frames.
    """

    def __init__(self, pulse: ModulePulse, n_bins: int, bin_length_m: float) -> None:
        model, taps = pulse.model, pulse.equaliser
        self.n_bins = n_bins
        self.bin_length_m = bin_length_m
        self.wave_number_rad_per_m = 4 * math.pi * model.carrier_hz / _SPEED_OF_LIGHT_MPS
        reach = model.half_length(bin_length_m) + (0 if taps is None else taps.size // 2)
        self._n_fft = 1 << (n_bins + reach - 1).bit_length()
        self._half = self._n_fft // 2
        # Of the pulse: exp(-(kappa - k)**2 s**2 / 2), kappa [rad/m]
        kappa = math.tau * np.arange(self._half) / (self._n_fft * bin_length_m)
        p = np.exp(-0.5 * ((kappa - self.wave_number_rad_per_m) * model.sigma_m) ** 2)
        shape = p ** (1 + _WHITENING) / (p**2 + _NOISE_SHARE)
        # An echo of amplitude 1 has the peak 1: its spectrum is p times this. The factor 2 makes up
        # for the negative frequencies.
        self._spectrum = (2 * shape * p.sum() / (p * shape).sum()).astype(np.complex128)
        # At eighths of bins from its peak, the carrier removed
        at_m = bin_length_m / _ECHO_STEPS * np.arange(_ECHO_STEPS * model.half_length(bin_length_m))
        phases = np.outer(at_m, kappa - self.wave_number_rad_per_m)
        self._echo = np.cos(phases) @ (p * shape) / (p * shape).sum()
        if taps is not None:
            kernel = np.zeros(self._n_fft)
            kernel[np.arange(taps.size) - taps.size // 2] = taps
            self._spectrum *= np.fft.rfft(kernel)[: self._half]

    def apply(self, samples: NDArray[np.floating], range_start_m: float) -> RangeProfiles:
        """Return the profiles of frames (n_frames, n_bins).

        ``range_start_m`` is the range of bin 0, the module's range offset removed, so it sets the
        zero of range, and of phase.
        """
        whole = np.zeros((len(samples), self._n_fft), dtype=np.complex128)
        whole[:, : self._half] = np.fft.rfft(samples, self._n_fft)[:, : self._half] * self._spectrum
        values = np.fft.ifft(whole)[:, : self.n_bins]
        ranges_m = range_start_m + self.bin_length_m * np.arange(self.n_bins)
        values *= np.exp(-1j * self.wave_number_rad_per_m * ranges_m)
        return RangeProfiles(
            values=values.astype(np.complex64),
            range_start_m=range_start_m,
            bin_length_m=self.bin_length_m,
            wave_number_rad_per_m=self.wave_number_rad_per_m,
            echo=self._echo,
        )


def baseband_profiles(
    samples: NDArray[np.complexfloating],
    range_start_m: float,
    bin_length_m: float,
    *,
    carrier_hz: float,
    sigma_m: float,
) -> RangeProfiles:
    """Return the profiles of I/Q frames (n_frames, n_bins), between whose bins others are put.

    The samples are those of a downconverter that multiplied by exp(-j k (r - r_0)) for any fixed
    r_0, and whose bins hold the whole band; ``sigma_m`` is the deviation of their envelope. So
    many bins are put between two of them (by FFT) that there are three per ``sigma_m``.
    """
    n, between = samples.shape[1], max(1, math.ceil(_BINS_PER_SIGMA * bin_length_m / sigma_m))
    step = _ECHO_STEPS * sigma_m * between / bin_length_m
    # As many bins of nothing behind the last: the ends of a frame are not each other's neighbours.
    spectrum = np.fft.fft(samples, 2 * n)
    padded = np.zeros((len(samples), 2 * n * between), dtype=np.complex128)
    padded[:, :n], padded[:, -n:] = spectrum[:, :n], spectrum[:, n:]
    values = between * np.fft.ifft(padded)[:, : (n - 1) * between + 1]
    return RangeProfiles(
        values=values.astype(np.complex64),
        range_start_m=range_start_m,
        bin_length_m=bin_length_m / between,
        wave_number_rad_per_m=4 * math.pi * carrier_hz / _SPEED_OF_LIGHT_MPS,
        echo=np.exp(-0.5 * (np.arange(0.0, 6.0 * step, 1.0) / step) ** 2),
    )


class StaticPart:
    """What is the same in the frames of one radar that were taken at different places.

    Frames are RF or I/Q, before the filter. While the robot stands nothing is added, so a start on
    the spot does not make the room static. A wall beside a straight path stands still, too, so the
    mean is taken for every 10 degrees of heading apart, and the median over headings counts: the
    wall fades where the robot has not turned yet, or never does. Behind ``memory`` frames of one
    heading, each new one takes the place of a share of all earlier ones.
    """

    def __init__(self, *, memory: int = 300) -> None:
        self._memory = memory
        self._last_m: Array | None = None
        self._of_headings: dict[int, tuple[int, Samples]] = {}

    @property
    def n_headings(self) -> int:
        """Return how many headings, 10 degrees apart, it is known from."""
        return len(self._of_headings)

    @property
    def samples(self) -> Samples | None:
        """Return the static part, shape (n_bins,); None before the first frame."""
        if not self._of_headings:
            return None
        means = np.array([mean for _, mean in self._of_headings.values()])
        if np.iscomplexobj(means):
            return np.asarray(np.median(means.real, axis=0) + 1j * np.median(means.imag, axis=0))
        return np.asarray(np.median(means, axis=0))

    def add(self, samples: Samples, antenna_m: Array, heading_rad: float = 0.0) -> None:
        """Take a frame (n_bins,) if its antenna (2,) or (3,) has moved.

        Antennas and headings are given in any frame that does not jump.
        """
        last_m = self._last_m
        if last_m is not None and math.dist(antenna_m, last_m) < _SPACING_M:
            return
        self._last_m = np.array(antenna_m, dtype=np.float64)
        heading = math.floor(heading_rad / math.tau * _HEADINGS) % _HEADINGS
        n, mean = self._of_headings.get(heading, (0, samples))
        new = mean + (samples - mean) / min(n + 1, self._memory)
        self._of_headings[heading] = n + 1, new

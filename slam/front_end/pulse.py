"""The pulse a front end expects: Gaussian envelope on a carrier, in the bins of a frame.

An echo of amplitude A and phase phi at position u (in bins) is, at RF sample n,

    A Re{ p(n - u) exp(j phi) },   p(x) = exp(-x**2 / (2 s**2)) exp(j kappa x)

with s the envelope's standard deviation and kappa the carrier's phase per bin. A range R is a
two-way delay 2 R / c, so everything follows from two frequencies and the length of a bin.

Cramer-Rao bound of the position, A and phi unknown, white noise of standard deviation sigma per
sample (Kay 1993, Fundamentals of Statistical Signal Processing vol. 1: section 3.5, and 3.7 for
more than one parameter). What counts is the part of the derivative that amplitude and phase do not
explain, the envelope's. With the sums over n as integrals,

    I(u) = A**2 / (2 sigma**2) int e'(x)**2 dx = A**2 sqrt(pi) / (4 s sigma**2),   e = |p|
    std(u) >= (2 sigma / A) sqrt(s / sqrt(pi))

The matched filter's amplitude has the standard deviation sigma sqrt(2 / (s sqrt(pi))) in either
quadrature, so the same bound reads sqrt(2) s over the ratio of amplitude to that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.config import MatchedFilterConfig

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_SPEED_OF_LIGHT_MPS = 299_792_458.0
# Half the length of a sampled pulse in standard deviations: 1.5e-8 of the amplitude is cut off.
_HALF_LENGTH_SIGMAS = 6.0


@dataclass(frozen=True, slots=True, kw_only=True)
class PulseModel:
    """Gaussian envelope on a carrier."""

    carrier_hz: float = 7.29e9  # centre frequency
    bandwidth_hz: float = 1.4e9  # full width of the power spectrum at -10 dB

    @property
    def sigma_m(self) -> float:
        """Return the envelope's standard deviation: exp(-(2 pi f sigma_t)**2) is 0.1 at half width.

        >>> round(1e3 * PulseModel().sigma_m, 1)
        51.7
        """
        sigma_s = math.sqrt(math.log(10)) / (math.pi * self.bandwidth_hz)
        return sigma_s * _SPEED_OF_LIGHT_MPS / 2

    @property
    def wavelength_m(self) -> float:
        """Return the range after which the carrier of an echo repeats, half a wavelength in air.

        >>> round(1e3 * PulseModel().wavelength_m, 2)
        20.56
        """
        return _SPEED_OF_LIGHT_MPS / (2 * self.carrier_hz)

    def sigma_bins(self, bin_length_m: float) -> float:
        return self.sigma_m / bin_length_m

    def carrier_rad(self, bin_length_m: float) -> float:
        return math.tau * bin_length_m / self.wavelength_m

    def half_length(self, bin_length_m: float) -> int:
        """Return how many samples a sampled pulse has on either side of its middle."""
        return math.ceil(_HALF_LENGTH_SIGMAS * self.sigma_bins(bin_length_m))

    def samples(self, offset_bins: Array, bin_length_m: float) -> ComplexArray:
        """Return pulses of amplitude 1 and phase 0, shape (k, 2 half_length + 1).

        ``offset_bins`` (k,) is the place of each from its nearest bin, -0.5 ... 0.5, which is in
        the middle of its row. The real part of a row times ``A exp(j phi)`` is the RF pulse.
        """
        half = self.half_length(bin_length_m)
        x = np.arange(-half, half + 1) - np.asarray(offset_bins, dtype=np.float64)[:, np.newaxis]
        envelope = np.exp(-0.5 * (x / self.sigma_bins(bin_length_m)) ** 2)
        pulses: ComplexArray = envelope * np.exp(1j * self.carrier_rad(bin_length_m) * x)
        return pulses

    def position_bound_bins(self, snr: float, bin_length_m: float) -> float:
        """Return the least standard deviation of a position, amplitude and phase unknown.

        ``snr`` is A / sigma, amplitude over the standard deviation of the white noise per RF
        sample.

        >>> bin_m = 299_792_458 / (2 * 23.328e9)
        >>> round(1e3 * bin_m * PulseModel().position_bound_bins(30.0, bin_m), 2)
        0.91
        """
        return 2 / snr * math.sqrt(self.sigma_bins(bin_length_m) / math.sqrt(math.pi))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ModulePulse:
    """The pulse of one module as the front end takes it: a Gaussian, its error, and an equaliser.

    The configured one, or what :mod:`slam.front_end.pulse_estimation` makes of echoes.
    """

    model: PulseModel
    # Relative error of the model, behind the equaliser if there is one: root of the energy of its
    # difference from the real pulse, over the energy of the pulse. It scales what a second echo
    # must explain, the misfit, and the deviation of echoes near others.
    error: float
    # Real filter, shape (2 h + 1,), that turns the module's pulse into the model: convolved with
    # the samples of a frame, its middle at delay zero. None: echoes are the model as they come.
    equaliser: Array | None = None


def nominal_pulse(settings: MatchedFilterConfig) -> ModulePulse:
    """Return the pulse that is configured, for a module whose own is not known."""
    return ModulePulse(
        model=PulseModel(carrier_hz=settings.carrier_hz, bandwidth_hz=settings.bandwidth_hz),
        error=settings.model_error,
    )

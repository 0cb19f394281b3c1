"""Correlation of a frame with the pulse, the noise that comes out, and the threshold over it.

A frame x is correlated with the analytic pulse p of :mod:`slam.pulse_model`, by FFT,

    y[n] = (2 / E) sum_m x[m] conj(p(m - n)),   E = sum_m |p(m)|**2

at every second bin n: y has no negative frequencies, so half its samples hold all of it. It is such
that an echo A Re{p(n - u) exp(j phi)} alone gives, with s the envelope's sigma in bins,

    y[n] = A rho(n - u) exp(j (kappa (n - u) + phi)),   rho(d) = exp(-d**2 / (4 s**2))

Noise
    sigma_y, the standard deviation of either quadrature of y, is taken from the frame itself: there
    the magnitude of y is Rayleigh distributed with median sigma_y sqrt(2 ln 2). Bins near echoes
    are left out. So slow in-band clutter counts as the noise that it is for a range.
Threshold
    The mean number of local maxima above r sigma_y in N bins of noise is, for high levels, the
    rate of upcrossings, c r exp(-r**2 / 2) with c = N / (2 sqrt(pi) s) (Rice 1945, section 3.8). An
    estimated sigma_y scatters like that of K independent cells; averaged over that, exp(-t) with
    t = r**2 / 2 becomes (1 + t / K)**-K (cell-averaging CFAR; Richards 2014, chapter 6). A mean of
    all powers has K = N / (sqrt(2 pi) s), since they correlate by rho**2; a median has the part
    ``_MEDIAN_EFFICIENCY`` of that.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.optimize import brentq

from slam.pulse_model import ComplexArray, PulseModel

Array = NDArray[np.float64]

_PROBES = np.linspace(-2.0, 2.0, 9)
# Bins from one value of y to the next.
BINS_PER_STEP = 2
# Variance of a mean of exponential powers, correlated by rho**2, over that of their median / ln 2;
# (ln 2)**2 if they were independent. A series of Laguerre polynomials gives it, see its test.
_MEDIAN_EFFICIENCY = 0.643
# Cells this many times the first guess of sigma_y**2 hold an echo, and so do two on either side.
_ECHO_LEVEL = 3.5**2
_FLANK_CELLS = 2
# Below one part in so many of its cells left, a frame is taken as a whole.
_LEAST_QUIET = 8


class PulseFilter:
    """Correlation of frames of one length with one pulse, everything worked out once.

    Parameters
    ----------
    pulse
        What an echo looks like.
    n_bins
        Length of the frames.
    bin_length_m
        Spacing of their samples.
    false_alarms
        Mean number of peaks in a frame of noise.
    noise_is_told
        Whether sigma is known, so that the threshold needs no allowance for its scatter.
    """

    def __init__(
        self,
        pulse: PulseModel,
        n_bins: int,
        bin_length_m: float,
        *,
        false_alarms: float,
        noise_is_told: bool,
    ) -> None:
        half = pulse.half_length(bin_length_m)
        template = pulse.samples(np.zeros(1), bin_length_m)[0]
        energy = float(np.sum(np.abs(template) ** 2))
        self.pulse = pulse
        self.n_bins = n_bins
        self.bin_length_m = bin_length_m
        self.sigma_bins = pulse.sigma_bins(bin_length_m)
        self.carrier_rad = pulse.carrier_rad(bin_length_m)
        self.noise_gain = math.sqrt(2 / energy)
        """sigma_y over sigma of white noise per RF sample."""
        # The next power of two, or three quarters of it: transforms of other lengths are slower.
        power_of_two = 1 << (n_bins + half - 1).bit_length()
        enough = power_of_two // 4 * 3 >= n_bins + half
        self._n_fft = power_of_two // 4 * 3 if enough else power_of_two
        # The whole spectrum at once is real: the pulse is even but for its carrier.
        placed = np.zeros(self._n_fft, dtype=np.complex128)
        placed[np.arange(-half, half + 1)] = template * (2 / energy)
        spectrum = np.fft.fft(placed).real
        self._spectrum = spectrum[: self._n_fft // BINS_PER_STEP] / BINS_PER_STEP
        self._n_steps = math.ceil(n_bins / BINS_PER_STEP)
        self._stride = max(1, int(0.75 * self.sigma_bins / BINS_PER_STEP))
        self.probes = np.unique(np.rint(_PROBES * self.sigma_bins / BINS_PER_STEP).astype(np.intp))
        """Where around a peak the misfit is looked at, in steps of y."""
        probe_bins = BINS_PER_STEP * self.probes.astype(np.float64)
        self.probe_sigmas = probe_bins / self.sigma_bins
        """The same in envelope sigmas."""
        self.probe_turns = np.exp(-1j * self.carrier_rad * probe_bins)
        """What turns the carrier at the probes to its phase at the peak."""
        rho_sq = np.exp(-0.5 * self.probe_sigmas**2)
        self.probe_energy = float(np.sum(rho_sq))
        """Energy of a pulse of amplitude 1 at the probes."""
        self.probe_noise = float(np.sum(2 - (2 + 0.5 * self.probe_sigmas**2) * rho_sq))
        """Energy at the probes, over sigma_y**2, that noise leaves once a pulse is fitted."""
        self.threshold = threshold_sigmas(
            n_bins / self.sigma_bins, false_alarms, noise_is_told=noise_is_told
        )

    def apply(self, samples: Array) -> ComplexArray:
        """Return y of frames of shape (..., n_bins) at every second bin, shape (..., n_steps)."""
        # The negative half of the spectrum is zero, so the other half alone has y's even bins.
        half = np.fft.rfft(samples, self._n_fft)[..., : self._spectrum.size] * self._spectrum
        y: ComplexArray = fft.ifft(half, overwrite_x=True)[..., : self._n_steps]
        return y

    def noise_power(self, power: Array) -> float:
        """Return sigma_y**2 from ``|y|**2`` of one frame, shape (n_steps,)."""
        cells = power[:: self._stride]
        first = _median(cells) / (2 * math.log(2))
        echo = cells > _ECHO_LEVEL * first
        if not echo.any():
            return first
        wide = echo.copy()
        for shift in range(1, _FLANK_CELLS + 1):
            wide[shift:] |= echo[:-shift]
            wide[:-shift] |= echo[shift:]
        quiet = cells[~wide]
        return (
            _median(quiet) / (2 * math.log(2)) if quiet.size * _LEAST_QUIET > cells.size else first
        )


def threshold_sigmas(length_sigmas: float, false_alarms: float, *, noise_is_told: bool) -> float:
    """Return the level, in sigma_y, that noise passes so often in one frame.

    Parameters
    ----------
    length_sigmas
        Length of the frame in envelope sigmas.
    false_alarms
        Mean number of local maxima of noise above the level.
    noise_is_told
        Whether sigma_y is known or estimated from the frame itself.
    """
    rate = length_sigmas / (2 * math.sqrt(math.pi))
    cells = _MEDIAN_EFFICIENCY * length_sigmas / math.sqrt(math.tau)

    def excess(r: float) -> float:
        t = r * r / 2
        tail = t if noise_is_told else cells * math.log1p(t / cells)
        return math.log(rate * r) - tail - math.log(false_alarms)

    # Upcrossings are rarer below the level sigma_y than at it; no threshold lies there.
    return float(brentq(excess, 1.0, 1e6)) if excess(1.0) > 0 else 1.0


def _median(values: Array) -> float:
    middle = values.size // 2
    return float(np.partition(values, middle)[middle])

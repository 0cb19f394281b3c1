"""The pulse of each module, estimated from the echoes that it receives.

An echo of amplitude and phase in one complex number a, at position u, is Re{a q(n - u)} with
q(x) = T(x) exp(j kappa x): carrier, and complex envelope T, which the pulse model takes for a
Gaussian; filters and antennas of a module widen it, skew it and let it ring. T is estimated from
strong isolated echoes, and a frame is then equalised: behind the filter

    G(f) = F_Gauss(f) conj F_T(f) / (|F_T(f)|**2 + delta max |F_T|**2)

(Wiener deconvolution; Gonzalez and Woods, Digital Image Processing, 5.8) an echo is a Gaussian
pulse again, of the width nearest to that of T, and all closed forms of the front end hold.

Echoes
    The strongest peak of a frame that has no other one of ``_LARGEST_NEIGHBOUR`` of its height
    within reach, each radar's at most every third frame and not twice from the same distance. Its
    samples within 9 sigma of the peak are kept as baseband at steps of 0.75 sigma, which hold all
    of the band. At most ``_CAPACITY`` per radar.
Estimate
    Every window is a T + b T' + rest, where b moves the echo. Given T, the two numbers of each
    window are a regression; given them, T is a weighted mean over the windows. The rest is other
    echoes more than noise, so each sample has the weight 1 / (1 + (|rest| / (|a| s))**2) of a
    Cauchy distribution (iteratively reweighted least squares; Holland and Welsch 1977), s the
    median of |rest / a|. The first T is the median of windows turned to amplitude 1.
Error
    The grouped jackknife: windows of a radar that follow on each other see the same neighbours, so
    blocks of them are left out in turn (Efron 1982, chapter 2). Neighbours that last, such as the
    corner beside a wall, or blends where every echo is one, show in none of that, but the windows
    then differ from the estimate: half of the energy that it leaves of three tenths of the windows
    near the peak, less that of noise, is added. All relative to the energy of T.
Choice
    An estimate is used where it differs from the pulse used so far by more than ``_LEAST_CHANGE``
    and ``_ERRORS`` times its own error, so it at least halves the error, and a nominal pulse stays
    what it is. That of all radars together replaces the nominal pulse, that of one radar replaces
    theirs: modules of one kind differ less from each other than from the data sheet.
Origin
    A delay of the pulse and a range cannot be separated. Zero of T is where the nominal filter has
    its peak, so an isolated echo keeps its range when the pulse changes.

All of it depends on the frames alone, in their order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from slam.front_end.pulse import ComplexArray, ModulePulse, PulseModel
from slam.geometry import ReceivedPulse

Array = NDArray[np.float64]

# Samples of an envelope, in envelope sigmas of the nominal pulse: spacing, and how far from zero
_STEP_SIGMAS, _STEPS = 0.75, 12
# Beyond the first distance an envelope is faded out, to nothing at the second [steps].
_FADE_STEPS = 9.5, 12.5
# Half the length of a window in sigmas: an isolated peak has no stronger one within it.
_REACH_SIGMAS = _STEP_SIGMAS * _STEPS
# Least height of an isolated peak, over sigma_y; largest of others within reach, over its own
_LEAST_SNR, _LARGEST_NEIGHBOUR = 30.0, 0.4
# Frames of one radar from one echo to the next, bins that it must have moved, echoes kept
_FRAMES_APART, _BINS_APART, _CAPACITY = 3, 1.0, 150
# Echoes of the first estimate, and how many times as many the next one needs
_FIRST, _MORE = 60, 1.5
_ROUNDS, _GROUPS = 10, 8
# Real error over that of the jackknife, since neighbours last longer than its blocks; least error
_ERROR_SHARE, _LEAST_ERROR = 2.5, 0.015
# Least difference from the pulse used so far, relative, and in standard deviations of the estimate
_LEAST_CHANGE, _ERRORS = 0.05, 2.0
# Steps that are near the peak; quantile of what the estimate leaves of the windows there, and the
# part of that energy which is the estimate's own error
_NEAR_STEPS, _AGREEING, _LEFT_SHARE = 4, 0.3, 0.5
# Noise that the equaliser allows for, as a part of the largest power of the pulse
_REGULARISATION = 3e-3
# Widths of the Gaussian that a pulse is turned into, as a share of the nominal one
_WIDTHS = np.linspace(0.7, 1.5, 161)
# Most Newton steps to the peak of a pulse behind the nominal filter, and a step that is converged
_PEAK_STEPS, _NO_STEP = 20, 1e-10
# Half the length of an equaliser in sigmas; the transform that it comes from is 4 times as long.
_TAPS_SIGMAS = 16.0
_AT_STEPS = np.arange(-_STEPS, _STEPS + 1)
_NOMINAL: ComplexArray = np.exp(-0.5 * (_STEP_SIGMAS * _AT_STEPS) ** 2).astype(np.complex128)
_NEAR = np.abs(_AT_STEPS) <= _NEAR_STEPS
# Power of the noise of a window over sigma_y**2: both bands, and both quadratures
_NOISE_GAIN = 2 * math.sqrt(math.pi) / _STEP_SIGMAS
_ENERGY = float(np.sum(_NOMINAL.real**2))
# Length of the transforms of envelopes; 25 steps moved by a few do not wrap round.
_N_FFT = 64
_RAD_PER_STEP = math.tau * np.fft.fftfreq(_N_FFT)
_FADE = 0.5 + 0.5 * np.cos(
    math.pi
    * np.clip((np.abs(_AT_STEPS) - _FADE_STEPS[0]) / (_FADE_STEPS[1] - _FADE_STEPS[0]), 0, 1)
)
# Added to a scale that may be zero, of windows without noise
_TINY = 1e-9


def _baseband(
    samples: Array, position_bins: float, pulse: PulseModel, bin_length_m: float
) -> ComplexArray:
    """Return the samples around a position as an envelope at 25 steps, carrier turned back.

    ``samples`` (n_bins,) are of one frame. Their band within half the rate of the steps is kept.
    """
    n_fft = 1 << (samples.size - 1).bit_length()
    band, turns = _band(n_fft, pulse.sigma_bins(bin_length_m), pulse.carrier_rad(bin_length_m))
    spectrum = np.fft.rfft(samples, n_fft)[band]
    spectrum *= np.exp(2j * math.pi / n_fft * position_bins * band) * (2 / n_fft)
    window: ComplexArray = np.einsum("mk,k->m", turns, spectrum)
    return window


@lru_cache
def _band(
    n_fft: int, sigma_bins: float, carrier_rad: float
) -> tuple[NDArray[np.intp], ComplexArray]:
    """Return the frequencies that windows hold (k,), and their phases at the steps (25, k)."""
    step_bins = _STEP_SIGMAS * sigma_bins
    carrier = carrier_rad / math.tau
    first = math.ceil((carrier - 0.5 / step_bins) * n_fft)
    last = math.floor((carrier + 0.5 / step_bins) * n_fft)
    band = np.arange(max(first, 1), min(last, n_fft // 2 - 1) + 1)
    turns = np.exp(2j * math.pi * step_bins * np.outer(_AT_STEPS, band / n_fft - carrier))
    return band, turns


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Envelope:
    """An envelope at the 25 steps, 1 behind the nominal filter and there at its peak."""

    samples: ComplexArray  # shape (25,)
    relative_error: float  # norm of its expected error over its own


def _estimate_envelope(windows: ComplexArray, sigma_y: Array) -> _Envelope:
    """Return the envelope that windows (n, 25) of `_baseband` have in common, n >= 3.

    Those with the same neighbours follow on each other; ``sigma_y`` (n,) is the noise of each
    behind the nominal filter.
    """
    first = np.einsum("nk,k->n", windows, _NOMINAL) / _ENERGY
    turned = windows / first[:, np.newaxis]
    envelope = _placed(np.median(turned.real, axis=0) + 1j * np.median(turned.imag, axis=0))
    weights = np.ones(windows.shape)
    for _ in range(_ROUNDS):
        slope = _slope(envelope)
        basis = np.stack([envelope, slope])
        crossed = basis.conj()[:, np.newaxis] * basis
        normal = np.einsum("nk,abk->nab", weights, crossed)
        seen = np.einsum("nk,ak->na", weights * windows, basis.conj())
        factors = np.linalg.solve(normal, seen[..., np.newaxis])[..., 0]
        height = np.abs(factors[:, :1])
        rest = np.abs(windows - np.einsum("na,ak->nk", factors, basis)) / height
        scale = float(np.median(rest)) + _TINY
        weights = 1 / (1 + (rest / scale) ** 2)
        cleared = (windows - factors[:, 1:] * slope) / factors[:, :1]
        weighted = weights * height**2
        envelope = _placed((weighted * cleared).sum(axis=0) / weighted.sum(axis=0))
    energy = float(np.sum(np.abs(envelope[_NEAR]) ** 2))
    noise = _NOISE_GAIN * (sigma_y / height[:, 0]) ** 2 * (np.count_nonzero(_NEAR) - 2)
    left = (np.sum(rest[:, _NEAR] ** 2, axis=1) - noise) / energy
    disagreement = _LEFT_SHARE * max(float(np.quantile(left, _AGREEING)), 0.0)
    variance = _ERROR_SHARE**2 * _jackknife(weighted * cleared, weighted) + disagreement
    error = math.sqrt(variance)
    return _Envelope(samples=envelope, relative_error=max(error, _LEAST_ERROR))


def _jackknife(weighted: ComplexArray, weights: Array) -> float:
    """Return the variance of the envelope of sums over rows (n, 25), relative to its energy."""
    total, norm = weighted.sum(axis=0), weights.sum(axis=0)
    blocks = np.array_split(np.arange(len(weights)), min(_GROUPS, len(weights)))
    without = np.array(
        [
            _placed((total - weighted[rows].sum(axis=0)) / (norm - weights[rows].sum(axis=0)))
            for rows in blocks
        ]
    )
    mean = without.mean(axis=0)
    spread = np.sum(np.abs(without - mean) ** 2) / np.sum(np.abs(mean) ** 2)
    return (len(blocks) - 1) / len(blocks) * float(spread)


def _relative_difference(one: ComplexArray, other: ComplexArray) -> float:
    """Return the norm of the difference of two envelopes (25,) over that of the second."""
    return float(np.linalg.norm(one - other) / np.linalg.norm(other))


def _placed(envelope: ComplexArray) -> ComplexArray:
    """Return an envelope faded out at the ends, moved and scaled: see ``Origin`` above."""
    spectrum = _spectrum(envelope * _FADE)
    filtered = spectrum * _spectrum(_NOMINAL).real
    at = 0.0
    for _ in range(_PEAK_STEPS):
        terms = filtered * np.exp(1j * _RAD_PER_STEP * at)
        value, slope, bend = (complex((terms * (1j * _RAD_PER_STEP) ** k).sum()) for k in range(3))
        climb = (value.conjugate() * slope).real
        fall = abs(slope) ** 2 + (value.conjugate() * bend).real
        if fall >= 0.0:  # not near a peak
            break
        at -= climb / fall
        if abs(climb / fall) < _NO_STEP:
            break
    moved = np.fft.ifft(spectrum * np.exp(1j * _RAD_PER_STEP * at))[_AT_STEPS]
    height = complex((filtered * np.exp(1j * _RAD_PER_STEP * at)).mean())
    placed: ComplexArray = moved * (_ENERGY / height) * _FADE
    return placed


def _slope(envelope: ComplexArray) -> ComplexArray:
    """Return the derivative of an envelope by steps."""
    slope: ComplexArray = np.fft.ifft(1j * _RAD_PER_STEP * _spectrum(envelope))[_AT_STEPS]
    return slope


def _spectrum(envelope: ComplexArray | Array) -> ComplexArray:
    placed = np.zeros(_N_FFT, dtype=np.complex128)
    placed[_AT_STEPS] = envelope
    spectrum: ComplexArray = np.fft.fft(placed)
    return spectrum


def module_pulse(received: ReceivedPulse, nominal: PulseModel, bin_length_m: float) -> ModulePulse:
    """Return what the front end needs to take the echoes of a module with this pulse."""
    envelope = np.array(received.real) + 1j * np.array(received.imaginary)
    at_m = received.step_m * (np.arange(envelope.size) - envelope.size // 2)
    gaussians = np.exp(-0.5 * (at_m / (_WIDTHS[:, np.newaxis] * nominal.sigma_m)) ** 2)
    explained = np.abs(np.einsum("wk,k->w", gaussians, envelope)) ** 2
    explained /= np.sum(gaussians**2, axis=1)
    width = float(_WIDTHS[np.argmax(explained)])
    model = replace(nominal, bandwidth_hz=nominal.bandwidth_hz / width)

    s = model.sigma_bins(bin_length_m)
    half = math.ceil(_TAPS_SIGMAS * nominal.sigma_bins(bin_length_m))
    n_fft = 1 << (4 * half).bit_length()
    cycles = np.fft.rfftfreq(n_fft) - nominal.carrier_rad(bin_length_m) / math.tau
    in_band = np.abs(cycles) < 0.5 * bin_length_m / received.step_m
    turns = np.exp(-2j * math.pi * np.outer(cycles[in_band], at_m / bin_length_m))
    spectrum = received.step_m / bin_length_m * np.einsum("fk,k->f", turns, envelope)
    wanted = math.sqrt(math.tau) * s * np.exp(-2 * (math.pi * s * cycles[in_band]) ** 2)
    power = np.abs(spectrum) ** 2
    transfer = np.zeros(cycles.size, dtype=np.complex128)
    transfer[in_band] = wanted * spectrum.conj() / (power + _REGULARISATION * power.max())
    taps = np.fft.irfft(transfer, n_fft)[np.arange(-half, half + 1)]
    return ModulePulse(model=model, error=received.relative_error, equaliser=taps)


class PulseEstimator:
    """The pulses of the modules of a rig, learnt from their frames.

    ``received`` are those to begin with, by radar; where there is none, or None, the nominal one.
    """

    def __init__(self, nominal: PulseModel, received: Sequence[ReceivedPulse | None] = ()) -> None:
        self._nominal = nominal
        self._received = tuple(received)
        self._common: ReceivedPulse | None = None  # of all radars together
        self._own: dict[int, ReceivedPulse | None] = {}
        self._estimates: dict[int | None, ReceivedPulse] = {}  # by radar; None: of all
        self._echoes: dict[int, list[tuple[ComplexArray, float]]] = {}
        self._waits: dict[int, int] = {}  # frames until the next echo is looked for
        self._last: dict[int, float] = {}  # position of the last one [bins]
        self._needed: dict[int | None, int] = {}  # echoes for the next estimate, by radar or of all

    def pulse(self, radar: int) -> ReceivedPulse | None:
        """Return the pulse that the frames of a radar are equalised by; None: the nominal one."""
        return self._own.get(radar) or self._before_own(radar)

    def estimate(self, radar: int | None) -> ReceivedPulse | None:
        """Return the last estimate of a radar's own pulse, or that of all; None: too few echoes."""
        return self._estimates.get(radar)

    def off_nominal(self, pulse: ReceivedPulse) -> float:
        """Return the norm of the difference of a pulse from the nominal one, relative to that."""
        return _relative_difference(self._at_steps(pulse), _NOMINAL)

    def echoes(self, radar: int) -> int:
        """Return how many echoes of a radar have been taken."""
        return len(self._echoes.get(radar, ()))

    def is_due(self, radar: int) -> bool:
        """Return whether `take` would use an echo of this frame of a radar; call once per frame."""
        wait = self._waits.get(radar, 0)
        self._waits[radar] = max(0, wait - 1)
        return not wait and len(self._echoes.get(radar, ())) < _CAPACITY

    def take(
        self,
        radar: int,
        samples: Array,
        bin_length_m: float,
        *,
        position_bins: Array,
        amplitude: Array,
        sigma_y: float,
    ) -> bool:
        """Take the best echo of a frame, if it has one, and return whether a pulse has changed.

        ``samples`` (n_bins,) are without their mean and not equalised, all usable;
        ``position_bins`` and ``amplitude`` (k,) are its peaks behind the filter, ``sigma_y`` the
        noise there.
        """
        at = _isolated_peak(
            position_bins,
            amplitude,
            _LEAST_SNR * sigma_y,
            _REACH_SIGMAS * self._nominal.sigma_bins(bin_length_m),
            samples.size,
        )
        if at is None:
            return False
        position = float(position_bins[at])
        if abs(position - self._last.get(radar, -math.inf)) < _BINS_APART:
            return False
        self._last[radar] = position
        self._waits[radar] = _FRAMES_APART - 1
        window = _baseband(samples, position, self._nominal, bin_length_m)
        self._echoes.setdefault(radar, []).append((window, sigma_y))
        return self._learn(None) | self._learn(radar)

    def _learn(self, radar: int | None) -> bool:
        """Estimate the pulse of one radar, or of all, once there are enough new echoes."""
        radars = sorted(self._echoes) if radar is None else [radar]
        echoes = [echo for each in radars for echo in self._echoes[each]]
        if len(echoes) < self._needed.get(radar, _FIRST):
            return False
        self._needed[radar] = math.ceil(_MORE * len(echoes))
        windows, sigma_y = (np.array(column) for column in zip(*echoes, strict=True))
        envelope = _estimate_envelope(windows, sigma_y)
        step_m = _STEP_SIGMAS * self._nominal.sigma_m
        estimate = ReceivedPulse(
            step_m=step_m,
            real=tuple(envelope.samples.real.tolist()),
            imaginary=tuple(envelope.samples.imag.tolist()),
            relative_error=envelope.relative_error,
        )
        self._estimates[radar] = estimate
        if radar is None:
            before, self._common = self._common, self._choice(estimate, envelope, None)
            return self._common is not before
        before = self._own.get(radar)
        own = self._choice(estimate, envelope, self._before_own(radar))
        self._own[radar] = own
        return own is not before

    def _choice(
        self, estimate: ReceivedPulse, envelope: _Envelope, before: ReceivedPulse | None
    ) -> ReceivedPulse | None:
        """Return the estimate if it is significantly different from the pulse before, or None."""
        error = math.hypot(estimate.relative_error, before.relative_error if before else 0.0)
        change = _relative_difference(envelope.samples, self._at_steps(before))
        return estimate if change > max(_LEAST_CHANGE, _ERRORS * error) else None

    def _before_own(self, radar: int) -> ReceivedPulse | None:
        """Return the pulse of a radar without an estimate of its own; None: the nominal one."""
        received = self._received[radar] if radar < len(self._received) else None
        return received or self._common

    def _at_steps(self, pulse: ReceivedPulse | None) -> ComplexArray:
        """Return the envelope of a pulse at the 25 steps; None: the nominal one."""
        if pulse is None:
            return _NOMINAL
        samples: ComplexArray = np.array(pulse.real) + 1j * np.array(pulse.imaginary)
        half = samples.size // 2
        # band-limited interpolation; the samples may have another step
        at = _STEP_SIGMAS * self._nominal.sigma_m / pulse.step_m * _AT_STEPS
        weights = np.sinc(at[:, np.newaxis] - np.arange(-half, half + 1))
        envelope: ComplexArray = np.einsum("mk,k->m", weights, samples)
        return envelope


def _isolated_peak(
    position_bins: Array, amplitude: Array, least_amplitude: float, reach: float, n_bins: int
) -> int | None:
    """Return the strongest peak isolated within ``reach`` [bins], ends included; None: no such."""
    for at in np.argsort(-amplitude, kind="stable"):
        if amplitude[at] < least_amplitude:
            return None
        position = position_bins[at]
        if not reach <= position <= n_bins - 1 - reach:
            continue
        near = np.abs(position_bins - position) < reach
        near[at] = False
        if not near.any() or amplitude[near].max() <= _LARGEST_NEIGHBOUR * amplitude[at]:
            return int(at)
    return None

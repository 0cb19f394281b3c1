"""Front ends that know the pulse: ``matched_filter`` and ``joint``.

A frame x is correlated with the analytic pulse p of :mod:`slam.front_end.pulse`, by FFT,

    y[n] = (2 / E) sum_m x[m] conj(p(m - n)),   E = sum_m |p(m)|**2

at every second bin n: y has no negative frequencies, so half its samples hold all of it. An echo
A Re{p(n - u) exp(j phi)} alone gives, with s the envelope's sigma in bins,

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
    all powers has K = N / (sqrt(2 pi) s), a median the part ``_MEDIAN_EFFICIENCY`` of that.
Echoes
    The local maxima of the magnitude of y above the threshold. The logarithm of the magnitude is a
    parabola around an echo: the vertex through three of its values is the position, and its scatter
    is the Cramer-Rao bound of the position with unknown amplitude and phase
    (``PulseModel.position_bound_bins``).
Misfit
    Energy of y minus the fitted pulses at nine points within 2 s of the peak (s the envelope's
    sigma), over what is expected there:

        sigma_y**2 n + m**2 E,   E = sum over points n and echoes k of A_k**2 rho(n - u_k)**2

    n is what noise leaves when amplitude, phase and position are fitted, per point
    2 - (2 + d**2 / (2 s**2)) rho(d)**2, d the distance from the peak; m is what a wrong pulse
    leaves near the peak as a share of the echo, ``_NEAR_PEAK`` times the pulse's relative error.
Deviation
    The bound above with the noise raised by what the wrong pulse of every other echo leaves at
    this one: sigma_y**2 + m**2 sum over k of A_k**2 rho(u - u_k)**2. The echo's own wrong pulse
    shifts every echo of a module alike: that is part of its range offset.
Joint
    Where peaks overlap or one is not one pulse, and the misfit is more than the pulse's own
    uncertain shape leaves, :mod:`slam.front_end.overlapping` decides how many echoes there are and
    where, with all other echoes of the frame subtracted; likewise where samples within 3 s of a
    peak are missing, saturated or beyond an end of the frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.optimize import brentq

from slam.config import FrontEnd, SlamConfig
from slam.frames import Detection, RadarFrame, reaches_limits, usable_samples
from slam.front_end.overlapping import (
    REACH_STEPS,
    Correlation,
    KnownPulse,
    SplitTest,
    fit_echoes,
    fit_whole_echoes,
)
from slam.front_end.pulse import ComplexArray, ModulePulse, PulseModel
from slam.front_end.pulse_estimation import PulseEstimator, module_pulse
from slam.geometry import ReceivedPulse

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_PROBES = np.linspace(-2.0, 2.0, 9)
# Bins from one value of y to the next.
BINS_PER_STEP = 2
# Distance of the samples that the noise is taken from, in envelope sigmas
_STRIDE_SIGMAS = 0.75
# No threshold is so high, in standard deviations of the noise.
_LARGEST_THRESHOLD = 1e6
# Variance of a mean of exponential powers, correlated by rho**2, over that of their median / ln 2;
# (ln 2)**2 if they were independent. A series of Laguerre polynomials gives it, see its test.
_MEDIAN_EFFICIENCY = 0.643
# Cells this many times the first guess of sigma_y**2 hold an echo, and so do two on either side.
_ECHO_LEVEL = 3.5**2
_FLANK_CELLS = 2
# Below one part in so many of its cells left, a frame is taken as a whole.
_LEAST_QUIET = 8
# Samples this far from a peak, in envelope sigmas, belong to it: beyond, 1 % of its height.
_REACH = 3.0
# Peaks closer than this, in envelope sigmas, overlap: rho there is 1 %.
OVERLAP = 4.3
# Samples fitted on either side of a group, also beyond an end of the frame, in envelope sigmas. A
# weak echo nearer than that to a strong one makes no peak of its own.
_MARGIN = 5.0
_SEARCH = 3.5
# With fewer usable samples than this many envelope sigmas a fit says nothing.
_LEAST_SAMPLES = 2.0
# Behind the filter an echo is wider: beyond, 1e-7 of its height.
_FILTERED_REACH = 8.0
# Columns of a table of echoes.
_POSITION, _AMPLITUDE, _PHASE, _SIGMA = range(4)
# Most echoes that a group is taken apart into.
_MAX_ECHOES = 4
# What a wrong pulse may leave near the peak of one that is fitted, over its relative error: 0.46 to
# 0.50 for a wrong width, 0.27 for skew, 0.37 for ringing, 0.45 for all of them; and a quarter more
_NEAR_PEAK = 0.625
_NEIGHBOURS = np.array([[-1], [0], [1]])
# A float32 frame says its samples to this part of the largest; noise is never less.
_RESOLUTION = float(np.finfo(np.float32).eps)


class PulseFilter:
    """Correlation of frames of one length with the pulse of one module.

    ``false_alarms`` and ``noise_is_known`` are those of `threshold_sigmas`.
    """

    def __init__(
        self,
        module: ModulePulse,
        n_bins: int,
        bin_length_m: float,
        *,
        false_alarms: float,
        noise_is_known: bool,
    ) -> None:
        pulse, taps = module.model, module.equaliser
        half = pulse.half_length(bin_length_m)
        template = pulse.samples(np.zeros(1), bin_length_m)[0]
        energy = float(np.sum(np.abs(template) ** 2))
        self.pulse = pulse
        self.n_bins = n_bins
        self.bin_length_m = bin_length_m
        self.sigma_bins = pulse.sigma_bins(bin_length_m)
        self.carrier_rad = pulse.carrier_rad(bin_length_m)
        reach = n_bins + half + (0 if taps is None else taps.size // 2)
        # The next power of two, or three quarters of it: transforms of other lengths are slower.
        power_of_two = 1 << (reach - 1).bit_length()
        enough = power_of_two // 4 * 3 >= reach
        self._n_fft = power_of_two // 4 * 3 if enough else power_of_two
        placed = np.zeros(self._n_fft, dtype=np.complex128)
        placed[np.arange(-half, half + 1)] = template * (2 / energy)
        # The whole spectrum at once is real: the pulse is even but for its carrier.
        spectrum = np.fft.fft(placed).real
        self.noise_gain = math.sqrt(2 / energy)
        """sigma_y over sigma of white noise per RF sample, behind the equaliser if there is one."""
        self.told_noise_gain = self.noise_gain
        """The same before the equaliser."""
        self._equaliser: ComplexArray | None = None
        if taps is not None:
            kernel = np.zeros(self._n_fft)
            kernel[np.arange(taps.size) - taps.size // 2] = taps
            self._equaliser = np.fft.rfft(kernel)
            both = np.abs(spectrum * np.fft.fft(kernel)) ** 2
            self.told_noise_gain = math.sqrt(0.5 * float(np.mean(both)))
        self._spectrum = spectrum[: self._n_fft // BINS_PER_STEP] / BINS_PER_STEP
        self._n_steps = math.ceil(n_bins / BINS_PER_STEP)
        self._stride = max(1, int(_STRIDE_SIGMAS * self.sigma_bins / BINS_PER_STEP))
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
        self.pulse_error = module.error
        self.left_near_peak = _NEAR_PEAK * module.error
        """What a wrong pulse leaves near the peak, relative to the amplitude."""
        self.threshold = threshold_sigmas(
            n_bins / self.sigma_bins, false_alarms, noise_is_known=noise_is_known
        )

    def apply(self, samples: Array) -> ComplexArray:
        """Return y of frames of shape (..., n_bins) at every second bin, shape (..., n_steps)."""
        # The negative half of the spectrum is zero, so the other half alone has y's even bins.
        half = np.fft.rfft(samples, self._n_fft)[..., : self._spectrum.size] * self._spectrum
        y: ComplexArray = fft.ifft(half, overwrite_x=True)[..., : self._n_steps]
        return y

    def equalised(self, samples: Array) -> Array:
        """Return one frame, shape (n_bins,), as if the module's pulse were the fitted one."""
        if self._equaliser is None:
            return samples
        spectrum = np.fft.rfft(samples, self._n_fft) * self._equaliser
        return np.fft.irfft(spectrum, self._n_fft)[: self.n_bins]

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


def threshold_sigmas(length_sigmas: float, false_alarms: float, *, noise_is_known: bool) -> float:
    """Return the level, in sigma_y, with ``false_alarms`` local maxima of noise above it per frame.

    ``length_sigmas`` is the length of the frame in envelope sigmas; ``noise_is_known``: sigma_y is
    not estimated from the frame itself.
    """
    rate = length_sigmas / (2 * math.sqrt(math.pi))
    cells = _MEDIAN_EFFICIENCY * length_sigmas / math.sqrt(math.tau)

    def excess(r: float) -> float:
        t = r * r / 2
        tail = t if noise_is_known else cells * math.log1p(t / cells)
        return math.log(rate * r) - tail - math.log(false_alarms)

    # Upcrossings are rarer below the level sigma_y than at it; no threshold lies there.
    return float(brentq(excess, 1.0, _LARGEST_THRESHOLD)) if excess(1.0) > 0 else 1.0


def _median(values: Array) -> float:
    middle = values.size // 2
    return float(np.partition(values, middle)[middle])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Peaks:
    """Echoes of one frame, k of them, nearest first; every array has shape (k,)."""

    position_bins: Array  # from sample 0
    amplitude: Array  # of the pulse, in the unit of the samples
    phase_rad: Array  # of the carrier at the position, up to whole turns
    sigma_bins: Array  # predicted standard deviation of the position
    misfit: Array  # unexplained over expected energy near the peak
    saturated: BoolArray  # whether samples within reach of the peak were missing inside the frame


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Filtered:
    """One frame behind the filter."""

    samples: Array  # shape (n_bins,): mean removed, unknown samples zero
    # shape (n_bins,): samples that are known and not at a limit of the sampler; None: all
    usable: BoolArray | None
    y: ComplexArray  # shape (n_steps,), complex: correlation with the pulse, at every second bin
    power: Array  # shape (n_steps,): squared magnitude of y
    sigma_y: float  # standard deviation of its noise, per quadrature
    pulse_filter: PulseFilter


def cut_pulses(position_bins: Array, filtered: Filtered) -> BoolArray | None:
    """Return which peaks miss samples within their reach, shape (k,); None where none does."""
    first = _REACH * filtered.pulse_filter.sigma_bins
    last = filtered.pulse_filter.n_bins - 1 - first
    if not position_bins.size:
        return None
    if filtered.usable is None and position_bins[0] >= first and position_bins[-1] <= last:
        return None
    beyond_an_end: BoolArray = (position_bins < first) | (position_bins > last)
    return beyond_an_end | saturated_pulses(position_bins, filtered)


def saturated_pulses(position_bins: Array, filtered: Filtered) -> BoolArray:
    """Return which peaks miss samples inside the frame within their reach, shape (k,)."""
    if filtered.usable is None:
        return np.zeros(position_bins.size, dtype=np.bool_)
    reach = _REACH * filtered.pulse_filter.sigma_bins
    missing = np.flatnonzero(~filtered.usable)
    first = np.searchsorted(missing, position_bins - reach)
    beyond: BoolArray = first < np.searchsorted(missing, position_bins + reach)
    return beyond


def refit(peaks: Peaks, again: BoolArray, filtered: Filtered, split: SplitTest) -> Peaks:
    """Return the peaks with those ``again`` (k,), and those that overlap with them, fitted anew.

    ``split.max_echoes`` 1 leaves each peak one echo.
    """
    pulse_filter = filtered.pulse_filter
    table = np.column_stack(
        [peaks.position_bins, peaks.amplitude, peaks.phase_rad, peaks.sigma_bins]
    )
    linked = OVERLAP * pulse_filter.sigma_bins if split.max_echoes > 1 else 0.0
    starts = np.flatnonzero(np.diff(peaks.position_bins) > linked) + 1
    groups = []
    for members in np.split(np.arange(len(table)), starts):
        group = table[members]
        if again[members].any():
            others = np.delete(table, members, axis=0)
            group = _fitted(group, others, filtered, split)
        groups.append(group)
    table = np.concatenate(groups)
    inside = (table[:, _POSITION] >= -0.5) & (table[:, _POSITION] < pulse_filter.n_bins - 0.5)
    table = table[inside & (table[:, _AMPLITUDE] > pulse_filter.threshold * filtered.sigma_y)]
    table = table[np.argsort(table[:, _POSITION])]
    return Peaks(
        position_bins=table[:, _POSITION],
        amplitude=table[:, _AMPLITUDE],
        phase_rad=table[:, _PHASE],
        sigma_bins=table[:, _SIGMA],
        misfit=_misfit(table, filtered),
        saturated=saturated_pulses(table[:, _POSITION], filtered),
    )


def _fitted(group: Array, others: Array, filtered: Filtered, split: SplitTest) -> Array:
    """Return the echoes near a group of peaks; the group where no sample is usable."""
    pulse_filter = filtered.pulse_filter
    margin = _MARGIN * pulse_filter.sigma_bins
    first = int(np.floor(group[0, _POSITION] - margin))
    last = int(np.ceil(group[-1, _POSITION] + margin))
    inside = slice(max(first, 0), min(last + 1, pulse_filter.n_bins))
    usable = np.zeros(last + 1 - first, dtype=np.bool_)
    known = slice(inside.start - first, inside.stop - first)
    usable[known] = True if filtered.usable is None else filtered.usable[inside]
    if usable.all():
        return _fitted_whole(group, others, filtered, split)
    if np.count_nonzero(usable) < _LEAST_SAMPLES * pulse_filter.sigma_bins:
        return group
    window = np.zeros(usable.size)
    window[known] = filtered.samples[inside] - _render(others, pulse_filter)[inside]
    # Echoes are looked for near the peaks, and as far beyond an end of the frame as it was cut.
    edge = margin - _SEARCH * pulse_filter.sigma_bins
    search_bins = (
        0.0 if first < 0 else edge,
        window.size - 1 - (0.0 if last >= pulse_filter.n_bins else edge),
    )
    fits = fit_echoes(
        window,
        pulse=KnownPulse(
            envelope_sigma_bins=pulse_filter.sigma_bins,
            carrier_rad_per_bin=pulse_filter.carrier_rad,
        ),
        noise_sigma=filtered.sigma_y / pulse_filter.noise_gain,
        usable=usable,
        search_bins=search_bins,
        split=split,
    )
    table = np.array(fits)
    table[:, _POSITION] += first
    return table


def _fitted_whole(group: Array, others: Array, filtered: Filtered, split: SplitTest) -> Array:
    pulse_filter = filtered.pulse_filter
    search = _SEARCH * pulse_filter.sigma_bins
    # one step more than z is interpolated from, rounding included
    first = int((group[0, _POSITION] - search) / BINS_PER_STEP) - REACH_STEPS - 1
    last = int((group[-1, _POSITION] + search) / BINS_PER_STEP) + REACH_STEPS + 2
    steps = np.arange(max(first, 0), min(last + 1, filtered.y.size))
    begin = BINS_PER_STEP * float(steps[0])
    z = filtered.y[steps] - _correlated(others, steps, pulse_filter)
    z *= np.exp(-1j * pulse_filter.carrier_rad * (BINS_PER_STEP * steps - begin))
    fits = fit_whole_echoes(
        Correlation(
            z,
            step_bins=BINS_PER_STEP,
            sigma_bins=pulse_filter.sigma_bins,
            sigma_y=filtered.sigma_y,
        ),
        group[0, _POSITION] - search - begin,
        group[-1, _POSITION] + search - begin,
        split,
    )
    table = np.array(fits)
    table[:, _PHASE] += pulse_filter.carrier_rad * table[:, _POSITION]
    table[:, _POSITION] += begin
    return table


def _correlated(table: Array, steps: NDArray[np.intp], pulse_filter: PulseFilter) -> ComplexArray:
    """Return whole echoes behind the filter, at steps of y; the shape of the steps."""
    reach = _FILTERED_REACH * pulse_filter.sigma_bins
    begin, end = BINS_PER_STEP * steps[0] - reach, BINS_PER_STEP * steps[-1] + reach
    near = table[(table[:, _POSITION] > begin) & (table[:, _POSITION] < end)]
    away = BINS_PER_STEP * steps - near[:, _POSITION, np.newaxis]
    pulses = np.exp(
        -0.25 * (away / pulse_filter.sigma_bins) ** 2
        + 1j * (pulse_filter.carrier_rad * away + near[:, _PHASE, np.newaxis])
    )
    summed: ComplexArray = near[:, _AMPLITUDE] @ pulses
    return summed


def _render(table: Array, pulse_filter: PulseFilter) -> Array:
    """Return the sum of echoes, shape (n_bins,)."""
    nearest = np.rint(table[:, _POSITION])
    pulses = (
        pulse_filter.pulse.samples(table[:, _POSITION] - nearest, pulse_filter.bin_length_m)
        * (table[:, _AMPLITUDE] * np.exp(1j * table[:, _PHASE]))[:, np.newaxis]
    )
    half = pulses.shape[1] // 2
    bins = nearest.astype(np.intp)[:, np.newaxis] + np.arange(-half, half + 1)
    seen = (bins >= 0) & (bins < pulse_filter.n_bins)
    total = np.bincount(bins[seen], weights=pulses.real[seen], minlength=pulse_filter.n_bins)
    return total.astype(np.float64, copy=False)  # of nothing, bincount answers integers


def _misfit(table: Array, filtered: Filtered) -> Array:
    """Return the misfit of each echo where all echoes together are the model."""
    if not len(table):
        return np.empty(0)
    pulse_filter = filtered.pulse_filter
    nearest = np.rint(table[:, _POSITION] / BINS_PER_STEP).astype(np.intp)
    steps = nearest[:, np.newaxis] + pulse_filter.probes
    reach = pulse_filter.pulse.half_length(pulse_filter.bin_length_m)
    at = BINS_PER_STEP * steps.astype(np.float64)
    first, last = table[[0, -1], _POSITION]
    if filtered.usable is None and first >= reach and last < pulse_filter.n_bins - reach:
        steps = steps.ravel()
        left = filtered.y[steps] - _correlated(table, steps, pulse_filter)
        left = left.reshape(len(table), -1)
    else:
        residual = filtered.samples - _render(table, pulse_filter)
        if filtered.usable is not None:
            residual *= filtered.usable
        left = pulse_filter.apply(residual).take(steps, mode="clip")
    energy: Array = np.sum(left.real**2 + left.imag**2, axis=1)
    return energy / _expected(table[:, _POSITION], table[:, _AMPLITUDE], at, filtered)


def _expected(position_bins: Array, amplitude: Array, at: Array, filtered: Filtered) -> Array:
    """Return the energy that noise and a wrong pulse leave at points (k, n) [bins], shape (k,)."""
    pulse_filter = filtered.pulse_filter
    wrong = pulse_filter.left_near_peak**2 * _echo_power(
        position_bins, amplitude, at, pulse_filter
    ).sum(axis=1)
    expected: Array = filtered.sigma_y**2 * pulse_filter.probe_noise + wrong
    return expected


def _echo_power(
    position_bins: Array, amplitude: Array, at: Array, pulse_filter: PulseFilter
) -> Array:
    """Return the sum of A**2 rho**2 of all echoes at positions [bins] of any shape."""
    away = (at[..., np.newaxis] - position_bins) / pulse_filter.sigma_bins
    power: Array = np.exp(-0.5 * away**2) @ amplitude**2
    return power


def _raised_by_neighbours(peaks: Peaks, filtered: Filtered) -> Array:
    """Return by what a wrong pulse of the others raises each deviation, shape (k,)."""
    at, amplitude = peaks.position_bins, peaks.amplitude
    others = _echo_power(at, amplitude, at, filtered.pulse_filter)
    others = np.maximum(others - amplitude**2, 0.0)
    wrong = (filtered.pulse_filter.left_near_peak / filtered.sigma_y) ** 2 * others
    raised: Array = np.sqrt(1 + wrong)
    return raised


class MatchedFilterDetector:
    """Echoes by correlation; under ``joint``, overlapping ones fitted together."""

    def __init__(self, config: SlamConfig, received: Sequence[ReceivedPulse | None] = ()) -> None:
        """Take each radar's pulse from its rig file to begin with, and learn it from then on."""
        settings = config.matched_filter
        self.config = config
        self._nominal = ModulePulse(
            model=PulseModel(carrier_hz=settings.carrier_hz, bandwidth_hz=settings.bandwidth_hz),
            error=settings.model_error,
        )
        self.estimator = PulseEstimator(self._nominal.model, received)
        self._joint = config.detection.front_end is FrontEnd.JOINT
        self._filters: dict[tuple[int, int, float], PulseFilter] = {}

    def detect(self, frame: RadarFrame, range_offset_m: float = 0.0) -> tuple[Detection, ...]:
        limits = self.config.detection
        start_m = frame.range_start_m - range_offset_m
        peaks = self.peaks(frame, (limits.min_range_m - start_m, limits.max_range_m - start_m))
        ranges_m = start_m + peaks.position_bins * frame.bin_length_m
        columns = zip(
            ranges_m.tolist(),
            peaks.amplitude.tolist(),
            peaks.phase_rad.tolist(),
            (peaks.sigma_bins * frame.bin_length_m).tolist(),
            peaks.misfit.tolist(),
            peaks.saturated.tolist(),
            strict=True,
        )
        return tuple(
            Detection(
                radar=frame.radar,
                t_ns=frame.t_ns,
                range_m=range_m,
                amplitude=amplitude,
                phase_rad=math.remainder(phase_rad, math.tau),
                sigma_m=sigma_m,
                misfit=misfit,
                saturated=saturated,
            )
            for range_m, amplitude, phase_rad, sigma_m, misfit, saturated in columns
            if limits.min_range_m <= range_m <= limits.max_range_m
        )

    def detect_many(
        self, frames: Sequence[RadarFrame], offsets_m: Sequence[float]
    ) -> list[tuple[Detection, ...]]:
        return [self.detect(*each) for each in zip(frames, offsets_m, strict=True)]

    def peaks(self, frame: RadarFrame, within_m: tuple[float, float]) -> Peaks:
        """Return every echo of a frame, whatever its range.

        Only echoes that lie ``within_m``, from the first bin on [m], or overlap with one that may,
        are fitted anew.
        """
        filtered = self._filtered(frame)
        peaks = self._fitted_peaks(frame, filtered, within_m)
        if not peaks.position_bins.size:
            return peaks
        return replace(peaks, sigma_bins=peaks.sigma_bins * _raised_by_neighbours(peaks, filtered))

    def _fitted_peaks(
        self, frame: RadarFrame, filtered: Filtered, within_m: tuple[float, float]
    ) -> Peaks:
        pulse_filter = filtered.pulse_filter
        found, several = _single_pulses(filtered, self.config.matched_filter.max_single_misfit)
        self._learn(frame, filtered, found)
        again = cut_pulses(found.position_bins, filtered)
        if self._joint:
            again = several if again is None else again | several
        if again is None:
            return found
        reach = OVERLAP * pulse_filter.sigma_bins
        again &= found.position_bins > within_m[0] / pulse_filter.bin_length_m - reach
        again &= found.position_bins < within_m[1] / pulse_filter.bin_length_m + reach
        if not again.any():
            return found
        split = SplitTest(
            max_echoes=_MAX_ECHOES if self._joint else 1,
            model_error=pulse_filter.pulse_error,
        )
        return refit(found, again, filtered, split)

    def learn(self, frame: RadarFrame) -> None:
        """Let the pulse be estimated from a frame whose echoes are not asked for."""
        filtered = self._filtered(frame)
        found, _ = _single_pulses(filtered, math.inf)
        self._learn(frame, filtered, found)

    def _learn(self, frame: RadarFrame, filtered: Filtered, peaks: Peaks) -> None:
        """Let the pulse be estimated from this frame, too; a change holds from the next one on."""
        if filtered.usable is not None or not self.estimator.is_due(frame.radar):
            return
        samples = frame.samples.astype(np.float64)
        samples -= np.add.reduce(samples) / samples.size
        has_changed = self.estimator.take(
            frame.radar,
            samples,
            frame.bin_length_m,
            position_bins=peaks.position_bins,
            amplitude=peaks.amplitude,
            sigma_y=filtered.sigma_y,
        )
        if has_changed:
            self._filters.clear()

    def _filter(self, frame: RadarFrame) -> PulseFilter:
        key = frame.radar, frame.samples.size, frame.bin_length_m
        if key not in self._filters:
            settings = self.config.matched_filter
            received = self.estimator.pulse(frame.radar)
            self._filters[key] = PulseFilter(
                self._nominal
                if received is None
                else module_pulse(received, self._nominal.model, frame.bin_length_m),
                *key[1:],
                false_alarms=settings.false_alarms_per_frame,
                noise_is_known=settings.noise_sigma > 0,
            )
        return self._filters[key]

    def _filtered(self, frame: RadarFrame) -> Filtered:
        pulse_filter = self._filter(frame)
        samples = frame.samples.astype(np.float64)
        lowest, highest = float(samples.min()), float(samples.max())
        usable = None
        if math.isnan(lowest) or reaches_limits(frame, lowest, highest):
            usable = usable_samples(frame)
            samples[np.isnan(samples)] = 0.0
            lowest, highest = float(samples.min()), float(samples.max())
        # A constant frame must come out as nothing, not as the two steps at its ends.
        samples -= np.add.reduce(samples) / samples.size
        samples = pulse_filter.equalised(samples)
        y = pulse_filter.apply(samples)
        power = y.real**2 + y.imag**2
        configured = self.config.matched_filter.noise_sigma
        sigma_y = configured * pulse_filter.told_noise_gain
        if not configured:
            sigma_y = math.sqrt(pulse_filter.noise_power(power))
        sigma_y = max(sigma_y, _RESOLUTION * max(highest, -lowest))
        return Filtered(
            samples=samples,
            usable=usable,
            y=y,
            power=power,
            sigma_y=sigma_y,
            pulse_filter=pulse_filter,
        )


def _single_pulses(filtered: Filtered, max_misfit: float) -> tuple[Peaks, BoolArray]:
    """Return every peak as one pulse, and which leave more than noise and a wrong pulse would."""
    y, power, sigma_y = filtered.y, filtered.power, filtered.sigma_y
    pulse_filter = filtered.pulse_filter
    at = (power[1:-1] > (pulse_filter.threshold * sigma_y) ** 2).nonzero()[0] + 1
    near = power.take(at + _NEIGHBOURS)
    highest = (near[1] > near[0]) & (near[1] >= near[2])
    at = at[highest]
    before, middle, after = np.log(near[:, highest])
    offset = 0.5 * BINS_PER_STEP * (before - after) / (before - 2 * middle + after)
    s, kappa = pulse_filter.sigma_bins, pulse_filter.carrier_rad
    at_peak = y[at]
    height = np.abs(at_peak)
    amplitude = height * np.exp((offset / (2 * s)) ** 2)

    # Turned back by the peak's phase and the carrier, a pulse is real.
    around = y.take(at[:, np.newaxis] + pulse_filter.probes, mode="clip")
    around *= pulse_filter.probe_turns
    around *= (at_peak.conj() / height)[:, np.newaxis]
    away = pulse_filter.probe_sigmas - (offset / s)[:, np.newaxis]
    around -= amplitude[:, np.newaxis] * np.exp(-0.25 * (away * away))
    left = np.vecdot(around, around).real
    several = left > max_misfit * sigma_y**2 * pulse_filter.probe_noise
    several &= left > pulse_filter.left_near_peak**2 * pulse_filter.probe_energy * amplitude**2

    position = BINS_PER_STEP * at + offset
    phase = np.arctan2(at_peak.imag, at_peak.real) + kappa * offset
    sigma = math.sqrt(2) * s * sigma_y / amplitude
    probed = BINS_PER_STEP * (at[:, np.newaxis] + pulse_filter.probes).astype(np.float64)
    peaks = Peaks(
        position_bins=position,
        amplitude=amplitude,
        phase_rad=phase,
        sigma_bins=sigma,
        misfit=left / _expected(position, amplitude, probed, filtered),
        saturated=np.zeros(at.size, dtype=np.bool_),
    )
    return peaks, several

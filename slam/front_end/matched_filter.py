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
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy import fft
from scipy.optimize import brentq

from slam.config import FrontEnd, SlamConfig
from slam.frames import (
    Detection,
    RadarFrame,
    StepInputError,
    reaches_limits,
    usable_samples,
)
from slam.front_end import kernels
from slam.front_end.kernels import (
    AMPLITUDE,
    BINS_PER_STEP,
    COLUMNS,
    PHASE,
    POSITION,
    SEVERAL,
)
from slam.front_end.overlapping import KnownPulse, SplitTest, fit_echoes, fit_whole_echoes
from slam.front_end.pulse import ComplexArray, ModulePulse, nominal_pulse
from slam.front_end.pulse_estimation import PulseEstimator, module_pulse
from slam.geometry import ReceivedPulse

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_PROBES = np.linspace(-2.0, 2.0, 9)
# Distance of the samples that the noise is taken from, in envelope sigmas
_STRIDE_SIGMAS = 0.75
# No threshold is so high, in standard deviations of the noise.
_LARGEST_THRESHOLD = 1e6
# Variance of a mean of exponential powers, correlated by rho**2, over that of their median / ln 2;
# (ln 2)**2 if they were independent. A series of Laguerre polynomials gives it, see its test.
_MEDIAN_EFFICIENCY = 0.643
# Samples this far from a peak, in envelope sigmas, belong to it: beyond, 1 % of its height.
_REACH = 3.0
# Peaks closer than this, in envelope sigmas, overlap: rho there is 1 %.
OVERLAP = 4.3
# Samples fitted on either side of a group, also beyond an end of the frame, in envelope sigmas. A
# weak echo nearer than that to a strong one makes no peak of its own.
_MARGIN = 5.0
_SEARCH = 3.5
# A fit needs usable samples over at least this many envelope sigmas.
_LEAST_SAMPLES = 2.0
# What a wrong pulse may leave near the peak of one that is fitted, over its relative error: 0.46 to
# 0.50 for a width 10 or 15 % off, less for skew, ringing and all of them together; a quarter more
_NEAR_PEAK = 0.625
# Resolution of a float32 frame, as a part of its largest sample; sigma_y is never less.
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
        self.known = KnownPulse(
            envelope_sigma_bins=self.sigma_bins, carrier_rad_per_bin=self.carrier_rad
        )
        self.n_fft = _transform_length(n_bins + half + (0 if taps is None else taps.size // 2))
        placed = np.zeros(self.n_fft, dtype=np.complex128)
        placed[np.arange(-half, half + 1)] = template * (2 / energy)
        # The whole spectrum at once is real: the pulse is even but for its carrier.
        spectrum = np.fft.fft(placed).real
        self.noise_gain = math.sqrt(2 / energy)
        """sigma_y over sigma of white noise per equalised sample."""
        self.raw_noise_gain = self.noise_gain
        """sigma_y over sigma of white noise per sample of the module, before the equaliser."""
        self._spectrum = (spectrum[: self.n_fft // 2] / BINS_PER_STEP).astype(np.complex128)
        self.n_steps = math.ceil(n_bins / BINS_PER_STEP)
        self._equaliser = None if taps is None else _spectrum_of(taps, self.n_fft)
        self.spectrum = self._spectrum
        """Equaliser and filter together: factors on the first half of `numpy.fft.rfft`."""
        if self._equaliser is not None:
            self.spectrum = self._spectrum * self._equaliser[: self._spectrum.size]
            power = float(np.sum(np.abs(BINS_PER_STEP * self.spectrum) ** 2)) / self.n_fft
            self.raw_noise_gain = math.sqrt(0.5 * power)
        self.table = np.empty((self.n_steps // 2 + 1, COLUMNS))
        """Where the peaks of a frame are written."""
        self.stride = max(1, int(_STRIDE_SIGMAS * self.sigma_bins / BINS_PER_STEP))
        self.cells = np.empty((2, self.n_steps))
        """Where the noise is estimated."""
        self.probes = np.unique(np.rint(_PROBES * self.sigma_bins / BINS_PER_STEP).astype(np.int64))
        """Where around a peak the misfit is looked at, in steps of y."""
        probe_bins = BINS_PER_STEP * self.probes.astype(np.float64)
        probe_sigmas = probe_bins / self.sigma_bins
        self.probe_turns = np.exp(-1j * self.carrier_rad * probe_bins)
        """What turns the carrier at the probes to its phase at the peak."""
        rho_sq = np.exp(-0.5 * probe_sigmas**2)
        self.probe_energy = float(np.sum(rho_sq))
        """Energy of a pulse of amplitude 1 at the probes."""
        self.probe_noise = float(np.sum(2 - (2 + 0.5 * probe_sigmas**2) * rho_sq))
        """Energy at the probes, over sigma_y**2, that noise leaves once a pulse is fitted."""
        self.split = SplitTest(model_error=module.error)
        self.single = SplitTest(max_echoes=1)
        self.left_near_peak = _NEAR_PEAK * module.error
        """What a wrong pulse leaves near the peak, relative to the amplitude."""
        self.threshold = threshold_sigmas(
            n_bins / self.sigma_bins, false_alarms, noise_is_known=noise_is_known
        )

    def apply(self, samples: Array) -> ComplexArray:
        """Return y of frames of shape (..., n_bins) at every second bin, shape (..., n_steps).

        The frames are `equalised` already.
        """
        return correlate(samples, self._spectrum, self)

    def equalised(self, samples: Array) -> Array:
        """Return one frame, shape (n_bins,), as if the module's pulse were the fitted one."""
        if self._equaliser is None:
            return samples
        spectrum = np.fft.rfft(samples, self.n_fft) * self._equaliser
        return np.fft.irfft(spectrum, self.n_fft)[: self.n_bins]


def _transform_length(least: int) -> int:
    """Return the next power of two, or three quarters of it: other lengths are slower."""
    power_of_two = 1 << (least - 1).bit_length()
    return power_of_two // 4 * 3 if power_of_two // 4 * 3 >= least else power_of_two


def _spectrum_of(taps: Array, n_fft: int) -> ComplexArray:
    """Return the spectrum of a filter whose middle is at delay zero, as `numpy.fft.rfft`."""
    kernel = np.zeros(n_fft)
    kernel[np.arange(taps.size) - taps.size // 2] = taps
    return np.fft.rfft(kernel)


def correlate(samples: Array, spectrum: ComplexArray, pulse_filter: PulseFilter) -> ComplexArray:
    """Return frames (..., n_bins) behind a filter of this spectrum, shape (..., n_steps)."""
    # The negative half of the spectrum is zero, so the other half alone has y's even bins.
    half = np.fft.rfft(samples, pulse_filter.n_fft)[..., : spectrum.shape[-1]] * spectrum
    y: ComplexArray = fft.ifft(half, overwrite_x=True)[..., : pulse_filter.n_steps]
    return y


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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Filtered:
    """One frame behind the filter."""

    samples: Array  # shape (n_bins,): mean removed, unknown samples zero; not equalised
    # shape (n_bins,): samples that are known and not at a limit of the sampler; None: all
    usable: BoolArray | None
    y: ComplexArray  # shape (n_steps,), complex: correlation with the pulse, at every second bin
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


def refit(
    table: Array, again: BoolArray, filtered: Filtered, within: tuple[float, float], *, joint: bool
) -> Array:
    """Return the echoes with those ``again`` (k,), and those that overlap with them, fitted anew.

    Where not ``joint``, each peak is left one echo, and none overlaps. Echoes between the positions
    ``within`` get their misfits.
    """
    pulse_filter = filtered.pulse_filter
    linked, split = 0.0, pulse_filter.single
    if joint:
        linked, split = OVERLAP * pulse_filter.sigma_bins, pulse_filter.split
    position, chosen = table[:, POSITION].tolist(), again.tolist()
    starts = [k for k in range(1, len(table)) if position[k] - position[k - 1] > linked]
    groups = []
    for first, end in pairwise([0, *starts, len(table)]):
        group = table[first:end]
        if True in chosen[first:end]:
            others = np.concatenate([table[:first], table[end:]])
            group = _fitted(group, others, filtered, split)
        groups.append(group)
    table = np.concatenate(groups)
    position, least = table[:, POSITION], pulse_filter.threshold * filtered.sigma_y
    is_inside = (position >= -0.5) & (position < pulse_filter.n_bins - 0.5)
    table = table[is_inside & (table[:, AMPLITUDE] > least)]
    table = table[np.argsort(table[:, POSITION], kind="stable")]
    _assess(table, filtered, within)
    return table


def _fitted(group: Array, others: Array, filtered: Filtered, split: SplitTest) -> Array:
    """Return the echoes near a group of peaks; the group where no sample is usable."""
    pulse_filter = filtered.pulse_filter
    margin = _MARGIN * pulse_filter.sigma_bins
    nearest, farthest = float(group[0, POSITION]), float(group[-1, POSITION])
    first, last = math.floor(nearest - margin), math.ceil(farthest + margin)
    inside = slice(max(first, 0), min(last + 1, pulse_filter.n_bins))
    is_whole = inside.start == first and inside.stop == last + 1
    search = _SEARCH * pulse_filter.sigma_bins
    if is_whole and (filtered.usable is None or filtered.usable[inside].all()):
        return fit_whole_echoes(
            filtered.y,
            (nearest - search, farthest + search),
            others=others,
            pulse=pulse_filter.known,
            sigma_y=filtered.sigma_y,
            split=split,
        )
    usable = np.zeros(last + 1 - first, dtype=np.bool_)
    known = slice(inside.start - first, inside.stop - first)
    usable[known] = True if filtered.usable is None else filtered.usable[inside]
    if np.count_nonzero(usable) < _LEAST_SAMPLES * pulse_filter.sigma_bins:
        return group
    window = np.zeros(usable.size)
    window[known] = pulse_filter.equalised(filtered.samples)[inside]
    window[known] -= _render(others, pulse_filter)[inside]
    # Echoes are looked for near the peaks, and as far beyond an end of the frame as it was cut.
    edge = margin - search
    search_bins = (
        0.0 if first < 0 else edge,
        window.size - 1 - (0.0 if last >= pulse_filter.n_bins else edge),
    )
    fits = fit_echoes(
        window,
        pulse=pulse_filter.known,
        noise_sigma=filtered.sigma_y / pulse_filter.noise_gain,
        usable=usable,
        search_bins=search_bins,
        split=split,
    )
    table = np.zeros((len(fits), COLUMNS))
    table[:, : len(fits[0])] = fits
    table[:, POSITION] += first
    return table


def _render(table: Array, pulse_filter: PulseFilter) -> Array:
    """Return the sum of echoes, shape (n_bins,)."""
    nearest = np.rint(table[:, POSITION])
    pulses = (
        pulse_filter.pulse.samples(table[:, POSITION] - nearest, pulse_filter.bin_length_m)
        * (table[:, AMPLITUDE] * np.exp(1j * table[:, PHASE]))[:, np.newaxis]
    )
    half = pulses.shape[1] // 2
    bins = nearest.astype(np.intp)[:, np.newaxis] + np.arange(-half, half + 1)
    seen = (bins >= 0) & (bins < pulse_filter.n_bins)
    total = np.bincount(bins[seen], weights=pulses.real[seen], minlength=pulse_filter.n_bins)
    return total.astype(np.float64, copy=False)  # of nothing, bincount answers integers


def _assess(table: Array, filtered: Filtered, within: tuple[float, float]) -> None:
    """Write the misfit of each echo between two positions where all echoes are the model."""
    if not len(table):
        return
    pulse_filter = filtered.pulse_filter
    reach = pulse_filter.pulse.half_length(pulse_filter.bin_length_m)
    first, last = table[[0, -1], POSITION]
    y = filtered.y
    is_whole = filtered.usable is None and first >= reach and last < pulse_filter.n_bins - reach
    if not is_whole:
        residual = pulse_filter.equalised(filtered.samples) - _render(table, pulse_filter)
        if filtered.usable is not None:
            residual *= filtered.usable
        y = pulse_filter.apply(residual)
    kernels.assess(
        y,
        is_whole,
        filtered.sigma_y,
        pulse_filter.sigma_bins,
        pulse_filter.carrier_rad,
        pulse_filter.probes,
        pulse_filter.probe_noise,
        pulse_filter.left_near_peak,
        *within,
        table,
    )


class MatchedFilterDetector:
    """Echoes by correlation; under ``joint``, overlapping ones fitted together."""

    def __init__(self, config: SlamConfig, received: Sequence[ReceivedPulse | None] = ()) -> None:
        """Take each radar's pulse from its rig file to begin with, and learn it from then on."""
        settings = config.matched_filter
        self.config = config
        self._nominal = nominal_pulse(settings)
        self.estimator = PulseEstimator(self._nominal.model, received)
        self._joint = config.detection.front_end is FrontEnd.JOINT
        self._filters: dict[tuple[int, int, float], PulseFilter] = {}

    def detect(self, frame: RadarFrame, range_offset_m: float = 0.0) -> tuple[Detection, ...]:
        return self.detect_many([frame], [range_offset_m])[0]

    def detect_many(
        self, frames: Sequence[RadarFrame], offsets_m: Sequence[float]
    ) -> list[tuple[Detection, ...]]:
        for frame in frames:  # before anything is learnt of one
            self._check_length(frame)
        found: list[tuple[Detection, ...]] = []
        while len(found) < len(frames):
            rest, offsets = frames[len(found) :], offsets_m[len(found) :]
            for frame, filtered, offset_m in zip(rest, self._filtered(rest), offsets, strict=True):
                detections, has_learnt = self._detections(frame, filtered, offset_m)
                found.append(detections)
                if has_learnt:  # the other frames come behind another filter
                    break
        return found

    def _check_length(self, frame: RadarFrame) -> None:
        n_bins = frame.samples.size
        shortest = 2 * self._nominal.model.half_length(frame.bin_length_m) + 1
        if n_bins < shortest:
            raise StepInputError(
                f"a frame of {n_bins} bins is shorter than a pulse ({shortest}); ask the module "
                "for a longer frame area"
            )

    def _detections(
        self, frame: RadarFrame, filtered: Filtered, range_offset_m: float
    ) -> tuple[tuple[Detection, ...], bool]:
        """Return the detections of one frame, and whether a pulse has changed."""
        limits, pulse_filter = self.config.detection, filtered.pulse_filter
        start_m, bin_m = frame.range_start_m - range_offset_m, frame.bin_length_m
        # Only echoes within the limits, or that overlap with one that may be, are looked into.
        reach = OVERLAP * pulse_filter.sigma_bins
        within = (
            (limits.min_range_m - start_m) / bin_m - reach,
            (limits.max_range_m - start_m) / bin_m + reach,
        )
        table = self._single_pulses(filtered, within)
        position = table[:, POSITION]
        has_learnt = self._learn(frame, filtered, table)
        again = cut_pulses(position, filtered)
        if self._joint:
            several = table[:, SEVERAL] > 0
            again = several if again is None else again | several
        if again is not None and again.any():
            again &= (position > within[0]) & (position < within[1])
            if again.any():
                table = refit(table, again, filtered, within, joint=self._joint)
        if not len(table):
            return (), has_learnt
        kernels.raise_deviations(
            filtered.sigma_y, pulse_filter.sigma_bins, pulse_filter.left_near_peak, table
        )
        saturated = saturated_pulses(table[:, POSITION], filtered).tolist()
        detections = tuple(
            Detection(
                radar=frame.radar,
                t_ns=frame.t_ns,
                range_m=start_m + position * bin_m,
                amplitude=amplitude,
                phase_rad=math.remainder(phase_rad, math.tau),
                sigma_m=sigma_bins * bin_m,
                misfit=misfit,
                saturated=was_cut,
            )
            for (position, amplitude, phase_rad, sigma_bins, misfit, _), was_cut in zip(
                table.tolist(), saturated, strict=True
            )
            if limits.min_range_m <= start_m + position * bin_m <= limits.max_range_m
        )
        return detections, has_learnt

    def learn(self, frame: RadarFrame) -> None:
        """Let the pulse be estimated from a frame whose echoes are not asked for."""
        (filtered,) = self._filtered([frame])
        self._learn(frame, filtered, self._single_pulses(filtered, (0.0, 0.0)))

    def _single_pulses(self, filtered: Filtered, within: tuple[float, float]) -> Array:
        """Return the peaks of a frame; those between two positions are looked into."""
        pulse_filter = filtered.pulse_filter
        n = kernels.single_pulses(
            filtered.y,
            filtered.sigma_y,
            pulse_filter.threshold,
            pulse_filter.sigma_bins,
            pulse_filter.carrier_rad,
            pulse_filter.probes,
            pulse_filter.probe_turns,
            pulse_filter.probe_energy,
            pulse_filter.probe_noise,
            pulse_filter.left_near_peak,
            self.config.matched_filter.max_single_misfit,
            *within,
            pulse_filter.table,
        )
        return pulse_filter.table[:n]

    def _learn(self, frame: RadarFrame, filtered: Filtered, table: Array) -> bool:
        """Let the pulse be estimated from this frame, too, and return whether it has changed."""
        if filtered.usable is not None or not self.estimator.is_due(frame.radar):
            return False
        has_changed = self.estimator.take(
            frame.radar,
            filtered.samples,
            frame.bin_length_m,
            position_bins=table[:, POSITION],
            amplitude=table[:, AMPLITUDE],
            sigma_y=filtered.sigma_y,
        )
        if has_changed:
            self._filters.clear()
        return has_changed

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

    def _filtered(self, frames: Sequence[RadarFrame]) -> list[Filtered]:
        """Return the frames behind their filters; those of one length are transformed together."""
        filters = [self._filter(frame) for frame in frames]
        batches: dict[tuple[int, int], list[int]] = {}
        for k, each in enumerate(filters):
            batches.setdefault((each.n_bins, each.n_fft), []).append(k)
        found: dict[int, Filtered] = {}
        for chosen in batches.values():
            prepared = [_without_mean(frames[k]) for k in chosen]
            spectra = np.stack([filters[k].spectrum for k in chosen])
            y = correlate(
                np.stack([samples for samples, _, _ in prepared]),
                spectra,
                filters[chosen[0]],
            )
            for row, k in enumerate(chosen):
                samples, usable, largest = prepared[row]
                configured = self.config.matched_filter.noise_sigma
                sigma_y = configured * filters[k].raw_noise_gain
                if not configured:
                    sigma_y = math.sqrt(
                        kernels.noise_power(y[row], filters[k].stride, filters[k].cells)
                    )
                found[k] = Filtered(
                    samples=samples,
                    usable=usable,
                    y=y[row],
                    sigma_y=max(sigma_y, _RESOLUTION * largest),
                    pulse_filter=filters[k],
                )
        return [found[k] for k in range(len(frames))]


def _without_mean(frame: RadarFrame) -> tuple[Array, BoolArray | None, float]:
    """Return the samples (n_bins,), unknown ones zero, which are usable, and the largest."""
    samples = frame.samples.astype(np.float64)
    lowest, highest = float(samples.min()), float(samples.max())
    usable = None
    if math.isnan(lowest) or reaches_limits(frame, lowest, highest):
        usable = usable_samples(frame)
        samples[np.isnan(samples)] = 0.0
        lowest, highest = float(samples.min()), float(samples.max())
    # A constant frame must come out as nothing, not as the two steps at its ends.
    samples -= np.add.reduce(samples) / samples.size
    return samples, usable, max(highest, -lowest)

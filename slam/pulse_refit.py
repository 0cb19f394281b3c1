"""Second look at echoes that are not one whole pulse: overlapping, saturated, or cut by an end.

Groups of such peaks are fitted with all other echoes of the frame subtracted: behind the filter, by
:mod:`slam.whole_echoes`, where every sample around them is known; sample by sample, by
:mod:`slam.close_echoes`, where some are not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.close_echoes import KnownPulse, SplitTest, fit_echoes
from slam.pulse_filter import BINS_PER_STEP, PulseFilter
from slam.pulse_model import ComplexArray
from slam.whole_echoes import REACH_STEPS, Correlation, fit_whole_echoes

Array = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Peaks:
    """Echoes of one frame, k of them, nearest first; every array has shape (k,).

    Attributes
    ----------
    position_bins
        From sample 0.
    amplitude
        Of the pulse, in the unit of the samples.
    phase_rad
        Of the carrier at the position, up to whole turns.
    sigma_bins
        Predicted standard deviation of the position.
    misfit
        Unexplained over expected energy near the peak.
    saturated
        Whether samples within reach of the peak were missing inside the frame.
    """

    position_bins: Array
    amplitude: Array
    phase_rad: Array
    sigma_bins: Array
    misfit: Array
    saturated: BoolArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Filtered:
    """One frame behind the filter.

    Attributes
    ----------
    samples
        shape (n_bins,): mean removed, unknown samples zero.
    usable
        shape (n_bins,): samples that are known and not at a limit of the sampler; None: all.
    y
        shape (n_steps,), complex: correlation with the pulse, at every second bin.
    power
        shape (n_steps,): squared magnitude of y.
    sigma_y
        Standard deviation of its noise, per quadrature.
    pulse_filter
        What made it.
    """

    samples: Array
    usable: BoolArray | None
    y: ComplexArray
    power: Array
    sigma_y: float
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
    """Return the peaks with the marked ones, and those that overlap with them, fitted anew.

    Parameters
    ----------
    peaks
        As if each were a single pulse.
    again
        shape (k,), which of them need the second look.
    filtered
        The frame they come from.
    split
        When one more echo is believed; ``max_echoes`` 1 leaves each peak one echo.
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
    """Return the echoes of a frame near a group of peaks; the group where nothing is to be seen."""
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
    return np.array(
        [(f.position_bins + first, f.amplitude, f.phase_rad, f.sigma_bins) for f in fits]
    )


def _fitted_whole(group: Array, others: Array, filtered: Filtered, split: SplitTest) -> Array:
    """Return the echoes near a group of peaks around which every sample is known."""
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
    table = np.array([(f.position_bins, f.amplitude, f.phase_rad, f.sigma_bins) for f in fits])
    table[:, _PHASE] += pulse_filter.carrier_rad * table[:, _POSITION]
    table[:, _POSITION] += begin
    return table


def _correlated(table: Array, steps: NDArray[np.intp], pulse_filter: PulseFilter) -> ComplexArray:
    """Return what whole echoes are behind the filter, at steps of y; the shape of the steps."""
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
    pulse_filter = filtered.pulse_filter
    nearest = np.rint(table[:, _POSITION] / BINS_PER_STEP).astype(np.intp)
    steps = nearest[:, np.newaxis] + pulse_filter.probes
    reach = pulse_filter.pulse.half_length(pulse_filter.bin_length_m)
    first, last = table[[0, -1], _POSITION] if len(table) else (0.0, 0.0)
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
    return energy / (filtered.sigma_y**2 * pulse_filter.probe_noise)

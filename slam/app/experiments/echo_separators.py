"""Other ways to tell close echoes apart, to hold the joint fit against: CLEAN, OMP and LASSO.

All see the same windows as `slam.close_echoes.fit_many`, know the same pulse and believe one more
echo by the same test; they differ in how they look for it. Each works on the correlation of the
window with pulses on a fine grid of positions, cosine and sine taken as orthogonal.

CLEAN
    Subtracts the strongest pulse of what is left, again and again (Hogbom 1974). Each is placed as
    if it were alone.
OMP
    Places pulses like CLEAN, but then fits the amplitudes of all of them together (Pati et al.
    1993). Positions stay where they were first put.
LASSO
    Amplitudes for every grid position at once, their absolute sum penalised (Tibshirani 1996;
    solved by FISTA, Beck and Teboulle 2009); neighbours are merged, weakest first out.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from slam.close_echoes import KnownPulse, SplitTest, split_threshold

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

Separator = Callable[[Array, KnownPulse, Array, SplitTest], list[Array]]
"""(windows (b, n), pulse, noise sigma (b,), split) -> positions in bins of each window, sorted."""

_FINE_STEP_BINS = 0.25
_COARSE_STEP_BINS = 1.0
_LASSO_STEPS = 200
_MERGED_BINS = 4.0
"""LASSO spreads one echo over neighbouring grid places; closer ones are taken as one."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Dictionary:
    """Pulses of norm 1 on a grid, and what of the windows each explains.

    Attributes
    ----------
    grid
        Shape (g,), bins.
    gram
        Shape (g, g), float64: correlation of the pulses.
    matched
        Shape (b, g), complex128: correlation of the windows, over the noise.
    """

    grid: Array
    gram: Array
    matched: ComplexArray

    @staticmethod
    def of(windows: Array, pulse: KnownPulse, noise_sigma: Array, step_bins: float) -> _Dictionary:
        n = np.arange(windows.shape[1])
        sigma = pulse.envelope_sigma_bins
        grid = np.arange(1.5 * sigma, len(n) - 1 - 1.5 * sigma, step_bins)
        envelopes = np.exp(-0.5 * ((n - grid[:, np.newaxis]) / sigma) ** 2)
        envelopes /= np.sqrt((envelopes**2).sum(axis=1, keepdims=True))
        angle = pulse.carrier_rad_per_bin * n
        # a cosine of envelope norm 1 has norm sqrt(1/2)
        whitened = windows * (math.sqrt(2) / noise_sigma[:, np.newaxis])
        matched = (whitened * np.cos(angle)) @ envelopes.T - 1j * (
            (whitened * np.sin(angle)) @ envelopes.T
        )
        return _Dictionary(grid=grid, gram=envelopes @ envelopes.T, matched=matched)


def clean(windows: Array, pulse: KnownPulse, noise_sigma: Array, split: SplitTest) -> list[Array]:
    """Return positions by CLEAN; arguments as in `Separator`."""
    dictionary = _Dictionary.of(windows, pulse, noise_sigma, _FINE_STEP_BINS)
    return [
        _greedy(dictionary, matched, split, pulse.envelope_sigma_bins, refit=False)
        for matched in dictionary.matched
    ]


def omp(windows: Array, pulse: KnownPulse, noise_sigma: Array, split: SplitTest) -> list[Array]:
    """Return positions by orthogonal matching pursuit; arguments as in `Separator`."""
    dictionary = _Dictionary.of(windows, pulse, noise_sigma, _FINE_STEP_BINS)
    return [
        _greedy(dictionary, matched, split, pulse.envelope_sigma_bins, refit=True)
        for matched in dictionary.matched
    ]


def _greedy(
    dictionary: _Dictionary, matched: ComplexArray, split: SplitTest, sigma: float, *, refit: bool
) -> Array:
    left, chosen, explained = matched, list[int](), 0.0
    root_h = math.sqrt(_threshold(dictionary, split, sigma))
    while len(chosen) < split.max_echoes:
        power = left.real**2 + left.imag**2
        best = int(power.argmax())
        if chosen and power[best] <= (root_h + split.model_error * math.sqrt(explained)) ** 2:
            break
        if best in chosen:  # what is left is no pulse
            break
        chosen.append(best)
        if refit:
            linear = np.linalg.solve(dictionary.gram[np.ix_(chosen, chosen)], matched[chosen])
            left = matched - dictionary.gram[:, chosen] @ linear
            explained = float((matched[chosen].conj() @ linear).real)
        else:
            explained += float(power[best])
            left = left - dictionary.gram[:, best] * left[best]
    return np.sort(dictionary.grid[chosen])


def lasso(windows: Array, pulse: KnownPulse, noise_sigma: Array, split: SplitTest) -> list[Array]:
    """Return positions by LASSO on a grid; arguments as in `Separator`."""
    dictionary = _Dictionary.of(windows, pulse, noise_sigma, _COARSE_STEP_BINS)
    gram, matched = dictionary.gram, dictionary.matched
    root_h = math.sqrt(_threshold(dictionary, split, pulse.envelope_sigma_bins))
    # The penalty at which noise, and what the pulse leaves of itself, stays at zero.
    strongest = np.abs(matched).max(axis=1, keepdims=True)
    penalty = root_h + split.model_error * strongest
    rate = 1 / float(np.linalg.eigvalsh(gram)[-1])
    amplitudes = ahead = np.zeros_like(matched)
    momentum = 1.0
    for _ in range(_LASSO_STEPS):
        moved = ahead + rate * (matched - ahead @ gram)
        size = np.abs(moved)
        shrunk = moved * np.maximum(0.0, 1 - rate * penalty / np.maximum(size, 1e-300))
        following = (1 + math.sqrt(1 + 4 * momentum**2)) / 2
        ahead = shrunk + (momentum - 1) / following * (shrunk - amplitudes)
        amplitudes, momentum = shrunk, following
    return [
        _pruned(_merged(dictionary.grid, np.abs(row)), dictionary, each, split, root_h)
        for row, each in zip(amplitudes, matched, strict=True)
    ]


def _merged(grid: Array, size: Array) -> Array:
    """Return the centres of runs of grid places in use, weighted by their amplitudes."""
    used = np.flatnonzero(size > 0.02 * size.max())
    runs = np.split(used, np.flatnonzero(np.diff(grid[used]) > _MERGED_BINS) + 1)
    return np.array([np.average(grid[run], weights=size[run]) for run in runs])


def _pruned(
    positions: Array,
    dictionary: _Dictionary,
    matched: ComplexArray,
    split: SplitTest,
    root_h: float,
) -> Array:
    """Drop the echo that explains least while the others explain nearly as much without it."""

    def energy(kept: Array) -> float:
        places = np.searchsorted(dictionary.grid, kept).clip(0, len(dictionary.grid) - 1)
        linear = np.linalg.lstsq(dictionary.gram[np.ix_(places, places)], matched[places])[0]
        return float((matched[places].conj() @ linear).real)

    while len(positions) > 1:
        whole = energy(positions)
        without = [energy(np.delete(positions, k)) for k in range(len(positions))]
        weakest = int(np.argmax(without))
        needed = (root_h + split.model_error * math.sqrt(max(0.0, without[weakest]))) ** 2
        if len(positions) <= split.max_echoes and whole - without[weakest] > needed:
            break
        positions = np.delete(positions, weakest)
    return positions


def _threshold(dictionary: _Dictionary, split: SplitTest, sigma: float) -> float:
    length = float(dictionary.grid[-1] - dictionary.grid[0])
    return split_threshold(split.false_split, length / sigma)


SEPARATORS: Mapping[str, Separator] = MappingProxyType({"clean": clean, "omp": omp, "lasso": lasso})

"""Overlapping echoes of which every sample is known, told apart behind the matched filter.

The same maximum likelihood as in :mod:`slam.close_echoes`, in closed form. Behind the filter
(:mod:`slam.pulse_filter`), with the carrier turned back, K pulses are

    z(n) = y(n) exp(-j kappa n) = sum_k a_k rho(n - u_k) + noise,   rho(d) = exp(-d**2 / (4 s**2))

and the noise is correlated by rho too, so that all a window of samples tells about the positions u
lies in the K values z(u_k). With R_kl = rho(u_k - u_l), what the echoes explain at their best is

    G(u) = z^H R^-1 z,   a = R^-1 z,   twice the log-likelihood = G / sigma_y**2

and with D_kl = d rho(u_k - u_l) / d u_k and H_kl = d2 rho(u_k - u_l) / (d u_k d u_l), variable
projection (Golub and Pereyra 1973, in Kaufman's form) gives

    1/2 dG/du_k = Re conj(a_k) (z'(u_k) - sum_l D_kl a_l)
    Fisher information of u = Re(conj(a_k) a_l) (H - D R^-1 D^T)_kl / sigma_y**2

The matrices have at most `SplitTest.max_echoes` rows: plain Python is several times faster on them
than arrays are.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import lru_cache
from itertools import pairwise
from operator import mul
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from slam.close_echoes import EchoFit, SplitTest, split_threshold
from slam.pulse_model import ComplexArray

Array = NDArray[np.float64]
Matrix = list[list[float]]
T = TypeVar("T")

_MAX_STEPS = 30
_LARGEST_STEP = 0.5
"""Of s."""
_HOPELESS = 1e3
"""Damping at which the search ends: it presses against a limit."""
_OPTIMISM = 10.0
"""How many times what it forecasts a search may gain, at most."""
_COARSE, _FINE = 1.0, 1e-4
"""Gains of twice the log-likelihood too small to go on: while echoes are counted, and at last."""
REACH_STEPS = 4
"""On either side of a step, how many it takes to interpolate there."""
_WINDOW = np.arange(2 * REACH_STEPS + 1)
_TAYLOR = np.linalg.inv(np.vander(_WINDOW - REACH_STEPS, increasing=True)).T + 0j
"""From nine values of z to the polynomial through them; z is smooth over ten steps."""


class Correlation:
    """z of a stretch of one frame, a polynomial around each of its steps.

    Parameters
    ----------
    z
        Shape (n,), complex: the filter's output with the carrier turned back.
    step_bins
        Bins from one value to the next.
    sigma_bins
        s, of the envelope.
    sigma_y
        Standard deviation of the noise of z, per quadrature.
    """

    def __init__(
        self, z: ComplexArray, *, step_bins: float, sigma_bins: float, sigma_y: float
    ) -> None:
        self.sigma_bins = sigma_bins
        self.sigma_y = sigma_y
        self.step_bins = step_bins
        self.curvature = 0.5 / sigma_bins**2
        """Of rho at its top [1/bin**2]."""
        self._around = z[np.arange(z.size - 2 * REACH_STEPS)[:, np.newaxis] + _WINDOW] @ _TAYLOR
        self._polynomials: list[list[complex]] = self._around.tolist()

    def on_steps(self, first: float, last: float) -> tuple[Array, ComplexArray]:
        """Return the positions of the steps within two positions, and z there."""
        begin = max(0, math.ceil(first / self.step_bins) - REACH_STEPS)
        end = max(begin + 1, math.floor(last / self.step_bins) + 1 - REACH_STEPS)
        values = self._around[begin:end, 0]
        return (np.arange(begin, begin + values.size) + REACH_STEPS) * self.step_bins, values

    def at(self, position: float) -> tuple[complex, complex]:
        """Return z and its derivative by the position [1/bin]; positions count from ``z[0]``."""
        steps = position / self.step_bins
        nearest = min(max(round(steps), REACH_STEPS), len(self._polynomials) - 1 + REACH_STEPS)
        offset = steps - nearest
        value = slope = 0j
        for coefficient in reversed(self._polynomials[nearest - REACH_STEPS]):
            slope = slope * offset + value
            value = value * offset + coefficient
        return value, slope / self.step_bins


class _Search(NamedTuple):
    """Where echoes are looked for: limits of their positions, least distance, steps, z there."""

    first: float
    last: float
    separation: float
    grid: Array
    z: ComplexArray


class _Fit:
    """Everything known at given positions.

    Attributes
    ----------
    positions, amplitudes
        u and a, one each per echo.
    inverse
        R^-1.
    explained
        G.
    gradient, information
        Half of dG/du, and the Fisher matrix times sigma_y**2.
    """

    __slots__ = ("amplitudes", "explained", "gradient", "information", "inverse", "positions")

    def __init__(self, data: Correlation, positions: list[float]) -> None:
        self.positions = positions
        overlap, slope, bend = _tables(positions, data.curvature)
        seen, climb = zip(*map(data.at, positions), strict=True)
        self.inverse = inverse = _inverse(overlap)
        self.amplitudes = a = [_dot(row, seen) for row in inverse]
        self.explained = _dot(a, map(complex.conjugate, seen)).real
        turned = [each.conjugate() for each in a]
        self.gradient = [
            (each * (here - _dot(row, a))).real
            for each, here, row in zip(turned, climb, slope, strict=True)
        ]
        # D^T = -D
        known = [[_dot(row, column) for column in inverse] for row in slope]
        columns = list(zip(*slope, strict=True))
        self.information = [
            [
                (each * other).real * (straight + _dot(row, column))
                for other, straight, column in zip(a, bends, columns, strict=True)
            ]
            for each, bends, row in zip(turned, bend, known, strict=True)
        ]


def fit_whole_echoes(
    data: Correlation, first: float, last: float, split: SplitTest
) -> tuple[EchoFit, ...]:
    """Return the echoes between two positions, at least one and at most ``split.max_echoes``.

    Parameters
    ----------
    data
        z around them, all other echoes of the frame taken away.
    first, last
        Least and largest position [bins].
    split
        When one more echo is believed.

    Returns
    -------
    Nearest first, positions counted in bins from ``z[0]``, phases at the positions with the carrier
    turned back; ``misfit`` is not known here (NaN).
    """
    s = data.sigma_bins
    grid, z = data.on_steps(first, last)
    search = _Search(first, last, split.min_separation * s, grid, z)
    threshold = split_threshold(split.false_split, math.ceil((last - first) / s))
    fit = _polished(data, _Fit(data, [float(grid[np.argmax(np.abs(z))])]), search, _COARSE)
    while len(fit.positions) < split.max_echoes:
        signal = math.sqrt(max(fit.explained, 0.0))
        needed = (math.sqrt(threshold) * data.sigma_y + split.model_error * signal) ** 2
        if len(fit.positions) == 1:
            starts = [_best_pair(search, s)]
        else:
            starts = _one_more(fit, search, s, needed)
        tried = [
            _polished(data, _Fit(data, start), search, _COARSE, fit.explained + needed)
            for start in starts
            if _apart(start, search.separation)
        ]
        more = max(tried, key=lambda each: each.explained, default=fit)
        if more.explained - fit.explained <= needed:
            break
        fit = more
    return _echoes(_polished(data, fit, search, _FINE), data.sigma_y)


def _polished(
    data: Correlation,
    fit: _Fit,
    search: _Search,
    tolerance: float,
    at_least: float = -math.inf,
) -> _Fit:
    """Return the best fit by Levenberg-Marquardt, kept between limits and apart.

    A search is given up when its own forecast, however often missed, stays short of what G is
    wanted to be.
    """
    first, last, separation = search[:3]
    largest = _LARGEST_STEP * data.sigma_bins
    damping = 1e-3
    for _ in range(_MAX_STEPS):
        damped = [row.copy() for row in fit.information]
        floor = 1e-12 * max(row[k] for k, row in enumerate(damped))
        if floor <= 0.0:  # nothing is there
            break
        for k, row in enumerate(damped):
            row[k] += damping * row[k] + floor
        step = [_dot(row, fit.gradient) for row in _inverse(damped)]
        # the model's own forecast of the gain
        promised = _dot(step, fit.gradient)
        if fit.explained + _OPTIMISM * promised < at_least:
            break
        wanted = sorted(
            min(max(u + min(max(du, -largest), largest), first), last)
            for u, du in zip(fit.positions, step, strict=True)
        )
        tried = _Fit(data, wanted) if _apart(wanted, separation) else fit
        gained = tried.explained - fit.explained
        if gained > 0.0:
            fit = tried
            damping *= 0.1
        else:
            gained = promised
            damping *= 10.0
        if gained <= tolerance * data.sigma_y**2 or damping >= _HOPELESS:
            break
    return fit


def _tables(positions: list[float], curvature: float) -> tuple[Matrix, Matrix, Matrix]:
    """Return R, D and H of pulses at positions."""
    size = len(positions)
    overlap, slope, bend = ([[0.0] * size for _ in positions] for _ in range(3))
    for k, here in enumerate(positions):
        overlap[k][k], bend[k][k] = 1.0, curvature
        for m, there in enumerate(positions[:k]):
            scaled = curvature * (here - there)
            left = scaled * (here - there)
            rho = math.exp(-0.5 * left)
            overlap[k][m] = overlap[m][k] = rho
            slope[m][k] = scaled * rho
            slope[k][m] = -slope[m][k]
            bend[k][m] = bend[m][k] = (1 - left) * curvature * rho
    return overlap, slope, bend


def _dot(one: Iterable[T], other: Iterable[T]) -> T:
    total: T = sum(map(mul, one, other))
    return total


def _apart(positions: list[float], separation: float) -> bool:
    return all(b - a >= separation for a, b in pairwise(positions))


def _best_pair(search: _Search, s: float) -> list[float]:
    """Return the two steps of the grid that explain most, far enough apart; or its two ends."""
    grid, z = search.grid, search.z
    step_bins = float(grid[1] - grid[0]) if grid.size > 1 else 0.0
    overlap, gain = _pairs(grid.size, step_bins, s, search.separation)
    energy = z.real**2 + z.imag**2
    crossed = np.multiply.outer(z.real, z.real) + np.multiply.outer(z.imag, z.imag)
    explained = np.add.outer(energy, energy)
    explained -= 2 * overlap * crossed
    explained *= gain
    one, other = divmod(int(np.argmax(explained)), grid.size)
    if not gain[one, other]:
        return [float(grid[0]), float(grid[-1])]
    return sorted((float(grid[one]), float(grid[other])))


@lru_cache
def _pairs(size: int, step_bins: float, s: float, separation: float) -> tuple[Array, Array]:
    """Return rho of each pair of steps, and 1 / (1 - rho**2), 0 where they are too close."""
    steps = np.abs(np.subtract.outer(np.arange(size), np.arange(size)))
    apart = step_bins * steps
    overlap = np.exp(-0.25 * (apart / s) ** 2)
    far = apart >= separation
    return overlap, np.where(far, 1 / np.where(far, 1 - overlap**2, 1.0), 0.0)


def _one_more(fit: _Fit, search: _Search, s: float, needed: float) -> list[list[float]]:
    """Return starts with one more echo: where it explains most, or as a split of one.

    None, where what is left is far from explaining what is needed.
    """
    first, last, separation, grid, z = search
    positions = np.array(fit.positions)
    apart = grid - positions[:, np.newaxis]
    overlap = np.exp(-0.25 * (apart / s) ** 2)
    residual = z - np.array(fit.amplitudes) @ overlap
    norm = 1 - np.einsum("kn,kn->n", overlap, np.array(fit.inverse) @ overlap)
    explained = (residual.real**2 + residual.imag**2) / np.maximum(norm, 1e-3)
    if _OPTIMISM * explained.max() < needed:
        return []
    explained[np.abs(apart).min(axis=0) < separation] = -1.0
    starts = [sorted([*fit.positions, float(grid[np.argmax(explained)])])]
    for k, position in enumerate(fit.positions):
        others = fit.positions[:k] + fit.positions[k + 1 :]
        halves = (max(position - 0.5 * s, first), min(position + 0.5 * s, last))
        starts.append(sorted([*others, *halves]))
    return starts


def _inverse(matrix: Matrix) -> Matrix:
    """Return the inverse of a small symmetric positive definite matrix, by bordering."""
    if len(matrix) == 1:
        return [[1 / matrix[0][0]]]
    (first, cross, *_), (_, second, *_) = matrix[:2]
    scale = 1 / (first * second - cross * cross)
    inverse = [[scale * second, -scale * cross], [-scale * cross, scale * first]]
    for row in matrix[2:]:
        size = len(inverse)
        border = [_dot(known, row[:size]) for known in inverse]
        scale = 1 / (row[size] - _dot(border, row))
        scaled = [scale * value for value in border]
        for known, factor in zip(inverse, border, strict=True):
            known[:] = [
                *(x + factor * y for x, y in zip(known, scaled, strict=True)),
                -scale * factor,
            ]
        inverse.append([*(-value for value in scaled), scale])
    return inverse


def _echoes(fit: _Fit, sigma_y: float) -> tuple[EchoFit, ...]:
    information = fit.information
    told = [row[k] for k, row in enumerate(information)]
    blind = min(told) <= 1e-12 * max(told)
    variances = [math.inf] * len(information)
    if not blind:
        variances = [row[k] for k, row in enumerate(_inverse(information))]
    spread = [sigma_y * math.sqrt(v) if v > 0.0 else math.inf for v in variances]
    return tuple(
        EchoFit(
            position_bins=position,
            amplitude=abs(a),
            phase_rad=math.atan2(a.imag, a.real),
            sigma_bins=sigma,
            misfit=math.nan,
        )
        for position, a, sigma in zip(fit.positions, fit.amplitudes, spread, strict=True)
    )

"""Echoes that overlap, separated by joint maximum likelihood.

A window of a raw frame is modelled as K pulses of known shape and white noise,

    x[n] = sum_k g(n - u_k) (b_k cos(w n) + d_k sin(w n)) + sigma w[n],

g the Gaussian envelope, w the carrier. The effect of reflection and carrier on the phase is in the
linear b and d, so the carrier's 20 mm ambiguity never enters: only the envelope tells where an echo
lies. For given positions b and d are a linear least-squares solution; the positions are found by
Levenberg-Marquardt on the residual, the Jacobian projected off the linear part (variable
projection; Golub and Pereyra 1973, in Kaufman's form). Two echoes start at the best pair of a grid
over the whole window, so no first guess can lock the search; each further echo starts where it
explains most of the residual of the others, and as a half of each of them.

How many echoes: one more is accepted if it raises twice the log-likelihood by more than

    (sqrt(h) + model_error sqrt(E) / sigma)**2,    E = energy of the echoes so far.

h is exceeded by noise alone, anywhere in the window, with probability ``false_split`` (upcrossings
of a chi-square process with 2 degrees of freedom; Davies 1987). The other term keeps a pulse that
differs from the model one echo, however strong: the residual of the pulse model grows with the
signal. Its price: of two echoes in phase that look like one wide pulse, or one far weaker than the
other, only one is reported.

`fit_echoes` does so sample by sample, where some samples are unknown. Where all are known,
`fit_whole_echoes` does it in closed form behind the filter (:mod:`slam.front_end.matched_filter`):
with the carrier turned back, K pulses are

    z(n) = y(n) exp(-j kappa n) = sum_k a_k rho(n - u_k) + noise,   rho(d) = exp(-d**2 / (4 s**2))

and the noise is correlated by rho too, so that all information of a window of samples about the
positions u is in the K values z(u_k). With R_kl = rho(u_k - u_l), the energy that the echoes
explain is

    G(u) = z^H R^-1 z,   a = R^-1 z,   twice the log-likelihood = G / sigma_y**2

and with D_kl = d rho(u_k - u_l) / d u_k and H_kl = d2 rho(u_k - u_l) / (d u_k d u_l),

    1/2 dG/du_k = Re conj(a_k) (z'(u_k) - sum_l D_kl a_l)
    Fisher information of u = Re(conj(a_k) a_l) (H - D R^-1 D^T)_kl / sigma_y**2

On matrices of at most `SplitTest.max_echoes` rows plain Python is several times faster than arrays.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from operator import mul
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from slam.front_end.pulse import ComplexArray

Array = NDArray[np.float64]
Matrix = list[list[float]]
T = TypeVar("T")

_MAX_STEPS = 30
# Of the envelope's sigma.
_LARGEST_STEP = 0.5
# Damping of the first step, by what it is multiplied after a step that helped and one that did
# not, and its least part, as a share of the largest information
_DAMPING, _EASED, _STIFFENED, _LEAST_DAMPING = 1e-3, 0.1, 10.0, 1e-12
# What keeps the matrix of the pulses regular, and shares of a pulse's norm and information below
# which a position explains nothing of its own
_RIDGE, _LEAST_NORM, _LEAST_INFORMATION = 1e-13, 1e-3, 1e-12
# How far from the ends of a window echoes are looked for, in envelope sigmas
_OFF_THE_ENDS = 1.5
_LARGEST_RISE = 200.0
# Damping at which the search ends: it presses against a limit.
_HOPELESS = 1e3
# Added to what may be zero where no sample is usable.
TINY = 1e-200
# Of the envelope's sigma: spacing of the start grid. The likelihood is smooth on that scale.
_GRID_STEP = 0.2
# Gains of twice the log-likelihood too small to go on: while echoes are counted, and at last, where
# it is a hundredth of a standard deviation of a position.
_COARSE, _FINE = 1.0, 1e-4
# How many times its forecast a search may gain, at most.
_OPTIMISM = 10.0
# On either side of a step, how many it takes to interpolate there.
REACH_STEPS = 4
_WINDOW = np.arange(2 * REACH_STEPS + 1)
# From nine values of z to the polynomial through them; z is smooth over ten steps.
_TAYLOR = np.linalg.inv(np.vander(_WINDOW - REACH_STEPS, increasing=True)).T + 0j


class Window(NamedTuple):
    """One window to be fitted, its carrier and its samples zero where a sample is not usable."""

    samples: Array  # (1, n)
    cosine: Array  # (1, n)
    sine: Array  # (1, n)
    weight: Array  # (1, n): 1 where a sample is usable
    noise_sigma: Array  # (1,)


class State(NamedTuple):
    """The fits at given positions, K echoes per row; a row is one start."""

    positions: Array  # (r, K)
    linear: Array  # (r, 2 K): b of every echo, then d
    sse: Array  # (r,)
    gradient: Array  # (r, K): of half the SSE, downhill
    information: Array  # (r, K, K): sigma**2 times the Fisher matrix of the positions

    def rows(self, chosen: NDArray[np.intp]) -> State:
        return State(*(table[chosen] for table in self))


class Solver:
    """Positions of K echoes by Levenberg-Marquardt, kept in the window and apart.

    In bins: ``sigma`` of the envelope, limits ``first`` and ``last`` of a position, and the least
    distance of two.
    """

    def __init__(self, sigma: float, first: float, last: float, separation: float) -> None:
        self.sigma = sigma
        self.separation = separation
        self._first = first
        self._last = last

    def fit(self, data: Window, starts: Array, tolerance: float) -> State:
        """Return the best fit over some starts (n_starts, K), ascending positions; one row.

        Its ``sse`` is infinite if the positions are never apart enough. The search ends where twice
        the log-likelihood gains less than ``tolerance``.
        """
        fitted = evaluate(data, starts, self.sigma)
        fitted.sse[~self._apart(fitted.positions)] = math.inf
        fitted = self.polish(data, fitted, tolerance)
        return fitted.rows(fitted.sse.argmin(axis=0, keepdims=True))

    def polish(self, data: Window, begun: State, tolerance: float) -> State:
        """Return the fits at which searches from some fits end; parameters as in `fit`."""
        state = begun.rows(np.arange(len(begun.sse)))
        damping = np.full(len(state.sse), _DAMPING)
        going = np.arange(len(state.sse))
        diagonal = np.arange(state.positions.shape[1])
        largest = _LARGEST_STEP * self.sigma
        for _ in range(_MAX_STEPS):
            at = state.rows(going)
            damped = at.information
            scale = damped[:, diagonal, diagonal]
            floor = _LEAST_DAMPING * scale.max(axis=1, keepdims=True) + TINY
            damped[:, diagonal, diagonal] += damping[going, np.newaxis] * scale + floor
            step = np.linalg.solve(damped, at.gradient[..., np.newaxis])[..., 0]
            wanted = at.positions + np.clip(step, -largest, largest)
            wanted = np.sort(np.clip(wanted, self._first, self._last), axis=1)
            tried = evaluate(data, wanted, self.sigma)
            better = (tried.sse < at.sse) & self._apart(wanted)
            for table, values in zip(state, tried, strict=True):
                table[going[better]] = values[better]
            damping[going] *= np.where(better, _EASED, _STIFFENED)
            # the model's own forecast of the gain, for a step that was not taken
            promised = np.einsum("rk,rk->r", step, at.gradient)
            gained = np.where(better, at.sse - tried.sse, promised)
            open_ends = (gained > tolerance * data.noise_sigma**2) & (damping[going] < _HOPELESS)
            going = going[open_ends]
            if not going.size:
                break
        return state

    def _apart(self, positions: Array) -> NDArray[np.bool_]:
        gaps = positions[:, 1:] - positions[:, :-1]
        apart: NDArray[np.bool_] = np.all(gaps >= self.separation, axis=1)
        return apart


def evaluate(data: Window, positions: Array, sigma: float) -> State:
    """Solve for the linear part and project the Jacobian of the positions off it."""
    n_echoes = positions.shape[1]
    offsets = np.arange(data.samples.shape[1]) - positions[..., np.newaxis]
    envelopes = np.exp(offsets * offsets * (-0.5 / sigma**2))
    cosine, sine = data.cosine[:, np.newaxis], data.sine[:, np.newaxis]
    columns = np.concatenate([envelopes * cosine, envelopes * sine], axis=1)
    samples = data.samples[..., np.newaxis]

    matched = (columns @ samples)[..., 0]
    gram = columns @ columns.swapaxes(1, 2)
    diagonal = np.arange(2 * n_echoes)
    gram[:, diagonal, diagonal] *= 1 + _RIDGE
    gram[:, diagonal, diagonal] += TINY
    linear = np.linalg.solve(gram, matched[..., np.newaxis])[..., 0]
    residual = data.samples - (linear[:, np.newaxis] @ columns)[:, 0]

    slope = offsets * (1 / sigma**2)
    pulses = linear[..., np.newaxis] * columns
    tangents = (pulses[:, :n_echoes] + pulses[:, n_echoes:]) * slope
    mixed = tangents @ columns.swapaxes(1, 2)
    explained: Array = mixed @ np.linalg.solve(gram, mixed.swapaxes(1, 2))
    return State(
        positions=positions,
        linear=linear,
        sse=np.einsum("rn,rn->r", residual, residual),
        gradient=(tangents @ residual[..., np.newaxis])[..., 0],
        information=tangents @ tangents.swapaxes(1, 2) - explained,
    )


def _on_grid(data: Window, samples: Array, envelopes: Array) -> tuple[Array, Array]:
    """Return the correlation of samples with pulses on a grid, complex, and their squared norms.

    Shapes (1, n_grid). Cosine and sine columns are orthogonal but for cut pulses.
    """
    matched = (samples * data.cosine) @ envelopes.T + 1j * ((samples * data.sine) @ envelopes.T)
    norm = 0.5 * data.weight @ (envelopes**2).T
    return matched, norm + TINY


def _envelopes(positions: Array, n_bins: int, sigma: float) -> Array:
    envelopes: Array = np.exp(
        -0.5 * ((np.arange(n_bins) - positions[..., np.newaxis]) / sigma) ** 2
    )
    return envelopes


def best_single(data: Window, grid: Array, sigma: float) -> Array:
    """Return the place of the grid where one echo explains most; shape (1, 1)."""
    matched, norm = _on_grid(data, data.samples, _envelopes(grid, data.samples.shape[1], sigma))
    best: Array = grid[np.argmax(np.abs(matched) ** 2 / norm, axis=1)]
    return best[:, np.newaxis]


def best_pair(data: Window, grid: Array, sigma: float, separation: float) -> Array:
    """Return the pair of the grid that explains most; shape (1, 2)."""
    one, other = np.triu_indices(len(grid), k=math.ceil(separation / (grid[1] - grid[0])))
    if not one.size:  # a search interval shorter than two echoes' distance
        return grid[np.newaxis, [0, -1]]
    envelopes = _envelopes(grid, data.samples.shape[1], sigma)
    matched, norm = _on_grid(data, data.samples, envelopes)
    overlaps = 0.5 * (data.weight[:, np.newaxis] * envelopes) @ envelopes.T
    overlap = overlaps[:, one, other]
    energy = np.abs(matched) ** 2
    joint = energy[:, one] * norm[:, other] + energy[:, other] * norm[:, one]
    joint -= 2 * overlap * (matched[:, one] * matched[:, other].conj()).real
    joint /= norm[:, one] * norm[:, other] - overlap**2 + TINY
    best = joint.argmax(axis=1)
    return np.stack([grid[one[best]], grid[other[best]]], axis=1)


def one_more(data: Window, state: State, grid: Array, sigma: float, separation: float) -> Array:
    """Return starts with one more echo: where it explains most, or as a split of one; (s, K)."""
    n_bins = data.samples.shape[1]
    weight = data.weight
    mine, theirs = _envelopes(state.positions, n_bins, sigma), _envelopes(grid, n_bins, sigma)
    fitted = state.linear.reshape(len(state.linear), 2, -1) @ mine
    residual = data.samples - fitted[:, 0] * data.cosine - fitted[:, 1] * data.sine
    matched, norm = _on_grid(data, residual, theirs)
    weighted = 0.5 * mine * weight[:, np.newaxis]
    mixed = weighted @ theirs.T
    known = np.linalg.solve(weighted @ mine.swapaxes(1, 2) + TINY * np.eye(mine.shape[1]), mixed)
    left = norm - (mixed * known).sum(axis=1)
    far = np.abs(grid - state.positions[..., np.newaxis]).min(axis=1) >= separation
    explained = np.where(far, np.abs(matched) ** 2 / np.maximum(left, _LEAST_NORM * norm), -1.0)
    added = grid[explained.argmax(axis=1)][:, np.newaxis]
    starts = [np.concatenate([state.positions, added], axis=1)]
    for k in range(state.positions.shape[1]):
        split = np.insert(state.positions, k, state.positions[:, k] - 0.5 * sigma, axis=1)
        split[:, k + 1] += 0.5 * sigma
        starts.append(split)
    together: Array = np.sort(np.concatenate(starts), axis=1)
    return together.clip(grid[0], grid[-1])


class EchoFit(NamedTuple):
    """One echo of a window."""

    position_bins: float  # centre of the pulse, in bins from the window's first sample
    amplitude: float  # peak of the envelope, in the unit of the samples
    phase_rad: float  # phase of the carrier at the pulse's centre, in (-pi, pi]
    # Standard deviation of the position: the Cramer-Rao bound at this fit, all else unknown
    sigma_bins: float


@dataclass(frozen=True, slots=True, kw_only=True)
class KnownPulse:
    """What the fit knows of the pulse."""

    envelope_sigma_bins: float  # standard deviation of the Gaussian envelope, in bins
    carrier_rad_per_bin: float  # advance of the carrier's phase per bin


@dataclass(frozen=True, slots=True, kw_only=True)
class SplitTest:
    """When one more echo is accepted."""

    max_echoes: int = 4  # most echoes of a window
    false_split: float = 1e-3  # probability that noise alone makes one more echo in a window
    # Amplitude error of the pulse model, relative. 0.08 covers a bandwidth wrong by 10 %.
    model_error: float = 0.08
    min_separation: float = 0.5  # closest echoes told apart, in standard deviations of the envelope


def fit_echoes(
    samples: Array,
    *,
    pulse: KnownPulse,
    noise_sigma: float,
    usable: NDArray[np.bool_] | None = None,
    search_bins: tuple[float, float] | None = None,
    split: SplitTest | None = None,
) -> tuple[EchoFit, ...]:
    """Return the echoes of a window, nearest first, between one and ``split.max_echoes``.

    ``samples`` (n,) are raw, about 3.5 envelope sigmas either side of the cluster, with noise of
    standard deviation ``noise_sigma`` > 0; ``usable`` (n,) is false where one is unknown (clipped,
    outside the frame). Echoes are looked for between the positions ``search_bins``, or 1.5 envelope
    sigmas off the ends.
    """
    split = split or SplitTest()
    n_bins = len(samples)
    sigma = pulse.envelope_sigma_bins
    first, last = search_bins or (_OFF_THE_ENDS * sigma, n_bins - 1 - _OFF_THE_ENDS * sigma)
    angle = pulse.carrier_rad_per_bin * np.arange(n_bins)
    weight = np.ones(n_bins) if usable is None else usable.astype(np.float64)
    data = Window(
        np.where(weight > 0.0, samples, 0.0)[np.newaxis],
        (np.cos(angle) * weight)[np.newaxis],
        (np.sin(angle) * weight)[np.newaxis],
        weight[np.newaxis],
        np.array([noise_sigma]),
    )
    grid = np.linspace(first, last, max(2, math.ceil((last - first) / (_GRID_STEP * sigma)) + 1))
    solver = Solver(sigma, first, last, split.min_separation * sigma)
    threshold = split_threshold(split.false_split, (last - first) / sigma)
    energy = np.einsum("rn,rn->r", data.samples, data.samples)

    state = solver.fit(data, best_single(data, grid, sigma), _COARSE)
    while (n_echoes := state.positions.shape[1]) < split.max_echoes:
        signal = np.sqrt(np.maximum(energy - state.sse, 0.0))
        needed = (math.sqrt(threshold) * data.noise_sigma + split.model_error * signal) ** 2
        if not state.sse > needed:  # no echo can explain more than all that is left
            break
        if n_echoes == 1:
            starts = best_pair(data, grid, sigma, solver.separation)
        else:
            starts = one_more(data, state, grid, sigma, solver.separation)
        more = solver.fit(data, starts, _COARSE)
        if not state.sse - more.sse > needed:
            break
        state = more
    state = solver.polish(data, state, _FINE)
    return _echoes(state, noise_sigma, pulse.carrier_rad_per_bin)


@lru_cache
def split_threshold(false_split: float, search_sigmas: float) -> float:
    """Return the rise of twice the log-likelihood that noise exceeds with a given probability.

    The probability that the energy that one more echo explains exceeds h anywhere is at most that
    of its first point plus its upcrossings, ``exp(-h/2) (1 + L sqrt(h / (4 pi)))``, with L =
    ``search_sigmas`` the interval searched, in standard deviations of the envelope.
    """

    def excess(h: float) -> float:
        return math.log1p(search_sigmas * math.sqrt(h / (4 * math.pi))) - h / 2

    return float(brentq(lambda h: excess(h) - math.log(false_split), 0.0, _LARGEST_RISE))


def _echoes(fit: State, noise_sigma: float, carrier_rad_per_bin: float) -> tuple[EchoFit, ...]:
    positions, information = fit.positions[0], fit.information[0]
    n_echoes = len(positions)
    if np.linalg.eigvalsh(information)[0] > TINY:
        sigma_bins = noise_sigma * np.sqrt(np.diag(np.linalg.inv(information)))
    else:
        sigma_bins = np.full(n_echoes, math.inf)
    b, d = fit.linear[0, :n_echoes], fit.linear[0, n_echoes:]
    # A cos(w (n - u) + phase) = b cos(w n) + d sin(w n)
    phases = np.angle((b - 1j * d) * np.exp(1j * carrier_rad_per_bin * positions))
    table = np.column_stack([positions, np.hypot(b, d), phases, sigma_bins])
    return tuple(EchoFit(*row) for row in table.tolist())


class Correlation:
    """z of a stretch of one frame, a polynomial around each of its steps.

    ``z`` (n,), complex, is ``step_bins`` apart; ``sigma_bins`` is s of the envelope, ``sigma_y``
    the noise of z per quadrature.
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
    """Limits of the positions, least distance, steps, and z there."""

    first: float
    last: float
    separation: float
    grid: Array
    z: ComplexArray


class _Fit:
    """The echoes at given positions u: amplitudes a, ``inverse`` R^-1, ``explained`` G.

    ``gradient`` and ``information``: half of dG/du, and the Fisher matrix times sigma_y**2.
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
    """Return the echoes between two positions [bins], between one and ``split.max_echoes``.

    ``data`` is z around them, all other echoes of the frame subtracted. Nearest first, positions
    in bins from ``z[0]``, phases with the carrier turned back.
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
    return _fitted_echoes(_polished(data, fit, search, _FINE), data.sigma_y)


def _polished(
    data: Correlation,
    fit: _Fit,
    search: _Search,
    tolerance: float,
    at_least: float = -math.inf,
) -> _Fit:
    """Return the best fit by Levenberg-Marquardt, kept between limits and apart.

    A search is given up when its own forecast, many times over, stays short of ``at_least``.
    """
    first, last, separation = search[:3]
    largest = _LARGEST_STEP * data.sigma_bins
    damping = _DAMPING
    for _ in range(_MAX_STEPS):
        damped = [row.copy() for row in fit.information]
        floor = _LEAST_DAMPING * max(row[k] for k, row in enumerate(damped))
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
            damping *= _EASED
        else:
            gained = promised
            damping *= _STIFFENED
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
    """Return starts as `one_more` does; none where the residual cannot explain what is needed."""
    first, last, separation, grid, z = search
    positions = np.array(fit.positions)
    apart = grid - positions[:, np.newaxis]
    overlap = np.exp(-0.25 * (apart / s) ** 2)
    residual = z - np.array(fit.amplitudes) @ overlap
    norm = 1 - np.einsum("kn,kn->n", overlap, np.array(fit.inverse) @ overlap)
    explained = (residual.real**2 + residual.imag**2) / np.maximum(norm, _LEAST_NORM)
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


def _fitted_echoes(fit: _Fit, sigma_y: float) -> tuple[EchoFit, ...]:
    information = fit.information
    diagonal = [row[k] for k, row in enumerate(information)]
    variances = [math.inf] * len(information)
    if min(diagonal) > _LEAST_INFORMATION * max(diagonal):
        variances = [row[k] for k, row in enumerate(_inverse(information))]
    spread = [sigma_y * math.sqrt(v) if v > 0.0 else math.inf for v in variances]
    return tuple(
        EchoFit(position, abs(a), math.atan2(a.imag, a.real), sigma)
        for position, a, sigma in zip(fit.positions, fit.amplitudes, spread, strict=True)
    )

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

Its loops are in :mod:`slam.front_end.kernels`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from slam.front_end import kernels
from slam.front_end.kernels import (
    BINS_PER_STEP,
    COARSE,
    COLUMNS,
    FINE,
    IMAG,
    INFORMATION,
    LEAST_NORM,
    MAX_ECHOES,
    NOW,
    POSITION,
    REACH_STEPS,
    REAL,
    ROWS,
    STATES,
    U,
)
from slam.front_end.pulse import ComplexArray

Array = NDArray[np.float64]

# How far from the ends of a window echoes are looked for, in envelope sigmas
_OFF_THE_ENDS = 1.5
_LARGEST_RISE = 200.0
# Added to what may be zero where no sample is usable.
TINY = 1e-200
# Of the envelope's sigma: spacing of the start grid. The likelihood is smooth on that scale.
_GRID_STEP = 0.2
_WINDOW = np.arange(2 * REACH_STEPS + 1)
# From nine values of z to the polynomial through them; z is smooth over ten steps.
_TAYLOR = np.linalg.inv(np.vander(_WINDOW - REACH_STEPS, increasing=True)).T.copy()


class FitWindow(NamedTuple):
    """One window to be fitted, its carrier and its samples zero where a sample is not usable."""

    samples: Array  # (n,)
    cosine: Array  # (n,)
    sine: Array  # (n,)
    weight: Array  # (n,): 1 where a sample is usable


class _Fit(NamedTuple):
    """K echoes at given positions."""

    state: Array  # (`ROWS`, `MAX_ECHOES`) of the kernels: positions, b and d of each, ...
    n_echoes: int
    explained: float  # energy

    @property
    def positions(self) -> Array:
        return self.state[U, : self.n_echoes]


def _on_grid(data: FitWindow, samples: Array, envelopes: Array) -> tuple[ComplexArray, Array]:
    """Return the correlation of samples with pulses on a grid, and their squared norms; (n_grid,).

    Cosine and sine columns are orthogonal but for cut pulses.
    """
    matched = envelopes @ (samples * data.cosine) + 1j * (envelopes @ (samples * data.sine))
    norm: Array = 0.5 * (envelopes**2 @ data.weight) + TINY
    return matched, norm


def _envelopes(positions: Array, n_bins: int, sigma: float) -> Array:
    envelopes: Array = np.exp(-0.5 * ((np.arange(n_bins) - positions[:, np.newaxis]) / sigma) ** 2)
    return envelopes


def _best_single(data: FitWindow, grid: Array, envelopes: Array) -> Array:
    """Return the place of the grid where one echo explains most; shape (1,)."""
    matched, norm = _on_grid(data, data.samples, envelopes)
    return grid[[np.argmax(np.abs(matched) ** 2 / norm)]]


def _best_pair(data: FitWindow, grid: Array, envelopes: Array, separation: float) -> Array:
    """Return the pair of the grid that explains most; shape (2,)."""
    one, other = np.triu_indices(len(grid), k=math.ceil(separation / (grid[1] - grid[0])))
    if not one.size:  # a search interval shorter than two echoes' distance
        return grid[[0, -1]]
    matched, norm = _on_grid(data, data.samples, envelopes)
    overlap = (0.5 * (data.weight * envelopes) @ envelopes.T)[one, other]
    energy = np.abs(matched) ** 2
    joint = energy[one] * norm[other] + energy[other] * norm[one]
    joint -= 2 * overlap * (matched[one] * matched[other].conj()).real
    joint /= norm[one] * norm[other] - overlap**2 + TINY
    best = joint.argmax()
    return grid[[one[best], other[best]]]


def _one_more(data: FitWindow, fit: _Fit, grid: Array, *, sigma: float, separation: float) -> Array:
    """Return starts with one more echo: where it explains most, or as a split of one; (s, K)."""
    positions, n = fit.positions, fit.n_echoes
    mine = _envelopes(positions, data.samples.size, sigma)
    envelopes = _envelopes(grid, data.samples.size, sigma)
    residual = data.samples - (fit.state[REAL, :n] @ mine) * data.cosine
    residual -= (fit.state[IMAG, :n] @ mine) * data.sine
    matched, norm = _on_grid(data, residual, envelopes)
    weighted = 0.5 * mine * data.weight
    mixed = weighted @ envelopes.T
    known = np.linalg.solve(weighted @ mine.T + TINY * np.eye(n), mixed)
    left = norm - (mixed * known).sum(axis=0)
    far = np.abs(grid - positions[:, np.newaxis]).min(axis=0) >= separation
    explained = np.where(far, np.abs(matched) ** 2 / np.maximum(left, LEAST_NORM * norm), -1.0)
    starts = [np.append(positions, grid[explained.argmax()])]
    for k in range(n):
        split = np.insert(positions, k, positions[k] - 0.5 * sigma)
        split[k + 1] += 0.5 * sigma
        starts.append(split)
    together: Array = np.sort(np.array(starts), axis=1)
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
    """The pulse that is fitted."""

    envelope_sigma_bins: float  # standard deviation of the Gaussian envelope, in bins
    carrier_rad_per_bin: float  # advance of the carrier's phase per bin


@dataclass(frozen=True, slots=True, kw_only=True)
class SplitTest:
    """When one more echo is accepted."""

    max_echoes: int = MAX_ECHOES  # most echoes of a window
    false_split: float = 1e-3  # probability that noise alone makes one more echo in a window
    # Relative error of the pulse model; 0.08 covers a bandwidth wrong by 10 %.
    model_error: float = 0.08
    min_separation: float = 0.5  # of two echoes, in standard deviations of the envelope


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
    data = FitWindow(
        np.where(weight > 0.0, samples, 0.0),
        np.cos(angle) * weight,
        np.sin(angle) * weight,
        weight,
    )
    columns = np.stack([data.samples + 0j, data.cosine + 1j * data.sine], axis=1)
    separation = split.min_separation * sigma
    states = np.empty((STATES, ROWS, MAX_ECHOES))

    def fitted(starts: Array, tolerance: float) -> _Fit:
        """Return the best of the fits that begin at some starts (n_starts, K), ascending."""
        n_echoes = starts.shape[1]
        best = _Fit(states[NOW], n_echoes, -math.inf)
        for start in starts:
            if np.any(np.diff(start) < separation):
                continue
            states[NOW, U, :n_echoes] = start
            explained = kernels.polish(
                columns,
                sigma,
                noise_sigma,
                first,
                last,
                separation,
                tolerance,
                -math.inf,
                states,
                n_echoes,
            )
            if explained > best.explained:
                best = _Fit(states[NOW].copy(), n_echoes, explained)
        return best

    grid = np.linspace(first, last, max(2, math.ceil((last - first) / (_GRID_STEP * sigma)) + 1))
    envelopes = _envelopes(grid, n_bins, sigma)
    threshold = split_threshold(split.false_split, (last - first) / sigma)
    energy = float(data.samples @ data.samples)

    fit = fitted(_best_single(data, grid, envelopes)[np.newaxis], COARSE)
    while fit.n_echoes < min(split.max_echoes, MAX_ECHOES):
        signal = math.sqrt(max(fit.explained, 0.0))
        needed = (math.sqrt(threshold) * noise_sigma + split.model_error * signal) ** 2
        if not energy - fit.explained > needed:  # no echo can explain more than all that is left
            break
        if fit.n_echoes == 1:
            starts = _best_pair(data, grid, envelopes, separation)[np.newaxis]
        else:
            starts = _one_more(data, fit, grid, sigma=sigma, separation=separation)
        more = fitted(starts, COARSE)
        if not more.explained - fit.explained > needed:
            break
        fit = more
    fit = fitted(fit.positions[np.newaxis], FINE)
    return _echoes(fit, noise_sigma, pulse.carrier_rad_per_bin)


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


def _echoes(fit: _Fit, noise_sigma: float, carrier_rad_per_bin: float) -> tuple[EchoFit, ...]:
    n_echoes, positions = fit.n_echoes, fit.positions
    information = fit.state[INFORMATION : INFORMATION + n_echoes, :n_echoes]
    if np.linalg.eigvalsh(information)[0] > TINY:
        sigma_bins = noise_sigma * np.sqrt(np.diag(np.linalg.inv(information)))
    else:
        sigma_bins = np.full(n_echoes, math.inf)
    b, d = fit.state[[REAL, IMAG], :n_echoes]
    # A cos(w (n - u) + phase) = b cos(w n) + d sin(w n)
    phases = np.angle((b - 1j * d) * np.exp(1j * carrier_rad_per_bin * positions))
    table = np.column_stack([positions, np.hypot(b, d), phases, sigma_bins])
    return tuple(EchoFit(*row) for row in table.tolist())


def fit_whole_echoes(
    y: ComplexArray,
    limits_bins: tuple[float, float],
    *,
    others: Array,
    pulse: KnownPulse,
    sigma_y: float,
    split: SplitTest,
) -> Array:
    """Return a table of the echoes between two positions, between one and ``split.max_echoes``.

    ``y`` is a frame behind the filter, at every second bin, with noise ``sigma_y`` per quadrature;
    the ``others`` (k, `COLUMNS`) are echoes of it to be subtracted. Nearest first; columns
    `POSITION` to `SIGMA` hold positions and deviations in bins, and phases of the carrier.
    """
    s, carrier = pulse.envelope_sigma_bins, pulse.carrier_rad_per_bin
    first, last = limits_bins
    # one step more than z is interpolated from, rounding included
    begin = max(int(first / BINS_PER_STEP) - REACH_STEPS - 1, 0)
    end = min(int(last / BINS_PER_STEP) + REACH_STEPS + 3, y.size)
    z = np.empty(end - begin, dtype=np.complex128)
    around = np.empty((z.size - 2 * REACH_STEPS, 2 * REACH_STEPS + 1), dtype=np.complex128)
    kernels.interpolate(y, others, begin, s, carrier, _TAYLOR, z, around)
    table = np.zeros((MAX_ECHOES, COLUMNS))
    begin_bins = BINS_PER_STEP * begin
    n = kernels.fit_whole(
        around,
        first - begin_bins,
        last - begin_bins,
        s,
        carrier,
        sigma_y,
        split_threshold(split.false_split, math.ceil((last - first) / s)),
        split.model_error,
        split.min_separation * s,
        min(split.max_echoes, MAX_ECHOES),
        np.empty((STATES, ROWS, MAX_ECHOES)),
        table,
    )
    table[:, POSITION] += begin_bins
    return table[:n]

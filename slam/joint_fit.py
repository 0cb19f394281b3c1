"""Least squares of several pulses in one window: their positions, given where to start.

The model and its literature are in `slam.close_echoes`, which decides how many pulses there are.
Everything is batched: a row is one window with one start.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_MAX_STEPS = 30
_LARGEST_STEP = 0.5
"""Of the envelope's sigma."""
_HOPELESS = 1e3
"""Damping at which the search ends: it presses against a limit."""
TINY = 1e-200
"""Added to what may be zero where no sample is usable."""


class Windows(NamedTuple):
    """Rows to be fitted, zero where a sample is not usable.

    Attributes
    ----------
    samples
        Shape (r, n).
    cosine, sine
        Shape (r, n), or (1, n) for all: the carrier.
    weight
        Shape (r, n), or (1, n) for all: 1 where a sample is usable.
    noise_sigma
        Shape (r,): standard deviation of a sample's noise.
    """

    samples: Array
    cosine: Array
    sine: Array
    weight: Array
    noise_sigma: Array

    @staticmethod
    def of(
        samples: Array,
        usable: NDArray[np.bool_] | None,
        noise_sigma: Array,
        carrier_rad_per_bin: float,
    ) -> Windows:
        """Return windows of raw samples; ``usable`` has their shape, all of them if None."""
        angle = carrier_rad_per_bin * np.arange(samples.shape[1])
        cosine, sine = np.cos(angle)[np.newaxis], np.sin(angle)[np.newaxis]
        if usable is None:
            return Windows(samples, cosine, sine, np.ones_like(cosine), noise_sigma)
        weight = usable.astype(np.float64)
        return Windows(
            np.where(usable, samples, 0.0), cosine * weight, sine * weight, weight, noise_sigma
        )

    def rows(self, chosen: NDArray[np.intp]) -> Windows:
        """Return some of the rows."""

        def pick(table: Array) -> Array:
            return table if len(table) == 1 else table[chosen]

        return Windows(
            self.samples[chosen],
            pick(self.cosine),
            pick(self.sine),
            pick(self.weight),
            self.noise_sigma[chosen],
        )


class State(NamedTuple):
    """Everything known at given positions, K per row."""

    positions: Array  # (r, K)
    linear: Array  # (r, 2 K): b of every echo, then d
    sse: Array  # (r,)
    gradient: Array  # (r, K): of half the SSE, downhill
    information: Array  # (r, K, K): sigma**2 times the Fisher matrix of the positions

    def rows(self, chosen: NDArray[np.intp]) -> State:
        """Return some of the rows, copied."""
        return State(*(table[chosen] for table in self))


class Solver:
    """Positions of K echoes by Levenberg-Marquardt, kept in the window and apart.

    Parameters
    ----------
    sigma
        Standard deviation of the envelope, in bins.
    first, last
        Least and largest position, in bins.
    separation
        Least distance of two positions, in bins.
    """

    def __init__(self, sigma: float, first: float, last: float, separation: float) -> None:
        self.sigma = sigma
        self.separation = separation
        self._first = first
        self._last = last

    def fit(self, data: Windows, starts: Array, tolerance: float) -> State:
        """Return the best fit of each window over its starts.

        A row whose positions are never apart enough has an infinite ``sse``.

        Parameters
        ----------
        data
            r windows.
        starts
            Shape (r, n_starts, K): ascending positions.
        tolerance
            A gain of twice the log-likelihood too small to go on.
        """
        n_rows, n_starts, n_echoes = starts.shape
        data = data.rows(np.repeat(np.arange(n_rows), n_starts))
        fitted = evaluate(data, starts.reshape(-1, n_echoes), self.sigma)
        fitted.sse[~self._apart(fitted.positions)] = math.inf
        fitted = self.polish(data, fitted, tolerance)
        best = fitted.sse.reshape(n_rows, n_starts).argmin(axis=1)
        return fitted.rows(best + n_starts * np.arange(n_rows))

    def polish(self, data: Windows, begun: State, tolerance: float) -> State:
        """Return the fit a search that began earlier ends at; parameters as in `fit`."""
        state = begun.rows(np.arange(len(begun.sse)))
        damping = np.full(len(state.sse), 1e-3)
        going = np.arange(len(state.sse))
        diagonal = np.arange(state.positions.shape[1])
        largest = _LARGEST_STEP * self.sigma
        for _ in range(_MAX_STEPS):
            at, data_at = state.rows(going), data.rows(going)
            damped = at.information
            scale = damped[:, diagonal, diagonal]
            floor = 1e-12 * scale.max(axis=1, keepdims=True) + TINY
            damped[:, diagonal, diagonal] += damping[going, np.newaxis] * scale + floor
            step = np.linalg.solve(damped, at.gradient[..., np.newaxis])[..., 0]
            wanted = at.positions + np.clip(step, -largest, largest)
            wanted = np.sort(np.clip(wanted, self._first, self._last), axis=1)
            tried = evaluate(data_at, wanted, self.sigma)
            better = (tried.sse < at.sse) & self._apart(wanted)
            for table, values in zip(state, tried, strict=True):
                table[going[better]] = values[better]
            damping[going] *= np.where(better, 0.1, 10.0)
            # the model's own forecast of the gain, for a step that was not taken
            promised = np.einsum("rk,rk->r", step, at.gradient)
            gained = np.where(better, at.sse - tried.sse, promised)
            open_ends = (gained > tolerance * data_at.noise_sigma**2) & (damping[going] < _HOPELESS)
            going = going[open_ends]
            if not going.size:
                break
        return state

    def _apart(self, positions: Array) -> NDArray[np.bool_]:
        gaps = positions[:, 1:] - positions[:, :-1]
        apart: NDArray[np.bool_] = np.all(gaps >= self.separation, axis=1)
        return apart


def evaluate(data: Windows, positions: Array, sigma: float) -> State:
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
    gram[:, diagonal, diagonal] *= 1 + 1e-13
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


def _on_grid(data: Windows, samples: Array, envelopes: Array) -> tuple[Array, Array]:
    """Return what the starts need of pulses on a grid, edges and gaps of the window included.

    Cosine and sine columns are taken as orthogonal, which they are but for cut pulses.

    Returns
    -------
    Shape (r, n_grid), complex128: correlation of the samples with a pulse; and shape
    (r or 1, n_grid): its squared norm.
    """
    matched = (samples * data.cosine) @ envelopes.T + 1j * ((samples * data.sine) @ envelopes.T)
    norm = 0.5 * data.weight @ (envelopes**2).T
    return matched, norm + TINY


def _envelopes(positions: Array, n_bins: int, sigma: float) -> Array:
    """Return envelopes centred at positions, shape (..., n_bins)."""
    envelopes: Array = np.exp(
        -0.5 * ((np.arange(n_bins) - positions[..., np.newaxis]) / sigma) ** 2
    )
    return envelopes


def best_single(data: Windows, grid: Array, sigma: float) -> Array:
    """Return the place of the grid where one echo explains most; shape (r, 1, 1)."""
    matched, norm = _on_grid(data, data.samples, _envelopes(grid, data.samples.shape[1], sigma))
    best: Array = grid[np.argmax(np.abs(matched) ** 2 / norm, axis=1)]
    return best[:, np.newaxis, np.newaxis]


def best_pair(data: Windows, grid: Array, sigma: float, separation: float) -> Array:
    """Return the pair of the grid that explains most; shape (r, 1, 2)."""
    one, other = np.triu_indices(len(grid), k=math.ceil(separation / (grid[1] - grid[0])))
    if not one.size:  # a search interval shorter than two echoes' distance
        return np.broadcast_to(grid[[0, -1]], (len(data.samples), 1, 2))
    envelopes = _envelopes(grid, data.samples.shape[1], sigma)
    matched, norm = _on_grid(data, data.samples, envelopes)
    overlaps = 0.5 * (data.weight[:, np.newaxis] * envelopes) @ envelopes.T
    overlap = overlaps[:, one, other]
    energy = np.abs(matched) ** 2
    joint = energy[:, one] * norm[:, other] + energy[:, other] * norm[:, one]
    joint -= 2 * overlap * (matched[:, one] * matched[:, other].conj()).real
    joint /= norm[:, one] * norm[:, other] - overlap**2 + TINY
    best = joint.argmax(axis=1)
    return np.stack([grid[one[best]], grid[other[best]]], axis=1)[:, np.newaxis]


def one_more(data: Windows, state: State, grid: Array, sigma: float, separation: float) -> Array:
    """Return starts with one more echo: where it explains most, or as a split of one; (r, s, K)."""
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
    explained = np.where(far, np.abs(matched) ** 2 / np.maximum(left, 1e-3 * norm), -1.0)
    added = grid[explained.argmax(axis=1)][:, np.newaxis]
    starts = [np.concatenate([state.positions, added], axis=1)]
    for k in range(state.positions.shape[1]):
        split = np.insert(state.positions, k, state.positions[:, k] - 0.5 * sigma, axis=1)
        split[:, k + 1] += 0.5 * sigma
        starts.append(split)
    together: Array = np.sort(np.stack(starts, axis=1), axis=2)
    return together.clip(grid[0], grid[-1])

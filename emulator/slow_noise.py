"""Slow Gaussian noise: a stationary process of scene time that can be asked for any instant.

Independent normals, one set per knot of a time grid, are joined by the cubic B-spline:

    x(t) = sum_k g_k B3((t + offset) / spacing - k) / sqrt(B7(0)),  B7(0) = 151/315

The grid's offset is uniform in one spacing and drawn once per process, so over seeds the process is
stationary in the strict sense, with variance 1 and autocorrelation B7(lag / spacing) / B7(0): the
spline of degree 7, nearly a Gaussian of variance 2/3 spacing**2. It is 1/e after 1.185 spacings and
0 after four. Along one path the variance breathes by +-4 % between knots and half-way points.
A sum of such processes with knots ever farther apart has a long tail without long memory.

The sum is computed at instants a fixed step apart, which belong to the process like its knots, and
is linear between them: frames that follow each other fast share two instants. That takes a little
off the variance of the fastest member, at most 2.3 % half-way between instants a quarter of its
spacing apart.

A knot depends on (seed, serial number, purpose, its index) alone, so a value does not depend on
what was asked for before.

Source: I. J. Schoenberg, Quart. Appl. Math. 4 (1946) 45, on cardinal splines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.noise import (
    UNITS_PER_SIGMA,
    Purpose,
    frame_noise_units,
    stream_of,
    uniform_below,
)

__all__ = ["SPACINGS_PER_E_FOLD", "KnotGrid", "SlowNoise"]

SPACINGS_PER_E_FOLD = 1.185
"""Lag at which B7(lag) / B7(0) is 1/e, in knot spacings."""
_KNOTS = 4
_SCALE = (151 / 315) ** -0.5 / UNITS_PER_SIGMA
# Knot indices must not be negative, while a clock that is early may ask for a time before 0.
_FIRST_KNOT = 1 << 40


@dataclass(frozen=True, slots=True, kw_only=True)
class KnotGrid:
    """One member of a sum: how far apart its knots are, and its standard deviation."""

    spacing_ns: int
    sigma: float


class SlowNoise:
    """Several slow processes of the same kind, independent of each other.

    Parameters
    ----------
    grids
        Members of the sum, fastest first; its variance is the sum of their ``sigma**2``.
    n_values
        How many processes.
    instants_per_knot
        Instants in a spacing of the fastest grid.
    seed, serial, purpose
        What selects their values: the run's seed, the module, and what they are for.
    """

    def __init__(
        self,
        grids: tuple[KnotGrid, ...],
        n_values: int,
        *,
        instants_per_knot: int,
        seed: int,
        serial: int,
        purpose: Purpose,
    ) -> None:
        self._grids = grids
        self._seed = seed
        self._streams = [stream_of(serial, purpose, part) for part in range(len(grids))]
        self._instant_ns = grids[0].spacing_ns // instants_per_knot
        # the parts behind the grids' own: their offsets, and that of the instants
        periods_ns = [*(grid.spacing_ns for grid in grids), self._instant_ns]
        *self._offsets_ns, self._instants_offset_ns = (
            uniform_below(period_ns, seed=seed, stream=stream_of(serial, purpose, part))
            for part, period_ns in enumerate(periods_ns, len(grids))
        )
        self._knots = np.empty((len(grids) * _KNOTS, n_values))
        self._first_knots: list[int | None] = [None] * len(grids)

    def instant_before(self, time_ns: int) -> tuple[int, float]:
        """Return the instant before a scene time and the fraction of the way to the next.

        Ask `values_at` for it and its successor.
        """
        instant, rest_ns = divmod(time_ns + self._instants_offset_ns, self._instant_ns)
        return instant, rest_ns / self._instant_ns

    def values_at(self, instant: int) -> NDArray[np.float64]:
        """Return the values at an instant, shape (n_values,), float64."""
        weights: list[float] = []
        for member, grid in enumerate(self._grids):
            since_ns = instant * self._instant_ns + self._offsets_ns[member]
            first_knot, rest_ns = divmod(since_ns, grid.spacing_ns)
            weights += _cubic_weights(rest_ns / grid.spacing_ns, grid.sigma * _SCALE)
            self._move_to(member, first_knot)
        # einsum multiplies and adds in loops of its own, never by BLAS
        values: NDArray[np.float64] = np.einsum("k,kn->n", np.array(weights), self._knots)
        return values

    def _move_to(self, member: int, first_knot: int) -> None:
        """Hold the four knots of a member that begin with one."""
        held = self._first_knots[member]
        if held == first_knot:
            return
        rows = self._knots[member * _KNOTS : (member + 1) * _KNOTS]
        missing = range(_KNOTS)
        if held is not None and 0 < first_knot - held < _KNOTS:
            kept = _KNOTS - (first_knot - held)
            rows[:kept] = rows[_KNOTS - kept :].copy()
            missing = range(kept, _KNOTS)
        counters = np.array([_FIRST_KNOT + first_knot + row for row in missing], dtype=np.int64)
        rows[missing.start :] = frame_noise_units(
            counters, rows.shape[1], seed=self._seed, stream=self._streams[member]
        )
        self._first_knots[member] = first_knot


def _cubic_weights(u: float, scale: float) -> tuple[float, float, float, float]:
    """Return the weights of four knots in a row at a fraction u behind the second."""
    v = 1 - u
    return (
        scale * (v * v * v / 6),
        scale * (2 / 3 - u * u * (2 - u) / 2),
        scale * (2 / 3 - v * v * (2 - v) / 2),
        scale * (u * u * u / 6),
    )

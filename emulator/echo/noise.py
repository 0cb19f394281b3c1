"""Slow Gaussian noise of scene time, and jitter of the carrier phase.

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

The sampler's clock trembles against the transmitter's: every echo of a frame, and the leakage, are
turned by the same phase. White jitter is a new normal for every frame counter; slow jitter is a
stationary process of scene time (``emulator.echo.noise``) that falls to 1/e after the scene's
``slow_correlation_s``. At 7.29 GHz one radian is 3.3 mm of range; the envelope is not moved, which
for 0.03 rad would be 0.1 mm. Amplitude jitter, and jitter within a sweep, are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.scene.philox import (
    UNITS_PER_SIGMA,
    Purpose,
    counter_normals,
    frame_noise_units,
    stream_of,
    uniform_below,
)
from emulator.scene.scene import JitterSpec

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


_INSTANTS_PER_KNOT = 16
_MOST_INSTANTS_KEPT = 64
_COUNTERS_AT_ONCE = 256


class CarrierJitter:
    """The jitter of one radar.

    Parameters
    ----------
    spec
        Standard deviations and correlation time.
    seed, serial
        The run's seed and the module's serial number: they select the jitter.
    """

    def __init__(self, spec: JitterSpec, *, seed: int, serial: int) -> None:
        self._spec = spec
        self._seed = seed
        self._white = stream_of(serial, Purpose.JITTER_WHITE)
        spacing_s = spec.slow_correlation_s / SPACINGS_PER_E_FOLD
        self._slow = SlowNoise(
            (KnotGrid(spacing_ns=round(spacing_s * 1e9), sigma=spec.slow_rad),),
            1,
            instants_per_knot=_INSTANTS_PER_KNOT,
            seed=seed,
            serial=serial,
            purpose=Purpose.JITTER_SLOW,
        )
        self._slow_rad: dict[int, float] = {}
        self._page = -1
        self._normals: list[float] = []

    def phases_rad(
        self, frame_counters: NDArray[np.int64], scene_times_ns: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return what to add to the carrier's phase of every echo of each frame.

        Parameters
        ----------
        frame_counters
            Shape (n_frames,), int64; they select the white part.
        scene_times_ns
            Shape (n_frames,), int64: when this radar truly took each frame.

        Returns
        -------
        Shape (n_frames,), float64, rad.
        """
        white = [0.0] * len(frame_counters)
        if self._spec.white_rad > 0:
            white = [self._white_at(counter) for counter in frame_counters.tolist()]
        slow = [0.0] * len(frame_counters)
        if self._spec.slow_rad > 0:
            slow = [self._slow_at(time_ns) for time_ns in scene_times_ns.tolist()]
        phases_rad: NDArray[np.float64] = np.array(white) * self._spec.white_rad + np.array(slow)
        return phases_rad

    def _slow_at(self, time_ns: int) -> float:
        instant, fraction = self._slow.instant_before(time_ns)
        before = self._slow_rad_at(instant)
        return before + fraction * (self._slow_rad_at(instant + 1) - before)

    def _white_at(self, counter: int) -> float:
        """Return the normal of a counter; made for many at once, since frames come one by one."""
        page, place = divmod(counter, _COUNTERS_AT_ONCE)
        if page != self._page:
            counters = page * _COUNTERS_AT_ONCE + np.arange(_COUNTERS_AT_ONCE, dtype=np.int64)
            normals = counter_normals(counters, seed=self._seed, stream=self._white)
            self._page, self._normals = page, normals.tolist()
        return self._normals[place]

    def _slow_rad_at(self, instant: int) -> float:
        if instant not in self._slow_rad:
            if len(self._slow_rad) > _MOST_INSTANTS_KEPT:
                self._slow_rad.clear()
            self._slow_rad[instant] = float(self._slow.values_at(instant)[0])
        return self._slow_rad[instant]

"""Point or wall: which law the ranges of one reflector follow while the robot moves.

The specular echo of a wall comes from wherever the wall is nearest, so its range is *linear* in
the antenna's position a; a point's is a hyperbola::

    point at b:     r = |b - a|
    wall (phi, d):  r = d - n . a,   n = [cos phi, sin phi]

A corner of two walls sends the pulse back to where it came from by way of both, and the length of
that way is twice the distance to the apex: a corner is a point, for ranges. Both laws have two
unknowns, so the difference of their chi-squares is twice the logarithm of the likelihood ratio
(and that of their BIC). Over a short displacement, or at a great distance, it is near zero, and
nothing is decided. Source of the laws: Leonard and Durrant-Whyte, "Directed Sonar Sensing for
Mobile Robot Navigation", 1992, chapter 2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from slam.robust.symmetric import Array

_STEPS = 8
_DAMPING = 1e-6


class Law(Enum):
    """What ranges over displacement say of a reflector."""

    POINT = "point"
    WALL = "wall"
    UNDECIDED = "undecided"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Sightings:
    """Ranges of one reflector from several places.

    Attributes
    ----------
    antennas_m
        shape (k, 2), in one frame.
    ranges_m, variances
        shape (k,): measured, without the offsets known, and their variances [m^2].
    radars
        shape (k,): index into the offsets.
    offset_covariance
        shape (r, r), of what is not known of the radars' offsets; None where they are known.
    """

    antennas_m: Array
    ranges_m: Array
    variances: Array
    radars: Array
    offset_covariance: Array | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fit:
    """A law at its best.

    Attributes
    ----------
    unknown
        shape (2,): the law's own two.
    offsets_m, radars
        shape (q,): what the offsets of these radars are off by.
    chi_square
        Of the residuals and of the offsets.
    by_law, extra
        d(range) / d(unknown), shape (k, 2), and d(range) / d(offset), shape (k, q).
    """

    unknown: Array
    offsets_m: Array
    radars: tuple[int, ...]
    chi_square: float
    by_law: Array
    extra: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """Chi-squares of the two laws, each at its best."""

    point: float
    wall: float

    def law(self, lead: float) -> Law:
        """Return the law whose chi-square is less by ``lead``, if one is."""
        if self.wall - self.point >= lead:
            return Law.POINT
        return Law.WALL if self.point - self.wall >= lead else Law.UNDECIDED


def compare(sightings: Sightings, toward_rad: float) -> Verdict:
    """Fit both laws to the same ranges.

    Parameters
    ----------
    sightings
        What was measured.
    toward_rad
        Roughly the direction of the reflector, in the frame of the antennas.
    """
    middle = sightings.antennas_m.mean(axis=0)
    range_m = float(sightings.ranges_m.mean())
    n = np.array([math.cos(toward_rad), math.sin(toward_rad)])
    point = _least(sightings, np.array([*(middle + range_m * n)]), _point_law)
    wall = _least(sightings, np.array([toward_rad, range_m + float(n @ middle)]), _wall_law)
    return Verdict(point=point.chi_square, wall=wall.chi_square)


def fit_wall(sightings: Sightings, start: Array) -> Fit:
    """Return the wall (phi, d) of least chi-square near a start."""
    return _least(sightings, start, _wall_law)


def _point_law(unknown: Array, antennas: Array) -> tuple[Array, Array]:
    away = unknown - antennas
    distance = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-6)
    return distance, away / distance[:, None]


def _wall_law(unknown: Array, antennas: Array) -> tuple[Array, Array]:
    c, s = math.cos(float(unknown[0])), math.sin(float(unknown[0]))
    by_angle = s * antennas[:, 0] - c * antennas[:, 1]
    distance = float(unknown[1]) - c * antennas[:, 0] - s * antennas[:, 1]
    return distance, np.column_stack([by_angle, np.ones(len(antennas))])


def _least(
    sightings: Sightings, start: Array, predict: Callable[[Array, Array], tuple[Array, Array]]
) -> Fit:
    """Return a law at its least chi-square: Gauss-Newton, steps halved until it falls."""
    extra, prior, radars = _offset_part(sightings)
    unknown, offsets = start, np.zeros(extra.shape[1])

    def chi_square(unknown: Array, offsets: Array) -> float:
        residual = sightings.ranges_m - predict(unknown, sightings.antennas_m)[0] - extra @ offsets
        return float(residual @ (residual / sightings.variances) + offsets @ prior @ offsets)

    best = chi_square(unknown, offsets)
    for _ in range(_STEPS):
        distance, J = predict(unknown, sightings.antennas_m)
        residual = sightings.ranges_m - distance - extra @ offsets
        J = np.hstack([J, extra])
        weighted = J.T / sightings.variances
        information, gradient = weighted @ J, weighted @ residual
        information[2:, 2:] += prior
        gradient[2:] -= prior @ offsets
        information += _DAMPING * np.diag(information.diagonal() + 1.0)
        change = np.linalg.solve(information, gradient)
        share = 1.0
        while share > 1e-3:
            moved = unknown + share * change[:2], offsets + share * change[2:]
            value = chi_square(*moved)
            if value <= best:
                break
            share *= 0.5
        else:
            break
        decrease, best = best - value, value
        unknown, offsets = moved
        if decrease < 1e-4:
            break
    return Fit(
        unknown=unknown,
        offsets_m=offsets,
        radars=radars,
        chi_square=best,
        by_law=predict(unknown, sightings.antennas_m)[1],
        extra=extra,
    )


def _offset_part(sightings: Sightings) -> tuple[Array, Array, tuple[int, ...]]:
    """Return d(range) / d(offset), (k, q), the offsets' information, (q, q), and whose, (q,)."""
    k = len(sightings.ranges_m)
    if sightings.offset_covariance is None:
        return np.zeros((k, 0)), np.zeros((0, 0)), ()
    used: Sequence[int] = np.unique(sightings.radars).tolist()
    part = (sightings.radars[:, None] == np.array(used)[None, :]).astype(np.float64)
    covariance = sightings.offset_covariance[np.ix_(used, used)] + 1e-12 * np.eye(len(used))
    return part, np.asarray(np.linalg.inv(covariance)), tuple(used)

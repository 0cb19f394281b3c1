"""A prior whose linearisation holds wherever the estimate goes: quadratic in invariant errors.

What poses measured that are kept no longer is a quadratic about where they were linearised. In
additive errors it would fix the direction of the map a little more at every such point, although
no range can see it, and the estimate would become too sure. In right-invariant errors

    e_th = theta - theta0,   e_p = Rot(-e_th) p - p0,   e_l = Rot(-e_th) l - l0
    e_phi = phi - e_th - phi0,   e_d = d - d0 (a wall's)

it does not: turning and shifting robot and map together changes what ranges tell by nothing, and
exactly so. Hence first estimates (FEJ: Huang, Mourikis, Roumeliotis, IJRR 29(5), 2010) need not be
kept for the measurements that stay. Calibration and offsets have additive errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.geometry import wrap_angle
from slam.robust.problem import Estimate, Prior
from slam.robust.state import quarter_turn, rotation
from slam.robust.symmetric import Array

X, HEADING, AFTER_POSE = slice(0, 2), 2, 3


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PriorTerms:
    """Half of the derivatives of a prior's cost at an estimate, in additive errors.

    ``information`` has shape (m, m), ``gradient`` (m,).
    """

    information: Array
    gradient: Array


def first_values(estimate: Estimate) -> Array:
    """Return the values a prior is about: first pose, its calibration, offsets, landmarks."""
    return np.concatenate(
        [
            estimate.poses[0],
            estimate.calibration[0],
            estimate.offsets_m,
            estimate.landmarks_m.ravel(),
        ]
    )


def prior_cost(prior: Prior, values: Array, n_offsets: int) -> float:
    """Return the cost of some values, shape (m,)."""
    e, _ = _errors(prior, values, n_offsets)
    return float(e @ (prior.information @ e + 2.0 * prior.gradient))


def prior_terms(prior: Prior, values: Array, n_offsets: int) -> PriorTerms:
    """Return information and gradient at some values, shape (m,)."""
    e, turned = _errors(prior, values, n_offsets)
    pulled = prior.information @ e
    back = rotation(-wrap_angle(float(values[HEADING] - prior.mean[HEADING])))
    points = _points(len(values), n_offsets, prior.n_walls)
    by_heading = -_swept(turned, points)
    half = _right(prior.information, back, by_heading, points)
    information = _right(half.T, back, by_heading, points)
    gradient = _right((pulled + prior.gradient)[None, :], back, by_heading, points)[0]
    return PriorTerms(
        information=(information + information.T) / 2,
        gradient=gradient,
    )


def prior_about(
    information: Array, gradient: Array, values: Array, n_offsets: int, n_walls: int = 0
) -> Prior:
    """Return the prior that has this information and gradient of additive errors at values."""
    points = _points(len(values), n_offsets, n_walls)
    by_heading = _swept(values, points)
    stay = np.eye(2)
    half = _right(information, stay, by_heading, points)
    whole = _right(half.T, stay, by_heading, points)
    return Prior(
        information=(whole + whole.T) / 2,
        gradient=_right(gradient[None, :], stay, by_heading, points)[0],
        mean=values.copy(),
        n_walls=n_walls,
    )


def _errors(prior: Prior, values: Array, n_offsets: int) -> tuple[Array, Array]:
    """Return the errors e, and the values with all points turned back by e_th."""
    angle = wrap_angle(float(values[HEADING] - prior.mean[HEADING]))
    turned, points = values.copy(), _points(len(values), n_offsets, prior.n_walls)
    back = rotation(-angle)
    turned[X] = back @ values[X]
    turned[points] = (values[points].reshape(-1, 2) @ back.T).ravel()
    turned[points.stop :: 2] -= angle
    e = turned - prior.mean
    e[HEADING] = angle
    return e, turned


def _points(size: int, n_offsets: int, n_walls: int) -> slice:
    """Return where the landmarks that are no walls lie."""
    return slice(6 + n_offsets, size - 2 * n_walls)


def _swept(values: Array, points: slice) -> Array:
    """Return how points and walls of some values move per radian about the origin, shape (m,)."""
    swept = np.zeros(len(values))
    swept[X] = quarter_turn(values[X])
    swept[points] = quarter_turn(values[points].reshape(-1, 2)).ravel()
    swept[points.stop :: 2] = 1.0
    return swept


def _right(rows: Array, turn: Array, by_heading: Array, points: slice) -> Array:
    """Return rows times the matrix [points: turn, heading column: by_heading + 1, rest: I]."""
    result = rows.copy()
    result[:, HEADING] += rows @ by_heading
    result[:, X] = rows[:, X] @ turn
    turned = rows[:, points].reshape(len(rows), -1, 2) @ turn
    result[:, points] = turned.reshape(len(rows), -1)
    return result

"""A point seen in the body frame meets the map: it is a known landmark, or a new one.

A point b with noise n and known dependence D_b on the radars' range offsets measures

    y = b - R^T (l - p),   H = [e_p: -R^T, e_l: R^T, e_b: -D_b],   S = H P H^T + C_b,

and a new landmark is l = p + R b with e_l = e_p + R D_b e_b + R n: correlated with all that the
pose is correlated with. (In right-invariant errors the heading enters neither.)
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.robust.parameters import MapRule
from slam.robust.state import POSITION, State, rotation
from slam.robust.symmetric import Array, Indices


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BodyPoint:
    """A point in the body frame of now.

    ``point_m`` (2,), ``covariance`` (2, 2), ``by_offsets`` (2, r): d(point) / d(range offsets);
    ``outward`` (2,): away from where it was seen from, where the axis of a round target lies.
    """

    point_m: Array
    covariance: Array
    by_offsets: Array
    outward: Array | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FeatureRows:
    """What is seen against one of the map: residual (2,), H (2, c) on columns ``at``, S (2, 2)."""

    residual: Array
    at: Indices
    H: Array
    S: Array

    @property
    def mahalanobis_sq(self) -> float:
        """Return the squared Mahalanobis distance (2 dof)."""
        return float(self.residual @ np.linalg.solve(self.S, self.residual))

    @property
    def log_det(self) -> float:
        """Return ln det S."""
        return math.log(float(np.linalg.det(self.S)))


def point_rows(state: State, row: int, point: BodyPoint) -> FeatureRows:
    """Return residual, H and S of a point that would be the landmark in ``row``."""
    R = rotation(state.heading_rad)
    offsets = np.arange(state.offsets.start, state.offsets.stop)
    at = np.concatenate([np.array([1, 2]), offsets, state.landmark_columns(np.array([row]))])
    H = np.hstack([-R.T, -point.by_offsets, R.T])
    S = H @ state.P.block(at) @ H.T + point.covariance
    seen_m = point.point_m
    if point.outward is not None and (radius_m := state.radii_m.get(state.landmark_ids[row], 0.0)):
        seen_m = seen_m + radius_m * point.outward
    return FeatureRows(
        residual=seen_m - R.T @ (state.landmarks_m[row] - state.position_m),
        at=at,
        H=H,
        S=(S + S.T) / 2,
    )


def near_rows(state: State, point: BodyPoint, reach_m: float) -> NDArray[np.intp]:
    """Return the rows of landmarks within reach of a point; O(n)."""
    place = state.position_m + rotation(state.heading_rad) @ point.point_m
    away = state.landmarks_m - place
    return np.flatnonzero(np.hypot(away[:, 0], away[:, 1]) <= reach_m)


def match(
    state: State, point: BodyPoint, rule: MapRule, elsewhere: Collection[int] = ()
) -> int | None:
    """Return the row of the landmark that a point is, or None where none stands out.

    A match must pass the gate, be likelier than a landmark not yet in the map,
    ``N(residual; 0, S) > beta``, and beat the next best in ``d^2 + ln det S``. Landmarks whose ids
    are ``elsewhere`` are out of reach.
    """
    scored = []
    for row in near_rows(state, point, rule.merge_reach_m):
        if state.landmark_ids[row] in elsewhere:
            continue
        rows = point_rows(state, int(row), point)
        scored.append((rows.mahalanobis_sq + rows.log_det, rows.mahalanobis_sq, int(row)))
    if not scored:
        return None
    scored.sort()
    score, distance, best = scored[0]
    if distance > rule.match_gate:
        return None
    if -0.5 * score - math.log(math.tau) <= math.log(rule.unmapped_per_m2):
        return None
    if len(scored) > 1 and scored[1][0] - score < rule.match_lead:
        return None
    return best


def update_with_point(state: State, row: int, point: BodyPoint) -> float:
    """Correct the state with a point that is the landmark in ``row``; return the NIS (2 dof)."""
    rows = point_rows(state, row, point)
    nis, _ = state.update(rows.at, rows.H, rows.residual, point.covariance)
    return nis


def give_birth(state: State, point: BodyPoint) -> int:
    """Append a point to the map; return the new landmark's id."""
    R = rotation(state.heading_rad)
    at = np.arange(state.offsets.stop)
    columns = state.P.columns(at)
    G = np.zeros((2, len(at)))
    G[:, POSITION] = np.eye(2)
    G[:, state.offsets] = R @ point.by_offsets
    cross = columns @ G.T
    corner = G @ cross[at] + R @ point.covariance @ R.T
    return state.augment(state.position_m + R @ point.point_m, cross, (corner + corner.T) / 2)

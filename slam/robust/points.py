"""Ranges and bearings of points, seen from the body's origin: for sensors that measure both.

With b = R^T (l - p) in the body frame, z = (|b|, atan2(b_y, b_x)) and G = dz / db::

    H = [e_p: -G R^T, e_l: G R^T]

A point is matched to the landmark of least Mahalanobis distance, all points of one time together
and no landmark twice, or named by whoever knows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from slam.geometry import wrap_angle
from slam.robust.births import BodyPoint, FeatureRows
from slam.robust.state import State, rotation
from slam.robust.symmetric import Array

_FORBIDDEN = 1e9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RangeBearing:
    """One point seen: range [m] and bearing [rad] in the body frame, covariance (2, 2).

    ``label`` names the target where that is known.
    """

    range_m: float
    bearing_rad: float
    covariance: Array
    label: int | None = None

    @property
    def values(self) -> Array:
        """Return [range m, bearing rad], shape (2,)."""
        return np.array([self.range_m, self.bearing_rad])

    def body_point(self, n_radars: int) -> BodyPoint:
        """Return the point in the body frame, its covariance to first order."""
        c, s = math.cos(self.bearing_rad), math.sin(self.bearing_rad)
        G = np.array([[c, -self.range_m * s], [s, self.range_m * c]])
        return BodyPoint(
            point_m=self.range_m * np.array([c, s]),
            covariance=G @ self.covariance @ G.T,
            by_offsets=np.zeros((2, n_radars)),
        )


def range_bearing_rows(state: State, row: int, seen: RangeBearing) -> FeatureRows:
    """Return residual, H and S of a point that would be the landmark in ``row``."""
    R = rotation(state.heading_rad)
    b = R.T @ (state.landmarks_m[row] - state.position_m)
    q = float(b @ b)
    r = math.sqrt(q)
    G = np.array([[b[0] / r, b[1] / r], [-b[1] / q, b[0] / q]]) @ R.T
    at = np.concatenate([np.array([1, 2]), state.landmark_columns(np.array([row]))])
    H = np.hstack([-G, G])
    S = H @ state.P.block(at) @ H.T + seen.covariance
    residual = seen.values - np.array([r, math.atan2(b[1], b[0])])
    residual[1] = wrap_angle(float(residual[1]))
    return FeatureRows(residual=residual, at=at, H=H, S=(S + S.T) / 2)


def named_rows(
    state: State, points: Sequence[RangeBearing], landmark_of_label: Mapping[int, int]
) -> list[int | None] | None:
    """Return the rows that labels name, -1 for new ones; None if not every point has a label."""
    labels = [point.label for point in points if point.label is not None]
    if len(labels) < len(points):
        return None
    known = {id_: row for row, id_ in enumerate(state.landmark_ids)}
    return [known.get(landmark_of_label.get(label, -1), -1) for label in labels]


def assign(
    state: State, points: Sequence[RangeBearing], gate: float, new_gate: float, reach_m: float
) -> list[int | None]:
    """Return for each point the row of its landmark, -1 for a new one, None where in doubt.

    A point farther than ``new_gate`` (squared Mahalanobis distance) from every landmark is new;
    one that is nearer but not assigned is in doubt.
    """
    if not points:
        return []
    n = len(state.landmark_ids)
    cost = np.full((len(points), n + len(points)), _FORBIDDEN)
    nearest = np.full(len(points), math.inf)
    R = rotation(state.heading_rad)
    for i, point in enumerate(points):
        cost[i, n + i] = gate
        place = state.position_m + R @ point.body_point(0).point_m
        away = state.landmarks_m - place
        for row in np.flatnonzero(np.hypot(away[:, 0], away[:, 1]) <= reach_m):
            distance = range_bearing_rows(state, int(row), point).mahalanobis_sq
            nearest[i] = min(nearest[i], distance)
            if distance < gate:
                cost[i, row] = distance
    rows: list[int | None] = []
    columns = linear_sum_assignment(cost)[1].tolist()
    for column, distance in zip(columns, nearest.tolist(), strict=True):
        if column < n:
            rows.append(column)
        else:
            rows.append(-1 if distance > new_gate else None)
    return rows

"""Walls of the map: lines that a wall seen from the robot becomes, or is recognised as.

A wall in the body frame, (phi_b, d_b) with noise n and known dependence D on the radars' range
offsets, measures

    phi_b = phi - theta,   d_b = d - n . p,
    H = [e_p: (0; -n), e_phi: (1; -(J n) . p), e_d: (0; 1), e_b: -D],   S = H P H^T + C,

with no entry for the heading, and a new wall has e_phi = D_phi e_b + n_phi,
e_d = n . e_p + (J n) . p e_phi + D_d e_b + n_d. A wall ends somewhere: the parts of it that
answered are kept in cells along it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from slam.geometry import wrap_angle
from slam.robust.births import FeatureRows
from slam.robust.parameters import WallRule
from slam.robust.ranges import Antennas, View
from slam.robust.state import State, rotation
from slam.robust.symmetric import Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BodyWall:
    """A wall in the body frame of now.

    ``wall`` (2,): phi [rad], d [m]; ``covariance`` (2, 2); ``by_offsets`` (2, r): d(phi, d) /
    d(range offsets); ``feet_m`` (k, 2): places on it that answered.
    """

    wall: Array
    covariance: Array
    by_offsets: Array
    feet_m: Array

    def in_map(self, state: State) -> Array:
        """Return the places that answered in the map frame, shape (k, 2)."""
        return np.asarray(state.position_m + self.feet_m @ rotation(state.heading_rad).T)


class WallCells:
    """Which parts of which walls have answered, by id, in cells along the wall.

    Parameters
    ----------
    cell_m
        Length of a cell.
    """

    def __init__(self, cell_m: float) -> None:
        self._cell_m = cell_m
        self._cells: dict[int, set[int]] = {}

    def add(self, wall_id: int, along_m: Array) -> None:
        """Note that a wall answered at these places, shape (k,)."""
        cells = np.floor(along_m / self._cell_m).astype(np.intp).tolist()
        self._cells.setdefault(wall_id, set()).update(cells)

    def distance_m(self, wall_id: int, along_m: float) -> float:
        """Return how far a place is from the nearest cell that answered."""
        cells = self._cells.get(wall_id)
        if not cells:
            return math.inf
        here = math.floor(along_m / self._cell_m)
        return self._cell_m * min(abs(here - cell) for cell in cells)

    def surrounds(self, wall_id: int, along_m: float) -> bool:
        """Tell whether the cell of a place and both its neighbours answered."""
        cells = self._cells.get(wall_id, set())
        here = math.floor(along_m / self._cell_m)
        return {here - 1, here, here + 1} <= cells

    def spans_m(self, wall_id: int) -> list[tuple[float, float]]:
        """Return the stretches that answered, as (from, to) along the wall."""
        spans: list[tuple[float, float]] = []
        for cell in sorted(self._cells.get(wall_id, ())):
            begin, end = cell * self._cell_m, (cell + 1) * self._cell_m
            if spans and begin - spans[-1][1] < 0.5 * self._cell_m:
                spans[-1] = (spans[-1][0], end)
            else:
                spans.append((begin, end))
        return spans

    def merge(self, kept: int, gone: int) -> None:
        """Let one wall take over the cells of another."""
        self._cells.setdefault(kept, set()).update(self._cells.pop(gone, set()))

    def forget(self, wall_id: int) -> None:
        """Drop a wall."""
        self._cells.pop(wall_id, None)


def along_wall(state: State, wall_row: int, places_m: Array) -> Array:
    """Return where along a wall some places lie [m], counted from the foot of the origin."""
    phi = float(state.walls[wall_row, 0])
    return np.asarray(places_m @ np.array([-math.sin(phi), math.cos(phi)]))


def wall_rows(state: State, wall_row: int, seen: BodyWall) -> FeatureRows:
    """Return residual, H and S of a wall seen that would be the mapped one."""
    phi, d = (float(value) for value in state.walls[wall_row])
    n = np.array([math.cos(phi), math.sin(phi)])
    along = float(state.position_m @ np.array([-n[1], n[0]]))
    offsets = np.arange(state.offsets.start, state.offsets.stop)
    columns = state.landmark_columns(np.array([len(state.landmark_ids) + wall_row]))
    at = np.concatenate([np.array([1, 2]), offsets, columns])
    by_position = np.array([[0.0, 0.0], -n])
    by_wall = np.array([[1.0, 0.0], [-along, 1.0]])
    H = np.hstack([by_position, -seen.by_offsets, by_wall])
    S = H @ state.P.block(at) @ H.T + seen.covariance
    expected = np.array([phi - state.heading_rad, d - float(n @ state.position_m)])
    residual = seen.wall - expected
    residual[0] = wrap_angle(float(residual[0]))
    return FeatureRows(residual=residual, at=at, H=H, S=(S + S.T) / 2)


def match_wall(state: State, seen: BodyWall, cells: WallCells, rule: WallRule) -> int | None:
    """Return the row of the wall that a wall seen is, or None where none stands out.

    As for points: the match must pass the gate, be likelier than a wall not yet in the map, and
    beat the next best; and the two must come within reach of each other along the line.
    """
    feet = seen.in_map(state)
    scored = []
    for row, wall_id in enumerate(state.wall_ids):
        along = along_wall(state, row, feet)
        if min(cells.distance_m(wall_id, float(place)) for place in along) > rule.reach_m:
            continue
        rows = wall_rows(state, row, seen)
        scored.append((rows.mahalanobis_sq + rows.log_det, rows.mahalanobis_sq, row))
    if not scored:
        return None
    scored.sort()
    score, distance, best = scored[0]
    if distance > rule.match_gate:
        return None
    if -0.5 * score - math.log(math.tau) <= math.log(rule.unmapped_per_rad_m):
        return None
    if len(scored) > 1 and scored[1][0] - score < rule.match_lead:
        return None
    return best


def is_unresolved(state: State, seen: BodyWall, cells: WallCells, rule: WallRule) -> bool:
    """Tell whether a wall seen is nearer to a mapped one than radars tell two walls apart."""
    feet = seen.in_map(state)
    phi_seen = float(seen.wall[0]) + state.heading_rad
    for row, wall_id in enumerate(state.wall_ids):
        phi, d = (float(value) for value in state.walls[row])
        if abs(wrap_angle(phi_seen - phi)) > rule.resolution_rad:
            continue
        apart = np.abs(feet @ np.array([math.cos(phi), math.sin(phi)]) - d)
        along = along_wall(state, row, feet)
        near = [cells.distance_m(wall_id, float(place)) <= rule.reach_m for place in along]
        if float(apart.max()) <= rule.resolution_m and any(near):
            return True
    return False


def update_with_wall(state: State, wall_row: int, seen: BodyWall) -> float:
    """Correct the state with a wall seen that is a mapped one; return the NIS (2 dof)."""
    rows = wall_rows(state, wall_row, seen)
    nis, _ = state.update(rows.at, rows.H, rows.residual, seen.covariance)
    return nis


def give_birth_to_wall(state: State, seen: BodyWall) -> int:
    """Append a wall seen to the map; return its id."""
    phi = state.heading_rad + float(seen.wall[0])
    n = np.array([math.cos(phi), math.sin(phi)])
    along = float(state.position_m @ np.array([-n[1], n[0]]))
    d = float(seen.wall[1] + n @ state.position_m)
    by_noise = np.array([[1.0, 0.0], [along, 1.0]])
    at = np.arange(state.offsets.stop)
    G = np.zeros((2, len(at)))
    G[1, 1:3] = n
    G[:, state.offsets] = by_noise @ seen.by_offsets
    cross = state.P.columns(at) @ G.T
    corner = G @ cross[at] + by_noise @ seen.covariance @ by_noise.T
    return state.augment_wall(np.array([phi, d]), cross, (corner + corner.T) / 2)


def foot_points(state: State, wall_row: int, antennas: Antennas) -> Array:
    """Return where each antenna's echo of a wall comes from, map frame, shape (r, 2)."""
    phi, d = (float(value) for value in state.walls[wall_row])
    n = np.array([math.cos(phi), math.sin(phi)])
    places = state.position_m + antennas.position_m @ rotation(state.heading_rad).T
    return np.asarray(places + np.outer(d - places @ n, n))


def hide_unknown(state: State, seen: View, feet_m: Array, cells: WallCells) -> View:
    """Turn walls out of view where no wall tracklet has shown them.

    The end of a wall answers, too, from farther on: its edge's range leaves the wall's by
    x^2 / 2 r only, within the gates of single ranges for long, and would turn wall and pose.

    ``feet_m`` has shape (r, w, 2): where echoes come from.
    """
    n = len(state.landmark_ids)
    off = seen.off_boresight_rad.copy()
    for row, wall_id in enumerate(state.wall_ids):
        for radar, place in enumerate(along_wall(state, row, feet_m[:, row]).tolist()):
            if not cells.surrounds(wall_id, place):
                off[radar, n + row] = math.pi
    return replace(seen, off_boresight_rad=off)

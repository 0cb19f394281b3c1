"""Walls: shown by patches, recognised, and predicted where they are known.

Patches show walls, as they show points, with range and bearing; two patches that agree make one.
Ranges alone make no wall, but what follows a wall's law is no point
(:mod:`slam.robust.initialisation`).

A wall in the body frame, (phi_b, d_b) with noise n and known dependence D on the radars' range
offsets, measures

    phi_b = phi - theta,   d_b = d - n . p,
    H = [e_p: (0; -n), e_phi: (1; -(J n) . p), e_d: (0; 1), e_b: -D],   S = H P H^T + C,

with no entry for the heading, and a new wall has e_phi = D_phi e_b + n_phi,
e_d = n . e_p + (J n) . p e_phi + D_d e_b + n_d. Walls end: the stretches that gave echoes are kept
in cells along the wall.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from slam.geometry import wrap_angle
from slam.results import SavedWall
from slam.robust.association import Antennas, View
from slam.robust.initialisation import (
    BodyTarget,
    FeatureRows,
    PointDetection,
    certain_row,
    fused,
)
from slam.robust.parameters import (
    TAIL_PROBABILITY,
    BackEndParameters,
    WallRule,
)
from slam.robust.state import HEAD_SIZE, Array, Motion, State, quarter_turn, rotation


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BodyWall(BodyTarget):
    """A wall in the newest body frame."""

    wall: Array  # shape (2,): phi [rad], d [m]
    feet_m: Array  # shape (k, 2), where its echoes came from

    def in_map(self, state: State) -> Array:
        """Return where its echoes came from in the map frame, shape (k, 2)."""
        return np.asarray(state.position_m + self.feet_m @ rotation(state.heading_rad).T)


class WallCells:
    """Which stretches of which walls gave echoes, by id, in cells of ``cell_m`` along the wall."""

    def __init__(self, cell_m: float) -> None:
        self._cell_m = cell_m
        self._cells: dict[int, set[int]] = {}

    def add(self, wall_id: int, along_m: Array) -> None:
        """Record echoes of a wall at these places, shape (k,)."""
        cells = np.floor(along_m / self._cell_m).astype(np.intp).tolist()
        self._cells.setdefault(wall_id, set()).update(cells)

    def of(self, wall_id: int) -> tuple[int, ...]:
        """Return the cells of a wall, in order."""
        return tuple(sorted(self._cells.get(wall_id, ())))

    def know(self, wall_id: int, cells: Collection[int]) -> None:
        self._cells[wall_id] = set(cells)

    def distance_m(self, wall_id: int, along_m: float) -> float:
        cells = self._cells.get(wall_id)
        if not cells:
            return math.inf
        here = math.floor(along_m / self._cell_m)
        return self._cell_m * min(abs(here - cell) for cell in cells)

    def is_near(self, wall_id: int, along_m: Array, reach_m: float) -> bool:
        """Return whether any of some places, shape (k,), is within reach of an echo of a wall."""
        return any(self.distance_m(wall_id, place) <= reach_m for place in along_m.tolist())

    def surrounds(self, wall_id: int, along_m: float) -> bool:
        cells = self._cells.get(wall_id, set())
        here = math.floor(along_m / self._cell_m)
        return {here - 1, here, here + 1} <= cells

    def spans_m(self, wall_id: int) -> list[tuple[float, float]]:
        """Return the stretches that gave echoes, as (from, to) along the wall."""
        spans: list[tuple[float, float]] = []
        for cell in self.of(wall_id):
            begin, end = cell * self._cell_m, (cell + 1) * self._cell_m
            if spans and begin - spans[-1][1] < 0.5 * self._cell_m:
                spans[-1] = (spans[-1][0], end)
            else:
                spans.append((begin, end))
        return spans

    def ends_m(self, wall_id: int, phi: float, d: float) -> Array:
        """Return the ends of these stretches of a wall (phi, d), shape (k, 2, 2), map frame."""
        n, t = np.array([np.cos(phi), np.sin(phi)]), np.array([-np.sin(phi), np.cos(phi)])
        spans = np.array(self.spans_m(wall_id)).reshape(-1, 2)
        return np.asarray(d * n + spans[:, :, None] * t)

    def forget(self, wall_id: int) -> None:
        self._cells.pop(wall_id, None)


def along_wall(state: State, wall_row: int, places_m: Array) -> Array:
    """Return where along a wall some places lie [m], counted from the foot of the origin."""
    phi = float(state.walls[wall_row, 0])
    return np.asarray(places_m @ np.array([-math.sin(phi), math.cos(phi)]))


def wall_rows(state: State, wall_row: int, seen: BodyWall) -> FeatureRows:
    phi, d = (float(value) for value in state.walls[wall_row])
    n = np.array([math.cos(phi), math.sin(phi)])
    along = float(state.position_m @ np.array([-n[1], n[0]]))
    columns = state.landmark_columns(np.array([len(state.landmark_ids) + wall_row]))
    at = np.concatenate([np.array([1, 2]), state.radar_columns, columns])
    by_position = np.array([[0.0, 0.0], -n])
    by_wall = np.array([[1.0, 0.0], [-along, 1.0]])
    H = np.hstack([by_position, -seen.by_offsets, by_wall])
    S = H @ state.P.block(at) @ H.T + seen.covariance
    expected = np.array([phi - state.heading_rad, d - float(n @ state.position_m)])
    residual = seen.wall - expected
    residual[0] = wrap_angle(float(residual[0]))
    return FeatureRows(residual=residual, at=at, H=H, S=(S + S.T) / 2)


def match_wall(
    state: State, seen: BodyWall, cells: WallCells, parameters: BackEndParameters
) -> int | None:
    """Return the row of the wall that a wall seen certainly is, or None.

    The rule is that of points; and the two must come within reach of each other along the line. The
    walls of the map are spread over all directions and the distances that a radar sees.
    """
    feet, reach_m = seen.in_map(state), parameters.walls.reach_m
    beta = max(len(state.wall_ids), 1) / (math.tau * parameters.ranges.max_range_m)
    found = {
        row: wall_rows(state, row, seen)
        for row, wall_id in enumerate(state.wall_ids)
        if cells.is_near(wall_id, along_wall(state, row, feet), reach_m)
    }
    return certain_row(found, beta)


def is_unresolved(state: State, seen: BodyWall, cells: WallCells, rule: WallRule) -> bool:
    """Return whether a wall seen is too near to a mapped one for radars to separate the two."""
    feet = seen.in_map(state)
    phi_seen = float(seen.wall[0]) + state.heading_rad
    for row, wall_id in enumerate(state.wall_ids):
        phi, d = (float(value) for value in state.walls[row])
        if abs(wrap_angle(phi_seen - phi)) > rule.resolution_rad:
            continue
        apart = np.abs(feet @ np.array([math.cos(phi), math.sin(phi)]) - d)
        if float(apart.max()) > rule.resolution_m:
            continue
        if cells.is_near(wall_id, along_wall(state, row, feet), rule.reach_m):
            return True
    return False


def update_with_wall(state: State, wall_row: int, seen: BodyWall) -> float:
    """Correct the state with a measurement of a mapped wall; return the NIS (2 dof)."""
    rows = wall_rows(state, wall_row, seen)
    return state.update(rows.at, rows.H, rows.residual, seen.covariance)


def initialise_wall(state: State, seen: BodyWall) -> int:
    phi = state.heading_rad + float(seen.wall[0])
    n = np.array([math.cos(phi), math.sin(phi)])
    along = float(state.position_m @ np.array([-n[1], n[0]]))
    d = float(seen.wall[1] + n @ state.position_m)
    by_noise = np.array([[1.0, 0.0], [along, 1.0]])
    at = np.arange(state.n_fixed)
    G = np.zeros((2, len(at)))
    G[1, 1:3] = n
    G[:, HEAD_SIZE:] = by_noise @ seen.by_offsets
    cross = state.P.columns(at) @ G.T
    corner = G @ cross[at] + by_noise @ seen.covariance @ by_noise.T
    return state.augment_wall(np.array([phi, d]), cross, (corner + corner.T) / 2)


Face = tuple[PointDetection, tuple[float, float]]
"""A face of a patch: its perpendicular, and the stretch that answered (`RangeScan.faces_m`)."""


def body_wall(state: State, antennas: Antennas, face: Face, rule: WallRule) -> BodyWall:
    """Return where a face lies in the newest body frame, the offset of its radar removed.

    Its noise is that of the face, of the roughness of walls, and as much larger as errors of the
    run are alike.
    """
    detection, (first_m, last_m) = face
    radar, layout = detection.radar, state.layout
    phi, antenna = detection.bearing_rad + detection.turn_rad, antennas.position_m[radar]
    n = np.array([math.cos(phi), math.sin(phi)])
    left, range_m = quarter_turn(n), detection.range_m - float(state.offsets_m[radar])
    by_measured = np.array([[1.0, 0.0], [float(left @ antenna), 1.0]])
    share = max(state.range_errors.variance_share, 1.0)
    of_range = detection.sigma_m**2 + rule.roughness_m**2
    spread = share * np.diag([detection.bearing_sigma_rad**2, of_range])
    along_m = np.linspace(first_m, last_m, 2 + math.floor((last_m - first_m) / rule.cell_m))
    by_radar = np.zeros((2, state.n_fixed - HEAD_SIZE))
    by_radar[1, radar] = -1.0
    if layout.has_mounts:
        mount = layout.n_radars + 2 * radar
        by_radar[1, mount : mount + 2] = n @ rotation(detection.turn_rad)
    return BodyWall(
        wall=np.array([phi, range_m + float(n @ antenna)]),
        covariance=by_measured @ spread @ by_measured.T,
        by_offsets=by_radar,
        feet_m=antenna + range_m * n + np.outer(along_m, left),
    )


@dataclass(slots=True, kw_only=True, eq=False)
class TentativeWall:
    """What may be a wall: a line in the newest body frame, and the faces that are of it."""

    wall: BodyWall
    seen: list[PointDetection]
    misses: int = 0  # patches since the last one that showed it

    def move(self, motion: Motion) -> None:
        """Move the body frame: phi' = phi - a, d' = d - n . step, and the noise of (step, a)."""
        before = self.wall
        phi, d = before.wall.tolist()
        n = np.array([math.cos(phi), math.sin(phi)])
        by_wall = np.array([[1.0, 0.0], [-float(motion.step_m @ quarter_turn(n)), 1.0]])
        by_motion = np.array([[0.0, 0.0, -1.0], [-n[0], -n[1], 0.0]])
        noise = by_motion @ motion.covariance @ by_motion.T
        self.wall = BodyWall(
            wall=np.array([phi - motion.turn_rad, d - float(n @ motion.step_m)]),
            covariance=by_wall @ before.covariance @ by_wall.T + noise,
            by_offsets=by_wall @ before.by_offsets,
            feet_m=(before.feet_m - motion.step_m) @ rotation(motion.turn_rad),
        )

    def residual(self, new: BodyWall) -> Array:
        """Return how far a face is from it, (2,): phi [rad], d [m]."""
        phi, d = (new.wall - self.wall.wall).tolist()
        return np.array([wrap_angle(phi), d])

    def fuse(self, detection: PointDetection, new: BodyWall) -> None:
        """Take in a face that is of it."""
        before = self.wall
        change, covariance, by_offsets, _ = fused(before, new, self.residual(new))
        self.wall = BodyWall(
            wall=before.wall + change,
            covariance=covariance,
            by_offsets=by_offsets,
            feet_m=np.concatenate([before.feet_m, new.feet_m]),
        )
        self.seen.append(detection)


class TentativeWalls:
    """Faces of patches that are of no wall yet.

    Of a cylinder or an edge a patch may show a tangent, which turns from patch to patch, so that it
    does not agree with earlier ones.
    """

    def __init__(self, parameters: BackEndParameters) -> None:
        self._parameters = parameters
        self._walls: list[TentativeWall] = []

    def move(self, motion: Motion) -> None:
        for one in self._walls:
            one.move(motion)

    def clear(self) -> None:
        self._walls = []

    def forget_before(self, pose: int) -> None:
        """Forget those that were seen before a pose, by index in the log."""
        self._walls = [one for one in self._walls if one.seen[0].pose >= pose]

    def take(self, faces: Sequence[tuple[PointDetection, BodyWall]]) -> list[TentativeWall]:
        """Take in the faces of a patch; return those that are walls by now, and forget them."""
        free, shown = self._walls.copy(), list[TentativeWall]()
        for detection, wall in faces:
            one = self._nearest(wall, free)
            if one is None:
                one = TentativeWall(wall=wall, seen=[detection])
            else:
                free.remove(one)
                one.fuse(detection, wall)
            one.misses = 0
            shown.append(one)
        for one in free:
            one.misses += 1
        fewest, window = self._parameters.imaged.new_patches, self._parameters.initialisation.window
        self._walls = [one for one in free if one.misses <= window]
        self._walls += [one for one in shown if len(one.seen) < fewest]
        return [one for one in shown if len(one.seen) >= fewest]

    def _nearest(self, wall: BodyWall, among: Sequence[TentativeWall]) -> TentativeWall | None:
        """Return the one that a face is likeliest of, None if it agrees with none."""
        limit, most, nearest = float(chdtri(2, TAIL_PROBABILITY)), math.inf, None
        for one in among:
            nu, S = one.residual(wall), one.wall.covariance + wall.covariance
            distance = float(nu @ np.linalg.solve(S, nu))
            cost = distance + float(np.linalg.slogdet(S)[1])
            gaps_m = np.linalg.norm(one.wall.feet_m[:, None] - wall.feet_m, axis=2)
            is_beside = float(gaps_m.min()) <= self._parameters.walls.reach_m
            if distance <= limit and is_beside and cost < most:
                most, nearest = cost, one
        return nearest


class WallKeeper:
    """The walls of a state."""

    def __init__(self, state: State, parameters: BackEndParameters) -> None:
        self._state, self._parameters, self._rule = state, parameters, parameters.walls
        self.cells = WallCells(self._rule.cell_m)
        self.tentative = TentativeWalls(parameters)

    def look(self, seen: View, antennas: Antennas) -> View:
        """Return a view without the walls that were not seen as walls where they would reflect.

        The end of a wall reflects, too, from farther on: its edge's range leaves the wall's by x^2
        / 2 r only, within the gates of single ranges for long, and would turn wall and pose.
        """
        state, n = self._state, len(self._state.landmark_ids)
        off = seen.off_boresight_rad.copy()
        places = state.position_m + antennas.position_m @ rotation(state.heading_rad).T
        for row, wall_id in enumerate(state.wall_ids):
            phi, d = (float(value) for value in state.walls[row])
            normal = np.array([math.cos(phi), math.sin(phi)])
            feet = np.asarray(places + np.outer(d - places @ normal, normal))
            for radar, place in enumerate(along_wall(state, row, feet).tolist()):
                if not self.cells.surrounds(wall_id, place):
                    off[radar, n + row] = math.pi
        return replace(seen, off_boresight_rad=off)

    def take(
        self, faces: Sequence[Face], antennas: Antennas
    ) -> list[tuple[int, list[PointDetection]]]:
        """Take in the faces of a patch; return ids of walls with those that are of them.

        A face of a wall of the map corrects the state; of one wall a patch has one face at most.
        """
        state, rule = self._state, self._rule
        hits, others = dict[int, list[PointDetection]](), list[Face]()
        for face in faces:
            wall = body_wall(state, antennas, face, rule)
            row = match_wall(state, wall, self.cells, self._parameters)
            if row is None:
                others.append(face)
            elif state.wall_ids[row] not in hits:
                hits[self._update(row, wall)] = [face[0]]
        found = list(hits.items())
        new = [(face[0], body_wall(state, antennas, face, rule)) for face in others]
        for one in self.tentative.take(new):
            wall_id = self.place(one.wall)
            if wall_id is not None:
                found.append((wall_id, one.seen))
        return found

    def _update(self, row: int, seen: BodyWall) -> int:
        """Correct the state with a wall of the map that was seen again; return its id."""
        update_with_wall(self._state, row, seen)
        self._answered(row, seen)
        return self._state.wall_ids[row]

    def _answered(self, row: int, seen: BodyWall) -> None:
        """Note where a wall has given echoes."""
        places = along_wall(self._state, row, seen.in_map(self._state))
        self.cells.add(self._state.wall_ids[row], places)

    def place(self, seen: BodyWall) -> int | None:
        """Bring a wall into the map; return its id, or None if it is too near to another one."""
        state = self._state
        row = match_wall(state, seen, self.cells, self._parameters)
        if row is not None:
            return self._update(row, seen)
        if is_unresolved(state, seen, self.cells, self._rule):
            return None
        wall_id = initialise_wall(state, seen)
        state.added_sigmas_m[wall_id] = self._rule.roughness_m
        self._answered(len(state.wall_ids) - 1, seen)
        return wall_id

    def place_saved(self, wall: SavedWall, covariance: Array) -> int | None:
        """Do the same with a wall of a map that is given in the body frame."""
        n = np.array([math.cos(wall.phi_rad), math.sin(wall.phi_rad)])
        along_m = (np.array(wall.cells) + 0.5) * self._rule.cell_m
        seen = BodyWall(
            wall=np.array([wall.phi_rad, wall.d_m]),
            covariance=covariance,
            by_offsets=np.zeros((2, len(self._state.radar_columns))),
            feet_m=wall.d_m * n + np.outer(along_m, (-n[1], n[0])),
        )
        return self.place(seen)

    def spans_m(self, row: int) -> Array:
        """Return the ends of the known stretches of a wall, shape (k, 2, 2), map frame."""
        return self.cells.ends_m(self._state.wall_ids[row], *self._state.walls[row].tolist())


def wall_spans_m(wall: SavedWall, cell_m: float) -> Array:
    """Return the ends of the stretches of a saved wall that gave echoes, (k, 2, 2), map frame."""
    cells = WallCells(cell_m)
    cells.know(wall.id, wall.cells)
    return cells.ends_m(wall.id, wall.phi_rad, wall.d_m)

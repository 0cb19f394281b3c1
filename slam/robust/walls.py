"""Walls: found among unassigned ranges, recognised, and predicted where they are known to be.

As in :mod:`slam.robust.initialisation`, a small Kalman filter follows a guess back through the
frames; here its state is a line (phi, d) in the newest body frame, whose range is d - n . a. The
ranges must follow the wall's law, and the point's clearly less well.

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
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np

from slam.geometry import wrap_angle
from slam.robust.association import Antennas, View
from slam.robust.initialisation import (
    MEMBER_MARGIN_RAD,
    FeatureRows,
    Guess,
    Member,
    Slot,
    Tracker,
    Tracklet,
    UnassignedRanges,
    best_first,
    clear_match,
    is_consistent,
)
from slam.robust.map import Sightings, compare, fit_wall
from slam.robust.parameters import BackEndParameters, RangeNoise, TrackletRule, WallRule
from slam.robust.state import Array, State, rotation

_PRIOR_RAD = 0.3


def wall_guesses(newest: Sequence[Slot], noise: RangeNoise, rule: TrackletRule) -> list[Guess]:
    """Return the lines (phi, d) that touch both circles of every pair of unused ranges."""
    guesses = []
    spread = np.diag([_PRIOR_RAD**2, rule.prior_sigma_m**2])
    for first, second in combinations(newest, 2):
        base_x, base_y = second.x_m - first.x_m, second.y_m - first.y_m
        base = math.hypot(base_x, base_y)
        for a, b in product(first.unused, second.unused):
            cosine = (a.range_m - b.range_m) / base if base else 2.0
            if abs(cosine) > 1.0 or a.label is not None or b.label is not None:
                continue
            along, off = math.atan2(base_y, base_x), math.acos(cosine)
            phi = min(
                (along + off, along - off),
                key=lambda angle: abs(math.remainder(angle - first.yaw_rad, math.tau)),
            )
            away = abs(math.remainder(phi - first.yaw_rad, math.tau))
            if away <= noise.field_of_view_rad / 2 + MEMBER_MARGIN_RAD:
                d = a.range_m + math.cos(phi) * first.x_m + math.sin(phi) * first.y_m
                guesses.append(Guess(target=np.array([phi, d]), covariance=spread))
    return guesses


class WallTracker(Tracker):
    """Follows guesses of walls, phi and d, back in time."""

    def __init__(
        self, parameters: BackEndParameters, offsets_m: Array, offset_covariance: Array
    ) -> None:
        super().__init__(parameters, offsets_m, offset_covariance)
        self._walls = parameters.walls
        self._heading_rad_per_sqrt_m = parameters.wheels.heading_rad_per_sqrt_m

    def _sight(self, x: float, y: float, slot: Slot) -> tuple[float, float, float, float]:
        cosine, sine = math.cos(x), math.sin(x)
        distance = y - cosine * slot.x_m - sine * slot.y_m
        off = abs(math.remainder(x - slot.yaw_rad, math.tau))
        return distance, off, sine * slot.x_m - cosine * slot.y_m, 1.0

    def _walk(self, guess: Guess, frames: Sequence[Sequence[Slot]]) -> Tracklet:
        walked = super()._walk(guess, frames)
        walked.covariance[0, 0] += self._turned(walked.members)
        return walked

    def _with_free_offsets(self, walked: Tracklet) -> Tracklet:
        """Judge the members by a wall *and* the radars' common offsets, which are uncertain.

        For the filter, an offset's uncertainty is noise of each range. It is one number: a wall may
        miss all ranges alike.
        """
        if walked.dof < 1:
            return walked
        sightings, rule = self.sightings(walked), self._rule
        fit = fit_wall(sightings, walked.target)
        information = (fit.by_law.T / sightings.variances) @ fit.by_law
        prior = np.diag([_PRIOR_RAD**-2, rule.prior_sigma_m**-2])
        covariance: Array = np.asarray(np.linalg.inv(information + prior), dtype=np.float64)
        by_offsets = np.zeros((2, len(self._offsets)))
        by_offsets[:, fit.radars] = -covariance @ (fit.by_law.T / sightings.variances) @ fit.extra
        covariance[0, 0] += self._turned(walked.members)
        return replace(
            walked,
            target=fit.unknown - by_offsets[:, fit.radars] @ fit.offsets_m,
            covariance=covariance,
            by_offsets=by_offsets,
            chi_square=fit.chi_square,
        )

    def _turned(self, members: Sequence[Member]) -> float:
        """Return the variance of the heading over the way of the members."""
        if not members:
            return 0.0
        first, last = members[-1].slot, members[0].slot
        way = math.hypot(last.x_m - first.x_m, last.y_m - first.y_m)
        return self._heading_rad_per_sqrt_m**2 * way / 3.0

    def _way_m(self, tracklet: Tracklet) -> float:
        """Return how far the echo moved along the wall, the most that a radar has seen."""
        phi = float(tracklet.target[0])
        of_radar: dict[int, list[float]] = {}
        for slot in (member.slot for member in tracklet.members):
            along = math.cos(phi) * slot.y_m - math.sin(phi) * slot.x_m
            of_radar.setdefault(slot.radar, []).append(along)
        return max(max(places) - min(places) for places in of_radar.values())

    def is_wall(self, tracklet: Tracklet) -> bool:
        if len({member.slot.back for member in tracklet.members}) < self._walls.min_frames:
            return False
        if self._way_m(tracklet) < self._walls.min_way_m:
            return False
        if not is_consistent(tracklet, 2, self._rule):
            return False
        point, wall = compare(self.sightings(tracklet), float(tracklet.target[0]))
        return point - wall >= self._walls.wall_margin

    def is_point(self, tracklet: Tracklet) -> bool:
        """Return whether the ranges of a point follow its law, not a wall's."""
        x, y = tracklet.target - np.mean(tracklet.antennas_m, axis=0)
        point, wall = compare(self.sightings(tracklet), math.atan2(y, x))
        return wall - point >= self._walls.point_margin

    def sightings(self, tracklet: Tracklet) -> Sightings:
        members = tracklet.members
        offsets = np.array([self._offsets[member.slot.radar] for member in members])
        return Sightings(
            antennas_m=tracklet.antennas_m,
            ranges_m=np.array([m.measured.range_m for m in members]) - offsets,
            variances=np.array([m.measured.sigma_m**2 + m.slot.drift for m in members]),
            radars=np.array([m.slot.radar for m in members]),
            offset_covariance=None if self._offsets_known else self._offset_covariance,
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class BodyWall:
    """A wall in the newest body frame."""

    wall: Array  # shape (2,): phi [rad], d [m]
    covariance: Array  # shape (2, 2)
    by_offsets: Array  # shape (2, r), d(phi, d) / d(range offsets)
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

    def distance_m(self, wall_id: int, along_m: float) -> float:
        cells = self._cells.get(wall_id)
        if not cells:
            return math.inf
        here = math.floor(along_m / self._cell_m)
        return self._cell_m * min(abs(here - cell) for cell in cells)

    def surrounds(self, wall_id: int, along_m: float) -> bool:
        cells = self._cells.get(wall_id, set())
        here = math.floor(along_m / self._cell_m)
        return {here - 1, here, here + 1} <= cells

    def spans_m(self, wall_id: int) -> list[tuple[float, float]]:
        """Return the stretches that gave echoes, as (from, to) along the wall."""
        spans: list[tuple[float, float]] = []
        for cell in sorted(self._cells.get(wall_id, ())):
            begin, end = cell * self._cell_m, (cell + 1) * self._cell_m
            if spans and begin - spans[-1][1] < 0.5 * self._cell_m:
                spans[-1] = (spans[-1][0], end)
            else:
                spans.append((begin, end))
        return spans

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
    """Return the row of the wall that a wall seen is, or None where no match is clear.

    The rules are those of points; and the two must come within reach of each other along the line.
    """
    feet = seen.in_map(state)
    scored = []
    for row, wall_id in enumerate(state.wall_ids):
        along = along_wall(state, row, feet)
        if min(cells.distance_m(wall_id, float(place)) for place in along) > rule.reach_m:
            continue
        rows = wall_rows(state, row, seen)
        scored.append((rows.mahalanobis_sq + rows.log_det, rows.mahalanobis_sq, row))
    return clear_match(scored, rule.match_gate, rule.unmapped_per_rad_m, rule.match_margin)


def is_unresolved(state: State, seen: BodyWall, cells: WallCells, rule: WallRule) -> bool:
    """Return whether a wall seen is too near to a mapped one for radars to separate the two."""
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
    """Correct the state with a measurement of a mapped wall; return the NIS (2 dof)."""
    rows = wall_rows(state, wall_row, seen)
    return state.update(rows.at, rows.H, rows.residual, seen.covariance)


def initialise_wall(state: State, seen: BodyWall) -> int:
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


class WallKeeper:
    """The walls of a state."""

    def __init__(self, state: State, parameters: BackEndParameters) -> None:
        self._state, self._parameters, self._rule = state, parameters, parameters.walls
        self.cells = WallCells(self._rule.cell_m)

    def look(self, seen: View, antennas: Antennas) -> View:
        """Return a view without the walls that no wall tracklet has shown where they would reflect.

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

    def is_point(self, tracklet: Tracklet) -> bool:
        """Return whether the ranges of a tracklet follow a point's law rather than a wall's.

        What goes on where a mapped wall does is not known to be a point yet: over a few frames both
        laws fit.
        """
        tracker = self._tracker()
        return tracker.is_point(tracklet) and not self._is_on_a_wall(tracklet, tracker)

    def _is_on_a_wall(self, tracklet: Tracklet, tracker: WallTracker) -> bool:
        """Return whether a mapped wall nearby explains the ranges, too."""
        state, rule = self._state, self._rule
        if not state.wall_ids:
            return False
        sightings = tracker.sightings(tracklet)
        for row, wall_id in enumerate(state.wall_ids):
            phi, d = (float(value) for value in state.walls[row])
            n = np.array([np.cos(phi - state.heading_rad), np.sin(phi - state.heading_rad)])
            depth = d - float(state.position_m @ np.array([np.cos(phi), np.sin(phi)]))
            ranges = depth - sightings.antennas_m @ n
            away = sightings.ranges_m - ranges
            if np.abs(away).max() > rule.resolution_m:
                continue
            feet = sightings.antennas_m + ranges[:, None] * n
            places = state.position_m + feet @ rotation(state.heading_rad).T
            along = along_wall(state, row, places).tolist()
            if min(self.cells.distance_m(wall_id, place) for place in along) <= rule.reach_m:
                return True
        return False

    def _tracker(self) -> WallTracker:
        state = self._state
        offsets = np.arange(state.offsets.start, state.offsets.stop)
        return WallTracker(self._parameters, state.offsets_m, state.P.block(offsets))

    def find(self, unassigned: UnassignedRanges, radars: Sequence[int]) -> list[Tracklet]:
        """Return the walls among the unassigned ranges of one side, and use these up."""
        if len(radars) < 2:
            return []
        frames = unassigned.slots(radars, self._rule.window)
        guesses = wall_guesses(frames[0], self._parameters.ranges, self._parameters.tracklets)
        if not guesses:
            return []
        tracker = self._tracker()
        return best_first(tracker, guesses, frames, tracker.is_wall)

    def place(self, tracklet: Tracklet) -> int | None:
        """Bring a wall into the map; return its id, or None if it is too near to another one."""
        state = self._state
        phi, d = tracklet.target
        n = np.array([np.cos(phi), np.sin(phi)])
        antennas = tracklet.antennas_m
        seen = BodyWall(
            wall=tracklet.target,
            covariance=tracklet.covariance,
            by_offsets=tracklet.by_offsets,
            feet_m=antennas + np.outer(d - antennas @ n, n),
        )
        row = match_wall(state, seen, self.cells, self._rule)
        if row is None:
            if is_unresolved(state, seen, self.cells, self._rule):
                return None
            wall_id = initialise_wall(state, seen)
            state.shape_sigmas_m[wall_id] = self._rule.roughness_m
            row = len(state.wall_ids) - 1
        else:
            wall_id = state.wall_ids[row]
            update_with_wall(state, row, seen)
        self.cells.add(wall_id, along_wall(state, row, seen.in_map(state)))
        return wall_id

    def spans_m(self, row: int) -> Array:
        """Return the ends of the known stretches of a wall, shape (k, 2, 2), map frame."""
        phi, d = (float(value) for value in self._state.walls[row])
        n, t = np.array([np.cos(phi), np.sin(phi)]), np.array([-np.sin(phi), np.cos(phi)])
        spans = np.array(self.cells.spans_m(self._state.wall_ids[row])).reshape(-1, 2)
        return np.asarray(d * n + spans[:, :, None] * t)

"""The walls of one run: found, recognised, looked for where they are known to be."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from slam.robust.leftovers import Leftovers
from slam.robust.parameters import BackEndParameters, WallRule
from slam.robust.ranges import Antennas, View
from slam.robust.reports import MapWall
from slam.robust.state import HEADING, State, rotation
from slam.robust.tracklets import Tracklet
from slam.robust.wall_tracklets import (
    WallTracker,
    WallTracklet,
    find_wall_tracklets,
    wall_guesses,
)
from slam.robust.walls import (
    BodyWall,
    WallCells,
    along_wall,
    foot_points,
    give_birth_to_wall,
    hide_unknown,
    is_unresolved,
    match_wall,
    update_with_wall,
)


class WallKeeper:
    """Keeps the walls of a state.

    Parameters
    ----------
    state
        Holds them.
    parameters
        Noise, and what is believed; without a rule for walls there are none.

    Attributes
    ----------
    cells
        Which parts of them have answered.
    """

    def __init__(self, state: State, parameters: BackEndParameters) -> None:
        self._state, self._parameters = state, parameters
        self._rule = parameters.walls or WallRule()
        self.cells = WallCells(self._rule.cell_m)

    def look(self, seen: View, antennas: Antennas) -> View:
        """Return a view without the walls that are not known where they would answer."""
        state = self._state
        feet = [foot_points(state, row, antennas) for row in range(len(state.wall_ids))]
        by_radar = np.array(feet).reshape(-1, len(antennas.yaw_rad), 2).transpose(1, 0, 2)
        return hide_unknown(state, seen, by_radar, self.cells)

    def is_point(self, tracklet: Tracklet) -> bool:
        """Tell whether the ranges of a tracklet follow a point's law rather than a wall's.

        What goes on where a mapped wall does is not known to be a point yet: over a few frames
        both laws fit.
        """
        if self._parameters.walls is None:
            return True
        tracker = self._tracker()
        return tracker.is_point(tracklet) and not self._is_on_a_wall(tracklet, tracker)

    def _is_on_a_wall(self, tracklet: Tracklet, tracker: WallTracker) -> bool:
        """Tell whether a mapped wall nearby explains the ranges of a tracklet, too."""
        state, rule = self._state, self._rule
        if not state.wall_ids:
            return False
        sightings = tracker.sightings(tracklet.members)
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
        return WallTracker(self._parameters, self._rule, state.offsets_m, state.P.block(offsets))

    def find(self, leftovers: Leftovers, radars: Sequence[int]) -> list[WallTracklet]:
        """Return the walls in what some radars of a side have not used, and use that up."""
        if self._parameters.walls is None or len(radars) < 2:
            return []
        frames = leftovers.slots(radars, self._rule.window)
        guesses = wall_guesses(frames[0], self._parameters.ranges)
        return find_wall_tracklets(self._tracker(), guesses, frames) if guesses else []

    def place(self, tracklet: WallTracklet) -> tuple[int, bool] | None:
        """Bring a wall into the map; return its id and whether it is new.

        None: it is too near to a mapped one to be another.
        """
        state = self._state
        phi, d = tracklet.wall
        n = np.array([np.cos(phi), np.sin(phi)])
        antennas = np.array([(m.slot.x_m, m.slot.y_m) for m in tracklet.members])
        seen = BodyWall(
            wall=tracklet.wall,
            covariance=tracklet.covariance,
            by_offsets=tracklet.by_offsets,
            feet_m=antennas + np.outer(d - antennas @ n, n),
        )
        row = match_wall(state, seen, self.cells, self._rule)
        is_new = row is None
        if row is None and is_unresolved(state, seen, self.cells, self._rule):
            return None
        if row is None:
            wall_id = give_birth_to_wall(state, seen)
            state.range_doubts_m[wall_id] = self._rule.roughness_m
            row = len(state.wall_ids) - 1
        else:
            wall_id = state.wall_ids[row]
            update_with_wall(state, row, seen)
        self.cells.add(wall_id, along_wall(state, row, seen.in_map(state)))
        return wall_id, is_new

    def reported(self, row: int, hits: int) -> MapWall:
        """Return a wall as the map reports it."""
        state, wall_id = self._state, self._state.wall_ids[row]
        phi, d = (float(value) for value in state.walls[row])
        n, t = np.array([np.cos(phi), np.sin(phi)]), np.array([-np.sin(phi), np.cos(phi)])
        columns = state.landmark_columns(np.array([len(state.landmark_ids) + row]))
        P = state.P.block(np.concatenate([columns, [HEADING]]))
        T = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
        spans = np.array(self.cells.spans_m(wall_id)).reshape(-1, 2)
        return MapWall(
            phi_rad=phi,
            d_m=d,
            covariance=T @ P @ T.T,
            spans_m=d * n + spans[:, :, None] * t,
            hits=hits,
        )

"""Whether the robot is where the map has it; what to do when it was carried away.

When the evidence has grown until the robot must be elsewhere (module ``surprise``), what was
measured since it was carried, perhaps of other landmarks than it was taken for, is forgotten. An
island begins, and ends when its landmarks are found on the map (module ``relocation``).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from slam.robust.existence import Existence
from slam.robust.merging import apply_merge, find_merge
from slam.robust.parameters import BackEndParameters, MapRule
from slam.robust.ranges import View
from slam.robust.relinearisation import relinearise
from slam.robust.relocation import apply_join, find_join, set_down
from slam.robust.run_log import RunLog
from slam.robust.state import State
from slam.robust.surprise import Surprise, Trial
from slam.robust.symmetric import Array


class Whereabouts:
    """Keeps watch over the pose.

    Parameters
    ----------
    parameters
        Noise and rules.
    """

    def __init__(self, parameters: BackEndParameters) -> None:
        self.parameters = parameters
        self._surprise = Surprise(parameters.surprise)
        self._first_pose = 0
        self._is_lost = False
        self.elsewhere: frozenset[int] = frozenset()

    @property
    def is_lost(self) -> bool:
        """Tell whether the place of the robot on the map is unknown.

        It stays so where nothing of the map is left: then there is no way back.
        """
        return self._is_lost

    @property
    def is_suspicious(self) -> bool:
        """Tell whether something speaks against the pose."""
        return self._surprise.is_suspicious

    @property
    def is_carried(self) -> bool:
        """Tell whether the robot must be elsewhere."""
        return self._surprise.is_carried

    @property
    def lost_covariance(self) -> Array:
        """Return the covariance of a pose of which nothing is known, shape (3, 3)."""
        sigma_m = self.parameters.relocation.lost_position_m
        return np.diag([sigma_m**2, sigma_m**2, math.pi**2 / 3.0])

    def seen_from_here(self, seen: View, state: State) -> View:
        """Return a view without what is elsewhere."""
        ids = enumerate(state.feature_ids)
        return seen.without([row for row, id_ in ids if id_ in self.elsewhere])

    def look(self, trials: Sequence[Trial], state: State, log: RunLog) -> None:
        """Judge one frame; to be called before anything is learned from it."""
        self._surprise.look(trials, log.n_poses - 1, state.feature_ids)

    def set_down(self, state: State, existence: Existence, log: RunLog) -> None:
        """Begin an island at the present pose, and forget what was measured since it was wrong.

        What came into the map since is taken out again; the rest is solved for without the ranges
        since then. Where there is an island already it is given up: what is left is the old map.
        """
        first = self._surprise.first_pose
        log.forget_from(first)
        known = self.elsewhere if self._is_lost else self._surprise.witnesses
        for id_ in state.feature_ids:
            if id_ not in known:
                forget(id_, state, existence, log)
        pose = state.pose
        if not self.is_lost:
            relinearise(log, state, self.parameters)
        set_down(state, pose)
        log.carried(pose)
        self.elsewhere = frozenset(state.feature_ids)
        self._is_lost = True
        self._first_pose = log.n_poses - 1
        self._surprise.reset()

    def find(self, state: State, existence: Existence, log: RunLog) -> tuple[tuple[int, int], ...]:
        """Join the island with the map if it is certain how; return (kept, gone) ids."""
        rules = self.parameters
        rows = [r for r, id_ in enumerate(state.landmark_ids) if existence.is_reported(id_)]
        island = [r for r in rows if state.landmark_ids[r] not in self.elsewhere]
        old = [r for r in rows if state.landmark_ids[r] in self.elsewhere]
        join = find_join(state, island, old, rules.map, rules.relocation)
        if join is None:
            return ()
        ids = [(state.landmark_ids[kept], state.landmark_ids[gone]) for kept, gone in join.pairs]
        whole = [r for r, id_ in enumerate(state.landmark_ids) if id_ not in self.elsewhere]
        apply_join(state, join, whole, rules.map.merge_sigma_m)
        log.lay(self._first_pose, join.motion)
        for kept, gone in ids:
            existence.merge(kept, gone)
            log.rename(gone, kept)
        self.elsewhere = frozenset()
        self._is_lost = False
        self._surprise.reset()
        return tuple(ids)


def forget(id_: int, state: State, existence: Existence, log: RunLog) -> None:
    """Take a landmark or a wall out of the belief and all that was measured of it."""
    state.remove(state.feature_ids.index(id_))
    existence.forget(id_)
    log.drop(id_)


def merge_landmarks(
    state: State, existence: Existence, log: RunLog, rule: MapRule, elsewhere: frozenset[int]
) -> tuple[tuple[int, int], ...]:
    """Make the merge that is certain enough now, if any; return (kept, gone) ids."""
    merge = find_merge(state, existence, rule, elsewhere)
    if merge is None:
        return ()
    ids = tuple((state.landmark_ids[kept], state.landmark_ids[gone]) for kept, gone in merge.pairs)
    apply_merge(state, merge.pairs, rule.merge_sigma_m)
    for kept, gone in ids:
        existence.merge(kept, gone)
        log.rename(gone, kept)
    return ids

"""Map management: existence, merging, and maps of earlier runs.

The statement ``l_i - l_j = 0`` is a measurement of the whole state, H = [e_li: I, e_lj: -I]:
merging after a loop bends the trajectory back, and everything correlated with it. It is proposed
late, when one merge stands out from all competitors; whether it is made, the solution over the
whole run decides (`slam.robust.solver.revision.solved_as_one`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtri

from slam.geometry import Rig
from slam.results import OF_MOUNT, SavedLandmark, SavedMap, SavedRadar, SavedWall
from slam.robust.association import (
    Correspondence,
    MirrorWay,
    Pairs,
    RangeScan,
    View,
    certain,
    correspondences,
    density_per_m2,
)
from slam.robust.parameters import MARGIN_NATS, TAIL_PROBABILITY, MapRule
from slam.robust.state import HEAD_SIZE, Array, Indices, State, SymmetricMatrix, rotation

# Noise [m] of the statement that two landmarks are one: it is exact.
MERGE_SIGMA_M = 1e-5
SURE = 1e-6  # standard deviations of a pose [m, rad] where a run's own map begins
_LEAST_M2 = 1e-14  # variance of what a map knows for sure
_FLOOR = 1e-12  # what keeps matrices regular, as a share


@dataclass(slots=True)
class _Record:
    score: float = 0.0
    hits: int = 0
    n_heard: int = 0  # ranges of it
    # Patches that showed it, and frames that began it, less patches that had it in view and did not
    more_shown: int = 0
    n_unheard: int = 0  # how often a radar had it surely in view and did not hear it
    # Where its mirror image lies, while that may be what is there. A point on the way is its own,
    # and known no better than both sides of the way allow.
    mirrored: MirrorWay | None = None


class Existence:
    """Scores of all landmarks, by id, and how often each is detected."""

    def __init__(self, rule: MapRule, report_hits: int, detection_probability: float) -> None:
        self._rule, self._report_hits = rule, report_hits
        self._detection_probability = detection_probability
        self._records: dict[int, _Record] = {}

    def hit(self, landmark_id: int, frames: int = 1) -> None:
        """Count frames that hit a landmark; a new id begins here."""
        record = self._records.setdefault(landmark_id, _Record())
        record.score = min(record.score + frames, self._rule.most)
        record.hits += frames

    def miss(self, landmark_id: int, most: float = math.inf) -> None:
        """Count a frame that should have hit a landmark and did not, by no more than ``most``."""
        self._records[landmark_id].score -= min(self._rule.miss, most)

    def begin_mirrored(self, landmark_id: int, ways: Sequence[MirrorWay | None]) -> None:
        """Note that a landmark may be a mirror image, if it may be in all of its detections."""
        known = [way for way in ways if way is not None]
        surest = min(known, key=lambda way: way.variance, default=None)
        if surest is not None and all(surest.is_like(way) for way in ways):
            self._records[landmark_id].mirrored = surest

    def take_mirror(self, landmark_id: int, way: MirrorWay | None) -> None:
        """Take where the mirror image of a landmark lies in another detection of it.

        If it is elsewhere, or there is none, the landmark is no mirror image.
        """
        record = self._records[landmark_id]
        if record.mirrored is not None and not record.mirrored.is_like(way):
            record.mirrored = None

    def heard(self, landmark_id: int) -> None:
        self._records[landmark_id].n_heard += 1

    def show(self, ids: Iterable[int], times: int = 1) -> None:
        """Count how often landmarks were shown; less than 0: how often not, though in view."""
        for id_ in ids:
            self._records[id_].more_shown += times

    def unheard(self, landmark_id: int) -> float:
        """Count that a radar did not hear a landmark; return the evidence of that, in nats.

        How often the landmark is detected is estimated from how often it was before, with that of
        all radars as the mean of a beta prior.
        """
        record, weight = self._records[landmark_id], self._rule.prior_looks
        missed = weight * (1.0 - self._detection_probability) + record.n_unheard
        record.n_unheard += 1
        return math.log(missed / (weight + record.n_heard + record.n_unheard - 1))

    def renew(self, landmark_id: int) -> None:
        """Let the score begin anew; the hits remain."""
        self._records[landmark_id].score = 0.0

    def hits(self, landmark_id: int) -> int:
        """Return how many frames have hit a landmark; none if there is no such landmark."""
        record = self._records.get(landmark_id)
        return 0 if record is None else record.hits

    def lost(self) -> list[int]:
        return [id_ for id_, record in self._records.items() if record.score < self._rule.least]

    def know(self, landmark_id: int, hits: int) -> None:
        """Begin with what frames of an earlier run hit: its score is that of a new landmark."""
        score = float(self._report_hits)
        self._records[landmark_id] = _Record(score=score, hits=hits, more_shown=hits)

    def is_reported(self, landmark_id: int) -> bool:
        """Return whether a landmark is certain enough.

        From far, patches take two things that stand close together for one between them. No single
        range is of that one, and patches from near do not show it.
        """
        record = self._records[landmark_id]
        is_there = record.n_heard > 0 or record.more_shown >= 0
        return record.hits >= self._report_hits and record.mirrored is None and is_there

    def forget(self, landmark_id: int) -> None:
        self._records.pop(landmark_id, None)

    def merge(self, kept: int, gone: int) -> None:
        into, other = self._records[kept], self._records[gone]
        into.score = min(max(into.score, 0.0) + max(other.score, 0.0), self._rule.most)
        into.hits += other.hits
        self.take_mirror(kept, other.mirrored)
        into.n_heard += other.n_heard
        into.more_shown += other.more_shown
        into.n_unheard += other.n_unheard
        self.forget(gone)


class Images:
    """Which radars have images, and which landmarks their newest patches do not show as points.

    Single ranges of such a landmark are not used: something else answers, such as the face behind
    an edge, or a neighbour. That nothing answers there counts as ever.
    """

    def __init__(self) -> None:
        self.radars: set[int] = set()
        self._unshown: set[tuple[int, int]] = set()  # radar, and id of a landmark
        self._since: dict[int, int] = {}  # by radar the pose behind its newest patch

    def take_scans(self, scans: Sequence[RangeScan], pose: int) -> None:
        """Note which radars have images at a pose, by index in the log."""
        imaged = {scan.radar for scan in scans if scan.is_imaged}
        self.radars = (self.radars - {scan.radar for scan in scans}) | imaged
        for radar in imaged:
            self._since.setdefault(radar, pose)

    def take_patch(self, radar: int, shown: set[int], hidden: set[int], end: int) -> int:
        """Take the ids that a patch shows, and those in view that it does not.

        ``end`` is the pose behind it; returned is the one behind the patch before: ranges since
        then are not of what is hidden.
        """
        self._unshown -= {(radar, id_) for id_ in shown}
        self._unshown |= {(radar, id_) for id_ in hidden}
        since = self._since.get(radar, 0)
        self._since[radar] = end
        return since

    def bar(self, seen: View, ids: Sequence[int]) -> None:
        """Bar what is not shown from a view of landmarks with these ids."""
        rows = {id_: row for row, id_ in enumerate(ids)}
        for radar, id_ in self._unshown:
            seen.barred[radar, rows[id_]] = True

    def forget(self, ids: Collection[int]) -> None:
        """Forget what is known of landmarks that are gone, or are one with another."""
        self._unshown = {(radar, id_) for radar, id_ in self._unshown if id_ not in ids}

    def begin_anew(self, pose: int) -> None:
        """Forget all patches: from this pose on the robot is elsewhere."""
        self._unshown.clear()
        self._since = dict.fromkeys(self._since, pose)


def unknowns_of(state: State, radars: Sequence[str]) -> tuple[str, ...]:
    """Return names of all that does not move, in the order of the layout behind the calibration."""
    names, layout = [f"offset {radar}" for radar in radars], state.layout
    if layout.has_mounts:
        names += [f"moved_{axis} {radar}" for radar in radars for axis in "xy"]
    axes = ("x", "y", "radius")[: layout.landmark_size]
    names += [f"{axis} {id_}" for id_ in state.landmark_ids for axis in axes]
    return (*names, *(f"{axis} {id_}" for id_ in state.wall_ids for axis in ("phi", "d")))


def fixed_values(state: State) -> Array:
    """Return offsets, mounts and features in the order of the layout, shape (q,)."""
    layout = state.layout
    mounts = state.mounts_m.ravel() if layout.has_mounts else np.zeros(0)
    landmarks = state.landmarks_m
    if layout.has_radii:
        landmarks = np.column_stack([landmarks, state.radii_m])
    return np.concatenate([state.offsets_m, mounts, landmarks.ravel(), state.walls.ravel()])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapPrior:
    """What is known before a run: its first pose, and the unknowns of a map, by name.

    Errors are additive; those of the pose and of the map are independent of each other.
    """

    pose: Array  # shape (3,)
    pose_sigmas: Array  # shape (3,)
    radars: tuple[str, ...]  # of the rig
    names: tuple[str, ...]
    values: Array  # shape (k,)
    covariance: Array  # shape (k, k)

    def of(self, state: State) -> tuple[Indices, Array, Array]:
        """Return which columns of the error it is about, with values and information.

        What is not on the map any more is marginalised.
        """
        row = {name: place for place, name in enumerate(self.names)}
        names = unknowns_of(state, self.radars)
        columns = np.array([at for at, name in enumerate(names) if name in row], dtype=np.intp)
        rows = np.array([row[names[at]] for at in columns.tolist()], dtype=np.intp)
        # What was known for sure has information of a finite size, too.
        covariance = self.covariance[np.ix_(rows, rows)] + _LEAST_M2 * np.eye(len(rows))
        information = np.linalg.inv(covariance)
        return HEAD_SIZE + columns, self.values[rows], (information + information.T) / 2


def add_landmarks(
    state: State, other: SavedMap, covariance: Array, row_of: Mapping[str, int]
) -> list[int]:
    """Add the landmarks of a map that is given in the body frame; return their rows.

    ``covariance`` (k, k) is that of its unknowns, whose rows are given by name.
    """
    R, size = rotation(state.heading_rad), state.layout.landmark_size
    turn, at, added = np.eye(3)[:size, :size], np.array([1, 2]), list[tuple[int, list[int]]]()
    turn[:2, :2] = R
    for one in other.landmarks:
        names = [f"{axis} {one.id}" for axis in ("x", "y", "radius")[:size]]
        mine = [row_of[name] for name in names]
        cross = np.zeros((state.P.size, size))
        cross[:, :2] = state.P.columns(at)
        corner = turn @ covariance[np.ix_(mine, mine)] @ turn.T
        corner[:2, :2] += state.P.block(at)
        for row, its in added:
            columns = state.layout.columns(np.array([row]))
            cross[columns] += turn @ covariance[np.ix_(its, mine)] @ turn.T
        place = state.position_m + R @ (one.x_m, one.y_m)
        new_id = state.augment(place, cross, (corner + corner.T) / 2)
        if state.radius_sigma_m:
            state.radii_m[-1] = one.radius_m
        added.append((state.landmark_ids.index(new_id), mine))
    return [row for row, _ in added]


def take_map(
    state: State, saved: SavedMap, rig: Rig, start: tuple[Array, Array] | None
) -> MapPrior:
    """Let a new state begin on a map, at a pose (3,) with standard deviations (3,).

    Without a start it is at the origin, for sure.

    Range offsets and antennas are known from the map if the rig is the one that made it; else they
    are independent of it.
    """
    pose, sigmas = start or (np.zeros(3), np.full(3, SURE))
    state.landmark_ids = [one.id for one in saved.landmarks]
    state.landmarks_m = saved.landmarks_m
    if state.radius_sigma_m:
        state.radii_m = np.array([one.radius_m for one in saved.landmarks])
    state.wall_ids = [one.id for one in saved.walls]
    state.walls = np.array([(one.phi_rad, one.d_m) for one in saved.walls]).reshape(-1, 2)
    state.added_sigmas_m = {one.id: one.added_sigma_m for one in saved.features}
    state.next_id = saved.next_id
    n_own, layout = len(saved.radars), state.layout
    is_same_rig = n_own == len(rig.mounts) and all(map(SavedRadar.is_of, saved.radars, rig.mounts))
    if is_same_rig:
        state.offsets_m = np.array([radar.offset_m for radar in saved.radars])
        if layout.has_mounts:
            state.mounts_m = np.array([radar.moved_m for radar in saved.radars])
    of_radars = ("offset ", "moved_x ", "moved_y ")
    radars = tuple(mount.name for mount in rig.mounts)
    own = unknowns_of(state, radars)
    rows = [
        row
        for row, name in enumerate(saved.unknowns)
        if name in own and (is_same_rig or not name.startswith(of_radars))
    ]
    names = tuple(saved.unknowns[row] for row in rows)
    known = saved.full_covariance()[np.ix_(rows, rows)]
    at = np.array([own.index(name) for name in names], dtype=np.intp)
    P = np.zeros((layout.size, layout.size))
    before = state.P.full()
    P[: len(before), : len(before)] = before
    P[:3, :3] = np.diag(np.square(np.array([sigmas[2], sigmas[0], sigmas[1]])))
    if layout.has_radii:
        radii = np.arange(layout.size)[layout.radii]
        P[radii, radii] = state.radius_sigma_m**2
    P[np.ix_(HEAD_SIZE + at, HEAD_SIZE + at)] = known
    state.position_m, state.heading_rad = np.array(pose[:2]), float(pose[2])
    state.P = SymmetricMatrix(P)  # of the size that it will have
    state.set_additive_covariance(P)
    return MapPrior(
        pose=pose,
        pose_sigmas=sigmas,
        radars=radars,
        names=names,
        values=fixed_values(state)[at],
        covariance=known,
    )


def saved_map_of(
    state: State,
    rig: Rig,
    existence: Existence,
    start: Array,
    *,
    labels: Mapping[int, int],
    cells_of: Callable[[int], tuple[int, ...]],
) -> SavedMap:
    """Return the reported landmarks and walls of a state; ``start`` (3,) is the first pose.

    ``labels`` are ids of beacons by landmark, ``cells_of`` gives where a wall answered.
    """
    layout, n = state.layout, len(state.landmark_ids)
    rows = [row for row, id_ in enumerate(state.feature_ids) if existence.is_reported(id_)]
    T = state.additive_transform()
    columns = [layout.columns(np.array([row])) for row in rows]
    at = np.concatenate([state.radar_columns, *columns])
    P = (T @ state.P.full() @ T.T)[np.ix_(at, at)]
    names = unknowns_of(state, [mount.name for mount in rig.mounts])
    radii_m = state.feature_radii_m
    features = [(row, state.feature_ids[row], state.added_sigmas_m) for row in rows]
    return SavedMap(
        radars=tuple(
            SavedRadar(
                **{key: getattr(mount, key) for key in OF_MOUNT},
                offset_m=float(state.offsets_m[place]),
                moved_m=(float(state.mounts_m[place, 0]), float(state.mounts_m[place, 1])),
            )
            for place, mount in enumerate(rig.mounts)
        ),
        landmarks=tuple(
            SavedLandmark(
                id=id_,
                x_m=float(state.landmarks_m[row, 0]),
                y_m=float(state.landmarks_m[row, 1]),
                radius_m=float(radii_m[row]),
                added_sigma_m=added.get(id_, 0.0),
                hits=existence.hits(id_),
                label=labels.get(id_),
            )
            for row, id_, added in features
            if row < n
        ),
        walls=tuple(
            SavedWall(
                id=id_,
                phi_rad=float(state.walls[row - n, 0]),
                d_m=float(state.walls[row - n, 1]),
                added_sigma_m=added.get(id_, 0.0),
                hits=existence.hits(id_),
                cells=cells_of(id_),
            )
            for row, id_, added in features
            if row >= n
        ),
        unknowns=tuple(names[column - HEAD_SIZE] for column in at.tolist()),
        covariance=tuple(tuple(P[row, : row + 1].tolist()) for row in range(len(at))),
        start=(float(start[0]), float(start[1]), float(start[2])),
        next_id=state.next_id,
    )


def apply_merge(state: State, pairs: Pairs, sigma_m: float) -> None:
    """State that pairs of landmarks are one, of one radius, and marginalise the second of each."""
    k, layout = state.layout.landmark_size, state.layout
    at = layout.columns(np.array(pairs, dtype=np.intp).ravel())
    H = np.kron(np.eye(len(pairs)), np.hstack([np.eye(k), -np.eye(k)]))
    means = state.landmarks_m
    if layout.has_radii:
        means = np.column_stack([means, state.radii_m])
    residual = np.concatenate([means[j] - means[i] for i, j in pairs])
    PHt = state.P.columns(at) @ H.T
    S = H @ PHt[at] + sigma_m**2 * np.eye(k * len(pairs))
    S = (S + S.T) / 2
    K = np.asarray(np.linalg.solve(S, PHt.T).T, dtype=np.float64)
    state.P.subtract_gains(K, PHt, S)
    state.correct(K @ residual)
    for row in sorted((second for _, second in pairs), reverse=True):
        state.remove(row)


def named_pairs(state: State, pairs: Pairs) -> Pairs:
    """Return the ids of landmarks that are given by row, in order."""
    ids = state.landmark_ids
    return tuple(sorted((ids[kept], ids[gone]) for kept, gone in pairs))


def find_merge(
    state: State,
    rule: MapRule,
    refused: Collection[Pairs] = (),
    distinct: Collection[int] = (),
) -> Correspondence | None:
    """Return the merge of two landmarks to be tried now, or None.

    ``refused`` are those not to be tried, as ``named_pairs`` returns them; of the rows ``distinct``
    no two are one.
    """
    density = density_per_m2(state.landmarks_m, rule.neighbourhood_m)
    merges = [
        one
        for one in _candidates(state, density, rule.neighbourhood_m)
        if not all(row in distinct for row in one.pair)
    ]
    pairs = [one.pair for one in merges]
    return certain(merges, [pair for pair in pairs if named_pairs(state, (pair,)) in refused])


def _candidates(state: State, density: float, neighbourhood_m: float) -> list[Correspondence]:
    """Return all merges of two landmarks within reach, those far from passing the test left out."""
    if len(state.landmark_ids) < 2:
        return []
    near = cKDTree(state.landmarks_m).query_pairs(neighbourhood_m, output_type="ndarray")
    near = near[np.lexsort((near[:, 1], near[:, 0]))].astype(np.intp)
    points = state.landmarks_m
    P = state.P.block(state.landmark_columns(np.arange(len(points))))
    distances = _distances_sq(points, P, near, MERGE_SIGMA_M)
    # What contradicts a possible one and comes within the margin of it is kept, too.
    near = near[distances <= float(chdtri(2, TAIL_PROBABILITY)) + 2.0 * MARGIN_NATS]
    first, second = near.T
    at = np.stack([2 * first, 2 * first + 1, 2 * second, 2 * second + 1], axis=-1)
    H = np.hstack([np.eye(2), -np.eye(2)])
    S = H @ P[at[:, :, None], at[:, None, :]] @ H.T + MERGE_SIGMA_M**2 * np.eye(2)
    pairs = [(one, other) for one, other in near.tolist()]
    return correspondences(pairs, points[second] - points[first], S, density)


def _distances_sq(points: Array, P: Array, pairs: Indices, sigma_m: float) -> Array:
    """Return d^2 of the statement that pairs of rows, shape (k, 2), are one landmark each."""
    i, j = 2 * pairs.T

    def spread(a: int, b: int) -> Array:
        own = P[i + a, i + b] + P[j + a, j + b]
        return np.asarray(own - P[i + a, j + b] - P[j + a, i + b])

    xx, yy, xy = spread(0, 0) + sigma_m**2, spread(1, 1) + sigma_m**2, spread(0, 1)
    apart = points[pairs[:, 0]] - points[pairs[:, 1]]
    x, y = apart[:, 0], apart[:, 1]
    # Where rounding has left no spread at all, nothing is ruled out here.
    determinant = np.maximum(xx * yy - xy**2, 0.0)
    numerator = yy * x**2 - 2.0 * xy * x * y + xx * y**2
    spread_out = determinant > _FLOOR * xx * yy
    return np.where(spread_out, numerator / np.where(spread_out, determinant, 1.0), 0.0)

"""Kidnap detection, submaps, and relocation on the old map.

Each landmark that a radar should see gives evidence. Where the pose is right, a range lies near its
prediction with the detection probability; where it is not, by chance only: with n ranges over a
span L, with 1 - exp(-n w / L) for a gate of width w. The log likelihood ratios are summed from each
of several moments at which the robot may have been carried, and the largest sum counts (a
cumulative sum test, Page, Biometrika 41, 1954, with few moments). Landmarks mapped after that
moment give no evidence, and the evidence of each is bounded, so that several must be missing.

Once the evidence suffices, all measurements since the robot was carried are forgotten, and a new
*submap* begins: the error of the pose is zero by definition, new landmarks belong to the submap,
and those of the old map stay in the state. All errors keep their correlations; wheels' calibration
and range offsets are shared.

A submap and the old map are joined by a motion T that lays landmarks of one on those of the other.
Two pairs of landmarks with equal distances give a T, all pairs that then lie together test it. Its
evidence is the likelihood of their residuals r with T integrated out, uniform over the map's
surroundings of area A and all headings (S covariance of r, N derivative of r by T)::

    ln p = -(r^T S^-1 r + ln det(2 pi S) + ln det(N^T S^-1 N / 2 pi)) / 2 - ln(2 pi A)

against ln beta for each landmark that would be new, and against every other T. The maps are joined
when one T stands out. In right-invariant errors, T = Exp(e_T) T^ adds the same e_T to pose and
submap: exact however little is known of T, so that the join is a merge (`slam.robust.map`).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from slam.geometry import align_se2, between, compose, transform
from slam.robust.association import RangeScan, SureLandmarks, View, density_per_m2
from slam.robust.map import Existence, apply_merge, find_merge
from slam.robust.parameters import BackEndParameters, MapRule, RelocationRule, SurpriseRule
from slam.robust.run_log import RunLog
from slam.robust.smoother import relinearise
from slam.robust.state import (
    HEADING,
    Array,
    State,
    SymmetricMatrix,
    quarter_turn,
    rotation,
)

# Far more than what is left to know of T once it is found; sets nothing.
_FREE_RAD, _FREE_M = 1.0, 1.0
_SURROUNDINGS_M = 1.5
# A target in view may be missed, however sure the front end is.
_LEAST_MISSED = 1e-3
# Probability that chi-square of a right join is larger than is believed
_JOIN_TAIL = 0.001
# Steps of the alignment of two sets of landmarks, the change that ends them, and a variance [m^2]
# that keeps the matrix regular
_STEPS, _LEAST_CHANGE, _VARIANCE_FLOOR_M2 = 5, 1e-9, 1e-10


@dataclass(frozen=True, slots=True)
class Evidence:
    """Evidence of a landmark."""

    landmark_id: int
    evidence: float  # in nats, positive if the robot is not where the map has it


def evidence(
    near: SureLandmarks,
    seen: View,
    scans: Sequence[RangeScan],
    state: State,
    parameters: BackEndParameters,
) -> list[Evidence]:
    """Return the evidence of each range that should be among those of the scans of one side.

    ``near`` are the landmarks that may be in view, ``seen`` all of them.
    """
    noise, rule = parameters.ranges, parameters.surprise
    rows, ids, n_points = near.rows, state.landmark_ids, len(state.landmark_ids)
    inside = seen.inside(noise, -rule.view_inset_rad, -rule.view_inset_m)
    variances = near.prior.diagonal()
    counts = inside[rows.radars, rows.landmarks] & (variances <= rule.most_sigma_m**2)
    counts &= rows.landmarks < n_points  # a wall may end before it comes into view
    by_radar = {scan.radar: scan for scan in scans}
    detection = min(noise.detection_probability, 1.0 - _LEAST_MISSED)
    span_m = noise.max_range_m - noise.min_range_m
    found = []
    for k in np.flatnonzero(counts).tolist():
        scan = by_radar[int(rows.radars[k])]
        if scan.may_hide(float(rows.predicted_m[k])):
            continue
        sigmas = np.array([scan.sigma(i, noise.sigma_m) for i in range(len(scan.ranges_m))])
        gates_m = rule.gate_sigmas * np.sqrt(float(variances[k]) + sigmas**2)
        chance = 1.0 - math.exp(-2.0 * float(gates_m.sum()) / span_m)
        chance = min(max(chance, rule.least_chance), detection)
        if np.any(np.abs(np.array(scan.ranges_m) - rows.predicted_m[k]) <= gates_m):
            evidence = math.log(chance / detection)
        else:
            evidence = math.log((1.0 - chance) / (1.0 - detection))
        found.append(Evidence(ids[int(rows.landmarks[k])], evidence))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Hypothesis:
    """The robot was carried away before a pose: landmarks known before it, and their votes."""

    first_pose: int
    known_before: frozenset[int]
    votes: dict[int, float]

    def score(self) -> float:
        return sum(self.votes.values())


class Surprise:
    """The running evidence that the robot is not where the map has it."""

    def __init__(self, rule: SurpriseRule) -> None:
        self._rule = rule
        self._hypotheses: deque[_Hypothesis] = deque(maxlen=rule.hypotheses)

    @property
    def score(self) -> float:
        """Return the evidence in nats of the best hypothesis, zero or more."""
        return max((one.score() for one in self._hypotheses), default=0.0)

    @property
    def best(self) -> _Hypothesis:
        return max(self._hypotheses, key=_Hypothesis.score)

    @property
    def is_suspicious(self) -> bool:
        """Return whether more than one landmark gives evidence against the pose.

        One alone may be hidden or not be a point: were that enough, it could neither be deleted nor
        solved for again, and would count on.
        """
        scores = (one.score() - max(one.votes.values(), default=0.0) for one in self._hypotheses)
        return max(scores, default=0.0) > self._rule.suspicious

    @property
    def is_carried(self) -> bool:
        return self.score > self._rule.carried

    def look(self, frame: Sequence[Evidence], pose: int, ids: Iterable[int]) -> None:
        """Take in the evidence of one frame, given its pose and the landmarks known before."""
        last = self._hypotheses[-1].first_pose if self._hypotheses else -math.inf
        if frame and pose - last >= self._rule.every:
            self._hypotheses.append(_Hypothesis(pose, frozenset(ids), {}))
        rule = self._rule
        for one in self._hypotheses:
            for given in frame:
                if given.landmark_id in one.known_before:
                    vote = one.votes.get(given.landmark_id, 0.0) + given.evidence
                    vote = min(max(vote, -rule.most_for), rule.most_against)
                    one.votes[given.landmark_id] = vote

    def reset(self) -> None:
        self._hypotheses.clear()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Join:
    """A motion that lays a submap on the old map."""

    motion: Array  # shape (3,), applied from the left to all of the submap
    pairs: tuple[tuple[int, int], ...]  # rows: landmark of the old map, landmark of the submap
    evidence: float  # in nats, against that all landmarks of the submap are new


def begin_submap(state: State, pose: Array) -> None:
    """Make the pose certain, in place; nothing else is forgotten."""
    T = state.additive_transform()
    P = T @ state.P.full() @ T.T
    P[:3, :] = 0.0
    P[:, :3] = 0.0
    state.position_m = np.array(pose[:2])
    state.heading_rad = float(pose[2])
    # With a certain heading, invariant errors are additive ones.
    state.P = SymmetricMatrix(P)


def find_join(
    state: State,
    submap: Sequence[int],
    old_map: Sequence[int],
    map_rule: MapRule,
    rule: RelocationRule,
) -> Join | None:
    """Return the join of two sets of rows, all reported landmarks, that stands out, or None."""
    if len(submap) < rule.least_landmarks or len(old_map) < rule.least_landmarks:
        return None
    joins: dict[tuple[tuple[int, int], ...], Join] = {}
    tried: set[tuple[tuple[int, int], ...]] = set()
    for pairs in _constellations(state, submap, old_map, rule):
        if pairs in tried:
            continue
        tried.add(pairs)
        join = _judged(state, pairs, old_map, map_rule)
        if join is not None and len(join.pairs) >= rule.least_landmarks:
            joins[join.pairs] = join
    ranked = sorted(joins.values(), key=lambda join: -join.evidence)
    if not ranked or ranked[0].evidence < rule.evidence:
        return None
    best = ranked[0]
    rivals = [join for join in ranked[1:] if _differ(state, join, best, rule)]
    if rivals and best.evidence - rivals[0].evidence < rule.margin:
        return None
    return best


def _differ(state: State, one: Join, other: Join, rule: RelocationRule) -> bool:
    away = between(compose(one.motion, state.pose), compose(other.motion, state.pose))
    return math.hypot(away[0], away[1]) > rule.reach_m or abs(float(away[2])) > rule.turn_rad


def _constellations(
    state: State, submap: Sequence[int], old_map: Sequence[int], rule: RelocationRule
) -> list[tuple[tuple[int, int], ...]]:
    """Return the pairings that two landmarks of either map lead to."""
    here, there = np.array(submap), np.array(old_map)
    points, targets = state.landmarks_m[here], state.landmarks_m[there]
    gaps = targets[None, :] - targets[:, None]
    lengths = np.hypot(gaps[..., 0], gaps[..., 1])
    angles = np.arctan2(gaps[..., 1], gaps[..., 0])
    found = []
    for a in range(len(here)):
        for b in range(a + 1, len(here)):
            gap = points[b] - points[a]
            length = float(np.hypot(*gap))
            if length < rule.least_base_m:
                continue
            alike = np.abs(lengths - length) <= rule.reach_m
            for i, j in np.argwhere(alike & (lengths >= rule.least_base_m)).tolist():
                turn = float(angles[i, j]) - math.atan2(gap[1], gap[0])
                R = rotation(turn)
                middle = (targets[i] + targets[j]) / 2 - R @ (points[a] + points[b]) / 2
                moved = points @ R.T + middle
                away = np.hypot(*np.moveaxis(moved[:, None] - targets[None, :], -1, 0))
                pairs = _nearest(away, rule.reach_m)
                if len(pairs) >= rule.least_landmarks:
                    found.append(tuple((int(there[t]), int(here[p])) for p, t in pairs))
    found.sort(key=lambda pairs: -len(pairs))
    return found[: rule.most_tried]


def _nearest(away: Array, reach_m: float) -> list[tuple[int, int]]:
    """Return mutual nearest neighbours (row, column) within reach."""
    best_column, best_row = away.argmin(axis=1), away.argmin(axis=0)
    return [
        (row, int(column))
        for row, column in enumerate(best_column)
        if best_row[column] == row and away[row, column] <= reach_m
    ]


def _judged(
    state: State, pairs: tuple[tuple[int, int], ...], old_map: Sequence[int], rule: MapRule
) -> Join | None:
    """Return the join of the pairs, the worst left out until all fit; None below two."""
    while len(pairs) >= 2:
        motion, residual, S, N = _aligned(state, pairs)
        S_inverse = np.linalg.inv(S)
        distance = float(residual @ S_inverse @ residual)
        if distance <= chdtri(max(2 * len(pairs) - 3, 1), _JOIN_TAIL):
            information = N.T @ S_inverse @ N
            log_det = float(np.linalg.slogdet(math.tau * S)[1])
            log_det += float(np.linalg.slogdet(information / math.tau)[1])
            targets = state.landmarks_m[np.array(old_map)]
            area = float(np.prod(np.ptp(targets, axis=0) + 2 * _SURROUNDINGS_M))
            evidence = -0.5 * (distance + log_det) - math.log(math.tau * area)
            evidence -= len(pairs) * math.log(density_per_m2(targets, rule.merge_reach_m))
            return Join(motion=motion, pairs=pairs, evidence=evidence)
        apart = residual.reshape(-1, 2)
        blocks = [S[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(len(pairs))]
        misfits = [float(r @ np.linalg.solve(B, r)) for r, B in zip(apart, blocks, strict=True)]
        worst = int(np.argmax(misfits))
        pairs = pairs[:worst] + pairs[worst + 1 :]
    return None


def _aligned(state: State, pairs: tuple[tuple[int, int], ...]) -> tuple[Array, Array, Array, Array]:
    """Return the motion of least squares, residual (2 k,), its covariance and derivative (2 k, 3).

    residual = T l_submap - l_old. While there is a submap, errors of landmarks are added to T (see
    above), so their additive errors are used.
    """
    there = np.array([pair[0] for pair in pairs])
    here = np.array([pair[1] for pair in pairs])
    points, targets = state.landmarks_m[here], state.landmarks_m[there]
    rows = np.concatenate([here, there])
    at = np.concatenate([[HEADING], state.landmark_columns(rows)])
    T = np.hstack([quarter_turn(state.landmarks_m[rows]).reshape(-1, 1), np.eye(2 * len(rows))])
    P = np.asarray(T @ state.P.block(at) @ T.T)
    k = 2 * len(pairs)
    motion = align_se2(points, targets)
    for _ in range(_STEPS):
        turned = np.kron(np.eye(len(pairs)), rotation(float(motion[2])))
        H = np.hstack([turned, -np.eye(k)])
        S = H @ P @ H.T
        S = (S + S.T) / 2 + _VARIANCE_FLOOR_M2 * np.eye(k)
        moved = transform(motion, points)
        residual = (moved - targets).ravel()
        N = np.zeros((k, 3))
        N[0::2, 0] = N[1::2, 1] = 1.0
        N[:, 2] = quarter_turn(moved).ravel()
        weighted = np.linalg.solve(S, N)
        change = -np.linalg.solve(N.T @ weighted, weighted.T @ residual)
        motion = compose(np.array([change[0], change[1], change[2]]), motion)
        if float(np.abs(change).max()) < _LEAST_CHANGE:
            break
    residual = (transform(motion, points) - targets).ravel()
    return motion, residual, S, N


def apply_join(state: State, join: Join, submap: Collection[int], sigma_m: float) -> None:
    """Move the submap, given by rows, onto the old map, and merge the pairs."""
    motion = join.motion
    R, rows = rotation(float(motion[2])), np.array(sorted(submap), dtype=np.intp)
    blocks = [np.array([1, 2]), *state.landmark_columns(rows).reshape(-1, 2)]
    # Old landmarks do not turn with the submap: their invariant errors follow the heading's alone.
    A = np.eye(state.P.size)
    for block in blocks:
        A[np.ix_(block, block)] = R
        A[block, HEADING] = -quarter_turn(motion[:2])
    N = np.zeros((state.P.size, 3))
    N[HEADING, 0] = 1.0
    first = state.offsets.stop
    N[first:, 0] = -state.turned_features().ravel()
    for block in blocks:
        N[block, 0] = 0.0
        N[block, 1:] = np.eye(2)
    free = np.diag([_FREE_RAD**2, _FREE_M**2, _FREE_M**2])
    P = A @ state.P.full() @ A.T + N @ free @ N.T
    pose = compose(motion, state.pose)
    state.position_m, state.heading_rad = pose[:2].copy(), float(pose[2])
    state.landmarks_m = state.landmarks_m.copy()
    state.landmarks_m[rows] = transform(motion, state.landmarks_m[rows])
    state.P = SymmetricMatrix((P + P.T) / 2)
    apply_merge(state, join.pairs, sigma_m)


class Localisation:
    """Whether the robot is where the map has it; submaps and relocation."""

    def __init__(self, parameters: BackEndParameters) -> None:
        self.parameters = parameters
        self.surprise = Surprise(parameters.surprise)
        self._first_pose = 0
        # Whether the place of the robot on the map is unknown; for good, if nothing of it is left
        self.is_lost = False
        # Ids of the old map's landmarks while there is a submap
        self.old_map: frozenset[int] = frozenset()

    @property
    def lost_covariance(self) -> Array:
        sigma_m = self.parameters.relocation.lost_position_m
        return np.diag([sigma_m**2, sigma_m**2, math.pi**2 / 3.0])

    def without_old_map(self, seen: View, state: State) -> View:
        rows = [row for row, id_ in enumerate(state.feature_ids) if id_ in self.old_map]
        if not rows:
            return seen
        ranges = seen.ranges_m.copy()
        ranges[:, rows] = math.inf
        return replace(seen, ranges_m=ranges)

    def look(self, evidence: Sequence[Evidence], state: State, log: RunLog) -> None:
        """Judge one frame; to be called before anything is learned from it."""
        self.surprise.look(evidence, log.n_poses - 1, state.feature_ids)

    def begin_submap(self, state: State, existence: Existence, log: RunLog) -> None:
        """Begin a submap at the present pose; forget all measurements since the pose was wrong.

        Landmarks mapped since are removed; the rest is solved for without the ranges since then. A
        submap that exists already is deleted: only the old map is left.
        """
        log.forget_from(self.surprise.best.first_pose)
        known = self.old_map if self.is_lost else self.surprise.best.known_before
        for id_ in state.feature_ids:
            if id_ not in known:
                forget(id_, state, existence, log)
        pose = state.pose
        if not self.is_lost:
            relinearise(log, state, self.parameters)
        begin_submap(state, pose)
        log.break_odometry(pose)
        self.old_map = frozenset(state.feature_ids)
        self.is_lost = True
        self._first_pose = log.n_poses - 1
        self.surprise.reset()

    def join(self, state: State, existence: Existence, log: RunLog) -> bool:
        """Join the submap with the old map if one join stands out; return whether it does."""
        rules = self.parameters
        rows = [r for r, id_ in enumerate(state.landmark_ids) if existence.is_reported(id_)]
        submap = [r for r in rows if state.landmark_ids[r] not in self.old_map]
        old = [r for r in rows if state.landmark_ids[r] in self.old_map]
        join = find_join(state, submap, old, rules.map, rules.relocation)
        if join is None:
            return False
        ids = [(state.landmark_ids[kept], state.landmark_ids[gone]) for kept, gone in join.pairs]
        whole = [r for r, id_ in enumerate(state.landmark_ids) if id_ not in self.old_map]
        apply_join(state, join, whole, rules.map.merge_sigma_m)
        log.move_poses(self._first_pose, join.motion)
        for kept, gone in ids:
            existence.merge(kept, gone)
            log.rename(gone, kept)
        self.old_map = frozenset()
        self.is_lost = False
        self.surprise.reset()
        return True


def forget(id_: int, state: State, existence: Existence, log: RunLog) -> None:
    """Remove a landmark or a wall, and all its measurements."""
    state.remove(state.feature_ids.index(id_))
    existence.forget(id_)
    log.drop(id_)


def merge_landmarks(
    state: State, existence: Existence, log: RunLog, rule: MapRule, old_map: frozenset[int]
) -> None:
    merge = find_merge(state, existence, rule, old_map)
    if merge is None:
        return
    ids = tuple((state.landmark_ids[kept], state.landmark_ids[gone]) for kept, gone in merge.pairs)
    apply_merge(state, merge.pairs, rule.merge_sigma_m)
    for kept, gone in ids:
        existence.merge(kept, gone)
        log.rename(gone, kept)

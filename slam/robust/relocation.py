"""A robot that was carried away finds itself again by a constellation of landmarks.

Where it was set down, a new *island* begins: the error of the pose is zero by definition, what is
seen becomes landmarks of the island, and those of the old map stay in the state, elsewhere. All
errors keep their correlations, the wheels' calibration and the range offsets are shared.

An island and the old map are joined by a motion T that lays landmarks of one on those of the
other. Two pairs of landmarks with equal distances give a T, all pairs that then lie together test
it. Its evidence is the likelihood of their residuals r with T integrated out, uniform over the
map's surroundings of area A and all headings (S covariance of r, N derivative of r by T)::

    ln p = -(r^T S^-1 r + ln det(2 pi S) + ln det(N^T S^-1 N / 2 pi)) / 2 - ln(2 pi A)

against ln beta for each landmark that would be new, and against every other T. Islands are joined
when one T stands out. In right-invariant errors, T = Exp(e_T) T^ adds the same e_T to pose and
island: exact however little is known of T, so that the join is a merge (module ``merging``).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from slam.geometry import between, compose, transform
from slam.robust.merging import apply_merge
from slam.robust.parameters import MapRule, RelocationRule
from slam.robust.state import HEADING, State, quarter_turn, rotation
from slam.robust.symmetric import Array, Indices, SymmetricMatrix

# Far more than what is left to know of T once it is found; sets nothing.
_FREE_RAD, _FREE_M = 1.0, 1.0
_SURROUNDINGS_M = 1.5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Join:
    """A motion that lays an island on the map.

    ``motion`` (3,) is applied from the left to all of the island; ``pairs`` are rows (landmark
    elsewhere, landmark of the island); ``evidence`` is in nats over that all of them are new.
    """

    motion: Array
    pairs: tuple[tuple[int, int], ...]
    evidence: float


def set_down(state: State, pose: Array) -> None:
    """Begin an island: the pose becomes one without doubt, in place; nothing else is forgotten."""
    T = state.additive_transform()
    P = T @ state.P.full() @ T.T
    P[:3, :] = 0.0
    P[:, :3] = 0.0
    state.position_m = np.array(pose[:2])
    state.heading_rad = float(pose[2])
    # With no doubt about the heading, invariant errors are additive ones.
    state.P = SymmetricMatrix(P)


def find_join(
    state: State,
    island: Sequence[int],
    elsewhere: Sequence[int],
    map_rule: MapRule,
    rule: RelocationRule,
) -> Join | None:
    """Return the join that stands out, or None.

    Parameters
    ----------
    state
        With an island.
    island, elsewhere
        Rows of landmarks believed in.
    map_rule, rule
        Density of unmapped landmarks; when a join stands out.
    """
    if len(island) < rule.least_landmarks or len(elsewhere) < rule.least_landmarks:
        return None
    joins: dict[tuple[tuple[int, int], ...], Join] = {}
    tried: set[tuple[tuple[int, int], ...]] = set()
    for pairs in _constellations(state, island, elsewhere, rule):
        if pairs in tried:
            continue
        tried.add(pairs)
        join = _judged(state, pairs, elsewhere, map_rule)
        if join is not None and len(join.pairs) >= rule.least_landmarks:
            joins[join.pairs] = join
    ranked = sorted(joins.values(), key=lambda join: -join.evidence)
    if not ranked or ranked[0].evidence < rule.evidence:
        return None
    best = ranked[0]
    rivals = [join for join in ranked[1:] if _differ(state, join, best, rule)]
    if rivals and best.evidence - rivals[0].evidence < rule.lead:
        return None
    return best


def _differ(state: State, one: Join, other: Join, rule: RelocationRule) -> bool:
    """Tell whether two joins put the robot in different places."""
    away = between(compose(one.motion, state.pose), compose(other.motion, state.pose))
    return math.hypot(away[0], away[1]) > rule.reach_m or abs(float(away[2])) > rule.turn_rad


def _constellations(
    state: State, island: Sequence[int], elsewhere: Sequence[int], rule: RelocationRule
) -> list[tuple[tuple[int, int], ...]]:
    """Return the pairings that two landmarks of the island with two elsewhere lead to."""
    here, there = np.array(island), np.array(elsewhere)
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
    state: State, pairs: tuple[tuple[int, int], ...], elsewhere: Sequence[int], rule: MapRule
) -> Join | None:
    """Return the best join of some pairs, the worst left out until all fit; None below two."""
    while len(pairs) >= 2:
        motion, residual, S, N = _aligned(state, pairs)
        S_inverse = np.linalg.inv(S)
        distance = float(residual @ S_inverse @ residual)
        if distance <= chdtri(max(2 * len(pairs) - 3, 1), 0.001):
            information = N.T @ S_inverse @ N
            log_det = float(np.linalg.slogdet(math.tau * S)[1])
            log_det += float(np.linalg.slogdet(information / math.tau)[1])
            targets = state.landmarks_m[np.array(elsewhere)]
            area = float(np.prod(np.ptp(targets, axis=0) + 2 * _SURROUNDINGS_M))
            evidence = -0.5 * (distance + log_det) - math.log(math.tau * area)
            evidence -= len(pairs) * math.log(rule.unmapped_per_m2)
            return Join(motion=motion, pairs=pairs, evidence=evidence)
        apart = residual.reshape(-1, 2)
        blocks = [S[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(len(pairs))]
        misfits = [float(r @ np.linalg.solve(B, r)) for r, B in zip(apart, blocks, strict=True)]
        worst = int(np.argmax(misfits))
        pairs = pairs[:worst] + pairs[worst + 1 :]
    return None


def _aligned(state: State, pairs: tuple[tuple[int, int], ...]) -> tuple[Array, Array, Array, Array]:
    """Return the motion of least squares, residual (2 k,), its covariance and derivative (2 k, 3).

    residual = T l_island - l_elsewhere. While there is an island, errors of landmarks are added to
    T (module docstring), so their additive errors are what counts.
    """
    there = np.array([pair[0] for pair in pairs])
    here = np.array([pair[1] for pair in pairs])
    points, targets = state.landmarks_m[here], state.landmarks_m[there]
    P = _additive_block(state, np.concatenate([here, there]))
    k = 2 * len(pairs)
    motion = _first_alignment(points, targets)
    for _ in range(5):
        turned = np.kron(np.eye(len(pairs)), rotation(float(motion[2])))
        H = np.hstack([turned, -np.eye(k)])
        S = H @ P @ H.T
        S = (S + S.T) / 2 + 1e-10 * np.eye(k)
        moved = transform(motion, points)
        residual = (moved - targets).ravel()
        N = np.zeros((k, 3))
        N[0::2, 0] = N[1::2, 1] = 1.0
        N[:, 2] = quarter_turn(moved).ravel()
        weighted = np.linalg.solve(S, N)
        change = -np.linalg.solve(N.T @ weighted, weighted.T @ residual)
        motion = compose(np.array([change[0], change[1], change[2]]), motion)
        if float(np.abs(change).max()) < 1e-9:
            break
    residual = (transform(motion, points) - targets).ravel()
    return motion, residual, S, N


def _additive_block(state: State, rows: Indices) -> Array:
    """Return the covariance of additive errors of landmarks, shape (2 k, 2 k)."""
    at = np.concatenate([[HEADING], state.landmark_columns(rows)])
    P = state.P.block(at)
    T = np.hstack([quarter_turn(state.landmarks_m[rows]).reshape(-1, 1), np.eye(2 * len(rows))])
    return np.asarray(T @ P @ T.T)


def _first_alignment(points: Array, targets: Array) -> Array:
    """Return the motion of unweighted least squares (Umeyama without scale), shape (3,)."""
    p, t = points - points.mean(axis=0), targets - targets.mean(axis=0)
    turn = math.atan2(float(np.sum(p[:, 0] * t[:, 1] - p[:, 1] * t[:, 0])), float(np.sum(p * t)))
    shift = targets.mean(axis=0) - rotation(turn) @ points.mean(axis=0)
    return np.array([shift[0], shift[1], turn])


def apply_join(state: State, join: Join, island: Collection[int], sigma_m: float) -> None:
    """Lay the island, rows of its landmarks given, on the map, and merge the pairs."""
    motion = join.motion
    R, rows = rotation(float(motion[2])), np.array(sorted(island), dtype=np.intp)
    blocks = [np.array([1, 2]), *state.landmark_columns(rows).reshape(-1, 2)]
    # Old landmarks do not turn with the island: their invariant errors follow the heading's alone.
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

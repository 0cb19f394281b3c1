"""Two landmarks that are one become one, once that is certain enough.

The statement ``l_i - l_j = 0`` is a measurement of the whole state, H = [e_li: I, e_lj: -I]:
merging after a loop bends the trajectory back, and everything that is correlated with it. It is
made late, when one merge, or two disjoint ones together, stand out from all competitors.
"""

from __future__ import annotations

import math
from collections.abc import Set
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from slam.robust.existence import Existence
from slam.robust.parameters import MapRule
from slam.robust.state import State
from slam.robust.symmetric import Array, Indices


@dataclass(frozen=True, slots=True, kw_only=True)
class Merge:
    """Landmarks by row, the older first, and how likely the statement is.

    ``log_likelihood`` is ln N(l_i - l_j; 0, S), that of several merges their joint one.
    """

    pairs: tuple[tuple[int, int], ...]
    mahalanobis_sq: float
    log_likelihood: float


def merge_rows(
    state: State, pairs: tuple[tuple[int, int], ...], sigma_m: float
) -> tuple[Indices, Array, Array, Array]:
    """Return columns, H (2 k, 4 k), residual (2 k,) and R (2 k, 2 k) of k merges of rows."""
    at = state.landmark_columns(np.array(pairs, dtype=np.intp).ravel())
    H = np.asarray(
        np.kron(np.eye(len(pairs)), np.hstack([np.eye(2), -np.eye(2)])), dtype=np.float64
    )
    apart = [state.landmarks_m[i] - state.landmarks_m[j] for i, j in pairs]
    return at, H, -np.concatenate(apart), sigma_m**2 * np.eye(2 * len(pairs))


def judge(state: State, pairs: tuple[tuple[int, int], ...], sigma_m: float) -> Merge:
    """Return the likelihood of a merge, or of several together."""
    at, H, residual, R = merge_rows(state, pairs, sigma_m)
    S = H @ state.P.block(at) @ H.T + R
    distance = float(residual @ np.linalg.solve(S, residual))
    log_det = float(np.linalg.slogdet(S)[1])
    k = len(residual)
    return Merge(
        pairs=pairs,
        mahalanobis_sq=distance,
        log_likelihood=-0.5 * (distance + log_det + k * math.log(math.tau)),
    )


def apply_merge(state: State, pairs: tuple[tuple[int, int], ...], sigma_m: float) -> None:
    """State that pairs of landmarks are one, and marginalise the second of each.

    The covariance changes in Joseph's form: the statement is nearly free of noise.
    """
    at, H, residual, R = merge_rows(state, pairs, sigma_m)
    PHt = state.P.columns(at) @ H.T
    S = H @ PHt[at] + R
    S = (S + S.T) / 2
    K = np.asarray(np.linalg.solve(S, PHt.T).T, dtype=np.float64)
    state.P.subtract_gains(K, PHt, S)
    state.correct(K @ residual)
    ids = state.landmark_ids
    for kept, gone in pairs:
        if ids[gone] in state.radii_m:
            state.radii_m.setdefault(ids[kept], state.radii_m[ids[gone]])
            state.range_doubts_m.setdefault(ids[kept], state.range_doubts_m.get(ids[gone], 0.0))
    for row in sorted((second for _, second in pairs), reverse=True):
        state.remove(row)


def find_merge(
    state: State, existence: Existence, rule: MapRule, elsewhere: Set[int] = frozenset()
) -> Merge | None:
    """Return the merge to be made now, one or two disjoint ones, or None.

    A landmark whose id is ``elsewhere`` is merged with none.
    """
    candidates = _candidates(state, existence, rule, elsewhere)
    floor = math.log(rule.unmapped_per_m2)
    fair = [merge for merge in candidates if merge.log_likelihood > floor]
    best: Merge | None = None
    for merge in fair:
        rivals = [
            other.log_likelihood
            for other in candidates
            if other is not merge and _share_landmark(other, merge)
        ]
        stands_out = merge.log_likelihood - max(rivals, default=-math.inf) > rule.merge_lead
        if stands_out and (best is None or merge.log_likelihood > best.log_likelihood):
            best = merge
    if best is not None:
        return best
    return _joint_merge(state, fair, 2.0 * floor, rule)


def _candidates(
    state: State, existence: Existence, rule: MapRule, elsewhere: Set[int]
) -> list[Merge]:
    """Return all merges of two landmarks within reach that pass the gate.

    Only pairs that are near touch the covariance, all of them at once.
    """
    if len(state.landmark_ids) < 2:
        return []
    near = cKDTree(state.landmarks_m).query_pairs(rule.merge_reach_m, output_type="ndarray")
    near = near[np.lexsort((near[:, 1], near[:, 0]))].astype(np.intp)
    distances = _distances_sq(state, near, rule.merge_sigma_m)
    # The last word is the judge's: here, rounding must not leave out what it would accept.
    found = []
    for first, second in near[distances <= (1.0 + 1e-6) * rule.merge_gate].tolist():
        ids = state.landmark_ids[first], state.landmark_ids[second]
        if existence.are_apart(*ids) or not elsewhere.isdisjoint(ids):
            continue
        merge = judge(state, ((first, second),), rule.merge_sigma_m)
        if merge.mahalanobis_sq <= rule.merge_gate:
            found.append(merge)
    return found


def _distances_sq(state: State, pairs: Indices, sigma_m: float) -> Array:
    """Return d^2 of the statement that pairs of rows, shape (k, 2), are one landmark each."""
    start = state.landmark_columns(np.zeros(1, dtype=np.intp))[0]
    i, j = start + 2 * pairs[:, 0], start + 2 * pairs[:, 1]

    def spread(a: int, b: int) -> Array:
        entries = state.P.entries
        own = entries(i + a, i + b) + entries(j + a, j + b)
        return np.asarray(own - entries(i + a, j + b) - entries(j + a, i + b))

    xx, yy, xy = spread(0, 0) + sigma_m**2, spread(1, 1) + sigma_m**2, spread(0, 1)
    apart = state.landmarks_m[pairs[:, 0]] - state.landmarks_m[pairs[:, 1]]
    x, y = apart[:, 0], apart[:, 1]
    # Where rounding has left no spread at all, nothing is ruled out here.
    determinant = np.maximum(xx * yy - xy**2, 0.0)
    numerator = yy * x**2 - 2.0 * xy * x * y + xx * y**2
    spread_out = determinant > 1e-12 * xx * yy
    return np.where(spread_out, numerator / np.where(spread_out, determinant, 1.0), 0.0)


def _joint_merge(state: State, fair: list[Merge], floor: float, rule: MapRule) -> Merge | None:
    """Return two disjoint merges that together beat every other two that contradict them."""
    joint = []
    for place, one in enumerate(fair):
        for other in fair[place + 1 :]:
            if _share_landmark(one, other):
                continue
            both = judge(state, one.pairs + other.pairs, rule.merge_sigma_m)
            if both.mahalanobis_sq <= rule.merge_gate_joint and both.log_likelihood > floor:
                joint.append(both)
    joint.sort(key=lambda merge: -merge.log_likelihood)
    if not joint:
        return None
    best = joint[0]
    for rival in joint[1:]:
        contradicts = any(
            mine != theirs and set(mine) & set(theirs)
            for mine in best.pairs
            for theirs in rival.pairs
        )
        if contradicts and best.log_likelihood - rival.log_likelihood <= rule.merge_lead:
            return None
    return best


def _share_landmark(one: Merge, other: Merge) -> bool:
    mine = {row for pair in one.pairs for row in pair}
    return any(row in mine for pair in other.pairs for row in pair)

"""Where one map lies on another, or on itself, from the constellation of their landmarks.

Two landmarks of either map with equal distances give a motion T that lays one pair on the other;
all pairs of landmarks that then lie together test it. Its evidence is the likelihood of their
residuals r with T integrated out, uniform over the surroundings of the map, of area A, and over all
headings (S covariance of r, N derivative of r by T)::

    ln p = -(r^T S^-1 r + ln det(2 pi S) + ln det(N^T S^-1 N / 2 pi)) / 2 - ln(2 pi A)

against ln beta for each landmark that would otherwise be new, beta the density of the map's own
landmarks, and against every other T.

A loop is closed by the same search between the landmarks of the last stretch and older ones. There
the covariance of the state gives the uncertainty of T, and the likelihood of the residuals is that
of the merge.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtri

from slam.geometry import align_se2, compose, transform
from slam.robust.association import Pairs, density_per_m2
from slam.robust.parameters import NEIGHBOURHOOD_M, TAIL_PROBABILITY, BranchRule, is_plausible
from slam.robust.state import HEADING, Array, Indices, State, quarter_turn, rotation

# Steps of the alignment of two sets of landmarks, the change that ends them, and a variance [m^2]
# that keeps the matrix regular
_STEPS, _LEAST_CHANGE, _VARIANCE_FLOOR_M2 = 5, 1e-9, 1e-10
_ROOM = 1.0 + 1e-9  # for rounding, where landmarks are searched within reach


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Constellation:
    """Landmarks of one map, shape (n, 2), and the covariance of their additive errors (2n, 2n)."""

    ids: tuple[int, ...]
    points_m: Array
    covariance_m2: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Placement:
    """A motion that lays one map on another."""

    motion: Array  # shape (3,), from the frame of the one to that of the other
    pairs: Pairs  # rows: landmark of the other, landmark of the one
    evidence: float  # in nats, against that all landmarks of the one are new


def constellation_of(state: State, rows: Sequence[int], sigma_m: float) -> Constellation:
    """Return the landmarks in some rows; ``sigma_m`` is added to their errors, in squares."""
    at_rows = np.array(rows, dtype=np.intp)
    points = state.landmarks_m[at_rows]
    at = np.concatenate([[HEADING], state.landmark_columns(at_rows)])
    T = np.hstack([quarter_turn(points).reshape(-1, 1), np.eye(2 * len(at_rows))])
    return Constellation(
        ids=tuple(state.landmark_ids[row] for row in rows),
        points_m=points,
        covariance_m2=np.asarray(T @ state.P.block(at) @ T.T + sigma_m**2 * np.eye(len(at) - 1)),
    )


def find_placements(here: Constellation, there: Constellation, rule: BranchRule) -> list[Placement]:
    """Return the motions from ``here`` to ``there``, likeliest first, no two to the same place.

    Those of fewer landmarks than `BranchRule.least_landmarks`, or by `BranchRule.placement_nats`
    less likely than the likeliest, are left out; and all, if that has less evidence.
    """
    least = rule.least_landmarks
    if len(here.ids) < least or len(there.ids) < least:
        return []
    found: dict[Pairs, Placement] = {}
    for placement in _placements(here, there, rule, len(here.ids)):
        found[placement.pairs] = placement
    middle = here.points_m.mean(axis=0)
    distinct: list[Placement] = []
    for one in sorted(found.values(), key=lambda one: -one.evidence):
        best = distinct[0].evidence if distinct else one.evidence
        if best < rule.placement_nats or best - one.evidence >= rule.placement_nats:
            break
        if all(_differ(one.motion, other.motion, middle, rule) for other in distinct):
            distinct.append(one)
    return distinct


def stands_out(
    nats: Array, known: Constellation, rule: BranchRule, is_possible: Callable[[Placement], bool]
) -> bool:
    """Return whether landmarks that could not be others of a map say where the robot is.

    ``nats`` is the evidence of all landmarks of the map, shape (n,). Of the landmarks that say
    most, at most `BranchRule.newest`, some could be others if a possible placement lays them on
    these; the rest, less what is missed, must say more than `BranchRule.price_nats`.
    """
    order = np.argsort(-nats, kind="stable")[: rule.newest]
    seen = order[nats[order] > 0.0]
    own = float(nats[seen].sum() + nats[nats < 0.0].sum())
    if len(seen) < rule.least_landmarks or own <= rule.price_nats:
        return False
    here = Constellation(
        ids=tuple(known.ids[row] for row in seen.tolist()),
        points_m=known.points_m[seen],
        covariance_m2=_part(known.covariance_m2, seen),
    )
    variances = known.covariance_m2.diagonal().reshape(-1, 2).mean(axis=1)
    limits = float(chdtri(2, TAIL_PROBABILITY)) * (variances[seen][:, None] + variances[None, :])
    # What is alike, if but one of so many of the first landmarks is; if that is too little for the
    # rest not to say enough, two of them are.
    alike_nats = nats[seen[0]] + nats[seen].sum() - np.cumsum(nats[seen])
    seeds = int(np.count_nonzero(alike_nats >= own - rule.price_nats)) + 1
    for one in _placements(here, known, rule, seeds):
        away = transform(one.motion, here.points_m)[:, None] - known.points_m[None, :]
        is_near = np.sum(away**2, axis=2) <= limits
        # A landmark that lies on its own double is where it was.
        is_other = any(row != seen[at] and not is_near[at, seen[at]] for row, at in one.pairs)
        if is_other and is_possible(one):
            # Two landmarks of one thing lie on one other landmark.
            is_alike = is_near.any(axis=1)
            if own - float(nats[seen[is_alike]].sum()) <= rule.price_nats:
                return False
    return True


def find_placement(here: Constellation, there: Constellation, rule: BranchRule) -> Placement | None:
    """Return the motion from ``here`` to ``there`` that stands out, or None."""
    found = find_placements(here, there, rule)
    return found[0] if len(found) == 1 else None


def _differ(one: Array, other: Array, point: Array, rule: BranchRule) -> bool:
    """Return whether two motions (3,) bring a point to different places, or turn it otherwise."""
    away = transform(one, point) - transform(other, point)
    turn = math.remainder(float(one[2] - other[2]), math.tau)
    return math.hypot(away[0], away[1]) > rule.reach_m or abs(turn) > rule.reach_m / rule.base_m


def _guesses(points: Array, targets: Array, rule: BranchRule, seeds: int) -> list[Pairs]:
    """Return the pairs that agree when two landmarks of either map are laid on each other.

    Of ``points``, two of the first ``seeds``. Pairs are mutual nearest neighbours within reach.
    """
    gaps = targets[None, :] - targets[:, None]
    lengths = np.hypot(gaps[..., 0], gaps[..., 1])
    angles = np.arctan2(gaps[..., 1], gaps[..., 0])
    long_enough = lengths >= rule.base_m
    first, tree, n, least = points[:seeds], cKDTree(targets), len(points), rule.least_landmarks
    rows, agree = np.zeros((0, n), dtype=np.intp), np.zeros((0, n), dtype=np.bool_)
    for a in range(len(first)):
        for b in range(a + 1, len(first)):
            gap = points[b] - points[a]
            length = math.hypot(gap[0], gap[1])
            if length < rule.base_m:
                continue
            direction = math.atan2(gap[1], gap[0])
            alike = np.argwhere(long_enough & (np.abs(lengths - length) <= rule.reach_m))
            turns = angles[alike[:, 0], alike[:, 1]] - direction
            by_turn = points - (points[a] + points[b]) / 2
            x, y = np.cos(turns)[:, None], np.sin(turns)[:, None]
            laid = np.stack([x * by_turn[:, 0], y * by_turn[:, 0]], axis=-1)
            laid += np.stack([-y * by_turn[:, 1], x * by_turn[:, 1]], axis=-1)
            laid += targets[alike].mean(axis=1)[:, None]
            near_m, row = tree.query(laid, distance_upper_bound=rule.reach_m * _ROOM)
            is_near = np.asarray(near_m <= rule.reach_m)
            # Many lay too few on any other, or no more than those that are found already.
            able = is_near.sum(axis=1) >= least
            laid, is_near = laid[able], is_near[able]
            # The row is too large where none is within reach.
            row = np.minimum(row, len(targets) - 1)[able]
            away = targets[row][:, :, None] - laid[:, None, :]
            is_mutual = np.hypot(away[..., 0], away[..., 1]).argmin(axis=2) == np.arange(n)
            rows, agree = np.vstack([rows, row]), np.vstack([agree, is_near & is_mutual])
            counts = agree.sum(axis=1)
            most = np.argsort(-counts, kind="stable")[: rule.most_tried]
            rows, agree = rows[most], agree[most]
            if len(most) == rule.most_tried:  # Of equals, the first stay.
                least = max(least, int(counts[most[-1]]) + 1)
    return [
        tuple(sorted(zip(row[own].tolist(), np.flatnonzero(own).tolist(), strict=True)))
        for row, own in zip(rows, agree, strict=True)
        if np.count_nonzero(own) >= rule.least_landmarks
    ]


def _placements(
    here: Constellation, there: Constellation, rule: BranchRule, seeds: int
) -> Iterator[Placement]:
    """Yield the placements by the guesses, those of too few landmarks left out."""
    spans = np.ptp(there.points_m, axis=0) + 2 * NEIGHBOURHOOD_M
    place_nats = math.log(math.tau * float(spans[0] * spans[1]))
    new_nats = math.log(density_per_m2(there.points_m, NEIGHBOURHOOD_M))
    for pairs in dict.fromkeys(_guesses(here.points_m, there.points_m, rule, seeds)):
        one = _judged(here, there, pairs, place_nats, new_nats)
        if one is not None and len(one.pairs) >= rule.least_landmarks:
            yield one


def _judged(
    here: Constellation, there: Constellation, pairs: Pairs, place_nats: float, new_nats: float
) -> Placement | None:
    """Return the placement by the pairs, the worst left out until all fit; None below two.

    ``place_nats`` is that of any place and heading, ``new_nats`` that of a new landmark.
    """
    while len(pairs) >= 2:
        motion, residual, S, N = _aligned(here, there, pairs)
        S_inverse = np.linalg.inv(S)
        distance = float(residual @ S_inverse @ residual)
        if is_plausible(distance, 2 * len(pairs) - 3):
            information = N.T @ S_inverse @ N
            log_det = float(np.linalg.slogdet(math.tau * S)[1])
            log_det += float(np.linalg.slogdet(information / math.tau)[1])
            evidence = -0.5 * (distance + log_det) - place_nats
            evidence -= len(pairs) * new_nats
            return Placement(motion=motion, pairs=pairs, evidence=evidence)
        blocks = [S[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(len(pairs))]
        apart = residual.reshape(-1, 2)
        misfits = [float(r @ np.linalg.solve(B, r)) for r, B in zip(apart, blocks, strict=True)]
        worst = int(np.argmax(misfits))
        pairs = pairs[:worst] + pairs[worst + 1 :]
    return None


def _aligned(
    here: Constellation, there: Constellation, pairs: Pairs
) -> tuple[Array, Array, Array, Array]:
    """Return the motion of least squares, residual (2 k,), its covariance and derivative (2 k, 3).

    residual = T l_here - l_there; the two maps are taken to have independent errors.
    """
    targets_at = np.array([pair[0] for pair in pairs])
    points_at = np.array([pair[1] for pair in pairs])
    points, targets = here.points_m[points_at], there.points_m[targets_at]
    own = _part(here.covariance_m2, points_at)
    other = _part(there.covariance_m2, targets_at)
    motion = align_se2(points, targets)
    k = 2 * len(pairs)
    for _ in range(_STEPS):
        turned = np.kron(np.eye(len(pairs)), rotation(float(motion[2])))
        S = turned @ own @ turned.T + other
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


def _part(covariance: Array, rows: Indices) -> Array:
    at = np.stack([2 * rows, 2 * rows + 1], axis=-1).ravel()
    return np.asarray(covariance[np.ix_(at, at)])

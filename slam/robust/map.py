"""Map management: existence, merging, and whether a target is a point, a wall or round.

Merging
    The statement ``l_i - l_j = 0`` is a measurement of the whole state, H = [e_li: I, e_lj: -I]:
    merging after a loop bends the trajectory back, and everything correlated with it. It is made
    late, when one merge, or two disjoint ones together, stand out from all competitors.
Points and walls
    The specular echo of a wall comes from wherever the wall is nearest, so its range is *linear* in
    the antenna's position a; a point's is a hyperbola::

        point at b:     r = |b - a|
        wall (phi, d):  r = d - n . a,   n = [cos phi, sin phi]

    For ranges, a corner of two walls is a point. Both laws have two unknowns, so the difference of
    their chi-squares is twice the logarithm of the likelihood ratio (and that of their BIC). Over a
    short displacement, or at a great distance, it is near zero. Source: Leonard and Durrant-Whyte,
    "Directed Sonar Sensing for Mobile Robot Navigation", 1992, chapter 2.
Round targets
    The range is r = |c - a| - R, with c the axis and R the radius: a law between a point's (R = 0)
    and a wall's. Over a few frames no radius shows, and the point that fits lies on the surface.
    The ranges of the last frames are laid along odometry alone, for poses that the ranges have
    corrected already follow the wrong law.
    Odometry errs so that it looks like a radius: a scale error s stretches the way, x^2 / 2 r, by
    as much as R = 2 s r does, and a curvature kappa bends it by kappa x^2 / 2. Both are unknowns of
    the fit, with the radars' offsets and the wheels' white noise, each with its prior. Turns are
    left out: there wheels err most. The radius is accepted if a solution over all poses is likelier
    with it. It is no unknown of the state: its uncertainty counts as noise of the landmark's
    ranges.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import chdtri

from slam.config import WheelNoise
from slam.geometry import between, transform
from slam.robust.association import Identity, certain, density_per_m2, identity
from slam.robust.parameters import (
    MARGIN_NATS,
    TAIL_PROBABILITY,
    BackEndParameters,
    MapRule,
    RoundnessRule,
    chi_square_limit,
)
from slam.robust.run_log import LoggedSightings, RunLog
from slam.robust.smoother import give_radius
from slam.robust.state import Array, Indices, State, quarter_turn

# Gauss-Newton steps of a fit of a law and of a radius
_STEPS, _RADIUS_STEPS = 8, 6
_DAMPING = 1e-6
# The smallest share of a step that is tried, and the decrease of chi-square that ends a fit
_LEAST_SHARE, _LEAST_DECREASE = 1e-3, 1e-4
# What keeps matrices regular, and the direction to what stands at an antenna finite
_FLOOR, _LEAST_WAY_M = 1e-12, 1e-6
# A radius off by e misses ranges up to 30 degrees from the middle one by e (1 - cos 30 deg), all
# alike: to the hundred of one passage that is as noise ten times as large.
_SHAPE_SIGMA_PER_RADIUS_SIGMA = 1.3
# Steps that the way of an arc is cut into
_KNOTS = 8


@dataclass(slots=True)
class _Record:
    score: float = 0.0
    hits: int = 0


class Existence:
    """Scores of all landmarks by id, and which pairs were seen whole in common frames."""

    def __init__(self, rule: MapRule) -> None:
        self._rule = rule
        self._records: dict[int, _Record] = {}
        self._together: dict[tuple[int, int], int] = {}

    def hit(self, landmark_id: int, frames: int = 1) -> None:
        """Count frames that hit a landmark; a new id begins here."""
        record = self._records.setdefault(landmark_id, _Record())
        record.score = min(record.score + frames * self._rule.hit, self._rule.most)
        record.hits += frames

    def miss(self, landmark_id: int) -> None:
        """Count a frame that should have hit a landmark and did not."""
        self._records[landmark_id].score -= self._rule.miss

    def lost(self) -> list[int]:
        return [id_ for id_, record in self._records.items() if record.score < self._rule.least]

    def hits(self, landmark_id: int) -> int:
        return self._records[landmark_id].hits

    def is_reported(self, landmark_id: int) -> bool:
        return self._records[landmark_id].hits >= self._rule.report_hits

    def forget(self, landmark_id: int) -> None:
        self._records.pop(landmark_id, None)
        for pair in [pair for pair in self._together if landmark_id in pair]:
            del self._together[pair]

    def seen_whole(self, landmark_ids: Iterable[int]) -> None:
        """Count a frame in which both radars of a pair saw each of these landmarks."""
        ids = sorted(landmark_ids)
        for place, first in enumerate(ids):
            for second in ids[place + 1 :]:
                key = (first, second)
                self._together[key] = self._together.get(key, 0) + 1

    def are_apart(self, first: int, second: int) -> bool:
        """Return whether two landmarks were seen whole together, and so are two.

        Only whole sightings count: of two copies of one target, each can be given one of its two
        ranges, and they would veto their own merge.
        """
        key = (min(first, second), max(first, second))
        return self._together.get(key, 0) >= self._rule.apart_frames

    def merge(self, kept: int, gone: int) -> None:
        into, other = self._records[kept], self._records[gone]
        into.score = min(max(into.score, 0.0) + max(other.score, 0.0), self._rule.most)
        into.hits += other.hits
        for (first, second), count in list(self._together.items()):
            if gone in (first, second):
                third = second if first == gone else first
                if third != kept:
                    key = (min(kept, third), max(kept, third))
                    self._together[key] = self._together.get(key, 0) + count
        self.forget(gone)


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


def judge(
    state: State, pairs: tuple[tuple[int, int], ...], sigma_m: float, density: float
) -> Identity:
    """Judge whether landmarks, by row, are one, in pairs."""
    at, H, residual, R = merge_rows(state, pairs, sigma_m)
    return identity(pairs, residual, H @ state.P.block(at) @ H.T + R, density)


def apply_merge(state: State, pairs: tuple[tuple[int, int], ...], sigma_m: float) -> None:
    """State that pairs of landmarks are one, and marginalise the second of each."""
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
            state.shape_sigmas_m.setdefault(ids[kept], state.shape_sigmas_m.get(ids[gone], 0.0))
    for row in sorted((second for _, second in pairs), reverse=True):
        state.remove(row)


def find_merge(state: State, existence: Existence, rule: MapRule) -> Identity | None:
    """Return the merge to be made now, of one pair or two, or None."""
    density = density_per_m2(state.landmarks_m, rule.merge_reach_m)
    single = _candidates(state, existence, rule, density)
    best = certain(single)
    if best is not None:
        return best
    likely = [one for one in single if one.is_possible]
    return certain(
        [
            judge(state, one.pairs + other.pairs, rule.merge_sigma_m, density)
            for one, other in combinations(likely, 2)
            if not one.contradicts(other)
        ]
    )


def _candidates(
    state: State, existence: Existence, rule: MapRule, density: float
) -> list[Identity]:
    """Return all merges of two landmarks within reach, those far from passing the test left out."""
    if len(state.landmark_ids) < 2:
        return []
    near = cKDTree(state.landmarks_m).query_pairs(rule.merge_reach_m, output_type="ndarray")
    near = near[np.lexsort((near[:, 1], near[:, 0]))].astype(np.intp)
    distances = _distances_sq(state, near, rule.merge_sigma_m)
    # What contradicts a possible one and comes within the margin of it is kept, too.
    limit = float(chdtri(2, TAIL_PROBABILITY)) + 2.0 * MARGIN_NATS
    return [
        judge(state, ((first, second),), rule.merge_sigma_m, density)
        for first, second in near[distances <= limit].tolist()
        if not existence.are_apart(state.landmark_ids[first], state.landmark_ids[second])
    ]


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
    spread_out = determinant > _FLOOR * xx * yy
    return np.where(spread_out, numerator / np.where(spread_out, determinant, 1.0), 0.0)


@dataclass(frozen=True, slots=True)
class Radius:
    """A radius [m] and its standard deviation; chi-square and its degrees of freedom."""

    radius_m: float
    sigma_m: float
    chi_square: float
    dof: int


def radius_of(
    log: RunLog, state: State, landmark_id: int, wheels: WheelNoise, rule: RoundnessRule
) -> Radius | None:
    """Return the radius that fits the last ranges of a landmark best; None if they are too few.

    Unknown are the axis, the radius, and q: scale, curvature, offsets and wheel noise in steps.
    """
    seen = log.sightings(landmark_id, rule.window, state.calibration, rule.most_turn_rad)
    k = len(seen.ranges_m)
    if k < rule.min_ranges:
        return None
    length_m = float(np.ptp(seen.way_m))
    if length_m < rule.min_way_m:
        return None
    place = state.landmarks_m[state.landmark_ids.index(landmark_id)]
    step_m = length_m / _KNOTS
    moved = _moved_by_steps(seen, step_m)
    since = seen.way_m - seen.way_m.min()
    ahead = np.column_stack([np.cos(seen.headings_rad), np.sin(seen.headings_rad)])
    by_scale, by_curvature = since[:, None] * ahead, step_m * moved[:, :, :_KNOTS].sum(axis=2)
    n_offsets = len(state.offsets_m)
    nuisance = np.concatenate(
        [by_scale[..., None], by_curvature[..., None], np.zeros((k, 2, n_offsets)), moved], axis=2
    )
    by_offset = np.zeros((k, nuisance.shape[2]))
    by_offset[np.arange(k), 2 + seen.radars] = 1.0
    at = np.array([3, 5, *range(state.offsets.start, state.offsets.stop)])
    prior = np.zeros((nuisance.shape[2], nuisance.shape[2]))
    known = 2 + n_offsets
    prior[:known, :known] = np.linalg.inv(state.P.block(at) + _FLOOR * np.eye(known))
    white = np.square(
        [wheels.heading_rad_per_sqrt_m, wheels.along_m_per_sqrt_m, wheels.across_m_per_sqrt_m]
    )
    per_step = np.repeat(white * step_m + _FLOOR, _KNOTS)
    prior[known:, known:] = np.diag(1.0 / per_step)
    ranges_m, variances = seen.ranges_m - state.offsets_m[seen.radars], np.square(seen.sigmas_m)
    start_m = transform(seen.newest, transform(between(state.pose, np.zeros(3)), place))
    unknown = np.concatenate([start_m, np.zeros(1 + len(prior))])
    for _ in range(_RADIUS_STEPS):
        q = unknown[3:]
        away = unknown[:2] - seen.antennas_m - nuisance @ q
        distance = np.maximum(np.hypot(away[:, 0], away[:, 1]), _LEAST_WAY_M)
        u = away / distance[:, None]
        residual = ranges_m - (distance - unknown[2] + by_offset @ q)
        by_q = by_offset - np.einsum("ki,kiq->kq", u, nuisance)
        J = np.hstack([u, -np.ones((len(u), 1)), by_q])
        information = (J.T / variances) @ J
        information[3:, 3:] += prior
        gradient = (J.T / variances) @ residual
        gradient[3:] -= prior @ q
        try:
            covariance = np.linalg.inv(information)
        except np.linalg.LinAlgError:
            return None
        unknown = unknown + covariance @ gradient
    if not np.isfinite(unknown).all() or covariance[2, 2] <= 0.0:
        return None
    q = unknown[3:]
    return Radius(
        radius_m=float(unknown[2]),
        sigma_m=math.sqrt(float(covariance[2, 2])),
        chi_square=float(residual @ (residual / variances) + q @ prior @ q),
        dof=len(residual) - 3,
    )


def _moved_by_steps(seen: LoggedSightings, step_m: float) -> Array:
    """Return how errors of the wheels along the way move the antennas, shape (k, 2, 3 _KNOTS).

    The way is cut into steps; a turn, then a shift ahead, then one to the left may happen amid each
    of them, and move what comes after.
    """
    order = np.argsort(seen.way_m, kind="stable")
    knots_m = seen.way_m[order[0]] + step_m * (np.arange(_KNOTS) + 0.5)
    way_m = seen.way_m[order]
    places = np.column_stack([np.interp(knots_m, way_m, seen.places_m[order, i]) for i in (0, 1)])
    headings = np.interp(knots_m, way_m, seen.headings_rad[order])
    ahead = np.column_stack([np.cos(headings), np.sin(headings)])
    after = (seen.way_m[:, None] > knots_m)[..., None]
    turned = quarter_turn(seen.antennas_m[:, None] - places) * after
    shifted = [np.where(after, way, 0.0) for way in (ahead, quarter_turn(ahead))]
    return np.concatenate([each.transpose(0, 2, 1) for each in (turned, *shifted)], axis=2)


class Roundness:
    """Gives round landmarks their radii."""

    def __init__(self, rule: RoundnessRule) -> None:
        self._rule = rule
        self._hits: dict[int, int] = {}
        self._sigmas_m: dict[int, float] = {}

    def give(
        self, state: State, log: RunLog, parameters: BackEndParameters, existence: Existence
    ) -> bool:
        """Give landmarks the radii that are evident; return whether all poses were solved for."""
        solved = False
        rule = self._rule
        for row, id_ in enumerate(state.landmark_ids):
            count = existence.hits(id_)
            if count - self._hits.get(id_, 0) < rule.every or log.is_condensed(id_):
                continue
            self._hits[id_] = count
            radius = radius_of(log, state, id_, parameters.wheels, rule)
            if radius is None or not self._is_news(id_, radius):
                continue
            self._sigmas_m[id_] = radius.sigma_m
            radius_m = radius.radius_m if self._is_likely(radius) else 0.0
            known_m = state.radii_m.get(id_, 0.0)
            if radius_m == known_m:
                continue
            # Being round takes evidence; of two radii the likelier one is right.
            margin = 0.0 if known_m else rule.margin
            if give_radius(log, state, parameters, (row, radius_m), margin):
                solved = True
                state.shape_sigmas_m[id_] = (
                    _SHAPE_SIGMA_PER_RADIUS_SIGMA * radius.sigma_m if radius_m else 0.0
                )
        return solved

    def _is_news(self, id_: int, radius: Radius) -> bool:
        """Return whether a radius is worth a solution over all poses."""
        limit = chi_square_limit(radius.dof, self._rule.excess_sigmas)
        if radius.chi_square > limit:
            return False
        if id_ not in self._sigmas_m:
            return self._is_likely(radius)
        return radius.sigma_m < self._rule.sharper * self._sigmas_m[id_]

    def _is_likely(self, radius: Radius) -> bool:
        least_m = self._rule.sigmas * radius.sigma_m
        return least_m < radius.radius_m < self._rule.largest_m

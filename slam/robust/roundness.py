"""Round targets: a drum answers from the point of its surface nearest to the antenna.

Its range is r = |c - a| - R, with c its axis and R its radius: a law between a point's (R = 0) and
a wall's. Over a few frames no radius is seen, and the point that fits lies on the surface; the
farther the robot drives, the more ranges miss it. So points whose ranges tell a radius get one.

The ranges of the last frames are laid along odometry alone, for poses that the ranges have
corrected already have given way to the wrong law. Odometry errs so that it looks like a radius:
a scale error s stretches the way, x^2 / 2 r, by as much as R = 2 s r does, and a curvature kappa
bends it by kappa x^2 / 2. Both are unknowns of the fit, with the radars' offsets and the wheels'
white noise, each with what is known of it before. Turns are left out: there wheels err most.

That makes a radius likely. It is believed if a solution over all poses is likelier with it. It is
no unknown of the state: what is not known of it counts as noise of the landmark's ranges.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from slam.geometry import between, transform
from slam.robust.parameters import BackEndParameters, RoundnessRule, WheelNoise
from slam.robust.relinearisation import give_radius
from slam.robust.run_log import LoggedSightings, RunLog
from slam.robust.state import State, quarter_turn
from slam.robust.symmetric import Array

# A radius off by e misses ranges up to 30 degrees from the middle one by e (1 - cos 30 deg), all
# alike: to the hundred of one passage that is as noise ten times as large.
_DOUBT_PER_SIGMA = 1.3
_STEPS = 6
_KNOTS = 8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Arc:
    """Ranges of one target along one piece of way, in the odometry frame of its first pose.

    Attributes
    ----------
    antennas_m, ranges_m, variances
        shapes (k, 2), (k,), (k,); ranges without the offsets known.
    nuisance
        shape (k, 2, q): d(antenna) / d(scale, curvature, offsets, wheel noise in steps).
    by_offset
        shape (k, q): d(range) / d(the same), of the offsets alone.
    prior
        shape (q, q): information about all q.
    start_m
        shape (2,): where the landmark is believed to be.
    """

    antennas_m: Array
    ranges_m: Array
    variances: Array
    nuisance: Array
    by_offset: Array
    prior: Array
    start_m: Array


@dataclass(frozen=True, slots=True)
class Radius:
    """A radius [m] and its standard deviation; chi-square and its degrees of freedom."""

    radius_m: float
    sigma_m: float
    chi_square: float
    dof: int


def arc_of(
    log: RunLog, state: State, landmark_id: int, wheels: WheelNoise, rule: RoundnessRule
) -> Arc | None:
    """Return what the last frames say of a landmark; None where that is too little."""
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
    prior[:known, :known] = np.linalg.inv(state.P.block(at) + 1e-12 * np.eye(known))
    white = np.square(
        [wheels.heading_rad_per_sqrt_m, wheels.along_m_per_sqrt_m, wheels.across_m_per_sqrt_m]
    )
    per_step = np.repeat(white * step_m + 1e-12, _KNOTS)
    prior[known:, known:] = np.diag(1.0 / per_step)
    return Arc(
        antennas_m=seen.antennas_m,
        ranges_m=seen.ranges_m - state.offsets_m[seen.radars],
        variances=np.square(seen.sigmas_m),
        nuisance=nuisance,
        by_offset=by_offset,
        prior=prior,
        start_m=transform(seen.newest, transform(between(state.pose, np.zeros(3)), place)),
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


def radius_of(arc: Arc) -> Radius | None:
    """Return the radius that ranges tell; None where the fit fails."""
    unknown = np.concatenate([arc.start_m, np.zeros(1 + len(arc.prior))])
    for _ in range(_STEPS):
        q = unknown[3:]
        away = unknown[:2] - arc.antennas_m - arc.nuisance @ q
        distance = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-6)
        u = away / distance[:, None]
        residual = arc.ranges_m - (distance - unknown[2] + arc.by_offset @ q)
        moved = arc.by_offset - np.einsum("ki,kiq->kq", u, arc.nuisance)
        J = np.hstack([u, -np.ones((len(u), 1)), moved])
        information = (J.T / arc.variances) @ J
        information[3:, 3:] += arc.prior
        gradient = (J.T / arc.variances) @ residual
        gradient[3:] -= arc.prior @ q
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
        chi_square=float(residual @ (residual / arc.variances) + q @ arc.prior @ q),
        dof=len(residual) - 3,
    )


class Roundness:
    """Gives landmarks their radii.

    Parameters
    ----------
    rule
        When a radius is believed.
    """

    def __init__(self, rule: RoundnessRule) -> None:
        self._rule = rule
        self._hits: dict[int, int] = {}
        self._sigmas_m: dict[int, float] = {}

    def give(
        self,
        state: State,
        log: RunLog,
        parameters: BackEndParameters,
        hits: Callable[[int], int],
    ) -> bool:
        """Give landmarks the radii that are evident; tell whether all poses were solved for.

        Parameters
        ----------
        state, log, parameters
            The belief, what was measured, and its noise.
        hits
            Returns the frames that hit a landmark so far.
        """
        solved = False
        rule = self._rule
        for row, id_ in enumerate(state.landmark_ids):
            count = hits(id_)
            if count - self._hits.get(id_, 0) < rule.every or log.is_condensed(id_):
                continue
            self._hits[id_] = count
            arc = arc_of(log, state, id_, parameters.wheels, rule)
            radius = None if arc is None else radius_of(arc)
            if radius is None or not self._is_news(id_, radius):
                continue
            self._sigmas_m[id_] = radius.sigma_m
            told_m = radius.radius_m if self._is_likely(radius) else 0.0
            known_m = state.radii_m.get(id_, 0.0)
            if told_m == known_m:
                continue
            # Being round takes evidence; of two radii the likelier one is right.
            lead = 0.0 if known_m else rule.lead
            if give_radius(log, state, parameters, (row, told_m), lead):
                solved = True
                state.range_doubts_m[id_] = _DOUBT_PER_SIGMA * radius.sigma_m if told_m else 0.0
        return solved

    def _is_news(self, id_: int, radius: Radius) -> bool:
        """Tell whether a radius is worth a look at all that was measured."""
        limit = radius.dof + self._rule.excess_sigmas * math.sqrt(2.0 * max(radius.dof, 0))
        before_m = self._sigmas_m.get(id_)
        if radius.chi_square > limit:
            return False
        if before_m is None:
            return self._is_likely(radius)
        return radius.sigma_m < self._rule.sharper * before_m

    def _is_likely(self, radius: Radius) -> bool:
        least_m = self._rule.sigmas * radius.sigma_m
        return least_m < radius.radius_m < self._rule.largest_m

"""Landmarks whose ranges have labels: where a beacon is, from its own ranges and the robot's way.

Ranges of one beacon from a straight way have two places, mirror images of each other. So the ranges
of a beacon that is not in the map wait in the log of the run. Now and then places are looked for
where they have a least sum of squares, the trajectory being taken for true. The whole run is solved
for with the beacon at the two likeliest, and at the mirror image of the first. The likeliest place
then is the beacon's if every other is less likely by `BranchRule.price_nats`, most ranges fit, and
it is known well enough for ranges to be linear there: over a spread e across the direction to it,
the circle of a range r bends away from its tangent by e^2 / (2 r), which must be less than the
noise of a range. That solution becomes the belief: all ranges so far then count, and none twice.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass

import numpy as np

from slam.geometry import mirrored
from slam.robust.parameters import BackEndParameters, is_plausible
from slam.robust.solver.revision import adopt, is_determined
from slam.robust.solver.run_log import Problem, RunLog
from slam.robust.solver.smoother import Smoother, Solution, measurement_residuals
from slam.robust.state import HEAD_SIZE, Array, State, quarter_turn, rotation

# Variance of a beacon's place until the run is solved for with it
_ANYWHERE_M2 = 1.0
# Steps of the search for places, its damping, and what keeps directions finite
_STEPS, _DAMPING, _LEAST_M = 30, 1e-3, 1e-9
# Directions in which the search begins, from each of some antennas
_ANGLES_RAD = np.arange(0.0, math.tau, 0.25)


@dataclass(slots=True)
class Waiting:
    """A beacon that is not in the map; its ranges are in the log under an id of their own."""

    log_id: int
    n_ranges: int = 0
    try_at: int = 0  # number of ranges from which on its place is looked for


def find_places(
    ranges_m: Array, sigmas_m: Array, antennas_m: Array, parameters: BackEndParameters
) -> Array:
    """Return where ranges from some antennas (k, 2) may cross, (m, 2) [m], likeliest first.

    These are the two least minima of Huber's cost that are reached from circles about three of the
    antennas, and the mirror image of the first one across the way of the antennas.
    """
    k, huber = len(ranges_m), parameters.ranges.huber_sigmas
    ring = np.column_stack([np.cos(_ANGLES_RAD), np.sin(_ANGLES_RAD)])
    points = np.concatenate(
        [antennas_m[i] + ranges_m[i] * ring for i in sorted({0, k // 2, k - 1})]
    )
    reach_m = float(np.median(ranges_m))

    def residuals(points: Array) -> tuple[Array, Array]:
        away = points[:, None, :] - antennas_m[None]
        distance = np.maximum(np.hypot(away[..., 0], away[..., 1]), _LEAST_M)
        return away / distance[..., None], (distance - ranges_m) / sigmas_m

    for _ in range(_STEPS):
        u, white = residuals(points)
        J = u / sigmas_m[None, :, None]
        weight = np.minimum(huber / np.maximum(np.abs(white), _LEAST_M), 1.0)
        information = np.einsum("mk,mki,mkj->mij", weight, J, J)
        trace = np.trace(information, axis1=1, axis2=2)
        information += _DAMPING * trace[:, None, None] * np.eye(2)
        gradient = np.einsum("mk,mki,mk->mi", weight, J, white)
        change = np.linalg.solve(information, gradient[..., None])[..., 0]
        length = np.hypot(change[:, 0], change[:, 1])
        points = points - change * np.minimum(1.0, reach_m / np.maximum(length, _LEAST_M))[:, None]
    white = np.abs(residuals(points)[1])
    costs = np.sum(white**2 - np.maximum(white - huber, 0.0) ** 2, axis=1)
    ranked = points[np.argsort(costs, kind="stable")]
    first = ranked[0]
    # What is closer than the noise of a range is the same minimum.
    others = ranked[np.hypot(*(ranked - first).T) > float(np.median(sigmas_m))]
    return np.array([first, *others[:1], mirrored(first, antennas_m)])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Candidate:
    """The solution of the whole run that begins with the beacon at one place."""

    point_m: Array  # begin of the search, shape (2,)
    problem: Problem
    solution: Solution
    cost: float

    @property
    def row(self) -> int:
        return self.problem.layout.n_landmarks - 1

    @property
    def place_m(self) -> Array:
        """Return where the beacon is in the solution, shape (2,)."""
        return self.solution.estimate.fixed[self._first - HEAD_SIZE :][:2]

    @property
    def _first(self) -> int:
        return int(self.problem.layout.first_columns(np.array([self.row]))[0])

    def covariances(self) -> tuple[Array, Array]:
        """Return the covariance of the place in the map, and as seen from the robot, (2, 2)."""
        R = rotation(float(self.solution.estimate.poses[-1, 2]))
        away = self.place_m - self.solution.estimate.poses[-1, :2]
        P = np.linalg.inv(self.solution.information)
        at = np.array([0, 1, 2, self._first, self._first + 1])
        H = np.column_stack([-np.eye(2), -quarter_turn(away), np.eye(2)])
        H = R.T @ H
        own = P[np.ix_(at[3:], at[3:])]
        return own, H @ P[np.ix_(at, at)] @ H.T


def initialise_beacon(
    log: RunLog, state: State, log_id: int, parameters: BackEndParameters
) -> int | None:
    """Bring a beacon into the map if its ranges have one place; return its id, or None.

    ``log_id`` is that of its ranges in the log. Then the solution of the whole run is the belief.
    """
    ranges_m, sigmas_m, antennas_m = log.ranges_of(log_id)
    candidates = [
        candidate
        for point_m in find_places(ranges_m, sigmas_m, antennas_m, parameters)
        if (candidate := _solved_with(log, state, log_id, point_m, parameters)) is not None
    ]
    if not candidates:
        return None
    best = min(candidates, key=lambda candidate: candidate.cost)
    if not is_determined(best.solution.information):
        return None
    covariance, seen = best.covariances()
    for other in candidates:
        away = other.place_m - best.place_m
        is_same = is_plausible(float(away @ np.linalg.solve(covariance, away)), 2)
        if not is_same and other.cost - best.cost < 2.0 * parameters.branches.price_nats:
            return None
    spread_m2 = float(np.linalg.eigvalsh(seen)[-1])
    if spread_m2 > 2.0 * float(np.median(ranges_m)) * float(np.median(sigmas_m)):
        return None
    mine = best.problem.range_landmarks == best.row
    residual = measurement_residuals(best.problem, best.solution.estimate).residual[: len(mine)]
    if _share_that_fits(residual[mine], parameters) < parameters.initialisation.min_share:
        return None
    landmark_id = _augmented(state, best.point_m)
    log.rename(log_id, landmark_id)
    adopt(log, state, best.problem, best.solution, parameters)
    log.since_solved = 0
    return landmark_id


def is_heard_where_it_is(
    log: RunLog, state: State, row: int, parameters: BackEndParameters
) -> bool:
    """Return whether enough of the newest ranges of a beacon fit its place; after a solution."""
    rule, problem = parameters.initialisation, log.problem(state, parameters)
    mine = np.flatnonzero(problem.range_landmarks == row)[-rule.min_frames :]
    residual = measurement_residuals(problem, log.starts(state, problem)[0]).residual[mine]
    return _share_that_fits(residual, parameters) >= rule.min_share


def _share_that_fits(residual: Array, parameters: BackEndParameters) -> float:
    return float(np.mean(np.abs(residual) <= parameters.relinearisation.outlier_sigmas))


def _augmented(state: State, point_m: Array) -> int:
    """Add a landmark that has no place yet, and return its id."""
    size = state.layout.landmark_size
    return state.augment(point_m, np.zeros((state.P.size, size)), _ANYWHERE_M2 * np.eye(size))


def _solved_with(
    log: RunLog, state: State, log_id: int, point_m: Array, parameters: BackEndParameters
) -> _Candidate | None:
    """Return the solution of the whole run that begins with a beacon at a place, or None."""
    other = copy.deepcopy(state)
    problem = log.problem(other, parameters, {log_id: _augmented(other, point_m)})
    smoother = Smoother(problem, parameters)
    solution = smoother.solve(min(log.starts(other, problem), key=smoother.cost))
    if solution is None:
        return None
    limit = parameters.relinearisation.outlier_sigmas
    cost = smoother.cost(solution.estimate, limit)
    return _Candidate(point_m=point_m, problem=problem, solution=solution, cost=cost)

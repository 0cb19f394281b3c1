"""When the filter has come far from where it linearised, all poses are solved for again."""

from __future__ import annotations

import math
from contextlib import suppress

import numpy as np

from slam.robust.parameters import BackEndParameters, RelinearisationRule
from slam.robust.problem import Estimate, start_prior
from slam.robust.run_log import RunLog
from slam.robust.smoother import Smoother, Solution
from slam.robust.state import HEADING, State
from slam.robust.symmetric import Array, SymmetricMatrix

_UNKNOWN = 100.0


def is_due(log: RunLog, state: State, parameters: BackEndParameters) -> bool:
    """Tell whether the pose has parted too far from the stored trajectory, or that is too long."""
    rule = parameters.relinearisation
    if rule is None:
        return False
    if log.since_solved < rule.every:
        return False
    if log.n_kept > rule.most_poses:
        return True
    if not state.feature_ids:
        return False
    shift_m, turn_rad = log.parted(state.pose)
    return turn_rad > rule.turn_rad or shift_m > rule.shift_m


def relinearise(log: RunLog, state: State, parameters: BackEndParameters) -> bool:
    """Solve for all poses and let the result take the belief's place; tell whether it worked."""
    rule = parameters.relinearisation
    if rule is None:
        return False
    log.tried()
    smoother, start = _all_poses(log, state, parameters, rule)
    solution = smoother.solve(start)
    if solution is not None and not is_determined(solution.information):
        solution = None
    if solution is not None:
        _replace(state, solution)
        log.solved(solution.estimate)
    if log.n_kept > rule.most_poses:
        # Best at the solution; but the log must not grow, not even where there is none.
        known = start if solution is None else solution.estimate
        n_steps = log.n_kept - math.ceil(rule.kept_share * rule.most_poses)
        with suppress(np.linalg.LinAlgError):  # then it is tried again a little later
            prior = smoother.condensed(known, n_steps, rule.outlier_sigmas)
            log.condense(prior, state.feature_ids, n_steps)
    return solution is not None


def give_radius(
    log: RunLog,
    state: State,
    parameters: BackEndParameters,
    candidate: tuple[int, float],
    lead: float,
) -> bool:
    """Give the landmark in a row a radius if all that was measured is likelier so; tell if it is.

    ``lead`` is by how much the cost of the solution over all poses must fall. Then that solution
    takes the belief's place.
    """
    rule = parameters.relinearisation
    if rule is None:
        return False
    row, radius_m = candidate
    smoother, start = _all_poses(log, state, parameters, rule)
    solution = smoother.solve(start)
    if solution is None:
        return False
    least = solution.cost - lead
    id_, point_m = state.landmark_ids[row], state.landmarks_m[row].copy()
    before_m = state.radii_m.pop(id_, 0.0)
    away = point_m - state.position_m
    state.landmarks_m[row] += (radius_m - before_m) * away / max(float(np.hypot(*away)), 1e-6)
    if radius_m:
        state.radii_m[id_] = radius_m
    smoother, start = _all_poses(log, state, parameters, rule)
    solution = smoother.solve(start)
    fits = solution is not None and solution.cost <= least
    if solution is not None and fits and is_determined(solution.information):
        _replace(state, solution)
        log.solved(solution.estimate)
        return True
    state.landmarks_m[row] = point_m
    state.radii_m.pop(id_, None)
    if before_m:
        state.radii_m[id_] = before_m
    return False


def is_determined(information: Array) -> bool:
    """Tell whether all unknowns of a solution are known to better than 100 m, rad or 1.

    A landmark all of whose ranges were left out as too far off has no information but rounding;
    its covariance would be of 1e14 m^2, and have negative eigenvalues.
    """
    variances = np.linalg.inv(information).diagonal()
    return bool(np.all((variances > 0.0) & (variances < _UNKNOWN**2)))


def _all_poses(
    log: RunLog, state: State, parameters: BackEndParameters, rule: RelinearisationRule
) -> tuple[Smoother, Estimate]:
    """Return the problem of all poses and the better of the values to start from."""
    prior = start_prior(
        parameters.wheels.calibration_sigmas,
        (parameters.ranges.offset_sigma_m,) * len(state.offsets_m),
        len(state.feature_ids),
    )
    problem = log.problem(state, prior)
    smoother = Smoother(problem, rule)
    return smoother, min(log.starts(state, problem), key=smoother.cost)


def _replace(state: State, solution: Solution) -> None:
    """Let a solution take the place of the belief."""
    estimate = solution.estimate
    pose = estimate.poses[-1]
    state.position_m = pose[:2].copy()
    state.heading_rad = math.remainder(float(pose[2]), math.tau)
    state.calibration = estimate.calibration[-1].copy()
    state.offsets_m = estimate.offsets_m.copy()
    n = len(state.landmark_ids)
    state.landmarks_m = estimate.landmarks_m[:n].copy()
    state.walls = estimate.landmarks_m[n:].copy()
    state.P = SymmetricMatrix(invariant_covariance(state, solution.information))


def invariant_covariance(state: State, information: Array) -> Array:
    """Return the covariance of the right-invariant error from the information of additive ones.

    The smoother orders (x, y, heading, ...), the filter (heading, x, y, ...);
    e_p = e_add,p - J p e_th, landmarks likewise.
    """
    additive = np.linalg.inv(information)
    order = np.concatenate([[2, 0, 1], np.arange(3, len(additive))])
    additive = additive[np.ix_(order, order)]
    T = state.additive_transform()
    T[1:, HEADING] *= -1.0
    P = T @ additive @ T.T
    return np.asarray((P + P.T) / 2)

"""When the filter has come far from where it linearised, all poses are solved for again."""

from __future__ import annotations

import math
from contextlib import suppress

import numpy as np

from slam.robust.parameters import BackEndParameters
from slam.robust.problem import start_prior
from slam.robust.run_log import RunLog
from slam.robust.smoother import Smoother, Solution
from slam.robust.state import HEADING, State
from slam.robust.symmetric import Array, SymmetricMatrix


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
    prior = start_prior(
        parameters.wheels.calibration_sigmas,
        (parameters.ranges.offset_sigma_m,) * len(state.offsets_m),
        len(state.feature_ids),
    )
    problem = log.problem(state, prior)
    smoother = Smoother(problem, rule)
    start = min(log.starts(state, problem), key=smoother.cost)
    solution = smoother.solve(start)
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

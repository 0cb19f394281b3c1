"""All poses at once: Gauss-Newton that eliminates the poses in time order.

Unknown are the poses, the calibration errors of the wheels (constant, or one set per pose that
walks), the range offsets and the landmarks. The normal equations are a band along time with a
border: the last pose, its calibration, the offsets and the landmarks. A band Cholesky in time
order eliminates all earlier poses in O(poses); the Schur complement left on the border is the
information of the belief that takes the filter's place, so no measurement counts twice.
Errors are additive here. Step lengths are halved until the cost falls. Source: square root
smoothing, Dellaert and Kaess, IJRR 25(12), 2006, with time order instead of a search for one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slam.robust.normal_equations import (
    BORDER_HEAD,
    CALIBRATION,
    POSE,
    NormalEquations,
    eliminate,
    solve,
)
from slam.robust.parameters import RelinearisationRule
from slam.robust.prior import first_values, prior_about, prior_cost, prior_terms
from slam.robust.problem import Estimate, Prior, Problem
from slam.robust.residuals import measurement_residuals, motion_residuals
from slam.robust.symmetric import Array

_LEAST_WALK_SHARE = 1e-5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solution:
    """The least-squares estimate and what is left to know.

    ``information`` is the Schur complement on (last pose, its calibration, offsets, landmarks),
    additive errors, shape (6 + r + 2 n,) squared; ``cost`` the sum of squared white residuals,
    counted from where the prior was taken.
    """

    estimate: Estimate
    information: Array
    cost: float


class Smoother:
    """Solves one problem.

    Parameters
    ----------
    problem
        What was measured.
    rule
        How many steps, and when ranges are left out.
    """

    def __init__(self, problem: Problem, rule: RelinearisationRule) -> None:
        self._problem, self._rule = problem, rule
        self._roots = _inverse_roots(problem.covariances)
        least = _LEAST_WALK_SHARE * np.sqrt(problem.walks.max(axis=0, initial=0.0))
        self._walk_roots = 1.0 / np.sqrt(problem.walks + least**2 + 1e-300)

    def solve(self, start: Estimate, tolerance: float = 1e-2) -> Solution | None:
        """Return the least-squares solution reached from a start, or None if it failed.

        ``tolerance`` is the decrease of the cost below which the search ends.
        """
        estimate, limit = start, math.inf
        cost = self.cost(estimate, limit)
        for iteration in range(1, self._rule.iterations + 1):
            if iteration == self._rule.outliers_from:
                limit = self._rule.outlier_sigmas
                cost = self.cost(estimate, limit)
            try:
                change = solve(self._equations(estimate, limit))
            except np.linalg.LinAlgError:
                return None
            share, better = 1.0, estimate
            for _ in range(8):
                better = _moved(estimate, change, share)
                new_cost = self.cost(better, limit)
                if new_cost <= cost + 1e-12:
                    break
                share *= 0.5
            else:
                new_cost, better = cost, estimate
            decrease, cost, estimate = cost - new_cost, new_cost, better
            if decrease < tolerance and iteration >= self._rule.outliers_from:
                break
        try:
            information = eliminate(self._equations(estimate, limit)).information
            np.linalg.cholesky(information)
        except np.linalg.LinAlgError:
            return None
        return Solution(estimate=estimate, information=information, cost=cost)

    def cost(self, estimate: Estimate, limit: float = math.inf) -> float:
        """Return the sum of squared white residuals, each measurement's capped at ``limit``."""
        steps, rows = (
            motion_residuals(self._problem, estimate, self._roots),
            measurement_residuals(self._problem, estimate),
        )
        total = float(np.sum(np.minimum(rows.residual**2, limit**2)))
        total += float(np.sum(steps.residual**2))
        walk = self._walk_residual(estimate)
        total += float(np.sum(walk**2))
        n_offsets = len(estimate.offsets_m)
        return total + prior_cost(self._problem.prior, first_values(estimate), n_offsets)

    def condensed(self, estimate: Estimate, n_steps: int, limit: float) -> Prior:
        """Return all that the poses before pose ``n_steps`` tell, as a prior on what is left.

        What lies beyond ``limit`` is left out. With the prior in place of the first ``n_steps``
        steps and of the measurements from their poses, the normal equations at this estimate have
        the same Schur complement: nothing is lost there, and nothing counts twice.
        """
        part = Smoother(self._problem.beginning(n_steps), self._rule)
        calibration = estimate.calibration
        if len(calibration) > 1:
            calibration = calibration[: n_steps + 1]
        beginning = Estimate(
            poses=estimate.poses[: n_steps + 1],
            calibration=calibration,
            offsets_m=estimate.offsets_m,
            landmarks_m=estimate.landmarks_m,
        )
        left = eliminate(part._equations(beginning, limit))
        values = first_values(
            Estimate(
                poses=beginning.poses[-1:],
                calibration=calibration[-1:],
                offsets_m=estimate.offsets_m,
                landmarks_m=estimate.landmarks_m,
            )
        )
        return prior_about(
            left.information,
            left.gradient,
            values,
            len(estimate.offsets_m),
            self._problem.n_walls,
        )

    def _walk_residual(self, estimate: Estimate) -> Array:
        if len(estimate.calibration) == 1:
            return np.zeros((0, 3))
        return np.asarray(np.diff(estimate.calibration, axis=0) * self._walk_roots)

    def _equations(self, estimate: Estimate, limit: float) -> NormalEquations:
        problem = self._problem
        n_border = BORDER_HEAD + len(estimate.offsets_m) + 2 * len(estimate.landmarks_m)
        size = 6 if problem.is_walking else 3
        equations = NormalEquations(len(problem.increments), size, n_border)
        steps = motion_residuals(self._problem, estimate, self._roots)
        if problem.is_walking:
            equations.add_walking_steps(steps, self._walk_roots, self._walk_residual(estimate))
        else:
            equations.add_steps(steps)
        rows = measurement_residuals(self._problem, estimate)
        weight = np.abs(rows.residual) <= limit
        equations.add_rows(rows, weight, len(estimate.offsets_m))
        n_offsets = len(estimate.offsets_m)
        prior = prior_terms(problem.prior, first_values(estimate), n_offsets)
        equations.add_prior(prior.information, prior.gradient)
        return equations


def _moved(estimate: Estimate, change: tuple[Array, Array], share: float) -> Estimate:
    chain, border = change
    poses = estimate.poses.copy()
    poses[:-1] += share * chain[:, :3]
    poses[-1] += share * border[POSE]
    calibration = estimate.calibration.copy()
    if chain.shape[1] == BORDER_HEAD:
        calibration[:-1] += share * chain[:, 3:]
        calibration[-1] += share * border[CALIBRATION]
    else:
        calibration[0] += share * border[CALIBRATION]
    n_offsets = len(estimate.offsets_m)
    rest = share * border[BORDER_HEAD:]
    return Estimate(
        poses=poses,
        calibration=calibration,
        offsets_m=estimate.offsets_m + rest[:n_offsets],
        landmarks_m=estimate.landmarks_m + rest[n_offsets:].reshape(-1, 2),
    )


def _inverse_roots(covariances: Array) -> Array:
    """Return matrices W with W C W^T = I, shape (k, 3, 3)."""
    if not len(covariances):
        return np.zeros((0, 3, 3))
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariances)))

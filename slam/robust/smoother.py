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
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbtrf, dtbtrs

from slam.geometry import wrap_angles
from slam.robust.parameters import RelinearisationRule
from slam.robust.symmetric import Array, Indices

# Standard deviations below these are taken as these, so that information stays finite.
_LEAST_CALIBRATION = 1e-7
_LEAST_OFFSET_M = 1e-7
_LEAST_WALK_SHARE = 1e-5
# Borders: last pose, its calibration, then offsets and landmarks.
_POSE, _CALIBRATION = slice(0, 3), slice(3, 6)
_BORDER_HEAD = 6


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate:
    """Values of all unknowns.

    Attributes
    ----------
    poses
        shape (k + 1, 3): x, y, heading.
    calibration
        shape (k + 1, 3) if it walks, else (1, 3): s, w, kappa.
    offsets_m, landmarks_m
        shapes (r,) and (n, 2).
    """

    poses: Array
    calibration: Array
    offsets_m: Array
    landmarks_m: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prior:
    """What is known beforehand of the first pose, its calibration, the offsets and landmarks.

    ``information`` has shape (6 + r + 2 n,) squared in that order, about ``mean``.
    """

    information: Array
    mean: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Problem:
    """All that was measured.

    Attributes
    ----------
    increments, covariances
        shapes (k, 3) and (k, 3, 3): reported steps from pose to pose, and their noise.
    walks
        shape (k, 3): variance each calibration error gains per step; all zero: constants.
    prior
        Of the first pose and everything that does not move.
    range_poses, range_radars, range_landmarks
        shape (m,) each: which pose, radar and landmark a range belongs to.
    range_antennas, ranges_m
        shapes (m, 2) and (m,): antenna in the body frame of the pose.
    range_sigma_m
        Noise of a range.
    point_poses, point_landmarks, points, point_roots
        shapes (q,), (q,), (q, 2), (q, 2, 2): range and bearing seen from the body's origin,
        and a matrix that makes their noise white.
    """

    increments: Array
    covariances: Array
    walks: Array
    prior: Prior
    range_poses: Indices
    range_radars: Indices
    range_landmarks: Indices
    range_antennas: Array
    ranges_m: Array
    range_sigma_m: float
    point_poses: Indices
    point_landmarks: Indices
    points: Array
    point_roots: Array

    @property
    def is_walking(self) -> bool:
        """Tell whether the calibration has one value per pose."""
        return bool(np.any(self.walks > 0.0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solution:
    """The least-squares estimate and what is left to know.

    ``information`` is the Schur complement on (last pose, its calibration, offsets, landmarks),
    additive errors, shape (6 + r + 2 n,) squared; ``cost`` the sum of squared white residuals.
    """

    estimate: Estimate
    information: Array
    cost: float
    iterations: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Rows:
    """White scalar rows of measurements: residual and derivatives."""

    poses: Indices
    landmarks: Indices
    residual: Array
    by_pose: Array  # (m, 3)
    by_landmark: Array  # (m, 2)
    radars: Indices  # -1: none
    by_offset: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Steps:
    """White residuals (k, 3) of all motions, derivatives (k, 3, 3) by both poses, calibration."""

    residual: Array
    by_before: Array
    by_after: Array
    by_calibration: Array


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
                change = _solve(self._equations(estimate, limit))
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
            information = _eliminate(self._equations(estimate, limit)).information
            np.linalg.cholesky(information)
        except np.linalg.LinAlgError:
            return None
        return Solution(
            estimate=estimate, information=information, cost=cost, iterations=iteration
        )

    def cost(self, estimate: Estimate, limit: float = math.inf) -> float:
        """Return the sum of squared white residuals, each measurement's capped at ``limit``."""
        steps, rows = self._steps(estimate), self._rows(estimate)
        total = float(np.sum(np.minimum(rows.residual**2, limit**2)))
        total += float(np.sum(steps.residual**2))
        walk = self._walk_residual(estimate)
        total += float(np.sum(walk**2))
        away = self._from_prior(estimate)
        return total + float(away @ self._problem.prior.information @ away)

    def _from_prior(self, estimate: Estimate) -> Array:
        parts = (
            estimate.poses[0],
            estimate.calibration[0],
            estimate.offsets_m,
            estimate.landmarks_m.ravel(),
        )
        away: Array = np.concatenate(parts) - self._problem.prior.mean
        away[2] = wrap_angles(away[2])
        return away

    def _walk_residual(self, estimate: Estimate) -> Array:
        if len(estimate.calibration) == 1:
            return np.zeros((0, 3))
        return np.asarray(np.diff(estimate.calibration, axis=0) * self._walk_roots)

    def _steps(self, estimate: Estimate) -> _Steps:
        problem, poses = self._problem, estimate.poses
        k = len(problem.increments)
        calibration = estimate.calibration[:k] if problem.is_walking else estimate.calibration
        s, w, kappa = calibration[:, 0], calibration[:, 1], calibration[:, 2]
        d = problem.increments[:, :2] / (1.0 + s)[:, None]
        D = np.hypot(d[:, 0], d[:, 1])
        a = (problem.increments[:, 2] - kappa * D) / (1.0 + w)

        c, sn = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
        gone = np.diff(poses[:, :2], axis=0)
        along = c * gone[:, 0] + sn * gone[:, 1]
        across = -sn * gone[:, 0] + c * gone[:, 1]
        residual = np.column_stack(
            [
                along - d[:, 0],
                across - d[:, 1],
                wrap_angles(np.diff(poses[:, 2]) - a),
            ]
        )
        by_before = np.zeros((k, 3, 3))
        by_before[:, 0, 0], by_before[:, 0, 1], by_before[:, 0, 2] = -c, -sn, across
        by_before[:, 1, 0], by_before[:, 1, 1], by_before[:, 1, 2] = sn, -c, -along
        by_before[:, 2, 2] = -1.0
        by_after = np.zeros((k, 3, 3))
        by_after[:, 0, 0], by_after[:, 0, 1] = c, sn
        by_after[:, 1, 0], by_after[:, 1, 1] = -sn, c
        by_after[:, 2, 2] = 1.0
        by_calibration = np.zeros((k, 3, 3))
        by_calibration[:, :2, 0] = d / (1.0 + s)[:, None]
        by_calibration[:, 2, 0] = -kappa * D / ((1.0 + s) * (1.0 + w))
        by_calibration[:, 2, 1] = a / (1.0 + w)
        by_calibration[:, 2, 2] = D / (1.0 + w)
        roots = self._roots
        return _Steps(
            residual=np.einsum("kij,kj->ki", roots, residual),
            by_before=roots @ by_before,
            by_after=roots @ by_after,
            by_calibration=roots @ by_calibration,
        )

    def _rows(self, estimate: Estimate) -> _Rows:
        problem = self._problem
        ranges = _range_rows(problem, estimate)
        if not len(problem.points):
            return ranges
        points = _point_rows(problem, estimate)
        return _Rows(
            poses=np.concatenate([ranges.poses, points.poses]),
            landmarks=np.concatenate([ranges.landmarks, points.landmarks]),
            residual=np.concatenate([ranges.residual, points.residual]),
            by_pose=np.vstack([ranges.by_pose, points.by_pose]),
            by_landmark=np.vstack([ranges.by_landmark, points.by_landmark]),
            radars=np.concatenate([ranges.radars, points.radars]),
            by_offset=np.concatenate([ranges.by_offset, points.by_offset]),
        )

    def _equations(self, estimate: Estimate, limit: float) -> _Equations:
        problem = self._problem
        n_border = _BORDER_HEAD + len(estimate.offsets_m) + 2 * len(estimate.landmarks_m)
        size = 6 if problem.is_walking else 3
        equations = _Equations(len(problem.increments), size, n_border)
        steps = self._steps(estimate)
        if problem.is_walking:
            equations.add_walking_steps(steps, self._walk_roots, self._walk_residual(estimate))
        else:
            equations.add_steps(steps)
        rows = self._rows(estimate)
        weight = np.abs(rows.residual) <= limit
        equations.add_rows(rows, weight, len(estimate.offsets_m))
        away = self._from_prior(estimate)
        equations.add_prior(problem.prior.information, away)
        return equations


class _Equations:
    """Normal equations ``[A, B; B^T, C] x = -[g, h]``: band A, border C."""

    def __init__(self, n_chain: int, size: int, n_border: int) -> None:
        self.size = size
        self.n_chain = n_chain
        self.diagonal = np.zeros((n_chain + 1, size, size))  # the last one goes to the border
        self.lower = np.zeros((n_chain, size, size))  # (k + 1, k)
        self.B = np.zeros((n_chain + 1, size, n_border))
        self.C = np.zeros((n_border, n_border))
        self.g = np.zeros((n_chain + 1, size))
        self.h = np.zeros(n_border)

    def add_steps(self, steps: _Steps) -> None:
        """Add motions whose calibration is one constant, in the border."""
        before, after, by = steps.by_before, steps.by_after, steps.by_calibration
        self._add_pairs(before, after, steps.residual)
        transposed = by.transpose(0, 2, 1)
        self.B[:-1, :, _CALIBRATION] += before.transpose(0, 2, 1) @ by
        self.B[1:, :, _CALIBRATION] += after.transpose(0, 2, 1) @ by
        self.C[_CALIBRATION, _CALIBRATION] += (transposed @ by).sum(axis=0)
        self.h[_CALIBRATION] += np.einsum("kij,kj->i", transposed, steps.residual)

    def add_walking_steps(self, steps: _Steps, walk_roots: Array, walks: Array) -> None:
        """Add motions whose calibration belongs to each pose, and its walk from pose to pose."""
        k = self.n_chain
        before, after = np.zeros((k, 6, 6)), np.zeros((k, 6, 6))
        before[:, :3, :3], before[:, :3, 3:] = steps.by_before, steps.by_calibration
        after[:, :3, :3] = steps.by_after
        for i in range(3):
            before[:, 3 + i, 3 + i] = -walk_roots[:, i]
            after[:, 3 + i, 3 + i] = walk_roots[:, i]
        self._add_pairs(before, after, np.hstack([steps.residual, walks]))

    def _add_pairs(self, before: Array, after: Array, residual: Array) -> None:
        before_t, after_t = before.transpose(0, 2, 1), after.transpose(0, 2, 1)
        self.diagonal[:-1] += before_t @ before
        self.diagonal[1:] += after_t @ after
        self.lower += after_t @ before
        self.g[:-1] += np.einsum("kij,kj->ki", before_t, residual)
        self.g[1:] += np.einsum("kij,kj->ki", after_t, residual)

    def add_rows(self, rows: _Rows, weight: NDArray[np.bool_], n_offsets: int) -> None:
        """Add scalar rows, those of weight zero left out."""
        n_poses, n_border = self.n_chain + 1, len(self.h)
        at = np.flatnonzero(weight)
        pose, residual = rows.poses[at], rows.residual[at]
        by_pose = rows.by_pose[at]
        offset = np.where(rows.radars[at] >= 0, _BORDER_HEAD + rows.radars[at], -1)
        first = _BORDER_HEAD + n_offsets + 2 * rows.landmarks[at]
        columns = np.column_stack([np.maximum(offset, _BORDER_HEAD), first, first + 1])
        columns = np.minimum(columns, n_border - 1)
        by_border = np.column_stack(
            [np.where(offset >= 0, rows.by_offset[at], 0.0), rows.by_landmark[at]]
        )
        for i in range(3):
            for j in range(i + 1):
                block = np.bincount(pose, by_pose[:, i] * by_pose[:, j], n_poses)
                self.diagonal[:, i, j] += block
                if i != j:
                    self.diagonal[:, j, i] += block
            self.g[:, i] += np.bincount(pose, by_pose[:, i] * residual, n_poses)
            flat = (pose * self.size + i)[:, None] * n_border + columns
            np.add.at(self.B.reshape(-1), flat, by_pose[:, i, None] * by_border)
        for j in range(3):
            self.h += np.bincount(columns[:, j], by_border[:, j] * residual, n_border)
            flat = columns[:, j, None] * n_border + columns
            np.add.at(self.C.reshape(-1), flat, by_border[:, j, None] * by_border)

    def add_prior(self, information: Array, away: Array) -> None:
        """Add what is known of the first pose, its calibration, the offsets and landmarks."""
        gradient = information @ away
        pose, rest = slice(0, 3), slice(_BORDER_HEAD, None)
        self.g[0, :3] += gradient[:3]
        self.diagonal[0, :3, :3] += information[pose, pose]
        if self.size == _BORDER_HEAD:
            calibration = slice(3, 6)
            self.g[0, 3:] += gradient[calibration]
            self.diagonal[0, 3:, :] += information[calibration, :6]
            self.diagonal[0, :3, 3:] += information[pose, calibration]
            self.B[0, :, rest] += information[:6, rest]
            self.C[rest, rest] += information[rest, rest]
            self.h[rest] += gradient[rest]
        else:
            border = slice(3, None)
            self.B[0, :, border] += information[pose, border]
            self.C[border, border] += information[border, border]
            self.h[border] += gradient[border]

    def closed(self) -> tuple[Array, Array, Array, Array, Array]:
        """Return band, B, C, g and h with the last pose moved to the border."""
        size, k = self.size, self.n_chain
        last = slice(0, size)
        B = self.B[:-1].copy()
        B[-1, :, last] += self.lower[-1].T
        C, h = self.C.copy(), self.h.copy()
        C[last, last] += self.diagonal[-1]
        C[last, :] += self.B[-1]
        C[:, last] += self.B[-1].T
        h[last] += self.g[-1]
        band = np.zeros((2 * size, k * size))
        for i in range(size):
            for j in range(size):
                if i >= j:
                    band[i - j, j::size] = self.diagonal[:-1, i, j]
                band[size + i - j, j : (k - 1) * size : size] = self.lower[:-1, i, j]
        return band, B.reshape(k * size, -1), C, self.g[:-1].ravel(), h


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Eliminated:
    """What is left on the border, and what gives the poses back."""

    information: Array
    gradient: Array
    factor: Array
    W: Array
    y: Array
    size: int


def _eliminate(equations: _Equations) -> _Eliminated:
    """Eliminate all poses but the last, in time order."""
    band, B, C, g, h = equations.closed()
    factor, info = dpbtrf(band, lower=1)
    if info != 0:
        raise np.linalg.LinAlgError("the chain of poses is not positive definite")
    right = np.asfortranarray(np.column_stack([B, g]))
    solved, info = dtbtrs(factor, right, uplo="L", overwrite_b=1)
    if info != 0:
        raise np.linalg.LinAlgError("the chain of poses is singular")
    W, y = solved[:, :-1], solved[:, -1]
    information = C - W.T @ W
    return _Eliminated(
        information=(information + information.T) / 2,
        gradient=h - W.T @ y,
        factor=factor,
        W=W,
        y=y,
        size=equations.size,
    )


def _solve(equations: _Equations) -> tuple[Array, Array]:
    """Return the change of the chain (k, size) and of the border."""
    left = _eliminate(equations)
    border = -_solve_positive(left.information, left.gradient)
    chain, _ = dtbtrs(left.factor, -(left.y + left.W @ border)[:, None], uplo="L", trans="T")
    if not (np.isfinite(chain).all() and np.isfinite(border).all()):
        raise np.linalg.LinAlgError("the normal equations are singular")
    return chain.reshape(-1, left.size), border


def _solve_positive(matrix: Array, right: Array) -> Array:
    L = np.linalg.cholesky(matrix)
    return np.asarray(np.linalg.solve(L.T, np.linalg.solve(L, right)))


def _moved(estimate: Estimate, change: tuple[Array, Array], share: float) -> Estimate:
    chain, border = change
    poses = estimate.poses.copy()
    poses[:-1] += share * chain[:, :3]
    poses[-1] += share * border[_POSE]
    calibration = estimate.calibration.copy()
    if chain.shape[1] == _BORDER_HEAD:
        calibration[:-1] += share * chain[:, 3:]
        calibration[-1] += share * border[_CALIBRATION]
    else:
        calibration[0] += share * border[_CALIBRATION]
    n_offsets = len(estimate.offsets_m)
    rest = share * border[_BORDER_HEAD:]
    return Estimate(
        poses=poses,
        calibration=calibration,
        offsets_m=estimate.offsets_m + rest[:n_offsets],
        landmarks_m=estimate.landmarks_m + rest[n_offsets:].reshape(-1, 2),
    )


def _range_rows(problem: Problem, estimate: Estimate) -> _Rows:
    pose = estimate.poses[problem.range_poses]
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    mx, my = problem.range_antennas[:, 0], problem.range_antennas[:, 1]
    arm = np.column_stack([c * mx - s * my, s * mx + c * my])
    away = estimate.landmarks_m[problem.range_landmarks] - pose[:, :2] - arm
    distance = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-9)
    u = away / distance[:, None] / problem.range_sigma_m
    by_pose = np.column_stack([-u, u[:, 0] * arm[:, 1] - u[:, 1] * arm[:, 0]])
    predicted = distance + estimate.offsets_m[problem.range_radars]
    return _Rows(
        poses=problem.range_poses,
        landmarks=problem.range_landmarks,
        residual=(predicted - problem.ranges_m) / problem.range_sigma_m,
        by_pose=by_pose,
        by_landmark=u,
        radars=problem.range_radars,
        by_offset=np.full(len(distance), 1.0 / problem.range_sigma_m),
    )


def _point_rows(problem: Problem, estimate: Estimate) -> _Rows:
    pose = estimate.poses[problem.point_poses]
    away = estimate.landmarks_m[problem.point_landmarks] - pose[:, :2]
    q = np.maximum(np.sum(away**2, axis=1), 1e-18)
    distance = np.sqrt(q)
    residual = np.column_stack([distance, np.arctan2(away[:, 1], away[:, 0]) - pose[:, 2]])
    residual -= problem.points
    residual[:, 1] = wrap_angles(residual[:, 1])
    by_landmark = np.empty((len(q), 2, 2))
    by_landmark[:, 0] = away / distance[:, None]
    by_landmark[:, 1, 0], by_landmark[:, 1, 1] = -away[:, 1] / q, away[:, 0] / q
    by_pose = np.zeros((len(q), 2, 3))
    by_pose[:, :, :2] = -by_landmark
    by_pose[:, 1, 2] = -1.0
    roots = problem.point_roots
    return _Rows(
        poses=np.repeat(problem.point_poses, 2),
        landmarks=np.repeat(problem.point_landmarks, 2),
        residual=np.einsum("kij,kj->ki", roots, residual).ravel(),
        by_pose=(roots @ by_pose).reshape(-1, 3),
        by_landmark=(roots @ by_landmark).reshape(-1, 2),
        radars=np.full(2 * len(q), -1, dtype=np.intp),
        by_offset=np.zeros(2 * len(q)),
    )


def _inverse_roots(covariances: Array) -> Array:
    """Return matrices W with W C W^T = I, shape (k, 3, 3)."""
    if not len(covariances):
        return np.zeros((0, 3, 3))
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariances)))


def start_prior(
    calibration_sigmas: tuple[float, float, float],
    offset_sigmas_m: tuple[float, ...],
    n_landmarks: int,
    pose_sigma: float = 1e-6,
) -> Prior:
    """Return the prior of a run that starts at the origin of its own map."""
    calibration = np.maximum(calibration_sigmas, _LEAST_CALIBRATION)
    offsets = np.maximum(offset_sigmas_m, _LEAST_OFFSET_M)
    sigmas = np.concatenate([np.full(3, pose_sigma), calibration, offsets])
    size = len(sigmas) + 2 * n_landmarks
    information = np.zeros((size, size))
    np.fill_diagonal(information[: len(sigmas), : len(sigmas)], sigmas**-2.0)
    return Prior(information=information, mean=np.zeros(size))

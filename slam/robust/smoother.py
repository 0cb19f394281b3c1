"""Solution over all poses, when the filter has come far from where it linearised.

Unknown are the poses, the calibration errors of the wheels (constant, or one set per pose that
walks), the range offsets and the landmarks. The normal equations are a band along time with a
border: the last pose, its calibration, the offsets and the landmarks. A band Cholesky in time
order eliminates all earlier poses in O(poses); the Schur complement left on the border is the
information of the belief that replaces the filter's, so no measurement counts twice. Errors are
additive here. Step lengths are halved until the cost falls. Source: square root smoothing, Dellaert
and Kaess, IJRR 25(12), 2006, with time order instead of a search for one.

The measurements of poses that are kept no longer become a prior, a quadratic about where they were
linearised. In additive errors it would fix the direction of the map a little more at every such
point, although no range can see it, and the estimate would become too sure. In right-invariant
errors

    e_th = theta - theta0,   e_p = Rot(-e_th) p - p0,   e_l = Rot(-e_th) l - l0
    e_phi = phi - e_th - phi0,   e_d = d - d0 (a wall's)

it does not: turning and shifting robot and map together changes no range, and exactly so. Hence
first estimates (FEJ: Huang, Mourikis, Roumeliotis, IJRR 29(5), 2010) need not be kept for the
measurements that stay. Calibration and offsets have additive errors.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbtrf, dtbtrs

from slam.geometry import wrap_angle, wrap_angles
from slam.robust.parameters import BackEndParameters, RelinearisationRule
from slam.robust.run_log import Estimate, Prior, Problem, RunLog, start_prior
from slam.robust.state import (
    HEADING,
    Array,
    Indices,
    State,
    SymmetricMatrix,
    quarter_turn,
    rotation,
)

X, POSE_HEADING = slice(0, 2), 2
# Columns of the border
POSE, CALIBRATION = slice(0, 3), slice(3, 6)
BORDER_HEAD = 6
_LEAST_WALK_SHARE = 1e-5
_UNKNOWN = 100.0
# The decrease of the cost that ends a search, what rounding may add to it, and how often a step is
# halved
_TOLERANCE, _ROUNDING, _HALVINGS = 1e-2, 1e-12, 8
# What keeps a direction finite where a landmark stands at an antenna, or at the robot, and a root
# where nothing walks
_LEAST_RANGE_M, _LEAST_RANGE_M2, _LEAST_RADIUS_WAY_M, _TINY = 1e-9, 1e-18, 1e-6, 1e-300


def first_values(estimate: Estimate) -> Array:
    """Return the values a prior is about: first pose, its calibration, offsets, landmarks."""
    return np.concatenate(
        [
            estimate.poses[0],
            estimate.calibration[0],
            estimate.offsets_m,
            estimate.landmarks_m.ravel(),
        ]
    )


def prior_cost(prior: Prior, values: Array, n_offsets: int) -> float:
    e, _ = _errors(prior, values, n_offsets)
    return float(e @ (prior.information @ e + 2.0 * prior.gradient))


def prior_terms(prior: Prior, values: Array, n_offsets: int) -> tuple[Array, Array]:
    """Return half the derivatives of a prior's cost by additive errors: (m, m) and (m,)."""
    e, turned = _errors(prior, values, n_offsets)
    pulled = prior.information @ e
    back = rotation(-wrap_angle(float(values[POSE_HEADING] - prior.mean[POSE_HEADING])))
    points = _points(len(values), n_offsets, prior.n_walls)
    by_heading = -_swept(turned, points)
    half = _right(prior.information, back, by_heading, points)
    information = _right(half.T, back, by_heading, points)
    gradient = _right((pulled + prior.gradient)[None, :], back, by_heading, points)[0]
    return (information + information.T) / 2, gradient


def prior_about(
    information: Array, gradient: Array, values: Array, n_offsets: int, n_walls: int = 0
) -> Prior:
    """Return the prior with this information and gradient of additive errors at values."""
    points = _points(len(values), n_offsets, n_walls)
    by_heading = _swept(values, points)
    stay = np.eye(2)
    half = _right(information, stay, by_heading, points)
    whole = _right(half.T, stay, by_heading, points)
    return Prior(
        information=(whole + whole.T) / 2,
        gradient=_right(gradient[None, :], stay, by_heading, points)[0],
        mean=values.copy(),
        n_walls=n_walls,
    )


def _errors(prior: Prior, values: Array, n_offsets: int) -> tuple[Array, Array]:
    """Return the errors e, and the values with all points turned back by e_th."""
    angle = wrap_angle(float(values[POSE_HEADING] - prior.mean[POSE_HEADING]))
    turned, points = values.copy(), _points(len(values), n_offsets, prior.n_walls)
    back = rotation(-angle)
    turned[X] = back @ values[X]
    turned[points] = (values[points].reshape(-1, 2) @ back.T).ravel()
    turned[points.stop :: 2] -= angle
    e = turned - prior.mean
    e[POSE_HEADING] = angle
    return e, turned


def _points(size: int, n_offsets: int, n_walls: int) -> slice:
    return slice(6 + n_offsets, size - 2 * n_walls)


def _swept(values: Array, points: slice) -> Array:
    """Return how points and walls of some values move per radian about the origin, shape (m,)."""
    swept = np.zeros(len(values))
    swept[X] = quarter_turn(values[X])
    swept[points] = quarter_turn(values[points].reshape(-1, 2)).ravel()
    swept[points.stop :: 2] = 1.0
    return swept


def _right(rows: Array, turn: Array, by_heading: Array, points: slice) -> Array:
    """Return rows times the matrix [points: turn, heading column: by_heading + 1, rest: I]."""
    result = rows.copy()
    result[:, POSE_HEADING] += rows @ by_heading
    result[:, X] = rows[:, X] @ turn
    turned = rows[:, points].reshape(len(rows), -1, 2) @ turn
    result[:, points] = turned.reshape(len(rows), -1)
    return result


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """White scalar rows of measurements: residual and derivatives; shapes (m,) unless said."""

    poses: Indices
    landmarks: Indices
    residual: Array
    by_pose: Array  # (m, 3)
    by_landmark: Array  # (m, 2)
    radars: Indices  # -1: none
    by_offset: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Steps:
    """White residuals (k, 3) of all motions, derivatives (k, 3, 3) by both poses, calibration."""

    residual: Array
    by_before: Array
    by_after: Array
    by_calibration: Array


def motion_residuals(problem: Problem, estimate: Estimate, roots: Array) -> Steps:
    """Return the residuals of all motions, whitened by ``roots`` (k, 3, 3)."""
    poses = estimate.poses
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
    turned = wrap_angles(np.diff(poses[:, 2]) - a)
    residual = np.column_stack([along - d[:, 0], across - d[:, 1], turned])
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
    return Steps(
        residual=np.einsum("kij,kj->ki", roots, residual),
        by_before=roots @ by_before,
        by_after=roots @ by_after,
        by_calibration=roots @ by_calibration,
    )


def measurement_residuals(problem: Problem, estimate: Estimate) -> Rows:
    """Return the white residuals of all ranges, then of all points."""
    ranges = _range_rows(problem, estimate)
    if not len(problem.points):
        return ranges
    points = _point_rows(problem, estimate)
    names = [column.name for column in fields(Rows)]
    return Rows(
        **{name: np.concatenate([getattr(ranges, name), getattr(points, name)]) for name in names}
    )


def _range_rows(problem: Problem, estimate: Estimate) -> Rows:
    pose = estimate.poses[problem.range_poses]
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    mx, my = problem.range_antennas[:, 0], problem.range_antennas[:, 1]
    arm = np.column_stack([c * mx - s * my, s * mx + c * my])
    places = pose[:, :2] + arm
    landmarks = estimate.landmarks_m[problem.range_landmarks]
    away = landmarks - places
    distance = np.maximum(np.hypot(away[:, 0], away[:, 1]), _LEAST_RANGE_M)
    sigmas = problem.range_sigmas_m
    u = away / (distance * sigmas)[:, None]
    by_landmark = u
    n_points = len(estimate.landmarks_m) - problem.n_walls
    walls = np.flatnonzero(problem.range_landmarks >= n_points)
    if len(walls):
        # z = d - n . q: the place matters along the normal only.
        c, s = np.cos(landmarks[walls, 0]), np.sin(landmarks[walls, 0])
        qx, qy = places[walls].T
        distance[walls] = landmarks[walls, 1] - c * qx - s * qy
        u[walls] = np.column_stack([c, s]) / sigmas[walls, None]
        by_landmark = u.copy()
        by_wall = np.column_stack([s * qx - c * qy, np.ones(len(walls))])
        by_landmark[walls] = by_wall / sigmas[walls, None]
    by_pose = np.column_stack([-u, u[:, 0] * arm[:, 1] - u[:, 1] * arm[:, 0]])
    predicted = distance + estimate.offsets_m[problem.range_radars]
    return Rows(
        poses=problem.range_poses,
        landmarks=problem.range_landmarks,
        residual=(predicted - problem.ranges_m) / sigmas,
        by_pose=by_pose,
        by_landmark=by_landmark,
        radars=problem.range_radars,
        by_offset=1.0 / sigmas,
    )


def _point_rows(problem: Problem, estimate: Estimate) -> Rows:
    pose = estimate.poses[problem.point_poses]
    away = estimate.landmarks_m[problem.point_landmarks] - pose[:, :2]
    q = np.maximum(np.sum(away**2, axis=1), _LEAST_RANGE_M2)
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
    return Rows(
        poses=np.repeat(problem.point_poses, 2),
        landmarks=np.repeat(problem.point_landmarks, 2),
        residual=np.einsum("kij,kj->ki", roots, residual).ravel(),
        by_pose=(roots @ by_pose).reshape(-1, 3),
        by_landmark=(roots @ by_landmark).reshape(-1, 2),
        radars=np.full(2 * len(q), -1, dtype=np.intp),
        by_offset=np.zeros(2 * len(q)),
    )


class NormalEquations:
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

    def add_steps(self, steps: Steps) -> None:
        """Add motions with one constant calibration, in the border."""
        before, after, by = steps.by_before, steps.by_after, steps.by_calibration
        self._add_pairs(before, after, steps.residual)
        transposed = by.transpose(0, 2, 1)
        self.B[:-1, :, CALIBRATION] += before.transpose(0, 2, 1) @ by
        self.B[1:, :, CALIBRATION] += after.transpose(0, 2, 1) @ by
        self.C[CALIBRATION, CALIBRATION] += (transposed @ by).sum(axis=0)
        self.h[CALIBRATION] += np.einsum("kij,kj->i", transposed, steps.residual)

    def add_walking_steps(self, steps: Steps, walk_roots: Array, walks: Array) -> None:
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

    def add_rows(self, rows: Rows, weight: NDArray[np.bool_], n_offsets: int) -> None:
        """Add scalar rows, those of weight zero left out."""
        n_poses, n_border = self.n_chain + 1, len(self.h)
        at = np.flatnonzero(weight)
        pose, residual = rows.poses[at], rows.residual[at]
        by_pose = rows.by_pose[at]
        offset = np.where(rows.radars[at] >= 0, BORDER_HEAD + rows.radars[at], -1)
        first = BORDER_HEAD + n_offsets + 2 * rows.landmarks[at]
        columns = np.column_stack([np.maximum(offset, BORDER_HEAD), first, first + 1])
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

    def add_prior(self, information: Array, gradient: Array) -> None:
        pose, rest = slice(0, 3), slice(BORDER_HEAD, None)
        self.g[0, :3] += gradient[:3]
        self.diagonal[0, :3, :3] += information[pose, pose]
        if self.size == BORDER_HEAD:
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
class Eliminated:
    """The border after elimination, and what gives the poses back."""

    information: Array
    gradient: Array
    factor: Array
    W: Array
    y: Array
    size: int


def eliminate(equations: NormalEquations) -> Eliminated:
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
    return Eliminated(
        information=(information + information.T) / 2,
        gradient=h - W.T @ y,
        factor=factor,
        W=W,
        y=y,
        size=equations.size,
    )


def solve(equations: NormalEquations) -> tuple[Array, Array]:
    """Return the change of the chain (k, size) and of the border."""
    left = eliminate(equations)
    L = np.linalg.cholesky(left.information)
    border = -np.asarray(np.linalg.solve(L.T, np.linalg.solve(L, left.gradient)))
    chain, _ = dtbtrs(left.factor, -(left.y + left.W @ border)[:, None], uplo="L", trans="T")
    if not (np.isfinite(chain).all() and np.isfinite(border).all()):
        raise np.linalg.LinAlgError("the normal equations are singular")
    return chain.reshape(-1, left.size), border


def covariances(left: Eliminated) -> tuple[Array, Array]:
    """Return the marginal covariances of the eliminated poses, (k, 3, 3), and of the border.

    With the blocks F of the factor, pose k is -F_kk^-T F_k+1,k^T x_k+1 and noise of covariance
    F_kk^-T F_kk^-1 while the border is known; what the border adds is A^-1 B S^-1 B^T A^-1.
    """
    root = np.linalg.inv(np.linalg.cholesky(left.information))
    by_border, _ = dtbtrs(left.factor, left.W @ root.T, uplo="L", trans="T")
    size = left.size
    by_border = by_border.reshape(-1, size, by_border.shape[1])[:, :3]
    chain = by_border @ by_border.transpose(0, 2, 1)
    diagonal, lower = (np.zeros((len(chain), size, size)) for _ in range(2))
    for i in range(size):
        for j in range(size):
            if i >= j:
                diagonal[:, i, j] = left.factor[i - j, j::size]
            lower[:-1, i, j] = left.factor[size + i - j, j : -size or None : size]
    inverses = np.linalg.inv(diagonal)
    own = inverses.transpose(0, 2, 1) @ inverses
    back = (lower @ inverses).transpose(0, 2, 1)
    later = np.zeros((size, size))
    for k in range(len(chain) - 1, -1, -1):
        later = own[k] + back[k] @ later @ back[k].T
        chain[k] += later[:3, :3]
    return (chain + chain.transpose(0, 2, 1)) / 2, root.T @ root


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solution:
    """The least-squares estimate and its information."""

    estimate: Estimate
    # shape (6 + r + 2 n,) squared: the Schur complement on last pose, its calibration, offsets and
    # landmarks, additive errors
    information: Array
    cost: float  # sum of squared white residuals, counted from where the prior was taken


class Smoother:
    """Solves one problem by Gauss-Newton."""

    def __init__(self, problem: Problem, rule: RelinearisationRule) -> None:
        self._problem, self._rule = problem, rule
        # W with W C W^T = I, shape (k, 3, 3)
        self._roots = np.asarray(np.linalg.inv(np.linalg.cholesky(problem.covariances)))
        least = _LEAST_WALK_SHARE * np.sqrt(problem.walks.max(axis=0, initial=0.0))
        self._walk_roots = 1.0 / np.sqrt(problem.walks + least**2 + _TINY)

    def solve(self, start: Estimate, tolerance: float = _TOLERANCE) -> Solution | None:
        """Return the solution reached from a start, or None if it failed.

        The search ends when the cost decreases by less than ``tolerance``.
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
            for _ in range(_HALVINGS):
                better = _moved(estimate, change, share)
                new_cost = self.cost(better, limit)
                if new_cost <= cost + _ROUNDING:
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
        steps = motion_residuals(self._problem, estimate, self._roots)
        rows = measurement_residuals(self._problem, estimate)
        total = float(np.sum(np.minimum(rows.residual**2, limit**2)))
        total += float(np.sum(steps.residual**2))
        total += float(np.sum(self._walk_residual(estimate) ** 2))
        n_offsets = len(estimate.offsets_m)
        return total + prior_cost(self._problem.prior, first_values(estimate), n_offsets)

    def covariances(self, estimate: Estimate) -> tuple[Array, Array]:
        """Return the covariances of all poses (k + 1, 3, 3) and of the border at a solution.

        Errors are additive; residuals beyond the limit of outliers are left out.

        Raises
        ------
        numpy.linalg.LinAlgError
            Something is not determined.
        """
        left = eliminate(self._equations(estimate, self._rule.outlier_sigmas))
        chain, border = covariances(left)
        return np.concatenate([chain, border[None, POSE, POSE]]), border

    def condensed(self, estimate: Estimate, n_steps: int, limit: float) -> Prior:
        """Return all measurements before pose ``n_steps`` as a prior on what is left.

        Residuals beyond ``limit`` are left out. With the prior in place of the first ``n_steps``
        steps and of the measurements from their poses, the normal equations at this estimate have
        the same Schur complement: nothing is lost there, and nothing counts twice.
        """
        part = Smoother(self._problem.beginning(n_steps), self._rule)
        beginning = replace(
            estimate,
            poses=estimate.poses[: n_steps + 1],
            calibration=estimate.calibration[: n_steps + 1],
        )
        left = eliminate(part._equations(beginning, limit))
        newest = replace(
            beginning, poses=beginning.poses[-1:], calibration=beginning.calibration[-1:]
        )
        n_offsets, n_walls = len(estimate.offsets_m), self._problem.n_walls
        return prior_about(
            left.information, left.gradient, first_values(newest), n_offsets, n_walls
        )

    def _walk_residual(self, estimate: Estimate) -> Array:
        if len(estimate.calibration) == 1:
            return np.zeros((0, 3))
        return np.asarray(np.diff(estimate.calibration, axis=0) * self._walk_roots)

    def _equations(self, estimate: Estimate, limit: float) -> NormalEquations:
        problem, n_offsets = self._problem, len(estimate.offsets_m)
        n_border = BORDER_HEAD + n_offsets + 2 * len(estimate.landmarks_m)
        size = 6 if problem.is_walking else 3
        equations = NormalEquations(len(problem.increments), size, n_border)
        steps = motion_residuals(self._problem, estimate, self._roots)
        if problem.is_walking:
            equations.add_walking_steps(steps, self._walk_roots, self._walk_residual(estimate))
        else:
            equations.add_steps(steps)
        rows = measurement_residuals(self._problem, estimate)
        weight = np.abs(rows.residual) <= limit
        equations.add_rows(rows, weight, n_offsets)
        equations.add_prior(*prior_terms(problem.prior, first_values(estimate), n_offsets))
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


def is_due(log: RunLog, state: State, parameters: BackEndParameters) -> bool:
    """Return whether the pose is too far from the stored trajectory, or too many poses are kept."""
    rule = parameters.relinearisation
    if log.since_solved < rule.every:
        return False
    if log.n_kept > rule.most_poses:
        return True
    if not state.feature_ids:
        return False
    shift_m, turn_rad = log.parted(state.pose)
    return turn_rad > rule.turn_rad or shift_m > rule.shift_m


def relinearise(log: RunLog, state: State, parameters: BackEndParameters) -> bool:
    """Solve for all poses and replace the belief by the result; return whether it worked."""
    rule = parameters.relinearisation
    log.since_solved = 0
    smoother, start = _all_poses(log, state, parameters)
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
    margin: float,
) -> bool:
    """Give the landmark in a row a radius if a solution with it is likelier; return whether it is.

    The cost of the solution over all poses must fall by ``margin``. Then that solution replaces the
    belief.
    """
    row, radius_m = candidate
    smoother, start = _all_poses(log, state, parameters)
    solution = smoother.solve(start)
    if solution is None:
        return False
    least = solution.cost - margin
    id_, point_m = state.landmark_ids[row], state.landmarks_m[row].copy()
    before_m = state.radii_m.pop(id_, 0.0)
    away = point_m - state.position_m
    state.landmarks_m[row] += (
        (radius_m - before_m) * away / max(float(np.hypot(*away)), _LEAST_RADIUS_WAY_M)
    )
    if radius_m:
        state.radii_m[id_] = radius_m
    smoother, start = _all_poses(log, state, parameters)
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


def solve_whole_run(
    log: RunLog, state: State, parameters: BackEndParameters
) -> tuple[Estimate, Array, Array] | None:
    """Return the solution over all poses since the start, or None if there is none.

    With it the covariances of the poses (k + 1, 3, 3) and of the features (n, 2, 2), errors
    additive. Nothing is changed.
    """
    prior = _start_prior(state, parameters)
    # A landmark whose ranges are all left out as outliers stays where it is, and is unknown.
    where = np.arange(len(prior.mean) - 2 * len(state.feature_ids), len(prior.mean))
    prior.information[where, where] = _UNKNOWN**-2.0
    prior.mean[where] = state.features.ravel()
    prior = replace(prior, n_walls=len(state.wall_ids))
    problem = log.problem(state, prior, whole=True)
    smoother = Smoother(problem, parameters.relinearisation)
    found = [smoother.solve(start) for start in log.starts(state, problem)]
    solutions = [solution for solution in found if solution is not None]
    if not solutions:
        return None
    best = min(solutions, key=lambda solution: solution.cost).estimate
    try:
        of_poses, border = smoother.covariances(best)
    except np.linalg.LinAlgError:
        return None
    first, n = BORDER_HEAD + len(best.offsets_m), len(best.landmarks_m)
    blocks = border[first:, first:].reshape(n, 2, n, 2)
    each = np.arange(n)
    return best, of_poses, blocks[each, :, each, :]


def is_determined(information: Array) -> bool:
    """Return whether all unknowns of a solution are known to better than 100 m, rad or 1.

    A landmark all of whose ranges were left out as too far off has no information but rounding;
    its covariance would be of 1e14 m^2, and have negative eigenvalues.
    """
    variances = np.linalg.inv(information).diagonal()
    return bool(np.all((variances > 0.0) & (variances < _UNKNOWN**2)))


def _all_poses(
    log: RunLog, state: State, parameters: BackEndParameters
) -> tuple[Smoother, Estimate]:
    """Return the problem of all poses and the better of the values to start from."""
    problem = log.problem(state, _start_prior(state, parameters))
    smoother = Smoother(problem, parameters.relinearisation)
    return smoother, min(log.starts(state, problem), key=smoother.cost)


def _start_prior(state: State, parameters: BackEndParameters) -> Prior:
    return start_prior(
        parameters.wheels.calibration_sigmas,
        (parameters.ranges.offset_sigma_m,) * len(state.offsets_m),
        len(state.feature_ids),
    )


def _replace(state: State, solution: Solution) -> None:
    estimate = solution.estimate
    pose = estimate.poses[-1]
    state.position_m = pose[:2].copy()
    state.heading_rad = math.remainder(float(pose[2]), math.tau)
    state.calibration = estimate.calibration[-1].copy()
    state.offsets_m = estimate.offsets_m.copy()
    n = len(state.landmark_ids)
    state.landmarks_m = estimate.landmarks_m[:n].copy()
    state.walls = estimate.landmarks_m[n:].copy()
    # The smoother orders (x, y, heading, ...), the filter (heading, x, y, ...)
    additive = np.linalg.inv(solution.information)
    order = np.concatenate([[2, 0, 1], np.arange(3, len(additive))])
    additive = additive[np.ix_(order, order)]
    # e_p = e_add,p - J p e_th, landmarks likewise
    T = state.additive_transform()
    T[1:, HEADING] *= -1.0
    P = T @ additive @ T.T
    state.P = SymmetricMatrix(np.asarray((P + P.T) / 2))

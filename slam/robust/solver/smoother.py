"""Solution over the whole run, when the filter has come far from where it linearised.

Unknown are the keyframes' poses, the calibration errors of the wheels (constant, or one set per
keyframe that walks), and what does not move: range offsets, mounts, landmarks. The normal equations
are a band along time with a border: the last pose, its calibration, and what does not move. A band
Cholesky in time order eliminates all earlier poses in O(poses); the Schur complement left on the
border is the information of the belief that replaces the filter's, so no measurement counts twice.
Errors are additive here. Step lengths are halved until the cost falls. Source: square root
smoothing, Dellaert and Kaess, IJRR 25(12), 2006, with time order instead of a search for one.

Every solution weighs ranges anew: by Huber's weights, and by zero beyond a limit. Where the wheels
may have slipped, the run has the noise of that (`slam.robust.proposals.slips`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from scipy.linalg import cho_solve
from scipy.linalg.lapack import dpbtrf, dtbtrs

from slam.geometry import wrap_angles
from slam.robust import kernels
from slam.robust.parameters import BackEndParameters
from slam.robust.solver.radii import RadiusPrior
from slam.robust.solver.run_log import (
    Estimate,
    Problem,
    chain_of,
    motion_covariances,
    motions_by_calibration,
)
from slam.robust.state import HEAD_SIZE, Array, Indices, quarter_turn

# Columns of the border
POSE, CALIBRATION = slice(0, 3), slice(3, HEAD_SIZE)
_LEAST_WALK_SHARE = 1e-5
# The decrease of the cost that ends a search, what rounding may add to it, and how often a step is
# halved
_TOLERANCE, _ROUNDING, _HALVINGS = 1e-2, 1e-12, 8
_GROUPS = 8  # of columns of the border whose rows begin together
_SETTLED_SHARE = 0.01  # decrease of the cost, as a share, from which on outliers are left out
# What keeps a direction finite where a landmark stands at an antenna, or at the robot, and a root
# where nothing walks
_LEAST_RANGE_M, _LEAST_RANGE_M2, _TINY = 1e-9, 1e-18, 1e-300


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """White scalar rows of measurements: residual (m,) and derivatives."""

    poses: Indices
    residual: Array
    by_pose: Array  # (m, 3)
    # (m, c): columns of the border, and derivatives by them; those of no use are zero
    columns: Indices
    by_border: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Steps:
    """Residuals (k, 3) of all motions, derivatives (k, 3, 3) by both poses and calibration."""

    residual: Array
    by_before: Array
    by_after: Array
    by_calibration: Array

    def whitened(self, roots: Array) -> Steps:
        return Steps(
            residual=np.einsum("kij,kj->ki", roots, self.residual),
            by_before=roots @ self.by_before,
            by_after=roots @ self.by_after,
            by_calibration=roots @ self.by_calibration,
        )


def motion_residuals(problem: Problem, estimate: Estimate) -> Steps:
    poses, calibration = estimate.poses, estimate.calibration[: len(problem.keys) - 1]
    k = len(poses) - 1
    chain = chain_of(problem.steps, problem.keys, calibration)
    c, sn = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    gone = np.diff(poses[:, :2], axis=0)
    along = c * gone[:, 0] + sn * gone[:, 1]
    across = -sn * gone[:, 0] + c * gone[:, 1]
    residual = np.column_stack([along, across, np.diff(poses[:, 2])]) - chain.ends
    residual[:, 2] = wrap_angles(residual[:, 2])
    by_before = np.zeros((k, 3, 3))
    by_before[:, 0, 0], by_before[:, 0, 1], by_before[:, 0, 2] = -c, -sn, across
    by_before[:, 1, 0], by_before[:, 1, 1], by_before[:, 1, 2] = sn, -c, -along
    by_before[:, 2, 2] = -1.0
    by_after = np.zeros((k, 3, 3))
    by_after[:, 0, 0], by_after[:, 0, 1] = c, sn
    by_after[:, 1, 0], by_after[:, 1, 1] = -sn, c
    by_after[:, 2, 2] = 1.0
    return Steps(
        residual=residual,
        by_before=by_before,
        by_after=by_after,
        by_calibration=-motions_by_calibration(chain, calibration),
    )


def measurement_residuals(problem: Problem, estimate: Estimate) -> Rows:
    """Return the white residuals of all ranges, then of those bearings that there are."""
    ranges = _range_rows(problem, estimate)
    at = problem.with_bearing
    if not len(at):
        return ranges
    bearings = _bearing_rows(problem, estimate, at)
    names = [column.name for column in fields(Rows)]
    return Rows(
        **{name: np.concatenate([getattr(ranges, name), getattr(bearings, name)]) for name in names}
    )


def _range_rows(problem: Problem, estimate: Estimate) -> Rows:
    layout, at = problem.layout, problem.range_landmarks
    values = np.concatenate([np.zeros(HEAD_SIZE), estimate.fixed])
    radars, first = problem.range_radars, layout.first_columns(at)
    pose = estimate.poses[problem.range_poses]
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    mx, my = problem.range_antennas.T
    of_offset = layout.offsets.start + radars
    columns = [of_offset, first, first + 1]
    if layout.has_mounts:
        # A mount that is elsewhere shifts the antenna as the robot stood when it sampled.
        of_mount = layout.mounts.start + 2 * radars
        cm, sm = np.cos(problem.range_turns), np.sin(problem.range_turns)
        ex, ey = values[of_mount], values[of_mount + 1]
        mx, my = mx + cm * ex - sm * ey, my + sm * ex + cm * ey
    arm = np.column_stack([c * mx - s * my, s * mx + c * my])
    places = pose[:, :2] + arm
    x, y = values[first], values[first + 1]
    away = np.column_stack([x, y]) - places
    distance = np.maximum(np.hypot(away[:, 0], away[:, 1]), _LEAST_RANGE_M)
    sigmas = problem.range_sigmas_m
    u = away / (distance * sigmas)[:, None]
    by_landmark = u
    is_wall = at >= layout.n_landmarks
    walls = np.flatnonzero(is_wall)
    if len(walls):
        # z = d - n . q: the place matters along the normal only.
        cw, sw = np.cos(x[walls]), np.sin(x[walls])
        qx, qy = places[walls].T
        distance[walls] = y[walls] - cw * qx - sw * qy
        u[walls] = np.column_stack([cw, sw]) / sigmas[walls, None]
        by_landmark = u.copy()
        by_wall = np.column_stack([sw * qx - cw * qy, np.ones(len(walls))])
        by_landmark[walls] = by_wall / sigmas[walls, None]
    by_pose = np.column_stack([-u, u[:, 0] * arm[:, 1] - u[:, 1] * arm[:, 0]])
    predicted = distance + values[of_offset]
    by_border = [1.0 / sigmas, *by_landmark.T]
    if layout.has_mounts:
        ct, st = c * cm - s * sm, s * cm + c * sm
        by_mount = [-(u[:, 0] * ct + u[:, 1] * st), u[:, 0] * st - u[:, 1] * ct]
        columns, by_border = [*columns, of_mount, of_mount + 1], [*by_border, *by_mount]
    if layout.has_radii:
        of_radius = np.where(is_wall, of_offset, first + 2)
        predicted -= np.where(is_wall, 0.0, values[of_radius])
        columns.append(of_radius)
        by_border.append(np.where(is_wall, 0.0, -1.0 / sigmas))
    return Rows(
        poses=problem.range_poses,
        residual=(predicted - problem.ranges_m) / sigmas,
        by_pose=by_pose,
        columns=np.column_stack(columns),
        by_border=np.column_stack(by_border),
    )


def _bearing_rows(problem: Problem, estimate: Estimate, at: Indices) -> Rows:
    """Return the rows of the bearings of some ranges; columns in the order of `_range_rows`."""
    layout, radars = problem.layout, problem.range_radars[at]
    values = np.concatenate([np.zeros(HEAD_SIZE), estimate.fixed])
    first = layout.first_columns(problem.range_landmarks[at])
    pose, turns = estimate.poses[problem.range_poses[at]], problem.range_turns[at]
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    cm, sm = np.cos(turns), np.sin(turns)
    mx, my = problem.range_antennas[at].T
    if layout.has_mounts:
        of_mount = layout.mounts.start + 2 * radars
        ex, ey = values[of_mount], values[of_mount + 1]
        mx, my = mx + cm * ex - sm * ey, my + sm * ex + cm * ey
    arm = np.column_stack([c * mx - s * my, s * mx + c * my])
    away = np.column_stack([values[first], values[first + 1]]) - pose[:, :2] - arm
    square = np.maximum(np.sum(away**2, axis=1), _LEAST_RANGE_M2)
    sigmas = problem.range_bearing_sigmas_rad[at]
    is_wall = problem.range_landmarks[at] >= layout.n_landmarks
    angle = np.where(is_wall, values[first], np.arctan2(away[:, 1], away[:, 0]))
    residual = wrap_angles(angle - pose[:, 2] - turns - problem.range_bearings_rad[at])
    g = quarter_turn(away) / (square * sigmas)[:, None]
    g[is_wall] = 0.0
    by_heading = g[:, 0] * arm[:, 1] - g[:, 1] * arm[:, 0] - 1.0 / sigmas
    of_offset, none = layout.offsets.start + radars, np.zeros(len(at))
    columns = [of_offset, first, first + 1]
    by_border = [none, np.where(is_wall, 1.0 / sigmas, g[:, 0]), g[:, 1]]
    if layout.has_mounts:
        ct, st = c * cm - s * sm, s * cm + c * sm
        by_mount = [-(g[:, 0] * ct + g[:, 1] * st), g[:, 0] * st - g[:, 1] * ct]
        columns, by_border = [*columns, of_mount, of_mount + 1], [*by_border, *by_mount]
    if layout.has_radii:
        columns = [*columns, np.where(is_wall, of_offset, first + 2)]
        by_border = [*by_border, none]
    return Rows(
        poses=problem.range_poses[at],
        residual=residual / sigmas,
        by_pose=np.column_stack([-g, by_heading]),
        columns=np.column_stack(columns),
        by_border=np.column_stack(by_border),
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

    def add_rows(self, rows: Rows, weights: Array) -> None:
        """Add scalar rows, each with the root of its weight."""
        n_poses, n_border = self.n_chain + 1, len(self.h)
        at = np.flatnonzero(weights)
        root = weights[at]
        pose, residual, columns = rows.poses[at], root * rows.residual[at], rows.columns[at]
        by_pose, by_border = root[:, None] * rows.by_pose[at], root[:, None] * rows.by_border[at]
        for i in range(3):
            for j in range(i + 1):
                block = np.bincount(pose, by_pose[:, i] * by_pose[:, j], n_poses)
                self.diagonal[:, i, j] += block
                if i != j:
                    self.diagonal[:, j, i] += block
            self.g[:, i] += np.bincount(pose, by_pose[:, i] * residual, n_poses)
        # Sorted by column, most entries of B hit are neighbours; many ranges share one.
        flat = pose[:, None] * n_border + columns
        for i in range(3):
            values = by_pose[:, i, None] * by_border
            summed = np.bincount(flat.ravel(), values.ravel(), n_poses * n_border)
            self.B[:, i] += summed.reshape(n_poses, n_border)
        for j in range(columns.shape[1]):
            self.h += np.bincount(columns[:, j], by_border[:, j] * residual, n_border)
            flat = columns[:, j, None] * n_border + columns
            values = by_border[:, j, None] * by_border
            summed = np.bincount(flat.ravel(), values.ravel(), n_border * n_border)
            self.C += summed.reshape(n_border, n_border)

    def add_prior(self, away: Array, sigmas: Array) -> None:
        """Add the prior of first pose and what is fixed, given how far they are from its mean."""
        information = sigmas**-2.0
        gradient = information * away
        first = np.arange(self.size)
        self.diagonal[0, first, first] += information[: self.size]
        self.g[0] += gradient[: self.size]
        rest = np.arange(self.size, len(self.h))
        self.C[rest, rest] += information[self.size :]
        self.h[rest] += gradient[self.size :]

    def add_known(self, at: Indices, away: Array, information: Array) -> None:
        """Add what a map says of the columns ``at``, given how far they are from its values."""
        self.C[np.ix_(at, at)] += information
        self.h[at] += information @ away[at]

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
    W = kernels.substitute(factor.T, B)
    y = kernels.substitute(factor.T, g[:, None])[:, 0]
    # A column is zero until the first pose that it has an entry of, and landmarks are in the order
    # in which they were first seen: the rows of early poses have entries in the first columns only.
    first = np.minimum.accumulate(np.argmax(B != 0.0, axis=0)[::-1])[::-1]
    information = C.copy()
    for columns in np.array_split(np.arange(len(first)), _GROUPS):
        if len(columns):
            end = int(columns[-1]) + 1
            rows = W[first[columns[0]] : (first[end] if end < len(first) else len(W)), :end]
            information[:end, :end] -= rows.T @ rows
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
    border = -np.asarray(cho_solve((L, True), left.gradient, check_finite=False))
    chain, _ = dtbtrs(left.factor, -(left.y + left.W @ border)[:, None], uplo="L", trans="T")
    if not (np.isfinite(chain).all() and np.isfinite(border).all()):
        raise np.linalg.LinAlgError("the normal equations are singular")
    return chain.reshape(-1, left.size), border


def covariances(left: Eliminated) -> tuple[Array, Array]:
    """Return the marginal covariances of the eliminated poses, (k, 3, 3), and of the border.

    Given the border they are a chain, see `_chain_given_border`; what the border adds is
    A^-1 B S^-1 B^T A^-1.
    """
    root = np.linalg.inv(np.linalg.cholesky(left.information))
    by_border, _ = dtbtrs(left.factor, left.W @ root.T, uplo="L", trans="T")
    size = left.size
    by_border = by_border.reshape(-1, size, by_border.shape[1])[:, :3]
    chain = by_border @ by_border.transpose(0, 2, 1)
    own, back = _chain_given_border(left)
    later = np.zeros((size, size))
    for k in range(len(chain) - 1, -1, -1):
        later = own[k] + back[k] @ later @ back[k].T
        chain[k] += later[:3, :3]
    return (chain + chain.transpose(0, 2, 1)) / 2, root.T @ root


def joint_covariance(left: Eliminated, at: Indices) -> Array:
    """Return the covariance of the border and, behind it, of some eliminated poses.

    ``at`` (k,) are their indices, increasing; the shape is (b + 3 k, b + 3 k).
    """
    size, n, k = left.size, len(left.information), len(at)
    joint = np.zeros((n + 3 * k, n + 3 * k))
    border = joint[:n, :n] = np.linalg.inv(left.information)
    if not k:
        return joint
    first = int(at[0])
    since = slice(first * size, None)  # what comes before it does not matter to later ones
    by_border, _ = dtbtrs(left.factor[:, since], left.W[since], uplo="L", trans="T")
    by_border = by_border.reshape(-1, size, n)[at - first, :3].reshape(-1, n)
    joint[n:, :n] = -by_border @ border
    joint[:n, n:] = joint[n:, :n].T
    joint[n:, n:] = by_border @ border @ by_border.T
    own, back = _chain_given_border(left)
    row_of = {int(pose): n + 3 * row for row, pose in enumerate(at)}
    own_now, with_later = np.zeros((size, size)), np.zeros((size, 3 * k))
    for pose in range(len(own) - 1, first - 1, -1):
        own_now = own[pose] + back[pose] @ own_now @ back[pose].T
        with_later = back[pose] @ with_later
        if pose in row_of:
            row = row_of[pose]
            with_later[:, row - n : row - n + 3] = own_now[:, :3]
            joint[row : row + 3, row:] += with_later[:3, row - n :]
            joint[row + 3 :, row : row + 3] = joint[row : row + 3, row + 3 :].T
    return joint


def _chain_given_border(left: Eliminated) -> tuple[Array, Array]:
    """Return the chain of eliminated poses given the border: x_k = G_k x_k+1 + noise.

    With the blocks F of the factor, the covariance of the noise is F_kk^-T F_kk^-1, and
    G_k = -F_kk^-T F_k+1,k^T; shape (k, size, size) each.
    """
    size, k = left.size, left.factor.shape[1] // left.size
    diagonal, lower = (np.zeros((k, size, size)) for _ in range(2))
    for i in range(size):
        for j in range(size):
            if i >= j:
                diagonal[:, i, j] = left.factor[i - j, j::size]
            lower[:-1, i, j] = left.factor[size + i - j, j : -size or None : size]
    inverses = np.linalg.inv(diagonal)
    own = inverses.transpose(0, 2, 1) @ inverses
    return own, -(lower @ inverses).transpose(0, 2, 1)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Solution:
    """The least-squares estimate and its information."""

    estimate: Estimate
    eliminated: Eliminated
    cost: float

    @property
    def information(self) -> Array:
        """Return that of last pose, its calibration, and what is fixed, (6 + q,) squared.

        It is the Schur complement; errors are additive.
        """
        return self.eliminated.information


class Smoother:
    """Solves one problem by Gauss-Newton."""

    def __init__(self, problem: Problem, parameters: BackEndParameters) -> None:
        self._problem, self._rule = problem, parameters.relinearisation
        first, layout = problem.keys[:-1], problem.layout
        radii = layout.radii if layout.has_radii else slice(0, 0)
        # Those of a map have its prior.
        self._radii = np.setdiff1d(np.arange(layout.size)[radii], problem.known_at)
        # Radii and deviations as wavefronts show them
        self._shown, self._shown_sigmas = np.zeros(layout.size), np.full(layout.size, math.inf)
        if len(problem.radii_m):
            self._shown[radii] = problem.radii_m
            self._shown_sigmas[radii] = problem.radius_sigmas_m
        self._of_radii = RadiusPrior(
            self._shown[self._radii], self._shown_sigmas[self._radii], parameters.radii
        )
        self._rounds = parameters.radii.rounds
        chain = chain_of(problem.steps, problem.keys, np.zeros((1, 3)))
        covariances = motion_covariances(chain, problem.step_covariances)
        # W with W C W^T = I, shape (k, 3, 3)
        self._roots = np.asarray(np.linalg.inv(np.linalg.cholesky(covariances)))
        walks = np.add.reduceat(problem.walks, first)
        least = _LEAST_WALK_SHARE * np.sqrt(walks.max(axis=0, initial=0.0))
        self._walk_roots = 1.0 / np.sqrt(walks + least**2 + _TINY)

    def solve(
        self, start: Estimate, tolerance: float = _TOLERANCE, limit: float = math.inf
    ) -> Solution | None:
        """Return the solution reached from a start, or None if it failed.

        The search ends when the cost decreases by less than ``tolerance``. Residuals beyond
        ``limit`` are left out from the first step on.
        """
        estimate, rule = start, self._rule
        cost, decrease = self.cost(estimate, limit), math.inf
        for iteration in range(rule.iterations):
            # Far from the solution, what is right may look like an outlier; but the last half of
            # the steps is without outliers.
            is_settled = decrease <= _SETTLED_SHARE * cost or 2 * iteration >= rule.iterations - 1
            if is_settled and limit != rule.outlier_sigmas:
                limit = rule.outlier_sigmas
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
            if decrease < tolerance and limit == rule.outlier_sigmas:
                break
        try:
            left = eliminate(self._equations(estimate, limit))
            np.linalg.cholesky(left.information)
        except np.linalg.LinAlgError:
            return None
        return Solution(estimate=estimate, eliminated=left, cost=cost)

    def believe(self, solution: Solution) -> Solution:
        """Return a solution with the uncertainty of radii (`slam.robust.solver.radii`).

        What was found is returned if that fails.
        """
        if not len(self._radii):
            return solution
        self._of_radii.begin_belief()
        for left in range(self._rounds, -1, -1):
            found = self.solve(solution.estimate, limit=self._rule.outlier_sigmas)
            if found is None:
                break
            solution = found
            if left:
                radii_m = solution.estimate.fixed[self._radii - HEAD_SIZE]
                variances = np.asarray(np.linalg.inv(solution.information).diagonal()[self._radii])
                self._of_radii.improve(radii_m, variances)
        return solution

    def cost(self, estimate: Estimate, limit: float = math.inf) -> float:
        """Return what is to be least: Huber's costs of all measurements, capped at ``limit``.

        To these come the costs of all motions.
        """
        problem = self._problem
        away = np.minimum(np.abs(measurement_residuals(problem, estimate).residual), limit)
        costs = away**2 - np.maximum(away - problem.huber_sigmas, 0.0) ** 2
        total = float(costs @ self._shares(len(costs)))
        motions = motion_residuals(problem, estimate).residual
        total += float(np.sum(np.einsum("kij,kj->ki", self._roots, motions) ** 2))
        total += float(np.sum(self._walk_residual(estimate) ** 2))
        away, sigmas = self._from_prior(estimate)
        costs = (away / sigmas) ** 2
        costs[self._radii] = 0.0
        total += float(np.sum(costs))
        total += self._of_radii.cost(estimate.fixed[self._radii - HEAD_SIZE])
        total += float(np.sum((self._from_shown(estimate) / self._shown_sigmas) ** 2))
        away = away[problem.known_at]
        return total + float(away @ problem.known_information @ away)

    def constants(self, estimate: Estimate) -> tuple[Array, Array]:
        """Return how far the constants are from their priors' means, (k,), and the priors' sigmas.

        They are the wheels' first calibration and the range offsets.
        """
        away, sigmas = self._from_prior(estimate)
        constants = slice(CALIBRATION.start, HEAD_SIZE + self._problem.layout.n_radars)
        return away[constants], sigmas[constants]

    def covariances(self, estimate: Estimate) -> tuple[Array, Array]:
        """Return the covariances of all keyframes (k + 1, 3, 3) and of the border at a solution.

        Errors are additive; residuals beyond the limit of outliers are left out.

        Raises
        ------
        numpy.linalg.LinAlgError
            Something is not determined.
        """
        left = eliminate(self._equations(estimate, self._rule.outlier_sigmas))
        chain, border = covariances(left)
        return np.concatenate([chain, border[None, POSE, POSE]]), border

    def _walk_residual(self, estimate: Estimate) -> Array:
        if len(estimate.calibration) == 1:
            return np.zeros((0, 3))
        return np.asarray(np.diff(estimate.calibration, axis=0) * self._walk_roots)

    def _from_prior(self, estimate: Estimate) -> tuple[Array, Array]:
        """Return how far values are from the prior's mean, and the standard deviations of that."""
        problem = self._problem
        first = np.concatenate([estimate.poses[0], estimate.calibration[0], estimate.fixed])
        away, sigmas = first - problem.prior_mean, problem.prior_sigmas.copy()
        away[self._radii], sigmas[self._radii] = self._of_radii.away(first[self._radii])
        return away, sigmas

    def _from_shown(self, estimate: Estimate) -> Array:
        """Return how far radii are from those that wavefronts show, and zeros for all else."""
        first = np.concatenate([estimate.poses[0], estimate.calibration[0], estimate.fixed])
        return np.where(np.isfinite(self._shown_sigmas), first - self._shown, 0.0)

    def weights(self, residual: Array, limit: float) -> Array:
        """Return roots of the weights of white residuals, shape (m,)."""
        away = np.abs(residual)
        weights = np.minimum(self._problem.huber_sigmas / np.maximum(away, _TINY), 1.0)
        roots = np.sqrt(weights * self._shares(len(away)))
        return np.asarray(np.where(away <= limit, roots, 0.0))

    def _shares(self, n_rows: int) -> Array:
        """Return what one measurement counts for, shape (m,): of correlated ranges, less."""
        shares = np.ones(n_rows)
        shares[: len(self._problem.ranges_m)] /= self._problem.variance_share
        return shares

    def _equations(self, estimate: Estimate, limit: float) -> NormalEquations:
        problem = self._problem
        n_border = HEAD_SIZE + len(estimate.fixed)
        size = 6 if problem.is_walking else 3
        equations = NormalEquations(len(estimate.poses) - 1, size, n_border)
        steps = motion_residuals(problem, estimate).whitened(self._roots)
        if problem.is_walking:
            equations.add_walking_steps(steps, self._walk_roots, self._walk_residual(estimate))
        else:
            equations.add_steps(steps)
        rows = measurement_residuals(problem, estimate)
        equations.add_rows(rows, self.weights(rows.residual, limit))
        away, sigmas = self._from_prior(estimate)
        equations.add_prior(away, sigmas)
        equations.add_prior(self._from_shown(estimate), self._shown_sigmas)
        if len(problem.known_at):
            equations.add_known(problem.known_at, away, problem.known_information)
        return equations


def _moved(estimate: Estimate, change: tuple[Array, Array], share: float) -> Estimate:
    chain, border = change
    poses = estimate.poses.copy()
    poses[:-1] += share * chain[:, :3]
    poses[-1] += share * border[POSE]
    calibration = estimate.calibration.copy()
    if chain.shape[1] == HEAD_SIZE:
        calibration[:-1] += share * chain[:, 3:]
        calibration[-1] += share * border[CALIBRATION]
    else:
        calibration[0] += share * border[CALIBRATION]
    return Estimate(
        poses=poses,
        calibration=calibration,
        fixed=estimate.fixed + share * border[HEAD_SIZE:],
    )

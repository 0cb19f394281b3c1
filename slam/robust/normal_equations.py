"""Normal equations of a run: a band along time with a border, poses eliminated in time order.

The border holds the last pose, its calibration, the range offsets and the landmarks. A band
Cholesky eliminates all earlier poses in O(poses); what is left on the border, the Schur
complement, is the information of the belief about now.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbtrf, dtbtrs

from slam.robust.residuals import Rows, Steps
from slam.robust.symmetric import Array

POSE, CALIBRATION = slice(0, 3), slice(3, 6)
BORDER_HEAD = 6


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
        """Add motions whose calibration is one constant, in the border."""
        before, after, by = steps.by_before, steps.by_after, steps.by_calibration
        self._add_pairs(before, after, steps.residual)
        transposed = by.transpose(0, 2, 1)
        self.B[:-1, :, CALIBRATION] += before.transpose(0, 2, 1) @ by
        self.B[1:, :, CALIBRATION] += after.transpose(0, 2, 1) @ by
        self.C[CALIBRATION, CALIBRATION] += (transposed @ by).sum(axis=0)
        self.h[CALIBRATION] += np.einsum("kij,kj->i", transposed, steps.residual)

    def add_walking_steps(self, steps: Steps, walk_roots: Array, walks: Array) -> None:
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
        """Add what is known of the first pose, its calibration, the offsets and landmarks."""
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
    """What is left on the border, and what gives the poses back."""

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
    border = -_solve_positive(left.information, left.gradient)
    chain, _ = dtbtrs(left.factor, -(left.y + left.W @ border)[:, None], uplo="L", trans="T")
    if not (np.isfinite(chain).all() and np.isfinite(border).all()):
        raise np.linalg.LinAlgError("the normal equations are singular")
    return chain.reshape(-1, left.size), border


def _solve_positive(matrix: Array, right: Array) -> Array:
    L = np.linalg.cholesky(matrix)
    return np.asarray(np.linalg.solve(L.T, np.linalg.solve(L, right)))

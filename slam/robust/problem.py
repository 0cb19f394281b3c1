"""The least-squares problem over a whole run: what was measured, and values of the unknowns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.robust.symmetric import Array, Indices

# Standard deviations below these are taken as these, so that information stays finite.
_LEAST_CALIBRATION = 1e-7
_LEAST_OFFSET_M = 1e-7


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
        shapes (r,) and (n, 2); the last of the landmarks may be walls, (phi, d).
    """

    poses: Array
    calibration: Array
    offsets_m: Array
    landmarks_m: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Prior:
    """What is known beforehand of the first pose, its calibration, the offsets and landmarks.

    A quadratic ``e^T information e + 2 gradient^T e`` in right-invariant errors e from ``mean``
    (module ``prior``), all of size 6 + r + 2 n in that order; the last ``n_walls`` of the n
    landmarks are walls.
    """

    information: Array
    gradient: Array
    mean: Array
    n_walls: int = 0


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
    range_sigmas_m
        shape (m,), noise of the ranges.
    point_poses, point_landmarks, points, point_roots
        shapes (q,), (q,), (q, 2), (q, 2, 2): range and bearing seen from the body's origin,
        and a matrix that makes their noise white.
    n_walls
        How many of the landmarks, the last ones, are walls.
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
    range_sigmas_m: Array
    point_poses: Indices
    point_landmarks: Indices
    points: Array
    point_roots: Array
    n_walls: int = 0

    @property
    def is_walking(self) -> bool:
        """Tell whether the calibration has one value per pose."""
        return bool(np.any(self.walks > 0.0))

    def beginning(self, n_steps: int) -> Problem:
        """Return what was measured before pose ``n_steps``, and the steps up to it."""
        ranges = self.range_poses < n_steps
        points = self.point_poses < n_steps
        return Problem(
            increments=self.increments[:n_steps],
            covariances=self.covariances[:n_steps],
            walks=self.walks[:n_steps],
            prior=self.prior,
            range_poses=self.range_poses[ranges],
            range_radars=self.range_radars[ranges],
            range_landmarks=self.range_landmarks[ranges],
            range_antennas=self.range_antennas[ranges],
            ranges_m=self.ranges_m[ranges],
            range_sigmas_m=self.range_sigmas_m[ranges],
            point_poses=self.point_poses[points],
            point_landmarks=self.point_landmarks[points],
            points=self.points[points],
            point_roots=self.point_roots[points],
            n_walls=self.n_walls,
        )


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
    return Prior(information=information, gradient=np.zeros(size), mean=np.zeros(size))

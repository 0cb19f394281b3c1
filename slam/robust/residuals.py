"""White residuals of a run and their derivatives, all poses at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.geometry import wrap_angles
from slam.robust.problem import Estimate, Problem
from slam.robust.symmetric import Array, Indices


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """White scalar rows of measurements: residual and derivatives."""

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
    """Return the white residuals of all motions; ``roots`` (k, 3, 3) makes their noise white."""
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
    return Rows(
        poses=np.concatenate([ranges.poses, points.poses]),
        landmarks=np.concatenate([ranges.landmarks, points.landmarks]),
        residual=np.concatenate([ranges.residual, points.residual]),
        by_pose=np.vstack([ranges.by_pose, points.by_pose]),
        by_landmark=np.vstack([ranges.by_landmark, points.by_landmark]),
        radars=np.concatenate([ranges.radars, points.radars]),
        by_offset=np.concatenate([ranges.by_offset, points.by_offset]),
    )


def _range_rows(problem: Problem, estimate: Estimate) -> Rows:
    pose = estimate.poses[problem.range_poses]
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    mx, my = problem.range_antennas[:, 0], problem.range_antennas[:, 1]
    arm = np.column_stack([c * mx - s * my, s * mx + c * my])
    places = pose[:, :2] + arm
    landmarks = estimate.landmarks_m[problem.range_landmarks]
    away = landmarks - places
    distance = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-9)
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
    return Rows(
        poses=np.repeat(problem.point_poses, 2),
        landmarks=np.repeat(problem.point_landmarks, 2),
        residual=np.einsum("kij,kj->ki", roots, residual).ravel(),
        by_pose=(roots @ by_pose).reshape(-1, 3),
        by_landmark=(roots @ by_landmark).reshape(-1, 2),
        radars=np.full(2 * len(q), -1, dtype=np.intp),
        by_offset=np.zeros(2 * len(q)),
    )

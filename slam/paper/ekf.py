"""Extended Kalman filter over one pose and the landmarks: pure functions from belief to belief.

Letters as in the paper: mean x, covariance P, motion Jacobian G, motion noise R, observation
Jacobian H, observation noise Q, innovation covariance S. The state is ``[x, y, heading, l0x, l0y,
l1x, l1y, ...]`` in the map frame. A landmark's *row* is its place in that order; its *id* never
changes.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slam.config import MotionConfig, MotionNoise
from slam.geometry import compose, wrap_angle, wrap_angles
from slam.results import LANDMARK_SIZE, POSE_SIZE, Belief, landmark_slice

Array = NDArray[np.float64]


def start() -> Belief:
    """Return the belief before any motion: at the origin of the map, certain, no landmarks."""
    return Belief(mean=np.zeros(POSE_SIZE), covariance=np.zeros((POSE_SIZE, POSE_SIZE)))


def motion_noise(increment: Array, heading_rad: float, config: MotionConfig) -> Array:
    """Return the covariance R that one motion adds to the pose, shape (3, 3), map axes.

    ``per_step_world`` is the paper's diagonal, the same for every step. ``proportional`` grows with
    the distance D and the turn a of the step, along and across the robot's axis::

        diag(along^2 D, across^2 D), turned into the map;  (h sqrt(D) + h_turn |a|)^2

    ``increment`` (3,) is the motion in the body frame before it, ``heading_rad`` that before it.
    """
    if config.noise is MotionNoise.PER_STEP_WORLD:
        return np.diag([config.sigma_xy_m**2, config.sigma_xy_m**2, config.sigma_heading_rad**2])
    distance_m = math.hypot(increment[0], increment[1])
    along, across, heading = config.wheels.step_variances(distance_m, increment[2])
    cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
    R = np.zeros((POSE_SIZE, POSE_SIZE))
    R[0, 0] = cosine**2 * along + sine**2 * across
    R[1, 1] = sine**2 * along + cosine**2 * across
    R[0, 1] = R[1, 0] = cosine * sine * (along - across)
    R[2, 2] = heading
    return R


def motion_jacobian(heading_rad: float, increment: Array) -> Array:
    """Return G = d(pose after) / d(pose before), shape (3, 3), of moving by a body increment."""
    cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
    G = np.eye(POSE_SIZE)
    G[0, 2] = -sine * increment[0] - cosine * increment[1]
    G[1, 2] = cosine * increment[0] - sine * increment[1]
    return G


def predict(belief: Belief, increment: Array, R: Array) -> Belief:
    """Move the pose by an odometry increment.

    ``x_r' = x_r (+) u``, ``P_rr' = G P_rr G^T + R``, ``P_rl' = G P_rl``. u has shape (3,), the
    motion in the body frame before it, [m, m, rad]; R (3, 3) is its noise in map axes.
    """
    pose = slice(0, POSE_SIZE)
    G = motion_jacobian(float(belief.mean[2]), increment)
    mean, P = belief.mean.copy(), belief.covariance.copy()
    mean[pose] = compose(belief.pose, increment)
    moved = G @ P[pose, :]
    P[pose, :] = moved
    P[:, pose] = moved.T
    corner = moved[:, pose] @ G.T
    P[pose, pose] = (corner + corner.T) / 2 + R
    return Belief(mean=mean, covariance=P, landmark_ids=belief.landmark_ids, next_id=belief.next_id)


def expected_observations(pose: Array, landmarks: Array) -> Array:
    """Return range [m] and bearing [rad] of landmarks from a pose.

    ``landmarks`` has shape (n, 2), the result too; bearings in [-pi, pi).
    """
    dx, dy = landmarks[:, 0] - pose[0], landmarks[:, 1] - pose[1]
    return np.column_stack([np.hypot(dx, dy), wrap_angles(np.arctan2(dy, dx) - pose[2])])


def observation_jacobians(pose: Array, landmarks: Array) -> tuple[Array, Array]:
    """Return d(range, bearing) / d(pose), (n, 2, 3), and / d(landmark), (n, 2, 2), off the pose.

    With (dx, dy) from pose to landmark and q = dx^2 + dy^2::

        H_pose     = [[-dx/sqrt(q), -dy/sqrt(q),  0], [ dy/q, -dx/q, -1]]
        H_landmark = [[ dx/sqrt(q),  dy/sqrt(q)   ], [-dy/q,  dx/q    ]]
    """
    dx, dy = landmarks[:, 0] - pose[0], landmarks[:, 1] - pose[1]
    q = dx**2 + dy**2
    root = np.sqrt(q)
    H_landmark = np.empty((len(landmarks), 2, 2))
    H_landmark[:, 0, 0] = dx / root
    H_landmark[:, 0, 1] = dy / root
    H_landmark[:, 1, 0] = -dy / q
    H_landmark[:, 1, 1] = dx / q
    H_pose = np.zeros((len(landmarks), 2, 3))
    H_pose[:, :, :2] = -H_landmark
    H_pose[:, 1, 2] = -1.0
    return H_pose, H_landmark


def innovation(observed: Array, expected: Array) -> Array:
    """Return observed minus expected (range, bearing), shape (..., 2), the angle in [-pi, pi)."""
    difference: Array = observed - expected
    difference[..., 1] = wrap_angles(difference[..., 1])
    return difference


def update(belief: Belief, row: int, observed: Array, Q: Array) -> Belief:
    """Correct the belief with one range [m] and bearing [rad] of the landmark in a row, noise Q.

    With the innovation nu, S = H P H^T + Q = L L^T and W = L^-1 H P::

        x' = x + W^T L^-1 nu          P' = P - W^T W

    Equal to the Joseph form ``(I - K H) P (I - K H)^T + K Q K^T`` with K = P H^T S^-1.
    """
    landmark = belief.landmarks[row : row + 1]
    expected = expected_observations(belief.pose, landmark)[0]
    H_pose, H_landmark = observation_jacobians(belief.pose, landmark)
    H = np.hstack([H_pose[0], H_landmark[0]])
    block = landmark_slice(row)
    P = belief.covariance
    # H is zero elsewhere: only five rows of P take part.
    HP = H @ np.concatenate([P[:POSE_SIZE], P[block]])
    S = HP[:, :POSE_SIZE] @ H_pose[0].T + HP[:, block] @ H_landmark[0].T + Q
    L = np.linalg.cholesky((S + S.T) / 2)
    W = whiten(L, HP)
    mean = belief.mean + W.T @ whiten(L, innovation(observed, expected))
    mean[2] = wrap_angle(mean[2])
    return Belief(
        mean=mean,
        covariance=P - W.T @ W,
        landmark_ids=belief.landmark_ids,
        next_id=belief.next_id,
    )


def whiten(L: NDArray[np.floating], rows: Array) -> Array:
    """Return L^-1 rows for a lower triangular L of shape (2, 2) and two rows of any length.

    A library call would cost more than it computes, and wake BLAS threads.
    """
    first = rows[0] / L[0, 0]
    return np.array([first, (rows[1] - L[1, 0] * first) / L[1, 1]], dtype=np.float64)


def augment(belief: Belief, observed: Array, Q: Array) -> Belief:
    """Add a landmark where one range [m] and bearing [rad] put it, correlated with everything else.

    ``l = p + r [cos(heading + phi), sin(heading + phi)]`` with Jacobians G_pose (2, 3) and G_obs
    (2, 2)::

        P_ll = G_pose P_rr G_pose^T + G_obs Q G_obs^T          P_lx = G_pose P_rx
    """
    r, direction = float(observed[0]), float(observed[1] + belief.mean[2])
    cosine, sine = math.cos(direction), math.sin(direction)
    G_pose = np.array([[1.0, 0.0, -r * sine], [0.0, 1.0, r * cosine]])
    G_obs = np.array([[cosine, -r * sine], [sine, r * cosine]])
    size = len(belief.mean)
    mean = np.append(belief.mean, [belief.mean[0] + r * cosine, belief.mean[1] + r * sine])
    P = np.empty((size + LANDMARK_SIZE, size + LANDMARK_SIZE))
    P[:size, :size] = belief.covariance
    cross = G_pose @ belief.covariance[:POSE_SIZE]
    P[size:, :size] = cross
    P[:size, size:] = cross.T
    corner = cross[:, :POSE_SIZE] @ G_pose.T + G_obs @ Q @ G_obs.T
    P[size:, size:] = (corner + corner.T) / 2
    return Belief(
        mean=mean,
        covariance=P,
        landmark_ids=(*belief.landmark_ids, belief.next_id),
        next_id=belief.next_id + 1,
    )

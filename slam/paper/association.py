"""Unknown correspondences: which landmark an observation is of, or whether it is a new one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from slam.config import Assignment, AssociationConfig
from slam.paper.ekf import augment, expected_observations, innovation, observation_jacobians, update
from slam.results import LANDMARK_SIZE, POSE_SIZE, Association, Belief

Array = NDArray[np.float64]


def mahalanobis_sq(belief: Belief, observed: Array, Q: Array) -> Array:
    """Return nu^T S^-1 nu of one observation against every landmark, shape (n,).

    S = H P H^T + Q per landmark, nu the innovation with its angle wrapped; inf where a landmark
    coincides with the pose, because a bearing to it does not exist. ``observed`` is (range [m],
    bearing [rad]), Q its noise, shape (2, 2).
    """
    n = len(belief.landmark_ids)
    distances = np.full(n, np.inf)
    usable = np.flatnonzero(np.any(belief.landmarks != belief.pose[:2], axis=1))
    if usable.size == 0:
        return distances
    landmarks = belief.landmarks[usable]
    H_pose, H_landmark = observation_jacobians(belief.pose, landmarks)
    P = belief.covariance
    P_rr = P[:POSE_SIZE, :POSE_SIZE]
    # (3, n, 2) -> (n, 3, 2): covariance of the pose with each landmark.
    P_rl = P[:POSE_SIZE, POSE_SIZE:].reshape(POSE_SIZE, n, LANDMARK_SIZE)
    P_rl = P_rl.transpose(1, 0, 2)[usable]
    blocks = P[POSE_SIZE:, POSE_SIZE:].reshape(n, LANDMARK_SIZE, n, LANDMARK_SIZE)
    P_ll = blocks[usable, :, usable, :]
    cross = H_pose @ P_rl @ H_landmark.transpose(0, 2, 1)
    S = H_pose @ P_rr @ H_pose.transpose(0, 2, 1) + cross + cross.transpose(0, 2, 1) + Q
    S += H_landmark @ P_ll @ H_landmark.transpose(0, 2, 1)
    nu = innovation(observed, expected_observations(belief.pose, landmarks))
    distances[usable] = np.einsum("ni,ni->n", nu, np.linalg.solve(S, nu[:, :, None])[:, :, 0])
    return distances


def nearest(distances: Array, gate_threshold: float) -> int | None:
    """Return the row of the least distance if it lies below the gate, else None."""
    if distances.size == 0:
        return None
    row = int(np.argmin(distances))
    return row if distances[row] < gate_threshold else None


def one_to_one(distances: Array, gate_threshold: float) -> list[int | None]:
    """Return for each observation its landmark's row, or None, no landmark twice.

    Among all such assignments the one of least total squared distance is chosen, where leaving an
    observation unmatched costs the gate. ``distances`` has shape (n_observations, n_landmarks).
    """
    n_observations, n_landmarks = distances.shape
    cost = np.full((n_observations, n_landmarks + n_observations), gate_threshold)
    # A match beyond the gate must never look better than no match at all.
    cost[:, :n_landmarks] = np.where(distances < gate_threshold, distances, 2 * gate_threshold)
    _, columns = linear_sum_assignment(cost)
    return [int(column) if column < n_landmarks else None for column in columns]


def update_map(
    belief: Belief,
    observations: Sequence[Array],
    Q: Array,
    config: AssociationConfig,
) -> tuple[Belief, tuple[Association, ...]]:
    """Update known landmarks and add new ones from the observations of one pose.

    As printed, one observation (range [m], bearing [rad], noise Q) after the other goes to the
    landmark nearest to it in Mahalanobis distance, or becomes a landmark if none lies within the
    gate. With ``one_to_one`` all are assigned jointly against the belief before any of them.
    """
    planned: list[int | None] | None = None
    if config.assignment is Assignment.ONE_TO_ONE and observations:
        table = np.array([mahalanobis_sq(belief, observed, Q) for observed in observations])
        planned = one_to_one(table, config.gate_threshold)
    associations = []
    for index, observed in enumerate(observations):
        distances = mahalanobis_sq(belief, observed, Q)
        candidate_ids = belief.landmark_ids
        row = nearest(distances, config.gate_threshold) if planned is None else planned[index]
        belief = augment(belief, observed, Q) if row is None else update(belief, row, observed, Q)
        associations.append(
            Association(
                landmark_id=belief.landmark_ids[-1 if row is None else row],
                is_new=row is None,
                mahalanobis_sq=distances,
                candidate_ids=candidate_ids,
            )
        )
    return belief, tuple(associations)

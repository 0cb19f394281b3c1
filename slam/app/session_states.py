"""A state of SLAM as one row of doubles, so that a session holds it to the last bit.

The row::

    n_landmarks, n_nis,
    truth (3), odometry (3), estimate (3), world_from_map (3),
    pose_covariance (9, row by row),
    n_landmarks times: id, x, y, cov_xx, cov_xy, cov_yx, cov_yy,
    n_nis times: NIS per degree of freedom

in the units and frames of `Snapshot`; an unknown truth is NaN.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.app.session import Snapshot

_COUNTS = 2
_PER_LANDMARK = 7


def state_row(snapshot: Snapshot) -> NDArray[np.float64]:
    """Return the row of a state, shape (23 + 7 n_landmarks + n_nis,), float64."""
    n_landmarks, n_nis = len(snapshot.landmark_ids), len(snapshot.nis_per_dof)
    landmarks = np.column_stack(
        [
            snapshot.landmark_ids,
            snapshot.landmarks_m.reshape(-1, 2),
            snapshot.landmark_covariances_m2.reshape(-1, 4),
        ]
    )
    parts = (
        [n_landmarks, n_nis],
        snapshot.truth,
        snapshot.odometry,
        snapshot.estimate,
        snapshot.world_from_map,
        snapshot.pose_covariance.ravel(),
        landmarks.ravel(),
        snapshot.nis_per_dof,
    )
    return np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])


def snapshot_of(counter: int, t_ns: int, row: NDArray[np.float64]) -> Snapshot:
    """Return the state that a row holds.

    Raises
    ------
    ValueError
        The row's length is not what its first two numbers say.
    """
    n_landmarks, n_nis = (int(value) for value in row[:_COUNTS])
    ends = np.cumsum([_COUNTS, 3, 3, 3, 3, 9, _PER_LANDMARK * n_landmarks, n_nis])
    if min(n_landmarks, n_nis) < 0 or ends[-1] != len(row):
        raise ValueError(f"a state of {len(row)} numbers says it has {ends[-1]}")
    _, truth, odometry, estimate, world_from_map, covariance, landmarks, nis, _ = np.split(
        row, ends
    )
    table = landmarks.reshape(-1, _PER_LANDMARK)
    return Snapshot(
        counter=counter,
        t_ns=t_ns,
        truth=truth,
        odometry=odometry,
        estimate=estimate,
        world_from_map=world_from_map,
        pose_covariance=covariance.reshape(3, 3),
        landmark_ids=table[:, 0].astype(np.int64),
        landmarks_m=table[:, 1:3],
        landmark_covariances_m2=table[:, 3:].reshape(-1, 2, 2),
        nis_per_dof=tuple(nis.tolist()),
    )

"""Edits of the map that no sensor asks for: forget a landmark, unite two that are one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.ekf_slam import LANDMARK_SIZE, Belief, landmark_slice, whiten
from slam.geometry import wrap_angle

Array = NDArray[np.float64]

# Two copies of one landmark are declared equal to this; exactly zero would make P singular.
MERGE_SIGMA_M = 1e-5


def remove(belief: Belief, row: int) -> Belief:
    """Return the belief without one landmark: marginalised, the rest unchanged bit for bit."""
    kept = np.delete(np.arange(len(belief.mean)), landmark_slice(row))
    return Belief(
        mean=belief.mean[kept],
        covariance=belief.covariance[np.ix_(kept, kept)],
        landmark_ids=(*belief.landmark_ids[:row], *belief.landmark_ids[row + 1 :]),
        next_id=belief.next_id,
    )


def merge(belief: Belief, keep: int, drop: int) -> Belief:
    """Return the belief given that two landmarks are one, under the id of ``keep``.

    The difference of the two is observed to be zero: H = [.. I .. -I ..], noise (10 um)^2, and
    the second is then removed.

    Parameters
    ----------
    belief
        Belief before.
    keep, drop
        Rows of the two landmarks, different.
    """
    if keep == drop:
        raise ValueError(f"landmark row {keep} cannot be merged with itself")
    a, b = landmark_slice(keep), landmark_slice(drop)
    HP = belief.covariance[a] - belief.covariance[b]
    S: Array = HP[:, a] - HP[:, b] + MERGE_SIGMA_M**2 * np.eye(LANDMARK_SIZE)
    L = np.linalg.cholesky((S + S.T) / 2)
    W = whiten(L, HP)
    mean = belief.mean + W.T @ whiten(L, belief.mean[b] - belief.mean[a])
    mean[2] = wrap_angle(mean[2])
    united = Belief(
        mean=mean,
        covariance=belief.covariance - W.T @ W,
        landmark_ids=belief.landmark_ids,
        next_id=belief.next_id,
    )
    return remove(united, drop)

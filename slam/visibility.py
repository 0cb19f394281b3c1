"""Which landmarks a run could have found: those some pair of radars had in joint view."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.config import SlamConfig
from slam.geometry import Mount, Rig, transform, wrap_angles
from slam.window import has_moved

Array = NDArray[np.float64]


def observable_landmarks(
    rig: Rig, poses: Array, landmarks_xy: Array, config: SlamConfig
) -> NDArray[np.bool_]:
    """Tell which landmarks lay in the joint view of one radar pair at enough distinct poses.

    Joint view means within the field of view and between the range limits of both radars of one
    pair. Enough is ``clustering.min_observations`` poses; poses closer together than a collected
    state (``window.min_distance_m``, ``min_turn_rad``) count once, so standing still adds nothing.

    Parameters
    ----------
    rig
        The mounts.
    poses
        shape (n, 3), true poses in time order, frame of the landmarks.
    landmarks_xy
        shape (m, 2) [m].
    config
        Field of view, range limits, what is distinct and what is enough.

    Returns
    -------
    observable
        shape (m,).
    """
    observable = np.zeros(len(landmarks_xy), dtype=bool)
    distinct = _distinct(poses, config)
    for pair in rig.pairs():
        seen = _in_view(rig.mounts[pair.first], distinct, landmarks_xy, config) & _in_view(
            rig.mounts[pair.second], distinct, landmarks_xy, config
        )
        observable |= seen.sum(axis=0) >= config.clustering.min_observations
    return observable


def _distinct(poses: Array, config: SlamConfig) -> Array:
    """Return the poses that differ from the one kept before them."""
    kept: list[Array] = []
    for pose in poses:
        if not kept or has_moved(kept[-1], pose, config.window):
            kept.append(pose)
    return np.array(kept).reshape(-1, 3)


def _in_view(
    mount: Mount, poses: Array, landmarks_xy: Array, config: SlamConfig
) -> NDArray[np.bool_]:
    """Return whether one radar has each landmark in view from each pose, shape (n, m)."""
    antenna = np.array([mount.x_m, mount.y_m])
    antennas = np.array([transform(pose, antenna) for pose in poses]).reshape(-1, 2)
    offsets = landmarks_xy[None, :, :] - antennas[:, None, :]
    ranges_m = np.hypot(offsets[..., 0], offsets[..., 1])
    directions = np.arctan2(offsets[..., 1], offsets[..., 0])
    off_boresight = wrap_angles(directions - poses[:, 2, None] - mount.yaw_rad)
    limits = config.detection
    in_view: NDArray[np.bool_] = (
        (ranges_m >= limits.min_range_m)
        & (ranges_m <= limits.max_range_m)
        & (np.abs(off_boresight) <= config.trilateration.field_of_view_rad / 2)
    )
    return in_view

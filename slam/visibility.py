"""Which landmarks a run could have found: those some pair of radars had in joint view.

The rule is part of the metric, not of the design under test, so its numbers are constants here:
designs are compared on equal seeds only, and against the same landmarks.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slam.geometry import Mount, Rig, transform, wrap_angle, wrap_angles

Array = NDArray[np.float64]

# Joint field of view and range limits of one radar: theta and L of the paper, and the start of
# the module's detection zone.
VIEW_DEG = 65.0
MIN_RANGE_M = 0.2
MAX_RANGE_M = 1.5
# As many poses as the paper wants observations of a landmark (min_opc) ...
MIN_POSES = 9
# ... and two poses are distinct if the paper would collect both (min_disp).
DISTINCT_M = 5e-3
DISTINCT_RAD = 0.1


def observable_landmarks(rig: Rig, poses: Array, landmarks_xy: Array) -> NDArray[np.bool_]:
    """Tell which landmarks lay in the joint view of one radar pair at nine or more poses.

    Joint view means within the 65 degree field of view and between 0.2 and 1.5 m of both radars
    of one pair. Poses less than 5 mm and 0.1 rad from the last distinct one count with it, so
    standing still adds nothing.

    Parameters
    ----------
    rig
        The mounts.
    poses
        shape (n, 3), true poses in time order, frame of the landmarks.
    landmarks_xy
        shape (m, 2) [m].

    Returns
    -------
    observable
        shape (m,).
    """
    observable = np.zeros(len(landmarks_xy), dtype=bool)
    distinct = _distinct(poses)
    for pair in rig.pairs():
        seen = _in_view(rig.mounts[pair.first], distinct, landmarks_xy) & _in_view(
            rig.mounts[pair.second], distinct, landmarks_xy
        )
        observable |= seen.sum(axis=0) >= MIN_POSES
    return observable


def _distinct(poses: Array) -> Array:
    """Return the poses that differ from the one kept before them."""
    kept: list[Array] = []
    for pose in poses:
        if (
            not kept
            or math.dist(kept[-1][:2], pose[:2]) >= DISTINCT_M
            or abs(wrap_angle(pose[2] - kept[-1][2])) >= DISTINCT_RAD
        ):
            kept.append(pose)
    return np.array(kept).reshape(-1, 3)


def _in_view(mount: Mount, poses: Array, landmarks_xy: Array) -> NDArray[np.bool_]:
    """Return whether one radar has each landmark in view from each pose, shape (n, m)."""
    antenna = np.array([mount.x_m, mount.y_m])
    antennas = np.array([transform(pose, antenna) for pose in poses]).reshape(-1, 2)
    offsets = landmarks_xy[None, :, :] - antennas[:, None, :]
    ranges_m = np.hypot(offsets[..., 0], offsets[..., 1])
    directions = np.arctan2(offsets[..., 1], offsets[..., 0])
    off_boresight = wrap_angles(directions - poses[:, 2, None] - mount.yaw_rad)
    in_view: NDArray[np.bool_] = (
        (ranges_m >= MIN_RANGE_M)
        & (ranges_m <= MAX_RANGE_M)
        & (np.abs(off_boresight) <= math.radians(VIEW_DEG) / 2)
    )
    return in_view

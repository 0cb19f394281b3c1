"""States of the robot, collected as it moves, with what the radars saw there (Algorithm 1)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.config import WindowConfig
from slam.detection import Detection
from slam.geometry import wrap_angle
from slam.trilateration import Fix

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CollectedState:
    """One entry of Odom[] and Obs[] of Algorithm 1.

    Attributes
    ----------
    t_ns
        Session time.
    odometry_pose
        shape (3,), [x m, y m, heading rad], odometry frame.
    detections
        Ranges of all radars at this pose.
    fixes
        Trilaterated points, body frame of this pose.
    """

    t_ns: int
    odometry_pose: Array
    detections: tuple[Detection, ...]
    fixes: tuple[Fix, ...]


def has_moved(previous: Array, pose: Array, config: WindowConfig) -> bool:
    """Tell whether a pose is far enough from the last collected one, by distance or by turn.

    Both poses have shape (3,). The turn is wrapped, so a heading that passes pi is no motion.
    """
    distance_m = math.hypot(pose[0] - previous[0], pose[1] - previous[1])
    turn_rad = abs(wrap_angle(pose[2] - previous[2]))
    return distance_m >= config.min_distance_m or turn_rad >= config.min_turn_rad

"""Where the walls and boxes of an emulated scene stand, for pictures."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from emulator.scene import Scene
from slam.geometry import transform

Array = NDArray[np.float64]


def outlines_m(scene: Scene) -> tuple[Array, ...]:
    """Return a line for each wall and a closed one for each box, shape (k, 2) [m], world frame."""
    walls = [np.array([wall.from_m, wall.to_m]) for wall in scene.walls]
    boxes = []
    for box in scene.objects:
        half = np.array([box.width_m, box.depth_m]) / 2
        corners = half * np.array([(1, 1), (-1, 1), (-1, -1), (1, -1), (1, 1)])
        boxes.append(transform(np.array([box.x_m, box.y_m, math.radians(box.yaw_deg)]), corners))
    return (*walls, *boxes)

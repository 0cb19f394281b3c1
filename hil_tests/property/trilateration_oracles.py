"""Forward geometry of one radar, and what is not a range."""

import math

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from slam.geometry import Mount

Array = NDArray[np.float64]

HALF_VIEW_RAD = math.radians(32.5)
NO_RANGES = st.sampled_from([math.nan, math.inf, -math.inf, 0.0, -0.0, -0.3, -1e300, 1e300])


def distance(mount: Mount, point: Array) -> float:
    return math.hypot(point[0] - mount.x_m, point[1] - mount.y_m)


def off_boresight(mount: Mount, point: Array) -> float:
    direction = math.atan2(point[1] - mount.y_m, point[0] - mount.x_m)
    return math.remainder(direction - mount.yaw_rad, math.tau)

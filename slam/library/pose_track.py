"""Poses of the wheels in time order, and the pose at any time between them."""

from __future__ import annotations

import math
from array import array
from bisect import bisect_right
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from slam.geometry import wrap_angle

# Forgetting moves all later poses, so it is done for some at a time
_FEWEST_FORGOTTEN = 64


class PoseTrack:
    """Poses at ascending times [ns], asked for the pose at any time between them.

    Position and heading are linear between two poses, the heading the short way round. That is
    exact on straight legs and for turns on the spot. On an arc the position half way between poses
    is chord / 2 * tan(turn / 4) off, 0.12 mm for 1 cm and 5.6 degrees; an arc instead would help
    only there, and fits no wheel that stops or starts between poses either.

    Later ones may be added while a robot drives; what lies between earlier ones stays the same to
    the last bit.
    """

    def __init__(self) -> None:
        self._stamps_ns = array("q")
        self._x_m, self._y_m = array("d"), array("d")
        self._heading_rad = array("d")  # unwrapped
        self._last_heading_rad = 0.0  # as it was given
        self._turns_rad = 0.0  # what unwrapping adds to it

    def __len__(self) -> int:
        return len(self._stamps_ns)

    @property
    def first_ns(self) -> int:
        return self._stamps_ns[0]

    @property
    def last_ns(self) -> int:
        return self._stamps_ns[-1]

    def add(self, t_ns: int, pose: Sequence[float]) -> None:
        """Take a pose, [x m, y m, heading rad], later than all before it."""
        x_m, y_m, heading_rad = pose
        if self._stamps_ns:
            self._turns_rad += _unwrapping(self._last_heading_rad, heading_rad)
        self._stamps_ns.append(t_ns)
        self._x_m.append(x_m)
        self._y_m.append(y_m)
        self._heading_rad.append(heading_rad + self._turns_rad)
        self._last_heading_rad = heading_rad

    def forget_before(self, t_ns: int) -> int:
        """Forget what no pose from a time on depends on, now or later; return how many poses."""
        n_needless = bisect_right(self._stamps_ns, t_ns) - 1
        if n_needless < _FEWEST_FORGOTTEN:
            return 0
        for column in (self._stamps_ns, self._x_m, self._y_m, self._heading_rad):
            del column[:n_needless]
        return n_needless

    def pose_at(self, t_ns: int) -> NDArray[np.float64]:
        """Return the pose at a time, shape (3,), its heading in [-pi, pi).

        Outside of all it is the nearest one.
        """
        stamps_ns = self._stamps_ns
        after = bisect_right(stamps_ns, t_ns)
        if after in (0, len(stamps_ns)):
            row = min(after, len(stamps_ns) - 1)
            return np.array([self._x_m[row], self._y_m[row], wrap_angle(self._heading_rad[row])])
        return self._between(after - 1, t_ns)

    def extrapolated(self, t_ns: int) -> NDArray[np.float64]:
        """Return the pose at a time behind the newest one, at the velocity of the last two."""
        return self._between(max(len(self) - 2, 0), t_ns) if len(self) > 1 else self.pose_at(t_ns)

    def _between(self, row: int, t_ns: int) -> NDArray[np.float64]:
        """Return the pose on the line through that of a row and the next one."""
        stamps_ns, after = self._stamps_ns, row + 1
        part = (t_ns - stamps_ns[row]) / (stamps_ns[after] - stamps_ns[row])
        x_m, y_m = self._x_m[row], self._y_m[row]
        turn_rad = self._heading_rad[after] - self._heading_rad[row]
        return np.array(
            [
                x_m + part * (self._x_m[after] - x_m),
                y_m + part * (self._y_m[after] - y_m),
                wrap_angle(self._heading_rad[row] + part * turn_rad),
            ]
        )


def _unwrapping(before_rad: float, after_rad: float) -> float:
    """Return what to add to a heading so that it follows on the one before the short way round.

    One step of `numpy.unwrap`, to the last bit.
    """
    turn_rad = after_rad - before_rad
    if abs(turn_rad) < math.pi:
        return 0.0
    short_rad = (turn_rad + math.pi) % math.tau - math.pi
    if short_rad == -math.pi and turn_rad > 0:
        short_rad = math.pi
    return short_rad - turn_rad

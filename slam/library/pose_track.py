"""Poses of the wheels in time order, and the pose at any time between them."""

from __future__ import annotations

import math
from array import array
from bisect import bisect_right
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from slam.geometry import between, compose, wrap_angle

_NS_PER_S = 1_000_000_000
# Forgetting moves all later poses, so it is done for some at a time
_FEWEST_FORGOTTEN = 64

# A source of odometry that is restarted begins at its first pose again, or at zero. The distances
# are in metres, a turn of 1 rad counts as one.
_JUMP = 0.3
_AT_START = 1e-3
# Of a first message that comes a little late, where nothing can have driven there
_NEAR_START, _MOST_ACCELERATION_MPS2 = 0.1, 10.0
# For so long a robot is taken to go on as before
_MOST_EXTRAPOLATED_S = 1.0


class PoseTrack:
    """Poses at ascending times [ns], asked for the pose at any time between them.

    Position and heading are linear between two poses, the heading the short way round. That is
    exact on straight legs and for turns on the spot. On an arc the position half way between poses
    is chord / 2 * tan(turn / 4) off, 0.12 mm for 1 cm and 5.6 degrees; an arc instead would help
    only there, and fits no wheel that stops or starts between poses either.

    Later ones may be added while a robot drives; what lies between earlier ones stays the same to
    the last bit.

    If the source begins anew, at its first pose or at zero, the robot is taken to have gone on as
    before, or to have stood where nothing came for more than a second: `pose_at` has no jump there.
    """

    def __init__(self) -> None:
        self._stamps_ns = array("q")
        self._x_m, self._y_m = array("d"), array("d")
        self._heading_rad = array("d")  # unwrapped
        self._last = (0.0, 0.0, 0.0)  # as it was given
        self._turns_rad = 0.0  # what unwrapping adds to it
        # Where the source began anew: the times, and its frame from then on in that of the first
        self._restarts_ns: list[int] = []
        self._frames: list[NDArray[np.float64]] = []
        self._starts = [(0.0, 0.0, 0.0)]

    def __len__(self) -> int:
        return len(self._stamps_ns)

    @property
    def first_ns(self) -> int:
        return self._stamps_ns[0]

    @property
    def last_ns(self) -> int:
        return self._stamps_ns[-1]

    def add(self, t_ns: int, pose: Sequence[float]) -> bool:
        """Take a pose, [x m, y m, heading rad], later than all before it.

        Return whether the source seems to have begun anew.
        """
        x_m, y_m, heading_rad = pose
        frame = None
        if not self._stamps_ns:
            self._starts.append((x_m, y_m, heading_rad))
        elif _apart(self._last, pose) >= _JUMP:
            frame = self._new_frame(t_ns, pose)
        if frame is not None:
            self._restarts_ns.append(t_ns)
            self._frames.append(frame)
        if self._stamps_ns:
            self._turns_rad += _unwrapping(self._last[2], heading_rad)
        self._stamps_ns.append(t_ns)
        self._x_m.append(x_m)
        self._y_m.append(y_m)
        self._heading_rad.append(heading_rad + self._turns_rad)
        self._last = (x_m, y_m, heading_rad)
        return frame is not None

    def frame_at(self, t_ns: int) -> NDArray[np.float64]:
        """Return the frame of the poses that were given at a time, shape (3,), in that of all.

        Zeros until the source begins anew.
        """
        n_restarts = bisect_right(self._restarts_ns, t_ns)
        return self._frames[n_restarts - 1] if n_restarts else np.zeros(3)

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
            return self._wrapped(min(after, len(stamps_ns) - 1))
        return self._between(after - 1, t_ns)

    def extrapolated(self, t_ns: int) -> NDArray[np.float64]:
        """Return the pose at a time behind the newest one, at the velocity of the last two."""
        return self._between(len(self) - 2, t_ns) if len(self) > 1 else self._wrapped(0)

    def _pose(self, row: int) -> tuple[float, float, float]:
        """Return the pose of a row, its heading unwrapped as long as the source goes on."""
        given = self._x_m[row], self._y_m[row], self._heading_rad[row]
        if not self._restarts_ns or self._stamps_ns[row] < self._restarts_ns[0]:
            return given
        x_m, y_m, heading_rad = compose(self.frame_at(self._stamps_ns[row]), np.array(given))
        return float(x_m), float(y_m), float(heading_rad)

    def _wrapped(self, row: int) -> NDArray[np.float64]:
        x_m, y_m, heading_rad = self._pose(row)
        return np.array([x_m, y_m, wrap_angle(heading_rad)])

    def _between(self, row: int, t_ns: int) -> NDArray[np.float64]:
        """Return the pose on the line through that of a row and the next one."""
        before_ns, after_ns = self._stamps_ns[row], self._stamps_ns[row + 1]
        part = (t_ns - before_ns) / (after_ns - before_ns)
        (x_m, y_m, heading_rad), after = self._pose(row), self._pose(row + 1)
        turn_rad = after[2] - heading_rad
        if self._restarts_ns:
            turn_rad = wrap_angle(turn_rad)
        return np.array(
            [
                x_m + part * (after[0] - x_m),
                y_m + part * (after[1] - y_m),
                wrap_angle(heading_rad + part * turn_rad),
            ]
        )

    def _new_frame(self, t_ns: int, given: Sequence[float]) -> NDArray[np.float64] | None:
        """Return the frame of the source from a pose far from the last one on; None: as before."""
        dt_s = (t_ns - self.last_ns) / _NS_PER_S
        goes_on = dt_s <= _MOST_EXTRAPOLATED_S
        expected = self.extrapolated(t_ns) if goes_on else self._wrapped(len(self) - 1)
        now = self.frame_at(t_ns)
        jump = _apart(expected.tolist(), compose(now, np.array(given)).tolist())
        is_drivable = jump <= max(_JUMP, _MOST_ACCELERATION_MPS2 * dt_s**2)
        if jump > _JUMP and self._from_start(given) <= (_AT_START if is_drivable else _NEAR_START):
            return compose(expected, between(np.array(given), np.zeros(3)))
        if self._frames and not is_drivable and self._from_start(self._last) <= _NEAR_START:
            # It never drove from there: for a while its poses were just not known.
            return self._frames[-2] if len(self._frames) > 1 else np.zeros(3)
        return None

    def _from_start(self, given: Sequence[float]) -> float:
        return min(_apart(start, given) for start in self._starts)


def _apart(one: Sequence[float], other: Sequence[float]) -> float:
    """Return how far two poses are apart [m], a turn of 1 rad as a metre."""
    turn_rad = abs(wrap_angle(other[2] - one[2]))
    return math.hypot(other[0] - one[0], other[1] - one[1]) + turn_rad


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

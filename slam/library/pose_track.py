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

# How near to its first pose, or to zero, a restarted source begins [m, rad]
_NEAR_START = 0.1
# How far its pose jumps at least [m, rad], and how many times faster than the robot ever moved
_JUMP, _FASTER = 0.3, 2.0
# Over which time rates are taken, and the largest that counts [m/s, rad/s]: no robot is faster
_RATE_NS, _MOST_RATE = 100_000_000, 10.0
# For how long the robot is taken to go on, and over which time its velocity is taken
_GOES_ON_NS, _VELOCITY_NS = 1_000_000_000, 300_000_000
# By how much the poses of a robot that stands may differ [m, rad]
_STOOD = 0.02
NEAR_NS = 100_000_000
"""For how long before or behind a pose a robot is taken to go on as it did there."""
# Over which time, at least, it is taken behind the newest pose: stamps of arrival bunch
_NEWEST_NS = 50_000_000


class PoseTrack:
    """Poses at ascending times [ns], asked for the pose at any time between them.

    Position and heading are linear between two poses, the heading the short way round. That is
    exact on straight legs and for turns on the spot. On an arc the position half way between poses
    is chord / 2 * tan(turn / 4) off, 0.12 mm for 1 cm and 5.6 degrees; an arc instead would help
    only there, and fits no wheel that stops or starts between poses either.

    Later ones may be added while a robot drives; what lies between earlier ones stays the same to
    the last bit.

    If the source is restarted, its poses begin at its first pose or at zero again. The robot is
    then taken to have gone on as before, or to have stood where nothing came for more than a
    second, and `pose_at` has no jump. A source that jumps elsewhere, too, is taken as it is, and so
    is one whose poses are more than 0.3 s apart.

    Parameters
    ----------
    may_restart
        False takes all poses as they are: those of a reference, or of a path that was made.
    """

    def __init__(self, *, may_restart: bool = True) -> None:
        self._stamps_ns = array("q")
        self._x_m, self._y_m = array("d"), array("d")
        self._heading_rad = array("d")  # unwrapped
        self._last = (0.0, 0.0, 0.0)  # as it was given
        self._turns_rad = 0.0  # what unwrapping adds to its heading
        self._may_restart = may_restart
        self._starts = [(0.0, 0.0, 0.0)]
        # Where the source was restarted: the times, and its frame from then on in that of `pose_at`
        self._restarts_ns: list[int] = []
        self._frames: list[NDArray[np.float64]] = []
        self._frame_before = np.zeros(3)
        # Since when its rate is taken, and the fastest so far [m/s, rad/s]; None: not known
        self._rate_since: tuple[int, tuple[float, float, float]] | None = None
        self._fastest: tuple[float, float] | None = None

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

        Return whether the source seems to have been restarted.
        """
        x_m, y_m, heading_rad = pose
        given, frame = (x_m, y_m, heading_rad), None
        if not self._stamps_ns:
            self._starts.append(given)
        else:
            frame = self._new_frame(t_ns, given) if self._may_restart else None
            self._turns_rad += _unwrapping(self._last[2], heading_rad)
        if frame is not None:
            self._frame_before = self.frame_at(t_ns)
            self._restarts_ns.append(t_ns)
            self._frames.append(frame)
            self._rate_since = None
        self._learn_rate(t_ns, given)
        self._stamps_ns.append(t_ns)
        self._x_m.append(x_m)
        self._y_m.append(y_m)
        self._heading_rad.append(heading_rad + self._turns_rad)
        self._last = given
        return frame is not None

    def frame_at(self, t_ns: int) -> NDArray[np.float64]:
        """Return the frame of the poses given at a time in that of `pose_at`, shape (3,).

        Zeros until the source is restarted.
        """
        n_restarts = bisect_right(self._restarts_ns, t_ns)
        return self._frames[n_restarts - 1] if n_restarts else np.zeros(3)

    def forget_before(self, t_ns: int) -> int:
        """Forget what no pose from a time on depends on, now or later; return how many poses."""
        if not self._stamps_ns:
            return 0
        t_ns = min(t_ns, self.last_ns - _VELOCITY_NS)
        n_needless = bisect_right(self._stamps_ns, t_ns) - 1
        if n_needless < _FEWEST_FORGOTTEN:
            return 0
        for column in (self._stamps_ns, self._x_m, self._y_m, self._heading_rad):
            del column[:n_needless]
        n_old = max(bisect_right(self._restarts_ns, self.first_ns) - 1, 0)
        del self._restarts_ns[:n_old], self._frames[:n_old]
        return n_needless

    def pose_at(self, t_ns: int) -> NDArray[np.float64]:
        """Return the pose at a time, shape (3,), its heading in [-pi, pi).

        Outside of all it is the nearest one.
        """
        stamps_ns = self._stamps_ns
        after = bisect_right(stamps_ns, t_ns)
        if after in (0, len(stamps_ns)):
            return self._wrapped(min(after, len(stamps_ns) - 1))
        return self._between(after - 1, t_ns, after)

    def gap_at(self, t_ns: int) -> tuple[int, int] | None:
        """Return the times of the poses around a time, if the robot drove unseen between them.

        That is for more than a second, and by more than `_STOOD`; near either pose it is known.
        """
        after = bisect_right(self._stamps_ns, t_ns)
        if after in (0, len(self)) or self._stamps_ns[after - 1] == t_ns:
            return None
        before_ns, after_ns = self._stamps_ns[after - 1 : after + 1]
        is_near = min(t_ns - before_ns, after_ns - t_ns) <= NEAR_NS
        if is_near or after_ns - before_ns <= _GOES_ON_NS:
            return None
        apart = _apart(self._pose(after - 1), self._pose(after))
        return (before_ns, after_ns) if max(apart) > _STOOD else None

    def extrapolated(self, t_ns: int) -> NDArray[np.float64]:
        """Return the pose at a time behind the newest one, at the velocity before it.

        That is taken over 50 ms, or between the last two poses if they are further apart.
        """
        newest = len(self) - 1
        before = max(bisect_right(self._stamps_ns, self.last_ns - _NEWEST_NS) - 1, 0)
        return self._between(before, t_ns, newest) if before < newest else self._wrapped(0)

    def _pose(self, row: int) -> tuple[float, float, float]:
        """Return the pose of a row; its heading is unwrapped until the first restart only."""
        given = self._x_m[row], self._y_m[row], self._heading_rad[row]
        if not self._restarts_ns or self._stamps_ns[row] < self._restarts_ns[0]:
            return given
        x_m, y_m, heading_rad = compose(self.frame_at(self._stamps_ns[row]), np.array(given))
        return float(x_m), float(y_m), float(heading_rad)

    def _wrapped(self, row: int) -> NDArray[np.float64]:
        x_m, y_m, heading_rad = self._pose(row)
        return np.array([x_m, y_m, wrap_angle(heading_rad)])

    def _between(self, row: int, t_ns: int, later: int) -> NDArray[np.float64]:
        """Return the pose on the line through those of two rows."""
        before_ns, after_ns = self._stamps_ns[row], self._stamps_ns[later]
        part = (t_ns - before_ns) / (after_ns - before_ns)
        (x_m, y_m, heading_rad), after = self._pose(row), self._pose(later)
        turn_rad = after[2] - heading_rad
        if self._restarts_ns and after_ns >= self._restarts_ns[0]:
            turn_rad = wrap_angle(turn_rad)
        return np.array(
            [
                x_m + part * (after[0] - x_m),
                y_m + part * (after[1] - y_m),
                wrap_angle(heading_rad + part * turn_rad),
            ]
        )

    def _new_frame(
        self, t_ns: int, given: tuple[float, float, float]
    ) -> NDArray[np.float64] | None:
        """Return the frame of the source from a pose on, if it is another one from there."""
        period_ns = self.last_ns - self._stamps_ns[max(len(self) - 2, 0)]
        if self._fastest is None or period_ns > _VELOCITY_NS or not self._is_jump(t_ns, given):
            return None
        if self._is_near_start(given):
            return compose(self._continued(t_ns), between(np.array(given), np.zeros(3)))
        since_ns = t_ns - self._restarts_ns[-1] if self._restarts_ns else _GOES_ON_NS
        if since_ns < _GOES_ON_NS and self._is_near_start(self._last):
            # It did not drive from there: for a moment its poses were not known.
            return self._frame_before
        self._may_restart = False
        return None

    def _is_jump(self, t_ns: int, given: tuple[float, float, float]) -> bool:
        assert self._fastest is not None
        could = _FASTER * (t_ns - self.last_ns) / _NS_PER_S
        steps, rates = _apart(self._last, given), self._fastest
        return any(a > max(_JUMP, could * rate) for a, rate in zip(steps, rates, strict=True))

    def _is_near_start(self, given: tuple[float, float, float]) -> bool:
        return any(max(_apart(start, given)) <= _NEAR_START for start in self._starts)

    def _continued(self, t_ns: int) -> NDArray[np.float64]:
        """Return where a robot is at a time behind the newest pose that goes on as before it."""
        last = self._wrapped(len(self) - 1)
        before_ns = self.last_ns - _VELOCITY_NS
        if t_ns - self.last_ns > _GOES_ON_NS or before_ns < self.first_ns:
            return last
        moved = last - PoseTrack.pose_at(self, before_ns)
        moved[2] = wrap_angle(moved[2])
        return np.asarray(last + (t_ns - self.last_ns) / _VELOCITY_NS * moved)

    def _learn_rate(self, t_ns: int, given: tuple[float, float, float]) -> None:
        since_ns, pose = self._rate_since or (t_ns, given)
        if self._rate_since is None:
            self._rate_since = t_ns, given
        elif t_ns - since_ns >= _RATE_NS:
            elapsed_s = (t_ns - since_ns) / _NS_PER_S
            mps, radps = (apart / elapsed_s for apart in _apart(pose, given))
            if max(mps, radps) <= _MOST_RATE:
                fastest = self._fastest or (0.0, 0.0)
                self._fastest = max(mps, fastest[0]), max(radps, fastest[1])
            self._rate_since = t_ns, given


def _apart(one: Sequence[float], other: Sequence[float]) -> tuple[float, float]:
    """Return how far two poses are apart [m], and turned [rad]."""
    distance_m = math.hypot(other[0] - one[0], other[1] - one[1])
    return distance_m, abs(wrap_angle(other[2] - one[2]))


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

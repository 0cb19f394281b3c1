"""Where the robot truly is: straight legs between waypoints and turns on the spot.

The world frame is the robot's start pose: it stands at the origin with heading zero (along x)
until scene time 0, drives, and stands still again at the end. Between knots position and heading
are linear in time, so a pose at any nanosecond is exact and needs no integration.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Trajectory", "carried", "drive"]

# A turn smaller than this is straight on; a U-turn within it of -180 deg is taken as +180 deg.
_ANGLE_TOLERANCE_RAD = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory:
    """A true path, piecewise linear between knots.

    Attributes
    ----------
    knot_times_ns
        Shape (k,), int64, strictly increasing, first 0.
    knot_poses
        Shape (k, 3), float64: x [m], y [m], heading [rad, counter-clockwise,
        continuous: never wrapped], world frame.
    carried_ns
        From when to when the robot is carried and its wheels stand; None where it never is.
    """

    knot_times_ns: NDArray[np.int64]
    knot_poses: NDArray[np.float64]
    carried_ns: tuple[int, int] | None = None

    @property
    def duration_ns(self) -> int:
        """Scene time at which the robot stops for good, in ns."""
        return int(self.knot_times_ns[-1])

    def poses(self, t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the true pose at each time; before 0 and after the end the robot stands still.

        Parameters
        ----------
        t_ns
            Shape (n,), int64, scene time.

        Returns
        -------
        Shape (n, 3), float64: x [m], y [m], heading [rad, not wrapped], world frame.
        """
        times = np.clip(np.asarray(t_ns, dtype=np.int64), 0, self.duration_ns)
        if len(self.knot_times_ns) == 1:
            return np.repeat(self.knot_poses, len(times), axis=0)
        last_leg = len(self.knot_times_ns) - 2
        leg = np.minimum(np.searchsorted(self.knot_times_ns, times, side="right") - 1, last_leg)
        start_ns = self.knot_times_ns[leg]
        fraction = (times - start_ns) / (self.knot_times_ns[leg + 1] - start_ns)
        start = self.knot_poses[leg]
        poses: NDArray[np.float64] = start + fraction[:, np.newaxis] * (
            self.knot_poses[leg + 1] - start
        )
        return poses


def drive(
    stops_m: Sequence[tuple[float, float]], *, speed_mps: float, turn_rate_rad_per_s: float
) -> Trajectory:
    """Return the trajectory of a robot that visits the stops in order, turning on the spot.

    It starts at the first stop with heading zero and takes the shorter way round at each turn;
    a U-turn goes counter-clockwise. Leg and turn times are rounded to whole nanoseconds,
    at least one.

    Parameters
    ----------
    stops_m
        At least one (x, y) [m], world frame. Equal neighbours are one stop.
    speed_mps
        Speed on the legs, > 0.
    turn_rate_rad_per_s
        Turn rate on the spot, > 0.

    >>> path = drive([(0, 0), (2, 0), (2, 2)], speed_mps=0.05, turn_rate_rad_per_s=math.pi / 6)
    >>> path.duration_ns  # 40 s along x, 3 s turning left, 40 s along y
    83000000000
    >>> path.poses(np.array([-1, 20_000_000_000, 99_000_000_000])).round(3).tolist()
    [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 2.0, 1.571]]
    """
    x, y = stops_m[0]
    heading = 0.0
    time_ns = 0
    times = [time_ns]
    poses = [(x, y, heading)]
    for next_x, next_y in stops_m[1:]:
        length_m = math.hypot(next_x - x, next_y - y)
        if length_m == 0:
            continue
        turn = math.remainder(math.atan2(next_y - y, next_x - x) - heading, math.tau)
        if turn < -math.pi + _ANGLE_TOLERANCE_RAD:
            turn += math.tau
        if abs(turn) > _ANGLE_TOLERANCE_RAD:
            heading += turn
            time_ns += max(round(abs(turn) / turn_rate_rad_per_s * 1e9), 1)
            times.append(time_ns)
            poses.append((x, y, heading))
        x, y = next_x, next_y
        time_ns += max(round(length_m / speed_mps * 1e9), 1)
        times.append(time_ns)
        poses.append((x, y, heading))
    return Trajectory(
        knot_times_ns=np.array(times, dtype=np.int64), knot_poses=np.array(poses, dtype=np.float64)
    )


def carried(path: Trajectory, *, at_ns: int, skips_ns: int, takes_ns: int) -> Trajectory:
    """Return a path of which a stretch is skipped: the robot is picked up and set down after it.

    Parameters
    ----------
    path
        The drive without the lift.
    at_ns, skips_ns
        When it is lifted, and how much of the drive is left out from there.
    takes_ns
        Time in the air, moving straight and turning evenly to the other end of the stretch.

    Raises
    ------
    ValueError
        The stretch does not end before the drive does.
    """
    down_ns = at_ns + skips_ns
    if not 0 < at_ns < down_ns < path.duration_ns:
        raise ValueError(
            f"the robot is set down {down_ns / 1e9:g} s into a drive of "
            f"{path.duration_ns / 1e9:g} s, must be before its end"
        )
    before, after = path.knot_times_ns < at_ns, path.knot_times_ns > down_ns
    ends_ns = np.array([at_ns, down_ns], dtype=np.int64)
    times = (
        path.knot_times_ns[before],
        [at_ns, at_ns + takes_ns],
        path.knot_times_ns[after] + takes_ns - skips_ns,
    )
    return Trajectory(
        knot_times_ns=np.concatenate(times),
        knot_poses=np.concatenate(
            (path.knot_poses[before], path.poses(ends_ns), path.knot_poses[after])
        ),
        carried_ns=(at_ns, at_ns + takes_ns),
    )

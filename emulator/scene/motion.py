"""Where the robot and people are at any time.

The world frame is the robot's start pose: it stands at the origin with heading zero (along x)
until scene time 0, drives, and stands still again at the end. Between knots position and heading
are linear in time, so a pose at any nanosecond is exact and needs no integration.

A person is a point reflector that moves: its echo falls with R**-2, and its range is the distance
to a point on its path less the chest's displacement ``breath_amplitude_m sin(2 pi f t)``, so the
carrier's phase follows every movement continuously. Limbs, the sway of walking, heartbeat,
shadowing and the body's extent are left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from emulator.scene.tables import Number, Table, matching

AMPLITUDE_OF_1_M2 = 0.06
"""Echo of 1 m**2 on boresight at 1 m, normalised units at TX power 2.

Assumed: a scene's rod of 0.015 is a cylinder of 1 cm radius seen over one Fresnel zone of 20 cm,
2 pi a h**2 / wavelength = 0.06 m**2, and amplitude goes with the root of the cross section."""

Metres = Annotated[Number, Field(ge=-1000, le=1000)]
Name = Annotated[
    str,
    Field(max_length=40),
    matching("[a-z][a-z0-9_]*", "of small letters, digits and _, a letter first"),
]
_Seconds = Annotated[Number, Field(ge=0, le=86_400)]

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
        Shape (k, 3), float64: x [m], y [m], heading [rad, counter-clockwise, never wrapped],
        world frame.
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
        """Return the true pose at each time, shape (n, 3), as ``knot_poses``.

        Before 0 and after the end the robot stands still.
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

    It starts at the first stop (of at least one, world frame) with heading zero and takes the
    shorter way round at each turn; a U-turn goes counter-clockwise. Leg and turn times are rounded
    to whole nanoseconds, at least one. Equal neighbours are one stop.

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

    It is in the air for ``takes_ns``, moving straight and turning evenly. `ValueError` is raised
    when the stretch does not end before the drive does.
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


class PersonSpec(Table):
    """One person, in the world frame.

    It is in the scene from ``enters_s`` to ``leaves_s`` (for ever if that is left out), and walks
    from the moment it enters. ``walk`` selects what happens at the last waypoint: ``once`` stays
    there, ``to_and_fro`` turns back, ``round`` goes on to the first one. One waypoint: it stands.
    ``rcs_m2`` is its radar cross section; breathing is ``breaths_per_min`` and the amplitude of
    the chest (half of its travel). The reflection phase is fixed by the name.
    """

    name: Name
    waypoints_m: Annotated[tuple[tuple[Metres, Metres], ...], Field(min_length=1, max_length=1000)]
    speed_mps: Annotated[Number, Field(ge=1e-3, le=10)] = 1.0
    walk: Literal["once", "to_and_fro", "round"] = "once"
    enters_s: _Seconds = 0.0
    leaves_s: _Seconds | None = None
    rcs_m2: Annotated[Number, Field(gt=0, le=100)] = 1.0
    breaths_per_min: Annotated[Number, Field(ge=0, le=60)] = 15.0
    breath_amplitude_m: Annotated[Number, Field(ge=0, le=0.05)] = 0.004

    @model_validator(mode="after")
    def _leaves_after_it_enters(self) -> PersonSpec:
        if self.leaves_s is not None and self.leaves_s <= self.enters_s:
            raise ValueError("leaves_s: must be later than enters_s")
        return self


def positions_m(person: PersonSpec, t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return where a person is, shape (n, 2) [m], world frame, at scene times of shape (n,)."""
    stops = list(person.waypoints_m)
    if person.walk == "round":
        stops.append(stops[0])
    elif person.walk == "to_and_fro":
        stops.extend(reversed(stops[:-1]))
    path = np.array(stops, dtype=np.float64)
    steps = np.diff(path, axis=0)
    ends_m = np.concatenate([[0.0], np.cumsum(np.sqrt(steps[:, 0] ** 2 + steps[:, 1] ** 2))])
    length_m = float(ends_m[-1])
    walked_m = np.maximum(t_ns / 1e9 - person.enters_s, 0.0) * person.speed_mps
    if person.walk != "once" and length_m > 0:
        walked_m = np.fmod(walked_m, length_m)
    at_x = np.interp(walked_m, ends_m, path[:, 0])
    at_y = np.interp(walked_m, ends_m, path[:, 1])
    return np.stack([at_x, at_y], axis=1)


def present(person: PersonSpec, t_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Return whether a person is in the scene, shape (n,)."""
    t_s = t_ns / 1e9
    there: NDArray[np.bool_] = t_s >= person.enters_s
    return there if person.leaves_s is None else there & (t_s < person.leaves_s)


def chest_displacement_m(person: PersonSpec, t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return how far the chest is out towards the radar, shape (n,) [m]."""
    turns = np.fmod(t_ns / 1e9 * (person.breaths_per_min / 60), 1.0)
    return np.asarray(person.breath_amplitude_m * np.sin(math.tau * turns), dtype=np.float64)

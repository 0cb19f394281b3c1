"""Where the robot is at any time, and things that swing; people are in `emulator.scene.people`.

The world frame is the robot's start pose: it stands at the origin with heading zero (along x)
until scene time 0, drives, and stands still again at the end. Between knots position and heading
are linear in time, so a pose at any nanosecond is exact and needs no integration.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field

from emulator.scene.toml_files import Number, Table
from xethru_protocol.validation import matching

AMPLITUDE_OF_1_M2 = 0.06
"""Echo of 1 m**2 on boresight at 1 m, normalised units at TX power 2.

Assumed: a scene's rod of 0.015 is a cylinder of 1 cm radius seen over one Fresnel zone of 20 cm,
2 pi a h**2 / wavelength = 0.06 m**2, and amplitude goes with the root of the cross section."""

Metres = Annotated[Number, Field(ge=-1000, le=1000)]
Name = Annotated[
    str,
    Field(max_length=40),
    AfterValidator(matching("[a-z][a-z0-9_]*", "of small letters, digits and _, a letter first")),
]
Degrees = Annotated[Number, Field(ge=-360, le=360)]

# A turn smaller than this is straight on; a U-turn within it of -180 deg is taken as +180 deg.
_ANGLE_TOLERANCE_RAD = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TruePath:
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
) -> TruePath:
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
    return TruePath(
        knot_times_ns=np.array(times, dtype=np.int64), knot_poses=np.array(poses, dtype=np.float64)
    )


def carried(path: TruePath, *, at_ns: int, skips_ns: int, takes_ns: int) -> TruePath:
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
    return TruePath(
        knot_times_ns=np.concatenate(times),
        knot_poses=np.concatenate(
            (path.knot_poses[before], path.poses(ends_ns), path.knot_poses[after])
        ),
        carried_ns=(at_ns, at_ns + takes_ns),
    )


class MoverSpec(Table):
    """A thing that swings to and fro, such as a fan or a curtain, in the world frame.

    Its echo is that of a point which lies ``swing_m sin(2 pi rate_hz t)`` from ``x_m``, ``y_m`` in
    the direction ``direction_deg``, counter-clockwise from x. Its amplitude is ``amplitude_1m (1 +
    fading cos(2 pi rate_hz t))``: a blade shows its face once a passage. The reflection phase is
    fixed by the name.
    """

    name: Name
    x_m: Metres
    y_m: Metres
    rate_hz: Annotated[Number, Field(gt=0, le=1000)]
    swing_m: Annotated[Number, Field(ge=0, le=1)]
    direction_deg: Degrees = 0.0
    amplitude_1m: Annotated[Number, Field(gt=0, le=10)] = 0.015
    fading: Annotated[Number, Field(ge=0, le=1)] = 0.0


def swings(
    mover: MoverSpec, t_ns: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where a mover is, shape (n, 2) [m], world frame, and the factor on its amplitude."""
    turned_rad = math.tau * np.fmod(t_ns / 1e9 * mover.rate_hz, 1.0)
    direction_rad = math.radians(mover.direction_deg)
    out_m = mover.swing_m * np.sin(turned_rad)
    places_m = np.stack(
        [
            mover.x_m + out_m * math.cos(direction_rad),
            mover.y_m + out_m * math.sin(direction_rad),
        ],
        axis=1,
    )
    return places_m, 1 + mover.fading * np.cos(turned_rad)

"""Planar geometry: poses in SE(2), the mounts of the radars, and the pairs that can trilaterate.

A pose is ``[x, y, heading]`` in [m, m, rad], heading counter-clockwise from x. The body frame has
x forward, y left and its origin at the base footprint.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

MOST_M = 1e8
"""Farther than once around the Earth, as positions on a map may be; filters square them."""
# Where two range circles cross at a smaller angle, an error of range moves their intersection by
# more than 80 times as much.
_MIN_CROSSING_RAD = math.radians(1.0)
# Least part of their fields of view in which two radars must be able to place a point ...
_PAIR_SHARE = 0.05
# ... and part from which on they look at the same things. Less, and most of what one of them ranges
# is out of the other's view.
_SAME_SIDE_SHARE = 0.3
# Cells of a field of view by range and by angle; a share is counted in cells of equal area.
_CELLS = 48


def wrap_angle(angle_rad: float) -> float:
    """Return the angle modulo one turn, in [-pi, pi).

    >>> wrap_angle(math.pi) == -math.pi
    True
    """
    wrapped = math.remainder(angle_rad, math.tau)
    return wrapped if wrapped < math.pi else -math.pi


def wrap_angles(angles_rad: ArrayLike) -> Array:
    """Return angles of any shape modulo one turn, in [-pi, pi)."""
    angles = np.asarray(angles_rad, dtype=np.float64)
    wrapped = angles - math.tau * np.round(angles / math.tau)
    return np.where((wrapped >= math.pi) | (wrapped < -math.pi), -math.pi, wrapped)


def compose(first: Array, second: Array) -> Array:
    """Return ``second``, a pose in the frame of ``first``, in the outer frame; heading wrapped."""
    cosine, sine = math.cos(first[2]), math.sin(first[2])
    return np.array(
        [
            first[0] + cosine * second[0] - sine * second[1],
            first[1] + sine * second[0] + cosine * second[1],
            wrap_angle(first[2] + second[2]),
        ]
    )


def between(origin: Array, pose: Array) -> Array:
    """Return ``pose`` seen from ``origin``, the motion from one to the other, heading wrapped."""
    cosine, sine = math.cos(origin[2]), math.sin(origin[2])
    dx, dy = pose[0] - origin[0], pose[1] - origin[1]
    return np.array(
        [cosine * dx + sine * dy, -sine * dx + cosine * dy, wrap_angle(pose[2] - origin[2])]
    )


def has_moved(previous: Array, pose: Array, min_distance_m: float, min_turn_rad: float) -> bool:
    """Return whether two poses of shape (3,) differ by at least a distance or a turn, wrapped."""
    distance_m = math.hypot(pose[0] - previous[0], pose[1] - previous[1])
    turn_rad = abs(wrap_angle(pose[2] - previous[2]))
    return distance_m >= min_distance_m or turn_rad >= min_turn_rad


def transform(pose: Array, points: Array) -> Array:
    """Return points (2,) or (n, 2) [m] of the frame ``pose`` in the frame the pose is given in."""
    cosine, sine = math.cos(pose[2]), math.sin(pose[2])
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    result: Array = points @ rotation.T + pose[:2]
    return result


def mirrored(point: Array, places: Array) -> Array:
    """Return the mirror image of a point (2,) across the line closest to places (k, 2), in m."""
    middle = places.mean(axis=0)
    along = np.linalg.svd(places - middle, full_matrices=False)[2][0]
    away = point - middle
    return np.asarray(middle + 2.0 * float(along @ away) * along - away)


def align_se2(points: Array, targets: Array) -> Array:
    """Return the rigid motion (3,) that brings points closest to targets, row by row.

    Least squares over rotation and translation, no scale (Umeyama 1991 in the plane), shapes (n, 2)
    [m]: ``transform(motion, points)`` are the aligned points.
    """
    centre_p, centre_t = points.mean(axis=0), targets.mean(axis=0)
    p, t = points - centre_p, targets - centre_t
    cross = float(np.sum(p[:, 0] * t[:, 1] - p[:, 1] * t[:, 0]))
    heading = math.atan2(cross, float(np.sum(p * t)))
    return np.append(centre_t - transform(np.array([0.0, 0.0, heading]), centre_p), heading)


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldOfView:
    """Where a radar can range what is there; the defaults are the paper's."""

    opening_rad: float = math.radians(65.0)  # full angle about the boresight, theta
    min_range_m: float = 0.2  # start of the module's detection zone
    max_range_m: float = 1.5  # L

    def points(self, mount: Mount) -> Array:
        """Return the middles of cells of equal area of one radar's field, (n, 2), body frame."""
        middles = (np.arange(_CELLS) + 0.5) / _CELLS
        squares = self.min_range_m**2 + middles * (self.max_range_m**2 - self.min_range_m**2)
        ranges_m = np.sqrt(squares)[:, None]
        directions = mount.yaw_rad + self.opening_rad * (middles - 0.5)
        x, y = mount.x_m + ranges_m * np.cos(directions), mount.y_m + ranges_m * np.sin(directions)
        return np.column_stack([x.ravel(), y.ravel()])

    def contains(self, mount: Mount, points: Array) -> NDArray[np.bool_]:
        """Return which points (n, 2), body frame, one radar can range, shape (n,)."""
        x, y = points[:, 0] - mount.x_m, points[:, 1] - mount.y_m
        ranges_m = np.hypot(x, y)
        off_boresight = np.abs(wrap_angles(np.arctan2(y, x) - mount.yaw_rad))
        inside = (ranges_m >= self.min_range_m) & (ranges_m <= self.max_range_m)
        return np.asarray(inside & (off_boresight <= self.opening_rad / 2))


PAPERS_FIELD = FieldOfView()


@dataclass(frozen=True, slots=True, kw_only=True)
class ReceivedPulse:
    """The envelope of the pulse that one module receives, as its rig file keeps it.

    Samples are complex, real and imaginary part apart: the carrier is turned back, so a Gaussian
    pulse has no imaginary part. There is an odd number of them, ``step_m`` of range apart, the
    middle one where the range of an echo is. Zero beyond.
    """

    step_m: float
    real: tuple[float, ...]
    imaginary: tuple[float, ...]
    relative_error: float  # norm of the error that is expected of the samples, over their norm

    def __post_init__(self) -> None:
        size = len(self.real)
        if len(self.imaginary) != size or not size % 2:
            raise ValueError("real and imaginary must have the same odd number of samples")
        if not all(map(math.isfinite, (*self.real, *self.imaginary, self.relative_error))):
            raise ValueError("samples and relative_error must be finite numbers")
        if not 0 < self.step_m < math.inf:
            raise ValueError("step_m must be positive")


@dataclass(frozen=True, slots=True, kw_only=True)
class Mount:
    """Where one radar sits on the robot and how its range zero is off.

    Attributes
    ----------
    name
        In messages; without one the rig numbers it.
    x_m, y_m
        Antenna position in the body frame.
    yaw_rad
        Boresight in the body frame, counter-clockwise from forward.
    range_offset_m
        What this module measures too long; the front end subtracts it from every range.
    phase_offset_rad
        What this module and its antennas add to an echo's carrier phase. Rig files and sessions
        keep it; SLAM does not use it.
    pulse
        What the front end begins with; None: the pulse of the data sheet.
    """

    name: str = ""
    x_m: float
    y_m: float
    yaw_rad: float
    range_offset_m: float = 0.0
    phase_offset_rad: float = 0.0
    pulse: ReceivedPulse | None = None


def mount_at(mount: Mount, motion: Array) -> Mount:
    """Return where a mount was when it sampled, in the body frame of another time.

    ``motion`` (3,) is the pose of the robot at the sample's time, seen from its pose at the time
    whose body frame is wanted (``between``).
    """
    cosine, sine = math.cos(motion[2]), math.sin(motion[2])
    return replace(
        mount,
        x_m=float(motion[0]) + cosine * mount.x_m - sine * mount.y_m,
        y_m=float(motion[1]) + sine * mount.x_m + cosine * mount.y_m,
        yaw_rad=mount.yaw_rad + float(motion[2]),
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RadarPair:
    """Two radars whose fields of view overlap, and the triangle base between them.

    ``first`` and ``second`` are mount indices; in the pairs of a rig they are ordered so that the
    boresights look to the left of the base from first to second.
    """

    first: int
    second: int
    baseline_m: float  # distance of the two antennas, d of the paper
    midpoint: Array  # shape (2,) [m], body frame: middle of the base
    # shape (2,) each, unit vectors, body frame: along the base from first to second, and square to
    # it on the side of the boresight
    along: Array
    ahead: Array
    # Angle of each boresight, of the first and of the second radar, from ``along`` towards
    # ``ahead``, in [-pi/2, 3 pi/2)
    boresights_rad: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Rig:
    """The mounts of all radars of one robot, indexed as in frames."""

    mounts: Sequence[Mount]  # kept as a tuple

    def __post_init__(self) -> None:
        """Raise ValueError for a mount that is nowhere, or is called as another one."""
        for number, mount in enumerate(self.mounts):
            where = mount.x_m, mount.y_m, mount.yaw_rad, mount.range_offset_m
            if not all(map(math.isfinite, where)):
                raise ValueError(f"mount {number}, {mount}: its numbers must be finite")
            if abs(mount.yaw_rad) > math.tau:
                raise ValueError(
                    f"mount {number}, {mount}: yaw_rad is in radians, at most a turn; of degrees "
                    "take math.radians"
                )
        named = [m if m.name else replace(m, name=f"radar{k}") for k, m in enumerate(self.mounts)]
        if len({mount.name for mount in named}) < len(named):  # maps and sessions go by names
            raise ValueError(f"mounts are called {', '.join(mount.name for mount in named)}")
        object.__setattr__(self, "mounts", tuple(named))

    def pairs(self, field: FieldOfView = PAPERS_FIELD) -> tuple[RadarPair, ...]:
        """Return the radars that can trilaterate, two by two: ``common_share`` is at least 0.05.

        ``field`` is that of every radar.
        """
        return self._pairs(field, _PAIR_SHARE)

    def sides(self, field: FieldOfView = PAPERS_FIELD) -> tuple[tuple[int, ...], ...]:
        """Return the groups of radars that look at the same things; others are alone in theirs.

        Those of a group are linked by pairs whose ``common_share`` is at least 0.3.
        """
        group = list(range(len(self.mounts)))
        for pair in self._pairs(field, _SAME_SIDE_SHARE):
            old, new = group[pair.second], group[pair.first]
            group = [new if g == old else g for g in group]
        return tuple(
            tuple(i for i, g in enumerate(group) if g == leader) for leader in dict.fromkeys(group)
        )

    def _pairs(self, field: FieldOfView, least_share: float) -> tuple[RadarPair, ...]:
        pairs = []
        for first, second in combinations(range(len(self.mounts)), 2):
            mounts = self.mounts[first], self.mounts[second]
            if common_share(mounts, field) >= least_share:
                pairs.append(_ordered(first, second, mounts))
        return tuple(pair for pair in pairs if pair is not None)


@lru_cache(maxsize=256)
def common_share(mounts: tuple[Mount, Mount], field: FieldOfView) -> float:
    """Return the part of their fields of view in which two radars can place a point, 0 to 1.

    Both must have the point in view, and not its mirror image across the line through both
    antennas, which has the same two ranges; and the range circles must cross there at a degree or
    more. Counted in 2304 cells of equal area of each field, whose mean is returned.
    """
    a, b = mounts
    base = np.array([b.x_m - a.x_m, b.y_m - a.y_m])
    baseline_m = math.hypot(base[0], base[1])
    if baseline_m == 0.0:
        return 0.0
    across = np.array([-base[1], base[0]]) / baseline_m
    points = np.vstack([field.points(a), field.points(b)])
    heights = (points - np.array([a.x_m, a.y_m])) @ across
    mirrored = points - 2.0 * heights[:, None] * across
    to_a = points - np.array([a.x_m, a.y_m])
    to_b = points - np.array([b.x_m, b.y_m])
    crossing = np.arctan2(baseline_m * np.abs(heights), np.sum(to_a * to_b, axis=1))
    common = field.contains(a, points) & field.contains(b, points)
    image = field.contains(a, mirrored) & field.contains(b, mirrored)
    crossing = np.minimum(crossing, math.pi - crossing)
    return float(np.mean(common & ~image & (crossing >= _MIN_CROSSING_RAD)))


def paper_rig() -> Rig:
    """Return the paper's rig: two radars 20 cm apart on each side, 20 cm off the base footprint."""
    return Rig(
        mounts=(
            Mount(name="left_rear", x_m=-0.1, y_m=0.2, yaw_rad=math.pi / 2),
            Mount(name="left_front", x_m=0.1, y_m=0.2, yaw_rad=math.pi / 2),
            Mount(name="right_rear", x_m=-0.1, y_m=-0.2, yaw_rad=-math.pi / 2),
            Mount(name="right_front", x_m=0.1, y_m=-0.2, yaw_rad=-math.pi / 2),
        )
    )


def pair_of(first: int, second: int, mounts: tuple[Mount, Mount]) -> RadarPair | None:
    """Return the triangle base between two mounts; None where they are at the same place.

    ``first`` and ``second`` are their indices. The view is on the side of the base that the
    boresights look to.
    """
    a, b = mounts
    baseline_m = math.hypot(b.x_m - a.x_m, b.y_m - a.y_m)
    if baseline_m == 0.0:
        return None
    base_rad = math.atan2(b.y_m - a.y_m, b.x_m - a.x_m)
    boresights_rad = [wrap_angle(mount.yaw_rad - base_rad) for mount in mounts]
    side = 1.0 if sum(math.sin(boresight_rad) for boresight_rad in boresights_rad) >= 0 else -1.0
    along = np.array([b.x_m - a.x_m, b.y_m - a.y_m]) / baseline_m
    return RadarPair(
        first=first,
        second=second,
        baseline_m=baseline_m,
        midpoint=np.array([a.x_m + b.x_m, a.y_m + b.y_m]) / 2,
        along=along,
        ahead=side * np.array([-along[1], along[0]]),
        boresights_rad=(_from_base(side * boresights_rad[0]), _from_base(side * boresights_rad[1])),
    )


def _from_base(angle_rad: float) -> float:
    """Return an angle in [-pi/2, 3 pi/2): near those of points ahead of the base, 0 to pi."""
    return angle_rad if angle_rad >= -math.pi / 2 else angle_rad + math.tau


def _ordered(first: int, second: int, mounts: tuple[Mount, Mount]) -> RadarPair | None:
    """Return the pair of two mounts, ordered so that the boresights look to the left of its base.

    None where they are at the same place.
    """
    pair = pair_of(first, second, mounts)
    if pair is None or pair.along[0] * pair.ahead[1] - pair.along[1] * pair.ahead[0] > 0:
        return pair
    return pair_of(second, first, mounts[::-1])

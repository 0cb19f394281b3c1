"""Single ranges followed from frame to frame, and where each followed echo stands.

One radar that moves sees a still reflector at ranges that bend: the track of one radar already
places it, up to the radar's unknown offset. So no two radars need to agree before the offsets are
known, which pairs of ranges would demand (20 mm between two radars turn a bearing by 5 degrees).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.detector import Detection
from slam.geometry import wrap_angles

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

# A robot of this class moves a radar by at most some centimetres per frame; a followed range obeys
# its own velocity far better than that.
_GATE_M = 0.012
_MOST_MISSED = 3
_SMOOTHING = 0.35
_LEAST_RANGES = 12
# Half a front end's usual error and what odometry drifts along one track.
_TRACK_SIGMA_M = 0.003
_MOST_RMS_M = 0.008
_MOST_SPREAD_M = 0.2
HALF_VIEW_RAD = math.radians(60)
_OFFSET_SIGMA_M = 0.03


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RangeSet:
    """All single ranges of a recording, in time order.

    Attributes
    ----------
    radar, t_ns
        Shape (n,): mount index and session time.
    range_m, amplitude, sigma_m
        Shape (n,), true metres without any offset removed; sigma is NaN where the front end does
        not tell.
    """

    radar: Indices
    t_ns: NDArray[np.int64]
    range_m: Array
    amplitude: Array
    sigma_m: Array

    @classmethod
    def of(cls, detections: Sequence[Detection]) -> RangeSet:
        """Stack detections; they may come in any order."""
        ordered = sorted(detections, key=lambda d: (d.t_ns, d.radar, d.range_m))
        return cls(
            radar=np.array([d.radar for d in ordered], dtype=np.intp),
            t_ns=np.array([d.t_ns for d in ordered], dtype=np.int64),
            range_m=np.array([d.range_m for d in ordered], dtype=np.float64),
            amplitude=np.array([d.amplitude for d in ordered], dtype=np.float64),
            sigma_m=np.array([d.sigma_m for d in ordered], dtype=np.float64),
        )

    def __len__(self) -> int:
        """Return the number of ranges."""
        return len(self.range_m)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PathNodes:
    """The robot's path as poses at some times; between two of them it is linear.

    Attributes
    ----------
    t_ns
        Shape (n,), ascending, int64.
    poses
        Shape (n, 3), x [m], y [m], heading [rad], continuous; odometry frame as measured, map frame
        as estimated.
    """

    t_ns: NDArray[np.int64]
    poses: Array

    def between(self, t_ns: NDArray[np.int64]) -> tuple[Indices, Array]:
        """Return the node before each time and the fraction on to the next; both shape (m,)."""
        node = np.searchsorted(self.t_ns, t_ns, side="right") - 1
        node = np.clip(node, 0, max(len(self.t_ns) - 2, 0)).astype(np.intp)
        following = np.minimum(node + 1, len(self.t_ns) - 1)
        gap = np.maximum(self.t_ns[following] - self.t_ns[node], 1)
        return node, np.clip((t_ns - self.t_ns[node]) / gap, 0.0, 1.0)

    def at(self, t_ns: NDArray[np.int64]) -> Array:
        """Return the poses at some times, shape (m, 3)."""
        node, fraction = self.between(t_ns)
        following = np.minimum(node + 1, len(self.t_ns) - 1)
        part = fraction[:, np.newaxis]
        result: Array = (1 - part) * self.poses[node] + part * self.poses[following]
        return result


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Track:
    """One echo followed by one radar, and the still point that explains its ranges.

    Attributes
    ----------
    radar
        Mount index.
    rows
        Shape (m,), rows of the RangeSet.
    point_m, covariance_m2
        Shapes (2,) [m] and (2, 2) [m2], frame of the path; the radar's unknown offset is in
        the covariance.
    """

    radar: int
    rows: Indices
    point_m: Array
    covariance_m2: Array


def radar_poses(path: PathNodes, mounts: Array, t_ns: NDArray[np.int64]) -> Array:
    """Return where antennas were and looked: x, y [m], boresight [rad], shape (m, 3).

    Parameters
    ----------
    path
        The robot.
    mounts
        Shape (m, 3): x, y [m] and yaw [rad] of the radar asked for at each time, body frame.
    t_ns
        Shape (m,).
    """
    x, y, heading = path.at(t_ns).T
    cosine, sine = np.cos(heading), np.sin(heading)
    return np.column_stack(
        [
            x + cosine * mounts[:, 0] - sine * mounts[:, 1],
            y + sine * mounts[:, 0] + cosine * mounts[:, 1],
            heading + mounts[:, 2],
        ]
    )


def follow_all(ranges: RangeSet) -> tuple[tuple[int, Indices], ...]:
    """Follow echoes from frame to frame; return radar and rows of each that lasted."""
    return tuple(
        (radar, rows)
        for radar in np.unique(ranges.radar).tolist()
        for rows in _follow(ranges, np.flatnonzero(ranges.radar == radar))
        if len(rows) >= _LEAST_RANGES
    )


def _follow(ranges: RangeSet, rows: Indices) -> list[Indices]:
    """Return the rows of each followed echo of one radar, in time order."""
    stamps, first = np.unique(ranges.t_ns[rows], return_index=True)
    bounds = [*first.tolist(), len(rows)]
    finished: list[list[int]] = []
    live: list[_Following] = []
    for number in range(len(stamps)):
        frame = rows[bounds[number] : bounds[number + 1]]
        free = {int(row): float(ranges.range_m[row]) for row in frame}
        pairs = sorted(
            (abs(value - following.expected(number)), index, row)
            for index, following in enumerate(live)
            for row, value in free.items()
            if abs(value - following.expected(number)) <= following.gate_m(number)
        )
        taken: set[int] = set()
        for _, index, row in pairs:
            if index not in taken and row in free:
                live[index].take(number, row, free.pop(row))
                taken.add(index)
        finished += [f.rows for f in live if number - f.last > _MOST_MISSED]
        live = [f for f in live if number - f.last <= _MOST_MISSED]
        live += [_Following(number, row, value) for row, value in free.items()]
    finished += [f.rows for f in live]
    return [np.array(members, dtype=np.intp) for members in finished]


class _Following:
    """An echo being followed: its last range and how fast it changes per frame."""

    def __init__(self, number: int, row: int, range_m: float) -> None:
        self.rows = [row]
        self.last = number
        self._range_m = range_m
        self._rate_m = 0.0

    def expected(self, number: int) -> float:
        return self._range_m + self._rate_m * (number - self.last)

    def gate_m(self, number: int) -> float:
        # The rate of a young one is not known yet: a turn moves a range by 2 cm per frame.
        young = 2.0 if len(self.rows) < 3 else 1.0
        return _GATE_M * young * (number - self.last)

    def take(self, number: int, row: int, range_m: float) -> None:
        rate_m = (range_m - self._range_m) / (number - self.last)
        weight = 1.0 if len(self.rows) == 1 else _SMOOTHING
        self._rate_m += weight * (rate_m - self._rate_m)
        self._range_m, self.last = range_m, number
        self.rows.append(row)


def place(sights: Array, range_m: Array) -> tuple[Array, Array] | None:
    """Find the still point in front of a moving radar that explains its ranges.

    Parameters
    ----------
    sights
        Shape (m, 3): antenna x, y [m] and boresight [rad] at each range.
    range_m
        Shape (m,); all share one unknown offset, 30 mm (1 sigma).

    Returns
    -------
    Point, shape (2,), and covariance, shape (2, 2); None where no point fits, or where the motion
    leaves it open along an arc.
    """
    middle = len(range_m) // 2
    bearing = sights[middle, 2] + np.linspace(-HALF_VIEW_RAD, HALF_VIEW_RAD, 61)
    points = sights[middle, :2] + range_m[middle] * np.column_stack(
        [np.cos(bearing), np.sin(bearing)]
    )
    error = range_m - np.linalg.norm(points[:, np.newaxis] - sights[:, :2], axis=2)
    best = int(np.argmin(error.var(axis=1)))
    unknown = np.array([*points[best], 0.0])
    for _ in range(10):
        away = unknown[:2] - sights[:, :2]
        distance = np.maximum(np.linalg.norm(away, axis=1), 1e-3)
        jacobian = np.column_stack([away / distance[:, np.newaxis], np.ones(len(away))])
        residual = range_m - distance - unknown[2]
        # Huber's weights: a few ranges of a neighbour must not bend the point away
        weight = np.minimum(1.0, 2 * _TRACK_SIGMA_M / np.maximum(np.abs(residual), 1e-9))
        information = jacobian.T @ (weight[:, np.newaxis] * jacobian) / _TRACK_SIGMA_M**2
        gradient = jacobian.T @ (weight * residual) / _TRACK_SIGMA_M**2
        information[2, 2] += _OFFSET_SIGMA_M**-2
        gradient[2] -= unknown[2] * _OFFSET_SIGMA_M**-2
        # held back: a short track's arc is curved on the scale of a whole step
        information[[0, 1], [0, 1]] += 1.0
        unknown = unknown + np.linalg.solve(information, gradient)
    covariance: Array = np.linalg.inv(information)[:2, :2]
    away = unknown[:2] - sights[middle, :2]
    off_axis = float(wrap_angles(math.atan2(away[1], away[0]) - sights[middle, 2]))
    fits = float(np.median(np.abs(residual))) <= _MOST_RMS_M
    known = float(np.linalg.eigvalsh(covariance)[-1]) <= _MOST_SPREAD_M**2
    if not (fits and known and abs(off_axis) <= HALF_VIEW_RAD + 0.1):
        return None
    return unknown[:2], covariance

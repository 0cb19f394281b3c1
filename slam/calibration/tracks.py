"""Which range is of which reflector, before and while the offsets become known.

The track of one moving radar places a still reflector, up to the radar's unknown offset, so no two
radars need to agree before the offsets are known (20 mm between two turn a bearing by 5 degrees).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.frames import Detection
from slam.front_end.pulse import PulseModel
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

UNASSIGNED = -1

_SAME_REFLECTOR_M = 0.15
_KNOWN_REFLECTOR_M = 0.3
# A track placed worse than this joins a reflector but makes none.
_PLACED_M = 0.035
# Two tracks of one radar in the same frames are two reflectors.
_SHARED_FRAMES = 5
_LEAST_PER_RADAR = 12
_LEAST_ASSOCIATED_RANGES = 30
_LEAST_SHARE = 0.2

_HALF_VIEW_COS = math.cos(HALF_VIEW_RAD)
_PULSE_SIGMA_M = PulseModel().sigma_m
_MOST_BEND_M = 0.004
BEAM_EXPONENT = math.log(math.sqrt(0.5)) / math.log(math.cos(math.radians(65 / 2)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RangeSet:
    """All single ranges of a recording, in time order."""

    # Shape (n,): mount index and session time
    radar: Indices
    t_ns: NDArray[np.int64]
    # Shape (n,), true metres without any offset removed; sigma is NaN where the front end has none
    range_m: Array
    amplitude: Array
    sigma_m: Array

    @classmethod
    def of(cls, detections: Sequence[Detection]) -> RangeSet:
        ordered = sorted(detections, key=lambda d: (d.t_ns, d.radar, d.range_m))
        return cls(
            radar=np.array([d.radar for d in ordered], dtype=np.intp),
            t_ns=np.array([d.t_ns for d in ordered], dtype=np.int64),
            range_m=np.array([d.range_m for d in ordered], dtype=np.float64),
            amplitude=np.array([d.amplitude for d in ordered], dtype=np.float64),
            sigma_m=np.array([d.sigma_m for d in ordered], dtype=np.float64),
        )

    def __len__(self) -> int:
        return len(self.range_m)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PathNodes:
    """The robot's path as poses at some times; between two of them it is linear."""

    t_ns: NDArray[np.int64]  # shape (n,), ascending, int64
    # Shape (n, 3), x [m], y [m], heading [rad], continuous; odometry frame as measured, map frame
    # as estimated
    poses: Array

    def between(self, t_ns: NDArray[np.int64]) -> tuple[Indices, Array]:
        """Return the node before each time and the fraction on to the next; both shape (m,)."""
        node = np.searchsorted(self.t_ns, t_ns, side="right") - 1
        node = np.clip(node, 0, max(len(self.t_ns) - 2, 0)).astype(np.intp)
        following = np.minimum(node + 1, len(self.t_ns) - 1)
        gap = np.maximum(self.t_ns[following] - self.t_ns[node], 1)
        return node, np.clip((t_ns - self.t_ns[node]) / gap, 0.0, 1.0)

    def at(self, t_ns: NDArray[np.int64]) -> Array:
        node, fraction = self.between(t_ns)
        following = np.minimum(node + 1, len(self.t_ns) - 1)
        part = fraction[:, np.newaxis]
        return np.asarray((1 - part) * self.poses[node] + part * self.poses[following])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Track:
    """One echo followed by one radar, and the still point that explains its ranges."""

    radar: int  # mount index
    rows: Indices  # shape (m,), rows of the RangeSet
    # Shapes (2,) [m] and (2, 2) [m2], frame of the path; the radar's unknown offset is in the
    # covariance
    point_m: Array
    covariance_m2: Array


def radar_poses(path: PathNodes, mounts: Array, t_ns: NDArray[np.int64]) -> Array:
    """Return where antennas were and looked: x, y [m], boresight [rad], shape (m, 3).

    ``mounts`` (m, 3): x, y [m] and yaw [rad] of the radar asked for at each time, body frame.
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
    """Return the still point that explains the ranges of a moving radar, and its covariance.

    ``sights`` (m, 3): antenna x, y [m] and boresight [rad] at each range; the ranges (m,) share one
    unknown offset, 30 mm (1 sigma). None where no point fits, or where the motion leaves it open
    along an arc.
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


def group_tracks(
    tracks: Sequence[Track], ranges: RangeSet, known_m: Array
) -> tuple[Array, Indices]:
    """Gather tracks of one reflector, the best placed first.

    ``known_m`` (k, 2) are reflectors whose places are known; they are the first of the result.
    Returns landmarks, shape (n, 2), and for every range its landmark or UNASSIGNED, shape
    (n_ranges,).
    """
    points: list[Array] = [*known_m]
    members: list[list[Track]] = [[] for _ in points]
    for track in sorted(tracks, key=lambda t: float(np.trace(t.covariance_m2))):
        distances = [
            math.dist(point, track.point_m)
            if not any(_seen_together(track, other, ranges) for other in group)
            else math.inf
            for point, group in zip(points, members, strict=True)
        ]
        best = int(np.argmin(distances)) if distances else -1
        near_m = _KNOWN_REFLECTOR_M if best < len(known_m) else _SAME_REFLECTOR_M
        if distances and distances[best] <= near_m:
            members[best].append(track)
        elif float(np.linalg.eigvalsh(track.covariance_m2)[-1]) <= _PLACED_M**2:
            points.append(track.point_m)
            members.append([track])
    landmark = np.full(len(ranges), UNASSIGNED, dtype=np.intp)
    for index, group in enumerate(members):
        for track in group:
            landmark[track.rows] = index
    return np.array(points).reshape(-1, 2), landmark


def _seen_together(first: Track, second: Track, ranges: RangeSet) -> bool:
    if first.radar != second.radar:
        return False
    shared = np.intersect1d(ranges.t_ns[first.rows], ranges.t_ns[second.rows])
    return len(shared) >= _SHARED_FRAMES


def assign(
    ranges: RangeSet,
    sights: Array,
    offset_m: Array,
    landmarks_m: Array,
    *,
    gate_m: Array,
    strengths: Array,
) -> tuple[Indices, Array]:
    """Return the one landmark whose predicted range each range meets, or UNASSIGNED, shape (n,).

    A range is left alone where two landmarks would meet it, and where another echo overlaps so much
    that it bends the peak by more than 4 mm. A landmark takes one range per frame. ``sights`` (n,
    3): antenna x, y [m] and boresight [rad] at each range, map frame; ``offset_m`` and ``gate_m``
    (n,): the radar's offset and the largest difference; ``strengths`` (k,) of the landmarks.

    Also returned, (n,) [m]: the standard deviation that echoes of other landmarks add.
    """
    unassigned = np.full(len(ranges), UNASSIGNED, dtype=np.intp)
    if not len(landmarks_m) or not len(ranges):
        return unassigned, np.zeros(len(ranges))
    distance, cosine = _seen(sights, landmarks_m)
    visible = cosine > _HALF_VIEW_COS
    error = np.abs(distance + offset_m[:, np.newaxis] - ranges.range_m[:, np.newaxis])
    inside = visible & (error <= gate_m[:, np.newaxis])
    best = np.argmin(np.where(visible, error, np.inf), axis=1)
    bend_m = _bends(distance, strengths * echo_law(distance, cosine), best)
    rows = np.flatnonzero((inside.sum(axis=1) == 1) & (bend_m <= _MOST_BEND_M))
    # the nearest range of each frame, radar and landmark comes first in its group
    order = np.lexsort((error[rows, best[rows]], best[rows], ranges.radar[rows], ranges.t_ns[rows]))
    rows = rows[order]
    keys = np.column_stack([ranges.t_ns[rows], ranges.radar[rows], best[rows]])
    first = np.ones(len(rows), dtype=np.bool_)
    first[1:] = np.any(keys[1:] != keys[:-1], axis=1)
    unassigned[rows[first]] = best[rows[first]]
    return unassigned, bend_m


def echo_law(distance_m: Array, cosine: Array) -> Array:
    """Return the amplitude of an echo relative to boresight at 1 m, any shape.

    R^-1.75 lies between a long rod's 1.5 and a point's 2; the beam is the two-way cosine power
    whose -3 dB width is 65 degrees (paper, section Hardware).
    """
    beam = np.maximum(cosine, 0.0) ** BEAM_EXPONENT
    return np.asarray(beam * np.maximum(distance_m, 0.05) ** -1.75)


def strengths(ranges: RangeSet, sights: Array, landmarks_m: Array, landmark: Indices) -> Array:
    """Return the median amplitude of each landmark, reduced by `echo_law` to 1 m; 0 without any."""
    result = np.zeros(len(landmarks_m))
    for index in range(len(landmarks_m)):
        rows = np.flatnonzero(landmark == index)
        distance, cosine = _seen(sights[rows], landmarks_m[index : index + 1])
        law = echo_law(distance[:, 0], cosine[:, 0])
        if np.any(law > 0):
            result[index] = np.median(ranges.amplitude[rows][law > 0] / law[law > 0])
    return result


def _seen(sights: Array, landmarks_m: Array) -> tuple[Array, Array]:
    """Return distance and cosine off boresight of every landmark from every sight, (n, k)."""
    away_x = landmarks_m[:, 0] - sights[:, :1]
    away_y = landmarks_m[:, 1] - sights[:, 1:2]
    distance = np.maximum(np.hypot(away_x, away_y), 1e-6)
    ahead = away_x * np.cos(sights[:, 2:]) + away_y * np.sin(sights[:, 2:])
    return distance, ahead / distance


def _bends(distance: Array, amplitude: Array, own: Indices) -> Array:
    """Return by how much the other echoes move the peak of each own one, rms, shape (n,).

    Behind a matched filter, a neighbour of relative amplitude a at distance D moves the peak by
    a D exp(-D^2 / 4 s^2) times the cosine of its carrier's phase, to first order in a.
    """
    every = np.arange(len(own))
    apart = np.maximum(np.abs(distance - distance[every, own][:, np.newaxis]), _PULSE_SIGMA_M)
    relative = amplitude / np.maximum(amplitude[every, own][:, np.newaxis], 1e-12)
    move = relative * apart * np.exp(-(apart**2) / (4 * _PULSE_SIGMA_M**2))
    move[every, own] = 0.0
    return np.asarray(np.sqrt((move**2).sum(axis=1) / 2))


def well_seen(ranges: RangeSet, landmark: Indices, n_landmarks: int) -> NDArray[np.bool_]:
    """Return which landmarks have enough ranges to be trusted, shape (n_landmarks,).

    What only one radar saw, or few times, is as likely a misplaced piece of another echo.
    """
    n_radars = int(ranges.radar.max(initial=0)) + 1
    counts = np.zeros((n_landmarks, n_radars), dtype=np.intp)
    used = landmark != UNASSIGNED
    np.add.at(counts, (landmark[used], ranges.radar[used]), 1)
    total = counts.sum(axis=1)
    n_seeing = (counts >= _LEAST_PER_RADAR).sum(axis=1)
    usual = float(np.median(total[total > 0])) if used.any() else 0.0
    enough = max(_LEAST_ASSOCIATED_RANGES, _LEAST_SHARE * usual)
    return np.asarray((n_seeing >= min(2, n_radars)) & (total >= enough))


def covisible(ranges: RangeSet, landmark: Indices, first: int, second: int) -> int:
    """Return in how many frames of a radar both landmarks have a range."""
    frames = [
        set(zip(ranges.t_ns[rows].tolist(), ranges.radar[rows].tolist(), strict=True))
        for rows in (np.flatnonzero(landmark == index) for index in (first, second))
    ]
    return len(frames[0] & frames[1])

"""Which range belongs to which reflector, before and while the offsets become known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.calibration_tracks import HALF_VIEW_RAD, RangeSet, Track
from slam.pulse_model import PulseModel

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

UNASSIGNED = -1

_SAME_REFLECTOR_M = 0.15
_KNOWN_REFLECTOR_M = 0.3
# A track placed worse than this joins a reflector but makes none.
_PLACED_M = 0.035
# Two tracks of one radar in the same frames are two reflectors.
_SHARED_FRAMES = 5
_LEAST_PER_RADAR = 12
_LEAST_RANGES = 30
_LEAST_SHARE = 0.2

_HALF_VIEW_COS = math.cos(HALF_VIEW_RAD)
_PULSE_SIGMA_M = PulseModel().sigma_m
_MOST_BEND_M = 0.004
BEAM_EXPONENT = math.log(math.sqrt(0.5)) / math.log(math.cos(math.radians(65 / 2)))


def group_tracks(
    tracks: Sequence[Track], ranges: RangeSet, known_m: Array
) -> tuple[Array, Indices]:
    """Gather tracks of one reflector, the best placed first.

    Parameters
    ----------
    tracks
        What was followed.
    ranges
        The ranges the tracks are made of.
    known_m
        Shape (k, 2): reflectors whose places are known; they are the first of the result.

    Returns
    -------
    Landmarks, shape (n, 2), and for every range its landmark or UNASSIGNED, shape (n_ranges,).
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Assignment:
    """Which landmark each range belongs to, and what its neighbours do to it.

    Attributes
    ----------
    landmark
        Shape (n,): index, or UNASSIGNED.
    bend_m
        Shape (n,): standard deviation that echoes of other landmarks add.
    """

    landmark: Indices
    bend_m: Array


def assign(
    ranges: RangeSet,
    sights: Array,
    offset_m: Array,
    landmarks_m: Array,
    *,
    gate_m: Array,
    strengths: Array,
) -> Assignment:
    """Give each range the one landmark whose predicted range it meets.

    A range is left alone where two landmarks would meet it, and where another echo overlaps so
    much that it bends the peak by more than 4 mm. A landmark takes one range per frame.

    Parameters
    ----------
    ranges
        All ranges, n.
    sights
        Shape (n, 3): antenna x, y [m] and boresight [rad] at each range, map frame.
    offset_m
        Shape (n,): the range offset of each range's radar.
    landmarks_m
        Shape (k, 2), map frame.
    gate_m
        Shape (n,): largest difference.
    strengths
        Shape (k,): amplitude of each landmark's echo on boresight at 1 m, in any unit.
    """
    nobody = np.full(len(ranges), UNASSIGNED, dtype=np.intp)
    if not len(landmarks_m) or not len(ranges):
        return Assignment(landmark=nobody, bend_m=np.zeros(len(ranges)))
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
    landmark = nobody
    landmark[rows[first]] = best[rows[first]]
    return Assignment(landmark=landmark, bend_m=bend_m)


def echo_law(distance_m: Array, cosine: Array) -> Array:
    """Return the amplitude of an echo relative to boresight at 1 m, any shape.

    R^-1.75 lies between a long rod's 1.5 and a point's 2; the beam is the two-way cosine power
    whose -3 dB width is 65 degrees (paper, section Hardware).
    """
    result: Array = np.maximum(cosine, 0.0) ** BEAM_EXPONENT * np.maximum(distance_m, 0.05) ** -1.75
    return result


def strengths(ranges: RangeSet, sights: Array, landmarks_m: Array, landmark: Indices) -> Array:
    """Return how loud each landmark answers, reduced by `echo_law` to 1 m; shape (k,).

    The median over its ranges; 0 where it has none.
    """
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

    A matched filter turns Gaussian pulses of width s into ones of sqrt(2) s; a neighbour of
    relative amplitude a at distance D moves the peak by a D exp(-D^2 / 4 s^2) times the cosine of
    its carrier's phase, to first order in a. The phase turns by a whole turn in 2 cm of motion.
    """
    every = np.arange(len(own))
    apart = np.maximum(np.abs(distance - distance[every, own][:, np.newaxis]), _PULSE_SIGMA_M)
    relative = amplitude / np.maximum(amplitude[every, own][:, np.newaxis], 1e-12)
    move = relative * apart * np.exp(-(apart**2) / (4 * _PULSE_SIGMA_M**2))
    move[every, own] = 0.0
    result: Array = np.sqrt((move**2).sum(axis=1) / 2)
    return result


def well_seen(ranges: RangeSet, landmark: Indices, n_landmarks: int) -> NDArray[np.bool_]:
    """Tell which landmarks have enough ranges to be trusted, shape (n_landmarks,).

    Two radars (where there are two) must have followed it, and not much less often than others:
    what only one radar saw, or few times, is as likely a misplaced piece of another echo.
    """
    n_radars = int(ranges.radar.max(initial=0)) + 1
    counts = np.zeros((n_landmarks, n_radars), dtype=np.intp)
    used = landmark != UNASSIGNED
    np.add.at(counts, (landmark[used], ranges.radar[used]), 1)
    total = counts.sum(axis=1)
    n_seeing = (counts >= _LEAST_PER_RADAR).sum(axis=1)
    usual = float(np.median(total[total > 0])) if used.any() else 0.0
    enough = max(_LEAST_RANGES, _LEAST_SHARE * usual)
    result: NDArray[np.bool_] = (n_seeing >= min(2, n_radars)) & (total >= enough)
    return result


def covisible(ranges: RangeSet, landmark: Indices, first: int, second: int) -> int:
    """Return in how many frames of a radar both landmarks met a range."""
    frames = [
        set(zip(ranges.t_ns[rows].tolist(), ranges.radar[rows].tolist(), strict=True))
        for rows in (np.flatnonzero(landmark == index) for index in (first, second))
    ]
    return len(frames[0] & frames[1])

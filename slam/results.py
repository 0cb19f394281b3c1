"""What a SLAM pipeline reports of each step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapLandmark:
    """One landmark of the map: id, position (2,) [m], covariance (2, 2), frames that hit it."""

    landmark_id: int
    position_m: Array
    covariance: Array
    hits: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MapWall:
    """One wall of the map: the line n . x = d, n = [cos phi, sin phi], and its known parts.

    Attributes
    ----------
    hits
        The frames that hit it.
    phi_rad, d_m
        Direction of its normal, away from the robot, and distance along it from the origin.
    covariance
        shape (2, 2), of (phi, d), additive errors.
    spans_m
        shape (k, 2, 2): ends of the stretches that answered, map frame [m].
    """

    phi_rad: float
    d_m: float
    covariance: Array
    spans_m: Array
    hits: int


@dataclass(frozen=True, slots=True, kw_only=True)
class ExpectedRange:
    """A range that could have continued a track, as predicted before any was looked at.

    Attributes
    ----------
    radar, landmark_id
        Whose range of what.
    range_m, variance
        Prediction, and its variance [m^2] from pose, map and offsets; the noise of the range
        itself comes on top.
    antenna_m, point_m
        Body frame of the pose, x and y [m]: where the antenna was when it sampled, and where the
        landmark is believed to be.
    """

    radar: int
    landmark_id: int
    range_m: float
    variance: float
    antenna_m: tuple[float, float]
    point_m: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class UpdateReport:
    """What became of the ranges of one time.

    Attributes
    ----------
    continued
        (radar, index of the range in its scan, landmark id).
    born, seen_again
        Ids of landmarks that tracklets made, or were recognised as.
    merged
        (kept, gone) ids.
    deleted
        Ids.
    nis, dof
        Normalised innovation squared of the ranges that continued tracks, before Huber's weights,
        and its degrees of freedom.
    relinearised
        Whether all poses were solved for.
    expected
        Every range of a landmark, not of walls, that took part, measured or not.
    carried, lost, relocated
        Whether it was found now that the robot was carried away; whether its place on the map is
        unknown, so that pose and covariance say nothing but that; whether it was found again now.
    """

    continued: tuple[tuple[int, int, int], ...]
    born: tuple[int, ...]
    seen_again: tuple[int, ...]
    merged: tuple[tuple[int, int], ...]
    deleted: tuple[int, ...]
    nis: float
    dof: int
    relinearised: bool
    expected: tuple[ExpectedRange, ...] = ()
    carried: bool = False
    lost: bool = False
    relocated: bool = False

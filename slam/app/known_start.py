"""Where a landmark first is: from a pair's two ranges, or from many of one radar on the way."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from slam.app.known_ranges import KnownRange
from slam.geometry import Mount, Rig, mount_at, pair_of, transform
from slam.robust.ranges import fix_of_pair

Array = NDArray[np.float64]

ALONE_RANGES = 20
ALONE_SIGMA_M = 0.1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenFrom:
    """A range and where it was measured: step, and the antenna in the body frame of that step."""

    step: int
    known: KnownRange
    antenna: Mount


def first_position(rig: Rig, seen: Sequence[SeenFrom], poses: Sequence[Array]) -> Array | None:
    """Return a landmark's first position in the map frame, shape (2,), or None where it is early.

    Parameters
    ----------
    rig
        Tells which radars are pairs.
    seen
        All its ranges so far, those of the newest step last.
    poses
        The estimated pose of every step, shape (3,) each.
    """
    newest = {item.known.radar: item for item in seen if item.step == seen[-1].step}
    for pair in rig.pairs():
        if pair.first in newest and pair.second in newest:
            first, second = newest[pair.first], newest[pair.second]
            base = pair_of(pair.first, pair.second, (first.antenna, second.antenna))
            if base is None:
                continue
            point = fix_of_pair(
                np.array([first.antenna.x_m, first.antenna.y_m]),
                np.array([second.antenna.x_m, second.antenna.y_m]),
                first.known.range_m,
                second.known.range_m,
                base.ahead,
            )
            if point is not None:
                return transform(poses[first.step], point)
    if len(seen) < ALONE_RANGES or len(seen) % ALONE_RANGES:
        return None
    return _from_many(seen, poses)


def _from_many(seen: Sequence[SeenFrom], poses: Sequence[Array]) -> Array | None:
    """Return the least-squares point of many ranges if they tell it to ``ALONE_SIGMA_M``."""
    antennas = [mount_at(item.antenna, poses[item.step]) for item in seen]
    at = np.array([[antenna.x_m, antenna.y_m] for antenna in antennas])
    ranges = np.array([item.known.range_m for item in seen])
    sigmas = np.array([item.known.sigma_m for item in seen])
    middle = antennas[len(antennas) // 2]
    ahead = np.array([math.cos(middle.yaw_rad), math.sin(middle.yaw_rad)])
    start = at[len(at) // 2] + ranges[len(ranges) // 2] * ahead

    def residual(point: Array) -> Array:
        away = point - at
        return np.asarray((np.hypot(away[:, 0], away[:, 1]) - ranges) / sigmas)

    fit = least_squares(residual, start, method="lm")
    weakest = float(np.linalg.svd(np.asarray(fit.jac), compute_uv=False)[-1])
    if weakest * ALONE_SIGMA_M < 1.0 or (fit.x - at[len(at) // 2]) @ ahead <= 0.0:
        return None
    return np.asarray(fit.x)

"""Errors and consistency of single states, with the band that chi-square gives each."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from slam.app.session import Snapshot
from slam.geometry import between, compose, transform
from slam.metrics import nees_pose

POSE_DOF = 3
_FIX_DOF = 2
_ONE_STEP = 0.1
"""Metres and radians that odometry and estimate may differ by at the first state, if they began
together; a step is shorter than that."""
_TAIL = 0.025
"""On either side of a 95 % band."""


@lru_cache(maxsize=512)
def band_95(dof: int) -> tuple[float, float]:
    """Return the bounds between which 95 % of a chi-square of so many degrees of freedom lie.

    >>> [round(bound, 2) for bound in band_95(3)]
    [0.22, 9.35]
    """
    return float(chdtri(dof, 1.0 - _TAIL)), float(chdtri(dof, _TAIL))


def nis_dof(snapshot: Snapshot) -> int | None:
    """Return over how many degrees of freedom the state's NIS is spread; None if nobody told."""
    if not snapshot.nis_per_dof or snapshot.step is None:
        return None
    report = snapshot.step.report
    return _FIX_DOF * len(snapshot.nis_per_dof) if report is None else report.dof


def world_from_odom(first: Snapshot) -> NDArray[np.float64]:
    """Return where the odometry's frame lies in the world, shape (3,), from the first state.

    That of a demo begins with the map frame. A robot's begins anywhere, as it runs before we
    listen: it is placed so that both paths begin at one pose.
    """
    apart = between(first.estimate, first.odometry)
    if np.all(np.abs(apart) < _ONE_STEP):
        return first.world_from_map
    start = compose(first.world_from_map, first.estimate)
    return compose(start, between(first.odometry, np.zeros(3)))


def position_errors_m(snapshot: Snapshot, odom: NDArray[np.float64]) -> tuple[float, float]:
    """Return how far estimate and odometry are from the truth, not aligned; NaN without truth.

    ``odom`` is what `world_from_odom` said of the first state.
    """
    place, truth = snapshot.world_from_map, snapshot.truth[:2]
    return (
        float(np.linalg.norm(transform(place, snapshot.estimate[:2]) - truth)),
        float(np.linalg.norm(transform(odom, snapshot.odometry[:2]) - truth)),
    )


def pose_nees(snapshot: Snapshot) -> float:
    """Return the NEES of the pose in the start frame, 3 dof; NaN without truth or certainty."""
    if not np.isfinite(snapshot.truth).all():
        return math.nan
    truth: NDArray[np.float64] = between(snapshot.world_from_map, snapshot.truth)
    try:
        return nees_pose(snapshot.estimate, snapshot.pose_covariance, truth)
    except (ValueError, np.linalg.LinAlgError):  # singular at the very start: no statement
        return math.nan

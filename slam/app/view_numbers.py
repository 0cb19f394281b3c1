"""Errors and consistency of single states, with the band that chi-square gives each."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from slam.app.session import Snapshot
from slam.geometry import between, transform
from slam.metrics import nees_pose

POSE_DOF = 3
_FIX_DOF = 2
_TAIL = 0.025
"""On either side of a 95 % band."""


@lru_cache(maxsize=512)
def band_95(dof: int) -> tuple[float, float]:
    """Return the bounds between which 95 % of a chi-square of so many degrees of freedom lie.

    >>> [round(bound, 2) for bound in band_95(3)]
    [0.22, 9.35]
    """
    return float(chi2.ppf(_TAIL, dof)), float(chi2.ppf(1.0 - _TAIL, dof))


def nis_dof(snapshot: Snapshot) -> int | None:
    """Return over how many degrees of freedom the state's NIS is spread; None if nobody told."""
    if not snapshot.nis_per_dof or snapshot.step is None:
        return None
    report = snapshot.step.report
    return _FIX_DOF * len(snapshot.nis_per_dof) if report is None else report.dof


def position_errors_m(snapshot: Snapshot) -> tuple[float, float]:
    """Return how far estimate and odometry are from the truth, not aligned; NaN without truth."""
    place, truth = snapshot.world_from_map, snapshot.truth[:2]
    return (
        float(np.linalg.norm(transform(place, snapshot.estimate[:2]) - truth)),
        float(np.linalg.norm(transform(place, snapshot.odometry[:2]) - truth)),
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

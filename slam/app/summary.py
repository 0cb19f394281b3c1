"""What a run amounts to: the numbers of summary.json and the one table a person reads."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass


def ratio(error_m: float, odometry_error_m: float) -> float:
    """Return an error in units of odometry's; infinite where odometry is perfect.

    >>> ratio(0.5, 2.0), ratio(0.5, 0.0)
    (0.25, inf)
    """
    return error_m / odometry_error_m if odometry_error_m else math.inf


@dataclass(frozen=True, slots=True, kw_only=True)
class LandmarkSummary:
    """Landmarks against the truth, matched within 0.15 m after the trajectory's alignment."""

    true: int | None
    """None where nobody knows what stands there; so are precision, recall and rmse_m then."""
    estimated: int
    precision: float | None
    recall: float | None
    duplicates: int
    rmse_m: float | None
    """These three are None where there is nothing to divide by."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """The numbers of one run; field names are those of summary.json and a stable contract.

    `ate_rmse_m` is time-associated and SE(2)-aligned, of the filtered path; `ate_icp_rmse_m` is the
    paper's number, without time, and flatters; `final_error_m` is that of the last state, not
    aligned; `nees_pose` holds (time of the state [s], NEES) pairs of the unaligned pose in the
    start frame, of the last state at or before each of ten times; `nis_mean` is divided by its
    degrees of freedom.
    """

    scene: str
    preset: str
    seed: int | None
    """None on real modules."""
    frames: int
    duration_s: float
    realtime_factor: float
    ate_rmse_m: float
    ate_icp_rmse_m: float
    odometry_ate_rmse_m: float
    final_error_m: float
    landmarks: LandmarkSummary
    nees_pose: tuple[tuple[float, float], ...]
    nis_mean: float | None
    """None where nothing was associated."""
    nis_times: tuple[tuple[float, float, int], ...] = ()
    """(time of the state [s], summed NIS, degrees of freedom) of the last state at or before each
    of the ten times that has a true association; for groups of runs, not part of summary.json."""

    @property
    def ate_ratio(self) -> float:
        """SLAM's ATE in units of odometry's; below 1 is better than driving blind."""
        return ratio(self.ate_rmse_m, self.odometry_ate_rmse_m)

    def to_json(self) -> str:
        """Return the text of summary.json: exactly these fields, no NaN."""
        fields = asdict(self)
        del fields["nis_times"]
        return json.dumps(fields, indent=2, allow_nan=False)

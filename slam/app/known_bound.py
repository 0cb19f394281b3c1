"""The known-association bound of one run: what is possible with the true ids, on the same data."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec

from slam.app.errors import UsageError


@dataclass(frozen=True, slots=True, kw_only=True)
class BoundSummary:
    """Errors of GTSAM with true associations: ISAM2's filtered path, and the full smoother's.

    Attributes
    ----------
    filtered_ate_rmse_m, smoothed_ate_rmse_m
        Time-associated, SE(2)-aligned, like `ate_rmse_m`.
    nees_pose
        (Time [s], NEES) of the filtered pose at the ten times of the run's own `nees_pose`.
    """

    filtered_ate_rmse_m: float
    smoothed_ate_rmse_m: float
    nees_pose: tuple[tuple[float, float], ...]


def require_gtsam() -> None:
    """Raise UsageError, one line with the remedy, where GTSAM is not installed."""
    if find_spec("gtsam") is None:
        raise UsageError("--bound: GTSAM is missing; pip install 'xethru-hil[gtsam]'")

"""The known-association bound of one run: what is possible with the true ids, on the same data."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from emulator.scene import Scene
from slam.app.emulated_rig import rig_of, true_landmarks_m, wheels_of
from slam.app.evaluation import NEES_AT
from slam.app.gtsam_door import load_gtsam
from slam.app.known_association import PURPOSE, known_association_paths
from slam.app.runner import RunRecord
from slam.app.tum import NS_PER_S
from slam.config import BackEnd, SlamConfig
from slam.geometry import between
from slam.metrics import ate_rmse_m, nees_pose

_PAPER_RANGE_SIGMA_M = 7.4e-3
"""Of the paper's front end, which predicts none: 7.1 to 8.0 mm at 30 to 44 dB, whatever the SNR."""


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
    """Raise AppError, one line with the remedy, where GTSAM is not installed."""
    load_gtsam(PURPOSE)


def bound_of(record: RunRecord, scene: Scene, config: SlamConfig) -> BoundSummary:
    """Return the bound of a run that has a state.

    Told of rig, wheels and offsets is what SLAM was told; the truth tells whose each range is.

    Raises
    ------
    AppError
        GTSAM is not installed.
    """
    is_robust = config.back_end is BackEnd.ROBUST
    paths = known_association_paths(
        record,
        rig_of(scene),
        wheels_of(scene),
        true_landmarks_m(scene),
        range_sigma_m=config.robust.range_sigma_m if is_robust else _PAPER_RANGE_SIGMA_M,
        offset_sigma_m=config.robust.offset_sigma_m if is_robust else 0.0,
    )
    stamps_ns = np.array([result.t_ns for result in record.results])
    values = []
    for part in NEES_AT:
        t_ns = round(part * record.duration_ns)
        row = max(int(np.searchsorted(stamps_ns, t_ns, side="right")) - 1, 0)
        truth = between(record.world_from_map, record.truth[row])
        nees = nees_pose(paths.filtered[row], paths.filtered_covariance[row], truth)
        values.append((int(stamps_ns[row]) / NS_PER_S, nees))
    truth_xy = record.truth[:, :2]
    return BoundSummary(
        filtered_ate_rmse_m=ate_rmse_m(paths.filtered[:, :2], truth_xy),
        smoothed_ate_rmse_m=ate_rmse_m(paths.smoothed[:, :2], truth_xy),
        nees_pose=tuple(values),
    )

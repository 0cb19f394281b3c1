"""The numbers of one run, from its record and what is known about the world."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slam.app.runner import RunRecord
from slam.app.summary import LandmarkSummary, Summary
from slam.app.tum import NS_PER_S
from slam.consistency import TrueAssociationNis, true_range_nis
from slam.geometry import Rig, between
from slam.metrics import (
    align_se2,
    ate_rmse_m,
    icp_ate_rmse_m,
    landmark_metrics,
    nees_pose,
)
from slam.visibility import observable_landmarks

NEES_AT = (0.1, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.75, 0.9, 1.0)
"""Parts of the run at which consistency is judged; the quarters are the ends of four laps."""

_FIX_DOF = 2

Nis = tuple[float, int]
"""Summed NIS of one state's true associations, and its degrees of freedom."""


def summarise(
    record: RunRecord,
    *,
    scene: str,
    preset: str,
    seed: int | None,
    rig: Rig,
    true_landmarks_m: NDArray[np.float64],
) -> Summary | None:
    """Compute summary.json's numbers; None where the run was too short for any state.

    Parameters
    ----------
    record
        The run.
    scene, preset, seed
        Its names.
    rig
        What SLAM was told of the mounts; decides which true landmarks count.
    true_landmarks_m
        Shape (n, 2), world frame.
    """
    if not record.results:
        return None
    truth_xy = record.truth[:, :2]
    truth_in_map = np.array([between(record.world_from_map, pose) for pose in record.truth])
    estimate = np.array([result.belief.pose for result in record.results])
    odometry = np.array([result.odometry_pose for result in record.results])
    last = record.results[-1]
    alignment = align_se2(estimate[:, :2], truth_xy)
    counting = observable_landmarks(rig, record.truth, true_landmarks_m)
    score = landmark_metrics(last.belief.landmarks, true_landmarks_m[counting], alignment)
    nis = _true_nis(record, true_landmarks_m)
    return Summary(
        scene=scene,
        preset=preset,
        seed=seed,
        frames=record.n_frames,
        duration_s=record.duration_ns / NS_PER_S,
        realtime_factor=record.duration_ns / NS_PER_S / record.wall_s,
        ate_rmse_m=ate_rmse_m(estimate[:, :2], truth_xy),
        ate_icp_rmse_m=icp_ate_rmse_m(estimate[:, :2], truth_in_map[:, :2]),
        odometry_ate_rmse_m=ate_rmse_m(odometry[:, :2], truth_xy),
        final_error_m=float(np.linalg.norm(estimate[-1, :2] - truth_in_map[-1, :2])),
        landmarks=LandmarkSummary(
            true=score.true,
            estimated=score.estimated,
            precision=score.precision,
            recall=score.recall,
            duplicates=score.duplicates,
            rmse_m=score.rmse_m,
        ),
        nees_pose=_nees(record, truth_in_map),
        nis_mean=sum(value for value, _ in nis) / dof if (dof := sum(n for _, n in nis)) else None,
        nis_times=_nis_times(record, nis),
    )


def _nees(record: RunRecord, truth_in_map: NDArray[np.float64]) -> tuple[tuple[float, float], ...]:
    """Return (its time [s], its NEES) of the last state at or before each of the ten times."""
    stamps_ns = np.array([result.t_ns for result in record.results])
    values = []
    for part in NEES_AT:
        t_ns = record.start_ns + round(part * record.duration_ns)
        row = max(int(np.searchsorted(stamps_ns, t_ns, side="right")) - 1, 0)
        belief = record.results[row].belief
        nees = nees_pose(belief.pose, belief.pose_covariance, truth_in_map[row])
        values.append((int(stamps_ns[row]) / NS_PER_S, nees))
    return tuple(values)


def _true_nis(record: RunRecord, true_landmarks_m: NDArray[np.float64]) -> list[Nis]:
    """Return the NIS of each state's measurements of what they are truly of, before gates."""
    collector = TrueAssociationNis(true_landmarks_m)
    nis = []
    for result, truth in zip(record.results, record.truth, strict=True):
        if result.report is None:
            fixes = [value for value in collector.add(result, truth) if math.isfinite(value)]
            nis.append((sum(fixes), _FIX_DOF * len(fixes)))
        else:
            ranges = true_range_nis(result, truth, true_landmarks_m)
            nis.append((sum(ranges), len(ranges)))
    return nis


def _nis_times(record: RunRecord, nis: list[Nis]) -> tuple[tuple[float, float, int], ...]:
    """Return (time [s], NIS, dof) of the last state at or before each time that has any."""
    judged = [row for row, (_, dof) in enumerate(nis) if dof]
    if not judged:
        return ()
    stamps_ns = np.array([record.results[row].t_ns for row in judged])
    values = []
    for part in NEES_AT:
        t_ns = record.start_ns + round(part * record.duration_ns)
        place = max(int(np.searchsorted(stamps_ns, t_ns, side="right")) - 1, 0)
        values.append((int(stamps_ns[place]) / NS_PER_S, *nis[judged[place]]))
    return tuple(values)

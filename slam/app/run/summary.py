"""The numbers of one run, from its record and what is known about the world."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri

from slam.app.run.runner import RunRecord
from slam.geometry import Rig, align_se2, between, compose, transform
from slam.library.evaluation import (
    LandmarkScore,
    ate_rmse_m,
    icp_ate_rmse_m,
    landmark_metrics,
    nees_pose,
    observable_landmarks,
)
from slam.live.odometry_track import NS_PER_S
from slam.live.session_records import SessionInfo, Snapshot
from slam.results import SmoothedRun


def ratio(error_m: float, odometry_error_m: float) -> float:
    """Return an error in units of odometry's; infinite where odometry is perfect.

    >>> ratio(0.5, 2.0), ratio(0.5, 0.0)
    (0.25, inf)
    """
    return error_m / odometry_error_m if odometry_error_m else math.inf


@dataclass(frozen=True, slots=True, kw_only=True)
class Summary:
    """The numbers of one run; field names are those of summary.json and a stable contract.

    `ate_rmse_m` is time-associated and SE(2)-aligned, of the filtered path; `ate_icp_rmse_m` is the
    paper's number, without time, and flatters; `final_error_m` is that of the last state, not
    aligned; `nees_pose` holds (time of the state [s], NEES) pairs of the unaligned pose in the
    start frame, of the last state at or before each of ten times; `nis_mean` is divided by its
    degrees of freedom. `lagged_ate_rmse_m` is of the poses as known two metres of travel later,
    aligned by themselves; the last two metres, and the time in which the robot was lost, have none.
    Preset `paper`, and a run with fewer than ten lagged poses, have None. Smoothed numbers are of
    the solution over the whole run at its end, None where there is none; its landmarks are those of
    the last map, where the solution has them.
    """

    scene: str
    preset: str
    seed: int | None
    """None on real modules."""
    frames: int
    duration_s: float
    realtime_factor: float
    ate_rmse_m: float
    lagged_ate_rmse_m: float | None = None
    smoothed_ate_rmse_m: float | None = None
    ate_icp_rmse_m: float
    odometry_ate_rmse_m: float
    final_error_m: float
    landmarks: LandmarkScore
    smoothed_landmarks: LandmarkScore | None = None
    nees_pose: tuple[tuple[float, float], ...]
    smoothed_nees_pose: tuple[tuple[float, float], ...] | None = None
    nis_mean: float | None
    """None where nothing was associated."""
    nis_times: tuple[tuple[float, float, int], ...] = ()
    """(time of the state [s], summed NIS, degrees of freedom) of the last state at or before each
    of the ten times that has a true association; for groups of runs, not part of summary.json."""

    @property
    def ate_ratio(self) -> float:
        """SLAM's ATE in units of odometry's."""
        return ratio(self.ate_rmse_m, self.odometry_ate_rmse_m)

    @property
    def smoothed_ate_ratio(self) -> float | None:
        if self.smoothed_ate_rmse_m is None:
            return None
        return ratio(self.smoothed_ate_rmse_m, self.odometry_ate_rmse_m)

    def numbers(self) -> dict[str, object]:
        """Return what summary.json holds."""
        numbers = asdict(self)
        del numbers["nis_times"]
        return numbers


POSE_DOF = 3
_FIX_DOF = 2
_ONE_STEP = 0.1
"""Metres and radians that odometry and estimate may differ by at the first state, if they began
together; a step is shorter than that."""
_FEWEST_ALIGNED = 10
"""Lagged poses, of about a metre: the error of fewer would be aligned away."""
_TAIL = 0.025
"""On either side of a 95 % band."""


def bands_95(dof: ArrayLike) -> NDArray[np.float64]:
    """Return the bounds between which 95 % of a chi-square over its degrees of freedom lie.

    Of ``dof``, shape (n,), the bounds have shape (n, 2); NaN where it is NaN.

    >>> bands_95([3.0]).round(3)
    array([[0.072, 3.116]])
    """
    degrees = np.asarray(dof, dtype=np.float64)
    bounds = np.stack([chdtri(degrees, 1.0 - _TAIL), chdtri(degrees, _TAIL)], axis=-1)
    return np.asarray(bounds / degrees[:, None])


def world_from_odom(first: Snapshot) -> NDArray[np.float64]:
    """Return where the odometry's frame lies in the world, shape (3,), from the first state.

    That of a demo begins with the map frame. A robot's odometry starts before the run: it is
    placed so that both paths begin at one pose.
    """
    apart = between(first.estimate, first.odometry)
    if np.all(np.abs(apart) < _ONE_STEP):
        return first.world_from_map
    start = compose(first.world_from_map, first.estimate)
    return compose(start, between(first.odometry, np.zeros(3)))


class StateNumbers(NamedTuple):
    """Numbers over the states of a run, each of shape (n,); NaN where there is none.

    Errors are the position's distance to the truth, from the start pose, not aligned; the NIS is of
    the associations inside the gate together, the NEES of the pose in the start frame.
    """

    slam_error_m: NDArray[np.float64]
    odometry_error_m: NDArray[np.float64]
    nis_per_dof: NDArray[np.float64]
    nis_dof: NDArray[np.float64]
    nees_per_dof: NDArray[np.float64]
    n_landmarks: NDArray[np.float64]


def state_numbers(snapshot: Snapshot, odom: NDArray[np.float64]) -> tuple[float, ...]:
    """Return the `StateNumbers` of one state; `odom` is the `world_from_odom` of the first one."""
    place, truth = snapshot.world_from_map, snapshot.truth[:2]
    return (
        float(np.linalg.norm(transform(place, snapshot.estimate[:2]) - truth)),
        float(np.linalg.norm(transform(odom, snapshot.odometry[:2]) - truth)),
        float(np.mean(snapshot.nis_per_dof)) if snapshot.nis_per_dof else math.nan,
        _nis_dof(snapshot),
        _pose_nees(snapshot) / POSE_DOF,
        float(len(snapshot.landmark_ids)),
    )


def _nis_dof(snapshot: Snapshot) -> float:
    if not snapshot.nis_per_dof or snapshot.step is None:
        return math.nan
    report = snapshot.step.report
    dof = _FIX_DOF * len(snapshot.nis_per_dof) if report is None else report.dof
    return float(dof or math.nan)


def _pose_nees(snapshot: Snapshot) -> float:
    if not np.isfinite(snapshot.truth).all():
        return math.nan
    truth: NDArray[np.float64] = between(snapshot.world_from_map, snapshot.truth)
    try:
        return nees_pose(snapshot.estimate, snapshot.pose_covariance, truth)
    except (ValueError, np.linalg.LinAlgError):  # singular at the very start: no statement
        return math.nan


def smoothed_errors(
    smoothed: SmoothedRun, truth: NDArray[np.float64], world_from_map: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return distances to the truth, not aligned [m], and NEES over 3 of the poses, (n,) each.

    `truth` has shape (n, 3), world frame; NaN where it is unknown.
    """
    path = transform(world_from_map, smoothed.poses[:, :2])
    errors_m = np.asarray(np.linalg.norm(path - truth[:, :2], axis=1))
    nees = np.full(len(truth), np.nan)
    for row in np.flatnonzero(np.isfinite(truth).all(axis=1)).tolist():
        true_pose = between(world_from_map, truth[row])
        nees[row] = nees_pose(smoothed.poses[row], smoothed.pose_covariances[row], true_pose)
    return errors_m, nees / POSE_DOF


NEES_AT = (0.1, 0.25, 0.3, 0.4, 0.5, 0.6, 0.7, 0.75, 0.9, 1.0)
"""Parts of the run at which consistency is evaluated; the quarters are the ends of four laps."""


def summarise(record: RunRecord, info: SessionInfo, rig: Rig) -> Summary | None:
    """Compute summary.json's numbers; None if no state was estimated or the truth is unknown.

    `rig` holds the mounts that SLAM uses; they and the settings in `info` decide which true
    landmarks count in recall. Corners of walls and boxes count in precision, too.
    """
    states, last = record.states, record.last
    if last is None or not states.has_truth:
        return None
    true_landmarks_m = info.true_landmarks_m
    truth_xy = states.truth[:, :2]
    truth_in_map = np.array([between(record.world_from_map, pose) for pose in states.truth])
    estimate, odometry = states.estimate, states.odometry
    observable = observable_landmarks(rig, states.truth, true_landmarks_m, info.field_of_view)

    def score(landmarks_m: NDArray[np.float64], poses: NDArray[np.float64]) -> LandmarkScore:
        alignment = align_se2(poses[:, :2], truth_xy)
        score = landmark_metrics(
            landmarks_m, true_landmarks_m, alignment, observable, info.corners_m
        )
        if info.simulated or len(true_landmarks_m):
            return score
        return replace(score, true=None, observable=None, precision=None, recall=None)

    summary = Summary(
        scene=info.scene,
        preset=info.preset,
        seed=info.seed,
        frames=record.n_frames,
        duration_s=record.duration_ns / NS_PER_S,
        realtime_factor=record.duration_ns / NS_PER_S / record.wall_s,
        ate_rmse_m=ate_rmse_m(estimate[:, :2], truth_xy),
        lagged_ate_rmse_m=_lagged_ate_rmse_m(record),
        ate_icp_rmse_m=icp_ate_rmse_m(estimate[:, :2], truth_in_map[:, :2]),
        odometry_ate_rmse_m=ate_rmse_m(odometry[:, :2], truth_xy),
        final_error_m=float(np.linalg.norm(estimate[-1, :2] - truth_in_map[-1, :2])),
        landmarks=score(last.landmarks_m, estimate),
        nees_pose=nees_at_ten_times(record, truth_in_map, estimate, states.pose_covariances),
        nis_mean=sum(states.nis.tolist()) / dof if (dof := int(states.nis_dof.sum())) else None,
        nis_times=_nis_times(record),
    )
    if (smoothed := record.whole_smoothed) is None:
        return summary
    return replace(
        summary,
        smoothed_ate_rmse_m=ate_rmse_m(smoothed.poses[:, :2], truth_xy),
        smoothed_landmarks=score(smoothed.landmarks_m, smoothed.poses),
        smoothed_nees_pose=nees_at_ten_times(
            record, truth_in_map, smoothed.poses, smoothed.pose_covariances
        ),
    )


def _lagged_ate_rmse_m(record: RunRecord) -> float | None:
    """Return the ATE of the lagged poses; None if there are too few."""
    if len(record.lagged) < _FEWEST_ALIGNED:
        return None
    rows = np.searchsorted(record.states.t_ns, record.lagged_ns)
    return ate_rmse_m(record.lagged[:, :2], record.states.truth[rows, :2])


def nees_at_ten_times(
    record: RunRecord,
    truth_in_map: NDArray[np.float64],
    poses: NDArray[np.float64],
    covariances: NDArray[np.float64],
) -> tuple[tuple[float, float], ...]:
    """Return (time [s], NEES) of the last state at or before each of the ten times."""
    states = record.states
    values = []
    for row in _rows_at(record, range(len(states))):
        nees = nees_pose(poses[row], covariances[row], truth_in_map[row])
        values.append((int(states.t_ns[row]) / NS_PER_S, nees))
    return tuple(values)


def _rows_at(record: RunRecord, rows: Sequence[int]) -> list[int]:
    """Return of each of the ten times the last of these rows at or before it, or the first."""
    stamps_ns = record.states.t_ns[rows].tolist()
    times_ns = [record.start_ns + round(part * record.duration_ns) for part in NEES_AT]
    return [rows[max(bisect_right(stamps_ns, t_ns) - 1, 0)] for t_ns in times_ns]


def _nis_times(record: RunRecord) -> tuple[tuple[float, float, int], ...]:
    """Return (time [s], NIS, dof) of the last state at or before each time that has any."""
    states = record.states
    judged = np.flatnonzero(states.nis_dof).tolist()
    if not judged:
        return ()
    return tuple(
        (int(states.t_ns[row]) / NS_PER_S, float(states.nis[row]), int(states.nis_dof[row]))
        for row in _rows_at(record, judged)
    )

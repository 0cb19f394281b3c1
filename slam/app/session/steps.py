"""What led to a state of SLAM, as one row of float64 in the topic /slam/step.

The row of a step::

    n_detections, n_fixes, n_observations, n_rejected, n_continued, n_predicted, n_wall_spans,
    has_sigmas (0 or 1), has_report (0 or 1), next_id,
    nis, dof, carried (0 or 1), lost (0 or 1),
    n_detections times: radar, dt_ns, range, amplitude, phase, sigma, misfit, saturated (0 or 1),
        sigma that SLAM used (0 without has_sigmas),
    n_fixes times: pair, dt_ns, x, y, and which two of the detections it is of,
    n_observations times: x, y, n_poses, landmark id, is_new (0 or 1),
        n_candidates, n_own_fixes,
        n_candidates times: landmark id, squared Mahalanobis distance,
        n_own_fixes times: which of the fixes belongs to it,
    n_rejected times: which of the fixes,
    n_continued times: radar, index of the range in its scan, landmark id,
    n_predicted times: radar, landmark id, range, variance, antenna (2), point (2),
    n_wall_spans times: x, y of one end, x, y of the other

in the units and frames of `StepResult` and `Snapshot.wall_spans_m`; dt_ns is a time less that of
the state; what is counted by "which" counts from 0. The four numbers of the report are 0 without
one. The pose, the odometry and the map are in the row of the state.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from slam.app.records import Snapshot
from slam.frames import Detection
from slam.results import (
    LANDMARK_SIZE,
    POSE_SIZE,
    Association,
    Belief,
    Fix,
    Observation,
    PredictedRange,
    StepResult,
    UpdateReport,
    landmark_slice,
)

Array = NDArray[np.float64]
_T = TypeVar("_T")

_HEAD = 14
_DETECTION, _FIX, _OBSERVATION, _CONTINUED, _PREDICTED, _WALL_SPAN = 9, 6, 7, 3, 8, 4
_NO_REPORT = (0.0, 0.0, 0.0, 0.0)


def step_row(step: StepResult, wall_spans_m: Array) -> Array:
    """Return the row of a step, see the module.

    The fixes of an observation that are of other states are left out: they are in their own rows.

    Raises
    ------
    ValueError
        A fix was made of detections that the step lacks, or the step lacks a rejected fix.
    """
    report = step.report
    rows_of_detections = {id(detection): row for row, detection in enumerate(step.detections)}
    rows_of_fixes = {id(fix): row for row, fix in enumerate(step.fixes)}
    try:
        ranges_of_fixes = [
            [rows_of_detections[id(d)] for d in fix.detections] for fix in step.fixes
        ]
        rejected = [rows_of_fixes[id(fix)] for fix in step.rejected]
    except KeyError:
        raise ValueError(
            "a step whose fixes are not of its own ranges cannot be recorded"
        ) from None
    row: list[float] = [
        len(step.detections),
        len(step.fixes),
        len(step.observations),
        len(rejected),
        len(report.continued) if report else 0,
        len(report.predicted) if report else 0,
        len(wall_spans_m),
        bool(step.range_sigmas_m),
        report is not None,
        step.belief.next_id,
        *((report.nis, report.dof, report.carried, report.lost) if report else _NO_REPORT),
    ]
    used = step.range_sigmas_m or (0.0,) * len(step.detections)
    for one, used_m in zip(step.detections, used, strict=True):
        row += [one.radar, one.t_ns - step.t_ns, one.range_m, one.amplitude, one.phase_rad]
        row += [one.sigma_m, one.misfit, one.saturated, used_m]
    for fix, (first, second) in zip(step.fixes, ranges_of_fixes, strict=True):
        row += [fix.pair, fix.t_ns - step.t_ns, fix.x_m, fix.y_m, first, second]
    for seen, association in zip(step.observations, step.associations, strict=True):
        own = [rows_of_fixes[id(fix)] for fix in seen.fixes if id(fix) in rows_of_fixes]
        row += [seen.x_m, seen.y_m, seen.n_poses, association.landmark_id, association.is_new]
        row += [len(association.candidate_ids), len(own)]
        for id_, distance in zip(
            association.candidate_ids, association.mahalanobis_sq.tolist(), strict=True
        ):
            row += [id_, distance]
        row += own
    row += rejected
    if report:
        for continued in report.continued:
            row += continued
        for predicted in report.predicted:
            row += [predicted.radar, predicted.landmark_id, predicted.range_m, predicted.variance]
            row += [*predicted.antenna_m, *predicted.point_m]
    return np.concatenate([np.array(row, dtype=np.float64), np.ravel(wall_spans_m)])


def with_step(state: Snapshot, row: Array) -> Snapshot:
    """Return a recorded state with the step that a row holds, and its stretches of wall.

    What the session does not hold of the belief, the covariance between the pose and a landmark and
    between two landmarks, is NaN.

    Raises
    ------
    ValueError
        The row's length does not fit its counts, or it counts what is not there.
    """
    reader = _Reader(row)
    head = reader.take(_HEAD)
    counts = [_count(value) for value in head[:7]]
    n_detections, n_fixes, n_observations, n_rejected, n_continued, n_predicted, n_spans = counts
    has_sigmas, has_report, next_id = bool(head[7]), bool(head[8]), int(head[9])
    table = reader.table(n_detections, _DETECTION)
    detections = tuple(
        Detection(
            radar=int(radar),
            t_ns=state.t_ns + int(dt_ns),
            range_m=range_m,
            amplitude=amplitude,
            phase_rad=phase_rad,
            sigma_m=sigma_m,
            misfit=misfit,
            saturated=bool(saturated),
        )
        for radar, dt_ns, range_m, amplitude, phase_rad, sigma_m, misfit, saturated, _ in table
    )
    fixes = tuple(
        Fix(
            pair=int(pair),
            t_ns=state.t_ns + int(dt_ns),
            x_m=x_m,
            y_m=y_m,
            detections=(_nth(detections, first), _nth(detections, second)),
        )
        for pair, dt_ns, x_m, y_m, first, second in reader.table(n_fixes, _FIX)
    )
    observations, associations = [], []
    for _ in range(n_observations):
        x_m, y_m, n_poses, id_, is_new, n_candidates, n_own = reader.take(_OBSERVATION)
        candidates = reader.table(_count(n_candidates), 2)
        own = tuple(_nth(fixes, which) for which in reader.take(_count(n_own)))
        observations.append(Observation(x_m=x_m, y_m=y_m, n_poses=int(n_poses), fixes=own))
        associations.append(
            Association(
                landmark_id=int(id_),
                is_new=bool(is_new),
                mahalanobis_sq=np.array([distance for _, distance in candidates]),
                candidate_ids=tuple(int(candidate) for candidate, _ in candidates),
            )
        )
    rejected = tuple(_nth(fixes, which) for which in reader.take(n_rejected))
    continued = tuple(
        (int(radar), int(index), int(id_))
        for radar, index, id_ in reader.table(n_continued, _CONTINUED)
    )
    predicted = tuple(
        PredictedRange(
            radar=int(radar),
            landmark_id=int(id_),
            range_m=range_m,
            variance=variance,
            antenna_m=(antenna_x, antenna_y),
            point_m=(point_x, point_y),
        )
        for radar, id_, range_m, variance, antenna_x, antenna_y, point_x, point_y in reader.table(
            n_predicted, _PREDICTED
        )
    )
    spans_m = np.array(reader.table(n_spans, _WALL_SPAN)).reshape(-1, 2, 2)
    reader.end()
    nis, dof, carried, lost = head[10:]
    report = UpdateReport(
        continued=continued,
        nis=nis,
        dof=int(dof),
        predicted=predicted,
        carried=bool(carried),
        lost=bool(lost),
    )
    step = StepResult(
        t_ns=state.t_ns,
        odometry_pose=state.odometry,
        belief=_belief(state, next_id),
        detections=detections,
        fixes=fixes,
        observations=tuple(observations),
        associations=tuple(associations),
        rejected=rejected,
        report=report if has_report else None,
        range_sigmas_m=tuple(one[-1] for one in table) if has_sigmas else (),
    )
    return replace(state, step=step, wall_spans_m=spans_m)


def _belief(state: Snapshot, next_id: int) -> Belief:
    n_landmarks = len(state.landmark_ids)
    size = POSE_SIZE + LANDMARK_SIZE * n_landmarks
    covariance = np.full((size, size), np.nan)
    covariance[:POSE_SIZE, :POSE_SIZE] = state.pose_covariance
    for row in range(n_landmarks):
        block = landmark_slice(row)
        covariance[block, block] = state.landmark_covariances_m2[row]
    return Belief(
        mean=np.concatenate([state.estimate, state.landmarks_m.ravel()]),
        covariance=covariance,
        landmark_ids=tuple(state.landmark_ids.tolist()),
        next_id=next_id,
    )


class _Reader:
    """Takes a row apart from its beginning; ValueError where it is too short or too long."""

    def __init__(self, row: Array) -> None:
        self._values: list[float] = row.tolist()
        self._at = 0

    def take(self, count: int) -> list[float]:
        begin, self._at = self._at, self._at + count
        if self._at > len(self._values):
            raise ValueError(
                f"a step of {len(self._values)} numbers whose counts need {self._at} or more"
            )
        return self._values[begin : self._at]

    def table(self, n_rows: int, width: int) -> list[list[float]]:
        values = self.take(n_rows * width)
        return [values[begin : begin + width] for begin in range(0, len(values), width)]

    def end(self) -> None:
        if self._at != len(self._values):
            raise ValueError(f"a step of {len(self._values)} numbers whose counts need {self._at}")


def _count(value: float) -> int:
    if value < 0.0 or not value.is_integer():
        raise ValueError(f"a step counts {value:g} of something")
    return int(value)


def _nth(values: Sequence[_T], which: float) -> _T:
    index = _count(which)
    if index >= len(values):
        raise ValueError(f"a step names number {index} of {len(values)}")
    return values[index]

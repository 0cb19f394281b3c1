"""States of SLAM, what led to them and the smoothed run, each as one row of float64.

The row of a state, in the topic /slam/state::

    n_landmarks, n_nis,
    truth (3), odometry (3), estimate (3), world_from_map (3),
    pose_covariance (9, row by row),
    n_landmarks times: id, x, y, cov_xx, cov_xy, cov_yx, cov_yy,
    n_nis times: NIS per degree of freedom

in the units and frames of `Snapshot`; an unknown truth is NaN. The row of what led to it, in
/slam/step::

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
    n_wall_spans times: x, y of one end, x, y of the other,
    for each lagged pose: dt_ns, x, y, heading, covariance (9, row by row)

in the units and frames of `StepResult` and `Snapshot.wall_spans_m`; dt_ns is a time less that of
the state; what is counted by "which" counts from 0. The four numbers of the report are 0 without
one. The pose, the odometry and the map are in the row of the state.

The row of a smoothed run, in /slam/smoothed, at the time of its last state::

    n_states, n_landmarks,
    n_states times: dt_ns, x, y, heading, covariance (9, row by row),
    n_landmarks times: id, x, y, cov_xx, cov_xy, cov_yx, cov_yy

in the map frame; dt_ns is a time less that of the last state.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from operator import attrgetter
from typing import Any, TypeVar, get_type_hints

import numpy as np
from numpy.typing import NDArray

from slam.frames import Detection
from slam.live.session_records import Snapshot
from slam.results import (
    LANDMARK_SIZE,
    POSE_SIZE,
    Association,
    Belief,
    Fix,
    LaggedPose,
    Observation,
    PredictedRange,
    SmoothedRun,
    StepResult,
    UpdateReport,
    landmark_slice,
)

Array = NDArray[np.float64]
_T = TypeVar("_T")


class _Columns:
    """Fields of a dataclass as numbers, each in a column: two of a pair, a time less another."""

    def __init__(self, kind: type, *names: str) -> None:
        types = get_type_hints(kind)
        self._types = {name: types[name] for name in names}
        self._values_of = attrgetter(*names)
        self._time_at = names.index("t_ns") if "t_ns" in names else None
        self.width = sum(2 if self._is_pair(name) else 1 for name in names)

    def _is_pair(self, name: str) -> bool:
        return bool(self._types[name] == tuple[float, float])

    def numbers(self, one: object, t_ns: int = 0) -> list[float]:
        row = list(self._values_of(one))
        if self._time_at is not None:
            row[self._time_at] -= t_ns
        if self.width > len(row):
            row = [part for value in row for part in (value if type(value) is tuple else (value,))]
        return row

    def read(self, row: Iterator[float], t_ns: int = 0) -> dict[str, Any]:
        """Return the fields by their names; what follows them in the row is left there."""
        found: dict[str, Any] = {}
        for name, kind in self._types.items():
            found[name] = tuple(islice(row, 2)) if self._is_pair(name) else kind(next(row))
        if "t_ns" in found:
            found["t_ns"] += t_ns
        return found


_DETECTION = _Columns(
    Detection,
    *("radar", "t_ns", "range_m", "amplitude", "phase_rad", "sigma_m", "misfit", "saturated"),
)
_FIX = _Columns(Fix, "pair", "t_ns", "x_m", "y_m")
_OBSERVATION = _Columns(Observation, "x_m", "y_m", "n_poses")
_ASSOCIATION = _Columns(Association, "landmark_id", "is_new")
_PREDICTED = _Columns(
    PredictedRange, "radar", "landmark_id", "range_m", "variance", "antenna_m", "point_m"
)
_REPORT = _Columns(UpdateReport, "nis", "dof", "carried", "lost")
_N_COUNTS = 7
_LAGGED_WIDTH = 1 + POSE_SIZE + POSE_SIZE**2


class _RowReader:
    """Takes a row apart from its beginning; ValueError where it is too short or too long."""

    def __init__(self, row: Array) -> None:
        self._row, self._at = row, 0

    def take(self, *shape: int) -> Array:
        begin, self._at = self._at, self._at + math.prod(shape)
        if self._at > len(self._row):
            raise ValueError(f"{len(self._row)} numbers, whose counts need {self._at} or more")
        return self._row[begin : self._at].reshape(shape)

    def table(self, n_rows: int, width: int) -> Iterator[Iterator[float]]:
        return map(iter, self.take(n_rows, width).tolist())

    @property
    def n_left(self) -> int:
        return len(self._row) - self._at

    def counts(self, n: int) -> list[int]:
        return [_count(value) for value in self.take(n).tolist()]

    def end(self) -> None:
        if self._at != len(self._row):
            raise ValueError(f"{len(self._row)} numbers, whose counts need {self._at}")


def _count(value: float) -> int:
    if value < 0.0 or not value.is_integer():
        raise ValueError(f"{value:g} is given as a count")
    return int(value)


def _nth(values: Sequence[_T], which: float) -> _T:
    index = _count(which)
    if index >= len(values):
        raise ValueError(f"a step names number {index} of {len(values)}")
    return values[index]


def state_row(snapshot: Snapshot) -> Array:
    """Return the row of a state, shape (23 + 7 n_landmarks + n_nis,)."""
    parts = (
        [len(snapshot.landmark_ids), len(snapshot.nis_per_dof)],
        snapshot.truth,
        snapshot.odometry,
        snapshot.estimate,
        snapshot.world_from_map,
        snapshot.pose_covariance.ravel(),
        _landmark_rows(snapshot).ravel(),
        snapshot.nis_per_dof,
    )
    return np.concatenate([np.asarray(part, dtype=np.float64) for part in parts])


def snapshot_of(counter: int, t_ns: int, numbers: Array) -> Snapshot:
    """Return the state that a row holds; ValueError if its length does not fit its counts."""
    row = _RowReader(numbers)
    n_landmarks, n_nis = row.counts(2)
    state = Snapshot(
        counter=counter,
        t_ns=t_ns,
        truth=row.take(POSE_SIZE),
        odometry=row.take(POSE_SIZE),
        estimate=row.take(POSE_SIZE),
        world_from_map=row.take(POSE_SIZE),
        pose_covariance=row.take(POSE_SIZE, POSE_SIZE),
        **_landmarks(row, n_landmarks),
        nis_per_dof=tuple(row.take(n_nis).tolist()),
    )
    row.end()
    return state


def smoothed_row(smoothed: SmoothedRun) -> Array:
    """Return the row of a smoothed run, shape (2 + 13 n_states + 7 n_landmarks,)."""
    since_last_ns = smoothed.t_ns - smoothed.t_ns[-1]
    covariances = smoothed.pose_covariances.reshape(-1, 9)
    states = np.column_stack([since_last_ns, smoothed.poses, covariances])
    landmarks = _landmark_rows(smoothed)
    head = [float(len(states)), float(len(landmarks))]
    return np.concatenate([head, states.ravel(), landmarks.ravel()])


def smoothed_of(t_ns: int, numbers: Array) -> SmoothedRun:
    """Return the smoothed run that a row holds.

    Raises
    ------
    ValueError
        It has no state, its length does not fit its counts, or a number is not finite.
    """
    row = _RowReader(numbers)
    n_states, n_landmarks = row.counts(2)
    states = row.take(n_states, 1 + POSE_SIZE + POSE_SIZE**2)
    landmarks = _landmarks(row, n_landmarks)
    row.end()
    if not n_states or not np.isfinite(numbers).all():
        raise ValueError("a smoothed run without states, or with numbers that are not finite")
    return SmoothedRun(
        t_ns=t_ns + states[:, 0].astype(np.int64),
        poses=states[:, 1:4],
        pose_covariances=states[:, 4:].reshape(-1, POSE_SIZE, POSE_SIZE),
        **landmarks | {"landmark_ids": tuple(landmarks["landmark_ids"].tolist())},
    )


def _landmark_rows(of: Snapshot | SmoothedRun) -> Array:
    """Return id, place and covariance of each landmark, shape (n_landmarks, 7)."""
    return np.column_stack(
        [
            np.asarray(of.landmark_ids, dtype=np.float64),
            of.landmarks_m.reshape(-1, 2),
            of.landmark_covariances_m2.reshape(-1, 4),
        ]
    )


def _landmarks(row: _RowReader, n_landmarks: int) -> dict[str, Any]:
    """Return ids (n,), places (n, 2) [m] and covariances (n, 2, 2) [m^2], by their names."""
    rows = row.take(n_landmarks, 1 + LANDMARK_SIZE + LANDMARK_SIZE**2)
    return {
        "landmark_ids": rows[:, 0].astype(np.int64),
        "landmarks_m": rows[:, 1:3],
        "landmark_covariances_m2": rows[:, 3:].reshape(-1, LANDMARK_SIZE, LANDMARK_SIZE),
    }


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
    continued = report.continued if report else ()
    predicted = report.predicted if report else ()
    row: list[float] = [
        *map(len, (step.detections, step.fixes, step.observations, step.rejected)),
        *map(len, (continued, predicted, wall_spans_m)),
        bool(step.range_sigmas_m),
        report is not None,
        step.belief.next_id,
        *(_REPORT.numbers(report) if report else [0.0] * _REPORT.width),
    ]
    used = step.range_sigmas_m or (0.0,) * len(step.detections)
    for detection, used_m in zip(step.detections, used, strict=True):
        row += [*_DETECTION.numbers(detection, step.t_ns), used_m]
    try:
        for fix in step.fixes:
            row += _FIX.numbers(fix, step.t_ns)
            row += [rows_of_detections[id(one)] for one in fix.detections]
        for seen, association in zip(step.observations, step.associations, strict=True):
            own = [rows_of_fixes[id(fix)] for fix in seen.fixes if id(fix) in rows_of_fixes]
            row += _OBSERVATION.numbers(seen) + _ASSOCIATION.numbers(association)
            row += [len(association.candidate_ids), len(own)]
            distances = association.mahalanobis_sq.tolist()
            for candidate in zip(association.candidate_ids, distances, strict=True):
                row += candidate
            row += own
        row += [rows_of_fixes[id(fix)] for fix in step.rejected]
    except KeyError:
        raise ValueError(
            "a step whose fixes are not of its own ranges cannot be recorded"
        ) from None
    for ids in continued:
        row += ids
    for one in predicted:
        row += _PREDICTED.numbers(one)
    parts = [np.array(row, dtype=np.float64), np.ravel(wall_spans_m), lagged_row(step)]
    return np.concatenate(parts)


def lagged_row(step: StepResult) -> Array:
    """Return the end of the row of a step, its lagged poses, shape (13 k,)."""
    rows = [
        np.concatenate([[one.t_ns - step.t_ns], one.pose, one.covariance.ravel()])
        for one in step.lagged
    ]
    return np.concatenate([np.zeros(0), *rows])


def with_step(state: Snapshot, numbers: Array) -> Snapshot:
    """Return a recorded state with the step that a row holds, and its stretches of wall.

    What the session does not hold of the belief, the covariance between the pose and a landmark and
    between two landmarks, is NaN.

    Raises
    ------
    ValueError
        The row's length does not fit its counts, or it counts what is not there.
    """
    row = _RowReader(numbers)
    n_detections, n_fixes, n_observations, *others = row.counts(_N_COUNTS)
    n_rejected, n_continued, n_predicted, n_spans = others
    has_sigmas, has_report, next_id = row.take(3).tolist()
    report = _REPORT.read(iter(row.take(_REPORT.width).tolist()))
    detections, used_m = [], []
    for values in row.table(n_detections, _DETECTION.width + 1):
        detections.append(Detection(**_DETECTION.read(values, state.t_ns)))
        used_m.append(next(values))
    fixes = []
    for values in row.table(n_fixes, _FIX.width + 2):
        found = _FIX.read(values, state.t_ns)
        first, second = (_nth(detections, which) for which in values)
        fixes.append(Fix(**found, detections=(first, second)))
    observations, associations = [], []
    for _ in range(n_observations):
        values = iter(row.take(_OBSERVATION.width + _ASSOCIATION.width).tolist())
        seen, association = _OBSERVATION.read(values), _ASSOCIATION.read(values)
        n_candidates, n_own = row.counts(2)
        candidates = row.take(n_candidates, 2)
        own = tuple(_nth(fixes, which) for which in row.take(n_own).tolist())
        observations.append(Observation(**seen, fixes=own))
        associations.append(
            Association(
                **association,
                mahalanobis_sq=candidates[:, 1].copy(),
                candidate_ids=tuple(map(int, candidates[:, 0].tolist())),
            )
        )
    rejected = tuple(_nth(fixes, which) for which in row.take(n_rejected).tolist())
    continued = tuple((int(a), int(b), int(c)) for a, b, c in row.table(n_continued, 3))
    predicted = tuple(
        PredictedRange(**_PREDICTED.read(values))
        for values in row.table(n_predicted, _PREDICTED.width)
    )
    spans_m = row.take(n_spans, 2, 2).copy()
    lagged = row.take(row.n_left // _LAGGED_WIDTH, _LAGGED_WIDTH)
    row.end()
    step = StepResult(
        t_ns=state.t_ns,
        odometry_pose=state.odometry,
        belief=_belief(state, int(next_id)),
        detections=tuple(detections),
        fixes=tuple(fixes),
        observations=tuple(observations),
        associations=tuple(associations),
        rejected=rejected,
        report=UpdateReport(continued=continued, predicted=predicted, **report)
        if has_report
        else None,
        range_sigmas_m=tuple(used_m) if has_sigmas else (),
        lagged=tuple(
            LaggedPose(
                t_ns=state.t_ns + int(numbers[0]),
                pose=numbers[1:4],
                covariance=numbers[4:].reshape(POSE_SIZE, POSE_SIZE),
            )
            for numbers in lagged
        ),
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

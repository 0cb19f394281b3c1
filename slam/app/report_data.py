"""What a report tells, gathered while a session is replayed."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.app.link_lanes import LinkChange, LinkLanes
from slam.app.session import LogLine, Scan, SessionInfo, SessionObserver, Snapshot
from slam.app.tum import NS_PER_S
from slam.app.view_numbers import (
    POSE_DOF,
    nis_dof,
    pose_nees,
    position_errors_m,
    world_from_odom,
)

_KEPT_WARNINGS = 200


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ReportSeries:
    """Numbers over the states of a run, each of shape (n_states,); NaN where there is none.

    Attributes
    ----------
    t_s
        Time since the first scan [s].
    slam_error_m, odometry_error_m
        Distance of the position to the truth, from the start pose, not aligned.
    nis_per_dof, nis_dof
        Of the gated associations together.
    nees_per_dof
        Of the pose, over 3.
    n_landmarks
        Landmarks of the map.
    """

    t_s: NDArray[np.float64]
    slam_error_m: NDArray[np.float64]
    odometry_error_m: NDArray[np.float64]
    nis_per_dof: NDArray[np.float64]
    nis_dof: NDArray[np.float64]
    nees_per_dof: NDArray[np.float64]
    n_landmarks: NDArray[np.float64]


class ReportData(SessionObserver):
    """Observes a run, and keeps what its report shows.

    Attributes
    ----------
    lanes, changes
        The links, and every change of their states with its time since the first scan [s].
    warnings, n_warnings
        The first warnings of the log, and how many there were.
    start_ns, end_ns
        Session time of first and last scan; None and 0 before any.
    """

    def __init__(self, info: SessionInfo) -> None:
        self.lanes = LinkLanes(info.radars)
        self.changes: list[tuple[float, LinkChange]] = []
        self.warnings: list[LogLine] = []
        self.n_warnings = 0
        self.start_ns: int | None = None
        self.end_ns = 0
        self._rows: list[tuple[float, ...]] = []
        self._odom: NDArray[np.float64] | None = None

    @property
    def duration_s(self) -> float:
        """Time between first and last scan [s]."""
        return 0.0 if self.start_ns is None else (self.end_ns - self.start_ns) / NS_PER_S

    def seconds(self, t_ns: int) -> float:
        """Return a session time as time since the first scan; what was before it counts as 0."""
        return 0.0 if self.start_ns is None else max(t_ns - self.start_ns, 0) / NS_PER_S

    def on_scan(self, scan: Scan) -> None:
        """Follow the links."""
        if self.start_ns is None:
            self.start_ns = scan.t_ns
        self.end_ns = scan.t_ns
        self._note(self.lanes.on_scan(scan))

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Keep the numbers of a state."""
        if self._odom is None:
            self._odom = world_from_odom(snapshot)
        nis = float(np.mean(snapshot.nis_per_dof)) if snapshot.nis_per_dof else math.nan
        self._rows.append(
            (
                self.seconds(snapshot.t_ns),
                *position_errors_m(snapshot, self._odom),
                nis,
                float(nis_dof(snapshot) or math.nan),
                pose_nees(snapshot) / POSE_DOF,
                float(len(snapshot.landmark_ids)),
            )
        )

    def on_log(self, line: LogLine) -> None:
        """Follow the links, keep warnings."""
        self._note(self.lanes.on_log(line))
        if line.warning:
            self.n_warnings += 1
            if len(self.warnings) < _KEPT_WARNINGS:
                self.warnings.append(line)

    def close(self) -> None:
        """End the lanes."""
        self._note(self.lanes.end(self.end_ns))

    def series(self) -> ReportSeries:
        """Return the numbers over time."""
        table = np.array(self._rows, dtype=np.float64).reshape(-1, 7)
        return ReportSeries(
            t_s=table[:, 0],
            slam_error_m=table[:, 1],
            odometry_error_m=table[:, 2],
            nis_per_dof=table[:, 3],
            nis_dof=table[:, 4],
            nees_per_dof=table[:, 5],
            n_landmarks=table[:, 6],
        )

    def _note(self, changes: Iterable[LinkChange]) -> None:
        self.changes += [(self.seconds(change.t_ns), change) for change in changes]

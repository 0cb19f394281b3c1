"""Numbers over time in Rerun: errors, NIS and NEES with their 95 % bands, landmarks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from slam.app.rerun_recording import Recording, Stamps
from slam.app.rerun_sdk import rr
from slam.app.session import Snapshot
from slam.app.view_numbers import (
    POSE_DOF,
    band_95,
    nis_dof,
    pose_nees,
    position_errors_m,
    world_from_odom,
)
from slam.app.view_style import BAND_RGB, ESTIMATE_RGB, LANDMARK_RGB, ODOMETRY_RGB, Rgb

# Entity, name in the legend, colour, line width in points.
_SERIES: tuple[tuple[str, str, Rgb, float], ...] = (
    ("error/slam", "SLAM [m]", ESTIMATE_RGB, 2.0),
    ("error/odometry", "wheels [m]", ODOMETRY_RGB, 1.5),
    ("consistency/nis/value", "NIS / dof", ESTIMATE_RGB, 1.5),
    ("consistency/nis/low", "95 % band", BAND_RGB, 1.0),
    ("consistency/nis/high", "95 % band", BAND_RGB, 1.0),
    ("consistency/nees/value", "NEES / 3", ESTIMATE_RGB, 1.5),
    ("consistency/nees/low", "95 % band", BAND_RGB, 1.0),
    ("consistency/nees/high", "95 % band", BAND_RGB, 1.0),
    ("landmarks/count", "landmarks", LANDMARK_RGB, 2.0),
)


class NumberLayer:
    """Collects states, and sends what they amount to in blocks."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._rows: list[Snapshot] = []
        self._odom: NDArray[np.float64] | None = None
        self._stamps = Stamps.none()
        for entity, name, colour, width in _SERIES:
            line = rr.SeriesLines(
                colors=colour,
                names=name,
                widths=width,
                interpolation_mode=rr.components.InterpolationMode.StepAfter
                if entity == "landmarks/count"
                else None,
            )
            recording.static(entity, line)

    def on_snapshot(self, snapshot: Snapshot, host_ns: int | None) -> None:
        """Take a state of SLAM."""
        if self._odom is None:
            self._odom = world_from_odom(snapshot)
        self._rows.append(snapshot)
        self._stamps.add(snapshot.t_ns, snapshot.counter, host_ns)

    def send(self) -> None:
        """Send the states that wait."""
        rows, self._rows = self._rows, []
        stamps, self._stamps = self._stamps, Stamps.none()
        if not rows or self._odom is None:
            return
        errors_m = [position_errors_m(row, self._odom) for row in rows]
        self._send("error/slam", stamps, [slam_m for slam_m, _ in errors_m])
        self._send("error/odometry", stamps, [wheels_m for _, wheels_m in errors_m])
        self._send("landmarks/count", stamps, [float(len(row.landmark_ids)) for row in rows])
        means = [np.mean(row.nis_per_dof) if row.nis_per_dof else math.nan for row in rows]
        self._send("consistency/nis/value", stamps, [float(mean) for mean in means])
        nis_bands = [_band(nis_dof(row)) for row in rows]
        self._send("consistency/nis/low", stamps, [low for low, _ in nis_bands])
        self._send("consistency/nis/high", stamps, [high for _, high in nis_bands])
        nees = [pose_nees(row) / POSE_DOF for row in rows]
        self._send("consistency/nees/value", stamps, nees)
        low, high = _band(POSE_DOF)
        known = [math.isfinite(value) for value in nees]
        for name, bound in (("low", low), ("high", high)):
            self._send(
                f"consistency/nees/{name}", stamps, [bound if told else math.nan for told in known]
            )

    def _send(self, entity: str, stamps: Stamps, values: Sequence[float]) -> None:
        """Send a series; a value that is no number is left out."""
        told = [row for row, value in enumerate(values) if math.isfinite(value)]
        if told:
            scalars = np.array([values[row] for row in told])
            columns = rr.Scalars.columns(scalars=scalars)
            self._recording.rows(entity, stamps.at(told), columns)


def _band(dof: int | None) -> tuple[float, float]:
    """Return the 95 % band of a chi-square divided by its degrees of freedom."""
    if not dof:
        return math.nan, math.nan
    low, high = band_95(dof)
    return low / dof, high / dof

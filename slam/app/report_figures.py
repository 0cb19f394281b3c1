"""The figures of a report but the map: errors, consistency and links over time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from slam.app.link_lanes import LinkChange, LinkState
from slam.app.picture import ESTIMATE, LANDMARK, ODOMETRY, PALE_INK, label
from slam.app.report_data import ReportSeries
from slam.app.view_numbers import POSE_DOF, band_95

_BAND = "#dfe3e8"
_STATE_COLOURS = {
    LinkState.SETTING_UP: "#8a9bb8",
    LinkState.STREAMING: "#3d9a5f",
    LinkState.FRAMES_LOST: "#e0a030",
    LinkState.SILENT: "#8c5a2b",
    LinkState.FAULT: "#d03a3a",
}
_LANE = 0.7
"""Height of a lane; 1 is the distance of two."""
_TIME = "time since the first scan [s]"


def draw_errors(figure: Figure, series: ReportSeries) -> None:
    """Draw the position errors in mm, where the truth is known, and the number of landmarks."""
    has_truth = bool(np.isfinite(series.slam_error_m).any())
    panels = figure.subplots(2 if has_truth else 1, 1, sharex=True, squeeze=False).ravel()
    if has_truth:
        axes = panels[0]
        axes.plot(series.t_s, 1e3 * series.odometry_error_m, color=ODOMETRY, label="wheel odometry")
        axes.plot(series.t_s, 1e3 * series.slam_error_m, color=ESTIMATE, label="radar SLAM")
        label(axes, "Position error, from the start pose, not aligned", "", "[mm]")
        axes.set_ylim(bottom=0.0)
        axes.legend(frameon=False, loc="upper left")
    panels[-1].step(series.t_s, series.n_landmarks, color=LANDMARK, where="post")
    label(panels[-1], "Landmarks on the map", _TIME, "")
    panels[-1].set_ylim(bottom=0.0)
    panels[-1].yaxis.set_major_locator(MaxNLocator(integer=True))


def draw_consistency(figure: Figure, series: ReportSeries) -> None:
    """Draw NIS and NEES over their degrees of freedom, with the 95 % band of each state."""
    has_truth = bool(np.isfinite(series.nees_per_dof).any())
    panels = figure.subplots(2 if has_truth else 1, 1, sharex=True, squeeze=False).ravel()
    told = np.isfinite(series.nis_dof)
    bands = np.array([band_95(int(dof)) for dof in series.nis_dof[told]]).reshape(-1, 2)
    bands /= np.maximum(series.nis_dof[told], 1.0)[:, None]
    _draw_band(panels[0], series.t_s[told], bands)
    panels[0].plot(
        series.t_s, series.nis_per_dof, linestyle="none", marker=".", markersize=2, color=ESTIMATE
    )
    label(panels[0], "NIS of associations inside the gate / dof, 95 % band", "", "")
    _scale(panels[0], series.nis_per_dof)
    if has_truth:
        bound = np.array(band_95(POSE_DOF)) / POSE_DOF
        _draw_band(panels[1], series.t_s, np.tile(bound, (len(series.t_s), 1)))
        panels[1].plot(series.t_s, series.nees_per_dof, color=ESTIMATE, linewidth=1.0)
        label(panels[1], "NEES of the pose in the start frame / 3, 95 % band", "", "")
        _scale(panels[1], series.nees_per_dof)
    panels[-1].set_xlabel(_TIME)


def draw_links(
    figure: Figure, names: Sequence[str], changes: Sequence[tuple[float, LinkChange]], end_s: float
) -> None:
    """Draw a lane per radar, coloured by the state of its link."""
    axes = figure.add_subplot()
    for row, name in enumerate(names):
        own = [(at_s, change.state) for at_s, change in changes if change.radar == name]
        ends = [*(at_s for at_s, _ in own[1:]), end_s]
        for (start_s, state), stop_s in zip(own, ends, strict=True):
            if state in _STATE_COLOURS:
                # The shortest state, one lost frame, must stay visible.
                width_s = max(stop_s - start_s, 0.002 * end_s)
                place, height = [(start_s, width_s)], (row - _LANE / 2, _LANE)
                axes.broken_barh(place, height, facecolors=_STATE_COLOURS[state])
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlim(0.0, max(end_s, 1e-3))
    label(axes, "State of each link", _TIME, "")
    axes.grid(visible=False)
    shown = {change.state for _, change in changes}
    for state, colour in _STATE_COLOURS.items():
        if state in shown:
            axes.plot([], [], linewidth=6, color=colour, label=str(state))
    figure.legend(loc="outside right upper", frameon=False, handlelength=1.0)


def _draw_band(axes: Axes, t_s: NDArray[np.float64], bounds: NDArray[np.float64]) -> None:
    axes.fill_between(t_s, bounds[:, 0], bounds[:, 1], color=_BAND, linewidth=0.0)
    axes.axhline(1.0, color=PALE_INK, linewidth=0.6)


def _scale(axes: Axes, values: NDArray[np.float64]) -> None:
    """Show what is usual; single values far above would flatten everything else."""
    known = values[np.isfinite(values)]
    if len(known):
        axes.set_ylim(0.0, max(4.0, 1.2 * float(np.percentile(known, 99))))

"""Draws the experiment `smoke`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from slam.app.experiments.smoke_runs import ObservedRun
from slam.app.picture import ESTIMATE, INK, LANDMARK, ODOMETRY, TRUTH, label, picture
from slam.app.report_table import mm_text

_SHOWN = ("clear air", "smoke", "lab, clear air")


def draw_smoke(path: Path, runs: Sequence[ObservedRun], *, seed: int) -> None:
    """Draw raw observations above filtered ones, run by run, on odometry poses; a PNG file."""
    shown = [run for run in runs if run.name in _SHOWN]
    with picture(path, width_in=10.4, height_in=7.4) as figure:
        figure.suptitle(
            "Observations on wheel-odometry poses, before and after the paper's DBSCAN filter "
            f"(simulated, seed {seed})",
            fontsize=11,
            color=INK,
            x=0.01,
            ha="left",
        )
        panels = figure.subplots(2, len(shown), sharex="col", sharey="col")
        for column, run in zip(panels.T, shown, strict=True):
            for axes, points, colour, what, error_m in (
                (column[0], run.raw_m, ESTIMATE, "raw", run.raw_rms_m),
                (column[1], run.filtered_m, LANDMARK, "filtered", run.filtered_rms_m),
            ):
                _draw(axes, run, points, colour)
                label(
                    axes,
                    f"{run.name}: {len(points)} {what}, {mm_text(error_m)} off",
                    "x [m]" if axes is column[1] else "",
                    "y [m]" if run is shown[0] else "",
                )
        handles = [*panels[0, 0].get_legend_handles_labels()[0]]
        handles.append(panels[1, 0].get_lines()[-1])
        figure.legend(
            handles,
            ["wheel odometry", "true path", "true landmark", "raw fix", "filtered observation"],
            loc="outside lower center",
            ncols=5,
            frameon=False,
            title="off: root mean square distance to the nearest landmark, seen from the true pose",
            title_fontsize=9,
        )


def _draw(axes: Axes, run: ObservedRun, points: NDArray[np.float64], colour: str) -> None:
    axes.set_aspect("equal", adjustable="box")
    axes.plot(*run.odometry_m.T, color=ODOMETRY, linewidth=0.8, label="odometry")
    axes.plot(*run.truth_m.T, color=TRUTH, linewidth=2.4, alpha=0.5, label="truth")
    axes.plot(
        *run.landmarks_m.T,
        linestyle="none",
        marker="+",
        markersize=12,
        markeredgewidth=1.4,
        color=INK,
        zorder=4,
        label="landmark",
    )
    axes.plot(
        *points.T,
        linestyle="none",
        marker=".",
        markersize=3.0,
        alpha=0.5,
        color=colour,
        label="seen",
    )

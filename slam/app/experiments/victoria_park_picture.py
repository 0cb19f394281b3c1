"""Draws the experiment `victoria-park`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from slam.app.experiments.victoria_park_scores import PathScore, odometry_path
from slam.app.picture import ESTIMATE, INK, LANDMARK, ODOMETRY, TRUTH, label, picture
from slam.app.victoria_park import Drive
from slam.app.victoria_park_runs import ParkRun, Reference

_ISAM = "#2f9e44"
_MAPS = ("true ids", "unknown ids")


def draw_park(
    path: Path,
    drive: Drive,
    reference: Reference,
    runs: Mapping[str, ParkRun],
    rows: Sequence[PathScore],
) -> None:
    """Draw one map per run beside the batch solution, and distances to it below; a PNG file."""
    odometry = odometry_path(drive)
    ate = {row.name: row.ate_m for row in rows}
    with picture(path, width_in=11.0, height_in=9.2) as figure:
        figure.suptitle(
            "Victoria Park (real data): causal paths of the robust back end "
            "against GTSAM's batch solution",
            fontsize=11,
            color=INK,
            x=0.01,
            ha="left",
        )
        grid = figure.add_gridspec(2, 2, height_ratios=(2.4, 1.0))
        for column, name in enumerate(_MAPS):
            run = runs[name]
            axes = figure.add_subplot(grid[0, column])
            _map(axes, odometry, reference, run)
            label(
                axes,
                f"{name}: {len(run.landmarks_m)} landmarks for {len(reference.labels)} trees, "
                f"ATE {ate[f'robust, {name}']:.2f} m",
                "x [m]",
                "y [m]",
            )
            if column == 0:
                axes.legend(loc="lower left", fontsize=8, frameon=False)
        axes = figure.add_subplot(grid[1, :])
        gone_m = np.concatenate(
            [[0.0], np.cumsum(np.hypot(*np.diff(reference.poses[:, :2], axis=0).T))]
        )
        paths = {"ISAM2, true ids": reference.causal} | {
            f"robust, {name}": runs[name].poses for name in _MAPS
        }
        for (name, poses), colour in zip(paths.items(), (_ISAM, ESTIMATE, LANDMARK), strict=True):
            away = np.hypot(*(poses - reference.poses)[:, :2].T)
            axes.semilogy(gone_m, np.maximum(away, 1e-3), color=colour, linewidth=0.9, label=name)
        axes.set_ylim(1e-2, None)
        axes.legend(loc="lower right", fontsize=8, frameon=False, ncols=3)
        label(
            axes,
            "distance to the batch solution, not aligned (batch also knows what came later)",
            "distance driven [m]",
            "distance [m]",
        )


def _map(axes: Axes, odometry: np.ndarray, reference: Reference, run: ParkRun) -> None:
    axes.set_aspect("equal", adjustable="datalim")
    axes.plot(*odometry[:, :2].T, color=ODOMETRY, linewidth=0.6, alpha=0.8, label="odometry")
    axes.plot(
        *reference.poses[:, :2].T, color=TRUTH, linewidth=2.6, alpha=0.6, label="batch, true ids"
    )
    axes.plot(*run.poses[:, :2].T, color=ESTIMATE, linewidth=0.9, label="causal path")
    axes.plot(
        *reference.landmarks_m.T,
        linestyle="none",
        marker="o",
        markersize=5,
        markerfacecolor="none",
        color=INK,
        markeredgewidth=0.7,
        label="tree, batch",
    )
    axes.plot(
        *run.landmarks_m.T,
        linestyle="none",
        marker="x",
        markersize=4,
        color=LANDMARK,
        label="landmark",
    )

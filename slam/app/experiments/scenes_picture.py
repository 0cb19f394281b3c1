"""Draws the experiment `scenes`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullLocator

from slam.app.experiments.stress_picture import draw_consistency, legend_below
from slam.app.picture import ESTIMATE, GRID, INK, LANDMARK, ODOMETRY, label, picture
from slam.app.sweep_groups import group_name


def draw_scenes(path: Path, groups: Sequence[dict[str, Any]]) -> None:
    """Draw the errors of wheels and SLAM beside the consistency, a row per group; a PNG."""
    names = [group_name(group) for group in groups]
    with picture(path, width_in=10.4, height_in=1.6 + 0.34 * len(groups)) as figure:
        figure.suptitle(
            "Clean runs, a row per scene and preset (simulated)",
            fontsize=11,
            color=INK,
            x=0.01,
            ha="left",
        )
        errors, consistency = figure.subplots(1, 2)
        _draw_errors(errors, groups, names)
        draw_consistency(consistency, groups, [""] * len(groups))
        legend_below(figure, errors, consistency)


def _draw_errors(axes: Axes, groups: Sequence[dict[str, Any]], names: Sequence[str]) -> None:
    places = range(len(groups))
    medians_mm = [
        [1e3 * group[key]["median"] for group in groups]
        for key in ("odometry_ate_rmse_m", "ate_rmse_m")
    ]
    axes.hlines(places, medians_mm[1], medians_mm[0], color=GRID, linewidth=3, zorder=1)
    p90_mm = [1e3 * group["ate_rmse_m"]["p90"] for group in groups]
    for values, marker, colour, text in (
        (medians_mm[0], "s", ODOMETRY, "wheels, median"),
        (medians_mm[1], "o", ESTIMATE, "SLAM, median"),
        (p90_mm, "D", LANDMARK, "SLAM, p90"),
    ):
        axes.plot(
            values, places, linestyle="none", marker=marker, markersize=6, color=colour, label=text
        )
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_locator(NullLocator())
    label(axes, "absolute trajectory error", "mm", "")
    axes.set_yticks(places, names)
    axes.set_ylim(len(groups) - 0.5, -0.5)

"""Draws the experiment `stress`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from slam.app.picture import ESTIMATE, GRID, INK, LANDMARK, PALE_INK, label, picture
from slam.app.sweep_groups import group_name
from slam.app.sweep_tables import times_clean

TARGETS = {
    **dict.fromkeys(("outliers", "dropped", "skew", "walk", "silent"), 1.5),
    "all": 2.5,
    "dead": 2.0,
    "offsets": 2.0,
}
"""How many times the clean error each hardship may cost."""

_MOST_NEES = 100.0
"""What is above is an arrow at the edge."""


def draw_stress(
    path: Path, tables: Sequence[tuple[dict[str, Any], Sequence[dict[str, Any]]]]
) -> None:
    """Draw the error in units of the clean one beside the consistency, a row per table; a PNG."""
    rows = max(len(groups) for _, groups in tables)
    height_in = 0.9 + (1.1 + 0.3 * rows) * len(tables)
    with picture(path, width_in=10.4, height_in=height_in) as figure:
        figure.suptitle(
            "What each hardship costs, on equal seeds (simulated)",
            fontsize=11,
            color=INK,
            x=0.01,
            ha="left",
        )
        panels = figure.subplots(len(tables), 2, squeeze=False, sharex="col")
        for (errors, consistency), (clean, groups) in zip(panels, tables, strict=True):
            _draw_errors(errors, clean, groups)
            draw_consistency(consistency, groups, [group["stress"] for group in groups])
        legend_below(figure, panels[0, 0], panels[0, 1])


def _draw_errors(axes: Axes, clean: dict[str, Any], groups: Sequence[dict[str, Any]]) -> None:
    places = range(len(groups))
    for statistic, marker, colour in (("median", "o", ESTIMATE), ("p90", "D", LANDMARK)):
        axes.plot(
            [times_clean(group, clean, statistic) for group in groups],
            places,
            linestyle="none",
            marker=marker,
            markersize=6,
            color=colour,
            label=statistic,
        )
    limits = [
        (TARGETS[g["stress"]], y)
        for y, g in zip(places, groups, strict=True)
        if g["stress"] in TARGETS
    ]
    axes.plot(
        [x for x, _ in limits],
        [y for _, y in limits],
        linestyle="none",
        marker="|",
        markersize=16,
        markeredgewidth=1.6,
        color=PALE_INK,
        label="target of the median",
    )
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_locator(NullLocator())
    median = 1e3 * clean["ate_rmse_m"]["median"]
    label(
        axes,
        f"{group_name(clean)}, {clean['runs']} seeds: clean median {median:.1f} mm",
        "ATE in units of the clean runs'",
        "",
    )
    axes.set_yticks(places, [group["stress"] for group in groups])
    axes.set_ylim(len(groups) - 0.5, -0.5)


def draw_consistency(axes: Axes, groups: Sequence[dict[str, Any]], names: Sequence[str]) -> None:
    """Draw the ten ANEES of each group in a row of its own, over the band of its seeds."""
    bands = [group["anees_band_95"] for group in groups]
    lows = [low for low, _ in bands]
    widths = [high - low for low, high in bands]
    axes.barh(range(len(groups)), widths, left=lows, color=GRID, zorder=0, label="95 % band")
    for place, group in enumerate(groups):
        values = [value for _, value in group["anees_pose"]]
        for marker, shown in (
            ("o", [value for value in values if value <= _MOST_NEES]),
            (">", [_MOST_NEES for value in values if value > _MOST_NEES]),
        ):
            axes.plot(
                shown,
                [place] * len(shown),
                linestyle="none",
                marker=marker,
                markersize=4,
                alpha=0.7,
                color=ESTIMATE,
                label="ANEES at one of ten times" if place == 0 and marker == "o" else None,
            )
    every = [value for group in groups for _, value in group["anees_pose"]]
    axes.set_xlim(0.7 * min(*lows, *every), 1.2 * _MOST_NEES)
    axes.set_xscale("log")
    label(axes, "consistency", "mean NEES of the pose (3 dof)", "")
    axes.set_yticks(range(len(groups)), names)
    axes.set_ylim(len(groups) - 0.5, -0.5)


def legend_below(figure: Figure, *panels: Axes) -> None:
    """Put what the panels show below all of them."""
    handles = [handle for axes in panels for handle in axes.get_legend_handles_labels()[0]]
    names = [name for axes in panels for name in axes.get_legend_handles_labels()[1]]
    figure.legend(handles, names, loc="outside lower center", ncols=5, frameon=False)

"""Whether SLAM is as sure as it may be: mean NEES and NIS over seeds at ten times of the run."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from slam.app.experiments import Result
from slam.app.experiments.stress import clean_groups
from slam.app.run.pictures import ESTIMATE, GRID, LANDMARK, ODOMETRY, TRUTH, label
from slam.app.sweep.statistics import group_name, in_band, nis_in_band
from xethru_protocol.system import StopFlag

_COLOURS = (ESTIMATE, ODOMETRY, LANDMARK, "#2b8a3e", "#7048b8")


def _draw(figure: Figure, groups: Sequence[dict[str, Any]], scenes: Sequence[str]) -> None:
    """Draw ANEES above NIS, a column per scene and a line per preset and setting."""
    panels = figure.subplots(2, len(scenes), squeeze=False, sharex="col", sharey="row")
    for column, scene in zip(panels.T, scenes, strict=True):
        of_scene = [group for group in groups if group["scene"] == scene]
        _draw_anees(column[0], of_scene)
        _draw_nis(column[1], of_scene)
        seeds = "/".join(str(n) for n in dict.fromkeys(group["runs"] for group in of_scene))
        label(column[0], f"{scene}, {seeds} seeds: NEES of the pose, 3 dof", "", "ANEES")
        label(column[1], "NIS of true associations, per dof", "time [s]", "mean NIS / dof")
        column[0].legend(frameon=False, fontsize=8)


def _draw_anees(axes: Axes, groups: Sequence[dict[str, Any]]) -> None:
    axes.set_yscale("log")
    for group, colour in zip(groups, _colours(groups), strict=True):
        axes.axhspan(*group["anees_band_95"], color=GRID, zorder=0)
        _line(axes, group["anees_pose"], colour, _name(group))
    for group in groups:
        if group["bound"] is not None:
            _line(axes, group["bound"]["anees_pose"], TRUTH, "known association, ISAM2")
            return  # the same data in every preset


def _draw_nis(axes: Axes, groups: Sequence[dict[str, Any]]) -> None:
    axes.set_yscale("log")
    axes.axhline(1.0, color=TRUTH, linewidth=0.8)
    for group, colour in zip(groups, _colours(groups), strict=True):
        known = [row for row in group["nis_times"] if row[1] is not None]
        times, means, lows, highs = zip(*known, strict=True) if known else ((), (), (), ())
        axes.fill_between(times, lows, highs, color=colour, alpha=0.15, linewidth=0)
        _line(axes, list(zip(times, means, strict=True)), colour, _name(group))


def _line(axes: Axes, rows: Sequence[Sequence[float]], colour: str, name: str) -> None:
    times, values = ([row[column] for row in rows] for column in (0, 1))
    axes.plot(times, values, marker="o", markersize=4, linewidth=1.4, color=colour, label=name)


def _colours(groups: Sequence[dict[str, Any]]) -> list[str]:
    return [_COLOURS[index % len(_COLOURS)] for index in range(len(groups))]


def _name(group: dict[str, Any]) -> str:
    settings = "".join(f", {key}={value}" for key, value in group["settings"].items())
    return f"preset {group['preset']}{settings}"


def run(arguments: argparse.Namespace, stop: StopFlag) -> Result:
    groups = clean_groups(arguments.sweep, arguments.out / "consistency.json")
    stop.check()
    scenes = list(dict.fromkeys(group["scene"] for group in groups))
    rows = []
    for group in groups:
        bound = group["bound"]
        rows.append(
            {
                "name": group_name(group),
                "runs": group["runs"],
                "anees_in_band": in_band(group),
                "bound_anees_in_band": None if bound is None else in_band(bound),
                "nis_in_band": nis_in_band(group),
                "nis_mean": group["nis_mean"],
            }
        )
    cells = [
        (
            row["name"],
            *("-" if row[key] is None else f"{row[key]:.4g}" for key in list(row)[1:]),
        )
        for row in rows
    ]
    return Result(
        numbers={"simulated": True, "groups": rows},
        title="Mean over seeds against the 95 % band of a consistent filter (simulated)",
        size_in=(1.2 + 4.6 * len(scenes), 7.2),
        draw=lambda figure: _draw(figure, groups, scenes),
        tables=[
            (
                "times of ten in their 95 % band: simulated numbers",
                ("group", "seeds", "ANEES", "known association", "NIS", "NIS mean"),
                cells,
            )
        ],
    )

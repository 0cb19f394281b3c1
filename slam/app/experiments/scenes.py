"""How a preset does in many scenes, those it was chosen on among them: errors, map, consistency."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from statistics import fmean
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from slam.app.experiments import Result
from slam.app.experiments.stress import clean_groups, draw_consistency, legend_below
from slam.app.run.evaluation import ratio
from slam.app.run.output import mm_text, share_text
from slam.app.run.pictures import ESTIMATE, GRID, LANDMARK, ODOMETRY, label
from slam.app.sweep.statistics import group_name, in_band
from xethru_protocol.system import StopFlag


def _draw(figure: Figure, groups: Sequence[dict[str, Any]]) -> None:
    errors, consistency = figure.subplots(1, 2)
    _draw_errors(errors, groups, [group_name(group) for group in groups])
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


def run(arguments: argparse.Namespace, stop: StopFlag) -> Result:
    groups = clean_groups(arguments.sweep, arguments.out / "scenes.json")
    stop.check()
    rows = [
        {
            "name": group_name(group),
            "runs": group["runs"],
            "runs_below_odometry": group["runs_below_odometry"],
            "odometry_ate_rmse_m": group["odometry_ate_rmse_m"],
            "ate_rmse_m": group["ate_rmse_m"],
            "ratio": ratio(group["ate_rmse_m"]["median"], group["odometry_ate_rmse_m"]["median"]),
            "anees_mean": fmean(nees for _, nees in group["anees_pose"]),
            "anees_in_band": in_band(group),
            "times": len(group["anees_pose"]),
            "nis_mean": group["nis_mean"],
            "landmark_medians": group["landmark_medians"],
            "without_duplicates": group["without_duplicates"],
            "confident_false": group["confident_false"],
        }
        for group in groups
    ]
    header = (
        "group",
        "seeds",
        "wheels",
        "SLAM",
        "SLAM p90",
        "of wheels",
        "beat wheels",
        "ANEES",
        "in band",
        "NIS",
        "precision",
        "recall",
        "no duplicate",
        "confident false",
    )
    cells = [
        (
            row["name"],
            str(row["runs"]),
            mm_text(row["odometry_ate_rmse_m"]["median"]),
            mm_text(row["ate_rmse_m"]["median"]),
            mm_text(row["ate_rmse_m"]["p90"]),
            f"{row['ratio']:.3f}",
            f"{row['runs_below_odometry']} of {row['runs']}",
            f"{row['anees_mean']:.1f}",
            f"{row['anees_in_band']} of {row['times']}",
            "-" if row["nis_mean"] is None else f"{row['nis_mean']:.2f}",
            share_text(row["landmark_medians"]["precision"]),
            share_text(row["landmark_medians"]["recall"]),
            f"{row['without_duplicates']:.0%}",
            str(row["confident_false"]),
        )
        for row in rows
    ]
    return Result(
        numbers={"simulated": True, "groups": rows},
        title="Clean runs, a row per scene and preset (simulated)",
        size_in=(10.4, 1.6 + 0.34 * len(groups)),
        draw=lambda figure: _draw(figure, groups),
        tables=[
            (
                "clean runs by scene and preset; errors, precision, recall: medians over seeds; "
                "simulated",
                header,
                cells,
            )
        ],
    )

"""How a preset does in many scenes, those it was chosen on among them: errors, map, consistency.

Light, so that ``--help`` is; the drawing is in ``scenes_picture``.
"""

from __future__ import annotations

import argparse

from slam.app.experiments.sweep_result import add_sweep_argument, read_groups
from slam.app.stop import StopFlag

NAME = "scenes"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the sweep to look at."""
    add_sweep_argument(parser, "out/scenes.json", "`uwb-slam sweep --scene ...`")


def run(arguments: argparse.Namespace, stop: StopFlag) -> None:
    """Draw and print the clean groups of a sweep, a row per scene."""
    # heavy, see module text
    from statistics import fmean

    from slam.app.experiments.results import print_table, write_json
    from slam.app.experiments.scenes_picture import draw_scenes
    from slam.app.report_table import mm_text, share_text
    from slam.app.stress import CLEAN
    from slam.app.summary import ratio
    from slam.app.sweep_groups import group_name
    from slam.app.sweep_tables import in_band

    result = arguments.out / f"{NAME}.json"
    groups = [group for group in read_groups(arguments.sweep, result) if group["stress"] == CLEAN]
    stop.check()
    draw_scenes(arguments.out / f"{NAME}.png", groups)
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
    write_json(result, {"simulated": True, "groups": rows})
    print_table(
        "clean runs by scene and preset; errors, precision, recall: medians over seeds; simulated",
        (
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
        ),
        [
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
        ],
    )

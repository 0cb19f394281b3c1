"""Whether SLAM is as sure as it may be: mean NEES and NIS over seeds at ten times of the run.

Light, so that ``--help`` is; the drawing is in ``consistency_picture``.
"""

from __future__ import annotations

import argparse

from slam.app.experiments.sweep_result import add_sweep_argument, read_groups
from slam.app.stop import StopFlag

NAME = "consistency"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the sweep to look at."""
    add_sweep_argument(parser, "out/sweep.json", "`uwb-slam sweep`, like `make sweep`")


def run(arguments: argparse.Namespace, stop: StopFlag) -> None:
    """Draw the clean groups of a sweep against their bands, and count the times inside."""
    # heavy, see module text
    from slam.app.experiments.consistency_picture import draw_consistency
    from slam.app.experiments.results import print_table, write_json
    from slam.app.stress import CLEAN
    from slam.app.sweep_groups import group_name
    from slam.app.sweep_tables import in_band, nis_in_band

    result = arguments.out / f"{NAME}.json"
    groups = [group for group in read_groups(arguments.sweep, result) if group["stress"] == CLEAN]
    stop.check()
    draw_consistency(arguments.out / f"{NAME}.png", groups)
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
    write_json(result, {"simulated": True, "groups": rows})
    print_table(
        "times of ten in their 95 % band: simulated numbers",
        ("group", "seeds", "ANEES", "known association", "NIS", "NIS mean"),
        [
            (
                row["name"],
                *("-" if row[key] is None else f"{row[key]:.4g}" for key in list(row)[1:]),
            )
            for row in rows
        ],
    )

"""How much worse each hardship of the stress table makes a run, on equal seeds.

Light, so that ``--help`` is; the drawing is in ``stress_picture``.
"""

from __future__ import annotations

import argparse

from slam.app.experiments.sweep_result import add_sweep_argument, read_groups
from slam.app.stop import StopFlag

NAME = "stress"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the sweep to look at."""
    add_sweep_argument(parser, "out/stress.json", "`uwb-slam sweep --stress ...`")


def run(arguments: argparse.Namespace, stop: StopFlag) -> None:
    """Draw and print the stress tables of a sweep."""
    # heavy, see module text
    from slam.app.errors import AppError
    from slam.app.experiments.results import write_json
    from slam.app.experiments.stress_picture import draw_stress
    from slam.app.sweep_groups import group_name
    from slam.app.sweep_tables import in_band, print_stress_tables, stress_tables, times_clean

    result = arguments.out / f"{NAME}.json"
    groups = read_groups(arguments.sweep, result)
    tables = stress_tables(groups)
    if not tables:
        raise AppError(f"{arguments.sweep}: has no stressed runs; `uwb-slam sweep --stress` does")
    stop.check()
    draw_stress(arguments.out / f"{NAME}.png", tables)
    numbers = [
        {
            "name": group_name(group),
            "runs": group["runs"],
            "ate_rmse_m": group["ate_rmse_m"],
            "times_clean": {of: times_clean(group, clean, of) for of in ("median", "p90")},
            "anees_in_band": in_band(group),
            "without_duplicates": group["without_duplicates"],
            "false_per_run": group["false_per_run"],
            "confident_false": group["confident_false"],
        }
        for clean, rows in tables
        for group in rows
    ]
    write_json(result, {"simulated": True, "groups": numbers})
    print_stress_tables(groups)

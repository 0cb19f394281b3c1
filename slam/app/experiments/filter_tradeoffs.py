"""What window, minimum count and search radius of the paper's outlier filter trade off.

Light, so that ``--help`` is; the work is in ``filter_study`` and ``filter_picture``.
"""

from __future__ import annotations

import argparse

from slam.app.arguments import seed
from slam.app.stop import StopFlag

NAME = "filter"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add seed and scenes."""
    parser.add_argument(
        "--seed",
        type=seed,
        default=0,
        help="seed of receiver noise and odometry drift (default: %(default)s)",
    )
    parser.add_argument(
        "--scene",
        nargs="+",
        default=["lab"],
        help="names or files of scenes (default: lab); in two_rooms walls make most of the fixes",
    )


def run(arguments: argparse.Namespace, stop: StopFlag) -> None:
    """Drive one lap per scene and filter what was seen with every setting."""
    # heavy, see module text
    from slam.app.emulated_rig import scene_and_config
    from slam.app.experiments.filter_picture import draw_filter
    from slam.app.experiments.filter_study import drive, outcomes
    from slam.app.experiments.results import print_table, write_json
    from slam.app.report_table import share_text

    for scene in arguments.scene:
        scene_and_config(scene, "paper")  # a bad one is refused before the first is driven
    studies = []
    for scene in arguments.scene:
        run_seen = drive(scene, seed=arguments.seed, check=stop.check)
        studies.append((run_seen, outcomes(run_seen, check=stop.check)))
    write_json(
        arguments.out / f"{NAME}.json",
        {
            "simulated": True,
            "seed": arguments.seed,
            "scenes": [
                seen.numbers() | {"settings": [row.numbers() for row in rows]}
                for seen, rows in studies
            ],
        },
    )
    draw_filter(arguments.out / f"{NAME}.png", studies, seed=arguments.seed)
    for seen, rows in studies:
        print_table(
            f"{seen.scene}, one lap, seed {arguments.seed}: {seen.n_true} true fixes, "
            f"{seen.n_ghosts} ghosts, {seen.n_clutter} others: simulated numbers",
            (
                "window, min_opc, search_rad",
                "true kept",
                "ghosts kept",
                "others kept",
                "observations",
                "wrong",
                "latency",
            ),
            [
                (
                    str(row.setting),
                    share_text(row.true_kept),
                    share_text(row.ghosts_kept),
                    share_text(row.clutter_kept),
                    str(row.n_observations),
                    share_text(row.wrong_observations),
                    f"{row.latency_s:.1f} s",
                )
                for row in rows
            ],
        )

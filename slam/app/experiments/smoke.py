"""The paper's smoke experiment, and its figure of the outlier filter on odometry poses.

Light, so that ``--help`` is; the work is in ``smoke_runs`` and ``smoke_picture``.
"""

from __future__ import annotations

import argparse

from slam.app.arguments import seed
from slam.app.stop import StopFlag

NAME = "smoke"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the seed."""
    parser.add_argument(
        "--seed",
        type=seed,
        default=0,
        help="seed of receiver noise and odometry drift (default: %(default)s)",
    )


def run(arguments: argparse.Namespace, stop: StopFlag) -> None:
    """Drive round one point feature in clear air and in smoke; filter what was observed."""
    # heavy, see module text
    from slam.app.experiments.results import print_table, write_json
    from slam.app.experiments.smoke_picture import draw_smoke
    from slam.app.experiments.smoke_runs import (
        SMOKE_G_PER_M3,
        drive_in_clear_air_and_smoke,
        light_attenuation_db,
        smoke_attenuation_db,
    )
    from slam.app.report_table import mm_text

    runs = drive_in_clear_air_and_smoke(seed=arguments.seed, check=stop.check)
    radar_db, light_db = smoke_attenuation_db(1.5), light_attenuation_db(1.5)
    write_json(
        arguments.out / f"{NAME}.json",
        {
            "simulated": True,
            "seed": arguments.seed,
            "smoke_g_per_m3": SMOKE_G_PER_M3,
            "attenuation_to_1_5_m_and_back_db": {"radar_at_most": radar_db, "light": light_db},
            "runs": [row.numbers() for row in runs],
        },
    )
    draw_smoke(arguments.out / f"{NAME}.png", runs, seed=arguments.seed)
    print_table(
        f"seed {arguments.seed}: simulated numbers. Smoke of {SMOKE_G_PER_M3:g} g/m3 takes at most "
        f"{radar_db:.4f} dB from a radar's echo 1.5 m away, and {light_db:.0f} dB from a lidar's",
        (
            "run",
            "detections",
            "states as in clear air",
            "raw fixes",
            "filtered",
            "raw error",
            "filtered error",
        ),
        [
            (
                row.name,
                str(row.n_detections),
                "-" if row.same_detections is None else f"{row.same_detections:.4f}",
                str(len(row.raw_m)),
                str(len(row.filtered_m)),
                mm_text(row.raw_rms_m),
                mm_text(row.filtered_rms_m),
            )
            for row in runs
        ],
    )

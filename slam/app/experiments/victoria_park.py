"""The robust back end on real data: Victoria Park, with and without the trees' ids.

Light, so that ``--help`` is; the work is in ``slam.app.victoria_park_runs`` and
``victoria_park_picture``.
"""

from __future__ import annotations

import argparse

from slam.app.arguments import count
from slam.app.stop import StopFlag

NAME = "victoria-park"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add how much of the drive to take."""
    parser.add_argument(
        "--steps",
        type=count,
        default=None,
        help="take the first steps of the drive only (default: all 6968)",
    )


def run(arguments: argparse.Namespace, stop: StopFlag) -> None:
    """Drive through the park with and without ids; compare with GTSAM on the same data."""
    # heavy, see module text
    import sys

    from slam.app.experiments.results import print_table, write_json
    from slam.app.experiments.victoria_park_picture import draw_park
    from slam.app.experiments.victoria_park_scores import scores
    from slam.app.report_table import share_text
    from slam.app.victoria_park import read_drive, shipped_file
    from slam.app.victoria_park_runs import (
        PERFECT_WHEELS,
        UNKNOWN_WHEELS,
        batch_reference,
        drive_back_end,
    )

    def tell(what: str) -> None:
        sys.stderr.write(f"{what}\n")

    drive = read_drive(shipped_file())
    if arguments.steps is not None:
        drive = drive.first(arguments.steps)
    tell("GTSAM: every step with ISAM2, then all of it in a batch")
    reference = batch_reference(drive, stop.check)
    runs = {}
    for name, with_ids, wheels in (
        ("true ids, wheels as in the reference", True, PERFECT_WHEELS),
        ("true ids", True, UNKNOWN_WHEELS),
        ("unknown ids", False, UNKNOWN_WHEELS),
    ):
        tell(f"robust back end, {name}")
        runs[name] = drive_back_end(drive, with_ids=with_ids, wheels=wheels, check=stop.check)
    rows = scores(drive, reference, runs)
    write_json(
        arguments.out / f"{NAME}.json",
        {
            "simulated": False,
            "data": "Victoria Park as in the wheel of gtsam; no ground truth",
            "reference": "GTSAM, batch, true ids",
            "steps": len(drive.increments),
            "observations": drive.n_observations,
            "landmarks": len(drive.labels),
            "reference_chi_square": reference.chi_square,
            "reference_dof": reference.dof,
            "reference_seconds": reference.seconds,
            "paths": [row.numbers() for row in rows],
            "wheel_errors": {
                name: {"mean": run.calibration.tolist(), "sigma": run.calibration_sigmas.tolist()}
                for name, run in runs.items()
            },
        },
    )
    draw_park(arguments.out / f"{NAME}.png", drive, reference, runs, rows)
    print_table(
        f"Victoria Park, {len(drive.increments)} steps, {len(drive.labels)} trees seen "
        f"{drive.n_observations} times: causal paths against GTSAM's batch solution (real data, "
        "no ground truth)",
        ("path", "ATE", "unaligned", "most", "landmarks", "right", "left out", "CPU time"),
        [
            (
                row.name,
                f"{row.ate_m:.2f} m",
                f"{row.rmse_m:.2f} m",
                f"{row.max_m:.2f} m",
                "-" if row.n_landmarks is None else str(row.n_landmarks),
                share_text(row.right_share),
                "-" if row.left_out is None else str(row.left_out),
                "-" if row.seconds is None else f"{row.seconds:.1f} s",
            )
            for row in rows
        ],
    )

"""The paper's figure of raw observations: a frame from raw to peaks, and a target that moves away.

Light, so that ``--help`` is; the work is in ``range_steps`` and ``figure7_picture``.
"""

from __future__ import annotations

import argparse

from slam.app.arguments import count, seed
from slam.app.stop import StopFlag

NAME = "figure7"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the seed and how many frames are taken of each position."""
    parser.add_argument(
        "--seed", type=seed, default=0, help="seed of the receiver noise (default: %(default)s)"
    )
    parser.add_argument(
        "--frames",
        type=count,
        default=20,
        help="frames taken at each position of the target (default: %(default)s)",
    )


def run(arguments: argparse.Namespace, stop: StopFlag) -> None:
    """Move a rod from 0.5 to 1.4 m in 1 cm steps past one radar of the lab."""
    # heavy, see module text
    from slam.app.experiments.figure7_picture import draw_figure7
    from slam.app.experiments.range_steps import measure_steps, range_errors
    from slam.app.experiments.results import print_table, write_json

    steps = measure_steps(seed=arguments.seed, frames_per_step=arguments.frames, check=stop.check)
    errors = range_errors(steps, check=stop.check)
    write_json(
        arguments.out / f"{NAME}.json",
        {
            "simulated": True,
            "seed": arguments.seed,
            "frames_per_step": arguments.frames,
            "true_ranges_m": steps.ranges_m.tolist(),
            "front_ends": {name: error.numbers() for name, error in errors.items()},
        },
    )
    draw_figure7(arguments.out / f"{NAME}.png", steps, errors, seed=arguments.seed)
    print_table(
        f"a rod moved away in {len(steps.ranges_m)} steps of 1 cm, {arguments.frames} frames each, "
        f"seed {arguments.seed}: simulated numbers",
        ("front end", "found", "others/frame", "bias", "std", "of it noise", "worst position"),
        [
            (
                name,
                f"{error.found:.3f}",
                f"{error.others_per_frame:.3f}",
                f"{1e3 * error.bias_m:.2f} mm",
                f"{1e3 * error.std_m:.2f} mm",
                f"{1e3 * error.noise_std_m:.2f} mm",
                f"{1e3 * error.worst_position_m:.2f} mm",
            )
            for name, error in errors.items()
        ],
    )

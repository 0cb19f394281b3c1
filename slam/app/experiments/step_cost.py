"""What one step of the robust filter costs against the size of the map.

Light, so that ``--help`` is; the work is in ``step_cost_study`` and ``step_cost_picture``.
"""

from __future__ import annotations

import argparse

from slam.app.arguments import count
from slam.app.errors import UsageError
from slam.app.stop import StopFlag

NAME = "step-cost"
_FEWEST = 2


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add sizes and repetitions."""
    parser.add_argument(
        "--landmarks",
        nargs="+",
        type=count,
        default=[10, 20, 50, 100, 200, 500, 1000, 2000],
        metavar="N",
        help="sizes of the map (default: 10 20 50 100 200 500 1000 2000)",
    )
    parser.add_argument(
        "--repetitions",
        type=count,
        default=7,
        metavar="N",
        help="how often every step is timed; the least counts (default: %(default)s)",
    )


def run(arguments: argparse.Namespace, stop: StopFlag) -> None:
    """Time a step at every size, write, draw and print.

    Raises
    ------
    UsageError
        A map of one landmark was asked for: each side of the robot needs its own.
    """
    # heavy, see module text
    from slam.app.experiments.results import print_table, write_json
    from slam.app.experiments.step_cost_picture import draw_step_cost
    from slam.app.experiments.step_cost_study import numbers_of, study

    if min(arguments.landmarks) < _FEWEST:
        raise UsageError(
            f"--landmarks {min(arguments.landmarks)}: a step sees one landmark on each side, "
            f"give at least {_FEWEST}"
        )
    costs = study(
        sorted(set(arguments.landmarks)), repetitions=arguments.repetitions, check=stop.check
    )
    numbers = numbers_of(costs, repetitions=arguments.repetitions)
    write_json(arguments.out / f"{NAME}.json", numbers)
    draw_step_cost(arguments.out / f"{NAME}.png", costs)
    print_table(
        "One step of the robust filter: predict, view, gate, 4 range updates; CPU time, one BLAS "
        f"thread, least of {arguments.repetitions}",
        ("landmarks", "step", "slowest step", "every change at once", "triangle read and written"),
        [
            (
                str(cost.n_landmarks),
                f"{cost.step_ms:.3f} ms",
                f"{cost.slowest_ms:.3f} ms",
                f"{cost.at_once_ms:.3f} ms",
                f"{cost.triangle_ms:.3f} ms",
            )
            for cost in costs
        ],
    )

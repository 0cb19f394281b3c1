"""The experiments of `uwb-slam experiment NAME`, one module each, and their options.

Importing this package loads nothing heavy. The module of an experiment is imported when it is run.
It has ``run(arguments, stop)``, which writes ``<out>/<name>.png`` and ``<out>/<name>.json``, prints
a table to stdout and progress to stderr, and calls ``stop.check()`` now and then. The folder exists
and can be written.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import MappingProxyType

from slam.app.commands.options import count, folder, seed
from slam.app.errors import StopFlag


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """One experiment: its name and help, the options besides ``--out``, its module."""

    name: str
    help: str
    module: str
    add_options: Callable[[argparse.ArgumentParser], None]

    def run(self, arguments: argparse.Namespace, stop: StopFlag) -> None:
        """Import the module and run it."""
        import_module(self.module).run(arguments, stop)


def add_experiments(experiment: argparse.ArgumentParser) -> None:
    """Add a command for each experiment; ``experiment`` of the arguments is its row."""
    names = experiment.add_subparsers(required=True, metavar="NAME", dest="name")
    for row in EXPERIMENTS.values():
        parser = names.add_parser(row.name, help=row.help, description=row.help)
        parser.add_argument(
            "--out", type=folder, default=Path("out/experiments"), help="folder for the results"
        )
        row.add_options(parser)
        parser.set_defaults(experiment=row)


def _sweep(default: str, made_by: str) -> Callable[[argparse.ArgumentParser], None]:
    def add(parser: argparse.ArgumentParser) -> None:
        parser.add_argument(
            "--sweep",
            type=Path,
            default=Path(default),
            metavar="JSON",
            help=f"result of {made_by} (default: %(default)s)",
        )

    return add


def _figure7(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--seed", type=seed, default=0, help="seed of the receiver noise (default: %(default)s)"
    )
    parser.add_argument(
        "--frames",
        type=count,
        default=20,
        help="frames taken at each position of the target (default: %(default)s)",
    )


def _smoke(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--seed",
        type=seed,
        default=0,
        help="seed of receiver noise and odometry drift (default: %(default)s)",
    )


def _filter(parser: argparse.ArgumentParser) -> None:
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


def _limits(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--seed",
        type=seed,
        default=0,
        help="seed of places, phases and noise (default: %(default)s)",
    )
    parser.add_argument(
        "--trials", type=count, default=2000, help="frames per cell (default: %(default)s)"
    )


def _recording(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--recording",
        type=Path,
        required=True,
        metavar="DIR",
        help="recording of a standing module's baseband frames, in any format `xethru dump` reads",
    )
    parser.add_argument("--radar", metavar="NAME", help="which radar of a recording of several")
    parser.add_argument(
        "--seed", type=seed, default=0, help="seed of the run drawn in full (default: %(default)s)"
    )
    parser.add_argument(
        "--runs",
        type=count,
        default=20,
        help="emulated runs, with seeds from there on (default: %(default)s)",
    )


def _step_cost(parser: argparse.ArgumentParser) -> None:
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


def _victoria_park(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--steps",
        type=count,
        default=None,
        help="take the first steps of the drive only (default: all 6968)",
    )


_ROWS: tuple[Experiment, ...] = (
    Experiment(
        name="figure7",
        help="one frame from raw to peaks, and a target that moves away in 1 cm steps",
        module="slam.app.experiments.figure7",
        add_options=_figure7,
    ),
    Experiment(
        name="smoke",
        help="observations in smoke and in clear air, raw and filtered",
        module="slam.app.experiments.smoke",
        add_options=_smoke,
    ),
    Experiment(
        name="filter",
        help="what window, minimum count and search radius of the outlier filter trade off",
        module="slam.app.experiments.filter",
        add_options=_filter,
    ),
    Experiment(
        name="limits",
        help="range error, detection and resolution of the front ends beside their bounds",
        module="slam.app.experiments.limits",
        add_options=_limits,
    ),
    Experiment(
        name="recording",
        help="a real recording of a standing module beside emulated frames",
        module="slam.app.experiments.recording",
        add_options=_recording,
    ),
    Experiment(
        name="step-cost",
        help="what a step of the robust filter costs against the size of the map",
        module="slam.app.experiments.step_cost",
        add_options=_step_cost,
    ),
    Experiment(
        name="consistency",
        help="mean NEES and NIS of a sweep at ten times, against their bands",
        module="slam.app.experiments.consistency",
        add_options=_sweep("out/sweep.json", "`uwb-slam sweep`, like `make sweep`"),
    ),
    Experiment(
        name="stress",
        help="what each hardship of a sweep costs, in units of its clean runs",
        module="slam.app.experiments.stress",
        add_options=_sweep("out/stress.json", "`uwb-slam sweep --stress ...`"),
    ),
    Experiment(
        name="scenes",
        help="what one preset does in each scene of a sweep",
        module="slam.app.experiments.scenes",
        add_options=_sweep("out/scenes.json", "`uwb-slam sweep --scene ...`"),
    ),
    Experiment(
        name="victoria-park",
        help="the robust back end on real data, a car among trees, against GTSAM's batch solution",
        module="slam.app.experiments.victoria_park",
        add_options=_victoria_park,
    ),
)

EXPERIMENTS: Mapping[str, Experiment] = MappingProxyType({row.name: row for row in _ROWS})

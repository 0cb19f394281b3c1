"""The experiments of `uwb-slam experiment NAME`: one row and one module each.

Importing this package loads nothing heavy. The module of a row is imported when its experiment
runs. Its ``run(arguments, stop)`` measures, writes progress to stderr, calls ``stop.check()`` now
and then and returns a `Result`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from slam.app.commands.options import count, folder, seed
from slam.app.errors import naming
from xethru_protocol.system import StopFlag

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Option = tuple[str, Mapping[str, Any]]
"""A flag, and the keywords of ``add_argument`` for it."""
Table = tuple[str, Sequence[str], Sequence[Sequence[str]]]
"""Title, header and rows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """What an experiment found.

    Attributes
    ----------
    numbers
        For NAME.json.
    title, size_in, draw
        NAME.png: its title, its width and height [inch], and what draws into the figure.
    tables
        For stdout.
    """

    numbers: Mapping[str, object]
    title: str
    size_in: tuple[float, float]
    draw: Callable[[Figure], None]
    tables: Sequence[Table]


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """One row: what the experiment is called, what it shows in a line, where it lives."""

    name: str
    help: str
    module: str
    options: Sequence[Option]


def add_experiments(experiment: argparse.ArgumentParser) -> None:
    names = experiment.add_subparsers(required=True, metavar="NAME", dest="name")
    for row in EXPERIMENTS.values():
        parser = names.add_parser(row.name, help=row.help, description=row.help)
        parser.add_argument(
            "--out", type=folder, default=Path("out/experiments"), help="folder for the results"
        )
        for flag, keywords in row.options:
            parser.add_argument(flag, **keywords)
        parser.set_defaults(command=run_experiment)


def run_experiment(arguments: argparse.Namespace, stop: StopFlag) -> None:
    """Run ``arguments.name``; write NAME.json and NAME.png into ``arguments.out``, print tables.

    Raises
    ------
    AppError
        The folder or a file cannot be written, or the experiment failed.
    """
    out: Path = arguments.out
    with naming(out):
        out.mkdir(parents=True, exist_ok=True)
    result: Result = import_module(EXPERIMENTS[arguments.name].module).run(arguments, stop)
    # heavy, see module text
    from slam.app.run.output import print_table, write_json
    from slam.app.run.pictures import INK, picture

    write_json(out / f"{arguments.name}.json", result.numbers)
    width_in, height_in = result.size_in
    with picture(out / f"{arguments.name}.png", width_in=width_in, height_in=height_in) as figure:
        figure.suptitle(result.title, fontsize=11, color=INK, x=0.01, ha="left")
        result.draw(figure)
    for table in result.tables:
        print_table(*table)


def _option(flag: str, **keywords: Any) -> Option:  # noqa: ANN401 - argparse's
    return flag, keywords


def _seed_of(what: str) -> Option:
    return _option("--seed", type=seed, default=0, help=f"seed of {what} (default: %(default)s)")


def _sweep_of(made_by: str, default: str) -> Option:
    text = f"result of {made_by} (default: %(default)s)"
    return _option("--sweep", type=Path, default=Path(default), metavar="JSON", help=text)


_ROWS: tuple[Experiment, ...] = (
    Experiment(
        name="figure7",
        help="one frame from raw to peaks, and a target that moves away in 1 cm steps",
        module="slam.app.experiments.figure7",
        options=(
            _seed_of("the receiver noise"),
            _option(
                "--frames",
                type=count,
                default=20,
                help="frames taken at each position of the target (default: %(default)s)",
            ),
        ),
    ),
    Experiment(
        name="smoke",
        help="observations in smoke and in clear air, raw and filtered",
        module="slam.app.experiments.smoke",
        options=(_seed_of("receiver noise and odometry drift"),),
    ),
    Experiment(
        name="filter",
        help="what window, minimum count and search radius of the outlier filter trade off",
        module="slam.app.experiments.filter",
        options=(
            _seed_of("receiver noise and odometry drift"),
            _option(
                "--scene",
                nargs="+",
                default=["lab"],
                help="names or files of scenes (default: lab); in two_rooms walls make most of "
                "the fixes",
            ),
        ),
    ),
    Experiment(
        name="limits",
        help="range error, detection and resolution of the front ends beside their bounds",
        module="slam.app.experiments.limits",
        options=(
            _seed_of("places, phases and noise"),
            _option(
                "--trials", type=count, default=2000, help="frames per cell (default: %(default)s)"
            ),
        ),
    ),
    Experiment(
        name="recording",
        help="a real recording of a standing module beside emulated frames",
        module="slam.app.experiments.recording",
        options=(
            _option(
                "--recording",
                type=Path,
                required=True,
                metavar="DIR",
                help="recording of a standing module's baseband frames, in any format "
                "`xethru dump` reads",
            ),
            _option("--radar", metavar="NAME", help="which radar of a recording of several"),
            _seed_of("the run drawn in full"),
            _option(
                "--runs",
                type=count,
                default=20,
                help="emulated runs, with seeds from there on (default: %(default)s)",
            ),
        ),
    ),
    Experiment(
        name="step-cost",
        help="what a step of the robust filter costs against the size of the map",
        module="slam.app.experiments.step_cost",
        options=(
            _option(
                "--landmarks",
                nargs="+",
                type=count,
                default=[10, 20, 50, 100, 200, 500, 1000, 2000],
                metavar="N",
                help="sizes of the map (default: 10 20 50 100 200 500 1000 2000)",
            ),
            _option(
                "--repetitions",
                type=count,
                default=7,
                metavar="N",
                help="how often every step is timed; the least counts (default: %(default)s)",
            ),
        ),
    ),
    Experiment(
        name="consistency",
        help="mean NEES and NIS of a sweep at ten times, against their bands",
        module="slam.app.experiments.consistency",
        options=(_sweep_of("`uwb-slam sweep`, like `make sweep`", "out/sweep.json"),),
    ),
    Experiment(
        name="stress",
        help="what each hardship of a sweep costs, in units of its clean runs",
        module="slam.app.experiments.stress",
        options=(_sweep_of("`uwb-slam sweep --stress ...`", "out/stress.json"),),
    ),
    Experiment(
        name="scenes",
        help="what one preset does in each scene of a sweep",
        module="slam.app.experiments.scenes",
        options=(_sweep_of("`uwb-slam sweep --scene ...`", "out/scenes.json"),),
    ),
    Experiment(
        name="victoria-park",
        help="the robust back end on real data, a car among trees, against GTSAM's batch solution",
        module="slam.app.experiments.victoria_park",
        options=(
            _option(
                "--steps",
                type=count,
                default=None,
                help="take the first steps of the drive only (default: all 6968)",
            ),
        ),
    ),
)

EXPERIMENTS: Mapping[str, Experiment] = MappingProxyType({row.name: row for row in _ROWS})

"""The experiments of `uwb-slam experiment NAME`.

Importing this package loads nothing heavy. The module of an experiment is imported when it runs:
its ``run(arguments, stop)`` measures, writes progress to stderr, calls ``stop.check()`` now and
then and returns a `Result`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from slam.app.commands.options import count, folder, seed
from slam.app.errors import naming
from xethru_protocol.system import StopFlag

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Option = tuple[str, dict[str, Any]]
"""A flag, and the keywords of ``add_argument`` for it."""
Table = tuple[str, Sequence[str], Sequence[Sequence[str]]]
"""Title, header and rows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """What an experiment found."""

    numbers: Mapping[str, object]  # for NAME.json
    title: str  # of NAME.png
    size_in: tuple[float, float]  # its width and height
    draw: Callable[[Figure], None]
    tables: Sequence[Table]  # for stdout


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """What an experiment shows in a line, the module of this package that runs it, its options."""

    help: str
    module: str
    options: Sequence[Option]


def table(title: str, columns: Mapping[str, Sequence[str]]) -> Table:
    """Return a table of columns by their headers."""
    return title, list(columns), list(zip(*columns.values(), strict=True))


def add_experiments(experiment: argparse.ArgumentParser) -> None:
    names = experiment.add_subparsers(required=True, metavar="NAME", dest="name")
    for name, row in EXPERIMENTS.items():
        parser = names.add_parser(name, help=row.help, description=row.help)
        parser.add_argument(
            "--out", type=folder, default=Path("out/experiments"), help="folder for the results"
        )
        for flag, keywords in row.options:
            parser.add_argument(flag, **keywords)
        parser.set_defaults(command=run_experiment)


def run_experiment(arguments: argparse.Namespace, stop: StopFlag) -> None:
    """Run ``arguments.name``; write NAME.json and NAME.png into ``arguments.out``, print tables.

    Raises AppError if the folder or a file cannot be written, or the experiment failed.
    """
    name, out = arguments.name, arguments.out
    with naming(out):
        out.mkdir(parents=True, exist_ok=True)
    with stop.leaving(program="uwb-slam"):  # imports take seconds
        module = import_module(f"slam.app.experiments.{EXPERIMENTS[name].module}")
    result: Result = module.run(arguments, stop)
    # heavy, see module text
    from slam.app.run.output import print_table, write_json
    from slam.app.run.pictures import INK, picture

    write_json(out / f"{name}.json", result.numbers)
    width_in, height_in = result.size_in
    with picture(out / f"{name}.png", width_in=width_in, height_in=height_in) as figure:
        figure.suptitle(result.title, fontsize=11, color=INK, x=0.01, ha="left")
        result.draw(figure)
    for each in result.tables:
        print_table(*each)


def _count(flag: str, default: int, what: str, **more: object) -> Option:
    text = f"{what} (default: %(default)s)"
    return flag, {"type": count, "default": default, "help": text} | more


def _seed_of(what: str) -> Option:
    return "--seed", {"type": seed, "default": 0, "help": f"seed of {what} (default: %(default)s)"}


def _sweep_of(made_by: str, default: str) -> Option:
    text = f"result of {made_by} (default: %(default)s)"
    return "--sweep", {"type": Path, "default": Path(default), "metavar": "JSON", "help": text}


EXPERIMENTS: Mapping[str, Experiment] = {
    "figure7": Experiment(
        help="one frame from raw to peaks, and a target that moves away in 1 cm steps",
        module="figure7",
        options=(
            _seed_of("the receiver noise"),
            _count("--frames", 20, "frames taken at each position of the target"),
        ),
    ),
    "smoke": Experiment(
        help="observations in smoke and in clear air, raw and filtered",
        module="smoke",
        options=(_seed_of("receiver noise and odometry drift"),),
    ),
    "filter": Experiment(
        help="what window, minimum count and search radius of the outlier filter trade off",
        module="filter",
        options=(
            _seed_of("receiver noise and odometry drift"),
            (
                "--scene",
                {
                    "nargs": "+",
                    "default": ["lab"],
                    "help": "names or files of scenes (default: lab); in two_rooms walls make most "
                    "of the fixes",
                },
            ),
        ),
    ),
    "limits": Experiment(
        help="range error, detection and resolution of the front ends beside their bounds",
        module="limits",
        options=(
            _seed_of("places, phases and noise"),
            _count("--trials", 2000, "frames per cell"),
        ),
    ),
    "recording": Experiment(
        help="a real recording of a standing module beside emulated frames",
        module="recording",
        options=(
            (
                "--recording",
                {
                    "type": Path,
                    "required": True,
                    "metavar": "DIR",
                    "help": "recording of a standing module's baseband frames, in any format "
                    "`xethru dump` reads",
                },
            ),
            ("--radar", {"metavar": "NAME", "help": "which radar of a recording of several"}),
            _seed_of("the run drawn in full"),
            _count("--runs", 20, "emulated runs, with seeds from there on"),
        ),
    ),
    "consistency": Experiment(
        help="mean NEES and NIS of a sweep at ten times, against their bands",
        module="sweep_results",
        options=(_sweep_of("`uwb-slam sweep`, like `make sweep`", "out/sweep.json"),),
    ),
    "stress": Experiment(
        help="what each hardship of a sweep costs, in units of its clean runs",
        module="sweep_results",
        options=(_sweep_of("`uwb-slam sweep --stress ...`", "out/stress.json"),),
    ),
    "scenes": Experiment(
        help="what one preset does in each scene of a sweep",
        module="sweep_results",
        options=(_sweep_of("`uwb-slam sweep --scene ...`", "out/scenes.json"),),
    ),
}

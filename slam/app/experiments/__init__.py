"""The experiments of `uwb-slam experiment NAME`: one row each, one module each.

Importing this package loads nothing heavy. A row's module is imported once its experiment is named
on the command line, for its ``--help`` too, so it imports numpy and the like inside ``run``. It has

``add_arguments(parser)``
    adds its own options to an ``argparse.ArgumentParser`` that has ``--out`` already, a
    ``pathlib.Path``;
``run(arguments, stop)``
    writes ``<out>/<name>.png`` and ``<out>/<name>.json``, prints a table to stdout and progress to
    stderr, and asks ``stop.check()`` now and then. The folder exists and can be written.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from types import MappingProxyType
from typing import Protocol, cast

from xethru_protocol.system import StopFlag


class ExperimentModule(Protocol):
    """What the module of a row offers."""

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Add the experiment's own options."""

    def run(self, arguments: argparse.Namespace, stop: StopFlag) -> None:
        """Measure, draw, write, print."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """One row: what the experiment is called, what it shows in a line, where it lives."""

    name: str
    help: str
    module: str

    def load(self) -> ExperimentModule:
        """Import the module."""
        return cast(ExperimentModule, import_module(self.module))


_ROWS: tuple[Experiment, ...] = (
    Experiment(
        name="figure7",
        help="one frame from raw to peaks, and a target that moves away in 1 cm steps",
        module="slam.app.experiments.figure7",
    ),
    Experiment(
        name="smoke",
        help="observations in smoke and in clear air, raw and filtered",
        module="slam.app.experiments.smoke",
    ),
    Experiment(
        name="filter",
        help="what window, minimum count and search radius of the outlier filter trade off",
        module="slam.app.experiments.filter",
    ),
    Experiment(
        name="limits",
        help="range error, detection and resolution of the front ends beside their bounds",
        module="slam.app.experiments.limits",
    ),
    Experiment(
        name="recording",
        help="a real recording of a standing module beside emulated frames",
        module="slam.app.experiments.recording",
    ),
    Experiment(
        name="step-cost",
        help="what a step of the robust filter costs against the size of the map",
        module="slam.app.experiments.step_cost",
    ),
    Experiment(
        name="consistency",
        help="mean NEES and NIS of a sweep at ten times, against their bands",
        module="slam.app.experiments.consistency",
    ),
    Experiment(
        name="stress",
        help="what each hardship of a sweep costs, in units of its clean runs",
        module="slam.app.experiments.stress",
    ),
    Experiment(
        name="scenes",
        help="what one preset does in each scene of a sweep",
        module="slam.app.experiments.scenes",
    ),
    Experiment(
        name="victoria-park",
        help="the robust back end on real data, a car among trees, against GTSAM's batch solution",
        module="slam.app.experiments.victoria_park",
    ),
)

EXPERIMENTS: Mapping[str, Experiment] = MappingProxyType({row.name: row for row in _ROWS})

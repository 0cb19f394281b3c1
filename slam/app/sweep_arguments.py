"""The options of `uwb-slam sweep`; light, for `--help`."""

from __future__ import annotations

import argparse
from pathlib import Path

from slam.app.arguments import count
from slam.app.stress import STRESSES

_DESCRIPTION = (
    "Runs every scene with every preset and seed in process, without ports, "
    "and writes each run's summary and the statistics of each group. Stopped, the same "
    "command goes on where it was. All numbers are simulated."
)
_EPILOG = (
    "STRESS is one of: " + "; ".join(f"{row.name}: {row.help}" for row in STRESSES.values()) + "."
)


def add_sweep(sweep: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Add them, and return the parser."""
    sweep.description, sweep.epilog = _DESCRIPTION, _EPILOG
    sweep.add_argument("--scene", nargs="+", action="extend", help="names or files (default: lab)")
    sweep.add_argument(
        "--preset", nargs="+", action="extend", help="settings of SLAM (default: robust)"
    )
    sweep.add_argument("--seeds", type=count, default=20, help="number of seeds, from 0")
    sweep.add_argument(
        "--set",
        type=_setting,
        action="append",
        default=[],
        metavar="KEY=V1,V2",
        help="replace a setting of the presets, like association.gate=0.6,9.2; several values, or "
        "several --set, make a group for every combination",
    )
    sweep.add_argument(
        "--stress",
        nargs="+",
        action="extend",
        default=[],
        choices=tuple(STRESSES),
        metavar="STRESS",
        help="run under these hardships, too, and print how much worse it gets",
    )
    sweep.add_argument(
        "--bound",
        action="store_true",
        help="compute on each run's data what is possible with the true associations (GTSAM)",
    )
    where = sweep.add_mutually_exclusive_group()
    where.add_argument("--jobs", type=count, help="processes (default: one per core)")
    where.add_argument("--dask", metavar="ADDRESS", help="scheduler of a Dask cluster to run on")
    sweep.add_argument("--json", type=Path, required=True, metavar="OUT", help="result file")
    return sweep


def _setting(text: str) -> tuple[str, tuple[str, ...]]:
    key, _, values = text.partition("=")
    named = tuple(value.strip() for value in values.split(","))
    if not key or not all(named):
        raise argparse.ArgumentTypeError(f"must be KEY=VALUE or KEY=V1,V2, not {text!r}")
    return key.strip(), named

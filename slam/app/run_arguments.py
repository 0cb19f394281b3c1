"""The options of `uwb-slam run`; light, for `--help`."""

from __future__ import annotations

import argparse
from pathlib import Path

from slam.app.arguments import count, folder
from slam.app.view_arguments import add_rerun


def add_run(run: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Add them, and return the parser."""
    run.add_argument("--rig", type=Path, required=True, metavar="RIG", help="a rig file, TOML")
    run.add_argument(
        "--odometry",
        required=True,
        metavar="SRC",
        help="TUM lines (timestamp x y z qx qy qz qw) from: - (stdin), a file or FIFO, unix:PATH, "
        "tcp://HOST:PORT, serial:PORT[@BAUD]",
    )
    run.add_argument(
        "--odometry-clock",
        default="arrival",
        metavar="CLOCK",
        help="what its stamps are: arrival (any clock, told by when lines come; the default), "
        "unix, monotonic, or the monotonic nanoseconds at stamp 0",
    )
    run.add_argument(
        "--ports", nargs="+", metavar="PORT", help="the modules' ports (default: look for them)"
    )
    run.add_argument("--out", type=folder, default=Path("out/run"), help="folder for the results")
    run.add_argument("--preset", default="robust", help="settings of SLAM (default: %(default)s)")
    run.add_argument("--fps", type=count, default=5, help="frames/s (default: %(default)s)")
    run.add_argument("--duration", type=count, metavar="S", help="end after so many seconds")
    run.add_argument("--wire", action="store_true", help="record every byte of the ports, too")
    add_rerun(run)
    return run

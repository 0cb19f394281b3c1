"""The options of `uwb-slam run`; light, for `--help`."""

from __future__ import annotations

import argparse
from pathlib import Path

from slam.app.arguments import count, folder
from slam.app.view_arguments import add_rerun

CSV_TO_TUM = (
    r"s/^([0-9]+),([0-9]+),[^,]*,[^,]*,"
    + ",".join([r"([^,]*)"] * 7)
    + r",.*/\1.000000000\2 \3 \4 \5 \6 \7 \8 \9/; s/\.0*([0-9]{9}) /.\1 /"
)
"""For `sed -E`: a line of `ros2 topic echo --csv` of a nav_msgs/Odometry to a TUM line."""

_DESCRIPTION = """\
Opens the modules that a rig file names by their serial numbers, follows the robot's odometry, and
runs SLAM while frames arrive. Ends with the odometry, after --duration, or by Ctrl-C; writes
session, map, trajectories and numbers.
"""

_EPILOG = rf"""
With ROS 2, whose stamps are seconds since 1970 (sed -u passes every line on at once; awk may not):

  PYTHONUNBUFFERED=1 ros2 topic echo --csv /odom nav_msgs/msg/Odometry |
    sed -uE '{CSV_TO_TUM}' |
    uwb-slam run --rig robot.toml --odometry - --odometry-clock unix

With an emulator in another terminal, which has both radars and odometry:

  xethru-emulator serve lab --link-dir ports
  uwb-slam run --rig robot.toml --odometry ports/odometry.sock
"""


def add_run(run: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Add them, and return the parser."""
    run.formatter_class = argparse.RawDescriptionHelpFormatter
    run.description, run.epilog = _DESCRIPTION, _EPILOG
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

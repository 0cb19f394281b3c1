"""The options of `uwb-slam convert`; light, for `--help`."""

from __future__ import annotations

import argparse
from pathlib import Path

from slam.app.arguments import count

_DESCRIPTION = (
    "IN is a session, then OUT is a MATLAB file of detections if its name "
    "ends in .mat, the raw bytes of one port if in .xtwire, a bag of ROS 1 if in .bag, or "
    "else a new folder with a bag of ROS 2; or IN is a .mat or a bag, then OUT is a "
    "session, which replay, view and report take."
)


def add_convert(convert: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Add them, and return the parser."""
    convert.description = _DESCRIPTION
    convert.add_argument(
        "source", type=Path, metavar="IN", help="session.mcap, *.mat, *.bag or folder"
    )
    convert.add_argument("out", type=Path, metavar="OUT", help="must not exist")
    convert.add_argument(
        "--rig", type=Path, help="where the radars of a bag sit, named UWBradar1 and so on"
    )
    convert.add_argument(
        "--frame-area",
        type=float,
        nargs=2,
        metavar=("START", "END"),
        help="what the modules of a bag were asked for, module metres (default: 0.2 9.4)",
    )
    convert.add_argument(
        "--truth", default="/slam_out_pose", metavar="TOPIC", help="default: %(default)s"
    )
    convert.add_argument(
        "--rate", type=count, default=5, help="states/s of a .mat, which has no stamps (default: 5)"
    )
    convert.add_argument(
        "--preset",
        help="settings of SLAM (default: a session's own; for a bag robust, for a .mat paper)",
    )
    convert.add_argument("--radar", metavar="NAME", help="whose raw bytes, for .xtwire")
    return convert

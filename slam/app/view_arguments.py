"""Arguments of `view`, `report` and `--rerun`; light, for `--help`."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from slam.app.arguments import folder
from slam.app.view_targets import CONNECT, DEFAULT_VIEWER_URL, SERVE_WEB, SPAWN


def rerun_target(text: str) -> str:
    """Return `spawn`, `serve-web`, or the address of a viewer."""
    if text in {SPAWN, SERVE_WEB}:
        return text
    if text == CONNECT:
        return DEFAULT_VIEWER_URL
    if text.startswith(("rerun+http://", "rerun+https://")) and text.endswith("/proxy"):
        return text
    raise argparse.ArgumentTypeError(
        f"must be {SPAWN}, {CONNECT}, {SERVE_WEB}, or an address like {DEFAULT_VIEWER_URL}, "
        f"not {text!r}"
    )


def add_rerun(parser: argparse.ArgumentParser) -> None:
    """Add `--rerun`: watch a run while it happens."""
    parser.add_argument(
        "--rerun",
        type=rerun_target,
        metavar="WHERE",
        help="watch live: spawn (a window), serve-web (a page for a browser), connect (a viewer "
        f"at {DEFAULT_VIEWER_URL}), or the address of another viewer",
    )


def add_view(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `uwb-slam view`."""
    parser.add_argument(
        "session", type=Path, metavar="SESSION", help="a session.mcap, an .rrd, or a run's folder"
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--web", action="store_true", help="serve a page for a browser")
    where.add_argument("--out", type=folder, metavar="FILE.rrd", help="write a file, show nothing")
    where.add_argument(
        "--screenshot", type=folder, metavar="FILE.png", help="write a picture, no window needed"
    )
    parser.add_argument(
        "--at",
        type=_seconds,
        metavar="S",
        help="when the screenshot is taken, since the first scan (default: the end)",
    )


def add_report(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `uwb-slam report`."""
    parser.add_argument(
        "session", type=Path, metavar="SESSION", help="a session.mcap, or a run's folder"
    )
    parser.add_argument(
        "--out", type=folder, metavar="FILE.html", help="(default: report.html beside the session)"
    )


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value >= 0.0):
        raise argparse.ArgumentTypeError(f"must be seconds, 0 or more, not {text!r}")
    return value

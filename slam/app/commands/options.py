"""Types of command-line arguments, and options that several commands share."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from slam.app.view import CONNECT, DEFAULT_VIEWER_URL, SERVE_WEB, SPAWN
from xethru_protocol.validation import shown


def folder(text: str) -> Path:
    """Return a path to write to; it must be UTF-8, which Rerun's writer requires."""
    try:
        text.encode()
    except UnicodeEncodeError:
        raise argparse.ArgumentTypeError(f"must be a UTF-8 name, not {shown(text)}") from None
    return Path(text)


def seed(text: str) -> int:
    """Return the seed of a random generator: a whole number, 0 or more."""
    return _whole_number(text, least=0)


def count(text: str) -> int:
    """Return how many of something: a whole number, 1 or more."""
    return _whole_number(text, least=1)


def _whole_number(text: str, *, least: int) -> int:
    if not text.isascii() or not text.isdigit() or not least <= int(text) < 2**63:
        raise argparse.ArgumentTypeError(
            f"must be a whole number, {least} or more, not {shown(text)}"
        )
    return int(text)


def seconds(text: str) -> float:
    """Return a time in seconds, finite, 0 or more."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value >= 0.0):
        raise argparse.ArgumentTypeError(f"must be seconds, 0 or more, not {shown(text)}")
    return value


def add_rerun(parser: argparse.ArgumentParser) -> None:
    """Add `--rerun`, which shows a run while it happens."""
    parser.add_argument(
        "--rerun",
        type=_rerun_target,
        metavar="WHERE",
        help="watch live: spawn (a window), serve-web (a page for a browser), connect (a viewer "
        f"at {DEFAULT_VIEWER_URL}), or the address of another viewer",
    )


def add_lean(parser: argparse.ArgumentParser) -> None:
    """Add `--lean`, which keeps a session small."""
    parser.add_argument(
        "--lean",
        action="store_true",
        help="leave out of the session what only other viewers draw: B-scans, paths, ellipses",
    )


def _rerun_target(text: str) -> str:
    if text in {SPAWN, SERVE_WEB}:
        return text
    if text == CONNECT:
        return DEFAULT_VIEWER_URL
    if text.startswith(("rerun+http://", "rerun+https://")) and text.endswith("/proxy"):
        return text
    raise argparse.ArgumentTypeError(
        f"must be {SPAWN}, {CONNECT}, {SERVE_WEB}, or an address like {DEFAULT_VIEWER_URL}, "
        f"not {shown(text)}"
    )

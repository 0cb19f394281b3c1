"""What `uwb-slam sweep` left behind, for pictures of it."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from emulator.bounded_file import read_bounded
from slam.app.errors import AppError

_MOST_BYTES = 1 << 28
_NEEDED = {"scene", "preset", "settings", "stress", "ate_rmse_m", "anees_pose", "nis_times"}


def add_sweep_argument(parser: argparse.ArgumentParser, default: str, made_by: str) -> None:
    """Add `--sweep`, the result file to look at."""
    parser.add_argument(
        "--sweep",
        type=Path,
        default=Path(default),
        metavar="JSON",
        help=f"result of {made_by} (default: %(default)s)",
    )


def read_groups(path: Path, result: Path) -> list[dict[str, Any]]:
    """Return the groups of a sweep's result file, in its order.

    Raises
    ------
    AppError
        It cannot be read, no sweep wrote it, or `result`, which is about to be written, would
        replace it; one line.
    """
    if result.resolve() == path.resolve():
        raise AppError(f"{path}: the result would replace the sweep; choose another --out")
    try:
        groups: list[dict[str, Any]] = json.loads(read_bounded(path, _MOST_BYTES))["groups"]
        complete = all(group.keys() >= _NEEDED for group in groups)
    except OSError as error:
        raise AppError(
            f"{path}: cannot be read: {error.strerror or error}; `uwb-slam sweep --json` writes it"
        ) from None
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        complete, groups = False, []
    if not groups or not complete:
        raise AppError(f"{path}: is not a result of this version's `uwb-slam sweep --json`")
    return groups

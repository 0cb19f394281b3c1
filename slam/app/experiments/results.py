"""How an experiment leaves its numbers: a JSON file and a short table."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from slam.app.errors import naming


def write_json(path: Path, numbers: Mapping[str, object]) -> None:
    """Write the numbers; NaN is refused, None stands for what there is not.

    Raises
    ------
    AppError
        The file cannot be written.
    """
    text = json.dumps(numbers, indent=2, allow_nan=False)
    with naming(path):
        path.write_text(text + "\n", encoding="ascii")


def print_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Write a table to stdout: names to the left, everything else to the right."""
    table = [header, *rows]
    widths = [max(len(row[column]) for row in table) for column in range(len(header))]
    rule = "-" * max(len(title), sum(widths) + 2 * (len(widths) - 1))
    lines = [
        "  ".join(
            cell.ljust(width) if column == 0 else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in table
    ]
    sys.stdout.write("\n".join([title, rule, lines[0], rule, *lines[1:], rule]) + "\n")

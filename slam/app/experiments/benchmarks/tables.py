"""Text files of numbers in columns, and what is wrong in them in one line."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.app.errors import AppError
from xethru_protocol.system import read_bounded
from xethru_protocol.validation import reason_of, shown

Array = NDArray[np.float64]

_MAX_BYTES = 1 << 28
_DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
REMEDY = "docs/benchmarks.md says where the data are from and how to lay out the folder"


def read_lines(path: Path, what: str) -> list[str]:
    """Return the lines of a text file; AppError if it cannot be read, or holds nothing."""
    try:
        text = read_bounded(path, _MAX_BYTES).decode("ascii")
    except UnicodeDecodeError as error:
        number = error.object[: error.start].count(b"\n") + 1
        raise AppError(f"{path}, line {number}: no ASCII text; it must be {what}") from None
    except OSError as error:
        reason = reason_of(error)
        raise AppError(f"{path}: cannot be read: {reason}; it is {what}; {REMEDY}") from None
    if not text.strip():
        raise AppError(f"{path}: holds nothing; it must be {what}; {REMEDY}")
    return text.split("\n")


def rows_of(path: Path, what: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the words of each line that is neither empty nor a comment (#)."""
    for number, line in enumerate(read_lines(path, what), start=1):
        words = line.split()
        if words and not words[0].startswith("#"):
            yield number, words


def number_of(word: str) -> float:
    """Return a finite decimal number; ValueError if the word is not one."""
    value = float(word) if _DECIMAL.fullmatch(word) else math.nan
    if not math.isfinite(value):
        raise ValueError(f"{shown(word)} is no finite decimal number")
    return value


def bad_line(path: Path, number: int, why: object) -> AppError:
    return AppError(
        f"{path}, line {number}: {why}; delete the line if it is damaged, or get the file anew"
    )


def read_table(path: Path, columns: Sequence[str], *, ascending: bool = False) -> Array:
    """Return the rows of a table of numbers, shape (n, number of columns), n >= 1.

    Lines that begin with `#` are skipped. With ``ascending`` the first column, a time, may not go
    back. Raises AppError that names the file, the line and what is wrong in it.
    """
    what = f"a table of {', '.join(columns)}"
    rows: list[list[float]] = []
    for number, words in rows_of(path, what):
        if len(words) != len(columns):
            raise bad_line(
                path, number, f"{len(words)} numbers, not {len(columns)} ({', '.join(columns)})"
            )
        try:
            rows.append([number_of(word) for word in words])
        except ValueError as error:
            raise bad_line(path, number, error) from None
        if ascending and len(rows) > 1 and rows[-1][0] < rows[-2][0]:
            raise bad_line(path, number, f"its {columns[0]} is before that of the line before")
    if not rows:
        raise AppError(f"{path}: holds no row; it must be {what}; {REMEDY}")
    return np.array(rows)


def folder_at(path: Path) -> Path:
    """Return the folder; AppError if it is not a folder."""
    if not path.is_dir():
        raise AppError(f"{path}: no such folder; {REMEDY}")
    return path


def found(folder: Path, pattern: str) -> list[Path]:
    """Return the files of a folder that match, by name; AppError if there are none."""
    paths = sorted(path for path in folder_at(folder).glob(pattern) if path.is_file())
    if not paths:
        raise AppError(f"{folder}: holds no {pattern}; {REMEDY}")
    return paths

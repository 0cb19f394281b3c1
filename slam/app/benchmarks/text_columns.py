"""Text files in columns: a row per line, and what is wrong in a file in one line."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slam.live.errors import AppError
from xethru_protocol.operating_system import read_bounded
from xethru_protocol.validation import reason_of, shown

Array = NDArray[np.float64]

_MAX_BYTES = 1 << 28
_DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")
REMEDY = "docs/benchmarks.md says where the data are from and how to lay out the folder"


@dataclass(frozen=True, slots=True, kw_only=True)
class TableRow:
    """One line of a file: its kind, the words in columns of names, the values in the others."""

    path: Path
    line: int
    kind: str
    names: tuple[str, ...]
    values: tuple[float, ...]

    def error(self, why: object) -> AppError:
        return AppError(
            f"{self.path}, line {self.line}: {why}; delete the line if it is damaged, or get the "
            "file anew"
        )


def read_rows(path: Path, columns: Mapping[str, str]) -> list[TableRow]:
    """Read a file with at least one row; empty lines and comments (#) are skipped.

    ``columns`` has, by the word that a line of the kind begins with, the columns behind that word;
    those in brackets are names, the others finite decimal numbers. Under the key "" are the columns
    of lines that begin with their first column.

    Raises AppError that names the file, the line and what is wrong in it.
    """
    what = " or ".join(f"{kind} {text}".strip() for kind, text in columns.items())
    rows = [_row(path, line, words, columns) for line, words in _lines(path, what)]
    if not rows:
        raise AppError(f"{path}: holds no row; it must be a table of {what}; {REMEDY}")
    return rows


def read_table(path: Path, columns: str, *, ascending: bool = False) -> Array:
    """Return the rows of a table of numbers, shape (n, number of columns), n >= 1.

    With ``ascending`` the first column, a time, may not go back. Raises AppError like `read_rows`.
    """
    rows = read_rows(path, {"": columns})
    if ascending:
        check_ascending(rows)
    return np.array([row.values for row in rows])


def check_ascending(rows: list[TableRow]) -> None:
    """Raise AppError if the first value of a row, a time, is less than that of the row before."""
    for before, row in pairwise(rows):
        if row.values[0] < before.values[0]:
            raise row.error(f"its time is before that of line {before.line}")


def _lines(path: Path, what: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the number and the words of each line that is neither empty nor a comment."""
    try:
        text = read_bounded(path, _MAX_BYTES).decode("ascii")
    except UnicodeDecodeError as error:
        line = error.object[: error.start].count(b"\n") + 1
        raise AppError(f"{path}, line {line}: must be ASCII text: a table of {what}") from None
    except OSError as error:
        raise AppError(
            f"{path}: cannot be read: {reason_of(error)}; it is a table of {what}; {REMEDY}"
        ) from None
    for line, each in enumerate(text.split("\n"), start=1):
        words = each.split()
        if words and not words[0].startswith("#"):
            yield line, words


def _row(path: Path, line: int, words: list[str], columns: Mapping[str, str]) -> TableRow:
    kind = "" if "" in columns else words.pop(0)
    row = TableRow(path=path, line=line, kind=kind, names=(), values=())
    if kind not in columns:
        raise row.error(f"{shown(kind)} is not one of {', '.join(columns)}")
    expected = columns[kind].split()
    if len(words) != len(expected):
        raise row.error(f"{len(words)} columns, not {len(expected)} ({columns[kind]})")
    names, values = [], []
    for word, column in zip(words, expected, strict=True):
        if column.startswith("["):
            names.append(word)
            continue
        try:
            values.append(number_of(word))
        except ValueError as error:
            raise row.error(error) from None
    return TableRow(path=path, line=line, kind=kind, names=tuple(names), values=tuple(values))


def number_of(word: str) -> float:
    """Return a finite decimal number; ValueError for another word."""
    value = float(word) if _DECIMAL.fullmatch(word) else math.nan
    if not math.isfinite(value):
        raise ValueError(f"{shown(word)} must be a finite decimal number")
    return value


def folder_at(path: Path) -> Path:
    """Return the folder; AppError if it does not exist."""
    if not path.is_dir():
        raise AppError(f"{path}: no such folder; {REMEDY}")
    return path


def found(folder: Path, pattern: str) -> list[Path]:
    """Return the files of a folder that match, by name; AppError if no file does."""
    paths = sorted(path for path in folder_at(folder).glob(pattern) if path.is_file())
    if not paths:
        raise AppError(f"{folder}: holds no {pattern}; {REMEDY}")
    return paths

"""What a sweep has done so far, in a file that a later run of the same command goes on with.

The file is a JSON object, ``{"command": {...}, "runs": [...]}``, whole after every run: each is
appended over the closing brackets by one write.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from slam.app.errors import AppError, naming
from slam.app.sweep_run import SweepRun

_TAIL = b"\n]}\n"


@dataclass(frozen=True, slots=True, kw_only=True)
class _Contents:
    command: dict[str, str]
    runs: list[SweepRun]


_READER: TypeAdapter[_Contents] = TypeAdapter(_Contents)


class PartFile:
    """The file OUT.part: made new, or read and continued.

    Parameters
    ----------
    path
        An existing file; empty if there is nothing to go on with.
    command
        What the runs depend on, in words by name; must be what the file says.

    Attributes
    ----------
    runs
        Done so far, in the order in which they were.

    Raises
    ------
    AppError
        It holds the runs of another command, or no such thing; nothing is changed then.
    """

    def __init__(self, path: Path, command: Mapping[str, str]) -> None:
        self.path = path
        self.runs: list[SweepRun] = []
        try:
            content = path.read_bytes()
        except OSError as error:
            raise AppError(f"{path}: cannot be read: {error.strerror or error}") from None
        if content:
            self.runs = _runs_of(path, content, command)
            self._end = content.rindex(_TAIL)
            return
        head = f'{{"command": {json.dumps(dict(command), indent=1)},\n"runs": ['.encode()
        with naming(path):
            path.write_bytes(head + _TAIL)
        self._end = len(head)

    def add(self, run: SweepRun) -> None:
        """Append a run.

        Raises
        ------
        AppError
            The file cannot be written.
        """
        text = json.dumps(asdict(run), allow_nan=False).encode()
        separator = b",\n" if self.runs else b"\n"
        with naming(self.path), self.path.open("r+b", buffering=0) as file:
            file.seek(self._end)
            file.write(separator + text + _TAIL)
            os.fsync(file.fileno())
        self._end += len(separator) + len(text)
        self.runs.append(run)


def _runs_of(path: Path, content: bytes, command: Mapping[str, str]) -> list[SweepRun]:
    remedy = "choose another --json, or move this file away"
    try:
        known = _READER.validate_json(content)
    except ValidationError:
        raise AppError(
            f"{path}: damaged, or not what a sweep left unfinished; {remedy} to begin anew"
        ) from None
    if not content.endswith(_TAIL):
        raise AppError(f"{path}: somebody else wrote behind the runs of a sweep; {remedy}")
    differing = [name for name in command if known.command.get(name) != command[name]]
    if differing or set(known.command) != set(command):
        names = ", ".join(differing or sorted(set(known.command) ^ set(command)))
        raise AppError(
            f"{path}: holds {len(known.runs)} runs of another sweep (other: {names}); "
            f"give that one's command to go on with it, {remedy}"
        )
    return known.runs

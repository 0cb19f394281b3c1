"""Errors a command of `uwb-slam` may end with: one line and an exit code."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from slam.live.errors import AppError

EXIT_USAGE = 2


class UsageError(AppError):
    """A command was called wrongly, for example with the name of a scene that does not exist."""

    exit_code = EXIT_USAGE


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Turn an OSError into an AppError that names the file."""
    try:
        yield
    except OSError as error:
        raise AppError(f"{path}: cannot be written: {error.strerror or error}") from None


class EmulatorError(AppError):
    """The emulator process did not start, or ended while it was needed."""

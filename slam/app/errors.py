"""Errors a command of `uwb-slam` may end with: one line and an exit code."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

EXIT_FAILED = 1
EXIT_USAGE = 2


class AppError(Exception):
    """A command failed; the message is one line that names the cause and the remedy."""

    exit_code = EXIT_FAILED


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


def refuse_pipe(path: Path) -> None:
    """Raise AppError if a path is a pipe: a recording is read more than once, or from its end."""
    if path.is_fifo():
        raise AppError(f"{path}: is a pipe; give a file")


class RadarSilentError(AppError):
    """A radar that was streaming sends no more frames."""


class EmulatorError(AppError):
    """The emulator process did not start, or ended while it was needed."""


class OdometryError(AppError):
    """Odometry is malformed, or does not cover a time that was asked for."""

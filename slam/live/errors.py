"""What modules, sessions and odometry fail with: one line that names the cause and the remedy."""

from __future__ import annotations

from pathlib import Path

EXIT_FAILED = 1


class AppError(Exception):
    """Something failed; the message is one line that names the cause and the remedy."""

    exit_code = EXIT_FAILED


class RadarSilentError(AppError):
    """A radar that was streaming sends no more frames."""


class OdometryError(AppError):
    """Odometry is malformed, or does not cover a time that was asked for."""


def refuse_pipe(path: Path) -> None:
    """Raise AppError if a path is a pipe: a recording is read more than once, or from its end."""
    if path.is_fifo():
        raise AppError(f"{path}: is a pipe; give a file")

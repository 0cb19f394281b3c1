"""The operating system for command lines: signals, closed streams, bounded files, locks.

Imports nothing heavy, so that a command line can stand under it while it imports the rest.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Protocol

MOST_BYTES = 1 << 20


def read_bounded(path: Path, most_bytes: int = MOST_BYTES) -> bytes:
    """Return all of a file, which may be a pipe.

    Raises
    ------
    OSError
        It cannot be read, or has more bytes than that.
    """
    with path.open("rb") as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise OSError(errno.EFBIG, f"longer than {most_bytes >> 20} MiB")
    return content


class PathInUseError(Exception):
    """Somebody else who still runs holds the path."""


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold an existing file or folder while the block runs.

    Only those who ask here keep each other out. A file system without locks keeps nobody out.

    Raises
    ------
    PathInUseError
        Another holds it.
    OSError
        It cannot be opened.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise PathInUseError(f"{path}: in use") from None
        except OSError:
            pass  # no locks here
        yield
    finally:
        os.close(descriptor)


class _Loop(Protocol):
    """What a request ends."""

    def stop(self) -> None:
        """End soon."""
        ...


class Stop:
    """A request to end that may come before there is a loop to end.

    Attributes
    ----------
    requested
        Whether a signal came.
    """

    def __init__(self) -> None:
        self._loop: _Loop | None = None
        self.requested = False

    def attach(self, loop: _Loop) -> None:
        """Name the loop that a request ends; one that came earlier ends it now."""
        self._loop = loop
        if self.requested:
            loop.stop()

    def detach(self) -> None:
        """Forget the loop, which is about to be closed."""
        self._loop = None

    def request(self, number: int, frame: FrameType | None) -> None:
        """Ask for the end; a signal handler."""
        del number, frame
        self.requested = True
        if self._loop is not None:
            self._loop.stop()


@contextlib.contextmanager
def stop_signals() -> Iterator[Stop]:
    """Turn SIGINT, SIGTERM and SIGHUP into an orderly end, from here to the last clean-up.

    A SIGHUP that is ignored already stays so, as whoever says `nohup` wants.
    """
    stop = Stop()
    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    before = {number: signal.signal(number, stop.request) for number in numbers}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def open_closed_streams() -> None:
    """Put the null device where the shell closed a standard stream (`>&-`).

    Python has None for such a stream, and the next file that is opened would get its descriptor.
    """
    for descriptor, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            _null_at(descriptor)
            setattr(sys, name, os.fdopen(descriptor, "w" if descriptor else "r", closefd=False))


def drop_what_cannot_be_said() -> None:
    """Send an output to the null device if it takes no more: its reader or its terminal has gone.

    What is left in a buffer would otherwise make the interpreter complain, and end with an exit
    code of its own, when it flushes at its end.
    """
    for descriptor, stream in enumerate((sys.stdout, sys.stderr), start=1):
        try:
            stream.flush()
        except (OSError, ValueError):
            _null_at(descriptor)


def _null_at(descriptor: int) -> None:
    opened = os.open(os.devnull, os.O_RDWR)
    if opened != descriptor:
        os.dup2(opened, descriptor)
        os.close(opened)

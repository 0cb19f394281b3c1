"""Orderly ends: SIGINT, SIGTERM and SIGHUP from the first moment on, before there is a loop.

Imports nothing heavy, so that a command line can stand under it while it imports the rest.
"""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from types import FrameType
from typing import Protocol

__all__ = ["Stop", "stop_signals"]


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

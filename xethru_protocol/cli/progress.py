"""Progress for people, on stderr: one line rewritten on a terminal, else a line now and then."""

import os
import sys
import time
from collections.abc import Callable
from typing import TextIO

from xethru_protocol.cli.output import is_terminal, show

_REWRITE_S = 0.2
_LINE_S = 10.0


class Progress:
    """Shows the newest of many states, not too often.

    Parameters
    ----------
    name
        What to begin lines of a log with, for example ``"xethru record"``.
    clock
        Monotonic time [s].
    """

    def __init__(self, name: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._name = name
        self._clock = clock
        self._rewrites = is_terminal(sys.stderr)
        self._shown_s = clock()
        self._is_open = False  # a line is there that ends in no line end

    def show(self, state: Callable[[], str]) -> None:
        """Show ``state()`` if it is time to."""
        now_s = self._clock()
        if now_s - self._shown_s < (_REWRITE_S if self._rewrites else _LINE_S):
            return
        self._shown_s = now_s
        if self._rewrites:
            show(rewriting(state(), sys.stderr))
            self._is_open = True
        else:
            show(f"{self._name}: {state()}\n")

    def finish(self, state: Callable[[], str]) -> None:
        """Bring a rewritten line up to date and end it."""
        if self._is_open:
            show(rewriting(state(), sys.stderr) + "\n")
            self._is_open = False


def rewriting(line: str, terminal: TextIO) -> str:
    """Text that replaces the line of a terminal, cut to fit: a longer one would scroll."""
    try:
        columns = os.get_terminal_size(terminal.fileno()).columns
    except (OSError, ValueError):  # it does not tell
        columns = 0
    return f"\r{line[: columns - 1] if columns else line}\x1b[K"


def counted(count: int, noun: str) -> str:
    """Write a number of things, for people.

    >>> counted(0, "frame"), counted(1, "frame"), counted(2, "frame")
    ('0 frames', '1 frame', '2 frames')
    """
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def bytes_text(count: int) -> str:
    """Amount of data, for people.

    >>> bytes_text(999), bytes_text(5_747_000)
    ('999 B', '5.7 MB')
    """
    value, unit = float(count), "B"
    for larger in ("kB", "MB", "GB", "TB"):
        if value < 1000:
            break
        value, unit = value / 1000, larger
    return f"{value:.0f} B" if unit == "B" else f"{value:.1f} {unit}"

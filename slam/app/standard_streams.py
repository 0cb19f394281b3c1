"""Standard streams as the rest expects them: there, and no reason to fail when they go away."""

from __future__ import annotations

import os
import sys


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

"""Processes that end when the process that started them does, however that ended."""

from __future__ import annotations

import ctypes
import signal
import sys
from collections.abc import Callable

_PR_SET_PDEATHSIG = 1


def signal_at_parents_death(which: signal.Signals) -> Callable[[], None] | None:
    """Return what a process calls to get a signal when its parent dies; None except on Linux.

    Strictly, when the thread that started it ends. The call is a single system call, as a
    `preexec_fn` must be.
    """
    if sys.platform != "linux":
        return None
    libc = ctypes.CDLL(None)
    return lambda: libc.prctl(_PR_SET_PDEATHSIG, which)

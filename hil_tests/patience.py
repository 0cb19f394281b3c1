"""How long tests wait for something before they fail: one factor for slow and busy machines.

These limits only end what hangs, so a large factor costs nothing while tests pass. The
environment variable ``XETHRU_TEST_PATIENCE`` sets it.
"""

import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

PATIENCE = float(os.environ.get("XETHRU_TEST_PATIENCE", "10"))


def seconds(limit_s: float) -> float:
    """Return the limit of time [s] for what takes less than ``limit_s`` on an idle machine."""
    return limit_s * PATIENCE


def patient_ns() -> int:
    """Return the time [ns] of a slow clock: a driver that has it waits longer for answers."""
    return round(time.monotonic_ns() / PATIENCE)


def wait_until(
    condition: Callable[[], object], process: subprocess.Popen[Any] | None = None
) -> None:
    """Return when the condition is true; AssertionError if the process ends or hangs before."""
    give_up_s = time.monotonic() + seconds(30)
    began_s = time.thread_time()
    while not condition():
        if process is not None and process.poll() is not None:
            raise AssertionError(f"it ended with {process.returncode}: {process.communicate()}")
        assert time.monotonic() < give_up_s, "what was waited for did not come"
        # a condition that reads a whole file is no reason to take the core from who writes it
        time.sleep(max(0.01, 4 * (time.thread_time() - began_s)))
        began_s = time.thread_time()


def catches(pid: int, number: signal.Signals) -> bool:
    """Tell whether a process has a handler of its own for a signal (Linux)."""
    (line,) = (
        line
        for line in Path(f"/proc/{pid}/status").read_text().splitlines()
        if line.startswith("SigCgt:")
    )
    return bool(int(line.split()[1], 16) >> (number - 1) & 1)

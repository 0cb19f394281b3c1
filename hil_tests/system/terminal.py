"""Commands in a real terminal that goes away under them, as when a connection breaks."""

import contextlib
import fcntl
import os
import select
import signal
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from hil_tests.patience import catches, wait_until
from xethru_protocol.operating_system import signal_at_parents_death

_REPORTER = """
import runpy, sys, threading, traceback
path, module = sys.argv[1:3]
del sys.argv[1:3]
def report(kind, error, trace, *_):
    with open(path, "a") as file:
        traceback.print_exception(kind, error, trace, file=file)
sys.excepthook = report
threading.excepthook = sys.unraisablehook = lambda crash: report(*crash[:3])
runpy.run_module(module, run_name="__main__", alter_sys=True)
"""
"""Runs a module as `python -m` does; tracebacks go to a file, as no terminal would show them."""


class Command:
    """A command that leads the session of a terminal.

    Attributes
    ----------
    process
        The command's.
    printed
        What came out of the terminal so far.
    """

    def __init__(self, process: subprocess.Popen[bytes], master: int, crashes: Path) -> None:
        self.process = process
        self.printed = b""
        self._master: int | None = master
        self._crashes = crashes

    @property
    def tracebacks(self) -> str:
        """Tracebacks of the command, wherever it wrote them; "" if there are none."""
        found = self._crashes.read_text() if self._crashes.exists() else ""
        return found + (self.printed.decode(errors="replace") if self._shows_one else "")

    @property
    def _shows_one(self) -> bool:
        return b"Traceback" in self.printed

    def echoes(self) -> bool:
        """Whether the terminal shows what is typed."""
        assert self._master is not None
        return bool(termios.tcgetattr(self._master)[3] & termios.ECHO)

    def read_until(self, condition: Callable[[], object]) -> None:
        """Show what the command prints until the condition is true; AssertionError if it ends."""

        def is_true() -> object:
            self.read()
            return condition()

        wait_until(is_true, self.process)

    def read(self) -> None:
        """Read what the terminal has to show, without waiting."""
        with contextlib.suppress(OSError):  # the command has ended, so it has no terminal
            while self._master is not None and select.select([self._master], [], [], 0.0)[0]:
                self.printed += os.read(self._master, 65536)

    def press(self, key: bytes) -> None:
        """Give the terminal a key, as its code."""
        assert self._master is not None
        os.write(self._master, key)

    def hang_up(self) -> None:
        """Close the terminal: the command gets SIGHUP, and errors from now on."""
        if self._master is not None:
            self.read()
            os.close(self._master)
            self._master = None

    def wait_for_handlers(self) -> None:
        """Return when the command has taken note of signals."""
        self.read_until(lambda: catches(self.process.pid, signal.SIGTERM))


@contextmanager
def in_terminal(
    module: str,
    arguments: Sequence[object],
    crashes: Path,
    *,
    ignores_hangup: bool = False,
    environment: Mapping[str, str] | None = None,
) -> Iterator[Command]:
    """Run ``python -m module arguments`` in a terminal of its own; kill it at the end.

    With ``ignores_hangup`` it is started as by `nohup`, but keeps the terminal for its output.
    """
    master, slave = os.openpty()
    end_with_parent = signal_at_parents_death(signal.SIGKILL)

    def lead_the_session() -> None:
        fcntl.ioctl(slave, termios.TIOCSCTTY, 0)
        if ignores_hangup:
            signal.signal(signal.SIGHUP, signal.SIG_IGN)
        if end_with_parent is not None:
            end_with_parent()

    with os.fdopen(slave, "rb", buffering=0) as terminal:
        process = subprocess.Popen(
            [sys.executable, "-c", _REPORTER, str(crashes), module, *map(str, arguments)],
            stdin=terminal,
            stdout=terminal,
            stderr=terminal,
            env={**os.environ, **(environment or {})},
            start_new_session=True,
            preexec_fn=lead_the_session,
        )
    command = Command(process, master, crashes)
    try:
        yield command
    finally:
        process.kill()
        process.wait()
        command.hang_up()

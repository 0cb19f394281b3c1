"""What a command of `uwb-slam` may end with: one line and an exit code, or a signal.

A signal only raises a flag; the program asks for it between two steps, so no file is left in the
middle of a record. A second signal of the same kind gets the system's default and ends the process
where it stands, for a user who does not want to wait; except SIGHUP, of which a closing terminal
sends two.
"""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any, Self

EXIT_FAILED = 1
EXIT_USAGE = 2


class AppError(Exception):
    """The thing asked for failed; the message is one line that names the thing and the remedy."""

    exit_code = EXIT_FAILED


class UsageError(AppError):
    """The command was called wrongly, for example with the name of a scene that does not exist."""

    exit_code = EXIT_USAGE


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Let a failing write say which file it is about; the system's own error does not always."""
    try:
        yield
    except OSError as error:
        raise AppError(f"{path}: cannot be written: {error.strerror or error}") from None


class RadarSilentError(AppError):
    """A radar that was streaming sends no more frames."""


class EmulatorError(AppError):
    """The emulator process did not start, or ended while it was needed."""


class OdometryError(AppError):
    """Odometry is malformed, or does not cover a time that was asked for."""


_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopRequestedError(Exception):
    """SIGINT, SIGTERM or SIGHUP arrived; carries the signal, and says what is left behind."""

    def __init__(self, received: signal.Signals, left_behind: str = "") -> None:
        super().__init__(f"stopped by {received.name}{left_behind}")
        self.received = received

    @property
    def exit_code(self) -> int:
        """What a shell expects of a program ended by this signal: 130, 143 or 129."""
        return 128 + int(self.received)


class StopFlag:
    """Catches SIGINT, SIGTERM and SIGHUP while it is entered; `check` raises once one arrived.

    A SIGHUP that is ignored already stays so, as whoever says `nohup` wants.

    Examples
    --------
    >>> with StopFlag() as stop:
    ...     stop.check()  # nothing arrived: returns
    """

    def __init__(self) -> None:
        self._received: signal.Signals | None = None
        self._previous: dict[signal.Signals, Any] = {}
        self._at_once = False

    def __enter__(self) -> Self:
        """Install the handlers. Main thread only, as Python demands."""
        for which in _SIGNALS:
            if which is not signal.SIGHUP or signal.getsignal(which) is not signal.SIG_IGN:
                self._previous[which] = signal.signal(which, self._on_signal)
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Put the previous handlers back."""
        for which, handler in self._previous.items():
            signal.signal(which, handler)

    def check(self) -> None:
        """Raise StopRequestedError if a signal arrived since this flag was entered."""
        if self._received is not None:
            raise StopRequestedError(self._received)

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Let a signal raise where it arrives: for waiting, where nothing is half-done."""
        try:
            # in this order: a signal is seen by the check, or raises where it arrives
            self._at_once = True
            self.check()
            yield
        finally:
            self._at_once = False

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self._received = signal.Signals(number)
        signal.signal(number, signal.SIG_IGN if number == signal.SIGHUP else signal.SIG_DFL)
        if self._at_once:
            self.check()

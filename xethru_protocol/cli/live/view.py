"""``xethru view``: a live picture in Rerun, in a browser or as text.

Every frame is taken; a picture is drawn as often as the display takes one. On a terminal, the key c
takes the next clutter filter.
"""

from __future__ import annotations

import os
import select
import shutil
import sys
import termios
import time
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Event, Thread
from typing import Any, Protocol

from xethru_protocol.cli.live.analysis import LiveAnalysis, LiveUpdate
from xethru_protocol.cli.live.sources import FrameSource, open_source
from xethru_protocol.cli.live.terminal_picture import Style, picture
from xethru_protocol.cli.live.viewer import ViewerError, ViewerKind, ViewerProcess
from xethru_protocol.cli.output import check_output, print_line, print_text, warn
from xethru_protocol.operating_system import STDOUT
from xethru_protocol.optional_packages import what_is_missing

_WINDOW_PERIOD_S, _BROWSER_PERIOD_S = 0.1, 0.2
_TERMINAL_PERIOD_S = 0.2
_SNAPSHOT_S = 10.0
_CLOSE_LIMIT_S = 3.0
_POLL_S = 0.1
_NEXT_CLUTTER = b"c"


class Display(Protocol):
    """Where updates are shown."""

    @property
    def is_open(self) -> bool:
        """Whether anybody can see it."""

    def is_due(self, t_s: float) -> bool:
        """Return whether the next picture should be drawn, the newest frame's time given."""

    def show(self, update: LiveUpdate) -> None:
        """Show an update, without waiting for the display."""

    def finish(self, update: LiveUpdate) -> None:
        """Show the last one."""


def view(arguments: Namespace) -> int:
    """Show frames until they end, the viewer is closed, or a signal comes."""
    with open_source(arguments) as source, _display(arguments) as display, _Keys() as keys:
        analysis = LiveAnalysis(source, clutter=arguments.clutter, window_s=arguments.window)
        show(source, display, analysis, keys)
    return 1 if source.faults else 0


def show(source: FrameSource, display: Display, analysis: LiveAnalysis, keys: _Keys) -> None:
    """Take every frame of a source; draw when the display is ready for it."""
    t_s = None
    for frame in source.frames:
        analysis.take(frame)
        t_s = frame.t_s
        for _ in range(keys.pressed().count(_NEXT_CLUTTER)):
            analysis.switch_clutter()
        if not display.is_open:
            return
        if display.is_due(t_s):
            display.show(analysis.update())
    if t_s is not None:
        display.finish(analysis.update())


@contextmanager
def _display(arguments: Namespace) -> Iterator[Display]:
    if arguments.terminal and STDOUT.is_terminal:
        with _Terminal() as terminal:
            yield terminal
    elif arguments.terminal:
        yield _Snapshots()
    else:
        kind = ViewerKind.WEB if arguments.web else ViewerKind.WINDOW
        name = f"xethru view {arguments.port or arguments.recording}"
        period_s = _BROWSER_PERIOD_S if arguments.web else _WINDOW_PERIOD_S
        with (
            ViewerProcess(kind, stays_open=False, memory_limit=arguments.memory) as process,
            _Viewer(process, name, period_s) as viewer,
        ):
            if arguments.web:
                warn(f"xethru view: watch at {process.web_url}")
            yield viewer


class _Keys:
    """Keys pressed on the terminal of standard input, without Enter; none if it is not a terminal.

    A terminal is read while this process is in its foreground only, and gets its mode back.
    """

    def __init__(self) -> None:
        try:
            self._terminal = sys.stdin.fileno() if sys.stdin.isatty() else None
        except (AttributeError, OSError, ValueError):  # closed, or none
            self._terminal = None
        self._mode: list[Any] | None = None

    def __enter__(self) -> _Keys:
        if self._terminal is not None and self._is_in_foreground():
            with suppress(termios.error):
                self._mode = termios.tcgetattr(self._terminal)
                at_once = list(self._mode)
                at_once[3] &= ~(termios.ICANON | termios.ECHO)
                termios.tcsetattr(self._terminal, termios.TCSADRAIN, at_once)
        return self

    def __exit__(self, *exception: object) -> None:
        if self._terminal is not None and self._mode is not None and self._is_in_foreground():
            with suppress(termios.error):
                termios.tcsetattr(self._terminal, termios.TCSADRAIN, self._mode)

    def pressed(self) -> bytes:
        """Return what was pressed since the last call, without waiting."""
        if self._terminal is None or self._mode is None or not self._is_in_foreground():
            return b""
        with suppress(OSError):  # the terminal was closed
            if select.select([self._terminal], [], [], 0.0)[0]:
                return os.read(self._terminal, 64)
        return b""

    def _is_in_foreground(self) -> bool:
        assert self._terminal is not None
        with suppress(OSError):
            return os.tcgetpgrp(self._terminal) == os.getpgrp()
        return False


def style_of_output() -> Style:
    """Return what standard output can show: colours on a terminal unless NO_COLOR is set.

    https://no-color.org
    """
    encoding = getattr(STDOUT.stream, "encoding", None) or "ascii"
    if "utf" not in encoding.lower():
        return Style.ASCII
    plain = os.environ.get("NO_COLOR") or os.environ.get("TERM") in {None, "", "dumb"}
    return Style.COLOUR if STDOUT.is_terminal and not plain else Style.UNICODE


class _Terminal:
    """Draws in place; a terminal that blocks gets no picture meanwhile."""

    is_open = True

    def __init__(self) -> None:
        self._drawn_s = -_TERMINAL_PERIOD_S
        self._size = (0, 0)

    def __enter__(self) -> _Terminal:
        STDOUT.offer("\x1b[?25l")  # no cursor
        return self

    def __exit__(self, *exception: object) -> None:
        STDOUT.write_soon(f"\x1b[0m\x1b[{self._size[1]};1H\n\x1b[?25h")

    def is_due(self, t_s: float) -> bool:
        return time.monotonic() - self._drawn_s >= _TERMINAL_PERIOD_S

    def show(self, update: LiveUpdate) -> None:
        self._drawn_s = time.monotonic()
        STDOUT.offer(self._text(update))
        check_output()

    def finish(self, update: LiveUpdate) -> None:
        print_text(self._text(update))

    def _text(self, update: LiveUpdate) -> str:
        size = shutil.get_terminal_size()
        lines = picture(update, size.columns, size.lines, style_of_output())
        clear = "" if size == self._size else "\x1b[2J"
        self._size = (size.columns, size.lines)
        return f"{clear}\x1b[H" + "\x1b[K\r\n".join(lines) + "\x1b[K"


class _Snapshots:
    """Prints a picture now and then, by the time of the frames, and at the end."""

    is_open = True

    def __init__(self) -> None:
        self._next_s = _SNAPSHOT_S

    def is_due(self, t_s: float) -> bool:
        return t_s >= self._next_s

    def show(self, update: LiveUpdate) -> None:
        self._next_s += _SNAPSHOT_S
        self.finish(update)

    def finish(self, update: LiveUpdate) -> None:
        size = shutil.get_terminal_size()
        for line in picture(update, size.columns, size.lines, style_of_output()):
            print_line(line.rstrip())
        print_line("")


class _Viewer:
    """Draws in a Rerun viewer, in a thread, so that a slow viewer delays no frame.

    Rerun is imported in that thread, too: a signal raises in the main one, which modules written in
    C do not pass on while they are imported.
    """

    def __init__(self, process: ViewerProcess, name: str, period_s: float) -> None:
        self._process, self._name, self._period_s = process, name, period_s
        self._newest: LiveUpdate | None = None
        self._wanted, self._connected, self._ending = Event(), Event(), Event()
        self._failure: Exception | None = None
        self._thread = Thread(target=self._run, daemon=True)

    def __enter__(self) -> _Viewer:
        self._process.wait_until_ready()
        self._thread.start()
        self._connected.wait()
        self._check()
        return self

    def __exit__(self, *exception: object) -> None:
        """Let the thread send what is left, if the viewer takes it in time."""
        self._ending.set()
        self._wanted.set()
        self._thread.join(0.0 if self._process.has_ended else _CLOSE_LIMIT_S)

    @property
    def is_open(self) -> bool:
        self._check()
        return not self._process.has_ended

    def is_due(self, t_s: float) -> bool:
        return not self._wanted.is_set()

    def show(self, update: LiveUpdate) -> None:
        self._newest = update
        self._wanted.set()

    def finish(self, update: LiveUpdate) -> None:
        """Leave the last picture until the viewer is closed."""
        self.show(update)
        warn("xethru view: no more frames; close the viewer or press Ctrl-C")
        while self.is_open:
            time.sleep(_POLL_S)

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        try:
            self._draw_all()
        except ModuleNotFoundError as error:
            missing = what_is_missing(error, extra="live")
            self._failure = ViewerError(missing) if missing else error
        except Exception as error:
            if not self._process.has_ended:  # which is the reason then
                self._failure = error
        finally:
            self._connected.set()

    def _draw_all(self) -> None:
        from xethru_protocol.cli.live.rerun_view import RerunPicture, connect

        stream = connect(self._process.url, self._name)
        drawing = RerunPicture(stream)
        self._connected.set()
        while not self._ending.is_set():
            self._wanted.wait()
            if self._newest is not None:
                drawing.draw(self._newest)
            self._ending.wait(self._period_s)
            self._wanted.clear()
        stream.disconnect()

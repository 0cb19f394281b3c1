"""What publishes a run while it happens: sinks, each with a queue and a thread of its own.

The run hands events over and goes on. A sink that is slow loses the oldest events of its queue; one
that fails, blocks or goes away loses its own only. Both are counted, and logged once.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from functools import partial
from importlib import import_module
from types import TracebackType
from typing import Protocol, Self
from uuid import uuid4

from slam.app.errors import UsageError
from slam.app.publish import SINKS
from slam.live.errors import AppError
from slam.live.session_records import LogLine, Scan, SessionInfo, SessionObserver, Snapshot
from slam.results import SmoothedRun
from xethru_protocol.validation import choices, shown

MOST_EVENTS = 256
"""Events that wait for a sink: at 20 scans/s those of some seconds."""
CLOSE_S = 2.0
"""How long the end of a run waits for its sinks, all together."""
_MAP_ID_LETTERS = 12


class Sink(SessionObserver):
    """A place that a run is published to.

    The constructor gets what stands behind the kind and its colon in a SINK of the command line,
    and checks it: it raises UsageError, and opens nothing. `open` is called before the run begins,
    in the main thread. The other methods, `begin` first and `close` last, are called in the thread
    of the sink, one after another; what they raise is counted, logged once and costs nothing but
    the event. Events are shared with the run and must not be changed. Only methods that a subclass
    defines get events.

    Attributes
    ----------
    takes_stdout
        Whether it writes to standard output, so that results must go elsewhere.
    """

    takes_stdout = False

    def open(self) -> None:
        """Take what the sink needs, as a port or a file; raise AppError if that is impossible.

        `close` gives it back; it is called without `begin`, too, if the run never began, but not
        after a failure of `open`.
        """

    def begin(self, info: SessionInfo, start_ns: int, map_id: str) -> None:
        """Learn about the run: no event precedes session time `start_ns`.

        `map_id` names the map of this run, and is of no other run.
        """


class Log(Protocol):
    """Logs a line about a subject of the run, as `LinkLog.log` does."""

    def __call__(self, subject: str, text: str, *, warning: bool) -> None: ...


def make_sink(spec: str) -> Sink:
    """Return the sink that a SINK of a command line names; UsageError if there is none such.

    Raises ModuleNotFoundError if a package is missing that the sink needs.
    """
    kind, _, text = spec.partition(":")
    if kind not in SINKS:
        raise UsageError(f"--publish {shown(spec)}: unknown kind of sink; {choices(kind, SINKS)}")
    module, _, name = SINKS[kind].sink.partition(":")
    try:
        sink: Sink = getattr(import_module(module), name)(text)
    except UsageError as error:
        raise UsageError(f"--publish {shown(spec)}: {error}") from None
    return sink


_METHODS = ("on_scan", "on_snapshot", "on_smoothed", "on_log")


class QueuedSink:
    """A sink with its queue and its thread.

    Attributes
    ----------
    n_sent
        Events that the sink took.
    n_dropped
        Events that found no room, or still waited at the end.
    n_failed
        Events that the sink raised an error for, or that came after it could not begin.
    """

    def __init__(self, spec: str, sink: Sink, most: int = MOST_EVENTS) -> None:
        self.spec, self._sink = spec, sink
        self.n_sent = self.n_dropped = self.n_failed = 0
        self._taken = {
            name for name in _METHODS if getattr(type(sink), name) is not getattr(Sink, name)
        }
        self._waiting: deque[tuple[str, object]] = deque(maxlen=most)
        self._changed = threading.Condition()
        self._is_over = self._is_gone = self._is_busy = self._is_closed = False
        self._warnings: dict[str, str] = {}  # by kind; "" once it was logged
        self._thread: threading.Thread | None = None

    def begin(self, info: SessionInfo, start_ns: int, map_id: str) -> None:
        """Start the thread, which begins the sink."""
        self._thread = threading.Thread(
            target=self._run,
            args=(info, start_ns, map_id),
            name=f"publish {self.spec}",
            daemon=True,  # one that blocks for ever does not hold up the end of the program
        )
        self._thread.start()

    def put(self, method: str, event: object) -> None:
        """Queue an event for a method of the sink; the oldest one goes if there is no room."""
        if method not in self._taken:
            return
        with self._changed:
            if self._is_gone:
                self.n_failed += 1
                return
            if len(self._waiting) == self._waiting.maxlen:
                self.n_dropped += 1
                self._warn("dropped", "is too slow, so its oldest events are dropped")
            self._waiting.append((method, event))
            self._changed.notify()

    def new_warnings(self) -> list[str]:
        """Return what is to be logged: each kind of trouble once."""
        with self._changed:
            new = [text for text in self._warnings.values() if text]
            self._warnings = dict.fromkeys(self._warnings, "")
        return new

    def end(self) -> None:
        """Let the thread deliver what waits, close the sink and end."""
        with self._changed:
            self._is_over = True
            self._changed.notify()

    def wait(self, until_s: float) -> None:
        """Wait for the end of the thread until a monotonic time; what still waits is dropped."""
        if self._is_closed:
            return
        self._is_closed = True
        if self._thread is None:
            with suppress(Exception):  # there was no run, whose end has an error of its own
                self._sink.close()
            return
        self._thread.join(max(until_s - time.monotonic(), 0.0))
        with self._changed:
            self.n_dropped += len(self._waiting) + self._is_busy
            self._is_gone, self._is_busy = True, False
            self._waiting.clear()

    def _run(self, info: SessionInfo, start_ns: int, map_id: str) -> None:
        if self._failure_of(partial(self._sink.begin, info, start_ns, map_id)):
            with self._changed:
                self._is_gone = True
                self.n_failed += len(self._waiting)
                self._waiting.clear()
        while (event := self._next()) is not None:
            method, what = event
            failed = self._failure_of(partial(getattr(self._sink, method), what))
            with self._changed:
                if self._is_busy:  # else the end did not wait for it
                    self.n_failed += failed
                    self.n_sent += not failed
                    self._is_busy = False
        self._failure_of(self._sink.close)

    def _next(self) -> tuple[str, object] | None:
        """Wait for an event; None at the end, or if the sink could not begin."""
        with self._changed:
            while not self._waiting:
                if self._is_over or self._is_gone:
                    return None
                self._changed.wait()
            self._is_busy = True
            return self._waiting.popleft()

    def _failure_of(self, act: Callable[[], object]) -> bool:
        """Return whether something raised, a panic of a compiled library, too."""
        try:
            act()
        except BaseException as error:
            with self._changed:
                self._warn("failed", f"{_reason(error)}; the run goes on")
            return True
        return False

    def _warn(self, kind: str, text: str) -> None:
        self._warnings.setdefault(kind, f"--publish {self.spec}: {text}")


def _reason(error: BaseException) -> str:
    match error:
        case AppError():
            return str(error)
        case OSError(strerror=str(reason)):
            return reason
    return f"{type(error).__name__}: {error}"


class _PublishedRun(SessionObserver):
    """Gives events to all sinks, and logs what happened to them."""

    def __init__(self, queued: Sequence[QueuedSink], log: Log, close: Callable[[], None]) -> None:
        self._queued, self._log, self._end = queued, log, close

    def on_scan(self, scan: Scan) -> None:
        self._put("on_scan", scan)

    def on_snapshot(self, snapshot: Snapshot) -> None:
        self._put("on_snapshot", snapshot)

    def on_smoothed(self, smoothed: SmoothedRun) -> None:
        self._put("on_smoothed", smoothed)

    def on_log(self, line: LogLine) -> None:
        for each in self._queued:
            each.put("on_log", line)

    def close(self) -> None:
        self._end()

    def _put(self, method: str, event: object) -> None:
        for each in self._queued:
            each.put(method, event)
            for text in each.new_warnings():
                self._log("run", text, warning=True)


class Publishing:
    """The sinks of a run, open while it is entered; `observer` gives a run to them.

    Parameters
    ----------
    specs
        Each a SINK of the command line.

    Attributes
    ----------
    queued
        The sinks that are open, or were.

    Raises
    ------
    UsageError
        A spec is none, or is given twice; nothing was opened.
    ModuleNotFoundError
        A package is missing that a sink needs.
    AppError
        On entering: a sink cannot be opened.
    """

    def __init__(self, specs: Sequence[str]) -> None:
        for spec in specs:
            if specs.count(spec) > 1:
                raise UsageError(f"--publish {shown(spec)}: is given twice")
        self._sinks = {spec: make_sink(spec) for spec in specs}
        self.queued: list[QueuedSink] = []

    def __enter__(self) -> Self:
        with ExitStack() as opening:
            opening.callback(self._close)
            for spec, sink in self._sinks.items():
                sink.open()
                self.queued.append(QueuedSink(spec, sink))
            opening.pop_all()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._close()

    def observer(self, info: SessionInfo, log: Log, start_ns: int = 0) -> SessionObserver:
        """Begin all sinks, and return what gives them the events of a run.

        What goes wrong with them is logged by `log`, in the thread of the run.
        """
        map_id = uuid4().hex[:_MAP_ID_LETTERS]
        for sink in self.queued:
            sink.begin(info, start_ns, map_id)
        return _PublishedRun(self.queued, log, self._close)

    @property
    def takes_stdout(self) -> bool:
        """Whether a sink writes to standard output."""
        return any(sink.takes_stdout for sink in self._sinks.values())

    def rows(self) -> list[tuple[str, str, str]]:
        """Return a row of the table of results for every sink, with what was not logged yet."""
        rows = []
        for each in self.queued:
            counts = f"events sent, {each.n_dropped} dropped, {each.n_failed} failed"
            note = "; ".join([f"{counts}: {each.spec}", *each.new_warnings()])
            rows.append((f"to {each.spec.partition(':')[0]}", f"{each.n_sent}", note))
        return rows

    def _close(self) -> None:
        until_s = time.monotonic() + CLOSE_S
        for each in self.queued:
            each.end()
        for each in self.queued:
            each.wait(until_s)

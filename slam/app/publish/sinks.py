"""What publishes a run while it happens: sinks, each with a queue and a thread of its own.

The run hands events over and goes on. A sink that is slow loses the oldest events of its queue; one
that fails, blocks or goes away loses its own only. Both are counted, and logged once.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from uuid import uuid4

from slam.app.errors import UsageError
from slam.app.publish import SINKS
from slam.live.errors import AppError
from slam.live.session_records import METHODS, Event, SessionInfo, SessionObserver
from xethru_protocol.validation import choices, shown

MOST_EVENTS = 256
"""Events that wait for a sink: at 20 scans/s those of some seconds."""
CLOSE_S = 2.0
"""How long the end of a run waits for its sinks, all together."""


class Sink(SessionObserver):
    """A place that a run is published to.

    The constructor gets what stands behind the kind and its colon in a SINK of the command line,
    and checks it: it raises UsageError, and opens nothing. `open` is called before the run begins,
    in the main thread. The other methods, `begin` first and `close` last, are called in the thread
    of the sink, one after another; what they raise is counted, logged once and costs nothing but
    the event. Events are shared with the run and must not be changed. Only methods that a subclass
    defines get events.
    """

    takes_stdout = False
    """Whether it writes to standard output, so that results must go elsewhere."""

    def __init__(self, text: str) -> None: ...

    def open(self) -> None:
        """Take what the sink needs, as a port or a file; raise AppError if that is impossible.

        `close` gives it back; it is called without `begin`, too, if the run never began, but not
        after a failure of `open`.
        """

    def begin(self, info: SessionInfo, start_ns: int, map_id: str) -> None:
        """Learn about the run: no event precedes session time `start_ns`.

        `map_id` names the map of this run, and is of no other run.
        """


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


class QueuedSink:
    """A sink that is open, with its queue and its thread.

    Attributes
    ----------
    n_put, n_sent, n_failed
        Events for the sink; those that it took; those that it raised an error for, or that came
        after it could not begin.
    warnings
        What is to be logged: each kind of trouble once.
    """

    def __init__(self, spec: str, sink: Sink) -> None:
        self.spec, self._sink = spec, sink
        self.n_put = self.n_sent = self.n_failed = 0
        self.warnings: list[str] = []
        self._warned: set[str] = set()
        self._waiting: deque[Event] = deque(maxlen=MOST_EVENTS)
        self._changed = threading.Condition()
        self._is_over = False
        self._thread: threading.Thread | None = None

    @property
    def n_dropped(self) -> int:
        """Events that found no room, or that the end did not wait for."""
        return self.n_put - self.n_sent - self.n_failed - len(self._waiting)

    def begin(self, info: SessionInfo, start_ns: int, map_id: str) -> None:
        self._thread = threading.Thread(
            target=self._run,
            args=(info, start_ns, map_id),
            name=f"publish {self.spec}",
            daemon=True,  # one that blocks for ever does not hold up the end of the program
        )
        self._thread.start()

    def put(self, event: Event) -> None:
        """Queue an event for the sink; the oldest one goes if there is no room."""
        method = METHODS[type(event)]
        if getattr(type(self._sink), method) is getattr(Sink, method):
            return
        with self._changed:
            self.n_put += 1
            if len(self._waiting) == MOST_EVENTS:
                self._warn("dropped", "is too slow, so its oldest events are dropped")
            self._waiting.append(event)
            self._changed.notify()

    def end(self) -> None:
        """Let the thread deliver what waits, close the sink and end."""
        with self._changed:
            self._is_over = True
            self._changed.notify()

    def wait(self, until_s: float) -> None:
        """Wait for the end of the thread until a monotonic time; what still waits is dropped."""
        if self._thread is not None:
            self._thread.join(max(until_s - time.monotonic(), 0.0))
            with self._changed:  # a sink that blocks does not hold it
                self._waiting.clear()
            return
        with suppress(Exception):  # there was no run, whose end has an error of its own
            self._sink.close()

    def _run(self, info: SessionInfo, start_ns: int, map_id: str) -> None:
        has_begun = self._try(self._sink.begin, info, start_ns, map_id)
        while (event := self._next()) is not None:
            is_sent = has_begun and self._try(self._sink.take, event)
            self.n_sent += is_sent
            self.n_failed += not is_sent
        self._try(self._sink.close)

    def _next(self) -> Event | None:
        """Wait for an event; None at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_over)
            return self._waiting.popleft() if self._waiting else None

    def _try(self, act: Callable[..., object], *arguments: object) -> bool:
        """Return whether nothing was raised, also no panic of a compiled library."""
        try:
            act(*arguments)
        except BaseException as error:
            reason = error.strerror if isinstance(error, OSError) else None
            name = "" if isinstance(error, AppError) else f"{type(error).__name__}: "
            self._warn("failed", f"{reason or f'{name}{error}'}; the run goes on")
            return False
        return True

    def _warn(self, kind: str, text: str) -> None:
        if kind not in self._warned:
            self._warned.add(kind)
            self.warnings.append(f"--publish {self.spec}: {text}")


class Publishing(SessionObserver):
    """The sinks of a run, which are opened here; gives them events, from `begin` on.

    `specs` are a SINK of the command line each. `takes_stdout`: one writes to standard output.

    Raises
    ------
    UsageError, ModuleNotFoundError
        A spec is none or given twice, or a package is missing; nothing was opened.
    AppError
        A sink cannot be opened; the others were closed.
    """

    def __init__(self, specs: Sequence[str]) -> None:
        for spec in specs:
            if specs.count(spec) > 1:
                raise UsageError(f"--publish {shown(spec)}: is given twice")
        sinks = {spec: make_sink(spec) for spec in specs}
        self.takes_stdout = any(sink.takes_stdout for sink in sinks.values())
        self.queued: list[QueuedSink] = []
        self._is_closed = False
        try:
            for spec, sink in sinks.items():
                sink.open()
                self.queued.append(QueuedSink(spec, sink))
        except BaseException:
            self.close()
            raise

    def begin(self, info: SessionInfo, log: Callable[..., None], start_ns: int = 0) -> None:
        """Begin all sinks; `log` is `LinkLog.log` of the run, called in the run's thread."""
        self._log, map_id = log, uuid4().hex
        for each in self.queued:
            each.begin(info, start_ns, map_id)

    def close(self) -> None:
        """End all sinks; doing so again does nothing."""
        if self._is_closed:
            return
        self._is_closed = True
        until_s = time.monotonic() + CLOSE_S
        for each in self.queued:
            each.end()
        for each in self.queued:
            each.wait(until_s)

    def rows(self) -> list[tuple[str, str, str]]:
        """Return a row of the table of results for every sink, with what was not logged yet."""
        rows = []
        for each in self.queued:
            counts = f"events sent, {each.n_dropped} dropped, {each.n_failed} failed"
            note = "; ".join([f"{counts}: {each.spec}", *each.warnings])
            rows.append((f"to {each.spec.partition(':')[0]}", f"{each.n_sent}", note))
        return rows

    def take(self, event: Event) -> None:
        if self._is_closed:  # as for the radar image of the end of a run
            return
        for each in self.queued:
            each.put(event)
            while each.warnings:  # each line comes back by `on_log`
                self._log("run", each.warnings.pop(0), warning=True)

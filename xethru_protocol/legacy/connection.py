"""The receiving side of a ModuleConnector: a thread that reads the line, and a queue per message.

The vendor's library receives in a thread and keeps what comes until the script takes it; so does a
`MessageQueues`. Several scripts' idioms rest on that: ``while peek: read`` empties a queue,
``read`` waits for the next message.
"""

import sys
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol, TypeVar

from xethru_protocol.driver.matching import ProtocolRecord
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire.errors import Disconnected, ResponseTimeout, XeThruError
from xethru_protocol.wire.table import Response

T = TypeVar("T")
Taker = Callable[[Response, int], None]

QUEUED = 4096
"""Messages of a kind that wait unread; then the oldest is dropped."""

_LISTEN_S = 0.5  # after which the thread sees that it is to end
_TOO_LONG_S = 10.0  # after which a line says what a script waits for
_LOGGED_FROM = 5  # the level of a ModuleConnector's log from which every command is shown


class ModuleConnectorError(XeThruError, RuntimeError):
    """What a call of an old script could not do; scripts catch `RuntimeError`."""


def report(text: str) -> None:
    """Write a line for the script's user."""
    print(text, file=sys.stderr)  # noqa: T201 - what the vendor prints


class MessageSource(Protocol):
    """Where a connection's messages come from: a module, or a recording that is played."""

    name: str

    def attach(self, take: Taker) -> None:
        """Begin to hand over messages and their time of arrival [ns, monotonic]."""

    def close(self) -> None:
        """Hand over nothing more; may be called twice."""

    def why_ended(self) -> str | None:
        """Return why nothing more will come; None while something may."""


class ModuleSource:
    """A module at a port."""

    def __init__(self, port: str, log_level: int) -> None:
        self.log_level = log_level
        self.radar = X4M300.open(port, observer=self._log, queue_frames=1)
        self.name = port
        self._closed = False
        self._ended: str | None = None
        self._restarting = False
        self._thread = threading.Thread(
            target=self._listen, name=f"ModuleConnector {port}", daemon=True
        )

    def attach(self, take: Taker) -> None:
        self.radar.listeners.add(take)
        self._thread.start()

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        if self._thread is not threading.current_thread():  # which closes the line when it ends
            self.radar.close()
            if self._thread.is_alive():
                self._thread.join()

    def why_ended(self) -> str | None:
        return "the ModuleConnector was closed" if self._closed else self._ended

    def restart(self) -> None:
        """Restart the module and wait until it is back."""
        self._restarting = True
        try:
            self.radar.reset(wait=True)
        finally:
            self._restarting = False

    def _listen(self) -> None:
        self._listen_until_closed()
        if self._closed:
            self.radar.close()

    def _listen_until_closed(self) -> None:
        while not self._closed:
            try:
                # what the driver keeps is the listener's already
                self.radar.read_message(Response, timeout_s=_LISTEN_S)
            except ResponseTimeout:
                continue
            except Disconnected as error:
                if not self._restarting:
                    self._ended = str(error)
                    return
                time.sleep(_LISTEN_S)
            except XeThruError as error:
                self._ended = str(error)
                return

    def _log(self, record: ProtocolRecord) -> None:
        if self.log_level >= _LOGGED_FROM:
            report(f"{self.name} {record.direction}: {record.summary}")


class MessageQueues:
    """Queues of what a source sent, by type of message.

    Every message goes to ``listeners``, too, with its arrival [ns, monotonic]; what is in
    ``on_close`` is called when the source is closed.
    """

    def __init__(self, source: MessageSource) -> None:
        self.source = source
        self.listeners: list[Taker] = []
        self.on_close: list[Callable[[], None]] = []
        self.is_left = False  # by the block that opened it
        self._queues: dict[type[Response], deque[Response]] = {}
        self._came = threading.Condition()
        OPEN.add(self)
        source.attach(_weak_take(self))

    def take(self, message: Response, arrival_ns: int) -> None:
        for listener in tuple(self.listeners):
            listener(message, arrival_ns)
        with self._came:
            queue = self._queues.get(type(message))
            if queue is None:
                queue = self._queues[type(message)] = deque(maxlen=QUEUED)
            queue.append(message)
            self._came.notify_all()

    def waiting(self, kind: type[Response]) -> int:
        """Count the messages of a type that were not read yet."""
        with self._came:
            return len(self._queues.get(kind, ()))

    def read(self, kind: type[T], call: str) -> T:
        """Take the oldest message of a type; waits without limit while one may come.

        Raises
        ------
        ModuleConnectorError
            If none can come any more: unplugged, closed, the recording ended.
        """
        began_s, warned = time.monotonic(), False
        with self._came:
            while True:
                queue = self._queues.get(kind)  # type: ignore[arg-type]  # as the keys
                if queue:
                    return queue.popleft()  # type: ignore[return-value]  # a queue holds one kind
                if reason := self.source.why_ended():
                    raise ModuleConnectorError(f"{call}: {reason}")
                self._came.wait(_LISTEN_S)
                if not warned and time.monotonic() - began_s > _TOO_LONG_S:
                    warned = True
                    report(
                        f"{call} has waited {_TOO_LONG_S:g} s for a message of {self.source.name}; "
                        "was its output switched on, and the radar or the profile started? Frames "
                        "of XEP come in mode MANUAL only: set_sensor_mode(XTID_SM_STOP, 0), then "
                        "(XTID_SM_MANUAL, 0)"
                    )

    def close(self) -> None:
        with suppress(KeyError):
            OPEN.remove(self)
        self.source.close()
        for call in self.on_close:
            call()


def _weak_take(connection: MessageQueues) -> Taker:
    reference = weakref.WeakMethod(connection.take)

    def take(message: Response, arrival_ns: int) -> None:
        method = reference()
        if method is not None:
            method(message, arrival_ns)

    return take


OPEN: "weakref.WeakSet[MessageQueues]" = weakref.WeakSet()
"""Connections that were not closed yet."""


def close_all() -> None:
    """Close every connection that a script left open."""
    for connection in list(OPEN):
        connection.close()


def close_left(port: str) -> None:
    """Close connections of a port whose block has ended, for another to open it."""
    for connection in list(OPEN):
        if connection.is_left and connection.source.name == port:
            connection.close()

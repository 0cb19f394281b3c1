"""What passes over the line to a radar, kept with its time, and decoded."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from xethru_protocol.transport import Transport
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import NEED_DATA, FramingFault
from xethru_protocol.wire.messages import Message

MOST_BYTES = 32 << 20  # of one test, some five minutes of frames; then the oldest go

Way = Literal["rx", "tx"]


@dataclass(frozen=True, slots=True)
class WireBytes:
    """Bytes from the module (``rx``) or the host (``tx``), and the driver's clock [ns].

    Packets may begin and end anywhere in them.
    """

    way: Way
    data: bytes
    t_ns: int


class WireTap:
    """What passed over the lines to one radar, oldest first.

    ``started_unix_ns`` and ``started_ns`` are wall clock and driver's clock at one moment.
    ``forgotten_bytes`` counts what was dropped from the beginning.
    """

    def __init__(self, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self.clock_ns = clock_ns
        self.started_unix_ns = time.time_ns()
        self.started_ns = clock_ns()
        self.forgotten_bytes = 0
        self._kept: deque[WireBytes] = deque()
        self._bytes = 0

    @property
    def passed(self) -> tuple[WireBytes, ...]:
        return tuple(self._kept)

    def note(self, way: Way, data: bytes) -> None:
        self._kept.append(WireBytes(way, data, self.clock_ns()))
        self._bytes += len(data)
        while self._bytes > MOST_BYTES:
            size = len(self._kept.popleft().data)
            self._bytes -= size
            self.forgotten_bytes += size

    def around(self, transport: Transport) -> TappedTransport:
        """Return a line that passes everything on and notes it."""
        return TappedTransport(transport, self)


class TappedTransport:
    """A line that notes what passes; every other attribute is the line's own."""

    def __init__(self, line: Transport, tap: WireTap) -> None:
        self._line = line
        self._tap = tap

    @property
    def name(self) -> str:
        return self._line.name

    def read(self, timeout_s: float) -> bytes:
        data = self._line.read(timeout_s)
        if data:
            self._tap.note("rx", data)
        return data

    def write(self, data: bytes) -> None:
        self._tap.note("tx", bytes(data))
        self._line.write(data)

    def close(self) -> None:
        self._line.close()

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - capacity and baud rate, where a line has them
        return getattr(self._line, name)


def decoded(tap: WireTap) -> Iterator[tuple[WireBytes, Sequence[Message | FramingFault]]]:
    """Yield each piece that passed with the messages and faults that it completed.

    Commands are read as the module reads them, answers as the driver does.
    """
    ends = {"tx": Connection(Role.MODULE), "rx": Connection(Role.HOST)}
    for passed in tap.passed:
        end = ends[passed.way]
        end.receive_data(passed.data)
        events: list[Message | FramingFault] = []
        while (event := end.next_event()) is not NEED_DATA:
            if isinstance(event, Message | FramingFault):
                events.append(event)
        yield passed, events

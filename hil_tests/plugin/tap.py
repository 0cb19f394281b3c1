"""Keeps the bytes that passed between driver and module, for the artefacts of a test that fails."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

from xethru_protocol.transport import Transport

__all__ = ["TappedTransport", "WireBytes", "WireTap"]

MOST_BYTES = 32 << 20  # of one test, some five minutes of frames; then the oldest go

Way = Literal["rx", "tx"]


@dataclass(frozen=True, slots=True)
class WireBytes:
    """Bytes that passed together.

    Attributes
    ----------
    way
        ``rx``: from the module; ``tx``: from the host.
    data
        As they passed: packets may begin and end anywhere.
    t_ns
        The driver's clock, ns; of a module in this process, virtual.
    """

    way: Way
    data: bytes
    t_ns: int


class WireTap:
    """What passed over the lines to one radar, oldest first.

    Attributes
    ----------
    clock_ns
        The driver's clock.
    started_unix_ns, started_ns
        Wall clock and driver's clock at one moment, so that a reader can date what passed.
    forgotten_bytes
        Bytes that were dropped from the beginning.
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
        """What is kept."""
        return tuple(self._kept)

    def note(self, way: Way, data: bytes) -> None:
        """Keep what passed."""
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
    """A line with a tap; what else it can do, the line itself does."""

    def __init__(self, line: Transport, tap: WireTap) -> None:
        self._line = line
        self._tap = tap

    @property
    def name(self) -> str:
        """Name of the line."""
        return self._line.name

    def read(self, timeout_s: float) -> bytes:
        """See `Transport.read`."""
        data = self._line.read(timeout_s)
        if data:
            self._tap.note("rx", data)
        return data

    def write(self, data: bytes) -> None:
        """See `Transport.write`."""
        self._tap.note("tx", bytes(data))
        self._line.write(data)

    def close(self) -> None:
        """See `Transport.close`."""
        self._line.close()

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - capacity and baud rate, where a line has them
        """Return what the line itself has."""
        return getattr(self._line, name)

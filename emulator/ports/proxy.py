"""A real module behind a pseudo-terminal: its bytes pass through, spoiled only if faults are armed.

The module's bytes are cut into packets on their way, because faults are of packets; what stays
incomplete for 50 ms goes on as it is. Nothing is added, removed or reordered by that.
"""

from __future__ import annotations

import selectors
import time
from collections import deque
from collections.abc import Callable

from emulator.ports.event_loop import Service, wait_for
from xethru_protocol.recordings.wire_capture import WireCapture
from xethru_protocol.transport import LineTransport
from xethru_protocol.wire.errors import Disconnected
from xethru_protocol.wire.framing import Direction, NeedData, PacketReader

HOLD_NS = 50_000_000
"""How long an incomplete packet waits for the rest of it."""
MOST_UNSENT = 65_536
MOST_WAITING = 1 << 20


class ModuleLine(Service):
    """A module's port as a device, and as a `Service` of the server's loop.

    Parameters
    ----------
    line
        The open port; closed by `close`.
    capture
        Gets all bytes as they pass the port.
    gone
        Called once when the port vanished.
    """

    def __init__(
        self, line: LineTransport, capture: WireCapture | None, gone: Callable[[], None]
    ) -> None:
        self._line = line
        self._capture = capture
        self._gone = gone
        self._selector: selectors.BaseSelector | None = None
        self._unsent = b""
        self._reader = PacketReader(Direction.FROM_MODULE)
        self._unjudged = bytearray()
        self._passed = 0  # bytes of it that went on before they were judged
        self._since_ns: int | None = None
        self._packets: deque[bytes] = deque()
        self._waiting = 0
        self._alive = True

    # --- as a device ----------------------------------------------------------------------------

    @property
    def wants_data(self) -> bool:
        return len(self._unsent) < MOST_UNSENT

    def receive_data(self, data: bytes, now_ns: int) -> None:
        if not self._alive or not data:
            return
        if self._capture is not None:
            self._capture.write("tx", data, time.time_ns())
        self._unsent += data
        self._write()

    def advance(self, now_ns: int) -> None:
        if self._since_ns is not None and now_ns - self._since_ns >= HOLD_NS:
            self._put(bytes(self._unjudged[self._passed :]))
            self._passed = len(self._unjudged)
            self._since_ns = None

    def next_packet(self, now_ns: int) -> bytes | None:
        if not self._packets:
            return None
        packet = self._packets.popleft()
        self._waiting -= len(packet)
        self._watch()
        return packet

    def wake_ns(self, now_ns: int) -> int | None:
        return None if self._since_ns is None else self._since_ns + HOLD_NS

    def port_present(self, now_ns: int) -> bool:
        return self._alive

    # --- as a service ---------------------------------------------------------------------------

    def register(self, selector: selectors.BaseSelector) -> None:
        self._selector = selector
        self._watch()

    def close(self) -> None:
        self._selector = None
        self._line.close()

    def _ready(self, events: int, now_ns: int) -> None:
        if events & selectors.EVENT_WRITE:
            self._write()
        if events & selectors.EVENT_READ:
            self._read(now_ns)

    def _read(self, now_ns: int) -> None:
        try:
            data = self._line.read(0.0)
        except Disconnected:
            self._lost()
            return
        if not data:
            return
        if self._capture is not None:
            self._capture.write("rx", data, time.time_ns())
        self._unjudged += data
        self._reader.receive_data(data)
        while not isinstance(self._reader.next_packet(), NeedData):
            end = len(self._unjudged) - self._reader.buffered
            self._put(bytes(self._unjudged[self._passed : end]))
            self._passed = max(self._passed - end, 0)
            del self._unjudged[:end]
        self._since_ns = now_ns if len(self._unjudged) > self._passed else None
        self._watch()

    def _put(self, data: bytes) -> None:
        if data:
            self._packets.append(data)
            self._waiting += len(data)

    def _write(self) -> None:
        try:
            self._unsent = self._unsent[self._line.write_some(self._unsent) :]
        except Disconnected:
            self._lost()
            return
        self._watch()

    def _watch(self) -> None:
        if self._selector is None or not self._alive:
            return
        wanted = selectors.EVENT_WRITE if self._unsent or self._line.unsent else 0
        wanted |= selectors.EVENT_READ if self._waiting < MOST_WAITING else 0
        wait_for(self._selector, self._line.fileno(), wanted, self._ready)

    def _lost(self) -> None:
        if self._selector is not None:
            wait_for(self._selector, self._line.fileno(), 0)
        self._alive = False
        self._unsent = b""
        self._gone()

"""What happens to bytes between a module and its port on a UART: time, rates.

A line is pure: bytes and times in, bytes out. A port without one passes bytes at once, as USB does.
What the module sends goes at the module's rate and is received at the host's, and the other way
round. Each packet is followed by an idle line, which is where a receiver that lost synchronisation
finds it again.

Source: protocol reference 4.10 and chapter 10; field notes 4.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from emulator.chip.chip import NS_PER_S
from emulator.module.settings import BITS_PER_BYTE, received_bytes

SLICE_NS = 4_000_000
"""A UART's bytes are handed over in pieces of so much line time, as adapters do."""
UART_MOST_UNDER_WAY = 4096
"""Bytes of a host; what it writes beyond waits on its side, as in its driver's buffer."""


class Flight:
    """Pieces of bytes under way in one direction, in order, each with its time of arrival."""

    def __init__(self) -> None:
        self._pieces: deque[tuple[int, bytes]] = deque()
        self._size = 0

    def put(self, due_ns: int, piece: bytes) -> None:
        self._pieces.append((due_ns, piece))
        self._size += len(piece)

    def take(self, now_ns: int) -> bytes:
        """Return what has arrived and was not taken before."""
        arrived: list[bytes] = []
        while self._pieces and self._pieces[0][0] <= now_ns:
            arrived.append(self._pieces.popleft()[1])
        data = b"".join(arrived)
        self._size -= len(data)
        return data

    def next_ns(self) -> int | None:
        """Return when more arrives; None if nothing is under way."""
        return self._pieces[0][0] if self._pieces else None

    def clear(self) -> None:
        self._pieces.clear()
        self._size = 0

    @property
    def is_empty(self) -> bool:
        """Whether nothing is under way, not even a piece of which nothing is received."""
        return not self._pieces

    def __len__(self) -> int:
        return self._size


class UartLine:
    """A line with a rate at each end.

    It has no flow control: the bits come whether the host reads them or not.

    Parameters
    ----------
    module_baud
        Returns the module's rate now, bit/s.
    host_baud
        Returns the host's, bit/s; None where it has none: then it is always the module's.
    """

    def __init__(self, module_baud: Callable[[], int], host_baud: Callable[[], int | None]) -> None:
        self.to_host = Flight()
        self.to_module = Flight()
        self._module_baud = module_baud
        self.host_baud = host_baud
        self._host_done_ns = 0

    @property
    def takes_packet(self) -> bool:
        """Whether the module may send another packet."""
        return self.to_host.is_empty  # a UART has no room for two

    @property
    def takes_bytes(self) -> bool:
        """Whether more should be read from the host."""
        return len(self.to_module) < UART_MOST_UNDER_WAY

    def from_module(self, packet: bytes, now_ns: int) -> None:
        _send(self.to_host, packet, now_ns, self._module_baud(), self._baud_of_host())

    def from_host(self, data: bytes, now_ns: int) -> None:
        """Take bytes of the host; they follow on those it wrote before."""
        begin_ns = max(now_ns, self._host_done_ns)
        sent, read = self._baud_of_host(), self._module_baud()
        self._host_done_ns = _send(self.to_module, data, begin_ns, sent, read)

    def flush_output(self) -> None:
        """Lose what the host wrote and did not send yet, as it asked for."""
        self.to_module.clear()
        self._host_done_ns = 0

    def clear(self) -> None:
        """Lose all that is under way: the line is cut."""
        self.to_host.clear()
        self.flush_output()

    def _baud_of_host(self) -> int:
        baud = self.host_baud()
        return self._module_baud() if baud is None else baud


def _send(flight: Flight, data: bytes, begin_ns: int, sent_baud: int, read_baud: int) -> int:
    """Send bytes off in slices, as they are received; return when the last bit has gone."""
    if sent_baud <= 0:
        return begin_ns  # hung up: nothing is sent
    end_ns = begin_ns + -(-len(data) * BITS_PER_BYTE * NS_PER_S // sent_baud)
    received = received_bytes(data, sent_baud, read_baud)
    n_slices = max(-(-(end_ns - begin_ns) // SLICE_NS), 1)
    done = 0
    for index in range(1, n_slices + 1):
        due_ns = min(begin_ns + index * SLICE_NS, end_ns)
        # all but the last slice hold whole bytes that have passed by then
        until = len(received) * (due_ns - begin_ns) // (end_ns - begin_ns) if data else 0
        if until > done or index == n_slices:
            flight.put(due_ns, received[done:until])
        done = until
    return end_ns

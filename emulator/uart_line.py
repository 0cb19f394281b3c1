"""A UART: ten bits per byte, no flow control, and garbage between ends of different rates.

What the module sends goes at the module's rate and is heard at the host's, and the other way
round. Each packet is followed by an idle line, which is where a receiver that lost its way finds
it again.

Source: protocol reference 4.10 and chapter 10; field notes 4.
"""

from __future__ import annotations

from collections.abc import Callable

from emulator.line import Flight
from emulator.uart_bits import BITS_PER_BYTE, what_is_heard

__all__ = ["UartLine"]

NS_PER_S = 1_000_000_000
SLICE_NS = 4_000_000
"""Bytes are handed over in pieces of so much line time, as adapters do."""
MOST_UNDER_WAY = 4096
"""Bytes of a host; what it writes beyond waits on its side, as in its driver's buffer."""


class UartLine:
    """A line with a rate at each end.

    Parameters
    ----------
    module_baud
        Returns the module's rate now, bit/s.
    host_baud
        Returns the host's, bit/s; None where it has none: then it is always the module's.

    Attributes
    ----------
    host_baud
        As given.
    """

    def __init__(self, module_baud: Callable[[], int], host_baud: Callable[[], int | None]) -> None:
        self._module_baud = module_baud
        self.host_baud = host_baud
        self._to_host = Flight()
        self._to_module = Flight()
        self._host_done_ns = 0

    @property
    def takes_packet(self) -> bool:
        """Whether the last packet has left: a UART has no room for two."""
        return self._to_host.is_empty

    @property
    def waits_for_host(self) -> bool:
        """False: without flow control the bits come whether anybody listens or not."""
        return False

    @property
    def takes_bytes(self) -> bool:
        """Whether the host may write on."""
        return len(self._to_module) < MOST_UNDER_WAY

    def from_module(self, packet: bytes, now_ns: int) -> None:
        """Take a packet of the module."""
        sent, read = self._module_baud(), self._baud_of_host()
        _send(self._to_host, packet, now_ns, sent, read)

    def to_host(self, now_ns: int) -> bytes:
        """Return what has arrived."""
        return self._to_host.take(now_ns)

    def from_host(self, data: bytes, now_ns: int) -> None:
        """Take bytes of the host; they follow on those it wrote before."""
        begin_ns = max(now_ns, self._host_done_ns)
        sent, read = self._baud_of_host(), self._module_baud()
        self._host_done_ns = _send(self._to_module, data, begin_ns, sent, read)

    def to_module(self, now_ns: int) -> bytes:
        """Return what has arrived."""
        return self._to_module.take(now_ns)

    def to_host_ns(self) -> int | None:
        """Return when the next piece arrives."""
        return self._to_host.next_ns()

    def to_module_ns(self) -> int | None:
        """Return when the next piece arrives."""
        return self._to_module.next_ns()

    def flush_output(self) -> None:
        """Lose what the host wrote and did not send yet, as it asked for."""
        self._to_module.clear()
        self._host_done_ns = 0

    def clear(self) -> None:
        """Lose all that is under way."""
        self._to_host.clear()
        self.flush_output()

    def _baud_of_host(self) -> int:
        baud = self.host_baud()
        return self._module_baud() if baud is None else baud


def _send(flight: Flight, data: bytes, begin_ns: int, sent_baud: int, read_baud: int) -> int:
    """Send bytes off in slices, as they are heard; return when the last bit has gone."""
    if sent_baud <= 0:
        return begin_ns  # hung up: nothing is sent
    end_ns = begin_ns + -(-len(data) * BITS_PER_BYTE * NS_PER_S // sent_baud)
    heard = what_is_heard(data, sent_baud, read_baud)
    n_slices = max(-(-(end_ns - begin_ns) // SLICE_NS), 1)
    done = 0
    for index in range(1, n_slices + 1):
        due_ns = min(begin_ns + index * SLICE_NS, end_ns)
        # all but the last slice hold whole bytes that have passed by then
        until = len(heard) * (due_ns - begin_ns) // (end_ns - begin_ns) if data else 0
        if until > done or index == n_slices:
            flight.put(due_ns, heard[done:until])
        done = until
    return end_ns

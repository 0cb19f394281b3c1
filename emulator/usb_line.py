"""USB CDC with its delays: transfers of at most 512 bytes, each a while under way.

The baud rate is ignored. Without a latency a port needs no line at all.

Source: protocol reference chapter 10.
"""

from __future__ import annotations

from emulator.line import Flight

__all__ = ["UsbLine"]

LARGEST_TRANSFER = 512
MOST_UNDER_WAY = 65536
"""Bytes in one direction; more wait at the sender."""


class UsbLine:
    """A line that delays.

    Parameters
    ----------
    latency_ns
        From one end to the other, in either direction.
    """

    def __init__(self, latency_ns: int) -> None:
        self._latency_ns = latency_ns
        self._to_host = Flight()
        self._to_module = Flight()

    @property
    def takes_packet(self) -> bool:
        """Whether not too much is under way."""
        return len(self._to_host) < MOST_UNDER_WAY

    @property
    def waits_for_host(self) -> bool:
        """True: the host's controller fetches bytes when it has room for them."""
        return True

    @property
    def takes_bytes(self) -> bool:
        """Whether not too much is under way."""
        return len(self._to_module) < MOST_UNDER_WAY

    def from_module(self, packet: bytes, now_ns: int) -> None:
        """Take a packet of the module."""
        self._send_off(self._to_host, packet, now_ns)

    def to_host(self, now_ns: int) -> bytes:
        """Return what has arrived, one transfer at most at a time."""
        return self._to_host.take_one(now_ns)

    def from_host(self, data: bytes, now_ns: int) -> None:
        """Take bytes of the host."""
        self._send_off(self._to_module, data, now_ns)

    def to_module(self, now_ns: int) -> bytes:
        """Return what has arrived, one transfer at most at a time."""
        return self._to_module.take_one(now_ns)

    def to_host_ns(self) -> int | None:
        """Return when the next transfer arrives."""
        return self._to_host.next_ns()

    def to_module_ns(self) -> int | None:
        """Return when the next transfer arrives."""
        return self._to_module.next_ns()

    def clear(self) -> None:
        """Lose all that is under way."""
        self._to_host.clear()
        self._to_module.clear()

    def _send_off(self, flight: Flight, data: bytes, now_ns: int) -> None:
        for begin in range(0, len(data), LARGEST_TRANSFER):
            flight.put(now_ns + self._latency_ns, data[begin : begin + LARGEST_TRANSFER])

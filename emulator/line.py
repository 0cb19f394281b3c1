"""What happens to bytes between a module and the descriptor of its port: time passes.

A line is pure: bytes and times in, bytes out. Without one, bytes pass at once.
"""

from __future__ import annotations

from collections import deque
from typing import Protocol

__all__ = ["Flight", "Line"]


class Line(Protocol):
    """What a port needs of a line: see `emulator.uart_line.UartLine`."""

    @property
    def takes_packet(self) -> bool:
        """Whether the module may send another packet."""
        ...

    @property
    def takes_bytes(self) -> bool:
        """Whether more should be read from the host."""
        ...

    @property
    def waits_for_host(self) -> bool:
        """Whether what the host's side has no room for waits; if not, it is lost."""
        ...

    def from_module(self, packet: bytes, now_ns: int) -> None:
        """Take a packet of the module."""
        ...

    def to_host(self, now_ns: int) -> bytes:
        """Return what has reached the host's side and was not returned before."""
        ...

    def from_host(self, data: bytes, now_ns: int) -> None:
        """Take bytes of the host."""
        ...

    def to_module(self, now_ns: int) -> bytes:
        """Return what has reached the module and was not returned before."""
        ...

    def to_host_ns(self) -> int | None:
        """Return when more reaches the host's side; None if nothing is under way."""
        ...

    def to_module_ns(self) -> int | None:
        """Return when more reaches the module; None if nothing is under way."""
        ...

    def clear(self) -> None:
        """Lose all that is under way: the line is cut."""
        ...


class Flight:
    """Pieces of bytes under way in one direction, in order, each with its time of arrival."""

    def __init__(self) -> None:
        self._pieces: deque[tuple[int, bytes]] = deque()
        self._size = 0

    def put(self, due_ns: int, piece: bytes) -> None:
        """Send a piece off."""
        self._pieces.append((due_ns, piece))
        self._size += len(piece)

    def take(self, now_ns: int) -> bytes:
        """Return all that has arrived."""
        arrived = []
        while self._pieces and self._pieces[0][0] <= now_ns:
            arrived.append(self._pieces.popleft()[1])
        data = b"".join(arrived)
        self._size -= len(data)
        return data

    def take_one(self, now_ns: int) -> bytes:
        """Return the first piece if it has arrived."""
        if not self._pieces or self._pieces[0][0] > now_ns:
            return b""
        _, piece = self._pieces.popleft()
        self._size -= len(piece)
        return piece

    def next_ns(self) -> int | None:
        """Return when the next piece arrives; None if none is under way."""
        return self._pieces[0][0] if self._pieces else None

    def clear(self) -> None:
        """Lose everything."""
        self._pieces.clear()
        self._size = 0

    @property
    def is_empty(self) -> bool:
        """Whether nothing is under way, not even a piece of which nothing is heard."""
        return not self._pieces

    def __len__(self) -> int:
        """Return the number of bytes under way."""
        return self._size

"""A line without a terminal: what is written on one side can be read on the other at once."""

from __future__ import annotations

import contextlib
import socket

__all__ = ["PairLine"]


class PairLine:
    """Both ends of a socket pair that holds a few packets; the module's is a `ByteLink`."""

    def __init__(self) -> None:
        self._end, self._host_end = socket.socketpair()
        for end in (self._end, self._host_end):
            end.setblocking(False)
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 16384)

    def fileno(self) -> int:
        return self._end.fileno()

    def read(self) -> bytes:
        return self._end.recv(4096)

    def write(self, data: memoryview) -> int:
        try:
            return self._end.send(data)
        except BlockingIOError:
            return 0

    def host_fileno(self) -> int:
        return self._host_end.fileno()

    def host_read(self) -> bytes:
        """Return what the module wrote; ``b""`` when there is nothing."""
        with contextlib.suppress(BlockingIOError):
            return self._host_end.recv(65536)
        return b""

    def host_write(self, data: bytes) -> int:
        """Write to the module what fits; return how much."""
        with contextlib.suppress(BlockingIOError):
            return self._host_end.send(data)
        return 0

    def close(self) -> None:
        self._end.close()
        self._host_end.close()

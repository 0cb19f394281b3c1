"""A module behind a TCP port: raw bytes, as serial-to-network adapters pass them."""

from __future__ import annotations

import select
import socket
import time

from xethru_protocol.errors import Disconnected, PortUnavailable

__all__ = ["TcpTransport"]

_CONNECT_S = 5.0
_WRITE_S = 5.0
_CHUNK_BYTES = 65536


class TcpTransport:
    """An `xethru_protocol.transport.Transport` over a TCP connection.

    Parameters
    ----------
    address
        ``host:port`` or ``tcp://host:port``.

    Raises
    ------
    PortUnavailable
        If nobody listens there.
    """

    def __init__(self, address: str) -> None:
        self.name = address if address.startswith("tcp://") else f"tcp://{address}"
        host, _, port = self.name.removeprefix("tcp://").rpartition(":")
        try:
            self._socket = socket.create_connection((host.strip("[]"), int(port)), _CONNECT_S)
        except (OSError, UnicodeError) as error:  # the latter of what is no name of a host
            reason = getattr(error, "strerror", None) or error
            raise PortUnavailable(
                f"{self.name} cannot be reached: {reason}; does the adapter, or "
                "'xethru-emulator serve --tcp', run there?"
            ) from None
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def read(self, timeout_s: float) -> bytes:
        """Return what has arrived, waiting up to ``timeout_s`` [s]; b"" if nothing."""
        try:
            ready, _, _ = select.select([self._socket], [], [], max(timeout_s, 0.0))
            if not ready:
                return b""
            data = self._socket.recv(_CHUNK_BYTES)
        except (OSError, ValueError) as error:  # ValueError: closed
            raise Disconnected(self._lost()) from error
        if not data:
            raise Disconnected(self._lost())
        return data

    def write(self, data: bytes) -> None:
        """Send all of ``data``."""
        rest = memoryview(data)
        deadline_s = time.monotonic() + _WRITE_S
        while rest:
            left_s = deadline_s - time.monotonic()
            if left_s <= 0:
                raise Disconnected(f"{self.name} takes no data any more; is the module hanging?")
            try:
                _, ready, _ = select.select([], [self._socket], [], left_s)
                if ready:
                    rest = rest[self._socket.send(rest) :]
            except BlockingIOError:
                continue
            except (OSError, ValueError) as error:
                raise Disconnected(self._lost()) from error

    def close(self) -> None:
        """Hang up; calling it again does nothing."""
        self._socket.close()

    def _lost(self) -> str:
        return (
            f"{self.name} hung up; is the module gone, or has another program taken it? "
            "(an adapter has one client at a time)"
        )

"""A module on a TCP port, as behind a serial-to-network adapter: raw bytes, one client at a time.

A client that comes while another one has the module is hung up on at once.
"""

from __future__ import annotations

import socket
from collections.abc import Callable

from emulator.ports.pty import LARGEST_READ, LinkError
from emulator.ports.sockets import Listener
from xethru_protocol.transport import keep_alive, listening_socket
from xethru_protocol.wire.errors import PortUnavailable

BACKLOG = 16
LAST_PORT = 65535


class TcpLink(Listener):
    """A listening socket and its one client: a line and a service of the loop.

    Parameters
    ----------
    port
        Port number; 0 for any that is free.
    admits
        Asked when a client connects while none is connected; False closes it.

    Attributes
    ----------
    port
        Number of the port, also where any was wanted.

    Raises
    ------
    LinkError
        When the port cannot be had.
    """

    def __init__(self, host: str, port: int, *, admits: Callable[[], bool]) -> None:
        self._admits = admits
        self._client: socket.socket | None = None
        if port > LAST_PORT:
            raise LinkError(f"{host}:{port}: cannot listen: ports end at {LAST_PORT}; lower --tcp")
        try:
            listener = listening_socket(host, port, BACKLOG)
        except PortUnavailable as error:
            raise LinkError(f"{error}; choose another --tcp or --tcp-host") from error
        super().__init__(listener)
        self.port: int = listener.getsockname()[1]

    def fileno(self) -> int:
        return -1 if self._client is None else self._client.fileno()

    def read(self) -> bytes:
        """Return what the client sent; ``b""`` if it sent nothing or has gone."""
        if self._client is None:
            return b""
        try:
            data = self._client.recv(LARGEST_READ)
        except BlockingIOError:
            return b""
        except OSError:  # reset by the client, or given up by the keep-alive
            data = b""
        if not data:
            self.hang_up()
        return data

    def write(self, data: memoryview) -> int:
        """Write as much as fits and return how much; for a client that has gone, all is lost."""
        if self._client is not None:
            try:
                return self._client.send(data)
            except BlockingIOError:
                return 0
            except OSError:
                self.hang_up()
        return len(data)

    def hang_up(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            self._hang_up(client)

    def close(self) -> None:
        self._selector = None  # the loop may be gone
        self.hang_up()
        super().close()

    def _admit(self, connection: socket.socket, now_ns: int) -> None:
        if self._client is not None or not self._admits():
            connection.close()
            return
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        keep_alive(connection)
        self._client = connection

"""A module on a TCP port, as behind a serial-to-network adapter: raw bytes, one client at a time.

A client that comes while another one has the module is hung up on at once.
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import os
import selectors
import socket
from collections.abc import Callable

from emulator.ports.event_loop import Service, wait_for
from emulator.ports.pty import LARGEST_READ, LinkError

BACKLOG = 16
LAST_PORT = 65535
_NO_DESCRIPTOR = frozenset({errno.EMFILE, errno.ENFILE})


def is_loopback(host: str) -> bool:
    """Whether a name or address surely stands for this machine only.

    Examples
    --------
    >>> [is_loopback(host) for host in ("127.0.0.1", "::1", "localhost", "0.0.0.0", "lab-pc")]
    [True, True, True, False, False]
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False  # a name may lead anywhere


class TcpLink(Service):
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
        self._selector: selectors.BaseSelector | None = None
        self._client: socket.socket | None = None
        if port > LAST_PORT:
            raise LinkError(f"{host}:{port}: cannot listen: ports end at {LAST_PORT}; lower --tcp")
        try:
            family, _, _, _, address = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0]
            self._listener = socket.create_server(
                (address[0], port), family=family, backlog=BACKLOG
            )
        except (OSError, UnicodeError) as error:  # the latter of a name that no host can have
            raise LinkError(
                f"{host}:{port}: cannot listen: {_reason(error)}; "
                "choose another --tcp or --tcp-host"
            ) from error
        self._listener.setblocking(False)
        self.port: int = self._listener.getsockname()[1]
        # given up for a moment to hang up on a client when descriptors have run out
        self._spare_fd = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)

    def register(self, selector: selectors.BaseSelector) -> None:
        self._selector = selector
        selector.register(self._listener, selectors.EVENT_READ, self._accept)

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
        if client is None:
            return
        if self._selector is not None:
            wait_for(self._selector, client.fileno(), 0)
        client.close()

    def close(self) -> None:
        self._selector = None
        self.hang_up()
        self._listener.close()
        if self._spare_fd >= 0:
            os.close(self._spare_fd)
            self._spare_fd = -1

    def _accept(self, events: int, now_ns: int) -> None:
        try:
            client, _ = self._listener.accept()
        except OSError as error:
            if error.errno in _NO_DESCRIPTOR:
                self._refuse_client()
            return  # else it left again before it was let in
        if self._client is not None or not self._admits():
            client.close()
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        self._client = client

    def _refuse_client(self) -> None:
        """Hang up on a waiting client without a descriptor for it, which would wake us for ever."""
        if self._spare_fd < 0:
            return
        os.close(self._spare_fd)
        self._spare_fd = -1
        with contextlib.suppress(OSError):
            self._listener.accept()[0].close()
        with contextlib.suppress(OSError):
            self._spare_fd = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)


def _reason(error: OSError | UnicodeError) -> str:
    """Return the message of the system without the address that Python adds to it."""
    if isinstance(error, OSError) and error.errno is not None and error.errno > 0:
        return os.strerror(error.errno)
    return str(error.args[-1])

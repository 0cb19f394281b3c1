"""Unix sockets beside the radars' ports: a listener and its clients, as a service of the loop."""

from __future__ import annotations

import contextlib
import errno
import os
import selectors
import socket
import stat
from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, TypeVar

from emulator.ports.pty import LinkError
from emulator.ports.server import Service

RETRY_NS = 1_000_000_000
"""How long new clients wait when descriptors have run out and no client of ours leaves."""
_EXHAUSTED = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})


@dataclass(slots=True, kw_only=True, eq=False)
class SocketClient:
    """A connection; ``reads`` until the client closes its direction."""

    connection: socket.socket
    unsent: bytes = b""
    reads: bool = True
    watched: int = 0


ClientT = TypeVar("ClientT", bound=SocketClient)


class SocketService(Service, Generic[ClientT]):
    """A listening unix socket.

    Parameters
    ----------
    path
        Where the socket appears; one left behind by a killed emulator is replaced.
    most_clients
        Further ones are hung up on.
    private
        Whether only the owner may connect, whatever the umask.

    Raises
    ------
    LinkError
        When the socket cannot be made.
    """

    def __init__(self, path: Path, name: str, *, most_clients: int, private: bool = False) -> None:
        self.path = path
        self._most_clients = most_clients
        self._clients: list[ClientT] = []
        self._selector: selectors.BaseSelector | None = None
        self._accept_again_ns: int | None = None
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            _remove_stale_socket(path)
            self._listener.bind(os.fspath(path))
            self._identity = _identity(path)
            if private:
                path.chmod(0o600)
            self._listener.listen()
            self._listener.setblocking(False)
        except OSError as error:
            self._listener.close()
            reason = error.strerror or str(error)
            raise LinkError(f"{path}: cannot offer the {name} socket: {reason}") from error

    @abstractmethod
    def _admit(self, connection: socket.socket, now_ns: int) -> None:
        """Enter a new client into ``_clients`` and watch it."""

    @abstractmethod
    def _ready(self, client: ClientT, events: int, now_ns: int) -> None:
        """Read from a client, or write to it."""

    def register(self, selector: selectors.BaseSelector) -> None:
        self._selector = selector
        self._listen()

    def advance(self, now_ns: int) -> None:
        if self._accept_again_ns is not None and now_ns >= self._accept_again_ns:
            self._listen()

    def wake_ns(self, now_ns: int) -> int | None:
        return self._accept_again_ns

    def close(self) -> None:
        """Close everything and remove the socket if it is still ours; the loop may be gone."""
        self._selector = None
        for client in list(self._clients):
            self._drop(client)
        with contextlib.suppress(OSError):
            if _identity(self.path) == self._identity:  # else another emulator took the path over
                self.path.unlink()
        self._listener.close()

    def _listen(self) -> None:
        self._accept_again_ns = None
        if self._selector is not None:
            self._selector.register(self._listener, selectors.EVENT_READ, self._accept)

    def _accept(self, events: int, now_ns: int) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError as error:
            if error.errno in _EXHAUSTED and self._selector is not None:
                # the client stays in the backlog, so the listener would be ready all the time
                self._selector.unregister(self._listener)
                self._accept_again_ns = now_ns + RETRY_NS
            return  # or the client gave up between the event and now
        connection.setblocking(False)
        if len(self._clients) >= self._most_clients:
            connection.close()
        else:
            self._admit(connection, now_ns)

    def _send(self, client: ClientT) -> bool:
        """Send what the line takes; return False if the client is gone."""
        try:
            client.unsent = client.unsent[client.connection.send(client.unsent) :]
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)
            return False
        return True

    def _watch(self, client: ClientT) -> None:
        """Wait for room when something is unsent, and for bytes until there will be no more."""
        wanted = selectors.EVENT_READ if client.reads else 0
        wanted |= selectors.EVENT_WRITE if client.unsent else 0
        if self._selector is None or client.watched == wanted:
            return

        def ready(events: int, now_ns: int) -> None:
            self._ready(client, events, now_ns)

        if not wanted:
            self._selector.unregister(client.connection)
        elif client.watched:
            self._selector.modify(client.connection, wanted, ready)
        else:
            self._selector.register(client.connection, wanted, ready)
        client.watched = wanted

    def _drop(self, client: ClientT) -> None:
        if client.watched and self._selector is not None:
            self._selector.unregister(client.connection)
        client.connection.close()
        self._clients.remove(client)
        if self._accept_again_ns is not None:
            self._listen()  # a descriptor came free


def _identity(path: Path) -> tuple[int, int]:
    status = path.lstat()
    return status.st_dev, status.st_ino


def _remove_stale_socket(path: Path) -> None:
    with contextlib.suppress(FileNotFoundError):
        if stat.S_ISSOCK(path.lstat().st_mode):
            path.unlink()

"""The unix socket of live control: lines in, lines out; `emulator.control` says which."""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
from dataclasses import dataclass
from pathlib import Path

from emulator.control import Control
from emulator.link import LinkError
from emulator.server import Service

__all__ = ["ControlSocket"]

MOST_CLIENTS = 16
LONGEST_LINE = 65_536
"""Bytes; who sends more without a line end is hung up on."""
MOST_UNREAD = 1 << 20
"""Bytes of answers that wait for a client; then it is hung up on."""
_READ = 65_536


@dataclass(slots=True, kw_only=True, eq=False)
class _Client:
    connection: socket.socket
    asked: bytes = b""
    unsent: bytes = b""
    speaks: bool = True
    watched: int = selectors.EVENT_READ


class ControlSocket(Service):
    """A listening unix socket, as a `Service` of the server's loop.

    Parameters
    ----------
    path
        Where the socket appears, readable by its owner only.
    control
        Carries out what is asked.

    Raises
    ------
    LinkError
        When the socket cannot be made.
    """

    def __init__(self, path: Path, control: Control) -> None:
        self.path = path
        self._control = control
        self._clients: list[_Client] = []
        self._selector: selectors.BaseSelector | None = None
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            if path.is_socket():
                path.unlink()  # left behind by a killed emulator: the directory is ours
            self._listener.bind(os.fspath(path))
            path.chmod(0o600)
            self._listener.listen()
            self._listener.setblocking(False)
        except OSError as error:
            self._listener.close()
            reason = error.strerror or str(error)
            raise LinkError(f"{path}: cannot offer the control socket: {reason}") from error

    def register(self, selector: selectors.BaseSelector) -> None:
        """Register with the loop."""
        self._selector = selector
        selector.register(self._listener, selectors.EVENT_READ, self._accept)

    def close(self) -> None:
        """Close everything and remove the socket; the loop may be gone."""
        self._selector = None
        for client in list(self._clients):
            self._drop(client)
        with contextlib.suppress(OSError):
            self.path.unlink()
        self._listener.close()

    def _accept(self, events: int, now_ns: int) -> None:
        del events, now_ns
        try:
            connection, _ = self._listener.accept()
        except OSError:
            return  # the client gave up, or descriptors have run out
        connection.setblocking(False)
        if len(self._clients) >= MOST_CLIENTS or self._selector is None:
            connection.close()
            return
        client = _Client(connection=connection)
        self._clients.append(client)

        def ready(events: int, now_ns: int) -> None:
            if events & selectors.EVENT_READ:
                self._read(client, now_ns)
            self._write(client)

        self._selector.register(connection, selectors.EVENT_READ, ready)

    def _read(self, client: _Client, now_ns: int) -> None:
        try:
            data = client.connection.recv(_READ)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        client.speaks = bool(data)
        *lines, client.asked = (client.asked + data).split(b"\n")
        for line in lines:
            if line.strip():
                client.unsent += self._control.answer(line, now_ns)
        if len(client.asked) > LONGEST_LINE or len(client.unsent) > MOST_UNREAD:
            client.speaks, client.unsent = False, b""

    def _write(self, client: _Client) -> None:
        if client not in self._clients:
            return
        try:
            client.unsent = client.unsent[client.connection.send(client.unsent) :]
        except BlockingIOError:
            pass
        except OSError:
            client.speaks, client.unsent = False, b""
        if not client.speaks and not client.unsent:
            self._drop(client)
            return
        wanted = selectors.EVENT_READ if client.speaks else 0
        wanted |= selectors.EVENT_WRITE if client.unsent else 0
        if self._selector is not None and wanted != client.watched:
            key = self._selector.get_key(client.connection)
            self._selector.modify(client.connection, wanted, key.data)
            client.watched = wanted

    def _drop(self, client: _Client) -> None:
        if self._selector is not None:
            self._selector.unregister(client.connection)
        client.connection.close()
        self._clients.remove(client)

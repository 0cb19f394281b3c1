"""The robot's wheel odometry on a unix socket, as TUM lines beside the radars' ports.

Every client gets all lines from the first one. Under `Pace.ASAP` they come at once; under
`Pace.REALTIME` each when its stamp is due. After the last line the socket is closed.
"""

from __future__ import annotations

import contextlib
import errno
import os
import selectors
import socket
import stat
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from emulator.chip import Pace
from emulator.ports.pty import LinkError
from emulator.ports.server import Service

__all__ = ["OdometryFeed"]

NS_PER_S = 1_000_000_000
MOST_CLIENTS = 64
SEND_SIZE = 65536
RETRY_NS = NS_PER_S
"""How long to let new clients wait when descriptors have run out and none of ours comes free."""
_EXHAUSTED = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})


@dataclass(slots=True, kw_only=True, eq=False)
class _Client:
    connection: socket.socket
    next_line: int = 0
    unsent: bytes = b""
    blocked: bool = False
    speaks: bool = True
    watched: int = field(default=0)


class OdometryFeed(Service):
    """A listening unix socket that plays the odometry to each client.

    Parameters
    ----------
    path
        Where the socket appears; one left behind by a killed emulator is replaced.
    lines
        TUM lines without line ends, in time order; the stamp is exact decimal seconds.
    pace
        When each line may be sent.
    scene_time_zero_ns
        Device time of scene time 0, ns.

    Raises
    ------
    LinkError
        When the socket cannot be made.
    """

    def __init__(
        self, path: Path, lines: Sequence[str], pace: Pace, *, scene_time_zero_ns: int = 0
    ) -> None:
        self.path = path
        self._lines = [f"{line}\n".encode() for line in lines]
        realtime = pace is Pace.REALTIME
        self._due_ns = [scene_time_zero_ns + stamp_ns(line) if realtime else 0 for line in lines]
        self._clients: list[_Client] = []
        self._selector: selectors.BaseSelector | None = None
        self._accept_again_ns: int | None = None
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            _remove_stale_socket(path)
            self._listener.bind(os.fspath(path))
            self._identity = _identity(path)
            self._listener.listen()
            self._listener.setblocking(False)
        except OSError as error:
            self._listener.close()
            reason = error.strerror or str(error)
            raise LinkError(f"{path}: cannot offer the odometry socket: {reason}") from error

    def register(self, selector: selectors.BaseSelector) -> None:
        self._selector = selector
        self._listen()

    def advance(self, now_ns: int) -> None:
        if self._accept_again_ns is not None and now_ns >= self._accept_again_ns:
            self._listen()
        for client in list(self._clients):
            self._serve(client, now_ns)

    def wake_ns(self, now_ns: int) -> int | None:
        wakes = [
            self._due_ns[client.next_line]
            for client in self._clients
            if not client.blocked and client.next_line < len(self._lines)
        ]
        if self._accept_again_ns is not None:
            wakes.append(self._accept_again_ns)
        return min(wakes, default=None)

    def close(self) -> None:
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
        if len(self._clients) >= MOST_CLIENTS:
            connection.close()
            return
        client = _Client(connection=connection)
        self._clients.append(client)
        self._serve(client, now_ns)

    def _serve(self, client: _Client, now_ns: int) -> None:
        while not client.blocked:
            if not client.unsent:
                last = client.next_line
                size = 0
                while last < len(self._lines) and self._due_ns[last] <= now_ns and size < SEND_SIZE:
                    size += len(self._lines[last])
                    last += 1
                client.unsent = b"".join(self._lines[client.next_line : last])
                client.next_line = last
            if not client.unsent:
                break
            try:
                client.unsent = client.unsent[client.connection.send(client.unsent) :]
            except BlockingIOError:
                client.blocked = True
            except OSError:
                self._drop(client)  # the client is gone
                return
        if not client.unsent and client.next_line == len(self._lines):
            self._drop(client)
            return
        self._watch(client)

    def _watch(self, client: _Client) -> None:
        """Wait for room when blocked, and for what the client says until it says no more.

        A client that closed only its own direction still listens; one that hung up is found
        out by the next line sent to it.
        """
        wanted = selectors.EVENT_READ if client.speaks else 0
        wanted |= selectors.EVENT_WRITE if client.blocked else 0
        if self._selector is None or client.watched == wanted:
            return

        def ready(events: int, now_ns: int) -> None:
            if events & selectors.EVENT_READ:
                client.speaks = _still_speaks(client.connection)
            client.blocked = client.blocked and not events & selectors.EVENT_WRITE
            self._serve(client, now_ns)

        if not wanted:
            self._selector.unregister(client.connection)
        elif client.watched:
            self._selector.modify(client.connection, wanted, ready)
        else:
            self._selector.register(client.connection, wanted, ready)
        client.watched = wanted

    def _drop(self, client: _Client) -> None:
        if client.watched and self._selector is not None:
            self._selector.unregister(client.connection)
        client.connection.close()
        self._clients.remove(client)
        if self._accept_again_ns is not None:
            self._listen()  # a descriptor came free


def stamp_ns(line: str) -> int:
    """Return the stamp of a TUM line in ns, exactly.

    Examples
    --------
    >>> stamp_ns("12.345678901 0 0 0 0 0 0 1")
    12345678901
    """
    seconds, _, fraction = line.split(" ", 1)[0].partition(".")
    return int(seconds) * NS_PER_S + int(fraction.ljust(9, "0")[:9] or 0)


def _still_speaks(connection: socket.socket) -> bool:
    """Read and forget what a client says; return False once it will say no more."""
    try:
        return bool(connection.recv(4096))
    except BlockingIOError:
        return True
    except OSError:
        return False


def _identity(path: Path) -> tuple[int, int]:
    status = path.lstat()
    return status.st_dev, status.st_ino


def _remove_stale_socket(path: Path) -> None:
    try:
        is_socket = stat.S_ISSOCK(path.lstat().st_mode)
    except FileNotFoundError:
        return
    if is_socket:
        path.unlink()

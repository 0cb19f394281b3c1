"""Listening sockets; unix ones beside the radars' ports, and odometry over one."""

from __future__ import annotations

import contextlib
import errno
import os
import selectors
import socket
import stat
from abc import abstractmethod
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from pathlib import Path

from emulator.chip import Pace
from emulator.chip.chip import NS_PER_S
from emulator.ports.event_loop import Service, wait_for
from emulator.ports.pty import LinkError

RETRY_NS = 1_000_000_000
"""How long new clients wait when descriptors have run out and no client of ours leaves."""
MOST_ODOMETRY_CLIENTS = 64
SEND_SIZE = 65536
_EXHAUSTED = frozenset({errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM})


@dataclass(slots=True, kw_only=True, eq=False)
class SocketClient:
    """A connection.

    Attributes
    ----------
    reads
        Until the client closes its direction.
    begun
        What it sent of a line without end.
    sent
        Bytes of odometry that it has got.
    """

    connection: socket.socket
    unsent: bytes = b""
    reads: bool = True
    begun: bytes = b""
    sent: int = 0


class Listener(Service):
    """A listening socket, which rests while there are no descriptors for new clients."""

    def __init__(self, listener: socket.socket) -> None:
        listener.setblocking(False)
        self._listener = listener
        self._selector: selectors.BaseSelector | None = None
        self._accept_again_ns: int | None = None

    @abstractmethod
    def _admit(self, connection: socket.socket, now_ns: int) -> None:
        """Take a client, or hang up on it."""

    def register(self, selector: selectors.BaseSelector) -> None:
        self._selector = selector
        self._listen()

    def advance(self, now_ns: int) -> None:
        if self._accept_again_ns is not None and now_ns >= self._accept_again_ns:
            self._listen()

    def wake_ns(self, now_ns: int) -> int | None:
        return self._accept_again_ns

    def close(self) -> None:
        self._selector = None  # the loop may be gone
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
        self._admit(connection, now_ns)

    def _hang_up(self, connection: socket.socket) -> None:
        if self._selector is not None:
            wait_for(self._selector, connection.fileno(), 0)
        connection.close()
        if self._accept_again_ns is not None:
            self._listen()  # a descriptor came free


class SocketService(Listener):
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
        self._clients: list[SocketClient] = []
        super().__init__(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
        try:
            with contextlib.suppress(FileNotFoundError):
                if stat.S_ISSOCK(path.lstat().st_mode):
                    path.unlink()
            self._listener.bind(os.fspath(path))
            self._identity = _identity(path)
            if private:
                path.chmod(0o600)
            self._listener.listen()
        except OSError as error:
            self._listener.close()
            reason = error.strerror or str(error)
            raise LinkError(f"{path}: cannot offer the {name} socket: {reason}") from error

    @abstractmethod
    def _ready(self, client: SocketClient, events: int, now_ns: int) -> None:
        """Read from a client, or write to it; ``events`` is 0 for one that has just come."""

    def close(self) -> None:
        """Close everything and remove the socket if it is still ours."""
        self._selector = None
        for client in list(self._clients):
            self._drop(client)
        with contextlib.suppress(OSError):
            if _identity(self.path) == self._identity:  # else another emulator took the path over
                self.path.unlink()
        super().close()

    def _admit(self, connection: socket.socket, now_ns: int) -> None:
        if len(self._clients) >= self._most_clients:
            connection.close()
            return
        client = SocketClient(connection=connection)
        self._clients.append(client)
        self._ready(client, 0, now_ns)

    def _send(self, client: SocketClient) -> bool:
        """Send what the line takes; return False if the client is gone."""
        try:
            client.unsent = client.unsent[client.connection.send(client.unsent) :]
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)
            return False
        return True

    def _watch(self, client: SocketClient) -> None:
        """Wait for room when something is unsent, and for bytes until there will be no more."""
        if self._selector is not None:
            wanted = selectors.EVENT_READ if client.reads else 0
            wanted |= selectors.EVENT_WRITE if client.unsent else 0
            wait_for(
                self._selector, client.connection.fileno(), wanted, partial(self._ready, client)
            )

    def _drop(self, client: SocketClient) -> None:
        self._clients.remove(client)
        self._hang_up(client.connection)


def _identity(path: Path) -> tuple[int, int]:
    status = path.lstat()
    return status.st_dev, status.st_ino


class OdometryFeed(SocketService):
    """The robot's wheel odometry, as TUM lines.

    Every client gets all lines from the first one. Under `Pace.ASAP` they come at once; under
    `Pace.REALTIME` each when its stamp is due. After the last line the connection is closed.

    Parameters
    ----------
    lines
        TUM lines without line ends, in time order; the stamp is exact decimal seconds.
    scene_time_zero_ns
        Device time of scene time 0, ns.
    """

    def __init__(
        self, path: Path, lines: Sequence[str], pace: Pace, *, scene_time_zero_ns: int = 0
    ) -> None:
        super().__init__(path, "odometry", most_clients=MOST_ODOMETRY_CLIENTS)
        self._text = "".join(f"{line}\n" for line in lines).encode()
        self._ends = list(accumulate(len(line.encode()) + 1 for line in lines))
        realtime = pace is Pace.REALTIME
        self._due_ns = [scene_time_zero_ns + stamp_ns(line) if realtime else 0 for line in lines]

    def advance(self, now_ns: int) -> None:
        super().advance(now_ns)
        for client in list(self._clients):
            if not client.unsent:
                self._serve(client, now_ns)

    def wake_ns(self, now_ns: int) -> int | None:
        coming = (
            bisect_right(self._ends, client.sent) for client in self._clients if not client.unsent
        )
        wakes = [self._due_ns[line] for line in coming if line < len(self._due_ns)]
        if (accept_again_ns := super().wake_ns(now_ns)) is not None:
            wakes.append(accept_again_ns)
        return min(wakes, default=None)

    def _ready(self, client: SocketClient, events: int, now_ns: int) -> None:
        if events & selectors.EVENT_READ:
            # one that closed only its own direction still listens; one that hung up is found out
            # by the next line sent to it
            try:
                client.reads = bool(client.connection.recv(4096))  # what it sends is ignored
            except BlockingIOError:
                pass
            except OSError:
                client.reads = False
        self._serve(client, now_ns)

    def _serve(self, client: SocketClient, now_ns: int) -> None:
        """Send what is due, or what the line takes of it."""
        n_due = bisect_right(self._due_ns, now_ns)
        due = self._ends[n_due - 1] if n_due else 0
        while client.unsent or client.sent < due:
            if not client.unsent:
                client.unsent = self._text[client.sent : min(due, client.sent + SEND_SIZE)]
                client.sent += len(client.unsent)
            if not self._send(client):
                return
            if client.unsent:
                break
        if client.unsent or client.sent < len(self._text):
            self._watch(client)
        else:
            self._drop(client)


def stamp_ns(line: str) -> int:
    """Return the stamp of a TUM line in ns, exactly.

    Examples
    --------
    >>> stamp_ns("12.345678901 0 0 0 0 0 0 1")
    12345678901
    """
    seconds, _, fraction = line.split(" ", 1)[0].partition(".")
    return int(seconds) * NS_PER_S + int(fraction.ljust(9, "0")[:9] or 0)

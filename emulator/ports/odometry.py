"""The robot's wheel odometry on a unix socket, as TUM lines beside the radars' ports.

Every client gets all lines from the first one. Under `Pace.ASAP` they come at once; under
`Pace.REALTIME` each when its stamp is due. After the last line the connection is closed.
"""

from __future__ import annotations

import selectors
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from emulator.chip import Pace
from emulator.ports.sockets import SocketClient, SocketService

NS_PER_S = 1_000_000_000
MOST_CLIENTS = 64
SEND_SIZE = 65536


@dataclass(slots=True, kw_only=True, eq=False)
class _Client(SocketClient):
    next_line: int = 0


class OdometryFeed(SocketService[_Client]):
    """A listening unix socket that plays the odometry to each client.

    Parameters
    ----------
    lines
        TUM lines without line ends, in time order; the stamp is exact decimal seconds.
    pace
        When each line may be sent.
    scene_time_zero_ns
        Device time of scene time 0, ns.
    """

    def __init__(
        self, path: Path, lines: Sequence[str], pace: Pace, *, scene_time_zero_ns: int = 0
    ) -> None:
        super().__init__(path, "odometry", most_clients=MOST_CLIENTS)
        self._lines = [f"{line}\n".encode() for line in lines]
        realtime = pace is Pace.REALTIME
        self._due_ns = [scene_time_zero_ns + stamp_ns(line) if realtime else 0 for line in lines]

    def advance(self, now_ns: int) -> None:
        super().advance(now_ns)
        for client in list(self._clients):
            if not client.unsent:
                self._serve(client, now_ns)

    def wake_ns(self, now_ns: int) -> int | None:
        wakes = [
            self._due_ns[client.next_line]
            for client in self._clients
            if not client.unsent and client.next_line < len(self._lines)
        ]
        if (accept_again_ns := super().wake_ns(now_ns)) is not None:
            wakes.append(accept_again_ns)
        return min(wakes, default=None)

    def _admit(self, connection: socket.socket, now_ns: int) -> None:
        client = _Client(connection=connection)
        self._clients.append(client)
        self._serve(client, now_ns)

    def _ready(self, client: _Client, events: int, now_ns: int) -> None:
        if events & selectors.EVENT_READ:
            # one that closed only its own direction still listens; one that hung up is found out
            # by the next line sent to it
            client.reads = _may_send_more(client.connection)
        if events & selectors.EVENT_WRITE or not client.unsent:
            self._serve(client, now_ns)
        else:
            self._watch(client)

    def _serve(self, client: _Client, now_ns: int) -> None:
        while True:
            if not client.unsent:
                client.unsent = self._due_lines(client, now_ns)
            if not client.unsent:
                break
            if not self._send(client):
                return
            if client.unsent:
                break
        if not client.unsent and client.next_line == len(self._lines):
            self._drop(client)
        else:
            self._watch(client)

    def _due_lines(self, client: _Client, now_ns: int) -> bytes:
        first = last = client.next_line
        size = 0
        while last < len(self._lines) and self._due_ns[last] <= now_ns and size < SEND_SIZE:
            size += len(self._lines[last])
            last += 1
        client.next_line = last
        return b"".join(self._lines[first:last])


def stamp_ns(line: str) -> int:
    """Return the stamp of a TUM line in ns, exactly.

    Examples
    --------
    >>> stamp_ns("12.345678901 0 0 0 0 0 0 1")
    12345678901
    """
    seconds, _, fraction = line.split(" ", 1)[0].partition(".")
    return int(seconds) * NS_PER_S + int(fraction.ljust(9, "0")[:9] or 0)


def _may_send_more(connection: socket.socket) -> bool:
    """Read and forget what a client sends; return False once it will send no more."""
    try:
        return bool(connection.recv(4096))
    except BlockingIOError:
        return True
    except OSError:
        return False

"""The sink that sends lines of JSON as datagrams."""

from __future__ import annotations

import socket
from collections.abc import Iterable
from urllib.parse import urlsplit

from slam.app.errors import UsageError
from slam.app.publish.json_lines import LineMaker
from slam.app.publish.sinks import Sink
from slam.live.errors import AppError
from slam.live.odometry_track import NS_PER_S
from slam.live.session_records import SessionInfo, Snapshot
from slam.results import SmoothedRun

MOST_BYTES = 65_507
"""What a datagram can hold over IPv4: 65 535 bytes less the headers of IP and UDP."""
_REPEAT_NS = 5 * NS_PER_S


class UdpSink(Sink):
    """Sends every line as one datagram to `//HOST:PORT`; all landmarks every five seconds."""

    def __init__(self, text: str) -> None:
        try:
            parts = urlsplit(f"udp:{text}")
            host, port = parts.hostname, parts.port
        except ValueError:
            host = port = None
        if not host or not port or text.rpartition(":")[2] != str(port):
            raise UsageError("must be udp://HOST:PORT, such as udp://192.168.0.7:5006")
        self._host, self._port = host, port
        self._socket: socket.socket | None = None

    def open(self) -> None:
        """Look the host up; nobody need listen there yet."""
        try:
            found = socket.getaddrinfo(self._host, self._port, type=socket.SOCK_DGRAM)
            family, kind, protocol, _, address = found[0]
            self._socket = socket.socket(family, kind, protocol)
            self._socket.connect(address)
        except OSError as error:
            raise AppError(
                f"--publish udp: {self._host} cannot be reached: {error.strerror or error}"
            ) from None

    def begin(self, info: SessionInfo, start_ns: int, map_id: str) -> None:
        self._lines = LineMaker(map_id, MOST_BYTES, _REPEAT_NS)

    def on_snapshot(self, snapshot: Snapshot) -> None:
        self._send(self._lines.state(snapshot))

    def on_smoothed(self, smoothed: SmoothedRun) -> None:
        self._send(self._lines.smoothed(smoothed))

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()

    def _send(self, lines: Iterable[bytes]) -> None:
        assert self._socket is not None
        refused = None
        try:
            for line in lines:
                try:
                    self._socket.send(line)
                except ConnectionRefusedError as error:
                    # of a datagram before; this one was not sent
                    refused = error
                    self._socket.send(line)
        except OSError:
            self._lines.begin_anew()
            raise
        if refused is not None:
            self._lines.begin_anew()
            raise refused

"""The sink that sends lines of JSON as datagrams."""

from __future__ import annotations

import socket

from slam.app.errors import UsageError
from slam.app.publish.json_lines import LinesSink
from slam.live.errors import AppError
from slam.live.odometry_track import NS_PER_S
from xethru_protocol.transport import host_and_port

MOST_BYTES = 65_507
"""What a datagram can hold over IPv4: 65 535 bytes less the headers of IP and UDP."""


class UdpSink(LinesSink):
    """Sends every line as one datagram to `//HOST:PORT`; all landmarks every five seconds."""

    limits = MOST_BYTES, 5 * NS_PER_S

    def __init__(self, text: str) -> None:
        address = host_and_port(text.removeprefix("//"))
        if address is None or not text.startswith("//"):
            raise UsageError("must be udp://HOST:PORT, such as udp://192.168.0.7:5006")
        self._host, self._port = address

    def open(self) -> None:
        """Look the host up; a listener is not needed yet."""
        try:
            (family, kind, *_, address), *_ = socket.getaddrinfo(
                self._host, self._port, type=socket.SOCK_DGRAM
            )
            self._socket = socket.socket(family, kind)
            self._socket.connect(address)
        except OSError as error:
            reason = error.strerror or error
            raise AppError(f"--publish udp: {self._host} cannot be reached: {reason}") from None

    def write(self, line: bytes) -> None:
        try:
            self._socket.send(line)
        except ConnectionRefusedError:  # of the datagram before; this one was not sent
            self._socket.send(line)
            raise

    def close(self) -> None:
        self._socket.close()

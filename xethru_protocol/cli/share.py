"""``xethru share``: one module for several programs, at a TCP port."""

from __future__ import annotations

import selectors
import socket
import time
from argparse import Namespace
from contextlib import suppress

from xethru_protocol.cli.output import counted, print_json, print_line, warn
from xethru_protocol.operating_system import StopFlag, StopRequestedError
from xethru_protocol.transport import LineTransport, is_loopback, listening_socket, open_line
from xethru_protocol.wire.errors import Disconnected, PortUnavailable
from xethru_protocol.wire.sharing import Host, SharedModule

_BACKLOG = 16
_MOST_HOSTS = 64
_SEND_BUFFER_BYTES = 1 << 18  # of the system, for a host that does not read
_AGAIN_NS = 500_000_000  # between two tries to open the port of a module that vanished
_CHUNK_BYTES = 65536


def share(arguments: Namespace) -> int:
    """Share a module until a signal comes; exit code 0 then."""
    host, stop = arguments.host, StopFlag("previous")
    if not is_loopback(host):
        warn(f"xethru share: --host {host}: everyone who reaches it can command the module")
    with (
        listening_socket(host, arguments.tcp, _BACKLOG) as listener,
        _Sharing(arguments, listener) as sharing,
        stop,
        suppress(StopRequestedError),
    ):
        sharing.announce()
        while True:
            with stop.at_once():
                ready = sharing.wait()
            sharing.serve(ready)
    return 0


class _Sharing:
    """The module's line, the listening socket and the connections of the hosts."""

    def __init__(self, arguments: Namespace, listener: socket.socket) -> None:
        self._port, self._baudrate = arguments.port, arguments.baudrate
        self._as_json = arguments.json
        self._listener = listener
        self._module = SharedModule()
        self._line: LineTransport | None = None
        self._connections: dict[Host, socket.socket] = {}
        self._selector = selectors.DefaultSelector()
        self._again_ns = 0

    def __enter__(self) -> _Sharing:
        self._line = open_line(self._port, self._baudrate)
        self._watch(self._listener, selectors.EVENT_READ, None)
        return self

    def __exit__(self, *error: object) -> None:
        for host in list(self._connections):
            self._hang_up(host)
        if self._line is not None:
            self._line.close()
        self._selector.close()

    def announce(self) -> None:
        host, port = self._listener.getsockname()[:2]
        url = f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}"
        if self._as_json:
            print_json({"ready": True, "port": self._port, "tcp": url})
        else:
            print_line(f"{self._port} is at {url}")

    def wait(self) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait until there is something to do."""
        for host, connection in self._connections.items():
            wanted = selectors.EVENT_WRITE if host.unsent else 0
            wanted |= selectors.EVENT_READ if self._module.wants_data(host) else 0
            self._watch(connection, wanted, host)
        wake_ns: int | None = self._again_ns
        if self._line is not None:
            to_module = self._module.to_module or self._line.unsent
            self._watch(
                self._line,
                selectors.EVENT_READ | (selectors.EVENT_WRITE if to_module else 0),
                self._line,
            )
            wake_ns = self._module.wake_ns()
        wait_s = None if wake_ns is None else max(wake_ns - time.monotonic_ns(), 0) * 1e-9
        return self._selector.select(wait_s)

    def serve(self, ready: list[tuple[selectors.SelectorKey, int]]) -> None:
        """Move bytes as far as that goes without waiting."""
        for key, events in ready:
            if key.data is None:
                self._accept()
            elif isinstance(key.data, Host):
                self._serve_host(key.data, events)
        try:
            if self._line is None:
                self._reopen()
            else:
                self._serve_module(self._line)
        except Disconnected as error:
            warn(f"xethru share: {error}; waiting for it")
            self._lose_module()
        for host in list(self._connections):
            self._send(host)

    def _accept(self) -> None:
        with suppress(OSError):  # it has gone already, or there are no descriptors left
            connection, address = self._listener.accept()
            if self._line is None or len(self._connections) >= _MOST_HOSTS:
                connection.close()
                return
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
            host = self._module.join(f"{address[0]}:{address[1]}")
            self._connections[host] = connection

    def _serve_host(self, host: Host, events: int) -> None:
        if host not in self._connections or not events & selectors.EVENT_READ:
            return
        try:
            data = self._connections[host].recv(_CHUNK_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._module.receive_from_host(host, data, time.monotonic_ns())
        else:
            self._hang_up(host)

    def _serve_module(self, line: LineTransport) -> None:
        data = line.read(0.0)
        now_ns = time.monotonic_ns()
        if data:
            self._module.receive_from_module(data, now_ns)
        self._module.advance(now_ns)
        if self._module.to_module or line.unsent:
            del self._module.to_module[: line.write_some(bytes(self._module.to_module))]

    def _send(self, host: Host) -> None:
        try:
            while host.unsent:
                sent = self._connections[host].send(host.unsent[:_CHUNK_BYTES])
                del host.unsent[:sent]
        except BlockingIOError:
            pass
        except OSError:
            self._hang_up(host)

    def _lose_module(self) -> None:
        """Hang up on all, as the port of a module that vanishes does, and look for it again."""
        for host in list(self._connections):
            self._hang_up(host)
        if self._line is not None:
            self._watch(self._line, 0, None)
            self._line.close()
        self._line, self._again_ns = None, time.monotonic_ns() + _AGAIN_NS
        self._module.line_lost()

    def _reopen(self) -> None:
        if time.monotonic_ns() < self._again_ns:
            return
        try:
            self._line = open_line(self._port, self._baudrate)
        except PortUnavailable:
            self._again_ns = time.monotonic_ns() + _AGAIN_NS
        else:
            warn(f"xethru share: {self._port} is back")

    def _hang_up(self, host: Host) -> None:
        connection = self._connections.pop(host)
        self._watch(connection, 0, None)
        connection.close()
        self._module.leave(host)
        if self._as_json:
            print_json({"left": host.name, "messages": host.messages, "lost": host.lost})
        else:
            taken = counted(host.messages, "message")
            warn(f"xethru share: {host.name} left after {taken}; {host.lost} lost as too slow")

    def _watch(self, file: socket.socket | LineTransport, events: int, data: object) -> None:
        """Wait for these events of a file from now on, 0: for none."""
        key = self._selector.get_map().get(file.fileno())
        if key is None and events:
            self._selector.register(file.fileno(), events, data)
        elif key is not None and not events:
            self._selector.unregister(file.fileno())
        elif key is not None and key.events != events:
            self._selector.modify(file.fileno(), events, data)

"""``xethru share``: one module for several programs, at a TCP port."""

from __future__ import annotations

import asyncio
import socket
import time
from argparse import Namespace
from contextlib import suppress

from xethru_protocol.cli.output import CommandFailed, counted, print_json, print_line, warn
from xethru_protocol.operating_system import StopFlag, StopRequestedError
from xethru_protocol.transport import (
    LineTransport,
    is_loopback,
    keep_alive,
    listening_socket,
    open_line,
)
from xethru_protocol.wire.errors import Disconnected, PortUnavailable
from xethru_protocol.wire.sharing import Host, SharedModule

_BACKLOG, _MOST_HOSTS = 16, 64
_SEND_BUFFER_BYTES = 1 << 18  # of the system, for a host that does not read
_CHUNK_BYTES = 65536
_LOOK_S = 0.5  # between two looks for a module that vanished, or an answer that does not come


def share(arguments: Namespace) -> int:
    """Share a module until a signal comes; exit code 0 then."""
    stop = StopFlag("previous")
    if not is_loopback(arguments.host):
        warn(f"xethru share: everyone who reaches {arguments.host} can command the module")
    with (
        listening_socket(arguments.host, arguments.tcp, _BACKLOG) as listener,
        stop,
        suppress(StopRequestedError),  # while standard output blocks
    ):
        asyncio.run(_Sharing(arguments).run(listener, stop))
    return 0


class _Sharing:
    """The module's line, and the connections of its hosts."""

    def __init__(self, arguments: Namespace) -> None:
        self._port, self._baudrate = arguments.port, arguments.baudrate
        self._as_json = arguments.json
        self._line: LineTransport | None = None
        self._module = SharedModule(self._write)
        self._writers: dict[Host, asyncio.StreamWriter] = {}

    async def run(self, listener: socket.socket, stop: StopFlag) -> None:
        loop, ended = asyncio.get_running_loop(), asyncio.Event()

        def end() -> None:
            loop.call_soon_threadsafe(ended.set)

        self._open()
        server = await asyncio.start_server(self._serve_host, sock=listener)
        try:
            self._announce(*listener.getsockname()[:2])
            stop.attach(end)
            while not ended.is_set():
                with suppress(TimeoutError):
                    await asyncio.wait_for(ended.wait(), _LOOK_S)
                self._look()
        finally:
            stop.detach()
            server.close()
            self._close()

    def _announce(self, host: str, port: int) -> None:
        url = f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}"
        if self._as_json:
            print_json({"ready": True, "port": self._port, "tcp": url})
        else:
            print_line(f"{self._port} is at {url}")

    def _open(self) -> None:
        self._line = open_line(self._port, self._baudrate)
        asyncio.get_running_loop().add_reader(self._line.fileno(), self._read)

    def _close(self) -> None:
        """Close the line and hang up on all, as the port of a module that vanishes does."""
        if self._line is not None:
            asyncio.get_running_loop().remove_reader(self._line.fileno())
            self._line.close()
        self._line = None
        self._module.line_lost()
        for writer in self._writers.values():
            writer.transport.abort()

    def _look(self) -> None:
        if self._line is not None:
            self._module.advance(time.monotonic_ns())
            return
        with suppress(PortUnavailable):
            self._open()
            warn(f"xethru share: {self._port} is back")

    def _read(self) -> None:
        try:
            if self._line is not None and (data := self._line.read(0.0)):
                self._module.receive_from_module(data, time.monotonic_ns())
        except Disconnected as error:
            self._lose(error)

    def _write(self, data: bytes) -> None:
        try:
            if self._line is not None:
                self._line.write(data)
        except Disconnected as error:
            self._lose(error)

    def _lose(self, error: Disconnected) -> None:
        warn(f"xethru share: {error}; waiting for it")
        self._close()

    async def _serve_host(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        peer = writer.get_extra_info("peername")  # None of one that has gone already
        if peer is None or self._line is None or len(self._writers) >= _MOST_HOSTS:
            writer.transport.abort()
            return
        connection = writer.get_extra_info("socket")
        keep_alive(connection)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)
        name, transport = f"{peer[0]}:{peer[1]}", writer.transport

        def send(data: bytes) -> None:
            if not transport.is_closing():  # asyncio logs every message to one that broke off
                transport.write(data)

        host = self._module.join(name, send, transport.get_write_buffer_size)
        self._writers[host] = writer
        try:
            while data := await reader.read(_CHUNK_BYTES):
                self._module.receive_from_host(host, data, time.monotonic_ns())
                await writer.drain()  # one that takes no answers asks no more
        except OSError:  # it is gone
            pass
        finally:
            del self._writers[host]
            self._module.leave(host)
            transport.abort()
            if self._as_json:
                # its reader has gone, or all ends
                with suppress(BrokenPipeError, CommandFailed, StopRequestedError):
                    print_json({"left": name, "messages": host.messages, "lost": host.lost})
            else:
                taken = counted(host.messages, "message")
                warn(f"xethru share: {name} left after {taken}; {host.lost} lost as too slow")

"""Which lines lead to each emulated module, and what they are called.

A module talks to one host at a time. While a TCP client is connected, what a host writes to the
pseudo-terminal is lost, and nothing comes out of it, as on a line that leads nowhere.

When a port goes away a host sees what a real unplug shows: its open port hangs up, the name is
gone; later there is a fresh port, under the same name or another one.
"""

from __future__ import annotations

import contextlib
import os
import selectors
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from emulator.ports.event_loop import Port, Service, wait_for
from emulator.ports.pty import LinkError, PortWatch, PtyLink
from emulator.ports.tcp import TcpLink
from emulator.ports.uart import UartLine
from emulator.x4m300 import ByteDevice
from xethru_protocol.wire.codes import POWER_UP_BAUD

LOOK_AGAIN_NS = 20_000_000
"""How often to look whether the port is back; a host looks less often."""


class DeviceSide:
    """A module as one of its two lines sees it: only one of them has it at a time."""

    def __init__(self, device: ByteDevice, has_it: Callable[[], bool]) -> None:
        self._device = device
        self._has_it = has_it

    @property
    def wants_data(self) -> bool:
        """Whether to read from the host; what is read without having the module is discarded."""
        return not self._has_it() or self._device.wants_data

    def receive_data(self, data: bytes, now_ns: int) -> None:
        if self._has_it():
            self._device.receive_data(data, now_ns)

    def advance(self, now_ns: int) -> None:
        self._device.advance(now_ns)

    def next_packet(self, now_ns: int) -> bytes | None:
        return self._device.next_packet(now_ns) if self._has_it() else None

    def wake_ns(self, now_ns: int) -> int | None:
        return self._device.wake_ns(now_ns) if self._has_it() else None


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedDevice:
    """A device and what the ready line says about it.

    Attributes
    ----------
    start_skew_ns
        Scene time at which it takes the first frame of its first stream; None where unknown.
    present
        Whether its own port is there at a time, ns; None if it always is.
    opened, closed
        Called with the time, ns, when the first host opens its terminal, and when the last one
        closes it or loses it.
    uart_baud
        The rate of its UART now, bit/s.
    """

    name: str
    serial: str
    device: ByteDevice
    start_skew_ns: int | None = None
    present: Callable[[int], bool] | None = None
    opened: Callable[[int], None] = lambda now_ns: None
    closed: Callable[[int], None] = lambda now_ns: None
    uart_baud: Callable[[], int] = lambda: POWER_UP_BAUD


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkOptions:
    """What leads to the modules beside or instead of a plain pseudo-terminal.

    Attributes
    ----------
    port_on_reset
        Whether a restart keeps the port, takes it away for a while, or has it return under
        another name every time: NAME-2, NAME-3 and so on, so that a host finds the module by its
        serial number only.
    tcp_base
        TCP port of the first module, the others' follow; 0: any that are free; None: no TCP.
    """

    kind: Literal["usb", "uart"] = "usb"
    port_on_reset: Literal["stay", "vanish", "rename"] = "stay"
    tcp_base: int | None = None
    tcp_host: str = "127.0.0.1"


@dataclass(slots=True, kw_only=True)
class _Line:
    """What leads to one module; ``path`` is that of its first port."""

    named: NamedDevice
    path: Path
    link: PtyLink
    watch: PortWatch
    tcp: TcpLink | None
    returns: int = 0

    @property
    def has_its_port(self) -> bool:
        return _is_open(self.link)


class DevicePorts(Service):
    """Everything that leads to the modules of one emulator; closed with ``cleanup``.

    As a service it takes the lines to a module away with its port and brings them back. A TCP
    client is hung up on, and none is admitted before the module is back.

    Attributes
    ----------
    services
        Those of the lines, and this one.
    moved
        Called when a port came back, maybe under another name.

    Raises
    ------
    LinkError
        When a line cannot be had.
    """

    def __init__(
        self,
        devices: Sequence[NamedDevice],
        folder: Path,
        options: LinkOptions,
        cleanup: contextlib.ExitStack,
    ) -> None:
        self.folder = folder
        self.ports: list[Port] = []
        self.services: list[Service] = [self]
        self.moved: Callable[[], None] = lambda: None
        self._options = options
        self._selector: selectors.BaseSelector | None = None
        self._lines: list[_Line] = []
        for named in devices:
            self._add(named, cleanup)

    def entries(self) -> list[dict[str, object]]:
        return [
            {
                "name": line.named.name,
                "path": os.fspath(line.link.path),
                "serial": line.named.serial,
                "start_skew_ns": line.named.start_skew_ns,
                "tcp": None if line.tcp is None else line.tcp.port,
                "uart": self._options.kind == "uart",
            }
            for line in self._lines
        ]

    def register(self, selector: selectors.BaseSelector) -> None:
        self._selector = selector

    def advance(self, now_ns: int) -> None:
        for line in self._lines:
            present = line.named.present
            wanted = present is None or present(now_ns)
            if line.has_its_port and not wanted:
                self._take_away(line, now_ns)
            elif wanted and not line.has_its_port:
                self._bring_back(line)

    def wake_ns(self, now_ns: int) -> int | None:
        complete = all(line.has_its_port for line in self._lines)
        return None if complete else now_ns + LOOK_AGAIN_NS

    def _take_away(self, line: _Line, now_ns: int) -> None:
        if self._selector is not None:
            wait_for(self._selector, line.link.fileno(), 0)
        line.link.close()
        line.watch.end(now_ns)
        if line.tcp is not None:
            line.tcp.hang_up()

    def _bring_back(self, line: _Line) -> None:
        path = line.path
        if self._options.port_on_reset == "rename":
            path = path.with_name(f"{path.name}-{line.returns + 2}")
        try:
            line.link.reopen(path)
        except LinkError:
            return  # no terminal is free, or a file is in the way: look again
        line.returns += 1
        line.watch.follow(line.link.terminal)
        self.moved()

    def _add(self, named: NamedDevice, cleanup: contextlib.ExitStack) -> None:
        options = self._options
        path = self.folder / named.name
        uart = self._uart(named)
        link = PtyLink(path, flushed=None if uart is None else uart.flush_output)
        cleanup.callback(link.close)
        if uart is not None:
            uart.host_baud = link.host_baud

        def closed(now_ns: int) -> None:
            link.admit()
            named.closed(now_ns)

        watch = PortWatch(link.terminal, opened=named.opened, closed=closed)
        cleanup.callback(watch.close)
        self.services.append(watch)
        tcp = None
        device: ByteDevice = named.device
        if options.tcp_base is not None:
            tcp_port = options.tcp_base and options.tcp_base + len(self._lines)
            tcp = TcpLink(options.tcp_host, tcp_port, admits=partial(_is_free, link, watch))
            cleanup.callback(tcp.close)
            has_client = partial(_is_open, tcp)
            device = DeviceSide(named.device, lambda: not has_client())
            guest = DeviceSide(named.device, has_client)
            self.ports.append(Port(tcp, guest, self._uart(named)))
            self.services.append(tcp)
        self.ports.append(Port(link, device, uart))
        self._lines.append(_Line(named=named, path=path, link=link, watch=watch, tcp=tcp))

    def _uart(self, named: NamedDevice) -> UartLine | None:
        """Return a line at whose end a host has no rate of its own, as a TCP client."""
        is_uart = self._options.kind == "uart"
        return UartLine(named.uart_baud, lambda: None) if is_uart else None


def _is_open(link: PtyLink | TcpLink) -> bool:
    return link.fileno() >= 0


def _is_free(link: PtyLink, watch: PortWatch) -> bool:
    return _is_open(link) and not watch.in_use

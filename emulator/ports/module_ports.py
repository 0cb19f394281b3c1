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


class Plug(Service):
    """Takes the lines to one module away and brings them back.

    Parameters
    ----------
    present
        Whether the module's own port is there at a time, ns.
    tcp
        A client of it is hung up on, and none admitted before the module is back.
    renames
        Whether it returns under another name every time: NAME-2, NAME-3 and so on, so that a host
        finds the module by its serial number only.
    """

    def __init__(
        self,
        link: PtyLink,
        present: Callable[[int], bool],
        *,
        tcp: TcpLink | None,
        watch: PortWatch,
        renames: bool,
        moved: Callable[[], None],
    ) -> None:
        self._link = link
        self._present = present
        self._tcp = tcp
        self._watch = watch
        self._first_path = link.path
        self._renames = renames
        self._returns = 0
        self._moved = moved
        self._selector: selectors.BaseSelector | None = None

    def register(self, selector: selectors.BaseSelector) -> None:
        self._selector = selector

    def advance(self, now_ns: int) -> None:
        wanted = self._present(now_ns)
        if _is_open(self._link) and not wanted:
            self._take_away()
        elif wanted and not _is_open(self._link):
            self._bring_back()

    def wake_ns(self, now_ns: int) -> int | None:
        return None if _is_open(self._link) else now_ns + LOOK_AGAIN_NS

    def _take_away(self) -> None:
        if self._selector is not None:
            wait_for(self._selector, self._link.fileno(), 0)
        self._link.close()
        if self._tcp is not None:
            self._tcp.hang_up()

    def _bring_back(self) -> None:
        path = self._first_path
        if self._renames:
            path = path.with_name(f"{path.name}-{self._returns + 2}")
        try:
            self._link.reopen(path)
        except LinkError:
            return  # no terminal is free, or a file is in the way: look again
        self._returns += 1
        self._watch.follow(self._link.terminal)
        self._moved()


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedDevice:
    """A device and what the ready line says about it.

    Attributes
    ----------
    start_skew_ns
        Scene time at which it takes the first frame of its first stream; None where unknown.
    present
        Whether its own port is there at a time, ns; None if it always is.
    uart_baud
        The rate of its UART now, bit/s.
    """

    name: str
    serial: str
    device: ByteDevice
    start_skew_ns: int | None = None
    present: Callable[[int], bool] | None = None
    uart_baud: Callable[[], int] = lambda: POWER_UP_BAUD


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkOptions:
    """What leads to the modules beside or instead of a plain pseudo-terminal.

    Attributes
    ----------
    port_on_reset
        Whether a restart keeps the port, takes it away for a while, or has it return under
        another name.
    tcp_base
        TCP port of the first module, the others' follow; 0: any that are free; None: no TCP.
    """

    kind: Literal["usb", "uart"] = "usb"
    port_on_reset: Literal["stay", "vanish", "rename"] = "stay"
    tcp_base: int | None = None
    tcp_host: str = "127.0.0.1"


class DevicePorts:
    """Everything that leads to the modules of one emulator; closed with ``cleanup``.

    Attributes
    ----------
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
        self.services: list[Service] = []
        self.moved: Callable[[], None] = lambda: None
        self._lines: list[tuple[NamedDevice, PtyLink, TcpLink | None]] = []
        self._is_uart = options.kind == "uart"
        for index, named in enumerate(devices):
            base = options.tcp_base
            tcp_port = base + index if base else base
            self._add(named, folder / named.name, tcp_port, options, cleanup)

    def entries(self) -> list[dict[str, object]]:
        return [
            {
                "name": named.name,
                "path": os.fspath(link.path),
                "serial": named.serial,
                "start_skew_ns": named.start_skew_ns,
                "tcp": None if tcp is None else tcp.port,
                "uart": self._is_uart,
            }
            for named, link, tcp in self._lines
        ]

    def _add(
        self,
        named: NamedDevice,
        path: Path,
        tcp_port: int | None,
        options: LinkOptions,
        cleanup: contextlib.ExitStack,
    ) -> None:
        line = self._line(named)
        flushed = None if line is None else line.flush_output
        link = PtyLink(path, flushed=flushed)
        cleanup.callback(link.close)
        if line is not None:
            line.host_baud = link.host_baud
        watch = PortWatch(link.terminal, closed=lambda now_ns: link.admit())
        cleanup.callback(watch.close)
        self.services.append(watch)
        tcp = None
        device: ByteDevice = named.device
        if tcp_port is not None:
            tcp = TcpLink(options.tcp_host, tcp_port, admits=partial(_is_free, link, watch))
            cleanup.callback(tcp.close)
            has_client = partial(_is_open, tcp)
            device = DeviceSide(named.device, lambda: not has_client())
            guest = DeviceSide(named.device, has_client)
            self.ports.append(Port(tcp, guest, self._line(named)))
            self.services.append(tcp)
        self.ports.append(Port(link, device, line))
        plug = Plug(
            link,
            named.present or (lambda now_ns: True),
            tcp=tcp,
            watch=watch,
            renames=options.port_on_reset == "rename",
            moved=lambda: self.moved(),
        )
        self.services.append(plug)
        self._lines.append((named, link, tcp))

    def _line(self, named: NamedDevice) -> UartLine | None:
        """Return a line at whose end a host has no rate of its own, as a TCP client."""
        return UartLine(named.uart_baud, lambda: None) if self._is_uart else None


def _is_open(link: PtyLink | TcpLink) -> bool:
    return link.fileno() >= 0


def _is_free(link: PtyLink, watch: PortWatch) -> bool:
    return _is_open(link) and not watch.in_use

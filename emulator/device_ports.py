"""Which lines lead to each emulated module, and what they are called."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from emulator.link import PtyLink
from emulator.plug import Plug
from emulator.port_watch import PortWatch
from emulator.serial_rate import DEFAULT_BAUDRATE
from emulator.server import ByteDevice, Port, Service
from emulator.shared_device import SharedDevice
from emulator.tcp_link import TcpLink
from emulator.uart_line import UartLine
from emulator.usb_line import UsbLine

__all__ = ["DevicePorts", "LinkOptions", "NamedDevice", "open_ports"]


def _power_up_baud() -> int:
    return DEFAULT_BAUDRATE


@dataclass(frozen=True, slots=True, kw_only=True)
class NamedDevice:
    """A device and what the ready line says about it.

    Attributes
    ----------
    name, serial
        For the ready line.
    device
        The module.
    start_skew_ns
        Scene time at which it takes the frame of counter 0; None where nobody knows.
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
    uart_baud: Callable[[], int] = _power_up_baud


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkOptions:
    """What leads to the modules beside or instead of a plain pseudo-terminal.

    Attributes
    ----------
    kind
        What the module is connected by.
    usb_latency_ns
        How long USB transfers of at most 512 bytes are under way; None: bytes pass at once.
    host_baud
        Rate of the host's side of a UART, bit/s; None: what it sets its terminal to, and for a
        TCP client the module's.
    port_on_reset
        Whether a restart keeps the port, takes it away for a while, or has it return under
        another name.
    tcp_base
        TCP port of the first module, the others' follow; 0: any that are free; None: no TCP.
    tcp_host
        Address to listen at.
    """

    kind: Literal["usb", "uart"] = "usb"
    usb_latency_ns: int | None = None
    host_baud: int | None = None
    port_on_reset: Literal["stay", "vanish", "rename"] = "stay"
    tcp_base: int | None = None
    tcp_host: str = "127.0.0.1"


def _nothing_moved() -> None:
    """Nobody wants to know that a port came back."""


@dataclass(slots=True, kw_only=True)
class DevicePorts:
    """Everything that leads to the modules of one emulator.

    Attributes
    ----------
    ports
        For the server's loop.
    services
        Likewise.
    plugs
        What takes the ports away, by the modules' names.
    moved
        Called when a port came back, maybe under another name.
    """

    ports: list[Port] = field(default_factory=list)
    services: list[Service] = field(default_factory=list)
    plugs: dict[str, Plug] = field(default_factory=dict)
    moved: Callable[[], None] = _nothing_moved
    _words: list[tuple[NamedDevice, PtyLink, TcpLink | None]] = field(default_factory=list)

    def entries(self) -> list[dict[str, object]]:
        """Return what the ready line says about the modules."""
        return [
            {
                "name": named.name,
                "path": os.fspath(link.path),
                "serial": named.serial,
                "start_skew_ns": named.start_skew_ns,
                "tcp": None if tcp is None else tcp.port,
            }
            for named, link, tcp in self._words
        ]

    def add(
        self,
        named: NamedDevice,
        path: Path,
        tcp_port: int | None,
        options: LinkOptions,
        cleanup: contextlib.ExitStack,
    ) -> None:
        """Open the lines to one more module.

        Raises
        ------
        LinkError
            When one cannot be had.
        """
        line = _line(named, options)
        flushed = line.flush_output if isinstance(line, UartLine) else None
        link = cleanup.enter_context(PtyLink(path, flushed=flushed))
        if isinstance(line, UartLine) and options.host_baud is None:
            line.host_baud = link.host_baud
        tcp, watch, device = None, None, named.device
        if tcp_port is not None:
            watch = PortWatch(link.terminal, opened=_unheard, closed=_unheard)
            cleanup.callback(watch.close)
            shared = SharedDevice(device)
            tcp = _tcp_link(shared, link, watch, tcp_port, options)
            cleanup.callback(tcp.close)
            device = shared.port
            self.ports.append(Port(tcp, shared.guest, _line(named, options)))
            self.services += [watch, tcp]
        self.ports.append(Port(link, device, line))
        plug = Plug(
            link,
            named.present or _always,
            tcp=tcp,
            watch=watch,
            renames=options.port_on_reset == "rename",
            moved=lambda: self.moved(),
        )
        self.services.append(plug)
        self.plugs[named.name] = plug
        self._words.append((named, link, tcp))


def open_ports(
    devices: Sequence[NamedDevice],
    folder: Path,
    options: LinkOptions,
    cleanup: contextlib.ExitStack,
) -> DevicePorts:
    """Open the lines to all modules; what was opened is closed with ``cleanup``.

    Raises
    ------
    LinkError
        When one cannot be had.
    """
    opened = DevicePorts()
    for index, named in enumerate(devices):
        base = options.tcp_base
        tcp_port = base + index if base else base
        opened.add(named, folder / named.name, tcp_port, options, cleanup)
    return opened


def _line(named: NamedDevice, options: LinkOptions) -> UsbLine | UartLine | None:
    if options.kind == "uart":
        return UartLine(named.uart_baud, lambda: options.host_baud)
    return None if options.usb_latency_ns is None else UsbLine(options.usb_latency_ns)


def _tcp_link(
    shared: SharedDevice, link: PtyLink, watch: PortWatch, tcp_port: int, options: LinkOptions
) -> TcpLink:
    def set_guest(present: bool) -> None:
        shared.guest_present = present

    return TcpLink(
        options.tcp_host,
        tcp_port,
        admits=lambda: link.fileno() >= 0 and not watch.in_use,
        came=lambda: set_guest(True),
        left=lambda: set_guest(False),
    )


def _unheard(now_ns: int) -> None:
    """Who opens a terminal matters only when somebody else wants the module."""


def _always(now_ns: int) -> bool:
    del now_ns
    return True

"""Bytes to and from a port, blocking or with asyncio, and where ports are found.

>>> from xethru_protocol.transport import SerialTransport
>>> SerialTransport("/dev/no-such-port")
Traceback (most recent call last):
xethru_protocol.wire.errors.PortUnavailable: there is no port /dev/no-such-port; 'xethru list'...

An emulator leaves one file ``<pid>.json`` with its ready line in the run directory, because
pseudo-terminals appear in no list of ports.
"""

import asyncio
import errno
import json
import math
import os
import select
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import serial
from serial.tools import list_ports

from xethru_protocol.wire.errors import Disconnected, PortUnavailable

_CHUNK_BYTES = 65536
_WRITE_TIMEOUT_S = 5.0
_TURN_S = 0.005  # how long one task of asyncio may read on while data never end
_LONGEST_WAIT_S = 86400.0  # poll() takes 31 bits of milliseconds; a caller waits again
_BAUD = 115200  # what a UART module starts with; without meaning on USB and ptys
_BITS_PER_BYTE = 10  # start and stop bit
# Names of ports without a rate of their own: USB CDC and pseudo-terminals.
_UNLIMITED = ("/dev/ttyACM", "/dev/pts/", "/dev/cu.usbmodem", "/dev/tty.usbmodem", "/dev/ttys")


class Transport(Protocol):
    """What a driver needs of a line to a module."""

    @property
    def name(self) -> str:
        """What to call this line in messages to people."""

    def read(self, timeout_s: float) -> bytes:
        """Whatever has arrived, waiting up to ``timeout_s`` for the first byte; b"" if none.

        Raises `Disconnected` if the line is gone.
        """

    def write(self, data: bytes) -> None:
        """Send all of ``data``; raises `Disconnected` if the line is gone."""

    def close(self) -> None:
        """Release the line. May be called twice."""


class SerialTransport:
    """A serial port: a real module's or an emulated one's pty.

    Takes an exclusive lock, so that two programs do not each get half of the bytes.

    ``path`` is, for example, ``/dev/ttyACM0`` or a link made by ``xethru-emulator``; ``baudrate``
    matters on a UART only. Raises PortUnavailable if the port does not exist, is no serial port,
    is in use, or may not be opened.
    """

    def __init__(self, path: str, baudrate: int = _BAUD) -> None:
        self.name = path
        try:
            self._port = serial.Serial(path, baudrate, timeout=0, exclusive=True)
        # SerialException is an OSError; no rate can have more than 32 bits
        except (OSError, ValueError, OverflowError) as error:
            raise PortUnavailable(_why(path, error)) from None
        self._fd: int = self._port.fileno()
        # select(), which pyserial's write uses, cannot wait on descriptors above 1023
        self._readable, self._writable = select.poll(), select.poll()
        self._readable.register(self._fd, select.POLLIN)
        self._writable.register(self._fd, select.POLLOUT)

    def read(self, timeout_s: float) -> bytes:
        try:
            # A line under load has data already, and one call is faster than two.
            data = self._take()
            if data:
                return data
            if not self._readable.poll(_whole_ms(timeout_s)):
                return b""
            data = self._take()
        except (OSError, ValueError) as error:  # EIO: the other end of a pty is gone
            raise Disconnected(self._lost()) from error
        if data == b"":  # readable, yet nothing there: hung up
            raise Disconnected(self._lost())
        return data or b""

    def _take(self) -> bytes | None:
        """Take what is there; b"" or None, by the kind of port, if nothing is."""
        try:
            return os.read(self._fd, _CHUNK_BYTES)
        except BlockingIOError:
            return None

    def write(self, data: bytes) -> None:
        deadline = time.monotonic() + _WRITE_TIMEOUT_S
        rest = memoryview(data)
        while rest:
            left_s = deadline - time.monotonic()
            if left_s <= 0:
                raise Disconnected(f"{self.name} takes no data any more; is the module hanging?")
            try:
                self._writable.poll(_whole_ms(left_s))
            except (OSError, ValueError) as error:
                raise Disconnected(self._lost()) from error
            rest = rest[self.write_some(rest) :]

    def write_some(self, data: bytes | memoryview) -> int:
        """Send what the line takes now and return how many bytes that were."""
        try:
            return os.write(self._fd, data)
        except BlockingIOError:  # no room
            return 0
        except (OSError, ValueError) as error:
            raise Disconnected(self._lost()) from error

    def fileno(self) -> int:
        """Descriptor to wait for with other means; raises `Disconnected` after `close`."""
        if self._fd < 0:
            raise Disconnected(self._lost())
        return self._fd

    @property
    def bytes_per_s(self) -> float:
        """What the line carries at most: 10 bits per byte on a UART, infinite elsewhere."""
        if os.path.realpath(self.name).startswith(_UNLIMITED):
            return math.inf
        return self._port.baudrate / _BITS_PER_BYTE

    def set_baudrate(self, baudrate: int) -> None:
        """Change this side's rate, keeping the port open."""
        try:
            self._port.baudrate = baudrate
        except (OSError, ValueError) as error:  # SerialException is an OSError
            raise Disconnected(f"{self.name} cannot be set to {baudrate} baud: {error}") from error

    def close(self) -> None:
        self._fd = -1
        with suppress(OSError):  # the device vanished: there is nothing left to release
            self._port.close()

    def _lost(self) -> str:
        if self._fd < 0:
            return f"{self.name} was closed"
        return f"{self.name} was disconnected; plug the module in again"


def capacity_bytes_per_s(line: object) -> float:
    """Return the highest rate of a line; infinite if it has no known limit."""
    return float(getattr(line, "bytes_per_s", math.inf))


def set_rate(line: object, baudrate: int) -> None:
    change = getattr(line, "set_baudrate", None)
    if change is not None:
        change(baudrate)


def _whole_ms(timeout_s: float) -> int:
    return math.ceil(min(max(timeout_s, 0.0), _LONGEST_WAIT_S) * 1000)


def _why(path: str, error: Exception) -> str:
    in_use = f"port {path} is in use by another program; close that first"
    not_serial = f"{path} is not a serial port"
    reasons = {
        errno.ENOENT: f"there is no port {path}; 'xethru list' shows the ports there are",
        errno.ENXIO: f"there is no module behind {path}; plug it in again",
        errno.EACCES: f"port {path} may not be opened by this user; "
        "join its group (often 'dialout') and log in again",
        errno.EBUSY: in_use,
        errno.EAGAIN: in_use,
        errno.ENOTTY: not_serial,
        errno.EISDIR: not_serial,
        errno.EINVAL: not_serial,
    }
    number, text = getattr(error, "errno", None), str(error)
    if number in reasons:
        return reasons[number]
    if "exclusively lock" in text:  # pyserial marks this one by its text only
        return in_use
    if "Could not configure port" in text:
        return not_serial
    return f"port {path} cannot be opened: {text}"


class AsyncTransport(Protocol):
    """What `AsyncX4M300` needs of a line to a module: a `Transport` whose calls are awaited."""

    @property
    def name(self) -> str: ...

    async def read(self, timeout_s: float) -> bytes: ...

    async def write(self, data: bytes) -> None: ...

    def close(self) -> None:
        """Release the line; a task that reads from it gets `Disconnected`. May be called twice."""


class AsyncSerialTransport:
    """A serial port whose descriptor the running event loop watches; see `SerialTransport`."""

    def __init__(self, path: str, baudrate: int = _BAUD) -> None:
        self.name = path
        self._port = SerialTransport(path, baudrate)
        # Tasks that wait for the descriptor, which must not be watched once it is closed.
        self._waiting: dict[asyncio.Future[bool], Callable[[int], object]] = {}
        self._turn_ends_s = 0.0

    @property
    def bytes_per_s(self) -> float:
        return self._port.bytes_per_s

    def set_baudrate(self, baudrate: int) -> None:
        self._port.set_baudrate(baudrate)

    async def read(self, timeout_s: float) -> bytes:
        loop = asyncio.get_running_loop()
        if loop.time() > self._turn_ends_s:  # a line that never pauses: now the other tasks
            await asyncio.sleep(0)  # before reading: a task cancelled here must lose no bytes
            self._turn_ends_s = loop.time() + _TURN_S
        data = self._port.read(0.0)
        if data or timeout_s <= 0:
            return data
        ready = await self._wait(loop.add_reader, loop.remove_reader, timeout_s)
        self._turn_ends_s = loop.time() + _TURN_S
        return self._port.read(0.0) if ready else b""

    async def write(self, data: bytes) -> None:
        loop = asyncio.get_running_loop()
        rest = memoryview(data)
        deadline_s = loop.time() + _WRITE_TIMEOUT_S
        while rest := rest[self._port.write_some(rest) :]:
            left_s = deadline_s - loop.time()
            if not await self._wait(loop.add_writer, loop.remove_writer, left_s):
                raise Disconnected(f"{self.name} takes no data any more; is the module hanging?")

    def close(self) -> None:
        while self._waiting:
            ready, unwatch = self._waiting.popitem()
            unwatch(self._port.fileno())
            if not ready.done():
                ready.set_exception(Disconnected(f"{self.name} was closed"))
        self._port.close()

    async def _wait(
        self,
        watch: Callable[..., object],
        unwatch: Callable[[int], object],
        timeout_s: float,
    ) -> bool:
        """Wait until the descriptor is ready; False if it is not in time."""
        loop = asyncio.get_running_loop()
        descriptor = self._port.fileno()
        ready: asyncio.Future[bool] = loop.create_future()

        def end(in_time: bool) -> None:
            if not ready.done():
                ready.set_result(in_time)

        self._waiting[ready] = unwatch
        watch(descriptor, end, True)
        # half the cost of wait_for(), which a stream of frames would feel
        timer = loop.call_later(min(max(timeout_s, 0.0), _LONGEST_WAIT_S), end, False)
        try:
            return await ready
        finally:
            timer.cancel()
            if self._waiting.pop(ready, None) is not None:
                unwatch(descriptor)


# Vendor and product ids; the vendor's sources disagree on which of the first two is the
# application and which the bootloader (Protocol reference 10).
_USB_IDS: dict[tuple[int | None, int | None], str] = {
    (0x03EB, 0x6124): "XeThru module",
    (0x03EB, 0x2404): "XeThru module or its bootloader",
    (0x0403, 0x6001): "FTDI adapter (X2 module?)",
    (0x0403, 0x6014): "FTDI adapter (X2 module?)",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class PortInfo:
    """A port worth trying."""

    path: str
    kind: str  # "usb" or "emulated"
    description: str
    serial: str | None


def find_ports() -> tuple[PortInfo, ...]:
    """Ports that may be modules: USB first, then those of running emulators."""
    return (*_usb_ports(), *_emulated_ports(run_directory()))


def run_directory() -> Path:
    """Folder in which running emulators are registered; it may not exist."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime and Path(runtime).is_dir():
        return Path(runtime) / "xethru"
    return Path(tempfile.gettempdir()) / f"xethru-{os.getuid()}"


def _usb_ports() -> Iterator[PortInfo]:
    for port in sorted(list_ports.comports(), key=lambda found: found.device):
        description = _USB_IDS.get((port.vid, port.pid))
        if description is not None:
            yield PortInfo(
                path=port.device, kind="usb", description=description, serial=port.serial_number
            )


def _emulated_ports(folder: Path) -> Iterator[PortInfo]:
    if not folder.is_dir():
        return
    for file in sorted(folder.glob("*.json")):
        try:
            entry: dict[str, Any] = json.loads(file.read_text())
            if not is_running(int(entry["pid"])):
                continue
            devices = [
                (str(one["path"]), str(one["name"]), one["serial"]) for one in entry["devices"]
            ]
        except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
            continue  # not an emulator's entry, or one that is being written
        for path, name, serial_number in devices:
            if os.path.exists(path):  # False, too, for what can be no path
                yield PortInfo(
                    path=path, kind="emulated", description=f"emulated {name}", serial=serial_number
                )


def is_running(pid: int) -> bool:
    """Whether a process of this number exists; False for numbers no process can have."""
    if pid <= 0:  # kill() would mean groups of processes
        return False
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # it exists and is another user's
        pass
    return True

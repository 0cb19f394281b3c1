"""Bytes to and from a port. The only user of pyserial.

>>> from xethru_protocol.transport import SerialTransport
>>> SerialTransport("/dev/no-such-port")
Traceback (most recent call last):
xethru_protocol.errors.PortUnavailable: there is no port /dev/no-such-port; 'xethru list' shows...
"""

import errno
import math
import os
import select
import time
from dataclasses import dataclass
from typing import Protocol

import serial
from serial.tools import list_ports

from xethru_protocol.errors import Disconnected, PortUnavailable

_CHUNK_BYTES = 65536
_WRITE_TIMEOUT_S = 5.0
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

    Parameters
    ----------
    path
        For example ``/dev/ttyACM0`` or a link made by ``xethru-emulator``.
    baudrate
        Rate of a UART; without meaning on USB and ptys.

    Raises
    ------
    PortUnavailable
        If the port does not exist, is no serial port, is in use, or may not be opened.
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
        """See `Transport.read`."""
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
        """See `Transport.write`."""
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
        """See `Transport.close`."""
        self._fd = -1
        try:
            self._port.close()
        except OSError:
            # The device vanished: there is nothing left to release.
            return

    def _lost(self) -> str:
        if self._fd < 0:
            return f"{self.name} was closed"
        return f"{self.name} was disconnected; plug the module in again"


def capacity_bytes_per_s(line: object) -> float:
    """Return what a line says that it carries at most; infinite if it says nothing."""
    return float(getattr(line, "bytes_per_s", math.inf))


def set_rate(line: object, baudrate: int) -> None:
    """Change a line's baud rate, if it has one."""
    change = getattr(line, "set_baudrate", None)
    if change is not None:
        change(baudrate)


def _whole_ms(timeout_s: float) -> int:
    return math.ceil(min(max(timeout_s, 0.0), _LONGEST_WAIT_S) * 1000)


@dataclass(frozen=True, slots=True, kw_only=True)
class UsbSerialPort:
    """A serial port and the USB ids behind it, None where it has none."""

    path: str
    vendor_id: int | None
    product_id: int | None
    serial: str | None


def usb_serial_ports() -> tuple[UsbSerialPort, ...]:
    """Return the serial ports the system lists, by path; pseudo-terminals are never among them."""
    return tuple(
        UsbSerialPort(
            path=port.device, vendor_id=port.vid, product_id=port.pid, serial=port.serial_number
        )
        for port in sorted(list_ports.comports(), key=lambda found: found.device)
    )


def _why(path: str, error: Exception) -> str:
    number = getattr(error, "errno", None)
    reasons = {
        errno.ENOENT: f"there is no port {path}; 'xethru list' shows the ports there are",
        errno.ENXIO: f"there is no module behind {path}; plug it in again",
        errno.EACCES: f"port {path} may not be opened by this user; "
        "join its group (often 'dialout') and log in again",
        errno.EBUSY: f"port {path} is in use by another program; close that first",
        errno.EAGAIN: f"port {path} is in use by another program; close that first",
        errno.ENOTTY: f"{path} is not a serial port",
        errno.EISDIR: f"{path} is not a serial port",
        errno.EINVAL: f"{path} is not a serial port",
    }
    if number in reasons:
        return reasons[number]
    text = str(error)
    if "exclusively lock" in text:  # pyserial tells this one by its text only
        return reasons[errno.EAGAIN]
    if "Could not configure port" in text:
        return reasons[errno.ENOTTY]
    return f"port {path} cannot be opened: {text}"

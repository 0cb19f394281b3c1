"""Bytes to and from a port, blocking or with asyncio, and where ports are found.

A port is a serial port of this machine, or a network port: ``tcp://HOST:PORT`` (or ``socket://``)
for bytes as they are, ``rfc2217://HOST:PORT`` for a server that also sets the baud rate.

>>> from xethru_protocol.transport import open_line
>>> open_line("/dev/no-such-port")
Traceback (most recent call last):
xethru_protocol.wire.errors.PortUnavailable: there is no port /dev/no-such-port; 'xethru list'...

An emulator leaves one file ``<pid>.json`` with its ready line in the run directory, because
pseudo-terminals appear in no list of ports.
"""

import asyncio
import errno
import fcntl
import ipaddress
import json
import math
import os
import re
import select
import socket
import stat
import tempfile
import termios
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import serial
from serial.tools import list_ports

from xethru_protocol.validation import reason_of
from xethru_protocol.wire.codes import POWER_UP_BAUD
from xethru_protocol.wire.errors import Disconnected, PortUnavailable

_CHUNK_BYTES = 65536
_FULL_BYTES, _MOST_PARTS = 2048, 8  # after so many bytes more may wait already; so many calls
_WRITE_TIMEOUT_S = 5.0
_LOOK_AGAIN_S = 0.005  # whether another thread has read what is waited for
_TURN_S = 0.005  # how long one task of asyncio may read on while data never end
_LONGEST_WAIT_S = 86400.0  # poll() takes 31 bits of milliseconds; a caller waits again
_BITS_PER_BYTE = 10  # start and stop bit
_SHARE = 0.8  # of a UART, for frames
# Names of ports without a rate of their own: USB CDC and pseudo-terminals.
_UNLIMITED = ("/dev/ttyACM", "/dev/pts/", "/dev/cu.usbmodem", "/dev/tty.usbmodem", "/dev/ttys")
_NETWORK_TIMEOUT_S = 5.0  # to connect; pyserial's, too
_RFC2217_TIMEOUT_S = 3.0  # for an answer about the line; pyserial's, too
_KEEP_ALIVE = {"TCP_KEEPIDLE": 10, "TCP_KEEPINTVL": 5, "TCP_KEEPCNT": 3}  # seconds, and tries


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
        """Release the line: a thread that reads from it gets `Disconnected`.

        May be called twice.
        """


class LineTransport:
    """A `Transport` over a descriptor: what serial ports and network connections have in common."""

    _gone = "was disconnected; plug the module in again"

    def __init__(self, name: str, descriptor: int) -> None:
        self.name = name
        self._wake, self._waker = os.pipe()  # ends the wait of another thread
        self._fd = descriptor
        # select(), which pyserial's write uses, cannot wait on descriptors above 1023
        self._readable, self._writable = select.poll(), select.poll()
        self._readable.register(self._fd, select.POLLIN)
        self._readable.register(self._wake, select.POLLIN)
        self._writable.register(self._fd, select.POLLOUT)

    def read(self, timeout_s: float) -> bytes:
        try:
            # A line under load has data already, and one call is faster than two.
            data = self._take()
            if data:
                return self._with_more(data)
            if not self._readable.poll(_whole_ms(timeout_s)):
                return b""
            data = self._take()
        except (OSError, ValueError) as error:  # EIO: the other end of a pty is gone
            raise Disconnected(self._lost()) from error
        if data == b"":  # readable, yet nothing there: hung up
            raise Disconnected(self._lost())
        return data or b""

    def _with_more(self, data: bytes) -> bytes:
        """Add what is there already: a pty gives 4095 bytes a call, less than a frame."""
        parts = [data]
        while len(parts[-1]) >= _FULL_BYTES and len(parts) < _MOST_PARTS:
            try:
                more = self._take()
            except OSError:  # the next read reports it; what came before is not lost
                break
            if not more:
                break
            parts.append(more)
        return b"".join(parts)

    def _take(self) -> bytes | None:
        """Take what is there; b"" or None, by the kind of port, if nothing is."""
        try:
            return os.read(self._fd, _CHUNK_BYTES)
        except BlockingIOError:
            return None

    def write(self, data: bytes) -> None:
        deadline = time.monotonic() + _WRITE_TIMEOUT_S
        rest = memoryview(data)
        while rest or self.unsent:
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

    @property
    def unsent(self) -> bool:
        """Whether bytes that `write_some` took still wait for room."""
        return False

    def fileno(self) -> int:
        """Descriptor to wait for with other means; raises `Disconnected` after `close`."""
        if self._fd < 0:
            raise Disconnected(self._lost())
        return self._fd

    @property
    def bytes_per_s(self) -> float:
        """What the line carries at most; infinite if it has no known limit."""
        return math.inf

    def set_baudrate(self, baudrate: int) -> None:
        """Change this side's rate, keeping the port open; no effect on lines that have none."""

    def close(self) -> None:
        if self._fd >= 0:
            self._fd = -1
            os.write(self._waker, b"!")
            os.close(self._waker)
            os.close(self._wake)

    def __del__(self) -> None:
        # a pseudo-terminal would stay exclusive, and the two descriptors open
        if getattr(self, "_fd", -1) >= 0:  # missing if the line could not be opened
            self.close()

    def _lost(self) -> str:
        return f"{self.name} was closed" if self._fd < 0 else f"{self.name} {self._gone}"


class SerialTransport(LineTransport):
    """A serial port: a real module's or an emulated one's pty.

    Takes an exclusive lock, so that two programs do not each get half of the bytes, and has the
    system refuse further opens (``TIOCEXCL``), since not every program asks for the lock.

    ``path`` is, for example, ``/dev/ttyACM0`` or a link made by ``xethru-emulator``; ``baudrate``
    matters on a UART only. Raises PortUnavailable if the port does not exist, is not a serial port,
    is in use, or may not be opened.
    """

    def __init__(self, path: str, baudrate: int = POWER_UP_BAUD) -> None:
        patched_by = serial.Serial.read.__module__
        if patched_by != serial.Serial.__module__:
            raise PortUnavailable(
                f"{path} is not opened: {patched_by} has replaced methods of serial.Serial, and "
                "this driver reads the port itself; record with 'xethru record --out X.mcap' and "
                "replay with 'xethru-emulator play X.mcap', or pytest's --radar replay:X.mcap"
            )
        try:
            self._port = serial.Serial(path, baudrate, timeout=0, exclusive=True)
        # SerialException is an OSError; no rate can have more than 32 bits
        except (OSError, ValueError, OverflowError) as error:
            raise PortUnavailable(_why(path, error)) from None
        super().__init__(path, self._port.fileno())
        self._set_exclusive(termios.TIOCEXCL)

    @property
    def bytes_per_s(self) -> float:
        """What the line carries at most: 10 bits per byte on a UART, infinite elsewhere."""
        real = os.path.realpath(self.name)
        if real.startswith(_UNLIMITED) and not _is_emulated_uart(real):
            return math.inf
        return self._port.baudrate / _BITS_PER_BYTE

    def set_baudrate(self, baudrate: int) -> None:
        """Change this side's rate, keeping the port open."""
        try:
            self._port.baudrate = baudrate
        except (OSError, ValueError) as error:  # SerialException is an OSError
            raise Disconnected(
                f"{self.name} cannot be set to {baudrate} baud: {reason_of(error)}"
            ) from error

    def close(self) -> None:
        if self._fd >= 0:
            self._set_exclusive(termios.TIOCNXCL)  # it would outlive this descriptor on a pty
        super().close()
        with suppress(OSError):  # the device vanished: there is nothing left to release
            self._port.close()

    def _set_exclusive(self, request: int) -> None:
        with suppress(OSError):  # no terminal of this system knows it, or it vanished
            fcntl.ioctl(self._fd, request)


class SocketTransport(LineTransport):
    """A module behind ``tcp://HOST:PORT`` or ``socket://HOST:PORT``, such as ser2net's raw ports.

    It has no lock: the server decides who else may connect, and most take one client at a
    time. Raises PortUnavailable if the server cannot be reached.
    """

    _gone = (
        "hung up; is the module gone, or has another program taken it? "
        "(an adapter has one client at a time)"
    )

    def __init__(self, url: str) -> None:
        host, port = _address(url)
        try:
            self._socket = socket.create_connection((host, port), _NETWORK_TIMEOUT_S)
        except (OSError, UnicodeError) as error:  # UnicodeError: not a host name
            raise PortUnavailable(_why_unreachable(url, host, error)) from None
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        keep_alive(self._socket)
        super().__init__(url, self._socket.fileno())

    def close(self) -> None:
        super().close()
        self._socket.close()


# Telnet (RFC 854, 856, 858) and its option for serial ports (RFC 2217)
_IAC, _SB, _SE = b"\xff", b"\xfa", b"\xf0"
_WILL, _WONT, _DO, _DONT = 251, 252, 253, 254
_BINARY, _NO_GO_AHEAD, _COM_PORT = 0, 3, 44
_OPTIONS = frozenset({_BINARY, _NO_GO_AHEAD, _COM_PORT})
_SET_BAUDRATE, _PURGE_DATA = 1, 12
# 8 data bits, no parity, 1 stop bit, no flow control, DTR and RTS on: as pyserial opens a port
_FORMAT = ((2, 8), (3, 1), (4, 1), (5, 1), (5, 8), (5, 11))
_PURGE_BOTH = 3
_FROM_SERVER = 100  # added to a command in its answer
_TELNET = re.compile(
    rb"\xff(?:(\xff)|([\xfb-\xfe])(.)|\xfa((?:[^\xff]|\xff\xff)*)\xff\xf0|[^\xfa-\xff])", re.DOTALL
)
_LONGEST_COMMAND = 4096
_MOST_UNSENT = 65536


class Rfc2217Transport(SocketTransport):
    """A serial port of another machine at ``rfc2217://HOST:PORT``, whose baud rate can be set.

    pyserial's own client needs a thread that takes every byte by itself, and carries 0.4 MB/s on
    one core; this one leaves the descriptor to the caller. Raises PortUnavailable if the server
    cannot be reached, does not speak RFC 2217, or does not set the rate.
    """

    def __init__(self, url: str, baudrate: int = POWER_UP_BAUD) -> None:
        super().__init__(url)
        self._held = b""  # an incomplete telnet command
        self._came = b""  # read while an answer about the line was waited for
        self._outgoing = bytearray()
        self._flushing = threading.Lock()  # the thread that reads answers telnet commands
        self._offered = {(verb, option) for verb in (_WILL, _DO) for option in _OPTIONS}
        self._answers: dict[int, bytes] = {}
        self._speaks = False  # the server knows RFC 2217
        self._purged = False  # what came before is older than this connection
        self._baudrate = baudrate
        try:
            for verb, option in sorted(self._offered):
                self._outgoing += bytes((_IAC[0], verb, option))
            if not self._wait(lambda: self._speaks):
                raise PortUnavailable(
                    f"{url}: what answers there does not speak RFC 2217; "
                    f"is it a plain TCP port? Then name it tcp://{url.partition('://')[2]}"
                )
            self.set_baudrate(baudrate)
            for command, value in _FORMAT:
                self._command(command, bytes((value,)))
            self._command(_PURGE_DATA, bytes((_PURGE_BOTH,)))
            self._wait(lambda: _PURGE_DATA in self._answers)
        except Disconnected as error:
            self.close()
            raise PortUnavailable(str(error)) from None
        except BaseException:
            self.close()
            raise

    @property
    def bytes_per_s(self) -> float:
        """10 bits per byte at the rate that was set."""
        return self._baudrate / _BITS_PER_BYTE

    def set_baudrate(self, baudrate: int) -> None:
        """Change the rate of the server's port; `Disconnected` if it does not do that."""
        self._answers.pop(_SET_BAUDRATE, None)
        try:
            self._command(_SET_BAUDRATE, baudrate.to_bytes(4, "big"))
        except OverflowError:
            raise Disconnected(f"{self.name}: {baudrate} is not a baud rate") from None
        if not self._wait(lambda: _SET_BAUDRATE in self._answers):
            raise Disconnected(f"{self.name} does not answer to a change of the baud rate")
        found = int.from_bytes(self._answers[_SET_BAUDRATE], "big")
        if found != baudrate:
            raise Disconnected(
                f"{self.name} cannot be set to {baudrate} baud: the server reports {found}"
            )
        self._baudrate = baudrate

    def write_some(self, data: bytes | memoryview) -> int:
        if len(self._outgoing) > _MOST_UNSENT:
            data = b""
        self._outgoing += bytes(data).replace(_IAC, _IAC + _IAC)
        self._flush()
        return len(data)

    @property
    def unsent(self) -> bool:
        return bool(self._outgoing)

    def _take(self) -> bytes | None:
        if self._came:
            came, self._came = self._came, b""
            return came
        data = super()._take()
        if data:
            data = self._without_commands(data) or None  # b"" would mean that the server hung up
            self._flush()
        return data

    def _flush(self) -> None:
        with self._flushing:
            if self._outgoing:
                del self._outgoing[: super().write_some(bytes(self._outgoing))]

    def _wait(self, done: Callable[[], bool]) -> bool:
        """Receive until ``done()``; False if that did not happen in time."""
        deadline = time.monotonic() + _RFC2217_TIMEOUT_S
        self._purged = False
        self._flush()
        while not done():
            left_s = deadline - time.monotonic()
            if left_s <= 0:
                return False
            try:
                data = super()._take() if self._readable.poll(_whole_ms(left_s)) else None
            except RuntimeError:  # another thread waits for the line, and takes the answer, too
                time.sleep(_LOOK_AGAIN_S)
                continue
            except OSError as error:
                raise Disconnected(self._lost()) from error
            if data == b"":
                raise Disconnected(self._lost())
            if data:
                came = self._without_commands(data)
                self._came = came if self._purged else self._came + came
                self._purged = False
            self._flush()
        return True

    def _command(self, command: int, value: bytes) -> None:
        about = bytes((_COM_PORT, command)) + value
        self._outgoing += _IAC + _SB + about.replace(_IAC, _IAC + _IAC) + _IAC + _SE

    def _without_commands(self, data: bytes) -> bytes:
        """Return the module's bytes; telnet commands between them are carried out."""
        if self._held:
            data, self._held = self._held + data, b""
        if _IAC not in data:
            return data
        parts, start = [], 0
        while (at := data.find(_IAC, start)) >= 0:
            parts.append(data[start:at])
            found = _TELNET.match(data, at)
            if found is None:
                self._held, start = data[at:], len(data)
                if len(self._held) > _LONGEST_COMMAND:
                    raise Disconnected(f"{self.name} does not send telnet; is it another port?")
                break
            start = found.end()
            escaped, verb, option, about = found.groups()
            if escaped:
                parts.append(_IAC)
            elif verb:
                self._negotiate(verb[0], option[0])
            elif about and about[0] == _COM_PORT and len(about) > 1:
                about = about.replace(_IAC + _IAC, _IAC)
                self._answers[about[1] - _FROM_SERVER] = about[2:]
                if about[1] == _PURGE_DATA + _FROM_SERVER:
                    parts.clear()
                    self._purged = True
        parts.append(data[start:])
        return b"".join(parts)

    def _negotiate(self, verb: int, option: int) -> None:
        """Agree to what is needed and refuse the rest, each once (RFC 854)."""
        if verb in (_WONT, _DONT):
            return
        self._speaks |= option == _COM_PORT
        agree, refuse = (_DO, _DONT) if verb == _WILL else (_WILL, _WONT)
        answer = agree if option in _OPTIONS else refuse
        if (answer, option) not in self._offered:
            self._offered.add((answer, option))
            self._outgoing += bytes((_IAC[0], answer, option))


_SCHEMES = ("tcp", "socket", "rfc2217")


def is_network_port(port: str) -> bool:
    """Whether a port is named by a scheme, such as ``tcp://``; also if there is no such scheme."""
    return re.match(r"[A-Za-z][A-Za-z0-9+.-]*://", port) is not None


def _is_rfc2217(port: str) -> bool:
    return port.lower().startswith("rfc2217:")


def open_line(port: str, baudrate: int = POWER_UP_BAUD) -> LineTransport:
    """Open a port by its name: a serial port, ``tcp://``, ``socket://`` or ``rfc2217://``.

    ``baudrate`` matters on UARTs, and at ``rfc2217://``. Raises PortUnavailable with what is wrong
    with the name, or why it cannot be opened.
    """
    if not is_network_port(port):
        return SerialTransport(port, baudrate)
    if _is_rfc2217(port):
        return Rfc2217Transport(port, baudrate)
    return SocketTransport(port)


def _address(url: str) -> tuple[str, int]:
    scheme, _, rest = url.partition("://")
    if scheme.lower() not in _SCHEMES:
        raise PortUnavailable(
            f"{url}: {scheme}:// is not a kind of port; there are tcp://HOST:PORT, "
            "rfc2217://HOST:PORT, and serial ports such as /dev/ttyACM0"
        )
    if (address := host_and_port(rest.removesuffix("/"))) is None:
        raise PortUnavailable(
            f"{url}: must be {scheme}://HOST:PORT with a port of 1...65535, and nothing behind it"
        )
    return address


def host_and_port(text: str) -> tuple[str, int] | None:
    """Return the two parts of ``HOST:PORT``; None if it is something else.

    >>> host_and_port("[::1]:8765"), host_and_port("lab-pc:0"), host_and_port("lab-pc")
    (('::1', 8765), None, None)
    """
    found = re.fullmatch(r"(\[[^\]]+\]|[^:/?#\[\]]+):([0-9]{1,5})", text, re.ASCII)
    if found is None or not 0 < int(found[2]) < 65536:
        return None
    return found[1].strip("[]"), int(found[2])


def is_loopback(host: str) -> bool:
    """Whether a name or address surely stands for this machine only.

    >>> [is_loopback(host) for host in ("127.0.0.1", "::1", "localhost", "0.0.0.0", "lab-pc")]
    [True, True, True, False, False]
    """
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False  # a name may lead anywhere


def listening_socket(host: str, port: int, backlog: int) -> socket.socket:
    """Return a socket that listens at a port, 0: at any that is free, and does not block.

    Raises PortUnavailable if it cannot be had.
    """
    try:
        family, _, _, _, address = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0]
        listener = socket.create_server((address[0], port), family=family, backlog=backlog)
    except (OSError, UnicodeError) as error:  # the latter of a name that no host can have
        reason = str(error.args[-1])
        if isinstance(error, OSError) and error.errno is not None and error.errno > 0:
            reason = os.strerror(error.errno)  # without the address that Python adds to it
        raise PortUnavailable(f"{host}:{port}: cannot listen: {reason}") from error
    listener.setblocking(False)
    return listener


def keep_alive(connection: socket.socket) -> None:
    """Find out in half a minute that the other machine lost its power, of which it says nothing."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in _KEEP_ALIVE.items():
        if hasattr(socket, option):  # Linux
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)


def _why_unreachable(url: str, host: str, error: Exception) -> str:
    if isinstance(error, socket.gaierror | UnicodeError):
        reason = getattr(error, "strerror", None) or "no such name can exist"
        return f"{url} cannot be reached: there is no host {host} ({reason})"
    if isinstance(error, ConnectionRefusedError):
        plain = not _is_rfc2217(url)
        servers = "ser2net, an adapter, or 'xethru-emulator serve --tcp'"
        return (
            f"{url} cannot be reached: nothing listens there; does "
            f"{servers if plain else 'ser2net or an adapter'} run on that machine?"
        )
    if isinstance(error, TimeoutError):
        return f"{url} cannot be reached: no answer within {_NETWORK_TIMEOUT_S:g} s; is it on?"
    return f"{url} cannot be reached: {getattr(error, 'strerror', None) or error}"


def capacity_bytes_per_s(line: object) -> float:
    """Return the highest rate of a line; infinite if it has no known limit."""
    return float(getattr(line, "bytes_per_s", math.inf))


def carried_rate_hz(wanted_hz: float, bytes_per_s: float, frame_bytes: int) -> float:
    """Return the wanted frame rate, or less, whole Hz, if a line carries fewer frames.

    A fifth of the line is kept for answers: behind frames that fill it they come late or never.
    """
    if math.isinf(bytes_per_s):
        return wanted_hz
    return min(wanted_hz, float(max(math.floor(bytes_per_s * _SHARE / frame_bytes), 1)))


def set_rate(line: object, baudrate: int) -> object:
    """Change the rate of a line that has one; what is returned is awaitable for one of asyncio."""
    change = getattr(line, "set_baudrate", None)
    return None if change is None else change(baudrate)


def _whole_ms(timeout_s: float) -> int:
    return math.ceil(min(max(timeout_s, 0.0), _LONGEST_WAIT_S) * 1000)


def _why(path: str, error: Exception) -> str:
    in_use = f"port {path} is in use by another program, or twice by this one; close that first"
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
    """A port whose descriptor the running event loop watches; ports as of `open_line`.

    What may take seconds is done in a thread, so that other tasks go on: connecting to a network
    port, by the first read or write unless `connect` was called before, and a change of its rate.
    """

    def __init__(self, path: str, baudrate: int = POWER_UP_BAUD) -> None:
        self.name = path
        self._baudrate = baudrate
        self._port: LineTransport | None = None
        if is_network_port(path):
            _address(path)  # a name that cannot be is refused at once
        else:
            self._port = open_line(path, baudrate)
        self._closed = False
        self._connecting: asyncio.Future[LineTransport] | None = None
        self._changing: asyncio.Future[None] | None = None  # its rate; the port is a thread's
        # Tasks that wait for the descriptor, which must not be watched once it is closed.
        self._waiting: dict[asyncio.Future[bool], Callable[[int], object]] = {}
        self._turn_ends_s = 0.0

    async def connect(self) -> LineTransport:
        """Open the port if that was not done yet; raises PortUnavailable."""
        if self._port is None:
            if self._connecting is None:
                self._raise_if_closed()
                opening = asyncio.to_thread(open_line, self.name, self._baudrate)
                self._connecting = asyncio.ensure_future(opening)
                self._connecting.add_done_callback(self._connected)
            self._port = await asyncio.shield(self._connecting)
            self._raise_if_closed()
        return self._port

    def _connected(self, done: asyncio.Future[LineTransport]) -> None:
        self._connecting = None
        if not done.cancelled() and done.exception() is None:
            self._port = done.result()
            if self._closed:
                self._port.close()

    def _raise_if_closed(self) -> None:
        if self._closed:
            raise Disconnected(f"{self.name} was closed")

    @property
    def bytes_per_s(self) -> float:
        if self._port is None:
            return self._baudrate / _BITS_PER_BYTE if _is_rfc2217(self.name) else math.inf
        return self._port.bytes_per_s

    async def set_baudrate(self, baudrate: int) -> None:
        port = await self.connect()
        if not _is_rfc2217(self.name):
            port.set_baudrate(baudrate)
            return
        self._changing = asyncio.ensure_future(asyncio.to_thread(port.set_baudrate, baudrate))
        self._changing.add_done_callback(self._changed)
        await asyncio.shield(self._changing)

    def _changed(self, done: asyncio.Future[None]) -> None:
        self._changing = None
        for ready in self._waiting:  # the thread may have read what they wait for
            if not ready.done():
                ready.set_result(True)

    async def read(self, timeout_s: float) -> bytes:
        port = self._port or await self.connect()
        loop = asyncio.get_running_loop()
        if loop.time() > self._turn_ends_s:  # a line that never pauses: now the other tasks
            await asyncio.sleep(0)  # before reading: a task cancelled here must lose no bytes
            self._turn_ends_s = loop.time() + _TURN_S
        if self._changing is not None:
            await asyncio.wait({self._changing}, timeout=min(max(timeout_s, 0.0), _LONGEST_WAIT_S))
            return b""
        data = port.read(0.0)
        if data or timeout_s <= 0:
            return data
        ready = await self._wait(loop.add_reader, loop.remove_reader, timeout_s)
        self._turn_ends_s = loop.time() + _TURN_S
        return port.read(0.0) if ready and self._changing is None else b""

    async def write(self, data: bytes) -> None:
        port = self._port or await self.connect()
        loop = asyncio.get_running_loop()
        rest = memoryview(data)
        deadline_s = loop.time() + _WRITE_TIMEOUT_S
        while (rest := rest[port.write_some(rest) :]) or port.unsent:
            left_s = deadline_s - loop.time()
            if not await self._wait(loop.add_writer, loop.remove_writer, left_s):
                raise Disconnected(f"{self.name} takes no data any more; is the module hanging?")

    def close(self) -> None:
        self._closed = True
        if self._port is None:
            return
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
        assert self._port is not None, "connected before"
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


# Vendor and product ids. Protocol reference 10.
_USB_IDS: dict[tuple[int | None, int | None], str] = {
    (0x03EB, 0x6124): "XeThru module",
    (0x03EB, 0x2404): "XeThru module in its bootloader",
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
    tcp: int | None = None  # TCP port of this machine at which an emulated module is, too
    uart: bool = False  # an emulated one, with a baud rate


def find_ports() -> tuple[PortInfo, ...]:
    """Ports that may be modules: USB first, then those of running emulators."""
    return (*_usb_ports(), *_emulated_ports(run_directory()))


def run_directory() -> Path:
    """Folder in which running emulators are registered; it may not exist."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime and Path(runtime).is_dir():
        return Path(runtime) / "xethru"
    return Path(tempfile.gettempdir()) / f"xethru-{os.getuid()}"


def is_private(folder: Path) -> bool:
    """Whether a folder is this user's, and no other user may write there.

    Only then is the run directory used: in the folder for temporary files anybody can make one
    of that name.
    """
    try:
        status = folder.lstat()
    except OSError:
        return False
    mine = stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid()
    return mine and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _usb_ports() -> Iterator[PortInfo]:
    for port in sorted(list_ports.comports(), key=lambda found: found.device):
        description = _USB_IDS.get((port.vid, port.pid))
        if description is not None:
            yield PortInfo(
                path=port.device, kind="usb", description=description, serial=port.serial_number
            )


def announcements(folder: Path) -> list[Path]:
    """Return the files in which emulators say what they serve; none of a folder of others."""
    if not is_private(folder):
        return []
    # a pipe or a device there could be read for ever
    return [path for path in sorted(folder.glob("*.json")) if path.is_file()]


def _emulated_ports(folder: Path) -> Iterator[PortInfo]:
    for file in announcements(folder):
        try:
            entry: dict[str, Any] = json.loads(file.read_text())
            if not is_running(int(entry["pid"])):
                continue
            devices = [
                (str(one["path"]), str(one["name"]), one["serial"], one.get("tcp"), one.get("uart"))
                for one in entry["devices"]
            ]
        except (
            OSError,
            ValueError,
            KeyError,
            TypeError,
            AttributeError,
            OverflowError,
            RecursionError,
        ):
            continue  # not an emulator's entry, or one that is being written
        for path, name, serial_number, tcp, uart in devices:
            if os.path.exists(path):  # False, too, for what can be no path
                yield PortInfo(
                    path=path,
                    kind="emulated",
                    description=f"emulated {name}",
                    serial=serial_number,
                    tcp=tcp,
                    uart=bool(uart),
                )


def _is_emulated_uart(path: str) -> bool:
    ports = _emulated_ports(run_directory())
    return any(port.uart and os.path.realpath(port.path) == path for port in ports)


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

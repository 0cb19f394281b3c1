"""Where a robot's odometry comes from, as text: stdin, files, sockets, serial ports.

`parse_source` turns what the user wrote into a `LineSource`; `read_lines` gives its lines with the
host's time at which each one came, so that a thread can follow any of them alike.
"""

from __future__ import annotations

import contextlib
import os
import re
import select
import socket
import stat
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

from slam.app.errors import OdometryError, UsageError
from xethru_protocol.errors import XeThruError
from xethru_protocol.transport import SerialTransport

BAUD = 115200
_POLL_S = 0.2
_CHUNK_BYTES = 65536
_LONGEST_LINE = 4096
_CONNECT_S = 5.0

HELP = (
    "-, a file or FIFO, unix:PATH, tcp://HOST:PORT, serial:PORT[@BAUD]; a path to a socket or a "
    "serial port will do"
)


class SourceKind(StrEnum):
    """What stands behind a source."""

    STDIN = "stdin"
    FILE = "file"
    FIFO = "FIFO"
    UNIX = "unix socket"
    TCP = "TCP socket"
    SERIAL = "serial port"


@dataclass(frozen=True, slots=True, kw_only=True)
class LineSource:
    """A source as the user named it: a path, or host and number (a port's, or a rate in baud)."""

    kind: SourceKind
    place: str
    number: int = 0

    @property
    def name(self) -> str:
        """Return what to call it in messages to people."""
        if self.kind is SourceKind.STDIN:
            return "stdin"
        where = f"{self.place}:{self.number}" if self.kind is SourceKind.TCP else self.place
        return f"{self.kind} {where}"

    @property
    def is_live(self) -> bool:
        """Whether lines come when they are new, so that their arrival tells the time."""
        return self.kind is not SourceKind.FILE


def parse_source(text: str) -> LineSource:
    """Return the source that a text means.

    Raises
    ------
    UsageError
        It means none; one line with what is allowed.

    Examples
    --------
    >>> parse_source("tcp://127.0.0.1:5005")
    LineSource(kind=<SourceKind.TCP: 'TCP socket'>, place='127.0.0.1', number=5005)
    >>> parse_source("serial:/dev/ttyUSB0@57600").name
    'serial port /dev/ttyUSB0'
    """
    if text == "-":
        return LineSource(kind=SourceKind.STDIN, place="-")
    scheme, colon, rest = text.partition(":")
    if colon and scheme in _SCHEMES:
        return _SCHEMES[scheme](text, rest)
    return _path_source(text)


def _tcp_source(text: str, rest: str) -> LineSource:
    host, _, port = rest.removeprefix("//").rpartition(":")
    number = int(port) if re.fullmatch(r"[0-9]{1,5}", port) else 0
    if not rest.startswith("//") or not host or not 0 < number < 1 << 16:
        raise UsageError(f"odometry {text}: must be tcp://HOST:PORT")
    return LineSource(kind=SourceKind.TCP, place=host.strip("[]"), number=number)


def _serial_source(text: str, rest: str) -> LineSource:
    path, at, baud = rest.partition("@")
    if not path or (at and not re.fullmatch(r"[1-9][0-9]{0,7}", baud)):
        raise UsageError(f"odometry {text}: must be serial:PORT or serial:PORT@BAUD")
    return LineSource(kind=SourceKind.SERIAL, place=path, number=int(baud or BAUD))


_SCHEMES: Mapping[str, Callable[[str, str], LineSource]] = {
    "tcp": _tcp_source,
    "unix": lambda _, rest: LineSource(kind=SourceKind.UNIX, place=rest),
    "serial": _serial_source,
}


def _path_source(text: str) -> LineSource:
    try:
        mode = os.stat(text).st_mode
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UsageError(f"odometry {text}: {reason}; give one of {HELP}") from None
    kinds = (
        (stat.S_ISSOCK, SourceKind.UNIX),
        (stat.S_ISFIFO, SourceKind.FIFO),
        (stat.S_ISCHR, SourceKind.SERIAL),
        (stat.S_ISREG, SourceKind.FILE),
    )
    kind = next((kind for is_one, kind in kinds if is_one(mode)), None)
    if kind is None:
        raise UsageError(f"odometry {text}: is no source of text; give one of {HELP}")
    return LineSource(kind=kind, place=text, number=BAUD if kind is SourceKind.SERIAL else 0)


class _Bytes(Protocol):
    def read(self) -> bytes | None:
        """Return what came, None if nothing did in a while, b"" at the end."""

    def close(self) -> None:
        """Let go of it."""


def read_lines(source: LineSource, is_stopped: Callable[[], bool]) -> Iterator[tuple[str, int]]:
    """Yield every line with the host's monotonic time [ns] at which its end was read.

    The last line may lack its end. Bytes that are no text come as replacement characters.

    Parameters
    ----------
    source
        What to read.
    is_stopped
        Asked a few times a second; then reading ends.

    Raises
    ------
    OdometryError
        It cannot be opened, or breaks off; one line.
    """
    stream = _open(source)
    pending = b""
    try:
        while not is_stopped():
            data = stream.read()
            if data is None:
                continue
            now_ns = time.monotonic_ns()
            if not data:
                if pending:
                    yield pending.decode(errors="replace"), now_ns
                return
            *lines, pending = (pending + data).split(b"\n")
            for line in lines:
                yield line.decode(errors="replace"), now_ns
            if len(pending) > _LONGEST_LINE:
                raise OdometryError(
                    f"odometry from {source.name}: {len(pending)} bytes without a line end; "
                    "TUM text is expected"
                )
    except (OSError, XeThruError) as error:
        reason = getattr(error, "strerror", None) or error
        raise OdometryError(f"odometry from {source.name}: {reason}") from None
    finally:
        stream.close()


class _Descriptor:
    """Bytes of anything that has a file descriptor and poll() understands, or a regular file."""

    def __init__(self, fd: int, close: Callable[[], None]) -> None:
        self._fd, self._close = fd, close
        self._poll = select.poll()
        self._poll.register(fd, select.POLLIN)

    def read(self) -> bytes | None:
        if not self._poll.poll(_POLL_S * 1000):
            return None
        try:
            return os.read(self._fd, _CHUNK_BYTES)
        except (BlockingIOError, InterruptedError):
            return None

    def close(self) -> None:
        self._close()


class _Fifo:
    """A FIFO: nobody writing yet is no end, the last writer gone is one."""

    def __init__(self, path: str) -> None:
        self._fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        self._bytes = _Descriptor(self._fd, lambda: os.close(self._fd))
        self._spoke = False

    def read(self) -> bytes | None:
        data = self._bytes.read()
        if data == b"" and not self._spoke:
            time.sleep(_POLL_S)  # poll() returns at once as long as no writer was there
            return None
        self._spoke = self._spoke or bool(data)
        return data

    def close(self) -> None:
        self._bytes.close()


class _Serial:
    def __init__(self, path: str, baud: int) -> None:
        self._port = SerialTransport(path, baud)

    def read(self) -> bytes | None:
        return self._port.read(_POLL_S) or None

    def close(self) -> None:
        self._port.close()


def _open(source: LineSource) -> _Bytes:
    try:
        match source.kind:
            case SourceKind.STDIN:
                return _Descriptor(sys.stdin.fileno(), lambda: None)
            case SourceKind.FILE:
                fd = os.open(source.place, os.O_RDONLY)
                return _Descriptor(fd, lambda: os.close(fd))
            case SourceKind.FIFO:
                return _Fifo(source.place)
            case SourceKind.SERIAL:
                return _Serial(source.place, source.number)
            case SourceKind.UNIX:
                line = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
                return _connected(line, lambda: line.connect(source.place))
            case SourceKind.TCP:
                line = socket.create_connection((source.place, source.number), _CONNECT_S)
                return _connected(line, lambda: None)
    except UnicodeError:  # as the codec of host names has it
        raise OdometryError(f"odometry from {source.name}: is no name of a host") from None
    except (OSError, XeThruError) as error:
        reason = getattr(error, "strerror", None) or error
        raise OdometryError(f"odometry from {source.name}: {reason}") from None


def _connected(line: socket.socket, connect: Callable[[], None]) -> _Descriptor:
    with contextlib.ExitStack() as unless_it_works:
        unless_it_works.callback(line.close)
        line.settimeout(_CONNECT_S)
        connect()
        line.setblocking(False)
        unless_it_works.pop_all()
    return _Descriptor(line.fileno(), line.close)

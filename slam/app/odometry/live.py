"""Where a robot's odometry comes from, as text: stdin, files, sockets, serial ports.

Session time is the odometry's own clock. Its relation to the host's clock follows from when lines
arrive, or is known beforehand; it places radar frames, which are stamped with the host's time.
"""

from __future__ import annotations

import math
import os
import re
import select
import socket
import stat
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from enum import StrEnum
from importlib import import_module

import numpy as np

from slam.app.errors import UsageError
from slam.geometry import MOST_M
from slam.live.arrival_clock import ClockLine, LowerEnvelope
from slam.live.errors import OdometryError
from slam.live.odometry_track import (
    MOST_GAP_NS,
    NS_PER_S,
    OdometryTrack,
    TumError,
    TumSample,
    parse_tum_line,
    symmetric,
)
from xethru_protocol.transport import SerialTransport
from xethru_protocol.wire.errors import XeThruError

SILENCE_S = 10.0
"""A source without a new pose for so long has ended: wheels at rest send poses, too."""
MOST_SPEED_MPS = 10.0
"""Faster robots do not carry these radars; a pose that far off was set by hand or reset."""
AHEAD_NS = 60 * NS_PER_S
"""A file may begin so much later than a run, and a clock be so far off."""
MOST_STAMP_NS = (2**31 - 1_000_000) * NS_PER_S
"""The seconds of a ROS message end at 2**31; days before, for a drive that begins there goes on."""
_MOST_WARNINGS = 5
_ROUNDED = 1e-9  # of the largest eigenvalue, for covariances without full rank


class LiveOdometry(OdometryTrack):
    """Turns lines into poses, and reports what is wrong with them.

    `name` is that of the source in messages, `clock` its clock against the host's, if known; None:
    from when lines arrive. `has_covariance` refuses lines that do not say how velocity errs.

    Attributes
    ----------
    n_refused
        Lines that did not hold a pose, or not later than the one before.
    ended
        Whether no more lines will come.
    trouble
        Why they will not; "" where the source just ended.
    """

    def __init__(
        self, name: str, clock: ClockLine | None = None, *, has_covariance: bool = False
    ) -> None:
        super().__init__((), may_be_empty=True)
        self._name = name
        self._has_covariance = has_covariance
        self._fixed = clock
        self._envelope = LowerEnvelope()
        self._newest_host_ns: int | None = None  # host time of the newest pose taken
        self._trouble = ""  # why the lines since then were refused
        self._n_warnings = 0
        self.n_refused = 0
        self.ended = False
        self.trouble = ""

    @property
    def drift_ppm(self) -> float | None:
        """How fast its clock is against the host's, in millionths; None where that is not asked."""
        return None if self._fixed else self._envelope.line.drift_ppm

    def session_ns(self, host_ns: int) -> int:
        if self._fixed is not None:
            return self._fixed.nominal_ns(host_ns)
        return self._envelope.line.nominal_ns(host_ns)

    def take(self, line: str, arrival_ns: int) -> tuple[TumSample | None, str]:
        """Take a line, of TUM text or empty or a comment, with the host time when it came.

        Returns
        -------
        The pose, None if the line has none; and a warning for the user, or "".
        """
        if not line.strip() or line.lstrip().startswith("#"):
            return None, ""
        try:
            sample = parse_tum_line(line)
        except TumError as error:
            return None, self._refuse(str(error))
        trouble = _rejection(sample)
        if not trouble and self._has_covariance:
            trouble = _covariance_rejection(sample.velocity_covariance)
        if trouble:
            return None, self._refuse(trouble)
        if self and sample.t_ns <= self.last_ns:
            back_s = (self.last_ns - sample.t_ns) / NS_PER_S
            return None, self._refuse(
                f"its stamps jumped back by {back_s:.3f} s"
                if back_s
                else f"stamp {sample.t_ns / NS_PER_S:.3f} s came twice"
            )
        warning = self._accept(sample)
        if self._fixed is None:
            self._envelope.take(sample.t_ns, arrival_ns)
        self._newest_host_ns = arrival_ns
        return sample, warning

    def _accept(self, sample: TumSample) -> str:
        if not self:
            self.append(sample)
            return ""
        before = self.last
        is_restart = self.append(sample)
        warnings = []
        if self._trouble:
            warnings.append("its lines are sound again")
            self._trouble, self._n_warnings = "", 0
        elapsed_ns = sample.t_ns - before.t_ns
        step_m = math.hypot(sample.x_m - before.x_m, sample.y_m - before.y_m)
        if elapsed_ns > MOST_GAP_NS:
            warnings.append(
                f"{elapsed_ns / NS_PER_S:.1f} s of it are missing; no scan of them is used"
            )
        if is_restart or step_m > MOST_SPEED_MPS * elapsed_ns / NS_PER_S:
            warnings.append(
                f"the pose jumped by {step_m:.2f} m in {elapsed_ns / NS_PER_S:.3f} s"
                + (
                    ", as when its source is restarted; SLAM does not take it for a drive"
                    if is_restart
                    else "; was it reset? SLAM takes it for a drive"
                )
            )
        return "; ".join(warnings)

    def _refuse(self, trouble: str) -> str:
        self.n_refused += 1
        is_first = not self._trouble
        self._trouble = self._trouble or trouble
        self._n_warnings += 1
        if is_first:
            return f"{trouble}; such lines are passed over"
        if self._n_warnings == _MOST_WARNINGS:
            return f"{trouble}; further ones are not reported"
        return ""

    def end(self, trouble: str) -> None:
        if not trouble and not self:
            trouble = f"odometry from {self._name}: ended before its first pose"
            trouble += f": {self._trouble}" if self._trouble else ""
        self.ended, self.trouble = True, trouble

    def silence(self, now_ns: int, since_ns: int) -> str:
        """Return why no more poses can be expected, "" if they can.

        Host times; poses are expected from `since_ns` on.
        """
        newest_ns = max(since_ns, self._newest_host_ns or since_ns)
        if self.ended or now_ns - newest_ns <= SILENCE_S * NS_PER_S:
            return ""
        if self._trouble:
            return (
                f"odometry from {self._name}: no usable line for {SILENCE_S:g} s: {self._trouble}"
            )
        said = "no line" if self._newest_host_ns is None else "no more line"
        return f"odometry from {self._name}: {said} for {SILENCE_S:g} s; is its sender running?"

    def clock_mismatch(self, now_ns: int) -> str:
        """Return why its stamps cannot be of the given clock, "" if they can."""
        t_ns = self.session_ns(now_ns)
        if self._fixed is None or self.first_ns - AHEAD_NS <= t_ns <= self.last_ns + AHEAD_NS:
            return ""
        return (
            f"odometry from {self._name}: its newest pose is of {self.last_ns / NS_PER_S:.3f} s, "
            f"and by --odometry-clock it is {t_ns / NS_PER_S:.3f} s now: its stamps are of another "
            "clock; if you do not know which, leave the option out"
        )

    def covers(self, t_ns: int) -> bool:
        return bool(self) and t_ns <= self.last_ns


def _rejection(sample: TumSample) -> str:
    """Return why a session cannot hold a pose, or the filter not take it; "" if both can."""
    if not 0 <= sample.t_ns < MOST_STAMP_NS:
        return (
            f"stamp {sample.t_ns / NS_PER_S:.3f} s is outside 0 to {MOST_STAMP_NS // NS_PER_S} s, "
            "the range of a session"
        )
    if max(abs(sample.x_m), abs(sample.y_m)) > MOST_M:
        return f"position ({sample.x_m:g}, {sample.y_m:g}) m is nowhere on Earth"
    return ""


def _covariance_rejection(triangle: tuple[float, ...]) -> str:
    """Return why an upper triangle cannot be the covariance of a velocity; "" if it can."""
    if not any(triangle):  # which in ROS means unknown
        return "it does not say how its velocity errs, as --odometry-covariance needs"
    least, _, most = np.linalg.eigvalsh(symmetric(triangle)).tolist()
    if least >= -_ROUNDED * most and most <= MOST_SPEED_MPS**2:
        return ""
    return (
        f"the covariance of its velocity has eigenvalues of {least:g} to {most:g}; no velocity is "
        f"that uncertain, above {MOST_SPEED_MPS**2:g} drivers mean that it is unknown"
    )


BAUD = 115200
_POLL_S = 0.2
_CHUNK_BYTES = 65536
_LONGEST_LINE = 4096
_CONNECT_S = 5.0

HELP = (
    "-, a file or FIFO, unix:PATH, tcp://HOST:PORT, serial:PORT[@BAUD], ros2:TOPIC[:PARENT:CHILD]; "
    "a path to a socket or a serial port will do"
)


class SourceKind(StrEnum):
    """What stands behind a source, in words for messages."""

    STDIN = "stdin"
    FILE = "file"
    FIFO = "FIFO"
    UNIX = "unix socket"
    TCP = "TCP socket"
    SERIAL = "serial port"
    ROS2 = "ROS 2 topic"


@dataclass(frozen=True, slots=True, kw_only=True)
class LineSource:
    """A source as the user named it: a path, or host and number (a port's, or a rate in baud).

    Of a topic of ROS 2 `frames` are parent and child of its poses, (): those of REP 105.
    """

    kind: SourceKind
    place: str
    number: int = 0
    frames: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        if self.kind is SourceKind.STDIN:
            return "stdin"
        where = f"{self.place}:{self.number}" if self.kind is SourceKind.TCP else self.place
        return f"{self.kind} {where}"

    @property
    def is_live(self) -> bool:
        """Whether lines arrive as they are made, so that their arrival gives the time."""
        return self.kind is not SourceKind.FILE


def parse_source(text: str) -> LineSource:
    """Return the source that a text means; UsageError if it means none.

    >>> parse_source("tcp://127.0.0.1:5005")
    LineSource(kind=<SourceKind.TCP: 'TCP socket'>, place='127.0.0.1', number=5005, frames=())
    >>> parse_source("serial:/dev/ttyUSB0@57600").name
    'serial port /dev/ttyUSB0'
    """
    if text == "-":
        return LineSource(kind=SourceKind.STDIN, place="-")
    scheme, colon, rest = text.partition(":")
    match scheme if colon else "":
        case "tcp":
            host, _, port = rest.removeprefix("//").rpartition(":")
            number = int(port) if re.fullmatch(r"[0-9]{1,5}", port) else 0
            if not rest.startswith("//") or not host or not 0 < number < 1 << 16:
                raise UsageError(f"odometry {text}: must be tcp://HOST:PORT")
            return LineSource(kind=SourceKind.TCP, place=host.strip("[]"), number=number)
        case "unix":
            return LineSource(kind=SourceKind.UNIX, place=rest)
        case "serial":
            path, at, baud = rest.partition("@")
            if not path or (at and not re.fullmatch(r"[1-9][0-9]{0,7}", baud)):
                raise UsageError(f"odometry {text}: must be serial:PORT or serial:PORT@BAUD")
            return LineSource(kind=SourceKind.SERIAL, place=path, number=int(baud or BAUD))
        case "ros2":
            return _topic_source(rest)
    return _path_source(text)


def _topic_source(text: str) -> LineSource:
    topic, *frames = text.split(":")
    is_pair = len(frames) in (0, 2) and all(re.fullmatch(r"[\w/.-]+", frame) for frame in frames)
    if not re.fullmatch(r"(?a)/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", topic) or not is_pair:
        raise UsageError(
            f"odometry ros2:{text}: must be ros2:TOPIC, or ros2:TOPIC:PARENT:CHILD where the "
            "frames are not odom and base_link or base_footprint"
        )
    # what is missing is reported before the modules are set up
    import_module("slam.app.odometry.dds").domain_number()
    place = f"/{topic.removeprefix('/')}"
    return LineSource(kind=SourceKind.ROS2, place=place, frames=tuple(frames))


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
        raise UsageError(f"odometry {text}: is not a source of text; give one of {HELP}")
    return LineSource(kind=kind, place=text, number=BAUD if kind is SourceKind.SERIAL else 0)


def read_lines(source: LineSource, is_stopped: Callable[[], bool]) -> Iterator[tuple[str, int]]:
    """Yield every line with the host's monotonic time [ns] at which its end was read.

    The last line may lack its end. Bytes that are not text come as replacement characters.
    `is_stopped` is called a few times a second; reading ends when it returns True. Raises
    OdometryError if the source cannot be opened, or breaks off.
    """
    if source.kind is SourceKind.ROS2:
        from slam.app.odometry.ros2 import topic_lines  # its package is an extra of its own

        yield from topic_lines(source.place, source.frames, is_stopped)
        return
    pending = b""
    try:
        with _opened(source) as read:
            while not is_stopped():
                data = read()
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
    except UnicodeError:  # as the codec of host names has it
        raise OdometryError(f"odometry from {source.name}: is not the name of a host") from None
    except (OSError, XeThruError) as error:
        reason = getattr(error, "strerror", None) or error
        raise OdometryError(f"odometry from {source.name}: {reason}") from None


@contextmanager
def _opened(source: LineSource) -> Iterator[Callable[[], bytes | None]]:
    """Hold a source open; the function returns what came, None if nothing did, b"" at the end."""
    with ExitStack() as held:
        match source.kind:
            case SourceKind.SERIAL:
                port = held.enter_context(closing(SerialTransport(source.place, source.number)))
                yield lambda: port.read(_POLL_S) or None
                return
            case SourceKind.STDIN:
                fd = sys.stdin.fileno()
            case SourceKind.FILE | SourceKind.FIFO:
                fd = os.open(source.place, os.O_RDONLY | os.O_NONBLOCK)
                held.callback(os.close, fd)
            case SourceKind.UNIX:
                line = held.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
                line.settimeout(_CONNECT_S)
                line.connect(source.place)
                line.setblocking(False)
                fd = line.fileno()
            case SourceKind.TCP:
                address = (source.place, source.number)
                line = held.enter_context(socket.create_connection(address, _CONNECT_S))
                line.setblocking(False)
                fd = line.fileno()
        yield _Descriptor(fd, is_fifo=source.kind is SourceKind.FIFO).read


class _Descriptor:
    """Anything that has a file descriptor and poll() understands, or a regular file.

    A FIFO ends when the last writer closes it, not while there is no writer yet.
    """

    def __init__(self, fd: int, *, is_fifo: bool) -> None:
        self._fd, self._waits_for_writer = fd, is_fifo
        self._poll = select.poll()
        self._poll.register(fd, select.POLLIN)

    def read(self) -> bytes | None:
        if not self._poll.poll(_POLL_S * 1000):
            return None
        try:
            data = os.read(self._fd, _CHUNK_BYTES)
        except (BlockingIOError, InterruptedError):
            return None
        if not data and self._waits_for_writer:
            time.sleep(_POLL_S)  # poll() returns at once as long as no writer was there
            return None
        self._waits_for_writer = False
        return data

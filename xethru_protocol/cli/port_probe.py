"""What `doctor` finds out about one port, each fact when it is first asked for.

Two programs that read one port each get a part of the bytes, and opening a port flushes what
waits in it. So programs that have it open are looked for first, and a port in use is not opened.
"""

import getpass
import grp
import math
import os
import shlex
import stat
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from pathlib import Path
from typing import Generic, TypeVar

from xethru_protocol.driver.link import ModuleInfo
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.transport import LineTransport, is_network_port, open_line
from xethru_protocol.validation import shown
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import POWER_UP_BAUD, X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.errors import DeviceError, Disconnected, PortUnavailable, XeThruError
from xethru_protocol.wire.framing import NEED_DATA, FramingFault
from xethru_protocol.wire.table import Command, Message, Response

SubjectT = TypeVar("SubjectT")


class Level(StrEnum):
    """How bad a finding is."""

    OK = "ok"
    NOTE = "note"  # as it should be for some users, not for others
    FAULT = "fault"


@dataclass(eq=False)
class Check(Generic[SubjectT]):
    """Enters a function into a table: it returns what is wrong, None if nothing is.

    A check that ``ends`` is the last one if it finds something: later ones would have nothing to
    look at, or would disturb another program.
    """

    table: "list[Check[SubjectT]]"
    name: str  # what is in order if nothing is found
    looks_at: str  # where the evidence comes from
    remedy: str  # ``{...}`` names an attribute of the subject, which is quoted for a shell
    level: Level = Level.FAULT  # NOTE for what is a fault only to some users
    ends: bool = False
    network: bool | None = None  # only of network ports, or (False) only of this machine's own
    find: Callable[[SubjectT], str | None] = field(init=False)

    def __call__(self, find: Callable[[SubjectT], str | None]) -> Callable[[SubjectT], str | None]:
        self.find = find
        self.table.append(self)
        return find


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Result of a check; ``found`` and ``remedy`` are empty if all is well."""

    check: str
    level: Level = Level.OK
    looks_at: str
    found: str = ""
    remedy: str = ""


def run_checks(subject: SubjectT, checks: Sequence[Check[SubjectT]]) -> Iterator[Finding]:
    """Run checks in order, until one with ``ends`` finds something."""
    for row in checks:
        finding = Finding(check=row.name, looks_at=row.looks_at)
        try:
            found = row.find(subject)
        except (XeThruError, OSError) as error:  # a module that answered, a port that was there
            yield replace(
                finding,
                level=Level.FAULT,
                found=f"this could not be found out: {getattr(error, 'strerror', None) or error}",
                remedy="try again; if this stays, take the module's power away for some seconds",
            )
            return
        if found is None:
            yield finding
            continue
        remedy = row.remedy.format_map(_Attributes(subject))
        yield replace(finding, level=row.level, found=found, remedy=remedy)
        if row.ends:
            return


class _Attributes(dict[str, object]):
    """The attributes of an object, quoted for a shell; each is asked for only when named."""

    def __init__(self, named: object) -> None:
        super().__init__()
        self._named = named

    def __missing__(self, name: str) -> object:
        value = getattr(self._named, name)
        return shlex.quote(str(value)) if isinstance(value, str | Path) else value


_LONGEST_NAME = 60
_FIRST_PTS_MAJOR, _LAST_PTS_MAJOR = 136, 143
_MINORS_PER_PTS_MAJOR = 256


def port_users(path: str) -> tuple[str, ...]:
    """Name and process id of programs that have a port open, as far as this user may know.

    The program that serves a pseudo-terminal is not listed. Only root sees other users' programs.
    """
    try:
        device = os.stat(path)
    except OSError:
        return ()
    if not stat.S_ISCHR(device.st_mode):
        return ()
    return tuple(
        f"{shown(_name(pid))} (pid {pid})"
        for pid in sorted(int(process.name) for process in Path("/proc").glob("[0-9]*"))
        if _has_open(pid, device) and not _serves(pid, device)
    )


def _has_open(pid: int, device: os.stat_result) -> bool:
    for descriptor, target in _descriptors(pid):
        if not target.startswith("/dev/"):
            continue
        try:
            opened = os.stat(descriptor)
        except OSError:  # closed meanwhile
            continue
        if opened.st_rdev == device.st_rdev and (
            # the same number is another terminal in another container
            _pts_index(device) is None or opened.st_dev == device.st_dev
        ):
            return True
    return False


def _serves(pid: int, device: os.stat_result) -> bool:
    """Whether a process has the other end of a pseudo-terminal."""
    index = _pts_index(device)
    if index is None:
        return False
    for descriptor, target in _descriptors(pid):
        if target.endswith("ptmx"):
            facts = _read(descriptor.replace("/fd/", "/fdinfo/"))
            if f"tty-index:\t{index}" in facts.splitlines():
                return True
    return False


def _pts_index(device: os.stat_result) -> int | None:
    major = os.major(device.st_rdev)
    if not _FIRST_PTS_MAJOR <= major <= _LAST_PTS_MAJOR:
        return None
    return (major - _FIRST_PTS_MAJOR) * _MINORS_PER_PTS_MAJOR + os.minor(device.st_rdev)


def _descriptors(pid: int) -> Iterator[tuple[str, str]]:
    """Path below /proc of each open descriptor, and what it is."""
    try:
        names = os.listdir(f"/proc/{pid}/fd")
    except OSError:  # another user's, or gone
        return
    for name in names:
        path = f"/proc/{pid}/fd/{name}"
        try:
            yield path, os.readlink(path)
        except OSError:
            continue


def _name(pid: int) -> str:
    """Command line of a process, without the interpreter and its folders."""
    words = [word for word in _read(f"/proc/{pid}/cmdline").split("\0") if word]
    if not words:
        return _read(f"/proc/{pid}/comm").strip() or "unknown"
    if len(words) > 1 and Path(words[0]).name.startswith("python"):
        del words[: 2 if words[1] == "-m" and len(words) > 2 else 1]
    words[0] = Path(words[0]).name
    text = " ".join(words)
    return text if len(text) <= _LONGEST_NAME else text[: _LONGEST_NAME - 3] + "..."


def _read(path: str) -> str:
    try:
        return Path(path).read_text(errors="replace")
    except OSError:
        return ""


_ANSWER_LIMIT_S = 1.0
_LONGEST_FRAME_BYTES = 6163  # Protocol reference 10
_REPLY_LIMIT_S = 0.25  # enough for the 18 bytes of PING and PONG at 9600 baud


@dataclass(frozen=True, slots=True, kw_only=True)
class Contact:
    """What came back over an opened port."""

    pong: int | None = None  # answer to PING
    baudrate: int = POWER_UP_BAUD  # at which that came
    talks: bool = False  # other messages came
    damaged: bool = False  # bytes came that are not packets
    bootloader: bool = False  # a bootloader answered
    gone: bool = False  # the port went away meanwhile


class PortProbe:
    """Facts about one port: above `refusal`, which opens it, those that leave it closed."""

    def __init__(self, path: str) -> None:
        self.path = path
        self.is_network = is_network_port(path)
        self._transport: LineTransport | None = None

    def close(self) -> None:
        if self._transport is not None:
            self._transport.close()

    @property
    def target(self) -> str:
        """The device behind a link, or the path itself."""
        return os.path.realpath(self.path)

    @property
    def is_serial_port(self) -> bool:
        """Whether it is a device, and of a serial driver where the system lists them (Linux)."""
        status = os.stat(self.path)
        if not stat.S_ISCHR(status.st_mode):
            return False
        drivers = _serial_drivers()
        return not drivers or any(
            os.major(status.st_rdev) == major and os.minor(status.st_rdev) in minors
            for major, minors in drivers
        )

    @property
    def group(self) -> str:
        number = os.stat(self.path).st_gid
        try:
            return grp.getgrgid(number).gr_name
        except KeyError:
            return str(number)

    @property
    def user(self) -> str:
        try:
            return getpass.getuser()
        except (KeyError, OSError):
            return str(os.getuid())

    @cached_property
    def users(self) -> tuple[str, ...]:
        return port_users(self.path)

    @cached_property
    def refusal(self) -> str | None:
        """Open the port; if that fails, return the reason."""
        try:
            self._transport = open_line(self.path)
        except PortUnavailable as error:
            return str(error)
        return None

    @cached_property
    def contact(self) -> Contact:
        """Send PING, at other rates too, and a command of the bootloader."""
        assert self._transport is not None
        bytes_per_s = self._transport.bytes_per_s
        first = self._ask(m.Ping(), _ANSWER_LIMIT_S)
        if first.damaged and not first.talks and math.isfinite(bytes_per_s):
            # the rest of a frame, perhaps: hear a whole one
            first = self._ask(m.Ping(), _ANSWER_LIMIT_S + 2 * _LONGEST_FRAME_BYTES / bytes_per_s)
        if first.pong is not None or first.gone:
            return first
        second = self._ask(m.BootloaderGetDeviceInfo(), _REPLY_LIMIT_S)
        if second.bootloader:
            return second
        if math.isfinite(bytes_per_s) and not first.talks:  # a UART, perhaps of another rate
            try:
                baudrate = self.module.find_baud_rate()
            except Disconnected:
                return replace(first, gone=True)
            if baudrate is not None:
                return self._ask(m.Ping(), _REPLY_LIMIT_S, baudrate)
        return first

    @cached_property
    def module(self) -> X4M300:
        assert self._transport is not None, "the checks open the port first"
        return X4M300(self._transport)

    @cached_property
    def info(self) -> ModuleInfo:
        return self.module.info()

    @property
    def is_bare_xep(self) -> bool:
        """Whether the firmware has no profile layer."""
        return self.info.order_code is None or self.info.firmware_id == "XEP"

    @cached_property
    def profile_id(self) -> int | None:
        """Loaded profile, 0 for none; None where the module refuses."""
        return self._value(m.GetProfileId())

    @cached_property
    def tx_power(self) -> int | None:
        """Transmitter power, 0 for off; None where the module refuses."""
        return self._value(m.X4DriverGet(setting=X4Setting.TXPOWER))

    def _value(self, command: Command[m.ReplyByte | m.ReplyInt | m.ReplyFloat]) -> int | None:
        try:
            values = self.module.request(command).values
        except DeviceError:
            return None
        return int(values[0]) if values else None

    def _ask(
        self, command: Command[Response], timeout_s: float, baudrate: int = POWER_UP_BAUD
    ) -> Contact:
        """Send a command; return what came until its answer, or until the time was over."""
        assert self._transport is not None
        connection = Connection(Role.HOST)
        talks = damaged = False
        try:
            self._transport.write(connection.send(command))
            deadline_s = time.monotonic() + timeout_s
            while (left_s := deadline_s - time.monotonic()) > 0:
                connection.receive_data(self._transport.read(left_s))
                while (event := connection.next_event()) is not NEED_DATA:
                    if isinstance(event, m.Pong):
                        return Contact(pong=event.value, baudrate=baudrate)
                    if isinstance(event, m.BootloaderSuccess):
                        return Contact(bootloader=True)
                    damaged |= isinstance(event, FramingFault)
                    talks |= isinstance(event, Message)
        except Disconnected:
            return Contact(gone=True)
        return Contact(talks=talks, damaged=damaged)


def _serial_drivers() -> list[tuple[int, range]]:
    """Major and minor numbers of serial ports and pseudo-terminals; empty where unknown."""
    try:
        lines = Path("/proc/tty/drivers").read_text().splitlines()
    except OSError:
        return []
    found = []
    for line in lines:
        words = line.split()  # driver, path, major, minors, kind
        if len(words) >= 5 and words[4].partition(":")[0] in ("serial", "pty"):
            first, _, last = words[3].partition("-")
            found.append((int(words[2]), range(int(first), int(last or first) + 1)))
    return found

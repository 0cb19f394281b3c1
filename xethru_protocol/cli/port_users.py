"""Which programs have a port open, told by ``/proc`` without touching the port (Linux only).

Two programs that read one port each get a part of the bytes, and the mere opening of a port
flushes what waits in it: so this is asked first.
"""

import os
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

_LONGEST_NAME = 60
_FIRST_PTS_MAJOR, _LAST_PTS_MAJOR = 136, 143
_MINORS_PER_PTS_MAJOR = 256


@dataclass(frozen=True, slots=True, kw_only=True)
class PortUser:
    """A program that has a port open."""

    pid: int
    name: str

    def __str__(self) -> str:
        """Name and process id, for messages."""
        return f"{self.name!r} (pid {self.pid})"


def port_users(path: str) -> tuple[PortUser, ...]:
    """Programs that have a port open, as far as this user may know; by process id.

    Whoever serves the port of a pseudo-terminal is none of them. Other users' programs are
    seen by root only.
    """
    try:
        device = os.stat(path)
    except OSError:
        return ()
    if not stat.S_ISCHR(device.st_mode):
        return ()
    return tuple(
        PortUser(pid=pid, name=_name(pid))
        for pid in _process_ids()
        if _has_open(pid, device) and not _serves(pid, device)
    )


def _process_ids() -> list[int]:
    try:
        return sorted(int(name) for name in os.listdir("/proc") if name.isdecimal())
    except OSError:  # no /proc on this system
        return []


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

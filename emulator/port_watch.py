"""Who opens and closes a pseudo-terminal, told by inotify (Linux only).

The emulator keeps every terminal's slave side open, which hides a host's hang-up from the master
side; the kernel's file events bring it back. Where inotify is missing, no event ever comes.
"""

from __future__ import annotations

import ctypes
import os
import selectors
import struct
from collections.abc import Callable

from emulator.server import Service

__all__ = ["PortWatch"]

_IN_CLOSE_WRITE = 0x08
_IN_CLOSE_NOWRITE = 0x10
_IN_OPEN = 0x20
_IN_NONBLOCK = os.O_NONBLOCK
_EVENT = struct.Struct("iIII")  # watch, mask, cookie, length of a name (none for a device)


class PortWatch(Service):
    """Calls back when the first host opens a terminal and when the last one closes it.

    Identical events that follow each other at once are merged by the kernel, so the count of two
    hosts on one port may be off by one; it never falls below zero.

    Parameters
    ----------
    terminal
        Path of the slave side.
    opened, closed
        Called with the loop's time, ns.
    """

    def __init__(
        self, terminal: str, *, opened: Callable[[int], None], closed: Callable[[int], None]
    ) -> None:
        self._opened = opened
        self._closed = closed
        self._hosts = 0
        self._watch = -1
        self._fd = _inotify()
        if self.works and not self.follow(terminal):
            self.close()

    @property
    def works(self) -> bool:
        """Whether this system tells who opens a port."""
        return self._fd >= 0

    @property
    def in_use(self) -> bool:
        """Whether a host has the terminal open, as far as this system tells."""
        return self._hosts > 0

    def follow(self, terminal: str) -> bool:
        """Watch another terminal, which nobody has open yet; return whether that is possible."""
        self._hosts = 0
        mask = _IN_OPEN | _IN_CLOSE_WRITE | _IN_CLOSE_NOWRITE
        if self.works:  # the watch of a terminal that is gone went with it
            path = os.fsencode(terminal)
            self._watch = int(ctypes.CDLL(None).inotify_add_watch(self._fd, path, mask))
        return self._watch >= 0

    def register(self, selector: selectors.BaseSelector) -> None:
        """Register with the loop."""
        if self.works:
            selector.register(self._fd, selectors.EVENT_READ, self._read)

    def close(self) -> None:
        """Stop watching."""
        if self.works:
            os.close(self._fd)
            self._fd = -1

    def _read(self, events: int, now_ns: int) -> None:
        del events
        try:
            data = os.read(self._fd, 64 * _EVENT.size)
        except BlockingIOError:
            return
        for watch, mask, _, _ in _EVENT.iter_unpack(data):
            if watch == self._watch:  # else of a terminal that is gone
                self._count(mask, now_ns)

    def _count(self, mask: int, now_ns: int) -> None:
        if mask & _IN_OPEN:
            self._hosts += 1
            if self._hosts == 1:
                self._opened(now_ns)
        elif mask & (_IN_CLOSE_WRITE | _IN_CLOSE_NOWRITE) and self._hosts:
            self._hosts -= 1
            if not self._hosts:
                self._closed(now_ns)


def _inotify() -> int:
    """Return a descriptor that tells of file events; -1 where there is no such thing."""
    try:
        start = ctypes.CDLL(None, use_errno=True).inotify_init1
    except AttributeError:
        return -1  # not Linux
    return int(start(_IN_NONBLOCK | os.O_CLOEXEC))

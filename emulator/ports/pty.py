"""Pseudo-terminals under stable names, and who opens them.

The emulator keeps every terminal's slave side open, which hides a host's hang-up from the master
side; the kernel's file events bring it back. Where inotify is missing, no event ever comes.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import selectors
import struct
import termios
import tty
from collections.abc import Callable
from pathlib import Path

from emulator.ports.event_loop import Service

_IN_CLOSE_WRITE = 0x08
_IN_CLOSE_NOWRITE = 0x10
_IN_OPEN = 0x20
_EVENT = struct.Struct("iIII")  # watch, mask, cookie, length of a name (none for a device)


LARGEST_READ = 1024  # at once: garbage takes time to look through, and other ports wait
# Linux: the speed as a number, which tcgetattr() does not give for rates without a constant
_TCGETS2, _TERMIOS2 = 0x802C542A, struct.Struct("=4IB19B2I")
_SPEEDS = {
    getattr(termios, name): int(name[1:])
    for name in dir(termios)
    if name[0] == "B" and name[1:].isdigit()
}


class LinkError(Exception):
    """A port that could not be published; the message names it and the remedy."""


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
        self,
        terminal: str,
        *,
        opened: Callable[[int], None] = lambda now_ns: None,
        closed: Callable[[int], None] = lambda now_ns: None,
    ) -> None:
        self._opened = opened
        self._closed = closed
        self._hosts = 0
        self._watch = -1
        try:
            start = ctypes.CDLL(None, use_errno=True).inotify_init1
            self._fd = int(start(os.O_NONBLOCK | os.O_CLOEXEC))
        except AttributeError:
            self._fd = -1  # not Linux
        if self.works and not self.follow(terminal):
            self.close()

    @property
    def works(self) -> bool:
        """Whether this system reports who opens a port."""
        return self._fd >= 0

    @property
    def in_use(self) -> bool:
        """Whether a host has the terminal open, as far as this system reports it."""
        return self._hosts > 0

    def follow(self, terminal: str) -> bool:
        """Watch another terminal, which no host has open yet; return whether that is possible."""
        self._hosts = 0
        mask = _IN_OPEN | _IN_CLOSE_WRITE | _IN_CLOSE_NOWRITE
        if self.works:  # the watch of a terminal that is gone went with it
            path = os.fsencode(terminal)
            self._watch = int(ctypes.CDLL(None).inotify_add_watch(self._fd, path, mask))
        return self._watch >= 0

    def end(self, now_ns: int) -> None:
        """Note that the terminal is gone: whoever had it open has lost it."""
        self._watch = -1
        if self._hosts:
            self._hosts = 0
            self._closed(now_ns)

    def register(self, selector: selectors.BaseSelector) -> None:
        if self.works:
            selector.register(self._fd, selectors.EVENT_READ, self._read)

    def close(self) -> None:
        if self.works:
            os.close(self._fd)
            self._fd = -1

    def _read(self, events: int, now_ns: int) -> None:
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


class PtyLink:
    """One pseudo-terminal, published as a symbolic link until closed or taken away.

    The slave side is raw from the start, because a client that does not set the line up itself
    would get its bytes echoed and translated; a slave descriptor kept open preserves that, and
    spares the master the error state of a terminal that no host has open.

    Parameters
    ----------
    path
        Where the link appears. A link left behind by a killed emulator is replaced.
    flushed
        Called when the host discards its unsent output, where the system reports that.

    Raises
    ------
    LinkError
        When no terminal can be had, or a file that is not a link has the path.
    """

    def __init__(self, path: Path, *, flushed: Callable[[], None] | None = None) -> None:
        self.path = path
        self._flushed = flushed
        self._in_packets = False
        self._open()

    def _open(self) -> None:
        try:
            self._master_fd, self._slave_fd = os.openpty()
        except OSError as error:
            raise LinkError(
                f"{self.path}: no pseudo-terminal to be had: {error.strerror}"
            ) from error
        try:
            tty.setraw(self._slave_fd)
            os.set_blocking(self._master_fd, False)
            self.terminal = os.ttyname(self._slave_fd)
            self._in_packets = self._flushed is not None and self._ask_for_packets()
            self._publish()
        except BaseException:
            self._close_descriptors()
            raise

    def reopen(self, path: Path) -> None:
        """Appear with a fresh terminal after `close`, as a device that was plugged in again.

        Raises
        ------
        LinkError
            As when it was made.
        """
        self.path = path
        self._open()

    def fileno(self) -> int:
        return self._master_fd

    def read(self) -> bytes:
        """Return what the host wrote; ``b""`` when there is nothing."""
        if self._master_fd < 0:
            return b""
        try:
            data = os.read(self._master_fd, LARGEST_READ)
        except BlockingIOError:
            return b""
        if not self._in_packets:
            return data
        if data[0] & termios.TIOCPKT_FLUSHWRITE and self._flushed is not None:
            self._flushed()
        return data[1:]  # nothing is left of a packet that only reports a state

    def write(self, data: memoryview) -> int:
        try:
            return os.write(self._master_fd, data)
        except BlockingIOError:
            return 0

    def host_baud(self) -> int | None:
        """Return the speed the host set its side to, bit/s; None where it is not reported."""
        if self._master_fd < 0:
            return None
        with contextlib.suppress(OSError):  # not Linux
            answer = fcntl.ioctl(self._master_fd, _TCGETS2, bytes(_TERMIOS2.size))
            return int(_TERMIOS2.unpack(answer)[-1])
        try:
            return _SPEEDS.get(termios.tcgetattr(self._master_fd)[5])
        except termios.error:
            return None

    def admit(self) -> None:
        """Let hosts open the terminal again after one of them was killed.

        A host may have asked for exclusive use (``TIOCEXCL``), which a terminal keeps until all
        its descriptors are closed, also ours.
        """
        if self._slave_fd >= 0:
            with contextlib.suppress(OSError):
                fcntl.ioctl(self._slave_fd, termios.TIOCNXCL)

    def close(self) -> None:
        """Remove the link, if it is still ours, and give the terminal back.

        A host that has the terminal open sees it hang up: EIO, end of file.
        """
        if self._master_fd < 0:
            return
        try:
            if os.readlink(self.path) == self.terminal:
                self.path.unlink()
        except OSError:
            pass  # removed or replaced by others: not ours to remove
        self._close_descriptors()

    def _ask_for_packets(self) -> bool:
        try:
            fcntl.ioctl(self._master_fd, termios.TIOCPKT, struct.pack("i", 1))
        except (AttributeError, OSError):  # not everywhere
            return False
        return True

    def _publish(self) -> None:
        if os.path.lexists(self.path) and not self.path.is_symlink():
            raise LinkError(f"{self.path}: exists and is not a link; remove it or use --link-dir")
        fresh = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        try:
            fresh.unlink(missing_ok=True)
            fresh.symlink_to(self.terminal)
            fresh.replace(self.path)  # atomic: a host sees the old terminal or the new one
        except OSError as error:
            fresh.unlink(missing_ok=True)
            raise LinkError(f"{self.path}: cannot publish the port: {error.strerror}") from error

    def _close_descriptors(self) -> None:
        os.close(self._master_fd)
        os.close(self._slave_fd)
        self._master_fd = self._slave_fd = -1

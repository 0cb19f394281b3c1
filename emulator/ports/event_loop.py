"""One event loop for many emulated modules: every port is served, none can hold up the others.

All descriptors are non-blocking. A port whose line is full keeps the rest of one packet and waits
for room; its device keeps its own queue. Each turn of the loop gives every port a bounded share.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Protocol

from emulator.chip.chip import NS_PER_S
from emulator.ports.uart import UartLine
from emulator.x4m300 import ByteDevice

PACKETS_PER_TURN = 8
LONGEST_WAIT_S = 86400.0
"""The system waits no longer than 24 days; a playback at a small rate may ask for years."""


def wait_for(
    selector: selectors.BaseSelector,
    descriptor: int,
    events: int,
    ready: Callable[[int, int], None] | None = None,
) -> None:
    """Wait for these events and no others, 0: for none; one system call if that is a change.

    ``ready`` is called with ``(events, now_ns)``.
    """
    key = selector.get_map().get(descriptor)
    if key is None and events:
        selector.register(descriptor, events, ready)
    elif key is not None and not events:
        selector.unregister(descriptor)
    elif key is not None and key.events != events:
        selector.modify(descriptor, events, ready)


class ByteLink(Protocol):
    """What the server needs of a line: see `emulator.ports.pty.PtyLink`."""

    def fileno(self) -> int:
        """Return the descriptor to wait on; -1 while the line is unplugged.

        It may change between turns. It is taken out of the selector before it is closed.
        """
        ...

    def read(self) -> bytes: ...

    def write(self, data: memoryview) -> int:
        """Write what fits, without blocking; return how much."""
        ...


class Service(ABC):
    """Anything else the loop serves beside the ports, with descriptors and deadlines of its own."""

    @abstractmethod
    def register(self, selector: selectors.BaseSelector) -> None:
        """Register descriptors; ``data`` is called with ``(events, now_ns)`` when one is ready."""

    def advance(self, now_ns: int) -> None:  # noqa: B027 - some wait for descriptors only
        """Let time pass."""

    def wake_ns(self, now_ns: int) -> int | None:
        """Return when `advance` should be called next; None if only descriptors matter."""
        return None


class Port:
    """A device on its line, and the packet that is half sent.

    Attributes
    ----------
    wakes_ns
        When it is to be served next, None: when its line is ready; as of its last turn.
    """

    def __init__(self, link: ByteLink, device: ByteDevice, line: UartLine | None = None) -> None:
        self.link = link
        self.device = device
        self._line = line
        self._unsent = memoryview(b"")
        self._blocked = False
        self.wakes_ns: int | None = 0
        self._served_fd: int | None = None  # not yet

    @property
    def moved(self) -> bool:
        """Whether its line came or went since its last turn began."""
        return self.link.fileno() != self._served_fd

    def is_due(self, now_ns: int) -> bool:
        return self.wakes_ns is not None and self.wakes_ns <= now_ns

    def serve(self, selector: selectors.BaseSelector, now_ns: int) -> None:
        """Give the device and its line their share of a turn."""
        self._served_fd = self.link.fileno()
        self.advance(now_ns)
        busy = False
        if self.link.fileno() < 0:
            self.cut()
        else:
            busy = self.send(now_ns)
            if self.link.fileno() >= 0:  # else the host left while we wrote
                wait_for(selector, self.link.fileno(), self.events, self.ready)
        self.wakes_ns = now_ns if busy or self.moved else self.wake_ns(now_ns)

    @property
    def events(self) -> int:
        takes_bytes = self._line is None or self._line.takes_bytes
        reading = selectors.EVENT_READ if self.device.wants_data and takes_bytes else 0
        return reading | (selectors.EVENT_WRITE if self._blocked else 0)

    def receive(self, now_ns: int) -> None:
        data = self.link.read()
        if data and self._line is not None:
            self.device.advance(now_ns)  # its rate may have changed since
            self._line.from_host(data, now_ns)
        elif data:
            self.device.receive_data(data, now_ns)
        elif self.link.fileno() < 0:
            self.cut()

    def advance(self, now_ns: int) -> None:
        self.device.advance(now_ns)
        while self._line is not None and self.device.wants_data:
            data = self._line.to_module.take(now_ns)
            if not data:
                return
            self.device.receive_data(data, now_ns)

    def wake_ns(self, now_ns: int) -> int | None:
        if self._line is None:
            return self.device.wake_ns(now_ns)
        candidates = [self.device.wake_ns(now_ns)]
        if not self._blocked:
            candidates.append(self._line.to_host.next_ns())
        if self.device.wants_data:
            candidates.append(self._line.to_module.next_ns())
        return min((time_ns for time_ns in candidates if time_ns is not None), default=None)

    def ready(self, events: int, now_ns: int) -> None:
        if events & selectors.EVENT_WRITE:
            self._blocked = False
            self.wakes_ns = now_ns
        if events & selectors.EVENT_READ:
            self.receive(now_ns)

    def cut(self) -> None:
        """Forget what was half sent: the line is unplugged, and the next host begins afresh."""
        self._unsent = memoryview(b"")
        self._blocked = False
        if self._line is not None:
            self._line.clear()

    def send(self, now_ns: int) -> bool:
        """Send a share of what waits; return whether there may be more to send right away."""
        if self._blocked:
            return False
        for _ in range(PACKETS_PER_TURN):
            if not self._unsent:
                packet = self._next_piece(now_ns)
                if not packet:
                    return False
                self._unsent = memoryview(packet)
            self._unsent = self._unsent[self.link.write(self._unsent) :]
            if self._unsent and self._line is not None:
                self._unsent = memoryview(b"")  # or an old backlog would meet the next host
            elif self._unsent:
                self._blocked = True
                return False
        return True

    def _next_piece(self, now_ns: int) -> bytes | None:
        """Return a packet, or what of one has passed the line by now."""
        if self._line is None:
            return self.device.next_packet(now_ns)
        data = self._line.to_host.take(now_ns)
        if data:
            return data
        while self._line.takes_packet:
            packet = self.device.next_packet(now_ns)
            if packet is None:
                break
            self._line.from_module(packet, now_ns)
        return self._line.to_host.take(now_ns)


class Server:
    """The loop.

    Parameters
    ----------
    clock_ns
        Monotonic time in ns, the devices' time.
    """

    def __init__(
        self,
        ports: Sequence[Port],
        services: Sequence[Service] = (),
        *,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._ports = ports
        self._services = services
        self._clock_ns = clock_ns
        self._stopped = False
        self._selector = selectors.DefaultSelector()
        self._wake_fd, self._waker_fd = os.pipe()
        os.set_blocking(self._wake_fd, False)
        os.set_blocking(self._waker_fd, False)
        self._selector.register(self._wake_fd, selectors.EVENT_READ, self._woken)
        for service in services:
            service.register(self._selector)

    def run(self) -> None:
        while not self._stopped:
            self.turn()

    def stop(self) -> None:
        """End `run` soon; may be called from a signal handler or another thread."""
        self._stopped = True
        with contextlib.suppress(BlockingIOError):  # a pipe full of earlier calls wakes it too
            os.write(self._waker_fd, b"x")

    def close(self) -> None:
        """Give the loop's own descriptors back; ports and services belong to the caller."""
        self._selector.close()
        os.close(self._wake_fd)
        os.close(self._waker_fd)

    def turn(self, longest_wait_s: float | None = None) -> None:
        """Serve once: wait for an event or a deadline, then give the ports their share.

        Every port has one after something was read or a line came or went, which may concern any of
        them (by a control socket, say, or two lines of one module); else those whose line takes
        more, or whose deadline has come.
        """
        everyone = False
        for key, events in self._selector.select(self._wait_s(longest_wait_s)):
            everyone |= bool(events & selectors.EVENT_READ)
            key.data(events, self._clock_ns())
        for service in self._services:
            service.advance(self._clock_ns())
        everyone = everyone or any(port.moved for port in self._ports)
        for port in self._ports:
            now_ns = self._clock_ns()
            if everyone or port.is_due(now_ns):
                port.serve(self._selector, now_ns)

    def _wait_s(self, longest_wait_s: float | None) -> float:
        now_ns = self._clock_ns()
        wakes = [port.wakes_ns for port in self._ports]
        wakes += [service.wake_ns(now_ns) for service in self._services]
        waits_s = [max(wake_ns - now_ns, 0) / NS_PER_S for wake_ns in wakes if wake_ns is not None]
        if longest_wait_s is not None:
            waits_s.append(longest_wait_s)
        return min([*waits_s, LONGEST_WAIT_S])

    def _woken(self, events: int, now_ns: int) -> None:
        with contextlib.suppress(BlockingIOError):  # woken twice for one byte
            os.read(self._wake_fd, 4096)

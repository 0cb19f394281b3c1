"""A host's transport that ends in an emulated device of the same process: no port, no waiting.

Time is virtual: it stands still while messages flow and jumps to the device's next deadline
when a host waits for one, so a reset of 2.5 s takes none. Only a device that sends as fast as its
host reads takes the time of a line. Give the driver the transport's own clock,
``X4M300(transport, clock=transport.clock_ns)``, and its time limits are virtual too.
"""

from __future__ import annotations

from emulator.chip.chip import NS_PER_S
from emulator.x4m300 import Device, PortDevice
from xethru_protocol.wire.errors import Disconnected

# More packets than a module's queue holds are made while the host reads them. Without time for them
# no limit of time would ever pass for that host.
_AT_ONCE = 64
_NS_PER_BYTE = 25  # USB 2.0 high speed, about 40 MB/s


class VirtualLine:
    """A device and the virtual time that it shares with its hosts."""

    def __init__(self, device: PortDevice) -> None:
        self.device = device
        self._now_ns = 0
        self._at_once = 0  # packets since the device last had none

    @property
    def present(self) -> bool:
        return self.device.port_present(self._now_ns)

    def clock_ns(self) -> int:
        """Return the virtual time, ns since the line was made."""
        return self._now_ns

    def read(self, timeout_s: float) -> bytes:
        """Return the next packet; ``b""`` once the timeout has passed or the port is gone."""
        deadline_ns = self._deadline_ns(timeout_s)
        while True:
            self.device.advance(self._now_ns)
            packet = self.device.next_packet(self._now_ns) if self.present else None
            if packet is not None:
                self._at_once += 1
                if self._at_once > _AT_ONCE:
                    self._now_ns += len(packet) * _NS_PER_BYTE
                return packet
            self._at_once = 0
            wake_ns = self.device.wake_ns(self._now_ns)
            if not self.present or wake_ns is None or wake_ns > deadline_ns:
                self._now_ns = deadline_ns if self.present else self._now_ns
                return b""
            self._now_ns = max(wake_ns, self._now_ns)

    def sleep(self, seconds: float) -> None:
        """Let time pass while nobody reads."""
        deadline_ns = self._deadline_ns(seconds)
        self.device.advance(self._now_ns)
        while (wake_ns := self.device.wake_ns(self._now_ns)) is not None:
            if not self._now_ns < wake_ns <= deadline_ns:
                break
            self._now_ns = wake_ns
            self.device.advance(self._now_ns)
        self._now_ns = deadline_ns
        self.device.advance(self._now_ns)

    def _deadline_ns(self, seconds: float) -> int:
        return self._now_ns + max(round(seconds * NS_PER_S), 0)


class LoopbackTransport:
    """An `xethru_protocol.transport.Transport` wired straight to a device, alone or with a line.

    Every read returns at most one packet, which the device makes at that moment: nothing is in
    flight between device and host. After `close`, `read` and `write` raise `Disconnected`.
    """

    def __init__(self, to: PortDevice | VirtualLine, name: str = "loopback") -> None:
        self._line = to if isinstance(to, VirtualLine) else VirtualLine(to)
        self._name = name
        self._open = True
        self.clock_ns = self._line.clock_ns
        device = self._line.device
        if isinstance(device, Device):
            device.port_opened(self.clock_ns())

    @property
    def name(self) -> str:
        return self._name

    def read(self, timeout_s: float) -> bytes:
        """Return the next packet, or ``b""`` once the timeout has passed in virtual time."""
        self._check_open()
        data = self._line.read(timeout_s)
        self._check_open()
        return data

    def write(self, data: bytes) -> None:
        self._check_open()
        self._line.device.receive_data(data, self.clock_ns())

    def close(self) -> None:
        device = self._line.device
        if self._open and isinstance(device, Device):
            device.port_closed(self.clock_ns())
        self._open = False

    def _check_open(self) -> None:
        if not self._open or not self._line.present:
            raise Disconnected(f"{self._name}: the port is closed")

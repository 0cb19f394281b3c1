"""A host's transport that ends in an emulated device of the same process: no port, no waiting.

Time is virtual: it stands still while messages flow and jumps to the device's next deadline
when a host waits for one, so a reset of 2.5 s takes none. Only a device that sends as fast as its
host reads takes the time of a line. Give the driver the transport's own clock,
``X4M300(transport, clock=transport.clock_ns)``, and its time limits are virtual too.
"""

from __future__ import annotations

from emulator.device import Device
from xethru_protocol.wire.errors import Disconnected

NS_PER_S = 1_000_000_000
# More packets than a module's queue holds are made while the host reads them. Without time for them
# no limit of time would ever pass for that host.
_AT_ONCE = 64
_NS_PER_BYTE = 25  # USB 2.0 high speed, about 40 MB/s


class LoopbackTransport:
    """An `xethru_protocol.transport.Transport` wired straight to a device.

    Every read returns at most one packet, which the device makes at that moment: nothing is in
    flight between device and host. After `close`, `read` and `write` raise `Disconnected`.
    """

    def __init__(self, device: Device, name: str = "loopback") -> None:
        self._device = device
        self._name = name
        self._now_ns = 0
        self._at_once = 0  # packets since the device last had none
        self._open = True
        device.port_opened(self._now_ns)

    @property
    def name(self) -> str:
        return self._name

    def clock_ns(self) -> int:
        """Return the virtual time, ns since the transport was made."""
        return self._now_ns

    def read(self, timeout_s: float) -> bytes:
        """Return the next packet, or ``b""`` once the timeout has passed in virtual time."""
        self._check_open()
        deadline_ns = self._now_ns + max(round(timeout_s * NS_PER_S), 0)
        while True:
            self._device.advance(self._now_ns)
            packet = self._device.next_packet(self._now_ns)
            if packet is not None:
                self._at_once += 1
                if self._at_once > _AT_ONCE:
                    self._now_ns += len(packet) * _NS_PER_BYTE
                return packet
            self._at_once = 0
            wake_ns = self._device.wake_ns(self._now_ns)
            if wake_ns is None or wake_ns > deadline_ns:
                self._now_ns = deadline_ns
                return b""
            self._now_ns = max(wake_ns, self._now_ns)

    def write(self, data: bytes) -> None:
        self._check_open()
        self._device.receive_data(data, self._now_ns)

    def close(self) -> None:
        if self._open:
            self._open = False
            self._device.port_closed(self._now_ns)

    def _check_open(self) -> None:
        if not self._open:
            raise Disconnected(f"{self._name}: the port is closed")

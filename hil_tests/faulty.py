"""Fixtures for tests with faults: a module in this process, its driver, virtual time.

from hil_tests.faulty import faulty_line  # the fixture

def test_what_my_program_does(faulty_line):
    radar = faulty_line.streaming()
    with fault(faulty_line.device, "missing_frames", frames=2) as injected:
        ...
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import pytest

from emulator.chip import Pace
from emulator.device import radar_device
from emulator.echo.echo import echo_source
from emulator.faults.faulty_device import FaultyDevice, InnerDevice, fault
from emulator.faults.plan import FaultPlan, Injected
from emulator.module.memory import Identity
from emulator.scene.scene import empty_room
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.transport import Transport
from xethru_protocol.wire.errors import Disconnected, PortUnavailable

__all__ = ["PATH", "SERIAL", "FaultyLine", "fault", "faulty_line"]

PATH = "virtual"
SERIAL = "202611210001"
SHORT = RawConfig(frame_area_m=(0.4, 1.0))
NS_PER_S = 1_000_000_000


class _Line:
    """A transport that ends in the device; time passes only while somebody waits."""

    def __init__(self, owner: FaultyLine) -> None:
        self._owner = owner
        self._open = True

    @property
    def name(self) -> str:
        return PATH

    def read(self, timeout_s: float) -> bytes:
        self._check()
        data = self._owner.next_bytes(timeout_s)
        self._check()
        return data

    def write(self, data: bytes) -> None:
        self._check()
        self._owner.device.receive_data(data, self._owner.clock_ns())

    def close(self) -> None:
        self._open = False

    def _check(self) -> None:
        if not self._open or not self._owner.device.port_present(self._owner.clock_ns()):
            raise Disconnected(f"{PATH}: the port is gone")


class FaultyLine:
    """A module with faults at the other end of a line, and a clock that both share.

    Parameters
    ----------
    inner
        The module; a stock one in an empty room if None.

    Attributes
    ----------
    device
        The module with its faults.
    truth
        What was injected, in order.
    """

    def __init__(self, inner: InnerDevice | None = None) -> None:
        self.truth: list[Injected] = []
        self._radars: list[X4M300] = []
        self._now_ns = 0
        if inner is None:
            echoes = echo_source(empty_room(), 0, 0)
            inner = radar_device(Identity(serial=SERIAL), echoes, Pace.REALTIME)
        self.device = FaultyDevice(inner, "radar_1", FaultPlan(), self.truth.append)

    def clock_ns(self) -> int:
        return self._now_ns

    def sleep(self, seconds: float) -> None:
        self.next_bytes_until(self._now_ns + round(seconds * NS_PER_S), send=False)

    def next_bytes(self, timeout_s: float) -> bytes:
        """Return what the module sends next; ``b""`` once the time is over or the port gone."""
        return self.next_bytes_until(self._now_ns + max(round(timeout_s * NS_PER_S), 0))

    def next_bytes_until(self, deadline_ns: int, *, send: bool = True) -> bytes:
        """Do the same until a time; without ``send`` the module is left to itself."""
        while True:
            self.device.advance(self._now_ns)
            if send:
                if not self.device.port_present(self._now_ns):
                    return b""
                packet = self.device.next_packet(self._now_ns)
                if packet is not None:
                    return packet
            wake_ns = self.device.wake_ns(self._now_ns)
            if wake_ns is None or wake_ns > deadline_ns or (not send and wake_ns <= self._now_ns):
                self._now_ns = max(deadline_ns, self._now_ns)
                self.device.advance(self._now_ns)
                return b""
            self._now_ns = max(wake_ns, self._now_ns)

    def open(self, path: str, baudrate: int) -> Transport:
        del baudrate
        if not self.device.port_present(self._now_ns):
            raise PortUnavailable(f"{path}: no such port")
        return _Line(self)

    def ports(self) -> Sequence[str]:
        return [PATH] if self.device.port_present(self._now_ns) else []

    def radar(self, reconnect_s: float = 0.0) -> X4M300:
        radar = X4M300(
            self.open(PATH, 115200),
            clock=self.clock_ns,
            reconnect_s=reconnect_s,
            open_port=self.open,
            candidates=self.ports,
            sleep=self.sleep,
        )
        self._radars.append(radar)
        return radar

    def forget(self) -> None:
        """Let the drivers go as if they were closed, whatever became of the module."""
        for radar in self._radars:
            radar._link.closed = True

    def streaming(self, fps: float = 20.0, reconnect_s: float = 0.0) -> X4M300:
        """Return a driver whose module sends short frames."""
        radar = self.radar(reconnect_s)
        radar.configure_raw(SHORT)
        radar.start(fps)
        return radar


@pytest.fixture
def faulty_line() -> Iterator[FaultyLine]:
    """Give a stock module in this process, on a line in virtual time."""
    line = FaultyLine()
    yield line
    line.forget()

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
from emulator.echo.echo import echo_source
from emulator.faults.faulty_device import FaultyDevice, fault
from emulator.faults.plan import FaultPlan, Injected
from emulator.loopback import LoopbackTransport, VirtualLine
from emulator.module.memory import Identity
from emulator.scene.scene import empty_room
from emulator.x4m300 import PortDevice, radar_device
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.transport import Transport
from xethru_protocol.wire.errors import PortUnavailable

__all__ = ["PATH", "SERIAL", "FaultyLine", "fault", "faulty_line"]

PATH = "virtual"
SERIAL = "202611210001"
SHORT = RawConfig(frame_area_m=(0.4, 1.0))


class FaultyLine(VirtualLine):
    """A module with faults at the other end of a line, and a clock that both share.

    Parameters
    ----------
    inner
        The module; a stock one in an empty room if None.

    Attributes
    ----------
    truth
        What was injected, in order.
    """

    device: FaultyDevice

    def __init__(self, inner: PortDevice | None = None) -> None:
        self.truth: list[Injected] = []
        self._radars: list[X4M300] = []
        if inner is None:
            echoes = echo_source(empty_room(), 0, 0)
            inner = radar_device(Identity(serial=SERIAL), echoes, Pace.REALTIME)
        super().__init__(FaultyDevice(inner, "radar_1", FaultPlan(), self.truth.append))

    def open(self, path: str, baudrate: int) -> Transport:
        del baudrate
        if not self.present:
            raise PortUnavailable(f"{path}: no such port")
        return LoopbackTransport(self, PATH)

    def ports(self) -> Sequence[str]:
        return [PATH] if self.present else []

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

"""Small stand-ins for the parts around the device: a source of known counters, a bare host."""

import contextlib
import os
import socket
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from emulator.chip import Pace
from emulator.chip.chip import CaptureSettings, Chip
from emulator.module.memory import Identity
from emulator.module.settings import DeviceOptions
from emulator.ports.event_loop import Server
from emulator.x4m300 import Device, radar_device
from hil_tests.patience import seconds
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import SensorMode, X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import NeedData

IDENTITY = Identity(serial="202611210001")


class RampSource:
    """Counters that tell frame, time and sample; remembers what it was asked."""

    def __init__(self) -> None:
        self.captures: list[CaptureSettings] = []
        self.blocks: list[int] = []
        self.scene_times_ns: dict[int, int] = {}

    def rf_counters(
        self,
        capture: CaptureSettings,
        frame_counters: NDArray[np.int64],
        scene_times_ns: NDArray[np.int64],
    ) -> NDArray[np.int64]:
        self.captures.append(capture)
        self.blocks.append(len(frame_counters))
        times = zip(frame_counters.tolist(), scene_times_ns.tolist(), strict=True)
        self.scene_times_ns.update(times)
        samples = np.arange(capture.n_samples, dtype=np.int64)
        return (frame_counters[:, np.newaxis] * 7 + samples) % 1000


class FormulaSource:
    """Counters from a formula over the sample's index counted from range label 0.18 m."""

    def __init__(self, formula: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> None:
        self._formula = formula

    def rf_counters(
        self,
        capture: CaptureSettings,
        frame_counters: NDArray[np.int64],
        scene_times_ns: NDArray[np.int64],
    ) -> NDArray[np.int64]:
        first = round((capture.first_sample_m - 0.18) * 23.328e9 / 1.5e8)
        index = np.arange(first, first + capture.n_samples, dtype=np.float64)
        row = np.rint(self._formula(index)).astype(np.int64)
        return np.tile(row, (len(frame_counters), 1))


def working_point(chip: Chip) -> Chip:
    chip.set(X4Setting.DACMIN, 949)
    chip.set(X4Setting.DACMAX, 1100)
    chip.set(X4Setting.ITERATIONS, 16)
    chip.set(X4Setting.PULSESPERSTEP, 300)
    chip.set(X4Setting.FRAMEAREA, (0.2, 9.4))
    return chip


class BareHost:
    """Speaks to a device directly; collects everything the device says."""

    def __init__(self, device: Device, now_ns: int = 0) -> None:
        self.device = device
        self.now_ns = now_ns
        self._line = Connection(Role.HOST)

    def send(self, command: m.Command[m.Response]) -> None:
        self.device.receive_data(self._line.send(command), self.now_ns)

    def hear(self, most: int = 1000) -> list[m.Message]:
        """Return the messages that are due now, as an owner of the line that has room gets them."""
        heard: list[m.Message] = []
        while len(heard) < most:
            packet = self.device.next_packet(self.now_ns)
            if packet is None:
                wake_ns = self.device.wake_ns(self.now_ns)
                if wake_ns is None or wake_ns > self.now_ns:
                    break
                self.device.advance(self.now_ns)
                continue
            self._line.receive_data(packet)
            event = self._line.next_event()
            assert isinstance(event, m.Message), event
            heard.append(event)
        return heard

    def ask(self, command: m.Command[m.Response]) -> m.Message:
        self.send(command)
        (reply,) = self.hear(1)
        return reply

    def command(self, *commands: m.Command[m.Ack]) -> None:
        for one in commands:
            assert self.ask(one) == m.Ack()

    def set(self, setting: X4Setting, value: m.X4Value) -> None:
        assert self.ask(m.X4DriverSet(setting=setting, value=value)) == m.Ack()

    def enter_manual(self) -> None:
        stop, manual = SensorMode.XTID_SM_STOP, SensorMode.XTID_SM_MANUAL
        self.command(m.SetMode(mode=stop), m.SetMode(mode=manual), m.X4DriverInit())

    def stream(self, fps: float = 17.0) -> None:
        self.enter_manual()
        self.set(X4Setting.FPS, fps)

    def at(self, now_ns: int) -> list[m.Message]:
        self.now_ns = now_ns
        self.device.advance(now_ns)
        return self.hear()

    def frames(self, count: int) -> list[m.DataFloat]:
        heard = self.hear(count)
        assert all(isinstance(message, m.DataFloat) for message in heard)
        return [message for message in heard if isinstance(message, m.DataFloat)]


def ramp_device(
    pace: Pace = Pace.ASAP,
    source: RampSource | None = None,
    options: DeviceOptions | None = None,
) -> Device:
    return radar_device(IDENTITY, source or RampSource(), pace, options=options)


def host_of(options: DeviceOptions) -> BareHost:
    return BareHost(ramp_device(options=options))


class PortHost:
    """A host at the other end of a line, which turns the server as it waits."""

    def __init__(self, fd: int, server: Server) -> None:
        self.fd = fd
        self.server = server
        self.line = Connection(Role.HOST)

    def send(self, command: m.Command[m.Response]) -> None:
        os.write(self.fd, self.line.send(command))

    def hear(self) -> m.Message:
        give_up_s = time.monotonic() + seconds(60)  # only ends a test that has failed
        while time.monotonic() < give_up_s:
            event = self.line.next_event()
            if isinstance(event, m.Message):
                return event
            assert isinstance(event, NeedData), event
            try:
                data = os.read(self.fd, 65536)
                assert data, "hung up"
                self.line.receive_data(data)
            except BlockingIOError:
                self.server.turn(longest_wait_s=0.01)
        raise AssertionError("the device says nothing")

    def ask(self, command: m.Command[m.Response]) -> m.Message:
        self.send(command)
        return self.hear()

    def stream(self, fps: float = 17.0) -> None:
        for command in (
            m.SetMode(mode=SensorMode.XTID_SM_MANUAL),
            m.X4DriverInit(),
            m.X4DriverSet(setting=X4Setting.FPS, value=fps),
        ):
            assert self.ask(command) == m.Ack()

    def close(self) -> None:
        if self.fd >= 0:
            os.close(self.fd)
            self.fd = -1


class PairLine:
    """Both ends of a socket pair that holds a few packets; the module's is a `ByteLink`."""

    def __init__(self) -> None:
        self._end, self._host_end = socket.socketpair()
        for end in (self._end, self._host_end):
            end.setblocking(False)
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 16384)

    def fileno(self) -> int:
        return self._end.fileno()

    def read(self) -> bytes:
        return self._end.recv(4096)

    def write(self, data: memoryview) -> int:
        try:
            return self._end.send(data)
        except BlockingIOError:
            return 0

    def host_fd(self) -> int:
        """Return a descriptor of the host's end, which the caller closes."""
        return os.dup(self._host_end.fileno())

    def host_read(self) -> bytes:
        with contextlib.suppress(BlockingIOError):
            return self._host_end.recv(65536)
        return b""

    def host_write(self, data: bytes) -> int:
        with contextlib.suppress(BlockingIOError):
            return self._host_end.send(data)
        return 0

    def close(self) -> None:
        self._end.close()
        self._host_end.close()

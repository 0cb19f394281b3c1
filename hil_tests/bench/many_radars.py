"""Many radars of one emulator at pace realtime: no frame may be lost.

`python -m hil_tests.bench.many_radars` has one emulator process serve 24 modules at 50 frames/s of
1431 bins for ten minutes through pseudo-terminals, and one process with as many drivers read them.
It prints what arrived, what was lost, and the processor time of both. Where other programs keep the
emulator from its processor for a second, a module loses frames, as the firmware does.

With ``--virtual`` the emulator's event loop, its modules and their hosts share one process and a
clock that goes on by 5 ms a turn, so that only the emulator itself can lose a frame.
"""

from __future__ import annotations

import argparse
import os
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from emulator import running
from emulator.chip import Pace
from emulator.echo.echo import echo_source
from emulator.module.memory import Identity
from emulator.ports.event_loop import Port, Server
from emulator.scene.scene import Scene, empty_room
from emulator.x4m300 import radar_device
from hil_tests.unit.emulator.doubles import PairLine
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import SensorMode, X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import NeedData

FAST = RawConfig(pulses_per_step=92)  # the chip can take 64 frames/s then, and 20 with 300
REPORT_S = 60.0
STEP_NS = 5_000_000
NS_PER_S = 1_000_000_000


class Reader(threading.Thread):
    """Reads one radar until a time.

    Attributes
    ----------
    frames, lost, faults
        As the driver counts them.
    problem
        What ended it before its time; empty: nothing did.
    """

    def __init__(self, path: str, fps: float, seconds: float) -> None:
        super().__init__(daemon=True)
        self._path = path
        self._fps = fps
        self._seconds = seconds
        self.frames = self.lost = self.faults = 0
        self.problem = ""

    def run(self) -> None:
        try:
            with X4M300.open(self._path) as radar:
                radar.configure_raw(FAST)
                radar.start(self._fps)
                end_s = time.monotonic() + self._seconds
                for _ in radar.frames(timeout_s=30.0):
                    self.frames += 1
                    self.lost, self.faults = radar.frames_lost, radar.fault_count
                    if time.monotonic() >= end_s:
                        break
        except Exception as error:
            self.problem = f"{self._path}: {error}"


class VirtualHost:
    """A module on one end of a socket pair, and at the other a host that counts its frames."""

    def __init__(self, scene: Scene, index: int) -> None:
        self.line = PairLine()
        identity = Identity(serial=scene.radars[index].serial)
        device = radar_device(identity, echo_source(scene, index, 0), Pace.REALTIME)
        self.port = Port(self.line, device)
        self._connection = Connection(Role.HOST)
        self._counter = 0
        self.frames = self.lost = self.faults = 0

    def start(self, fps: float) -> None:
        settings = {**dict(FAST.settings()), X4Setting.FPS: fps}
        for command in (
            m.SetMode(mode=SensorMode.XTID_SM_STOP),
            m.SetMode(mode=SensorMode.XTID_SM_MANUAL),
            m.X4DriverInit(),
            *(m.X4DriverSet(setting=one, value=value) for one, value in settings.items()),
        ):
            self.line.host_write(self._connection.send(command))

    def read(self) -> None:
        while data := self.line.host_read():
            self._connection.receive_data(data)
            while not isinstance(event := self._connection.next_event(), NeedData):
                if isinstance(event, m.DataFloat):
                    self.frames += 1
                    self.lost += event.info - self._counter - 1
                    self._counter = event.info
                elif not isinstance(event, m.Ack | m.System | m.PresenceSingle):
                    self.faults += 1


def run_virtual(count: int, fps: float, seconds: float) -> Sequence[VirtualHost]:
    """Run as many modules for so long on a clock of their own; print a line per minute."""
    scene, now_ns = empty_room(count), 0
    hosts = [VirtualHost(scene, index) for index in range(count)]
    server = Server([host.port for host in hosts], clock_ns=lambda: now_ns)
    for host in hosts:
        host.start(fps)
    began_s, reported_ns = time.monotonic(), 0
    while now_ns < seconds * NS_PER_S:
        server.turn(longest_wait_s=0)
        for host in hosts:
            host.read()
        now_ns += STEP_NS
        if now_ns - reported_ns >= REPORT_S * NS_PER_S:
            reported_ns = now_ns
            sys.stdout.write(f"{time.monotonic() - began_s:5.0f} s of this machine: ")
            _report(hosts, now_ns / NS_PER_S, {"processor": time.process_time()})
    return hosts


def cpu_s(pid: int) -> float:
    """Return the processor time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m hil_tests.bench.many_radars")
    parser.add_argument("--count", type=int, default=24)
    parser.add_argument("--fps", type=float, default=50.0)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--virtual", action="store_true", help="on a clock of its own")
    given = parser.parse_args(arguments)
    if given.virtual:
        hosts = run_virtual(given.count, given.fps, given.minutes * 60)
        return int(any(host.lost or host.faults for host in hosts))
    with running("serve", "--bare", "--count", str(given.count)) as (process, ready):
        seconds = given.minutes * 60
        readers = [Reader(device["path"], given.fps, seconds) for device in ready["devices"]]
        began_s = time.monotonic()
        for reader in readers:
            reader.start()
        while any(reader.is_alive() for reader in readers):
            for reader in readers:
                reader.join(REPORT_S / len(readers))
            processors = {"emulator": cpu_s(process.pid), "drivers": time.process_time()}
            _report(readers, time.monotonic() - began_s, processors)
    problems = [reader.problem for reader in readers if reader.problem]
    sys.stdout.writelines(f"{problem}\n" for problem in problems)
    return 1 if problems or any(reader.lost or reader.faults for reader in readers) else 0


def _report(
    readers: Sequence[Reader | VirtualHost], passed_s: float, processors: dict[str, float]
) -> None:
    frames, lost, faults = (
        sum(getattr(reader, name) for reader in readers) for name in ("frames", "lost", "faults")
    )
    shares = ", ".join(f"{name} {used_s / passed_s:.1%}" for name, used_s in processors.items())
    sys.stdout.write(
        f"{passed_s:5.0f} s  {len(readers)} radars  {frames:7} frames  {frames / passed_s:6.1f}/s  "
        f"{lost} lost  {faults} faults  {shares}\n"
    )
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())

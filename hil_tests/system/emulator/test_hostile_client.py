"""Hostile clients in virtual time and at real ports, and corrupted traffic."""

import contextlib
import os
import select
import time
from pathlib import Path

import pytest

from emulator.chip import Pace
from hil_tests.device.emulator_process import Served, emulator
from hil_tests.patience import seconds
from hil_tests.system.emulator import corrupted_traffic
from hil_tests.system.emulator.corrupted_traffic import (
    SWALLOWED_BULK,
    SWALLOWED_MERGED,
    SWALLOWED_NORMAL,
    Outcome,
    run_command,
)
from hil_tests.system.emulator.hostile_client import run
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import PongCode, SensorMode, X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import NeedData


@pytest.mark.parametrize(
    ("seed", "pace"),
    [
        (1, Pace.REALTIME),
        (2, Pace.ASAP),
        pytest.param(1, Pace.ASAP, marks=pytest.mark.thorough),
        pytest.param(2, Pace.REALTIME, marks=pytest.mark.thorough),
    ],
)
def test_a_hostile_client_disturbs_no_other_port(seed: int, pace: Pace) -> None:
    outcome = run(1.0, seed, pace)
    assert outcome.answers
    first, n_frames = outcome.counters[0], len(outcome.counters)
    assert outcome.counters == list(range(first, first + n_frames))
    # at most two frames may still be on their way
    assert outcome.frames_due - 2 <= n_frames <= outcome.frames_due + 1
    # what a full queue and a full flash may differ by
    assert outcome.objects_grown <= 2000
    assert outcome.sent_bytes > 50_000
    assert outcome.faults_seen > 20
    assert min(outcome.actions.values()) > 5


class Watched:
    """A process from outside, and a reader of one of its ports."""

    def __init__(self, served: Served, port: int) -> None:
        self._process = Path(f"/proc/{served.process.pid}")
        self.fd = os.open(served.paths[port], os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self._line = Connection(Role.HOST)
        self.counters: list[int] = []
        for command in (
            m.SetMode(mode=SensorMode.XTID_SM_MANUAL),
            m.X4DriverSet(setting=X4Setting.FPS, value=17.0),
        ):
            os.write(self.fd, self._line.send(command))

    def descriptors(self) -> int:
        return len(list((self._process / "fd").iterdir()))

    def resident_kib(self) -> int:
        pages = int((self._process / "statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") // 1024

    def read(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while data := os.read(self.fd, 65536):
                self._line.receive_data(data)
        while not isinstance(event := self._line.next_event(), NeedData):
            if isinstance(event, m.DataFloat):
                self.counters.append(event.info)

    def read_more(self, frames: int) -> None:
        enough = len(self.counters) + frames
        while len(self.counters) < enough:
            assert select.select([self.fd], [], [], seconds(10))[0], "the module says nothing"
            self.read()


def open_port(path: str) -> int:
    return os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)


def ping_through_whatever(path: str) -> bool:
    line, fd = Connection(Role.HOST), open_port(path)
    end = time.monotonic() + seconds(10)
    try:
        while time.monotonic() < end:
            with contextlib.suppress(BlockingIOError):
                os.write(fd, line.send(m.Ping()))
            select.select([fd], [], [], 0.05)
            with contextlib.suppress(BlockingIOError):
                line.receive_data(os.read(fd, 65536))
            while not isinstance(event := line.next_event(), NeedData):
                if event == m.Pong(value=PongCode.XTS_SPRP_READY):
                    return True
    finally:
        os.close(fd)
    return False


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="tells memory by /proc: Linux only")
def test_hostile_hosts_at_real_ports() -> None:
    """A thousand openings, two hosts at one port, a host that never reads; one port is at peace."""
    with emulator("serve", "--bare", "--count", "4") as served:
        watched = Watched(served, 3)
        opened, shared, deaf = served.paths[:3]
        line = Connection(Role.HOST)
        stream = line.send(m.SetMode(mode=SensorMode.XTID_SM_MANUAL)) + line.send(
            m.X4DriverSet(setting=X4Setting.FPS, value=200.0)
        )
        deaf_fd = open_port(deaf)
        two = [open_port(shared), open_port(shared)]
        for fd in (deaf_fd, *two):
            os.write(fd, stream)
        watched.read_more(25)  # the deaf host's line and queue fill up
        before = watched.descriptors(), watched.resident_kib()
        for number in range(1000):
            fd = open_port(opened)
            os.write(fd, stream if number % 2 else line.send(m.Ping())[: number % 8])
            os.close(fd)
            if number % 20 == 0:
                for fd in two:  # each gets a part of what the module says, and both talk at once
                    with contextlib.suppress(BlockingIOError):
                        os.read(fd, 4096)
                    os.write(fd, line.send(m.GetMode())[:3])
            watched.read()
        watched.read_more(17)
        after = watched.descriptors(), watched.resident_kib()
        for fd in (deaf_fd, *two):
            os.close(fd)
        assert after[0] == before[0], "descriptors"
        assert after[1] - before[1] < 4096, "KiB of memory"
        # A module more than a second behind its clock loses frames (protocol reference 8.4), and a
        # busy machine can hold up this process that long: only in virtual time (the test above) can
        # a test ask for every frame.
        assert watched.counters == sorted(set(watched.counters))
        for path in (opened, shared, deaf):
            assert ping_through_whatever(path), path
        os.close(watched.fd)
        assert served.end() == 0


def check(outcome: Outcome) -> None:
    """Every packet that no damage touched was found, or is known to be inside another."""
    statistics = outcome.statistics
    assert statistics.bytes == outcome.bytes
    assert outcome.found + outcome.missed.total() == outcome.untouched
    assert set(outcome.missed) <= {SWALLOWED_NORMAL, SWALLOWED_MERGED, SWALLOWED_BULK}
    assert outcome.missed.total() <= 1e-3 * outcome.untouched + 1


@pytest.mark.parametrize("rate", [1e-5, 1e-3])
def test_mixed_traffic(rate: float) -> None:
    outcome = corrupted_traffic.run(1_000_000, rate, 1, short=False)
    check(outcome)
    assert outcome.untouched > (0.4 if rate == 1e-3 else 0.9) * outcome.packets
    assert outcome.damaged_bytes > 0


def test_short_packets_with_a_hundredth_of_all_bytes_damaged() -> None:
    outcome = corrupted_traffic.run(200_000, 1e-2, 1, short=True)
    check(outcome)
    assert outcome.untouched > 0.8 * outcome.packets
    assert outcome.statistics.checksum_failures > 100


def test_undamaged_traffic_is_found_whole() -> None:
    outcome = corrupted_traffic.run(1_000_000, 0.0, 1, short=False)
    assert outcome.found == outcome.untouched == outcome.packets == outcome.statistics.packets
    assert outcome.statistics.clean


def test_the_command_finds_the_same() -> None:
    outcome = corrupted_traffic.run(300_000, 1e-3, 2, short=False)
    command = run_command(300_000, 1e-3, 2, short=False)
    assert command.exit_code == 0
    assert command.statistics == outcome.statistics.summary()
    assert command.faults == outcome.statistics.faults.total()
    assert command.lines - command.faults == outcome.statistics.packets

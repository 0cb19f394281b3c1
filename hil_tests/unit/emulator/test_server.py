"""The loop, turn by turn: fairness, back-pressure, bounded reply latency."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from emulator.device import Device
from emulator.link import PtyLink
from emulator.pace import Pace
from emulator.server import PACKETS_PER_TURN, Port, Server
from hil_tests.unit.emulator.doubles import ramp_device
from xethru_protocol import messages as m
from xethru_protocol.codes import SensorMode, X4Setting
from xethru_protocol.connection import Connection, Role
from xethru_protocol.packets import NeedData


@dataclass
class Clock:
    now_ns: int = 0

    def __call__(self) -> int:
        return self.now_ns


class PtyHost:
    """A host on the other side of a real pseudo-terminal, stepping the server as it waits."""

    def __init__(self, link: PtyLink, server: Server) -> None:
        self.server = server
        self.fd = os.open(link.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self.line = Connection(Role.HOST)

    def send(self, command: m.Command[m.Response]) -> None:
        os.write(self.fd, self.line.send(command))

    def hear(self) -> m.Message:
        for _ in range(200):
            event = self.line.next_event()
            if isinstance(event, m.Message):
                return event
            assert isinstance(event, NeedData), event
            try:
                self.line.receive_data(os.read(self.fd, 65536))
            except BlockingIOError:
                self.server.turn(longest_wait_s=0.01)
        raise AssertionError("the device says nothing")

    def ask(self, command: m.Command[m.Response]) -> tuple[m.Message, int]:
        """Return the reply and how many frames came before it."""
        self.send(command)
        frames = 0
        while isinstance(message := self.hear(), m.DataFloat):
            frames += 1
        return message, frames

    def stream(self, fps: float = 17.0) -> None:
        commands: list[m.Command[m.Response]] = [
            m.SetMode(mode=SensorMode.XTID_SM_MANUAL),
            m.X4DriverInit(),
            m.X4DriverSet(setting=X4Setting.FPS, value=fps),
        ]
        for command in commands:
            assert self.ask(command) == (m.Ack(), 0)

    def close(self) -> None:
        os.close(self.fd)


@dataclass
class Bench:
    clock: Clock
    server: Server
    links: list[PtyLink]
    devices: list[Device]
    hosts: list[PtyHost] = field(default_factory=list)

    def host(self, index: int) -> PtyHost:
        host = PtyHost(self.links[index], self.server)
        self.hosts.append(host)
        return host


@pytest.fixture(params=list(Pace))
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    devices = [ramp_device(request.param) for _ in range(3)]
    links = [PtyLink(tmp_path / f"radar{index}") for index in range(3)]
    clock = Clock()
    ports = [Port(link, device) for link, device in zip(links, devices, strict=True)]
    server = Server(ports, clock_ns=clock)
    made = Bench(clock=clock, server=server, links=links, devices=devices)
    yield made
    for host in made.hosts:
        host.close()
    server.close()
    for link in links:
        link.close()


@pytest.fixture
def asap(tmp_path: Path) -> Iterator[Bench]:
    device, link, clock = ramp_device(), PtyLink(tmp_path / "radar"), Clock()
    server = Server([Port(link, device)], clock_ns=clock)
    made = Bench(clock=clock, server=server, links=[link], devices=[device])
    yield made
    for host in made.hosts:
        host.close()
    server.close()
    link.close()


def test_commands_are_answered(bench: Bench) -> None:
    host = bench.host(1)
    assert host.ask(m.Ping()) == (m.Pong(value=0xAAEEAEEA), 0)


def test_nothing_is_lost_when_the_host_reads_slowly(asap: Bench) -> None:
    host = asap.host(0)
    host.stream()
    counters = []
    for step in range(200):
        if step % 10 == 0:
            for _ in range(20):
                asap.server.turn(longest_wait_s=0)
        message = host.hear()
        assert isinstance(message, m.DataFloat)
        counters.append(message.info)
    assert counters == list(range(200))


def test_back_pressure_stops_the_chip(asap: Bench) -> None:
    host = asap.host(0)
    host.stream()
    for _ in range(100):
        asap.server.turn(longest_wait_s=0)
    made = asap.devices[0].module.chip.timeline.next_counter
    for _ in range(100):
        asap.server.turn(longest_wait_s=0)
    assert asap.devices[0].module.chip.timeline.next_counter == made
    assert made < 20, "no more than the terminal holds"


def test_a_reply_overtakes_all_but_what_is_in_the_terminal(asap: Bench) -> None:
    host = asap.host(0)
    host.stream()
    for _ in range(50):
        asap.server.turn(longest_wait_s=0)
    made = asap.devices[0].module.chip.timeline.next_counter
    reply, frames = host.ask(m.X4DriverSet(setting=X4Setting.FPS, value=0.0))
    assert reply == m.Ack()
    assert frames <= made + 2, "what was made before, and a packet that was half sent"
    for _ in range(20):
        asap.server.turn(longest_wait_s=0)
    with pytest.raises(BlockingIOError):
        os.read(host.fd, 1)


def test_a_host_that_dies_while_streaming_leaves_a_usable_module(bench: Bench) -> None:
    first = bench.host(0)
    first.stream(fps=90.0)
    for _ in range(200):
        bench.clock.now_ns += 10_000_000
        bench.server.turn(longest_wait_s=0)
    bench.hosts.remove(first)
    first.close()
    for _ in range(200):
        bench.clock.now_ns += 10_000_000
        bench.server.turn(longest_wait_s=0)
    second = bench.host(0)
    second.send(m.X4DriverSet(setting=X4Setting.FPS, value=0.0))
    for _ in range(200):  # drain: the old frames, at worst one cut in two, then the reply
        event = second.line.next_event()
        if isinstance(event, m.Ack):
            break
        if isinstance(event, NeedData):
            try:
                second.line.receive_data(os.read(second.fd, 65536))
            except BlockingIOError:
                bench.server.turn(longest_wait_s=0.01)
    else:
        pytest.fail("no answer after a host died")
    assert second.ask(m.Ping()) == (m.Pong(value=0xAAEEAEEA), 0)


def test_one_greedy_port_does_not_hold_up_another(bench: Bench) -> None:
    bench.host(0).stream(fps=1e6)
    quiet = bench.host(2)
    bench.clock.now_ns += 10**9
    turns = 0
    quiet.send(m.Ping())
    while True:
        bench.server.turn(longest_wait_s=0)
        turns += 1
        try:
            quiet.line.receive_data(os.read(quiet.fd, 4096))
            break
        except BlockingIOError:
            assert turns < 5
    assert quiet.line.next_event() == m.Pong(value=0xAAEEAEEA)


def test_random_bytes_on_one_port_leave_the_others_alone(bench: Bench) -> None:
    noisy, quiet = bench.host(0), bench.host(1)
    for seed in range(50):
        os.write(noisy.fd, bytes((seed * 7 + step * step) % 256 for step in range(400)))
        bench.server.turn(longest_wait_s=0)
        assert quiet.ask(m.Ping()) == (m.Pong(value=0xAAEEAEEA), 0)


def test_a_host_that_never_reads_replies_is_held_back(asap: Bench) -> None:
    host = asap.host(0)
    question = host.line.send(m.SystemGetInfo(item=4))
    unsent = question * 3000
    for _ in range(3000):
        try:
            unsent = unsent[os.write(host.fd, unsent) :]
        except BlockingIOError:
            asap.server.turn(longest_wait_s=0)
    assert not asap.devices[0].wants_data
    # whole, in order, nothing dropped: one reply per complete command
    for _ in range(3000 - len(unsent) // len(question) - 1):
        assert isinstance(host.hear(), m.ReplyString)


def test_stop_ends_a_waiting_loop(asap: Bench) -> None:
    asap.server.stop()
    asap.server.run()


def test_a_turn_sends_a_bounded_share() -> None:
    class Endless:
        wants_data = True
        sent = 0

        def receive_data(self, data: bytes, now_ns: int) -> None: ...

        def advance(self, now_ns: int) -> None: ...

        def next_packet(self, now_ns: int) -> bytes | None:
            self.sent += 1
            return b"x"

        def wake_ns(self, now_ns: int) -> int | None:
            return None

    class Bottomless:
        def fileno(self) -> int:
            return -1

        def read(self) -> bytes:
            return b""

        def write(self, data: memoryview) -> int:
            return len(data)

    device = Endless()
    assert Port(Bottomless(), device).send(0)
    assert device.sent == PACKETS_PER_TURN

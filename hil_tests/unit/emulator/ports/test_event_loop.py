"""The loop, turn by turn: fairness, back-pressure, bounded reply latency.

Most tests use a socket pair as the line: what is written on one side can be read on the other at
once. A pseudo-terminal moves bytes in a kernel worker of its own, at no certain time.
"""

import contextlib
import os
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from emulator.chip import Pace
from emulator.module.commands import answer
from emulator.module.state import Module
from emulator.ports.event_loop import PACKETS_PER_TURN, Port, Server
from emulator.ports.pty import PtyLink
from emulator.x4m300 import COMMANDS_AT_ONCE, Device
from hil_tests.patience import seconds
from hil_tests.unit.emulator.doubles import PairLine, PortHost, ramp_device
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import SensorMode, X4Setting
from xethru_protocol.wire.framing import NeedData


@dataclass
class Clock:
    now_ns: int = 0

    def __call__(self) -> int:
        return self.now_ns


LIMIT_S = seconds(60)
PONG = m.Pong(value=0xAAEEAEEA)


class TerminalLink(PtyLink):
    def host_fd(self) -> int:
        return os.open(self.path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)


@dataclass
class Bench:
    clock: Clock
    server: Server
    links: list[PairLine] | list[TerminalLink]
    devices: list[Device]
    hosts: list[PortHost] = field(default_factory=list)

    def host(self, index: int) -> PortHost:
        host = PortHost(self.links[index].host_fd(), self.server)
        self.hosts.append(host)
        return host

    def turns(self, count: int, each_ns: int = 0) -> None:
        for _ in range(count):
            self.clock.now_ns += each_ns
            self.server.turn(longest_wait_s=0)


@contextlib.contextmanager
def served(links: list[PairLine] | list[TerminalLink], pace: Pace) -> Iterator[Bench]:
    devices = [ramp_device(pace) for _ in links]
    clock = Clock()
    ports = [Port(links[index], device) for index, device in enumerate(devices)]
    server = Server(ports, clock_ns=clock)
    made = Bench(clock=clock, server=server, links=links, devices=devices)
    yield made
    for host in made.hosts:
        host.close()
    server.close()
    for link in links:
        link.close()


@pytest.fixture(params=list(Pace))
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    with served([PairLine() for _ in range(3)], request.param) as made:
        yield made


@pytest.fixture
def asap() -> Iterator[Bench]:
    with served([PairLine()], Pace.ASAP) as made:
        yield made


@pytest.fixture(params=list(Pace))
def terminal(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    with served([TerminalLink(tmp_path / "radar")], request.param) as made:
        yield made


def test_nothing_is_lost_when_the_host_reads_slowly(asap: Bench) -> None:
    host = asap.host(0)
    host.stream()
    counters = []
    for step in range(200):
        if step % 10 == 0:
            asap.turns(20)
        message = host.hear()
        assert isinstance(message, m.DataFloat)
        counters.append(message.info)
    assert counters == list(range(1, 201))


def test_back_pressure_stops_the_chip(asap: Bench) -> None:
    host = asap.host(0)
    host.stream()
    asap.turns(100)
    made = asap.devices[0].module.chip.timeline.next_counter
    asap.turns(100)
    assert asap.devices[0].module.chip.timeline.next_counter == made
    assert made < 20, "no more than the line holds"


def test_a_reply_overtakes_all_but_what_is_in_the_line(asap: Bench) -> None:
    host = asap.host(0)
    host.stream()
    asap.turns(50)
    made = asap.devices[0].module.chip.timeline.next_counter
    host.send(m.X4DriverSet(setting=X4Setting.FPS, value=0.0))
    frames = 0
    while isinstance(message := host.hear(), m.DataFloat):
        frames += 1
    assert message == m.Ack()
    assert frames <= made + 2, "what was made before, and a packet that was half sent"
    asap.turns(20)
    with pytest.raises(BlockingIOError):
        os.read(host.fd, 1)


def test_a_host_that_dies_while_streaming_leaves_a_usable_module(terminal: Bench) -> None:
    first = terminal.host(0)
    first.stream(fps=90.0)
    terminal.turns(200, 10_000_000)
    terminal.hosts.remove(first)
    first.close()
    terminal.turns(200, 10_000_000)
    second = terminal.host(0)
    second.send(m.X4DriverSet(setting=X4Setting.FPS, value=0.0))
    deadline = time.monotonic() + LIMIT_S
    while time.monotonic() < deadline:  # the old frames, at worst one cut in two, then the reply
        event = second.line.next_event()
        if isinstance(event, m.Ack):
            break
        if isinstance(event, NeedData):
            try:
                second.line.receive_data(os.read(second.fd, 65536))
            except BlockingIOError:
                terminal.server.turn(longest_wait_s=0.01)
    else:
        pytest.fail("no answer after a host died")
    assert second.ask(m.Ping()) == PONG


def test_one_greedy_port_does_not_hold_up_another(bench: Bench) -> None:
    bench.host(0).stream(fps=1e6)
    quiet = bench.host(2)
    quiet.ask(m.SetMode(mode=SensorMode.XTID_SM_STOP))  # ends the profile
    bench.clock.now_ns += 10**9
    quiet.send(m.Ping())
    bench.server.turn(longest_wait_s=0)  # one turn serves every port, whatever the others want
    quiet.line.receive_data(os.read(quiet.fd, 4096))
    assert quiet.line.next_event() == m.Pong(value=0xAAEEAEEA)


@pytest.mark.parametrize("flood", [m.Ping(), m.UnknownMessage(code=0x77, payload=b"\x77")])
def test_a_flood_of_commands_is_carried_out_bit_by_bit(
    bench: Bench, flood: m.Command[m.Response], monkeypatch: pytest.MonkeyPatch
) -> None:
    noisy, quiet = bench.host(0), bench.host(1)
    carried_out = 0

    def counted(module: Module, command: m.Command[m.Response]) -> m.Response | None:
        nonlocal carried_out
        carried_out += 1
        return answer(module, command)

    monkeypatch.setattr("emulator.x4m300.answer", counted)
    bench.turns(1)
    total = 300  # more than a thousand bytes, which are read at once
    os.write(noisy.fd, noisy.line.send(flood) * total)
    quiet.send(m.Ping())
    bench.server.turn(longest_wait_s=0)
    quiet.line.receive_data(os.read(quiet.fd, 4096))
    assert quiet.line.next_event() == PONG
    assert carried_out <= 2 * COMMANDS_AT_ONCE + 1
    replies = [noisy.hear() for _ in range(total)]
    assert all(reply == replies[0] for reply in replies)
    assert carried_out == total + 1
    assert bench.devices[0].wants_data


def test_random_bytes_on_one_port_leave_the_others_alone(bench: Bench) -> None:
    noisy, quiet = bench.host(0), bench.host(1)
    for seed in range(50):
        os.write(noisy.fd, bytes((seed * 7 + step * step) % 256 for step in range(400)))
        bench.server.turn(longest_wait_s=0)
        assert quiet.ask(m.Ping()) == PONG


def test_a_host_that_never_reads_replies_is_held_back(asap: Bench) -> None:
    host = asap.host(0)
    question = host.line.send(m.SystemGetInfo(item=4))
    total = 20_000  # far more than the line holds in either direction
    unsent = question * total
    idle_turns = 0  # in which the line took nothing more
    while idle_turns < 100:
        idle_turns += 1
        with contextlib.suppress(BlockingIOError):
            unsent = unsent[os.write(host.fd, unsent) :]
            idle_turns = 0
        asap.server.turn(longest_wait_s=0)
    assert not asap.devices[0].wants_data
    assert unsent, "the line back to the host fills up, too"
    # whole, in order, nothing dropped: one reply per complete command
    for _ in range(total - len(unsent) // len(question) - 1):
        assert isinstance(host.hear(), m.ReplyString)


def test_stop_before_run_ends_it_at_once(asap: Bench) -> None:
    asap.server.stop()
    asap.server.run()


def test_stop_ends_a_waiting_loop(asap: Bench) -> None:
    loop = threading.Thread(target=asap.server.run, daemon=True)
    loop.start()
    time.sleep(0.2)  # nothing is due and nobody speaks: by now it waits without a limit
    asap.server.stop()
    loop.join(LIMIT_S)
    assert not loop.is_alive()


class Idle:
    wants_data = True

    def receive_data(self, data: bytes, now_ns: int) -> None: ...

    def advance(self, now_ns: int) -> None: ...

    def next_packet(self, now_ns: int) -> bytes | None:
        return None

    def wake_ns(self, now_ns: int) -> int | None:
        return None


def test_a_turn_sends_a_bounded_share() -> None:
    class Endless(Idle):
        sent = 0

        def next_packet(self, now_ns: int) -> bytes | None:
            self.sent += 1
            return b"x"

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


def test_a_deadline_serves_the_ports_whose_own_has_come() -> None:
    class Periodic(Idle):
        def __init__(self, period_ns: int) -> None:
            self.period_ns = self.due_ns = period_ns
            self.served: list[int] = []

        def advance(self, now_ns: int) -> None:
            self.served.append(now_ns)
            self.due_ns = now_ns // self.period_ns * self.period_ns + self.period_ns

        def wake_ns(self, now_ns: int) -> int | None:
            return self.due_ns

    links, devices, clock = [PairLine(), PairLine()], [Periodic(10), Periodic(25)], Clock()
    server = Server([Port(*pair) for pair in zip(links, devices, strict=True)], clock_ns=clock)
    for clock.now_ns in range(0, 101, 5):
        server.turn(longest_wait_s=0)
    assert devices[0].served == list(range(0, 101, 10))
    assert devices[1].served == list(range(0, 101, 25))
    links[1].host_write(b"x")  # whatever happens on a line may concern every device
    clock.now_ns += 1
    server.turn(longest_wait_s=0)
    assert [device.served[-1] for device in devices] == [101, 101]
    server.close()
    for link in links:
        link.close()


def test_a_line_that_is_hung_up_while_written_to_serves_every_port() -> None:
    """The other line of the module has it now."""

    class Counting(Idle):
        served = 0

        def advance(self, now_ns: int) -> None:
            self.served += 1

    class Speaking(Counting):
        def next_packet(self, now_ns: int) -> bytes | None:
            return b"x"

    class HangsUp(PairLine):
        up = True

        def fileno(self) -> int:
            return super().fileno() if self.up else -1

        def write(self, data: memoryview) -> int:
            if self.up:
                server._selector.unregister(self.fileno())
            self.up = False
            return len(data)

    links, waiting = [PairLine(), HangsUp()], Counting()
    server = Server([Port(links[0], waiting), Port(links[1], Idle())], clock_ns=lambda: 0)
    server.turn(longest_wait_s=0)
    server._ports[1].device = Speaking()
    links[1].host_write(b"y")
    server.turn(longest_wait_s=0)
    before = waiting.served
    server.turn(longest_wait_s=60)  # at once
    assert waiting.served == before + 1
    server.close()
    for link in links:
        link.close()


def test_the_loop_waits_for_a_deadline_from_now_on() -> None:
    """The clock of a machine that has been up for long."""

    class Soon(Idle):
        def wake_ns(self, now_ns: int) -> int | None:
            return now_ns + 1_000_000

    link = PairLine()
    server = Server([Port(link, Soon())], clock_ns=lambda: 10**18)
    began_s = time.monotonic()
    server.turn(longest_wait_s=LIMIT_S)
    assert time.monotonic() - began_s < LIMIT_S / 2
    server.close()
    link.close()


def test_a_deadline_beyond_what_the_system_waits_for_is_no_error() -> None:
    class Distant(Idle):
        def wake_ns(self, now_ns: int) -> int | None:
            return 10**24

    link = PairLine()
    server = Server([Port(link, Distant())], clock_ns=lambda: 0)
    server.stop()  # its wait ends at once, if it begins
    server.turn()
    server.turn(longest_wait_s=0)
    server.close()
    link.close()

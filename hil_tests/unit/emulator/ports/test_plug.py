"""Ports that go away while a module restarts: hang-up, no name, a fresh port that works."""

from __future__ import annotations

import contextlib
import gc
import os
import select
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from emulator.chip import Pace
from emulator.device import radar_device
from emulator.module.settings import DeviceOptions
from emulator.ports.module_ports import DevicePorts, LinkOptions, NamedDevice
from emulator.ports.server import Server
from hil_tests.patience import seconds
from hil_tests.unit.emulator.doubles import IDENTITY, RampSource
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.connection import Connection, Role

MS = 1_000_000
# Protocol reference 8.1: half a second from the ACK to the restart, two more to the transmitter
RESTART_MS, RETURN_MS = 500, 2500


class Bench:
    """One served module under a clock that tests set."""

    def __init__(self, folder: Path, links: LinkOptions, cleanup: contextlib.ExitStack) -> None:
        self.now_ns = 0
        self.folder = folder
        self.told: list[str] = []
        options = DeviceOptions(port_on_reset="vanish")
        device = radar_device(IDENTITY, RampSource(), Pace.REALTIME, options=options)
        self.pulled = False
        named = NamedDevice(
            name="radar",
            serial="1",
            device=device,
            present=lambda now_ns: device.port_present(now_ns) and not self.pulled,
        )
        self.opened = DevicePorts([named], folder, links, cleanup)
        self.opened.moved = lambda: self.told.append(str(self.opened.entries()[0]["path"]))
        self.server = Server(self.opened.ports, self.opened.services, clock_ns=lambda: self.now_ns)
        cleanup.callback(self.server.close)

    def at_ms(self, time_ms: int) -> None:
        self.now_ns = time_ms * MS
        for _ in range(5):
            self.server.turn(longest_wait_s=0.001)

    def names(self) -> list[str]:
        return sorted(path.name for path in self.folder.iterdir())

    def open(self, name: str = "radar") -> int:
        return os.open(self.folder / name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)

    def reset(self, fd: int) -> None:
        os.write(fd, Connection(Role.HOST).send(m.ModReset()))
        boot = [m.System(code=0x10), m.System(code=0x11)]
        heard = self.packets(fd, 1, last=m.Ack)  # the pty may hand over the boot messages first
        assert heard in ([m.Ack()], [*boot, m.Ack()])

    def packets(self, fd: int, count: int, *, last: type[m.Message] = m.Message) -> list[m.Message]:
        """Return what arrives until there are ``count`` and the last one is of that type."""
        line = Connection(Role.HOST)
        heard: list[m.Message] = []
        while len(heard) < count or not isinstance(heard[-1], last):
            for _ in range(50):
                self.server.turn(longest_wait_s=0.001)
                if select.select([fd], [], [], 0.05)[0]:
                    break
            line.receive_data(os.read(fd, 4096))
            while isinstance(event := line.next_event(), m.Message):
                heard.append(event)
        return heard


def bench_of(folder: Path, links: LinkOptions) -> Iterator[Bench]:
    with contextlib.ExitStack() as cleanup:
        yield Bench(folder, links, cleanup)


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    yield from bench_of(tmp_path, LinkOptions(port_on_reset="vanish"))


@pytest.fixture
def renaming(tmp_path: Path) -> Iterator[Bench]:
    yield from bench_of(tmp_path, LinkOptions(port_on_reset="rename"))


@pytest.fixture
def with_tcp(tmp_path: Path) -> Iterator[Bench]:
    yield from bench_of(tmp_path, LinkOptions(port_on_reset="vanish", tcp_base=0))


def test_an_open_port_hangs_up_and_its_name_is_gone_until_the_module_is_back(bench: Bench) -> None:
    host = bench.open()
    bench.reset(host)
    bench.at_ms(RESTART_MS - 1)
    assert bench.names() == ["radar"]
    bench.at_ms(RESTART_MS)
    assert bench.names() == []
    assert select.select([host], [], [], seconds(5))[0], "a blocked reader wakes up"
    with contextlib.suppress(OSError):  # EIO
        assert os.read(host, 1) == b"", "end of file"
    with pytest.raises(OSError, match="Input/output error"):
        os.write(host, b"x")
    os.close(host)
    bench.at_ms(RETURN_MS - 1)
    assert bench.names() == []
    assert bench.told == []
    bench.at_ms(RETURN_MS)
    assert bench.names() == ["radar"]
    assert bench.told == [str(bench.folder / "radar")]
    host = bench.open()
    heard = bench.packets(host, 2)
    assert heard == [m.System(code=0x10), m.System(code=0x11)], "BOOTING and READY wait"
    os.write(host, Connection(Role.HOST).send(m.Ping()))
    assert bench.packets(host, 1) == [m.Pong(value=0xAAEEAEEA)]
    os.close(host)


def test_the_loop_wakes_by_itself_when_the_port_is_due(bench: Bench) -> None:
    host = bench.open()
    bench.reset(host)
    (plug,) = bench.opened.services
    assert plug.wake_ns(0) is None
    bench.at_ms(RESTART_MS)
    wake_ns = plug.wake_ns(bench.now_ns)
    assert wake_ns is not None
    assert 0 < wake_ns - bench.now_ns <= 100 * MS
    os.close(host)


def test_it_returns_under_another_name_each_time(renaming: Bench) -> None:
    base_ms = 0
    for name, next_name in (("radar", "radar-2"), ("radar-2", "radar-3")):
        host = renaming.open(name)
        renaming.reset(host)
        os.close(host)
        renaming.at_ms(base_ms + RESTART_MS)
        assert renaming.names() == []
        base_ms += RETURN_MS
        renaming.at_ms(base_ms)
        assert renaming.names() == [next_name]
    assert renaming.told == [str(renaming.folder / name) for name in ("radar-2", "radar-3")]


def test_a_tcp_client_is_hung_up_on_and_none_is_let_in_meanwhile(with_tcp: Bench) -> None:
    port = with_tcp.opened.entries()[0]["tcp"]
    assert isinstance(port, int)

    def is_let_in() -> bool:
        with socket.create_connection(("127.0.0.1", port), timeout=seconds(5)) as client:
            client.sendall(Connection(Role.HOST).send(m.ModReset()))
            for _ in range(20):
                with_tcp.server.turn(longest_wait_s=0.001)
            with contextlib.suppress(ConnectionError):
                return client.recv(100) != b""
            return False

    with socket.create_connection(("127.0.0.1", port), timeout=seconds(5)) as first:
        with_tcp.reset(first.fileno())
        with_tcp.at_ms(RESTART_MS)
        assert first.recv(1) == b""
    assert not is_let_in()
    with_tcp.at_ms(RETURN_MS)
    assert is_let_in()


def test_a_pulled_plug_stays_out_until_it_is_put_in(bench: Bench) -> None:
    bench.pulled = True
    bench.at_ms(1)
    assert bench.names() == []
    bench.at_ms(10_000)
    assert bench.names() == []
    bench.pulled = False
    bench.at_ms(10_001)
    assert bench.names() == ["radar"]


def test_a_hundred_restarts_leak_nothing(bench: Bench) -> None:
    gc.collect()  # what earlier tests left must not go away in between
    before = sorted(os.listdir("/dev/fd"))
    for _ in range(100):
        host = bench.open()
        for pulled in (True, False):
            bench.pulled = pulled
            bench.server.turn(longest_wait_s=0)
        os.close(host)
    bench.at_ms(1)
    assert len(os.listdir("/dev/fd")) == len(before)
    host = bench.open()
    os.write(host, Connection(Role.HOST).send(m.Ping()))
    assert bench.packets(host, 1) == [m.Pong(value=0xAAEEAEEA)]
    os.close(host)


def test_a_file_in_the_way_is_waited_for_not_died_of(bench: Bench) -> None:
    bench.pulled = True
    bench.at_ms(1)
    (bench.folder / "radar").write_text("mine")
    bench.pulled = False
    bench.at_ms(2)
    assert (bench.folder / "radar").read_text() == "mine"
    (bench.folder / "radar").unlink()
    bench.at_ms(3)
    assert (bench.folder / "radar").is_symlink()

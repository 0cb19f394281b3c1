"""Lines to a module: one TCP client at a time, a terminal that is deaf meanwhile, ports that go."""

from __future__ import annotations

import contextlib
import fcntl
import gc
import os
import select
import socket
import sys
import termios
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from emulator.chip import Pace
from emulator.module.settings import DeviceOptions
from emulator.ports.event_loop import Server
from emulator.ports.module_ports import DevicePorts, LinkOptions, NamedDevice
from emulator.ports.pty import LinkError, PortWatch
from emulator.x4m300 import radar_device
from hil_tests.patience import seconds, wait_until
from hil_tests.unit.emulator.doubles import IDENTITY, PortHost, RampSource, ramp_device
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.connection import Connection, Role

MS = 1_000_000
# Protocol reference 8.1: half a second from the ACK to the restart, two more to the transmitter
RESTART_MS, RETURN_MS = 500, 2500
PONG = m.Pong(value=0xAAEEAEEA)


class Bench:
    def __init__(
        self,
        folder: Path,
        links: LinkOptions,
        devices: Sequence[NamedDevice],
        cleanup: contextlib.ExitStack,
    ) -> None:
        self.now_ns = 0
        self.folder = folder
        self.cleanup = cleanup
        self.opened = DevicePorts(devices, folder, links, cleanup)
        self.server = Server(self.opened.ports, self.opened.services, clock_ns=lambda: self.now_ns)
        cleanup.callback(self.server.close)

    def turns(self, count: int = 10) -> None:
        for _ in range(count):
            self.server.turn(longest_wait_s=0.001)

    def tcp_port(self, index: int = 0) -> int:
        port = self.opened.entries()[index]["tcp"]
        assert isinstance(port, int)
        return port

    def tcp(self, index: int = 0) -> Host:
        client = socket.create_connection(("127.0.0.1", self.tcp_port(index)))
        client.setblocking(False)
        return Host(self, client.detach())

    def open(self, name: str) -> int:
        return os.open(self.folder / name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)

    def pty(self, name: str = "radar_1") -> Host:
        return Host(self, self.open(name))


class Host(PortHost):
    def __init__(self, bench: Bench, fd: int) -> None:
        super().__init__(fd, bench.server)
        self.bench = bench
        bench.cleanup.callback(self.close)

    def is_hung_up(self) -> bool:
        def is_readable() -> list[int]:
            self.bench.turns()
            return select.select([self.fd], [], [], 0)[0]

        wait_until(is_readable)
        try:
            return os.read(self.fd, 65536) == b""
        except ConnectionError:
            return True


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    """Return two modules, each on a pseudo-terminal and a TCP port."""
    devices = [
        NamedDevice(name=f"radar_{index}", serial=str(index), device=ramp_device())
        for index in (1, 2)
    ]
    with contextlib.ExitStack() as cleanup:
        yield Bench(tmp_path, LinkOptions(tcp_base=0), devices, cleanup)


class Unplugged(Bench):
    """One module whose port goes away while it restarts, and can be pulled."""

    def __init__(self, folder: Path, links: LinkOptions, cleanup: contextlib.ExitStack) -> None:
        self.told: list[str] = []
        self.pulled = False
        options = DeviceOptions(port_on_reset="vanish")
        device = radar_device(IDENTITY, RampSource(), Pace.REALTIME, options=options)
        named = NamedDevice(
            name="radar",
            serial="1",
            device=device,
            present=lambda now_ns: device.port_present(now_ns) and not self.pulled,
        )
        super().__init__(folder, links, [named], cleanup)
        self.opened.moved = lambda: self.told.append(str(self.opened.entries()[0]["path"]))

    def at_ms(self, time_ms: int) -> None:
        self.now_ns = time_ms * MS
        self.turns(5)

    def names(self) -> list[str]:
        return sorted(path.name for path in self.folder.iterdir())

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


@pytest.fixture
def vanishing(tmp_path: Path) -> Iterator[Unplugged]:
    with contextlib.ExitStack() as cleanup:
        yield Unplugged(tmp_path, LinkOptions(port_on_reset="vanish"), cleanup)


@pytest.fixture
def renaming(tmp_path: Path) -> Iterator[Unplugged]:
    with contextlib.ExitStack() as cleanup:
        yield Unplugged(tmp_path, LinkOptions(port_on_reset="rename"), cleanup)


@pytest.fixture
def with_tcp(tmp_path: Path) -> Iterator[Unplugged]:
    with contextlib.ExitStack() as cleanup:
        yield Unplugged(tmp_path, LinkOptions(port_on_reset="vanish", tcp_base=0), cleanup)


def test_every_module_answers_on_a_port_of_its_own(bench: Bench) -> None:
    assert bench.tcp_port(0) != bench.tcp_port(1)
    for index in (0, 1):
        assert bench.tcp(index).ask(m.Ping()) == PONG


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux shows whether a port is exclusive")
def test_a_killed_host_keeps_no_other_out(bench: Bench) -> None:
    """It had the terminal exclusively, and a terminal remembers that."""
    killed = bench.open("radar_1")
    fcntl.ioctl(killed, termios.TIOCEXCL)
    bench.turns()
    os.close(killed)
    bench.turns()
    host = bench.pty("radar_1")
    get_exclusive = 0x80045440  # TIOCGEXCL, which termios does not have
    assert fcntl.ioctl(host.fd, get_exclusive, bytes(4)) == bytes(4)


def test_the_same_bytes_come_through_tcp_and_terminal(bench: Bench) -> None:
    streams = []
    for host in (bench.tcp(0), bench.pty("radar_2")):
        host.stream()
        frame = host.hear()
        assert isinstance(frame, m.DataFloat)
        streams.append((frame.info, frame.values.tobytes()))
    assert streams[0] == streams[1]


def test_a_second_client_is_hung_up_on_and_the_first_notices_nothing(bench: Bench) -> None:
    first = bench.tcp()
    assert first.ask(m.Ping()) == PONG
    assert bench.tcp().is_hung_up()
    assert first.ask(m.Ping()) == PONG
    first.close()
    bench.turns()
    assert bench.tcp().ask(m.Ping()) == PONG


def test_the_terminal_is_deaf_while_a_client_has_the_module(bench: Bench) -> None:
    client = bench.tcp()
    assert client.ask(m.Ping()) == PONG
    terminal = bench.pty()
    terminal.send(m.Ping())
    bench.turns()
    assert client.ask(m.GetProfileId()) != PONG, "the answer to its own question and no other"
    with pytest.raises(BlockingIOError):
        os.read(terminal.fd, 1)
    client.close()
    bench.turns()
    assert terminal.ask(m.Ping()) == PONG


def test_who_has_the_terminal_open_keeps_the_module(bench: Bench) -> None:
    terminal = bench.pty()
    assert terminal.ask(m.Ping()) == PONG
    watches = [one for one in bench.opened.services if isinstance(one, PortWatch)]
    assert watches
    if not all(one.works for one in watches):
        pytest.skip("this system does not tell who opens a terminal")
    assert bench.tcp().is_hung_up()
    terminal.close()
    bench.turns()
    assert bench.tcp().ask(m.Ping()) == PONG


def test_a_client_that_leaves_amid_a_frame_leaves_nothing_to_the_next(bench: Bench) -> None:
    first = bench.tcp()
    first.stream(90.0)
    bench.turns(200)  # never reading: its line fills up, a frame is half sent
    first.close()
    bench.turns()
    second = bench.tcp()
    second.send(m.X4DriverSet(setting=X4Setting.FPS, value=0.0))
    while isinstance(heard := second.hear(), m.DataFloat):  # `hear` allows no damaged packet
        pass
    assert heard == m.Ack()


def test_a_thousand_clients_leak_nothing(bench: Bench) -> None:
    bench.turns()
    gc.collect()  # what earlier tests left must not go away in between
    before = sorted(os.listdir("/dev/fd"))
    for index in range(1000):
        client = bench.tcp(index % 2)
        os.write(client.fd, bytes((index * 7 + step * step) % 256 for step in range(40)))
        bench.server.turn(longest_wait_s=0.001)
        client.close()
    bench.turns(20)
    assert sorted(os.listdir("/dev/fd")) == before
    assert bench.tcp().ask(m.Ping()) == PONG


def test_after_the_last_host_the_loop_rests(bench: Bench) -> None:
    for index in range(20):
        for host in (bench.pty(f"radar_{index % 2 + 1}"), bench.tcp(index % 2)):
            os.write(host.fd, bytes(range(256)))
            bench.turns(2)
            host.close()
    bench.turns(20)
    begin_s = time.monotonic()
    for _ in range(5):  # a loop that spins does millions
        bench.server.turn(longest_wait_s=0.1)
    assert time.monotonic() - begin_s > 0.2


def test_a_port_that_is_taken_is_one_clear_line(bench: Bench, tmp_path: Path) -> None:
    taken = bench.tcp_port()
    devices = [NamedDevice(name="other", serial="3", device=ramp_device())]
    for port, why in ((taken, "Address already in use"), (70000, "ports end at 65535")):
        with (
            contextlib.ExitStack() as cleanup,
            pytest.raises(LinkError, match=rf"127.0.0.1:{port}: cannot listen: .*{why}.*--tcp"),
        ):
            DevicePorts(devices, tmp_path, LinkOptions(tcp_base=port), cleanup)
    assert not (tmp_path / "other").is_symlink()


@pytest.mark.parametrize(
    ("host", "why"),
    [("a" * 300, "label"), ("192.0.2.1", "Cannot assign requested address"), ("a..b", "label")],
)
def test_an_address_that_cannot_be_is_one_clear_line(host: str, why: str, tmp_path: Path) -> None:
    devices = [NamedDevice(name="other", serial="3", device=ramp_device())]
    with contextlib.ExitStack() as cleanup, pytest.raises(LinkError) as caught:
        DevicePorts(devices, tmp_path, LinkOptions(tcp_base=0, tcp_host=host), cleanup)
    said = str(caught.value)
    assert said.startswith(f"{host}:0: cannot listen: ")
    assert said.endswith("; choose another --tcp or --tcp-host")
    assert why in said
    assert said.count(host) == 1, "said once is enough"


def test_an_open_port_hangs_up_and_its_name_is_gone_until_the_module_is_back(
    vanishing: Unplugged,
) -> None:
    host = vanishing.open("radar")
    vanishing.reset(host)
    vanishing.at_ms(RESTART_MS - 1)
    assert vanishing.names() == ["radar"]
    vanishing.at_ms(RESTART_MS)
    assert vanishing.names() == []
    assert select.select([host], [], [], seconds(5))[0], "a blocked reader wakes up"
    with contextlib.suppress(OSError):  # EIO
        assert os.read(host, 1) == b"", "end of file"
    with pytest.raises(OSError, match="Input/output error"):
        os.write(host, b"x")
    os.close(host)
    vanishing.at_ms(RETURN_MS - 1)
    assert vanishing.names() == []
    assert vanishing.told == []
    vanishing.at_ms(RETURN_MS)
    assert vanishing.names() == ["radar"]
    assert vanishing.told == [str(vanishing.folder / "radar")]
    host = vanishing.open("radar")
    heard = vanishing.packets(host, 2)
    assert heard == [m.System(code=0x10), m.System(code=0x11)], "BOOTING and READY wait"
    os.write(host, Connection(Role.HOST).send(m.Ping()))
    assert vanishing.packets(host, 1) == [PONG]
    os.close(host)


def test_the_loop_wakes_by_itself_when_the_port_is_due(vanishing: Unplugged) -> None:
    host = vanishing.open("radar")
    vanishing.reset(host)
    plug = vanishing.opened
    assert plug.wake_ns(0) is None
    vanishing.at_ms(RESTART_MS)
    wake_ns = plug.wake_ns(vanishing.now_ns)
    assert wake_ns is not None
    assert 0 < wake_ns - vanishing.now_ns <= 100 * MS
    os.close(host)


def test_it_returns_under_another_name_each_time(renaming: Unplugged) -> None:
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


def test_a_tcp_client_is_hung_up_on_and_none_is_let_in_meanwhile(with_tcp: Unplugged) -> None:
    port = with_tcp.tcp_port()

    def is_let_in() -> bool:
        with socket.create_connection(("127.0.0.1", port), timeout=seconds(5)) as client:
            client.sendall(Connection(Role.HOST).send(m.ModReset()))
            with_tcp.turns(20)
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


def test_a_pulled_plug_stays_out_until_it_is_put_in(vanishing: Unplugged) -> None:
    vanishing.pulled = True
    vanishing.at_ms(1)
    assert vanishing.names() == []
    vanishing.at_ms(10_000)
    assert vanishing.names() == []
    vanishing.pulled = False
    vanishing.at_ms(10_001)
    assert vanishing.names() == ["radar"]


def test_a_hundred_restarts_leak_nothing(vanishing: Unplugged) -> None:
    gc.collect()  # what earlier tests left must not go away in between
    before = sorted(os.listdir("/dev/fd"))
    for _ in range(100):
        host = vanishing.open("radar")
        for pulled in (True, False):
            vanishing.pulled = pulled
            vanishing.server.turn(longest_wait_s=0)
        os.close(host)
    vanishing.at_ms(1)
    assert len(os.listdir("/dev/fd")) == len(before)
    host = vanishing.open("radar")
    os.write(host, Connection(Role.HOST).send(m.Ping()))
    assert vanishing.packets(host, 1) == [PONG]
    os.close(host)


def test_a_file_in_the_way_is_waited_for_not_died_of(vanishing: Unplugged) -> None:
    vanishing.pulled = True
    vanishing.at_ms(1)
    (vanishing.folder / "radar").write_text("mine")
    vanishing.pulled = False
    vanishing.at_ms(2)
    assert (vanishing.folder / "radar").read_text() == "mine"
    (vanishing.folder / "radar").unlink()
    vanishing.at_ms(3)
    assert (vanishing.folder / "radar").is_symlink()

"""A module on a TCP port: one client at a time, the pseudo-terminal deaf meanwhile."""

from __future__ import annotations

import contextlib
import gc
import os
import select
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from emulator.ports.module_ports import DevicePorts, LinkOptions, NamedDevice
from emulator.ports.pty import LinkError
from emulator.ports.server import Server
from hil_tests.patience import wait_until
from hil_tests.unit.emulator.doubles import PortHost, ramp_device
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting

PONG = m.Pong(value=0xAAEEAEEA)


class Bench:
    """Two served modules, each on a pseudo-terminal and a TCP port."""

    def __init__(self, folder: Path, cleanup: contextlib.ExitStack) -> None:
        devices = [
            NamedDevice(name=f"radar_{index}", serial=str(index), device=ramp_device())
            for index in (1, 2)
        ]
        self.cleanup = cleanup
        self.opened = DevicePorts(devices, folder, LinkOptions(tcp_base=0), cleanup)
        self.server = Server(self.opened.ports, self.opened.services, clock_ns=lambda: 0)
        cleanup.callback(self.server.close)

    def turns(self, count: int = 10) -> None:
        for _ in range(count):
            self.server.turn(longest_wait_s=0.001)

    def tcp(self, index: int = 0) -> Host:
        port = self.opened.entries()[index]["tcp"]
        assert isinstance(port, int)
        client = socket.create_connection(("127.0.0.1", port))
        client.setblocking(False)
        return Host(self, client.detach())

    def pty(self, index: int = 0) -> Host:
        path = str(self.opened.entries()[index]["path"])
        return Host(self, os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK))


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
    with contextlib.ExitStack() as cleanup:
        yield Bench(tmp_path, cleanup)


def test_every_module_answers_on_a_port_of_its_own(bench: Bench) -> None:
    ports = [entry["tcp"] for entry in bench.opened.entries()]
    assert len(set(ports)) == 2
    for index in (0, 1):
        assert bench.tcp(index).ask(m.Ping()) == PONG


def test_the_same_bytes_come_through_tcp_and_terminal(bench: Bench) -> None:
    streams = []
    for host in (bench.tcp(0), bench.pty(1)):
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
    if not getattr(bench.opened.services[0], "works", False):
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
        for host in (bench.pty(index % 2), bench.tcp(index % 2)):
            os.write(host.fd, bytes(range(256)))
            bench.turns(2)
            host.close()
    bench.turns(20)
    begin_s = time.monotonic()
    for _ in range(5):  # a loop that spins does millions
        bench.server.turn(longest_wait_s=0.1)
    assert time.monotonic() - begin_s > 0.2


def test_a_port_that_is_taken_is_one_clear_line(bench: Bench, tmp_path: Path) -> None:
    taken = bench.opened.entries()[0]["tcp"]
    assert isinstance(taken, int)
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

"""Ports of the network: raw TCP and RFC 2217, against the emulator, pyserial's server and ser2net.

Expected bytes are those of RFC 854 and RFC 2217.
"""

import asyncio
import concurrent.futures
import contextlib
import math
import shutil
import socket
import subprocess
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
import serial
from serial import rfc2217

from hil_tests.device.emulator_process import Served, emulator
from hil_tests.patience import patient_ns, seconds, wait_until
from hil_tests.unit.xethru_protocol.pty_module import PtyModule
from xethru_protocol.cli import main
from xethru_protocol.driver.async_radar import AsyncX4M300
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.transport import (
    AsyncSerialTransport,
    LineTransport,
    capacity_bytes_per_s,
    open_line,
)
from xethru_protocol.wire.codes import PongCode
from xethru_protocol.wire.errors import Disconnected, PortUnavailable

SHORT = RawConfig(frame_area_m=(0.4, 1.0), iterations=4)


class _PtyPort(serial.Serial):
    """A pty for pyserial's server, which asks for modem lines; a pty has none."""

    dtr = rts = True
    cts = dsr = ri = cd = False


class Redirector:
    """pyserial's RFC 2217 server on a serial port, for one client after the other.

    It claims the port: the number of a pty is soon given to another one, and a driver that looks
    for the module it had there would set the rate of this one.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.url = f"rfc2217://127.0.0.1:{self._listener.getsockname()[1]}"
        self.baudrates: list[int] = []
        self._client: socket.socket | None = None
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> None:  # what PortManager calls
        assert self._client is not None
        self._client.sendall(data)

    def hang_up(self) -> None:
        if self._client is not None:
            with contextlib.suppress(OSError):
                self._client.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self.hang_up()
        self._thread.join(seconds(2))
        self._listener.close()

    def _serve(self) -> None:
        while True:
            try:
                self._client, _ = self._listener.accept()
            except OSError:
                return
            with self._client, _PtyPort(self._path, 9600, timeout=0.01, exclusive=True) as port:
                # the stubs of pyserial ask for two ports; a port and a writer are used
                manager = rfc2217.PortManager(port, self)  # type: ignore[arg-type] # wants write()
                gone = threading.Event()

                def pass_on(
                    manager: rfc2217.PortManager = manager, gone: threading.Event = gone
                ) -> None:
                    while not gone.is_set():
                        # a client may purge what this thread was about to read
                        with contextlib.suppress(OSError):
                            self.write(b"".join(manager.escape(port.read(4096))))

                reading = threading.Thread(target=pass_on)
                reading.start()
                with contextlib.suppress(OSError):
                    while data := self._client.recv(4096):
                        port.write(b"".join(manager.filter(data)))
                        if port.baudrate not in self.baudrates[-1:]:
                            self.baudrates.append(port.baudrate)
                gone.set()
                reading.join()


@contextmanager
def _ser2net(path: str, folder: Path) -> Iterator[tuple[str, str]]:
    """Run ser2net on a port; URLs of its RFC 2217 and its raw port."""
    program = shutil.which("ser2net") or shutil.which("/usr/sbin/ser2net")
    if program is None:
        pytest.skip("ser2net is not installed (Debian: apt-get install ser2net)")
    with (
        closing(socket.create_server(("127.0.0.1", 0))) as one,
        closing(socket.create_server(("127.0.0.1", 0))) as other,
    ):
        numbers = one.getsockname()[1], other.getsockname()[1]
    settings = folder / "ser2net.yaml"
    settings.write_text(
        "".join(
            f"connection: &{name}\n  accepter: {accepter},127.0.0.1,{number}\n"
            f"  connector: serialdev,{path},115200n81,local\n"
            for name, accepter, number in zip(
                "ab", ("telnet(rfc2217),tcp", "tcp"), numbers, strict=True
            )
        )
    )
    process = subprocess.Popen(
        [program, "-n", "-d", "-u", "-c", settings],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )

    def listens() -> bool:
        try:
            socket.create_connection(("127.0.0.1", numbers[0]), 1.0).close()
        except OSError:
            return False
        return True

    try:
        wait_until(listens, process)
        yield f"rfc2217://127.0.0.1:{numbers[0]}", f"tcp://127.0.0.1:{numbers[1]}"
    finally:
        process.terminate()
        process.wait(seconds(5))


@pytest.fixture(scope="module")
def served() -> Iterator[Served]:
    with emulator("serve", "--bare", "--tcp", "0") as served:
        yield served


@pytest.fixture(params=["tcp", "socket", "rfc2217", "ser2net", "ser2net raw"])
def url(request: pytest.FixtureRequest, served: Served, tmp_path: Path) -> Iterator[str]:
    match request.param:
        case "tcp" | "socket":
            yield f"{request.param}://127.0.0.1:{served.tcp_ports[0]}"
        case "rfc2217":
            with closing(Redirector(served.paths[0])) as redirector:
                yield redirector.url
        case _:
            with _ser2net(served.paths[0], tmp_path) as urls:
                yield urls["raw" in request.param]


def _opened(url: str, reconnect_s: float = 0.0) -> X4M300:
    """Return a driver; a server may still be busy with the client before."""
    radars: list[X4M300] = []

    def opens() -> bool:
        try:
            radar = X4M300.open(url, clock=patient_ns, reconnect_s=reconnect_s)
        except PortUnavailable:
            return False
        try:
            radar.ping(seconds(0.2))
        except Disconnected:
            radar.close()
            return False
        radars.append(radar)
        return True

    wait_until(opens)
    return radars[0]


@pytest.mark.slow
def test_both_drivers_stream_over_every_kind_of_port(url: str, served: Served) -> None:
    with _opened(url) as radar:
        assert radar.info().serial_number == served.serials[0]
        assert radar.port == url
        radar.configure_raw(SHORT)
        radar.start(50.0)
        counters = [frame.counter for frame in radar.frames(20, timeout_s=seconds(1))]
        assert counters == list(range(counters[0], counters[0] + 20))
        assert (radar.fault_count, radar.frames_lost) == (0, 0)

    async def stream() -> list[int]:
        async with AsyncX4M300.open(url, clock=patient_ns) as radar:
            await radar.configure_raw(SHORT)
            await radar.start(50.0)
            return [frame.counter async for frame in radar.frames(20, timeout_s=seconds(1))]

    counters = []

    def streams() -> bool:  # the server may not have noticed that the first client left
        try:
            counters[:] = asyncio.run(stream())
        except (PortUnavailable, Disconnected):
            return False
        return True

    wait_until(streams)
    assert counters == list(range(counters[0], counters[0] + 20))


@pytest.mark.rare
@pytest.mark.slow
def test_the_baud_rate_is_set_on_the_server_too() -> None:
    """The emulated UART answers only a host whose own side has the module's rate."""
    with (
        emulator("serve", "--bare", "--link", "uart") as served,
        closing(Redirector(served.paths[0])) as redirector,
        _opened(redirector.url) as radar,
    ):
        assert capacity_bytes_per_s(radar._transport) == 11520.0
        radar.set_baud_rate(921600)
        assert radar.ping() is PongCode.XTS_SPRP_READY
        assert capacity_bytes_per_s(radar._transport) == 92160.0
        assert redirector.baudrates[-1] == 921600


@pytest.mark.rare
@pytest.mark.slow
def test_the_baud_rate_is_set_while_another_thread_reads() -> None:
    with (
        PtyModule() as module,
        closing(Redirector(module.path)) as redirector,
        _opened(redirector.url) as radar,
        concurrent.futures.ThreadPoolExecutor() as threads,
    ):
        radar.configure_raw()
        reading = threads.submit(radar.read_frame, seconds(60))
        for rate in (230400, 921600, 460800):
            radar.set_baud_rate(rate)
        radar.start(17.0)
        assert reading.result(seconds(60)).counter == 0
        assert redirector.baudrates[-3:] == [230400, 921600, 460800]


@pytest.mark.slow
def test_a_server_that_hangs_up_is_found_again(served: Served) -> None:
    with closing(Redirector(served.paths[0])) as redirector:
        with _opened(redirector.url, reconnect_s=seconds(5)) as radar:
            radar.configure_raw(SHORT)
            radar.start(50.0)
            radar.read_frame(seconds(1))
            redirector.hang_up()
            for _ in range(50):
                radar.read_frame(seconds(1))
            assert radar.reconnects == 1
        with _opened(redirector.url) as radar:
            redirector.hang_up()
            with pytest.raises(Disconnected):
                radar.read_frame(seconds(1))


@pytest.mark.slow
@pytest.mark.parametrize("is_cancelled", [False, True])
def test_other_tasks_go_on_while_a_network_port_is_opened(
    is_cancelled: bool, served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = f"tcp://127.0.0.1:{served.tcp_ports[0]}"
    _opened(url).close()
    entered, released = threading.Event(), threading.Event()
    opened: list[LineTransport] = []

    def open_slowly(path: str, baudrate: int) -> LineTransport:
        entered.set()
        assert released.wait(seconds(2)), "the loop was held up"
        opened.append(open_line(path, baudrate))
        return opened[-1]

    async def reconnect() -> None:
        radar = AsyncX4M300(AsyncSerialTransport(url), clock=patient_ns, candidates=list)
        assert await radar.ping(seconds(1)) is PongCode.XTS_SPRP_READY
        monkeypatch.setattr("xethru_protocol.transport.open_line", open_slowly)
        reconnecting = asyncio.create_task(radar.reconnect(seconds(3)))
        while not entered.is_set():
            await asyncio.sleep(0.001)
        if is_cancelled:
            reconnecting.cancel()
            with pytest.raises(asyncio.CancelledError):
                await reconnecting
            released.set()
            while not opened:
                await asyncio.sleep(0.001)
            await asyncio.sleep(0.05)
        else:
            released.set()
            assert await reconnecting == url
        await radar.close()

    asyncio.run(reconnect())
    for line in opened:
        with pytest.raises(Disconnected, match="was closed"):
            line.fileno()


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("http://pi:80", "http:// .* tcp://HOST:PORT, rfc2217://"),
        ("tcp://pi", "must be tcp://HOST:PORT with a port of 1...65535"),
        ("tcp://pi:65536", "must be tcp://HOST:PORT with a port of 1...65535"),
        ("rfc2217://pi:7?logging=debug", "must be rfc2217://HOST:PORT .* and nothing behind it"),
        ("socket://:5000", "must be socket://HOST:PORT"),
        ("tcp://no-such-host.invalid:5", "no-such-host.invalid"),
        (f"tcp://{'a' * 300}:5", "cannot be reached: there is no host"),
        ("tcp://a..\u0431:5", "cannot be reached: there is no host"),
    ],
)
def test_what_is_wrong_with_a_name_is_said(
    url: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(PortUnavailable, match=words):
        open_line(url)
    assert main(["ping", "--port", url]) == 1
    assert capsys.readouterr().err.count("\n") == 1


def test_where_nothing_listens_it_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as listener:
        number = listener.getsockname()[1]
    for scheme, has_emulator in (("tcp", True), ("rfc2217", False)):  # it serves bytes only
        with pytest.raises(PortUnavailable, match="nothing listens there; does ser2net") as caught:
            open_line(f"{scheme}://127.0.0.1:{number}")
        assert ("xethru-emulator serve --tcp" in str(caught.value)) is has_emulator
    assert main(["doctor", "--port", f"tcp://127.0.0.1:{number}"]) == 1
    assert "nothing listens there" in capsys.readouterr().out


def test_plain_tcp_is_no_rfc2217(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("xethru_protocol.transport._RFC2217_TIMEOUT_S", 0.1)
    with closing(socket.create_server(("127.0.0.1", 0))) as listener:
        number = listener.getsockname()[1]
        with pytest.raises(PortUnavailable, match=f"Then name it tcp://127.0.0.1:{number}"):
            open_line(f"rfc2217://127.0.0.1:{number}")


@pytest.mark.slow
def test_doctor_examines_a_network_port(served: Served, capsys: pytest.CaptureFixture[str]) -> None:
    url = f"tcp://127.0.0.1:{served.tcp_ports[0]}"
    _opened(url).close()
    wait_until(lambda: main(["doctor", "--port", url]) == 0)
    text = capsys.readouterr().out.rpartition(url)[2]
    assert served.serials[0] in text
    assert text.endswith("all is well\n")


# --- RFC 2217 by its bytes ----------------------------------------------------------------------

IAC, WILL, DO, DONT, WONT, SB, SE, COM = 255, 251, 253, 254, 252, 250, 240, 44
RATE_115200 = bytes((IAC, SB, COM, 1, 0x00, 0x01, 0xC2, 0x00, IAC, SE))
RATE_IS_115200 = bytes((IAC, SB, COM, 101, 0x00, 0x01, 0xC2, 0x00, IAC, SE))
PURGED = bytes((IAC, SB, COM, 112, 3, IAC, SE))
PURGE = bytes((IAC, SB, COM, 12, 3, IAC, SE))
AGREED = (bytes((IAC, WILL, COM)), bytes((IAC, DO, COM)))
POLITE = (AGREED, (RATE_115200, RATE_IS_115200), (PURGE, b"old bytes" + PURGED))


ServerOf = Callable[[Sequence[tuple[bytes, bytes]]], tuple[str, Callable[[], bytes]]]


@pytest.fixture
def scripted() -> Iterator[ServerOf]:
    """Make a server that says bytes, one by one, once it got others; its URL, and what it got."""
    with contextlib.ExitStack() as held:

        def start(script: Sequence[tuple[bytes, bytes]]) -> tuple[str, Callable[[], bytes]]:
            listener = held.enter_context(closing(socket.create_server(("127.0.0.1", 0))))
            got = bytearray()

            def serve() -> None:
                with contextlib.suppress(OSError):
                    client, _ = listener.accept()
                    with client:
                        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                        for awaited, said in script:
                            while awaited not in got:
                                got.extend(client.recv(4096))
                            for byte in said:
                                client.sendall(bytes((byte,)))
                        while data := client.recv(4096):
                            got.extend(data)

            thread = threading.Thread(target=serve, daemon=True)
            thread.start()
            held.callback(thread.join, seconds(2))
            return f"rfc2217://127.0.0.1:{listener.getsockname()[1]}", lambda: bytes(got)

        yield start


def test_telnet_commands_and_escapes_are_not_the_modules(
    scripted: ServerOf,
) -> None:
    from_module = b"\x7c\xff\x00\xff\xff\r\n\r\x00"
    noise = bytes((IAC, 241, IAC, WILL, 1, IAC, DO, 24))  # NOP, WILL ECHO, DO TERMINAL-TYPE
    state = bytes((IAC, SB, COM, 107, IAC, IAC, IAC, SE))  # NOTIFY-MODEMSTATE FFh, escaped
    said = noise + b"\x7c\xff\xff" + state + b"\x00\xff\xff\xff\xff\r\n\r\x00"
    url, got = scripted([*POLITE, (b"", said)])
    with closing(open_line(url)) as line:
        read = b""
        while len(read) < len(from_module):
            read += line.read(seconds(1))
        assert read == from_module
        line.write(b"\x7d\xff\x7e")
        wait_until(lambda: got().endswith(b"\x7d\xff\xff\x7e"))
    negotiated = got()
    assert bytes((IAC, WILL, COM)) in negotiated
    assert bytes((IAC, DO, 0)) in negotiated  # BINARY both ways: else CR would gain a NUL
    assert bytes((IAC, WILL, 0)) in negotiated
    assert RATE_115200 in negotiated
    assert bytes((IAC, DONT, 1)) in negotiated  # no echo
    assert bytes((IAC, WONT, 24)) in negotiated
    assert negotiated.index(bytes((IAC, WILL, COM))) < negotiated.index(RATE_115200)


@pytest.mark.parametrize(
    ("script", "words"),
    [
        ([(b"", bytes((IAC, DONT, COM)))], "does not speak RFC 2217"),
        ([AGREED], "does not answer to a change of the baud rate"),
        (
            [AGREED, (RATE_115200, bytes((IAC, SB, COM, 101, 0, 0, 0x25, 0x80, IAC, SE)))],
            "cannot be set to 115200 baud: the server reports 9600",
        ),
        ([AGREED, (b"", bytes((IAC, SB)) + bytes(5000))], "telnet"),
    ],
)
def test_a_server_that_cannot_do_it_is_refused(
    script: Sequence[tuple[bytes, bytes]],
    words: str,
    scripted: ServerOf,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("xethru_protocol.transport._RFC2217_TIMEOUT_S", 0.5)
    url, _ = scripted(script)
    with pytest.raises(PortUnavailable, match=words):
        open_line(url)


def test_a_rate_that_a_server_cannot_have_changes_nothing(
    scripted: ServerOf,
) -> None:
    url, _ = scripted(POLITE)
    with closing(open_line(url)) as line:
        with pytest.raises(Disconnected):
            line.set_baudrate(2**40)
        assert line.bytes_per_s == 11520.0


def test_raw_tcp_has_no_rate() -> None:
    with (
        closing(socket.create_server(("127.0.0.1", 0))) as listener,
        closing(open_line(f"tcp://127.0.0.1:{listener.getsockname()[1]}")) as line,
    ):
        line.set_baudrate(9600)
        assert line.bytes_per_s == math.inf


# --- other tasks of asyncio ---------------------------------------------------------------------


@contextmanager
def _server(serve: Callable[[socket.socket], None]) -> Iterator[int]:
    """Run a server for one client; its port."""
    with closing(socket.create_server(("127.0.0.1", 0))) as listener:

        def run() -> None:
            with contextlib.suppress(OSError), listener.accept()[0] as client:
                serve(client)

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        yield listener.getsockname()[1]
        thread.join(seconds(2))


def _until(client: socket.socket, awaited: bytes) -> None:
    got = b""
    while awaited not in got:
        got += client.recv(4096)


RATE_921600 = bytes((IAC, SB, COM, 1, 0x00, 0x0E, 0x10, 0x00, IAC, SE))
RATE_IS_921600 = bytes((IAC, SB, COM, 101, 0x00, 0x0E, 0x10, 0x00, IAC, SE))


@pytest.mark.parametrize("opens", ["async with", "the first call"])
def test_other_tasks_go_on_while_a_silent_server_is_opened(opens: str) -> None:
    """It agrees to RFC 2217 only when another task has had its turn."""
    went_on = threading.Event()

    def serve(client: socket.socket) -> None:
        assert went_on.wait(seconds(3))
        for awaited, said in POLITE:
            _until(client, awaited)
            client.sendall(said)
        _until(client, b"\x7d")
        client.sendall(bytes.fromhex("7d01eaaeeeaa7c7e"))

    async def run(url: str) -> PongCode:
        async def other() -> None:
            await asyncio.sleep(0.01)
            went_on.set()

        task = asyncio.create_task(other())
        await asyncio.sleep(0)
        radar = AsyncX4M300.open(url, clock=patient_ns)
        assert radar.bytes_per_s == 11520.0
        if opens == "async with":
            async with radar:
                state = await radar.ping(seconds(1))
        else:
            state = await radar.ping(seconds(1))
            await radar.close()
        await task
        return state

    with _server(serve) as port:
        assert asyncio.run(run(f"rfc2217://127.0.0.1:{port}")) is PongCode.XTS_SPRP_READY


def test_other_tasks_go_on_while_the_rate_of_a_server_is_changed() -> None:
    """Bytes that come meanwhile reach the task that reads, in their order."""
    went_on = threading.Event()

    def serve(client: socket.socket) -> None:
        for awaited, said in POLITE:
            _until(client, awaited)
            client.sendall(said)
        _until(client, RATE_921600)
        client.sendall(b"one ")
        assert went_on.wait(seconds(3))
        client.sendall(b"two " + RATE_IS_921600 + b"three")
        with contextlib.suppress(OSError):
            client.recv(1)

    async def run(url: str) -> bytes:
        line = AsyncSerialTransport(url)
        await line.connect()
        came = b""

        async def read() -> None:
            nonlocal came
            while not came.endswith(b"three"):
                came += await line.read(seconds(1))

        async def other() -> None:
            await asyncio.sleep(0.01)
            went_on.set()

        reading = asyncio.create_task(read())
        await asyncio.sleep(0)
        waiting = asyncio.create_task(other())
        await line.set_baudrate(921600)
        assert line.bytes_per_s == 92160.0
        await asyncio.gather(reading, waiting)
        line.close()
        return came

    with _server(serve) as port:
        came = asyncio.run(run(f"rfc2217://127.0.0.1:{port}"))
    assert came.removeprefix(b"old bytes") == b"one two three"


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("http://pi:80", "http://"),
        ("tcp://no-such-host.invalid:5", "there is no host no-such-host.invalid"),
    ],
)
def test_what_is_wrong_with_a_name_is_said_to_tasks_too(url: str, words: str) -> None:
    async def run() -> None:
        async with AsyncX4M300.open(url):
            pass

    with pytest.raises(PortUnavailable, match=words):
        asyncio.run(run())


def test_closed_before_it_connected_stays_closed() -> None:
    async def run(url: str) -> None:
        line = AsyncSerialTransport(url)
        line.close()
        with pytest.raises(Disconnected, match="was closed"):
            await line.read(1.0)

    asyncio.run(run("tcp://127.0.0.1:9"))

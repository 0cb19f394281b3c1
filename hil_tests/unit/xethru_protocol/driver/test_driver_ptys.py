"""Both drivers on real ports: modules that vanish and return, and several asyncio tasks."""

import asyncio
import concurrent.futures
import functools
import os
import pty
import termios
import threading
import tty
from collections.abc import Callable, Coroutine, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from hil_tests.patience import patient_ns, seconds
from hil_tests.unit.xethru_protocol.pty_module import PtyMachine
from xethru_protocol.driver.async_radar import AsyncX4M300
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.transport import AsyncSerialTransport
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.errors import Disconnected, ResponseTimeout

OURS, ANOTHER = "123456789012", "999999999999"


def in_loop(test: Callable[..., Coroutine[None, None, None]]) -> Callable[..., None]:
    """Run a test's coroutine in an event loop."""

    @functools.wraps(test)
    def run(*arguments: Any, **named: Any) -> None:  # noqa: ANN401 - fixtures
        asyncio.run(test(*arguments, **named))

    return run


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[PtyMachine]:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with PtyMachine(tmp_path) as machine:
        machine.plug("home", OURS)
        yield machine


@pytest.fixture
def pty_pair() -> Iterator[tuple[int, str]]:
    """Return the descriptor of one end, and the path of the other."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    os.close(master)
    os.close(slave)


def return_as(machine: PtyMachine, name: str) -> threading.Timer:
    """Bring our module back in a moment, and another one at once."""
    machine.plug("decoy", ANOTHER)
    timer = threading.Timer(0.3, machine.plug, (name, OURS))
    timer.start()
    return timer


def test_a_port_may_be_named_by_a_path_object(machine: PtyMachine) -> None:
    with X4M300.open(Path(machine.path("home")), clock=patient_ns) as radar:
        radar.ping()
        assert radar.port == machine.path("home")


@pytest.mark.parametrize("name", ["home", "elsewhere"])
def test_radar_goes_on_at_the_port_its_module_returned_to(machine: PtyMachine, name: str) -> None:
    with X4M300.open(machine.path("home"), clock=patient_ns, reconnect_s=10.0) as radar:
        radar.configure_raw()
        radar.start(17.0)
        assert [got.counter for got in radar.frames(2)] == [0, 1]
        machine.unplug("home")
        timer = return_as(machine, name)
        while radar.reconnects == 0:
            radar.read_frame()
        timer.join()
        assert radar.port == machine.path(name)
        counters = [got.counter for got in radar.frames(5)]
        assert counters == list(range(counters[0], counters[0] + 5))
        assert all(isinstance(c, m.Ping | m.SystemGetInfo) for c in machine.received("decoy"))
        assert machine.received("decoy") or name == "home"
        assert m.X4DriverSet(setting=X4Setting.FPS, value=17.0) in machine.received(name)


@pytest.mark.parametrize("name", [pytest.param("home", marks=pytest.mark.rare), "elsewhere"])
def test_it_does_too_while_threads_use_it(machine: PtyMachine, name: str) -> None:
    with X4M300.open(machine.path("home"), clock=patient_ns, reconnect_s=10.0) as radar:
        radar.configure_raw()
        radar.start(17.0)
        assert radar.read_frame().counter == 0
        pongs = 0

        def ask() -> None:
            nonlocal pongs
            while radar.reconnects == 0:
                radar.ping()
            radar.ping()
            pongs += 1

        with concurrent.futures.ThreadPoolExecutor() as threads:
            asking = [threads.submit(ask) for _ in range(2)]
            machine.unplug("home")
            timer = return_as(machine, name)
            while radar.read_frame().stream == 0:
                pass
            streams = {got.stream for got in radar.frames(5)}
            for one in asking:
                one.result(seconds(30))
        timer.join()
        assert (radar.port, radar.reconnects, streams) == (machine.path(name), 1, {1})
        assert pongs == 2


@pytest.mark.parametrize("name", [pytest.param("home", marks=pytest.mark.rare), "elsewhere"])
@in_loop
async def test_asynchronous_radar_does_too_while_two_tasks_use_it(
    machine: PtyMachine, name: str
) -> None:
    async with AsyncX4M300.open(machine.path("home"), clock=patient_ns, reconnect_s=10.0) as radar:
        await radar.configure_raw()
        await radar.start(17.0)
        assert (await radar.read_frame()).counter == 0
        machine.unplug("home")
        timer = return_as(machine, name)

        async def read() -> None:
            while radar.reconnects == 0:
                await radar.read_frame()
            await radar.read_frame()

        reading = asyncio.create_task(read())
        while radar.reconnects == 0:
            await radar.ping()
        await reading
        timer.join()
        assert (radar.port, radar.reconnects) == (machine.path(name), 1)


@in_loop
async def test_frames_are_read_while_another_task_asks(machine: PtyMachine) -> None:
    async with AsyncX4M300.open(machine.path("home"), clock=patient_ns) as radar:
        await radar.configure_raw()
        await radar.start(17.0)
        counters: list[int] = []

        async def read() -> None:
            counters.extend([got.counter async for got in radar.frames(20)])

        async def ask() -> None:
            for _ in range(20):
                await radar.ping()

        await asyncio.gather(read(), ask(), ask())
        assert counters == list(range(20))
        assert (radar.stray_count, radar.frames_lost) == (0, 0)


@in_loop
async def test_waiting_task_can_be_cancelled_and_stops_no_other(machine: PtyMachine) -> None:
    async with AsyncX4M300.open(machine.path("home"), clock=patient_ns) as radar:
        waiting = asyncio.create_task(radar.read_frame(60.0))
        await asyncio.sleep(0.02)
        await radar.ping()  # heard by the task that reads
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting
        await radar.ping()
        with pytest.raises(ResponseTimeout):
            await radar.read_frame(0.05)


@in_loop
async def test_cancelled_read_loses_no_bytes(pty_pair: tuple[int, str]) -> None:
    """Also on a line that never pauses, where a read lets other tasks have their turn."""
    other_end, path = pty_pair
    with closing(AsyncSerialTransport(path)) as line:
        os.write(other_end, b"first")
        reading = asyncio.create_task(line.read(60.0))
        await asyncio.sleep(0)  # it lets us have our turn
        reading.cancel()
        with pytest.raises(asyncio.CancelledError):
            await reading
        assert await line.read(seconds(1)) == b"first"


@pytest.mark.parametrize("cancel", [False, True])
@in_loop
async def test_no_timer_outlives_the_read_that_set_it(
    pty_pair: tuple[int, str], cancel: bool
) -> None:
    other_end, path = pty_pair
    loop = asyncio.get_running_loop()
    set_timer = loop.call_later
    timers: list[asyncio.TimerHandle] = []

    def call_later(delay_s: float, *what: Any) -> asyncio.TimerHandle:  # noqa: ANN401 - any
        timers.append(set_timer(delay_s, *what))
        return timers[-1]

    loop.call_later = call_later  # type: ignore[method-assign, assignment]  # a spy
    with closing(AsyncSerialTransport(path)) as line:
        reading = asyncio.create_task(line.read(60.0))
        while not timers:
            await asyncio.sleep(0)
        if cancel:
            reading.cancel()
            with pytest.raises(asyncio.CancelledError):
                await reading
        else:
            os.write(other_end, b"!")
            assert await reading == b"!"
        assert [timer.cancelled() for timer in timers] == [True]


@in_loop
async def test_closing_wakes_the_task_that_reads(machine: PtyMachine) -> None:
    radar = AsyncX4M300.open(machine.path("home"), clock=patient_ns, reconnect_s=10.0)
    await radar.ping()
    waiting = asyncio.create_task(radar.read_frame(60.0))
    await asyncio.sleep(0.02)
    await radar.close()
    with pytest.raises(Disconnected):
        await waiting


@in_loop
async def test_answer_to_a_cancelled_command_is_dropped(
    machine: PtyMachine, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with AsyncX4M300.open(machine.path("home"), clock=patient_ns) as radar:
        write = radar._transport.write

        async def write_and_be_cancelled(data: bytes) -> None:
            await write(data)
            asking.cancel()
            await asyncio.sleep(0)

        with monkeypatch.context() as patch:
            patch.setattr(radar._transport, "write", write_and_be_cancelled)
            asking = asyncio.create_task(radar.info())
            with pytest.raises(asyncio.CancelledError):
                await asking
        assert (await radar.request(m.SystemGetInfo(item=6))).text == OURS


@in_loop
async def test_asynchronous_line_that_takes_nothing_is_given_up(
    pty_pair: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("xethru_protocol.transport._WRITE_TIMEOUT_S", 0.3)
    line = AsyncSerialTransport(pty_pair[1])
    ticks = 0

    async def tick() -> None:
        nonlocal ticks
        while True:
            ticks += 1
            await asyncio.sleep(0)

    ticking = asyncio.create_task(tick())
    with pytest.raises(Disconnected):
        await line.write(bytes(1 << 20))
    ticking.cancel()
    assert ticks > 3  # the loop went on meanwhile
    line.close()
    line.close()


@in_loop
async def test_long_asynchronous_writes_wait_for_room(pty_pair: tuple[int, str]) -> None:
    other_end, path = pty_pair
    data = bytes(range(256)) * 400
    with closing(AsyncSerialTransport(path)) as line:
        writing = asyncio.create_task(line.write(data))
        got = bytearray()
        while len(got) < len(data):
            await asyncio.sleep(0.001)
            got += os.read(other_end, 4096)
        await writing
    assert got == data


def test_rate_is_that_of_the_port(machine: PtyMachine) -> None:
    with X4M300.open(machine.path("home"), baudrate=921600) as radar:
        assert _speed(radar) == termios.B921600
        radar.set_baud_rate(230400)
        assert _speed(radar) == termios.B230400
        assert machine.received("home")[1] == m.SetBaudRate(baudrate=230400)


def _speed(radar: X4M300) -> int:
    descriptor = radar._transport.fileno()  # type: ignore[attr-defined] # a serial port has one
    speed: int = termios.tcgetattr(descriptor)[4]
    return speed

"""Who calls a driver: its own callbacks, several threads, programs that drop it."""

import asyncio
import contextlib
import gc
import queue
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import pytest

from hil_tests.patience import seconds
from hil_tests.unit.xethru_protocol.both_drivers import DriverOn
from hil_tests.unit.xethru_protocol.emulated import Emulated
from hil_tests.unit.xethru_protocol.scripted import PlainModule, ScriptedTransport, frame
from xethru_protocol.driver.async_radar import AsyncX4M300
from xethru_protocol.driver.frames import FrameGeometry
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import PongCode, X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.errors import Disconnected, LocalProtocolError, ResponseTimeout
from xethru_protocol.wire.framing import NEED_DATA

GEOMETRY = FrameGeometry(range_start_m=0.2, bin_length_m=0.0064, n_bins=1431, downconversion=False)
SET_POWER = m.X4DriverSet(setting=X4Setting.TXPOWER, value=1)

# --- callbacks ----------------------------------------------------------------------------------


def called(radar: Any, name: str) -> None:  # noqa: ANN401 - a driver or its stand-in
    """Call a method of a driver, also where it is a coroutine and its event loop runs already."""
    target = getattr(radar, "target", radar)
    result = getattr(target, name)()
    if hasattr(result, "send"):
        result.send(None)


@pytest.mark.parametrize("name", ["ping", "read_frame", "stop", "close"])
@pytest.mark.parametrize("place", ["listener", "raw_listener", "observer"])
def test_callback_that_calls_the_driver_is_refused_at_once(
    driver_on: DriverOn, place: str, name: str
) -> None:
    raised: list[str] = []

    def call_back(*what: object) -> None:
        try:
            called(radar, name)
        except LocalProtocolError as error:
            raised.append(str(error))

    radar, line = driver_on(**({"observer": call_back} if place == "observer" else {}))
    if place != "observer":
        setattr(radar, place, call_back)
    line.say(frame(1))
    assert radar.ping() is PongCode.XTS_SPRP_READY
    assert raised
    assert all("callback" in text and "queue.Queue" in text for text in raised)
    assert line.received == [m.Ping()]  # nothing was sent from inside
    assert not line.closed
    assert line.now_ns < 1e6


def test_error_of_a_callback_reaches_the_caller_and_the_driver_goes_on(driver_on: DriverOn) -> None:
    radar, _ = driver_on()
    radar.listener = lambda message, t_ns: called(radar, "ping")
    with pytest.raises(LocalProtocolError):
        radar.request(SET_POWER)
    radar.listener = None
    assert radar.request(SET_POWER) == m.Ack()


def test_report_of_progress_must_not_call_the_driver_either(emulated: Emulated) -> None:
    radar, _, _ = emulated
    with pytest.raises(LocalProtocolError):
        radar.files.write(0x80000000, 1, bytes(600), lambda done, total: called(radar, "ping"))
    assert radar.ping() is PongCode.XTS_SPRP_READY


# --- threads ------------------------------------------------------------------------------------


class Wire:
    """A line on which reads wait in real time; two readers at once are an error, as on a port."""

    def __init__(self) -> None:
        self.name = "the wire"
        self.reading = threading.Event()
        self.module = PlainModule()
        self._to_host: queue.Queue[bytes] = queue.Queue()
        self._connection = Connection(Role.MODULE)
        self._busy = threading.Lock()
        self._closed = False

    def read(self, timeout_s: float) -> bytes:
        if self._closed:
            raise Disconnected("the wire was closed")
        if not self._busy.acquire(blocking=False):
            raise RuntimeError("concurrent poll() invocation")
        try:
            self.reading.set()
            return self._to_host.get(timeout_s > 0, min(timeout_s, seconds(60)))
        except queue.Empty:
            return b""
        finally:
            self._busy.release()

    def write(self, data: bytes) -> None:
        self._connection.receive_data(data)
        while (event := self._connection.next_event()) is not NEED_DATA:
            assert isinstance(event, m.Message)
            self.say(*self.module(event))

    def say(self, *said: m.Message | bytes) -> None:
        for one in said:
            self._to_host.put(one if isinstance(one, bytes) else self._connection.send(one))

    def close(self) -> None:
        self._closed = True
        self._to_host.put(b"")


@contextmanager
def thread(work: Callable[[], object]) -> Iterator[list[object]]:
    """Run a function in a thread; at the end its result is in the list, or its error is raised."""
    results: list[object] = []

    def run() -> None:
        try:
            results.append(work())
        except BaseException as error:
            results.append(error)

    worker = threading.Thread(target=run, daemon=True)
    worker.start()
    yield results
    worker.join(seconds(60))
    assert not worker.is_alive()
    if isinstance(results[0], BaseException):
        raise results[0]


def wait_for_reader(wire: Wire) -> None:
    assert wire.reading.wait(seconds(60))


def test_thread_asks_while_another_waits_for_a_frame() -> None:
    wire = Wire()
    radar = X4M300(wire)
    radar.configure_raw()
    wire.reading.clear()
    with thread(lambda: radar.read_frame(seconds(60)).counter) as read:
        wait_for_reader(wire)
        for _ in range(20):  # all these answers are heard by the other thread
            assert radar.request(SET_POWER) == m.Ack()
            assert not read
        wire.say(frame(7))
    assert read == [7]
    assert radar.stray_count == 0


def test_threads_that_ask_at_once_each_get_their_own_answer() -> None:
    wire = Wire()
    radar = X4M300(wire)
    radar.configure_raw()
    values = {X4Setting.DACMIN: 949, X4Setting.DACMAX: 1100, X4Setting.ITERATIONS: 16}

    def ask(setting: X4Setting) -> set[object]:
        replies = [radar.request(m.X4DriverGet(setting=setting)) for _ in range(100)]
        return {reply.values for reply in replies}

    def read() -> list[int]:
        return [got.counter for got in radar.frames(200, seconds(60))]

    with (
        thread(read) as frames,
        thread(lambda: ask(X4Setting.DACMIN)) as first,
        thread(lambda: ask(X4Setting.DACMAX)) as second,
    ):
        third = ask(X4Setting.ITERATIONS)
        wire.say(*(frame(k) for k in range(200)))
    assert [first, second, third] == [
        [{(values[X4Setting.DACMIN],)}],
        [{(values[X4Setting.DACMAX],)}],
        {(values[X4Setting.ITERATIONS],)},
    ]
    assert frames == [list(range(200))]
    assert (radar.stray_count, radar.frames_lost) == (0, 0)


def test_thread_that_stops_waiting_leaves_the_line_to_the_other() -> None:
    """The one that read returns with its frame, and the answer is still to come."""
    wire = Wire()
    radar = X4M300(wire)
    radar.configure_raw()
    asked = threading.Event()

    def slow(command: m.Message) -> Sequence[m.Message | bytes]:
        asked.set()
        return []

    wire.module = slow  # type: ignore[assignment] # both are called with a command
    wire.reading.clear()
    with thread(lambda: radar.read_frame(seconds(60)).counter) as read:
        wait_for_reader(wire)
        with thread(lambda: radar.request(SET_POWER, seconds(60))) as answer:
            assert asked.wait(seconds(60))
            wire.say(frame(1))
            while not read:
                time.sleep(0.001)
            wire.say(m.Ack())
    assert (read, answer) == ([1], [m.Ack()])


def test_closing_wakes_the_thread_that_reads() -> None:
    wire = Wire()
    radar = X4M300(wire)

    def read() -> object:
        with pytest.raises(Disconnected):
            radar.read_frame(seconds(60))
        return "woken"

    with thread(read) as result:
        wait_for_reader(wire)
        radar.close()
    assert result == ["woken"]


# --- several readers ----------------------------------------------------------------------------


class Trickle:
    """A line that gives one packet a read, until ``stopped``."""

    def __init__(self, message: m.Response) -> None:
        self.name = "the line"
        self.stopped = False
        self._packet = Connection(Role.MODULE).send(message)

    def read(self, timeout_s: float) -> bytes:
        if timeout_s <= 0:
            return b""
        if self.stopped:
            raise Disconnected("all have read enough")
        time.sleep(0.0002)
        return self._packet

    def write(self, data: bytes) -> None:
        """Hear nothing."""

    def close(self) -> None:
        """Stay open."""


class AsyncTrickle(Trickle):
    async def read(self, timeout_s: float) -> bytes:  # type: ignore[override]  # asyncio
        await asyncio.sleep(0)
        return super().read(timeout_s)

    async def write(self, data: bytes) -> None:  # type: ignore[override]  # asyncio
        """Hear nothing."""


MESSAGE = m.DataString(content_id=0, info=0, text="one")


@pytest.mark.parametrize("message", [frame(1), MESSAGE], ids=["frames", "messages"])
@pytest.mark.parametrize("kind", ["sync", "async"])
@pytest.mark.parametrize("readers", [2, 3])
def test_several_readers_share_what_comes(message: m.Response, kind: str, readers: int) -> None:
    """None takes more than its turn while others wait."""
    log: list[int] = []

    def note(reader: int, line: Trickle) -> bool:
        log.append(reader)
        line.stopped = line.stopped or min(map(log.count, range(readers))) >= 50
        return not line.stopped and len(log) < 5000

    read = "read_frame" if isinstance(message, m.DataFloat) else "read_message"
    what: list[Any] = [] if read == "read_frame" else [m.DataString]
    if kind == "sync":
        line = Trickle(message)
        radar = X4M300(line)
        radar.geometry = GEOMETRY

        def reader_thread(reader: int) -> None:
            with contextlib.suppress(ResponseTimeout, Disconnected):
                while getattr(radar, read)(*what, seconds(1)) and note(reader, line):
                    pass

        with contextlib.ExitStack() as threads:
            for reader in range(readers):
                threads.enter_context(thread(partial(reader_thread, reader)))
    else:

        async def run() -> None:
            line = AsyncTrickle(message)
            radar = AsyncX4M300(line)
            radar.geometry = GEOMETRY

            async def reader_task(reader: int) -> None:
                with contextlib.suppress(ResponseTimeout, Disconnected):
                    while await getattr(radar, read)(*what, seconds(1)) and note(reader, line):
                        pass

            await asyncio.gather(*map(reader_task, range(readers)))

        asyncio.run(run())
    together = log[max(map(log.index, range(readers))) :]  # from when the last one began
    counts = [together.count(reader) for reader in range(readers)]
    assert min(counts) > 40
    assert max(counts) - min(counts) < 10


def test_reader_that_gives_up_leaves_its_place_to_the_next(driver_on: DriverOn) -> None:
    radar, line = driver_on()
    radar.geometry = GEOMETRY
    for _ in range(3):
        with pytest.raises(ResponseTimeout):
            radar.read_frame(0.5)
    assert 1.4e9 < line.now_ns < 1.7e9
    line.say(frame(3))
    assert radar.read_frame().counter == 3


def test_task_whose_turn_does_not_come_gives_up_in_time() -> None:
    async def run() -> float:
        line = AsyncTrickle(MESSAGE)
        radar = AsyncX4M300(line)
        first = asyncio.create_task(radar.read_frame(60.0))
        await asyncio.sleep(0)
        began_s = time.monotonic()
        with pytest.raises(ResponseTimeout):
            await radar.read_frame(0.05)
        took_s = time.monotonic() - began_s
        third = asyncio.create_task(radar.read_frame(60.0))
        await asyncio.sleep(0.01)
        for task in (first, third):  # a cancelled one leaves its place, too
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
        return took_s

    assert 0.04 < asyncio.run(run()) < seconds(1)


# --- dropped ------------------------------------------------------------------------------------


def drop(prepare: Callable[[X4M300], object]) -> list[str]:
    """Return the texts of the warnings that dropping a driver gives."""
    line = ScriptedTransport(PlainModule())
    radar = X4M300(line, clock=line.clock)
    prepare(radar)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        del radar
        gc.collect()
    return [str(one.message) for one in caught if issubclass(one.category, ResourceWarning)]


def begin(radar: X4M300, fps: float = 17.0) -> None:
    radar.configure_raw()
    radar.start(fps)


def begin_and(end: Callable[[X4M300], object]) -> Callable[[X4M300], object]:
    def prepare(radar: X4M300) -> None:
        begin(radar)
        end(radar)

    return prepare


@pytest.mark.parametrize("fps", [17.0, 17, np.float32(17), np.int64(17)])
def test_driver_dropped_while_its_radar_transmits_is_warned_of(fps: float) -> None:
    (text,) = drop(partial(begin, fps=fps))
    assert "the port" in text
    assert "with X4M300.open(...)" in text


@pytest.mark.parametrize(
    "prepare",
    [
        X4M300.ping,
        X4M300.configure_raw,
        begin_and(X4M300.stop),
        begin_and(X4M300.close),
        begin_and(X4M300.reset),
    ],
    ids=["ping", "configured", "stopped", "closed", "reset"],
)
def test_driver_of_a_radar_that_is_silent_may_be_dropped(
    prepare: Callable[[X4M300], object],
) -> None:
    assert drop(prepare) == []

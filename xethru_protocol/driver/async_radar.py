"""Driver of one X4M300 for asyncio: the same as `X4M300`, with methods that are awaited.

::

    async with AsyncX4M300.open(port, reconnect_s=20.0) as radar:
        await radar.configure_raw()
        await radar.start(17.0)
        async for frame in radar.frames():
            ...

No threads: the port's descriptor is watched by the event loop while somebody waits for it.

Several tasks may use one driver, for example one that reads frames and one that asks: commands
wait for each other, and whatever is read is sorted for everybody.
"""

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from types import TracebackType
from typing import Self, TypeVar

from xethru_protocol.driver import link, raw_mode, reconnect
from xethru_protocol.driver.conversation import Observer
from xethru_protocol.driver.files import AsyncFiles, AsyncPresence
from xethru_protocol.driver.frames import DEFAULT_FRAMES, Frame
from xethru_protocol.driver.link import (
    CloseLine,
    OpenLine,
    Procedure,
    RadarCore,
    Read,
    SetLineRate,
    Sleep,
    Step,
    Write,
)
from xethru_protocol.driver.radar import DriverFacts, known_ports
from xethru_protocol.driver.reconnect import awaited, awaited_once
from xethru_protocol.transport import (
    AsyncSerialTransport,
    AsyncTransport,
    capacity_bytes_per_s,
    set_rate,
)
from xethru_protocol.wire.errors import Disconnected, XeThruError

_BAUD = 115200
_LONGEST_WAIT_S = 86400.0

T = TypeVar("T")


class AsyncX4M300(DriverFacts):
    """One module at the other end of a transport of asyncio; parameters as of `X4M300`.

    Attributes
    ----------
    presence
        Profiles: load, set up, run, hear.
    files
        Files in the module's flash, and its crash dump.
    """

    def __init__(
        self,
        transport: AsyncTransport,
        *,
        clock: Callable[[], int] = time.monotonic_ns,
        observer: Observer | None = None,
        queue_frames: int = DEFAULT_FRAMES,
        reconnect_s: float = 0.0,
        open_port: Callable[[str, int], AsyncTransport] = AsyncSerialTransport,
        candidates: Callable[[], Sequence[str]] = known_ports,
        sleep: Callable[[float], Awaitable[None]] = asyncio.sleep,
    ) -> None:
        super().__init__(
            RadarCore(
                transport.name,
                clock=clock,
                observer=observer,
                queue_frames=queue_frames,
                reconnect_s=reconnect_s,
                candidates=candidates,
            )
        )
        self._core.bytes_per_s = capacity_bytes_per_s(transport)
        self._transport = transport
        self._open_port = open_port
        self._sleep = sleep
        self._one_at_a_time = asyncio.Lock()
        self._reading: asyncio.Future[None] | None = None
        self.presence = AsyncPresence(self._core, self._run, self._run_beside)
        self.files = AsyncFiles(self._core, self._run)

    @classmethod
    def open(
        cls,
        path: str,
        *,
        baudrate: int = _BAUD,
        clock: Callable[[], int] = time.monotonic_ns,
        observer: Observer | None = None,
        queue_frames: int = DEFAULT_FRAMES,
        reconnect_s: float = 0.0,
    ) -> Self:
        """Driver on a serial port; `PortUnavailable` if it cannot be opened.

        ``baudrate`` is the rate at which a UART module talks now; USB and ptys have none.
        """
        transport = AsyncSerialTransport(path, baudrate)
        try:
            radar = cls(
                transport,
                clock=clock,
                observer=observer,
                queue_frames=queue_frames,
                reconnect_s=reconnect_s,
            )
        except BaseException:
            transport.close()
            raise
        radar._core.baudrate = baudrate
        return radar

    async def __aenter__(self) -> Self:
        """Return self; `close` is called at the end."""
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close, also after an error."""
        await self.close()

    async def close(self) -> None:
        """Stop the radar if this driver configured it, and release the line.

        A profile is left running, as the module itself would after power-up.
        """
        self._core.closed = True
        try:
            await self._run(raw_mode.leave(self._core))
        except XeThruError as error:
            self._core.warn(f"the module was not stopped: {error}")
        finally:
            self._transport.close()

    # --- any command ----------------------------------------------------------------------------

    request = awaited(link.request)
    ping = awaited(link.ping)
    info = awaited(link.info)
    x4_settings = awaited(link.x4_settings)

    # --- the line -------------------------------------------------------------------------------

    reset = awaited_once(reconnect.reset)
    reconnect = awaited_once(reconnect.reconnect)
    set_baud_rate = awaited_once(link.set_baud_rate)

    # --- raw radar mode -------------------------------------------------------------------------

    configure_raw = awaited(raw_mode.configure_raw)
    start = awaited(raw_mode.start)
    stop = awaited(raw_mode.stop_frames)

    async def read_frame(self, timeout_s: float = link.TIMEOUT_S) -> Frame:
        """Next frame, in order of arrival; see `X4M300.read_frame`."""
        frames = self._core.frames
        while not frames:  # another task may have been faster
            await self._run_beside(lambda: link.wait_for_frame(self._core, timeout_s))
        return frames.pop()

    async def frames(
        self, count: int | None = None, timeout_s: float = link.TIMEOUT_S
    ) -> AsyncIterator[Frame]:
        """Iterate over frames; ``count`` of them, or without end; see `X4M300.frames`."""
        while count is None or count > 0:
            yield await self.read_frame(timeout_s)
            if count is not None:
                count -= 1

    # --- carrying out steps ---------------------------------------------------------------------

    async def _run(self, procedure: Procedure[T]) -> T:
        """Carry out a procedure that asks: no other may ask before it is done."""
        async with self._one_at_a_time:
            return await self._carry(procedure)

    async def _run_beside(self, procedure: Callable[[], Procedure[T]]) -> T:
        """Carry out a procedure that only hears, beside one that asks; again after a reconnect."""
        core = self._core
        if core.reconnect_s > 0 and core.identity is None:
            await self._run(reconnect.identify_quietly(core))
        for _ in range(reconnect.RECONNECTS_PER_CALL):
            generation = core.generation
            try:
                return await self._carry(procedure())
            except Disconnected as error:
                await self._run(reconnect.recover(core, generation, error))
        return await self._carry(procedure())

    async def _carry(self, procedure: Procedure[T]) -> T:
        try:
            step = next(procedure)
            while True:
                try:
                    came = await self._carry_out(step)
                except BaseException as error:  # the procedure decides
                    step = procedure.throw(error)
                else:
                    step = procedure.send(came)
        except StopIteration as end:
            result: T = end.value
            return result

    async def _carry_out(self, step: Step) -> bool:
        if isinstance(step, Read):  # the most frequent one, so without a match
            return await self._pump(step.timeout_s)
        match step:
            case Write(data):
                if self.raw_listener is not None:
                    self.raw_listener("tx", data, self._core.clock())
                await self._transport.write(data)
            case Sleep(seconds):
                await self._sleep(seconds)
            case CloseLine():
                self._transport.close()
            case OpenLine(path, baudrate):
                self._transport = self._open_port(path, baudrate)
                self._core.bytes_per_s = capacity_bytes_per_s(self._transport)
            case SetLineRate(baudrate):
                set_rate(self._transport, baudrate)
                self._core.bytes_per_s = capacity_bytes_per_s(self._transport)
        return False

    async def _pump(self, timeout_s: float) -> bool:
        """Read once and sort what came, or wait for the task that does; False if nothing came."""
        if self._reading is not None:
            done, _ = await asyncio.wait({self._reading}, timeout=min(timeout_s, _LONGEST_WAIT_S))
            return bool(done)
        self._reading = asyncio.get_running_loop().create_future()
        try:
            data = await self._transport.read(timeout_s)
        finally:
            self._reading.set_result(None)
            self._reading = None
        if not data:
            return False
        arrival_ns = self._core.clock()
        if self.raw_listener is not None:
            self.raw_listener("rx", data, arrival_ns)
        self._core.conversation.receive(data, arrival_ns)
        return True

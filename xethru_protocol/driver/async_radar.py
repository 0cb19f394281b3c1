"""Driver of one X4M300 for asyncio: the same as `X4M300`, with methods that are awaited.

::

    async with AsyncX4M300.open(port, reconnect_s=20.0) as radar:
        await radar.configure_raw()
        await radar.x4.iterations.set(8)
        await radar.start(17.0)
        async for frame in radar.frames():
            ...

The port's descriptor is watched by the event loop while a task waits for it. A network port is
connected to at ``async with``, or by the first call, and `PortUnavailable` is raised there.

Several tasks may use one driver, for example one that reads frames and one that sends commands:
commands wait for each other, and what one task reads reaches the others.
"""

import asyncio
import inspect
import itertools
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from typing import Self, TypeVarTuple

from xethru_protocol.driver import raw_mode, reconnect
from xethru_protocol.driver.frames import Frame
from xethru_protocol.driver.link import (
    TIMEOUT_S,
    Awaited,
    AwaitGate,
    CloseLine,
    Link,
    OpenLine,
    P,
    Procedure,
    Read,
    ReplyT,
    SetLineRate,
    Sleep,
    Step,
    Steps,
    T,
    Write,
)
from xethru_protocol.driver.profiles import (
    MESSAGE_TIMEOUT_S,
    MessageT,
    wait_for_message,
)
from xethru_protocol.driver.radar import RadarState, reentry
from xethru_protocol.transport import (
    AsyncSerialTransport,
    AsyncTransport,
    Transport,
    set_rate,
)
from xethru_protocol.wire.errors import Disconnected, XeThruError
from xethru_protocol.wire.messages import Command, Response

_LONGEST_WAIT_S = 86400.0
Ts = TypeVarTuple("Ts")


class AsyncX4M300(RadarState[Awaited, AsyncTransport]):
    """One module at the other end of a transport of asyncio; all members as of `X4M300`.

    A chip setting has coroutines: ``await radar.x4.iterations.get()``, ``.set(8)``.
    """

    _is_awaited = True
    _make_gate = asyncio.Event
    _port_type = staticmethod(AsyncSerialTransport)
    _usual_sleep = staticmethod(asyncio.sleep)

    def _make_locks(self) -> None:
        self._one_at_a_time = asyncio.Lock()
        self._reading: asyncio.Future[None] | None = None
        self._at_work = False  # never while a task waits

    async def __aenter__(self) -> Self:
        await _connect(self._transport)
        return self

    async def __aexit__(self, *error: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Stop the radar if this driver configured it, and release the line."""
        self._refuse_reentry()
        self._link.closed = True
        try:
            await self._call_once(raw_mode.leave)
        except XeThruError as error:
            self._link.warn(f"the module was not stopped: {error}")
        finally:
            self._transport.close()

    # --- any command, iterators ---

    async def request(self, command: Command[ReplyT], timeout_s: float = TIMEOUT_S) -> ReplyT:
        """Send a command and return its reply; see `X4M300.request`."""
        return await self._call(Link.request, command, timeout_s)

    async def frames(
        self, count: int | None = None, timeout_s: float = TIMEOUT_S
    ) -> AsyncIterator[Frame]:
        """Iterate over frames; ``count`` of them, or without end; see `X4M300.frames`."""
        for _ in itertools.count() if count is None else range(count):
            yield await self.read_frame(timeout_s)

    async def read_message(
        self, kind: type[MessageT], timeout_s: float = MESSAGE_TIMEOUT_S
    ) -> MessageT:
        """Next message of a class; see `X4M300.read_message`."""
        return await self._listen(wait_for_message, kind, timeout_s)

    async def messages(
        self, count: int | None = None, timeout_s: float = MESSAGE_TIMEOUT_S
    ) -> AsyncIterator[Response]:
        """Iterate over what comes besides frames and answers; see `X4M300.messages`."""
        for _ in itertools.count() if count is None else range(count):
            yield await self.read_message(Response, timeout_s)

    # --- carrying out steps ---

    async def _call(self, procedure: Procedure[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
        """Carry out a procedure that sends commands; again after a reconnect, if that is on."""
        link = self._link
        return await self._run(reconnect.resilient(link, lambda: procedure(link, *args, **kwargs)))

    async def _call_once(
        self, procedure: Procedure[P, T], /, *args: P.args, **kwargs: P.kwargs
    ) -> T:
        return await self._run(procedure(self._link, *args, **kwargs))

    async def _listen(self, procedure: Procedure[P, T], /, *args: P.args, **kwargs: P.kwargs) -> T:
        """Carry out a procedure that only receives, beside one that sends; also repeated."""
        link = self._link
        if link.reconnect_s > 0 and not link.identified:
            await self._run(reconnect.identify(link))
        for _ in range(reconnect.RECONNECTS_PER_CALL):
            reconnects = link.reconnects
            try:
                return await self._carry(procedure(link, *args, **kwargs))
            except Disconnected as error:
                await self._run(reconnect.recover(link, reconnects, error))
        return await self._carry(procedure(link, *args, **kwargs))

    async def _run(self, procedure: Steps[T]) -> T:
        """Carry out a procedure that sends commands: no other may send before it is done."""
        self._refuse_reentry()
        async with self._one_at_a_time:
            return await self._carry(procedure)

    def _refuse_reentry(self) -> None:
        """Refuse to go on inside a callback, as event loops that can be nested make possible."""
        if self._at_work:
            raise reentry(self._link.name)

    async def _carry(self, procedure: Steps[T]) -> T:
        self._refuse_reentry()
        try:
            step = self._work(next, procedure)
            while True:
                try:
                    came = await self._carry_out(step)
                except BaseException as error:  # the procedure decides
                    step = self._work(procedure.throw, error)
                else:
                    step = self._work(procedure.send, came)
        except StopIteration as end:
            result: T = end.value
            return result

    def _work(self, work: Callable[[*Ts], T], *what: *Ts) -> T:
        self._at_work = True
        try:
            return work(*what)
        finally:
            self._at_work = False

    async def _carry_out(self, step: Step) -> bool:
        if isinstance(step, Read):  # the most frequent one, so without a match
            return await self._pump(step.timeout_s)
        match step:
            case Write(data):
                self._work(self._link.conversation.hear, "tx", data, self._link.clock())
                await self._transport.write(data)
            case Sleep(seconds):
                await self._sleep(seconds)
            case AwaitGate(gate, timeout_s):
                with suppress(TimeoutError):
                    async with asyncio.timeout(min(timeout_s, _LONGEST_WAIT_S)):
                        await gate.wait()
            case OpenLine(path, baudrate):
                self._transport.close()
                transport = self._open_port(path, baudrate)
                await _connect(transport)
                self._use(transport)
            case SetLineRate(baudrate):
                changing = set_rate(self._transport, baudrate)
                if inspect.isawaitable(changing):
                    await changing
                self._use(self._transport)
            case CloseLine():
                self._transport.close()
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
        self._work(self._link.receive, data, self._link.clock())
        return True


async def _connect(transport: Transport | AsyncTransport) -> None:
    """Connect now to what would connect at the first read or write."""
    connect = getattr(transport, "connect", None)
    if connect is not None:
        try:
            await connect()
        except BaseException:
            transport.close()
            raise

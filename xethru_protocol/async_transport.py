"""Bytes to and from a port for asyncio, without threads."""

import asyncio
from collections.abc import Callable
from typing import Protocol

from xethru_protocol.errors import Disconnected
from xethru_protocol.transport import SerialTransport

_WRITE_TIMEOUT_S = 5.0
_LONGEST_WAIT_S = 86400.0
_TURN_S = 0.005  # how long one task may read on while data never end


class AsyncTransport(Protocol):
    """What `AsyncX4M300` needs of a line to a module."""

    @property
    def name(self) -> str:
        """What to call this line in messages to people."""

    async def read(self, timeout_s: float) -> bytes:
        """Whatever has arrived, waiting up to ``timeout_s`` for the first byte; b"" if none.

        Raises `Disconnected` if the line is gone.
        """

    async def write(self, data: bytes) -> None:
        """Send all of ``data``; raises `Disconnected` if the line is gone."""

    def close(self) -> None:
        """Release the line; who reads from it gets `Disconnected`. May be called twice."""


class AsyncSerialTransport:
    """A serial port whose descriptor the running event loop watches; see `SerialTransport`."""

    def __init__(self, path: str, baudrate: int = 115200) -> None:
        self._port = SerialTransport(path, baudrate)
        self._waiting: set[_Waiting] = set()
        self._turn_ends_s = 0.0

    @property
    def name(self) -> str:
        """See `AsyncTransport.name`."""
        return self._port.name

    @property
    def bytes_per_s(self) -> float:
        """See `SerialTransport.bytes_per_s`."""
        return self._port.bytes_per_s

    def set_baudrate(self, baudrate: int) -> None:
        """See `SerialTransport.set_baudrate`."""
        self._port.set_baudrate(baudrate)

    async def read(self, timeout_s: float) -> bytes:
        """See `AsyncTransport.read`."""
        loop = asyncio.get_running_loop()
        if loop.time() > self._turn_ends_s:  # a line that never pauses: now the other tasks
            await asyncio.sleep(0)  # before reading: a task cancelled here must lose no bytes
            self._turn_ends_s = loop.time() + _TURN_S
        data = self._port.read(0.0)
        if data or timeout_s <= 0:
            return data
        ready = await self._wait(loop.add_reader, loop.remove_reader, timeout_s)
        self._turn_ends_s = loop.time() + _TURN_S
        return self._port.read(0.0) if ready else b""

    async def write(self, data: bytes) -> None:
        """See `AsyncTransport.write`."""
        loop = asyncio.get_running_loop()
        rest = memoryview(data)
        deadline_s = loop.time() + _WRITE_TIMEOUT_S
        while rest := rest[self._port.write_some(rest) :]:
            left_s = deadline_s - loop.time()
            if not await self._wait(loop.add_writer, loop.remove_writer, left_s):
                raise Disconnected(f"{self.name} takes no data any more; is the module hanging?")

    def close(self) -> None:
        """See `AsyncTransport.close`."""
        for waiting in tuple(self._waiting):
            waiting.unwatch()
            if not waiting.ready.done():
                waiting.ready.set_exception(Disconnected(f"{self.name} was closed"))
        self._port.close()

    async def _wait(
        self,
        watch: Callable[..., object],
        unwatch: Callable[[int], object],
        timeout_s: float,
    ) -> bool:
        """Wait until the descriptor is ready; False if it is not in time."""
        waiting = _Waiting(self._waiting, self._port.fileno(), unwatch)
        watch(waiting.descriptor, waiting.end, True)
        limit_s = min(max(timeout_s, 0.0), _LONGEST_WAIT_S)
        # half the cost of wait_for(), which a stream of frames would feel
        timer = asyncio.get_running_loop().call_later(limit_s, waiting.end, False)
        try:
            return await waiting.ready
        finally:
            timer.cancel()
            waiting.unwatch()


class _Waiting:
    """A task that waits for a descriptor, which must not be watched once it is closed."""

    def __init__(
        self, others: "set[_Waiting]", descriptor: int, unwatch: Callable[[int], object]
    ) -> None:
        self.descriptor = descriptor
        self.ready: asyncio.Future[bool] = asyncio.get_running_loop().create_future()
        self._others = others
        self._unwatch = unwatch
        others.add(self)

    def end(self, ready: bool) -> None:
        if not self.ready.done():
            self.ready.set_result(ready)

    def unwatch(self) -> None:
        if self in self._others:
            self._others.discard(self)
            self._unwatch(self.descriptor)

"""The same tests on both drivers: `AsyncX4M300` with an event loop around each call."""

import asyncio
import contextlib
import inspect
from collections.abc import Callable, Iterator
from typing import Any, Self, cast

from hil_tests.unit.xethru_protocol.scripted import Answer, PlainModule, ScriptedTransport
from xethru_protocol.driver.async_radar import AsyncX4M300
from xethru_protocol.driver.chip import AsyncSetting, Setting
from xethru_protocol.driver.link import Part
from xethru_protocol.driver.radar import X4M300, RadarState


class AsyncScripted:
    """A `ScriptedTransport` whose reads and writes are awaited."""

    def __init__(self, line: ScriptedTransport) -> None:
        self.line = line
        self.name = line.name

    async def read(self, timeout_s: float) -> bytes:
        await asyncio.sleep(0)
        return self.line.read(timeout_s)

    async def write(self, data: bytes) -> None:
        self.line.write(data)

    def close(self) -> None:
        self.line.close()

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - what only some lines have
        if name == "line":
            raise AttributeError(name)
        return getattr(self.line, name)


class Blocking:
    """Anything with coroutines, as if it had none."""

    def __init__(self, target: object, runner: asyncio.Runner) -> None:
        self.__dict__.update(target=target, runner=runner)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - anything
        """Member of the target, awaited if it must be."""
        value = getattr(self.target, name)
        if inspect.iscoroutinefunction(value):
            return lambda *args, **kwargs: self.runner.run(value(*args, **kwargs))
        if inspect.isasyncgenfunction(value):
            return lambda *args, **kwargs: self._iterate(value(*args, **kwargs))
        if isinstance(value, AsyncSetting):
            return self.runner.run(value.get())
        return Blocking(value, self.runner) if isinstance(value, Part) else value

    def __setattr__(self, name: str, value: object) -> None:
        if isinstance(getattr(type(self.target), name, None), Setting):
            self.runner.run(getattr(self.target, name).set(value))
        else:
            setattr(self.target, name, value)

    def __enter__(self) -> Self:
        self.runner.run(self.target.__aenter__())
        return self

    def __exit__(self, *reason: object) -> None:
        self.runner.run(self.target.__aexit__(*reason))

    def _iterate(self, items: Any) -> Iterator[Any]:  # noqa: ANN401 - an asynchronous generator
        async def take() -> Any:  # noqa: ANN401 - as above
            return await anext(items)

        while True:
            try:
                item = self.runner.run(take())
            except StopAsyncIteration:
                return
            yield item


Scripted = tuple[X4M300, ScriptedTransport]
DriverOn = Callable[..., Scripted]
"""Returns a driver and its line: the function below."""


@contextlib.contextmanager
def driver_factory(kind: str) -> Iterator[DriverOn]:
    """Give a maker of drivers; at the end they count as closed, whatever their modules do."""
    made: list[RadarState[Any, Any]] = []
    with asyncio.Runner() as runner:
        yield _maker(kind, runner, made)
    for radar in made:
        radar._link.closed = True


def _maker(kind: str, runner: asyncio.Runner, made: list[RadarState[Any, Any]]) -> DriverOn:
    def driver_on(
        answer: Answer | None = None,
        *,
        ports: dict[str, Callable[[int], ScriptedTransport]] | None = None,
        name: str = "the port",
        **options: Any,  # noqa: ANN401 - those of the drivers
    ) -> Scripted:
        """Return both; ``ports`` are those at which a reconnect may open a line."""
        line = ScriptedTransport(answer or PlainModule(), name)
        known = ports or {}

        def open_line(path: str, baudrate: int) -> ScriptedTransport:
            return known[path](baudrate)

        def pass_time(seconds: float) -> None:
            line.now_ns += round(seconds * 1e9)

        async def let_time_pass(seconds: float) -> None:
            pass_time(seconds)

        shared = {"clock": line.clock, "candidates": lambda: list(known), **options}
        if kind == "sync":
            made.append(X4M300(line, open_port=open_line, sleep=pass_time, **shared))
            return cast(X4M300, made[-1]), line
        awaited = AsyncX4M300(
            AsyncScripted(line),
            open_port=lambda path, baudrate: AsyncScripted(open_line(path, baudrate)),
            sleep=let_time_pass,
            **shared,
        )
        made.append(awaited)
        return cast(X4M300, Blocking(awaited, runner)), line

    return driver_on

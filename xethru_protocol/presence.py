"""The profile of a module as part of a driver: ``radar.presence``.

::

    with X4M300.open(port) as radar:
        radar.presence.load()
        zone_m = radar.presence.set_zone(0.4, 5.0)
        radar.presence.set_output(OutputFeature.PRESENCE_SINGLE)
        radar.presence.run()
        radar.presence.wait_until_initialized()
        for message in radar.presence.messages():
            ...
"""

from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from typing import Protocol, TypeVar

from xethru_protocol import profile_mode, reconnection
from xethru_protocol.core import RadarCore
from xethru_protocol.messages import Response
from xethru_protocol.profile_mode import MESSAGE_TIMEOUT_S
from xethru_protocol.steps import Procedure
from xethru_protocol.verbs import awaited, blocking

T = TypeVar("T")


class Run(Protocol):
    """Carries a procedure out."""

    def __call__(self, procedure: Procedure[T], /) -> T:
        """Return its result."""


class RunAsync(Protocol):
    """Carries a procedure out."""

    def __call__(self, procedure: Procedure[T], /) -> Awaitable[T]:
        """Await its result."""


class RunBeside(Protocol):
    """Carries a procedure out that only hears, beside others."""

    def __call__(self, procedure: Callable[[], Procedure[T]], /) -> Awaitable[T]:
        """Await its result."""


class Presence:
    """The profile of a module behind an `X4M300`."""

    def __init__(self, core: RadarCore, run: Run) -> None:
        self._core = core
        self._run = run

    load = blocking(profile_mode.load)
    profile_id = blocking(profile_mode.profile_id)

    # settings: after `load`, before `run`
    zone_limits = blocking(profile_mode.zone_limits)
    set_zone = blocking(profile_mode.set_zone)
    zone = blocking(profile_mode.zone)
    set_sensitivity = blocking(profile_mode.set_sensitivity)
    sensitivity = blocking(profile_mode.sensitivity)
    set_band = blocking(profile_mode.set_band)
    band = blocking(profile_mode.band)
    set_led = blocking(profile_mode.set_led)
    led = blocking(profile_mode.led)
    set_noise_map = blocking(profile_mode.set_noise_map)
    noise_map = blocking(profile_mode.noise_map)
    store_noise_map = blocking(profile_mode.store_noise_map)
    load_noise_map = blocking(profile_mode.load_noise_map)
    delete_noise_map = blocking(profile_mode.delete_noise_map)
    factory_preset = blocking(profile_mode.factory_preset)
    set_output = blocking(profile_mode.set_output)
    output = blocking(profile_mode.output)

    # running
    run = blocking(reconnection.run_profile)
    idle = blocking(profile_mode.idle)
    stop = blocking(profile_mode.stop)
    wait_until_initialized = blocking(profile_mode.wait_until_initialized)
    _next_message = blocking(profile_mode.wait_for_message)

    def messages(
        self, count: int | None = None, timeout_s: float = MESSAGE_TIMEOUT_S
    ) -> Iterator[Response]:
        """Iterate over what the module says of its own accord, but frames; `ResponseTimeout`."""
        while count is None or count > 0:
            yield self._next_message(timeout_s)
            if count is not None:
                count -= 1


class AsyncPresence:
    """The profile of a module behind an `AsyncX4M300`; methods as of `Presence`."""

    def __init__(self, core: RadarCore, run: RunAsync, run_beside: RunBeside) -> None:
        self._core = core
        self._run = run
        self._run_beside = run_beside

    load = awaited(profile_mode.load)
    profile_id = awaited(profile_mode.profile_id)

    # settings: after `load`, before `run`
    zone_limits = awaited(profile_mode.zone_limits)
    set_zone = awaited(profile_mode.set_zone)
    zone = awaited(profile_mode.zone)
    set_sensitivity = awaited(profile_mode.set_sensitivity)
    sensitivity = awaited(profile_mode.sensitivity)
    set_band = awaited(profile_mode.set_band)
    band = awaited(profile_mode.band)
    set_led = awaited(profile_mode.set_led)
    led = awaited(profile_mode.led)
    set_noise_map = awaited(profile_mode.set_noise_map)
    noise_map = awaited(profile_mode.noise_map)
    store_noise_map = awaited(profile_mode.store_noise_map)
    load_noise_map = awaited(profile_mode.load_noise_map)
    delete_noise_map = awaited(profile_mode.delete_noise_map)
    factory_preset = awaited(profile_mode.factory_preset)
    set_output = awaited(profile_mode.set_output)
    output = awaited(profile_mode.output)

    # running
    run = awaited(reconnection.run_profile)
    idle = awaited(profile_mode.idle)
    stop = awaited(profile_mode.stop)

    async def wait_until_initialized(self, timeout_s: float | None = None) -> Response:
        """See `Presence.wait_until_initialized`; other tasks may ask meanwhile."""
        return await self._run_beside(
            lambda: profile_mode.wait_until_initialized(self._core, timeout_s)
        )

    async def messages(
        self, count: int | None = None, timeout_s: float = MESSAGE_TIMEOUT_S
    ) -> AsyncIterator[Response]:
        """Iterate over what the module says of its own accord, but frames; `ResponseTimeout`."""
        while count is None or count > 0:
            yield await self._run_beside(
                lambda: profile_mode.wait_for_message(self._core, timeout_s)
            )
            if count is not None:
                count -= 1

"""A module with its profile alone, rooms with one person, and messages by virtual time."""

from collections.abc import Iterator
from typing import Any

from emulator.chip import Pace
from emulator.chip.chip import Chip, ModuleClock
from emulator.echo.echo import SceneEcho
from emulator.module.settings import DeviceOptions, ModelName, ProfileSettings
from emulator.module.state import Module
from emulator.profiles.running_profile import ProfileStream
from emulator.scene.people import PersonSpec
from emulator.scene.scene import LeakageSpec, NoiseSpec, Scene, empty_room
from hil_tests.unit.emulator.doubles import IDENTITY, RampSource
from xethru_protocol.wire import messages as m

SECOND = 1_000_000_000
DEFAULT_MAP = 6  # protocol reference 4.6: default map, no extra initialisation
FRAME_HZ = 17.049379  # protocol reference 9.6: what 17 frames/s really are
BIN_M = 8 * 1.5e8 / 23.328e9


def room(*people: PersonSpec, quiet: bool = False) -> Scene:
    """Return an empty room with people, with or without receiver noise and leakage."""
    changes: dict[str, Any] = {"people": people}
    if quiet:
        changes |= {"noise": NoiseSpec(rf_sigma=0.0), "leakage": LeakageSpec(amplitude=0.0)}
    return empty_room().model_copy(update=changes)


def standing(range_m: float, **changes: object) -> PersonSpec:
    return PersonSpec.model_validate(
        {"name": "somebody", "waypoints_m": ((range_m, 0.0),)} | changes
    )


def walking(start_m: float, end_m: float, **changes: object) -> PersonSpec:
    return PersonSpec.model_validate(
        {"name": "somebody", "waypoints_m": ((start_m, 0.0), (end_m, 0.0))} | changes
    )


def profile(
    scene: Scene,
    *,
    outputs: dict[int, int] | None = None,
    pace: Pace = Pace.REALTIME,
    zero_ns: int = 0,
    model: ModelName = "x4m300",
    **settings: Any,  # noqa: ANN401 - whatever ProfileSettings takes
) -> tuple[ProfileStream, Module]:
    module = Module(IDENTITY, Chip(RampSource()), DeviceOptions(model=model))
    shipped: dict[str, Any] = {"outputs": module.profile.outputs, "noise_map_control": DEFAULT_MAP}
    module.profile = ProfileSettings(**(shipped | settings))
    if outputs is not None:
        module.profile.outputs = outputs
    source = SceneEcho(scene, scene.radars[0], seed=1)
    stream = ProfileStream(
        module, source, pace=pace, clock=ModuleClock(), scene_time_zero_ns=zero_ns
    )
    return stream, module


def heard_until(stream: ProfileStream, end_ns: int) -> Iterator[tuple[float, m.Response]]:
    """Yield due time [s] and message of everything due before a time."""
    while (due_ns := stream.next_due_ns()) is not None and due_ns < end_ns:
        message = stream.take()
        if message is not None:
            yield due_ns / SECOND, message


def first_message(stream: ProfileStream) -> m.Response:
    return next(message for _, message in heard_until(stream, 10**18))


def presence_until(stream: ProfileStream, end_s: float) -> list[tuple[float, m.PresenceSingle]]:
    return [
        (due_s, message)
        for due_s, message in heard_until(stream, round(end_s * SECOND))
        if isinstance(message, m.PresenceSingle)
    ]

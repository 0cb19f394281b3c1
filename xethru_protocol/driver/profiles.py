"""Profiles of a module: load, set up, run; as part of a driver, ``radar.profile``.

::

    with X4M300.open(port) as radar:
        radar.profile.load()
        zone_m = radar.profile.set_zone(0.4, 5.0)
        radar.profile.set_output(OutputFeature.PRESENCE_SINGLE)
        radar.profile.run()
        radar.profile.wait_until_initialized()
        for message in radar.messages():
            ...
"""

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

from xethru_protocol.driver.conversation import FRAMES
from xethru_protocol.driver.link import (
    SLOW_TIMEOUT_S,
    AsyncCall,
    AsyncPart,
    Call,
    Link,
    Part,
    Steps,
)
from xethru_protocol.driver.reconnect import await_restart
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import (
    ErrorCode,
    LedMode,
    NoiseMapControl,
    OutputFeature,
    PresenceState,
    ProfileId,
    RespirationState,
    SensorMode,
)
from xethru_protocol.wire.errors import (
    DeviceError,
    LocalProtocolError,
    RemoteProtocolError,
    ResponseTimeout,
)

MessageT = TypeVar("MessageT", bound=m.Response)

MESSAGE_TIMEOUT_S = 3.0  # presence messages come once a second
_START_S = 20.0  # to fill the slow matrix
_NEW_MAP_S = 120.0  # where a noise map must be made first
_RESERVE_S = 5.0
_SMALLEST_ZONE_M = 0.20
_MAX_SENSITIVITY = 9
_SLACK_M = 1e-4  # limits come as float32
_WITH_STATE = (m.PresenceSingle, m.PresenceMovingList, m.RespStatus, m.SleepStatus, m.VitalSigns)
_INITIALIZING: Mapping[type[m.Response], int] = {
    kind: PresenceState.INITIALIZING if kind in _WITH_STATE[:2] else RespirationState.INITIALIZING
    for kind in _WITH_STATE
}


@dataclass(frozen=True, slots=True, kw_only=True)
class ZoneLimits:
    """Where a detection zone may begin and end, and the grid it is snapped to [m]."""

    min_m: float
    max_m: float
    step_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ProfilePlan:
    """A profile as the user wants it.

    ``loaded`` is False if it was found running. ``settings`` holds the last command for each
    setting, by what it sets; ``mode`` is None before the profile was run.
    """

    profile_id: int
    loaded: bool
    settings: Mapping[object, m.Command[m.Response]] = field(default_factory=dict)
    mode: int | None = None

    def restore(self, link: Link) -> Steps[None]:
        """Load, set up and run again."""
        if self.loaded:
            yield from _load(link, self.profile_id)
        for command in self.settings.values():
            yield from link.request(command)
        if self.mode is not None:
            yield from link.request(m.SetMode(mode=self.mode), SLOW_TIMEOUT_S)


def load(link: Link, profile_id: int = ProfileId.XTS_ID_APP_PRESENCE_2) -> Steps[None]:
    yield from link.wait_until_ready()
    yield from _load(link, profile_id)
    link.plan = ProfilePlan(profile_id=profile_id, loaded=True)
    waiting = keep_messages(link)
    texts = _texts(waiting)
    waiting.clear()  # those that wait are of what ran before
    waiting.extend(texts)


def _load(link: Link, profile_id: int) -> Steps[None]:
    yield from link.stop_profile()
    yield from link.request(m.LoadApp(profile_id=profile_id), SLOW_TIMEOUT_S)
    link.raw_mode = False


def profile_id(link: Link) -> Steps[int]:
    return (yield from _value(link, m.GetProfileId(), "profile")) & 0xFFFFFFFF


# --- settings: after `load`, before `run` -------------------------------------------------------


def zone_limits(link: Link) -> Steps[ZoneLimits]:
    yield from _need_profile(link)
    values = (yield from link.request(m.GetDetectionZoneLimits())).values
    if len(values) != 3:
        raise RemoteProtocolError(f"{link.path} reports zone limits {values}, not three numbers")
    return ZoneLimits(min_m=values[0], max_m=values[1], step_m=values[2])


def set_zone(link: Link, start_m: float, end_m: float) -> Steps[tuple[float, float]]:
    limits = yield from zone_limits(link)
    if not limits.min_m - _SLACK_M <= start_m < end_m <= limits.max_m + _SLACK_M:
        raise LocalProtocolError(
            f"detection zone {start_m:g} ... {end_m:g} m does not lie within "
            f"{limits.min_m:g} ... {limits.max_m:g} m"
        )
    if end_m - start_m < _SMALLEST_ZONE_M - _SLACK_M:
        raise LocalProtocolError(
            f"detection zone {start_m:g} ... {end_m:g} m is smaller than {_SMALLEST_ZONE_M} m"
        )
    yield from _set(link, m.SetDetectionZone(start_m=start_m, end_m=end_m))
    return (yield from zone(link))


def zone(link: Link) -> Steps[tuple[float, float]]:
    yield from _need_profile(link)
    values = (yield from link.request(m.GetDetectionZone())).values
    if len(values) != 2:
        raise RemoteProtocolError(f"{link.path} reports detection zone {values}, not two numbers")
    return values[0], values[1]


def set_sensitivity(link: Link, sensitivity: int) -> Steps[None]:
    if not 0 <= sensitivity <= _MAX_SENSITIVITY:
        raise LocalProtocolError(f"sensitivity must be 0 ... {_MAX_SENSITIVITY}, not {sensitivity}")
    yield from _set(link, m.SetSensitivity(sensitivity=sensitivity))


def set_band(link: Link, tx_center_frequency: int) -> Steps[None]:
    if tx_center_frequency not in {3, 4}:
        raise LocalProtocolError(f"band must be 3 (low) or 4 (high), not {tx_center_frequency}")
    yield from _set(link, m.SetTxCenterFrequency(tx_center_frequency=tx_center_frequency))


def led(link: Link) -> Steps[LedMode]:
    value = yield from _setting(link, m.AppGetLedControl(), "LED mode")
    try:
        return LedMode(value)
    except ValueError:
        raise RemoteProtocolError(
            f"{link.path} reports LED mode {value}, which does not exist"
        ) from None


def factory_preset(link: Link) -> Steps[None]:
    yield from link.request(m.FactoryPreset(), SLOW_TIMEOUT_S)
    if isinstance(link.plan, ProfilePlan):
        link.plan = replace(link.plan, settings={})


def output(link: Link, question: m.OutputGetControl | m.DebugOutputGetControl) -> Steps[int]:
    what = f"control of output {question.feature:08X}h"
    return (yield from _setting(link, question, what)) & 0xFFFFFFFF


def parameter_file(link: Link, name: str) -> Steps[str]:
    yield from _need_profile(link)
    reply = yield from link.request(m.GetParameterFile(name=name))
    match reply:
        case m.ReplyString(text=content) | m.ParameterFile(data=content):
            pass
        case m.ReplyByte(values=content):
            pass
    text = content if isinstance(content, str) else content.decode("latin-1")
    return text.rstrip("\0")


def set_parameter_file(link: Link, name: str, data: str | bytes) -> Steps[None]:
    yield from _need_profile(link)
    yield from link.request(m.SetParameterFile(name=name, data=data), SLOW_TIMEOUT_S)


# --- running ------------------------------------------------------------------------------------


def run(link: Link) -> Steps[None]:
    readies = link.conversation.readies
    try:
        yield from _set_mode(link, SensorMode.XTID_SM_RUN)
    except DeviceError as error:
        plan = link.plan
        if error.code != ErrorCode.XTS_SPRE_RESTARTING or not isinstance(plan, ProfilePlan):
            raise
        link.warn("the module restarts to change its profile")
        yield from await_restart(link, readies)
        plan = link.plan = replace(plan, mode=SensorMode.XTID_SM_RUN)
        yield from plan.restore(link)


def stop(link: Link) -> Steps[None]:
    yield from link.stop_profile()
    link.plan = None


def set_mode(link: Link, mode: SensorMode, parameter: int | None = None) -> Steps[None]:
    yield from link.request(m.SetMode(mode=mode, param=parameter), SLOW_TIMEOUT_S)
    plan = link.plan
    if mode in {SensorMode.XTID_SM_RUN, SensorMode.XTID_SM_IDLE} and isinstance(plan, ProfilePlan):
        link.plan = replace(plan, mode=mode)
        return
    link.plan = None  # nothing that this driver set up is sure to be there
    link.raw_mode = mode == SensorMode.XTID_SM_MANUAL


def wait_for_message(link: Link, kind: type[MessageT], timeout_s: float) -> Steps[MessageT]:
    """Take the oldest message of a kind; those of others stay."""
    waiting = _waiting(link, kind)

    def find() -> MessageT | None:
        return next((message for message in waiting if isinstance(message, kind)), None)

    if find() is None:
        yield from link.listen(lambda: find() is not None, timeout_s)
    message = find()
    if message is None:
        raise _no_message(link, timeout_s)
    waiting.remove(message)
    return message


def messages_waiting(link: Link, kind: type[m.Response]) -> Steps[int]:
    waiting = _waiting(link, kind)
    yield from link.take_stale_input()
    return sum(isinstance(message, kind) for message in waiting)


def wait_until_initialized(link: Link, timeout_s: float | None = None) -> Steps[m.Response]:
    limit_s = _starting_time_s(link) if timeout_s is None else timeout_s
    deadline_ns = link.conversation.deadline_ns(limit_s)
    waiting = keep_messages(link)
    texts: list[m.Response] = []
    try:
        while (left_s := link.left_s(deadline_ns)) > 0:
            wait_s = min(left_s, MESSAGE_TIMEOUT_S)
            if not waiting and not (yield from link.listen(lambda: bool(waiting), wait_s)):
                if wait_s == MESSAGE_TIMEOUT_S:
                    raise _no_message(link, wait_s)
                break
            message = waiting.popleft()
            if isinstance(message, _WITH_STATE) and message.state != _INITIALIZING[type(message)]:
                return message
            if isinstance(message, m.DataString):
                texts.append(message)
    finally:
        waiting.extendleft(reversed(texts))
    raise link.conversation.silence(
        "end of the profile's start", limit_s, "does the room keep it from settling?"
    )


def keep_messages(link: Link) -> deque[m.Response]:
    """From now on keep what the profile sends, and return where."""
    link.keeps_messages = True
    return link.messages


# --- inside -------------------------------------------------------------------------------------


def _waiting(link: Link, kind: type[m.Response]) -> deque[m.Response]:
    if kind in FRAMES:
        raise LocalProtocolError(f"{kind.__name__} comes as frames: read_frame(), frames_waiting()")
    return keep_messages(link)


def _texts(messages: Iterable[m.Response]) -> list[m.DataString]:
    return [message for message in messages if isinstance(message, m.DataString)]


def _starting_time_s(link: Link) -> float:
    plan = link.plan
    chosen = plan.settings.get(m.NoiseMapSetControl) if isinstance(plan, ProfilePlan) else None
    makes_map = not isinstance(chosen, m.NoiseMapSetControl) or bool(
        chosen.control & NoiseMapControl.NO_DEFAULT
    )
    return (_NEW_MAP_S if makes_map else _START_S) + _RESERVE_S


def _no_message(link: Link, timeout_s: float) -> ResponseTimeout:
    return link.conversation.silence(
        "message of the profile", timeout_s, "does it run, and is an output switched on?"
    )


def _set_mode(link: Link, mode: SensorMode) -> Steps[None]:
    yield from _need_profile(link)
    yield from link.request(m.SetMode(mode=mode), SLOW_TIMEOUT_S)
    if isinstance(link.plan, ProfilePlan):
        link.plan = replace(link.plan, mode=mode)


def _set(link: Link, command: m.Command[m.Ack]) -> Steps[None]:
    """Send a setting and remember it; the last of each kind counts."""
    yield from _need_profile(link)
    plan = link.plan
    try:
        yield from link.request(command)
    except DeviceError as error:
        if isinstance(plan, ProfilePlan) and (plan.mode is not None or not plan.loaded):
            error.add_note("a profile that was run refuses most settings: load() it, set, run()")
        raise
    if isinstance(plan, ProfilePlan):
        kind: object = type(command)
        if isinstance(command, m.OutputSetControl | m.DebugOutputSetControl):
            kind = (type(command), command.feature)
        kept = {key: value for key, value in plan.settings.items() if key != kind}
        link.plan = replace(plan, settings={**kept, kind: command})


def _need_profile(link: Link) -> Steps[None]:
    """Check that a profile is loaded: without one, some questions get no answer at all."""
    if isinstance(link.plan, ProfilePlan):
        return
    try:
        found = yield from profile_id(link)
    except DeviceError as error:
        raise LocalProtocolError(f"this module has no profiles: {error}") from error
    if found == ProfileId.XTS_ID_APP_NONE:
        raise LocalProtocolError("no profile is loaded; load() one first")
    link.plan = ProfilePlan(profile_id=found, loaded=False)


def _setting(link: Link, command: m.Command[m.ReplyByte | m.ReplyInt], what: str) -> Steps[int]:
    yield from _need_profile(link)
    return (yield from _value(link, command, what))


def _value(link: Link, command: m.Command[m.ReplyByte | m.ReplyInt], what: str) -> Steps[int]:
    values = (yield from link.request(command)).values
    if not values:
        raise RemoteProtocolError(f"{link.path} reports no value as its {what}")
    return values[0]


class Profile(Part):
    """The profile of a module behind an `X4M300`: load, set up, run.

    Presence on an X4M300, respiration and sleep on an X4M200. What it sends comes by
    `X4M300.messages`, its BASEBAND_IQ by `X4M300.frames`. The module takes settings from `load` on
    and refuses most of them while the profile runs.
    """

    __slots__ = ("_listen",)

    def __init__(self, call: Call, listen: Call) -> None:
        super().__init__(call)
        self._listen = listen

    def load(self, profile_id: int = ProfileId.XTS_ID_APP_PRESENCE_2) -> None:
        """Stop whatever runs and load a profile, not running yet, with its own last settings.

        Raises
        ------
        DeviceError
            If the module does not have it.
        """
        self._call(load, profile_id)

    def profile_id(self) -> int:
        """Ask which profile is loaded; 0 if none."""
        return self._call(profile_id)

    # --- settings: after `load`, before `run` ---

    def zone_limits(self) -> ZoneLimits:
        """Ask within which limits a detection zone may lie."""
        return self._call(zone_limits)

    def set_zone(self, start_m: float, end_m: float) -> tuple[float, float]:
        """Choose the detection zone; returns the one the module snapped it to [m].

        Raises
        ------
        LocalProtocolError
            If it is outside the limits the module reports, or smaller than 0.20 m.
        """
        return self._call(set_zone, start_m, end_m)

    def zone(self) -> tuple[float, float]:
        """Ask for the actual detection zone [m]."""
        return self._call(zone)

    def set_sensitivity(self, sensitivity: int) -> None:
        """Choose how little is enough to detect, 0 ... 9."""
        self._call(set_sensitivity, sensitivity)

    def sensitivity(self) -> int:
        return self._call(_setting, m.GetSensitivity(), "sensitivity")

    def set_band(self, tx_center_frequency: int) -> None:
        """Choose the band: 3 is 7.29 GHz (low), 4 is 8.748 GHz (high)."""
        self._call(set_band, tx_center_frequency)

    def band(self) -> int:
        """Ask for the band, 3 or 4."""
        return self._call(_setting, m.GetTxCenterFrequency(), "band")

    def set_led(self, mode: LedMode, intensity: int = 0) -> None:
        """Choose what the LED shows; released firmware ignores ``intensity`` 0 ... 100."""
        self._call(_set, m.AppSetLedControl(mode=mode, intensity=intensity))

    def led(self) -> LedMode:
        return self._call(led)

    def set_noise_map(self, control: NoiseMapControl) -> None:
        """Choose where the noise map comes from when the profile starts."""
        self._call(_set, m.NoiseMapSetControl(control=control))

    def noise_map(self) -> NoiseMapControl:
        value = self._call(_setting, m.NoiseMapGetControl(), "noise map control")
        return NoiseMapControl(value)

    def set_noise_map_interval(self, minutes: int) -> None:
        """Choose how often the running profile stores its noise map [min] (16)."""
        self._call(_set, m.NoiseMapSetPeriodicStore(interval_min=minutes))

    def noise_map_interval(self) -> int:
        """Ask how often the noise map is stored [min]."""
        return self._call(_setting, m.NoiseMapGetPeriodicStore(), "noise map interval")

    def store_noise_map(self) -> None:
        """Store the noise map for later starts."""
        self._call(Link.request, m.StoreNoiseMap(), SLOW_TIMEOUT_S)

    def load_noise_map(self) -> None:
        """Load the stored noise map; without effect in released firmware."""
        self._call(Link.request, m.LoadNoiseMap(), SLOW_TIMEOUT_S)

    def delete_noise_map(self) -> None:
        self._call(Link.request, m.DeleteNoiseMap(), SLOW_TIMEOUT_S)

    def factory_preset(self) -> None:
        """Set the profile back to its factory settings."""
        self._call(factory_preset)

    def set_output(self, feature: OutputFeature, control: int = 1) -> None:
        """Switch a message on or off.

        Parameters
        ----------
        feature
            BASEBAND_IQ messages come as frames, all others as messages. IQ and AMPLITUDE_PHASE
            exclude each other, so do FLOAT and BYTE of one matrix.
        control
            0 or 1; for pulse-Doppler and noise maps `MatrixControl` bits.
        """
        self._call(_set, m.OutputSetControl(feature=feature, control=control))

    def output(self, feature: OutputFeature) -> int:
        """Ask whether a message is on: its control bits."""
        return self._call(output, m.OutputGetControl(feature=feature))

    def set_debug_output(self, feature: OutputFeature, control: int = 1) -> None:
        """Switch a message on or off on the module's debug line; as `set_output`."""
        self._call(_set, m.DebugOutputSetControl(feature=feature, control=control))

    def debug_output(self, feature: OutputFeature) -> int:
        """Ask whether a message is on on the debug line: its control bits."""
        return self._call(output, m.DebugOutputGetControl(feature=feature))

    def set_parameter_file(self, name: str, data: str | bytes) -> None:
        """Store the profile's parameter file."""
        self._call(set_parameter_file, name, data)

    def parameter_file(self, name: str) -> str:
        """Read the profile's parameter file, one character per byte.

        Raises
        ------
        DeviceError
            If the module has no parameter file of this name.
        """
        return self._call(parameter_file, name)

    # --- running ---

    def run(self) -> None:
        """Run the loaded profile; the module saves its settings.

        A module that must restart to change its profile is waited for and set up again.
        """
        self._call(run)

    def idle(self) -> None:
        """Pause the profile; `run` resumes it."""
        self._call(_set_mode, SensorMode.XTID_SM_IDLE)

    def stop(self) -> None:
        """Stop and unload the profile."""
        self._call(stop)

    def wait_until_initialized(self, timeout_s: float | None = None) -> m.Response:
        """Wait until the profile reports more than that it is starting; returns that message.

        That is one of presence, respiration, sleep or vital signs; an output of one must be on.
        Other messages that come meanwhile are dropped, but for debug text.

        Parameters
        ----------
        timeout_s
            None: as long as this start may take, 20 s, or 120 s if a noise map must be made.

        Raises
        ------
        ResponseTimeout
            If it is still starting then, or sends nothing for seconds.
        """
        return self._listen(wait_until_initialized, timeout_s)


class AsyncProfile(AsyncPart):
    """The profile of a module behind an `AsyncX4M300`; methods as of `Profile`."""

    __slots__ = ("_listen",)

    def __init__(self, call: AsyncCall, listen: AsyncCall) -> None:
        super().__init__(call)
        self._listen = listen

    async def load(self, profile_id: int = ProfileId.XTS_ID_APP_PRESENCE_2) -> None:
        await self._call(load, profile_id)

    async def profile_id(self) -> int:
        return await self._call(profile_id)

    # --- settings: after `load`, before `run` ---

    async def zone_limits(self) -> ZoneLimits:
        return await self._call(zone_limits)

    async def set_zone(self, start_m: float, end_m: float) -> tuple[float, float]:
        return await self._call(set_zone, start_m, end_m)

    async def zone(self) -> tuple[float, float]:
        return await self._call(zone)

    async def set_sensitivity(self, sensitivity: int) -> None:
        await self._call(set_sensitivity, sensitivity)

    async def sensitivity(self) -> int:
        return await self._call(_setting, m.GetSensitivity(), "sensitivity")

    async def set_band(self, tx_center_frequency: int) -> None:
        await self._call(set_band, tx_center_frequency)

    async def band(self) -> int:
        return await self._call(_setting, m.GetTxCenterFrequency(), "band")

    async def set_led(self, mode: LedMode, intensity: int = 0) -> None:
        await self._call(_set, m.AppSetLedControl(mode=mode, intensity=intensity))

    async def led(self) -> LedMode:
        return await self._call(led)

    async def set_noise_map(self, control: NoiseMapControl) -> None:
        await self._call(_set, m.NoiseMapSetControl(control=control))

    async def noise_map(self) -> NoiseMapControl:
        value = await self._call(_setting, m.NoiseMapGetControl(), "noise map control")
        return NoiseMapControl(value)

    async def set_noise_map_interval(self, minutes: int) -> None:
        await self._call(_set, m.NoiseMapSetPeriodicStore(interval_min=minutes))

    async def noise_map_interval(self) -> int:
        return await self._call(_setting, m.NoiseMapGetPeriodicStore(), "noise map interval")

    async def store_noise_map(self) -> None:
        await self._call(Link.request, m.StoreNoiseMap(), SLOW_TIMEOUT_S)

    async def load_noise_map(self) -> None:
        await self._call(Link.request, m.LoadNoiseMap(), SLOW_TIMEOUT_S)

    async def delete_noise_map(self) -> None:
        await self._call(Link.request, m.DeleteNoiseMap(), SLOW_TIMEOUT_S)

    async def factory_preset(self) -> None:
        await self._call(factory_preset)

    async def set_output(self, feature: OutputFeature, control: int = 1) -> None:
        await self._call(_set, m.OutputSetControl(feature=feature, control=control))

    async def output(self, feature: OutputFeature) -> int:
        return await self._call(output, m.OutputGetControl(feature=feature))

    async def set_debug_output(self, feature: OutputFeature, control: int = 1) -> None:
        await self._call(_set, m.DebugOutputSetControl(feature=feature, control=control))

    async def debug_output(self, feature: OutputFeature) -> int:
        return await self._call(output, m.DebugOutputGetControl(feature=feature))

    async def set_parameter_file(self, name: str, data: str | bytes) -> None:
        await self._call(set_parameter_file, name, data)

    async def parameter_file(self, name: str) -> str:
        return await self._call(parameter_file, name)

    # --- running ---

    async def run(self) -> None:
        await self._call(run)

    async def idle(self) -> None:
        await self._call(_set_mode, SensorMode.XTID_SM_IDLE)

    async def stop(self) -> None:
        await self._call(stop)

    async def wait_until_initialized(self, timeout_s: float | None = None) -> m.Response:
        """See `Profile.wait_until_initialized`; other tasks may send commands meanwhile."""
        return await self._listen(wait_until_initialized, timeout_s)

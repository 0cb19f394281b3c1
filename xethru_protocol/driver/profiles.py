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
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

from xethru_protocol.driver.link import SLOW_TIMEOUT_S, KindT, Link, Part, Steps, receives, sends
from xethru_protocol.driver.matching import FRAMES, summary
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


class Profile(Part[KindT]):
    """The profile of a module: load, set up, run.

    Presence on an X4M300, respiration and sleep on an X4M200. What it sends comes by
    `X4M300.messages`, its BASEBAND_IQ by `X4M300.frames`. The module takes settings from `load` on
    and refuses most of them while the profile runs.
    """

    __slots__ = ()

    @sends
    def load(link: Link, profile_id: int = ProfileId.XTS_ID_APP_PRESENCE_2) -> Steps[None]:
        """Stop whatever runs and load a profile, not running yet, with its own last settings.

        Raises
        ------
        DeviceError
            If the module does not have it.
        """
        yield from link.wait_until_ready()
        yield from _load(link, profile_id)
        link.plan = ProfilePlan(profile_id=profile_id, loaded=True)
        waiting = keep_messages(link)
        texts = [message for message in waiting if isinstance(message, m.DataString)]
        waiting.clear()  # those that wait are of what ran before
        waiting.extend(texts)

    @sends
    def profile_id(link: Link) -> Steps[int]:
        """Ask which profile is loaded; 0 if none."""
        return _profile_id(link)

    # --- settings: after `load`, before `run` ---

    @sends
    def zone_limits(link: Link) -> Steps[ZoneLimits]:
        """Ask within which limits a detection zone may lie."""
        return _zone_limits(link)

    @sends
    def set_zone(link: Link, start_m: float, end_m: float) -> Steps[tuple[float, float]]:
        """Choose the detection zone; returns the one the module snapped it to [m].

        Raises
        ------
        LocalProtocolError
            If it is outside the limits the module reports, or smaller than 0.20 m.
        """
        limits = yield from _zone_limits(link)
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
        return (yield from _zone(link))

    @sends
    def zone(link: Link) -> Steps[tuple[float, float]]:
        """Ask for the actual detection zone [m]."""
        return _zone(link)

    @sends
    def set_sensitivity(link: Link, sensitivity: int) -> Steps[None]:
        """Choose how little is enough to detect, 0 ... 9."""
        if not 0 <= sensitivity <= _MAX_SENSITIVITY:
            raise LocalProtocolError(
                f"sensitivity must be 0 ... {_MAX_SENSITIVITY}, not {sensitivity}"
            )
        yield from _set(link, m.SetSensitivity(sensitivity=sensitivity))

    @sends
    def sensitivity(link: Link) -> Steps[int]:
        return _setting(link, m.GetSensitivity())

    @sends
    def set_band(link: Link, tx_center_frequency: int) -> Steps[None]:
        """Choose the band: 3 is 7.29 GHz (low), 4 is 8.748 GHz (high)."""
        if tx_center_frequency not in {3, 4}:
            raise LocalProtocolError(f"band must be 3 (low) or 4 (high), not {tx_center_frequency}")
        yield from _set(link, m.SetTxCenterFrequency(tx_center_frequency=tx_center_frequency))

    @sends
    def band(link: Link) -> Steps[int]:
        """Ask for the band, 3 or 4."""
        return _setting(link, m.GetTxCenterFrequency())

    @sends
    def set_led(link: Link, mode: LedMode, intensity: int = 0) -> Steps[None]:
        """Choose what the LED shows; released firmware ignores ``intensity`` 0 ... 100."""
        return _set(link, m.AppSetLedControl(mode=mode, intensity=intensity))

    @sends
    def led(link: Link) -> Steps[LedMode]:
        value = yield from _setting(link, m.AppGetLedControl())
        try:
            return LedMode(value)
        except ValueError:
            raise RemoteProtocolError(
                f"{link.path} reports LED mode {value}, which does not exist"
            ) from None

    @sends
    def set_noise_map(link: Link, control: NoiseMapControl) -> Steps[None]:
        """Choose where the noise map comes from when the profile starts."""
        return _set(link, m.NoiseMapSetControl(control=control))

    @sends
    def noise_map(link: Link) -> Steps[NoiseMapControl]:
        value = yield from _setting(link, m.NoiseMapGetControl())
        return NoiseMapControl(value)

    @sends
    def set_noise_map_interval(link: Link, minutes: int) -> Steps[None]:
        """Choose how often the running profile stores its noise map [min] (16)."""
        return _set(link, m.NoiseMapSetPeriodicStore(interval_min=minutes))

    @sends
    def noise_map_interval(link: Link) -> Steps[int]:
        """Ask how often the noise map is stored [min]."""
        return _setting(link, m.NoiseMapGetPeriodicStore())

    @sends
    def store_noise_map(link: Link) -> Steps[None]:
        """Store the noise map for later starts."""
        yield from link.request(m.StoreNoiseMap(), SLOW_TIMEOUT_S)

    @sends
    def load_noise_map(link: Link) -> Steps[None]:
        """Load the stored noise map; without effect in released firmware."""
        yield from link.request(m.LoadNoiseMap(), SLOW_TIMEOUT_S)

    @sends
    def delete_noise_map(link: Link) -> Steps[None]:
        yield from link.request(m.DeleteNoiseMap(), SLOW_TIMEOUT_S)

    @sends
    def factory_preset(link: Link) -> Steps[None]:
        """Set the profile back to its factory settings."""
        yield from link.request(m.FactoryPreset(), SLOW_TIMEOUT_S)
        if isinstance(link.plan, ProfilePlan):
            link.plan = replace(link.plan, settings={})

    @sends
    def set_output(link: Link, feature: OutputFeature, control: int = 1) -> Steps[None]:
        """Switch a message on or off.

        Parameters
        ----------
        feature
            BASEBAND_IQ messages come as frames, all others as messages. IQ and AMPLITUDE_PHASE
            exclude each other, so do FLOAT and BYTE of one matrix.
        control
            0 or 1; for pulse-Doppler and noise maps `MatrixControl` bits.
        """
        return _set(link, m.OutputSetControl(feature=feature, control=control))

    @sends
    def output(link: Link, feature: OutputFeature) -> Steps[int]:
        """Ask whether a message is on: its control bits."""
        return _output(link, m.OutputGetControl(feature=feature))

    @sends
    def set_debug_output(link: Link, feature: OutputFeature, control: int = 1) -> Steps[None]:
        """Switch a message on or off on the module's debug line; as `set_output`."""
        return _set(link, m.DebugOutputSetControl(feature=feature, control=control))

    @sends
    def debug_output(link: Link, feature: OutputFeature) -> Steps[int]:
        """Ask whether a message is on on the debug line: its control bits."""
        return _output(link, m.DebugOutputGetControl(feature=feature))

    @sends
    def set_parameter_file(link: Link, name: str, data: str | bytes) -> Steps[None]:
        """Store the profile's parameter file."""
        yield from _need_profile(link)
        yield from link.request(m.SetParameterFile(name=name, data=data), SLOW_TIMEOUT_S)

    @sends
    def parameter_file(link: Link, name: str) -> Steps[str]:
        """Read the profile's parameter file, one character per byte.

        Raises
        ------
        DeviceError
            If the module has no parameter file of this name.
        """
        yield from _need_profile(link)
        reply = yield from link.request(m.GetParameterFile(name=name))
        match reply:
            case m.ReplyString(text=content) | m.ParameterFile(data=content):
                pass
            case m.ReplyByte(values=content):
                pass
        text = content if isinstance(content, str) else content.decode("latin-1")
        return text.rstrip("\0")

    # --- running ---

    @sends
    def run(link: Link) -> Steps[None]:
        """Run the loaded profile; the module saves its settings.

        A module that must restart to change its profile is waited for and set up again.
        """
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

    @sends
    def idle(link: Link) -> Steps[None]:
        """Pause the profile; `run` resumes it."""
        return _set_mode(link, SensorMode.XTID_SM_IDLE)

    @sends
    def stop(link: Link) -> Steps[None]:
        """Stop and unload the profile."""
        yield from link.stop_profile()
        link.plan = None

    @receives
    def wait_until_initialized(link: Link, timeout_s: float | None = None) -> Steps[m.Response]:
        """Wait until the profile reports more than that it is starting; returns that message.

        That is one of presence, respiration, sleep or vital signs; an output of one must be on.
        Other messages that come meanwhile are dropped, but for debug text. Other tasks or threads
        may send commands meanwhile.

        Parameters
        ----------
        timeout_s
            None: as long as this start may take, 20 s, or 120 s if a noise map must be made.

        Raises
        ------
        ResponseTimeout
            If it is still starting then, or sends nothing for seconds.
        """
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
                if (
                    isinstance(message, _WITH_STATE)
                    and message.state != _INITIALIZING[type(message)]
                ):
                    return message
                if isinstance(message, m.DataString):
                    texts.append(message)
        finally:
            waiting.extendleft(reversed(texts))
        raise link.conversation.silence(
            "end of the profile's start", limit_s, "does the room keep it from settling?"
        )


def _load(link: Link, profile_id: int) -> Steps[None]:
    yield from link.stop_profile()
    yield from link.request(m.LoadApp(profile_id=profile_id), SLOW_TIMEOUT_S)
    link.raw_mode = False


def _profile_id(link: Link) -> Steps[int]:
    return (yield from _value(link, m.GetProfileId())) & 0xFFFFFFFF


def _zone_limits(link: Link) -> Steps[ZoneLimits]:
    yield from _need_profile(link)
    min_m, max_m, step_m = yield from link.numbers(m.GetDetectionZoneLimits(), 3)
    return ZoneLimits(min_m=min_m, max_m=max_m, step_m=step_m)


def _zone(link: Link) -> Steps[tuple[float, float]]:
    yield from _need_profile(link)
    start_m, end_m = yield from link.numbers(m.GetDetectionZone(), 2)
    return start_m, end_m


def _output(link: Link, question: m.OutputGetControl | m.DebugOutputGetControl) -> Steps[int]:
    return (yield from _setting(link, question)) & 0xFFFFFFFF


# --- modes and messages -------------------------------------------------------------------------


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

    deadline_ns = link.conversation.deadline_ns(timeout_s)
    with link.turn(kind) as turn:
        yield from turn.come(lambda: link.left_s(deadline_ns))
        if find() is None:
            yield from link.listen(lambda: find() is not None, link.left_s(deadline_ns))
        message = find()
        if message is None:
            raise _no_message(link, timeout_s)
        waiting.remove(message)
        return message


def messages_waiting(link: Link, kind: type[m.Response]) -> Steps[int]:
    waiting = _waiting(link, kind)
    yield from link.take_stale_input()
    return sum(isinstance(message, kind) for message in waiting)


def keep_messages(link: Link) -> deque[m.Response]:
    """From now on keep what the profile sends, and return where."""
    link.keeps_messages = True
    return link.messages


def _waiting(link: Link, kind: type[m.Response]) -> deque[m.Response]:
    if kind in FRAMES:
        raise LocalProtocolError(f"{kind.__name__} comes as frames: read_frame(), frames_waiting()")
    return keep_messages(link)


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
    yield from set_mode(link, mode)


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
        found = yield from _profile_id(link)
    except DeviceError as error:
        raise LocalProtocolError(f"this module has no profiles: {error}") from error
    if found == ProfileId.XTS_ID_APP_NONE:
        raise LocalProtocolError("no profile is loaded; load() one first")
    link.plan = ProfilePlan(profile_id=found, loaded=False)


def _setting(link: Link, command: m.Command[m.ReplyByte | m.ReplyInt]) -> Steps[int]:
    yield from _need_profile(link)
    return (yield from _value(link, command))


def _value(link: Link, command: m.Command[m.ReplyByte | m.ReplyInt]) -> Steps[int]:
    values = (yield from link.request(command)).values
    if not values:
        raise RemoteProtocolError(f"{link.name} answers {summary(command)} without a value")
    return values[0]

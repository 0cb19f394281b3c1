"""Profiles of a module: load, set up, run, receive."""

from collections import deque
from dataclasses import dataclass, replace

from xethru_protocol.driver.link import (
    SLOW_TIMEOUT_S,
    Procedure,
    ProfilePlan,
    RadarCore,
    listen,
    request,
    wait_until_ready,
)
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import (
    LedMode,
    NoiseMapControl,
    OutputFeature,
    PresenceState,
    ProfileId,
    SensorMode,
)
from xethru_protocol.wire.errors import (
    DeviceError,
    LocalProtocolError,
    RemoteProtocolError,
    ResponseTimeout,
)

MESSAGE_TIMEOUT_S = 3.0  # presence messages come once a second
_START_S = 20.0  # to fill the slow matrix
_NEW_MAP_S = 120.0  # where a noise map must be made first
_RESERVE_S = 5.0
_SMALLEST_ZONE_M = 0.20
_MAX_SENSITIVITY = 9
_SLACK_M = 1e-4  # limits come as float32


@dataclass(frozen=True, slots=True, kw_only=True)
class ZoneLimits:
    """Where a detection zone may begin and end, and the grid it is snapped to [m]."""

    min_m: float
    max_m: float
    step_m: float


def load(core: RadarCore, profile_id: int = ProfileId.XTS_ID_APP_PRESENCE_2) -> Procedure[None]:
    """Stop whatever runs and load a profile, not running yet, with its own last settings.

    Raises
    ------
    DeviceError
        If the module does not have it.
    """
    yield from wait_until_ready(core)
    yield from _load(core, profile_id)
    core.plan = ProfilePlan(profile_id=profile_id, loaded=True)
    hear_messages(core).clear()  # those that wait are of what ran before


def _load(core: RadarCore, profile_id: int) -> Procedure[None]:
    yield from request(core, m.SetMode(mode=SensorMode.XTID_SM_STOP), SLOW_TIMEOUT_S)
    yield from request(core, m.LoadApp(profile_id=profile_id), SLOW_TIMEOUT_S)
    core.raw_mode = False


def profile_id(core: RadarCore) -> Procedure[int]:
    """Ask which profile is loaded; 0 if none."""
    values = (yield from request(core, m.GetProfileId())).values
    return _first(core, values, "profile") & 0xFFFFFFFF


def apply_plan(core: RadarCore, plan: ProfilePlan) -> Procedure[None]:
    """Load, set up and run as planned."""
    if plan.loaded:
        yield from _load(core, plan.profile_id)
    for command in plan.settings.values():
        yield from request(core, command)
    if plan.mode is not None:
        yield from request(core, m.SetMode(mode=plan.mode), SLOW_TIMEOUT_S)


# --- settings: after `load`, before `run` -------------------------------------------------------


def zone_limits(core: RadarCore) -> Procedure[ZoneLimits]:
    """Ask within which limits a detection zone may lie."""
    yield from _need_profile(core)
    values = (yield from request(core, m.GetDetectionZoneLimits())).values
    if len(values) != 3:
        raise RemoteProtocolError(f"{core.path} tells zone limits {values}, not three numbers")
    return ZoneLimits(min_m=values[0], max_m=values[1], step_m=values[2])


def set_zone(core: RadarCore, start_m: float, end_m: float) -> Procedure[tuple[float, float]]:
    """Choose the detection zone; returns the one the module snapped it to [m].

    Raises
    ------
    LocalProtocolError
        If it leaves the limits the module tells, or is smaller than 0.20 m.
    """
    limits = yield from zone_limits(core)
    if not limits.min_m - _SLACK_M <= start_m < end_m <= limits.max_m + _SLACK_M:
        raise LocalProtocolError(
            f"detection zone {start_m:g} ... {end_m:g} m does not lie within "
            f"{limits.min_m:g} ... {limits.max_m:g} m"
        )
    if end_m - start_m < _SMALLEST_ZONE_M - _SLACK_M:
        raise LocalProtocolError(
            f"detection zone {start_m:g} ... {end_m:g} m is smaller than {_SMALLEST_ZONE_M} m"
        )
    yield from _set(core, m.SetDetectionZone(start_m=start_m, end_m=end_m))
    return (yield from zone(core))


def zone(core: RadarCore) -> Procedure[tuple[float, float]]:
    """Ask for the actual detection zone [m]."""
    yield from _need_profile(core)
    values = (yield from request(core, m.GetDetectionZone())).values
    if len(values) != 2:
        raise RemoteProtocolError(f"{core.path} tells detection zone {values}, not two numbers")
    return values[0], values[1]


def set_sensitivity(core: RadarCore, sensitivity: int) -> Procedure[None]:
    """Choose how little is enough to detect, 0 ... 9."""
    if not 0 <= sensitivity <= _MAX_SENSITIVITY:
        raise LocalProtocolError(f"sensitivity must be 0 ... {_MAX_SENSITIVITY}, not {sensitivity}")
    yield from _set(core, m.SetSensitivity(sensitivity=sensitivity))


def sensitivity(core: RadarCore) -> Procedure[int]:
    """Ask for the sensitivity."""
    yield from _need_profile(core)
    return _first(core, (yield from request(core, m.GetSensitivity())).values, "sensitivity")


def set_band(core: RadarCore, tx_center_frequency: int) -> Procedure[None]:
    """Choose the band: 3 is 7.29 GHz (low), 4 is 8.748 GHz (high)."""
    if tx_center_frequency not in {3, 4}:
        raise LocalProtocolError(f"band must be 3 (low) or 4 (high), not {tx_center_frequency}")
    yield from _set(core, m.SetTxCenterFrequency(tx_center_frequency=tx_center_frequency))


def band(core: RadarCore) -> Procedure[int]:
    """Ask for the band, 3 or 4."""
    yield from _need_profile(core)
    return _first(core, (yield from request(core, m.GetTxCenterFrequency())).values, "band")


def set_led(core: RadarCore, mode: LedMode, intensity: int = 0) -> Procedure[None]:
    """Choose what the LED shows; released firmware ignores ``intensity`` 0 ... 100."""
    yield from _set(core, m.AppSetLedControl(mode=mode, intensity=intensity))


def led(core: RadarCore) -> Procedure[LedMode]:
    """Ask what the LED shows."""
    yield from _need_profile(core)
    value = _first(core, (yield from request(core, m.AppGetLedControl())).values, "LED mode")
    try:
        return LedMode(value)
    except ValueError:
        raise RemoteProtocolError(f"{core.path} tells LED mode {value}; there is none") from None


def set_noise_map(core: RadarCore, control: NoiseMapControl) -> Procedure[None]:
    """Choose where the noise map comes from when the profile starts."""
    yield from _set(core, m.NoiseMapSetControl(control=control))


def noise_map(core: RadarCore) -> Procedure[NoiseMapControl]:
    """Ask where the noise map comes from."""
    yield from _need_profile(core)
    values = (yield from request(core, m.NoiseMapGetControl())).values
    return NoiseMapControl(_first(core, values, "noise map control"))


def store_noise_map(core: RadarCore) -> Procedure[None]:
    """Store the noise map for later starts."""
    yield from request(core, m.StoreNoiseMap(), SLOW_TIMEOUT_S)


def load_noise_map(core: RadarCore) -> Procedure[None]:
    """Load the stored noise map; without effect in released firmware."""
    yield from request(core, m.LoadNoiseMap(), SLOW_TIMEOUT_S)


def delete_noise_map(core: RadarCore) -> Procedure[None]:
    """Delete the stored noise map."""
    yield from request(core, m.DeleteNoiseMap(), SLOW_TIMEOUT_S)


def factory_preset(core: RadarCore) -> Procedure[None]:
    """Set the profile back to its factory settings."""
    yield from request(core, m.FactoryPreset(), SLOW_TIMEOUT_S)
    if isinstance(core.plan, ProfilePlan):
        core.plan = replace(core.plan, settings={})


def set_output(core: RadarCore, feature: OutputFeature, control: int = 1) -> Procedure[None]:
    """Switch a message on or off.

    Parameters
    ----------
    feature
        BASEBAND_IQ messages come as frames, all others as messages. IQ and AMPLITUDE_PHASE
        exclude each other, so do FLOAT and BYTE of one matrix.
    control
        0 or 1; for pulse-Doppler and noise maps `MatrixControl` bits.
    """
    yield from _set(core, m.OutputSetControl(feature=feature, control=control))


def output(core: RadarCore, feature: OutputFeature) -> Procedure[int]:
    """Ask whether a message is on: its control bits."""
    values = (yield from request(core, m.OutputGetControl(feature=feature))).values
    return _first(core, values, f"the control of output {feature:#x}") & 0xFFFFFFFF


# --- running ------------------------------------------------------------------------------------


def run(core: RadarCore) -> Procedure[None]:
    """Run the loaded profile; its settings are saved in the module by that."""
    yield from _set_mode(core, SensorMode.XTID_SM_RUN)


def idle(core: RadarCore) -> Procedure[None]:
    """Pause the profile; `run` resumes it."""
    yield from _set_mode(core, SensorMode.XTID_SM_IDLE)


def stop(core: RadarCore) -> Procedure[None]:
    """Stop and unload the profile."""
    yield from request(core, m.SetMode(mode=SensorMode.XTID_SM_STOP), SLOW_TIMEOUT_S)
    core.plan = None


def wait_for_message(core: RadarCore, timeout_s: float) -> Procedure[m.Response]:
    """Take the next message of the profile.

    Raises
    ------
    ResponseTimeout
        If none comes in time.
    """
    waiting = hear_messages(core)
    if not waiting and not (yield from listen(core, lambda: bool(waiting), timeout_s)):
        raise _no_message(core, timeout_s)
    return waiting.popleft()


def wait_until_initialized(
    core: RadarCore, timeout_s: float | None = None
) -> Procedure[m.Response]:
    """Wait until the profile says more than that it is starting; returns that first message.

    Messages of other kinds that come meanwhile are dropped.

    Parameters
    ----------
    timeout_s
        None: as long as this start may take, 20 s, or 120 s if a noise map must be made.

    Raises
    ------
    ResponseTimeout
        If it is still starting then, or says nothing for seconds.
    """
    limit_s = _starting_time_s(core) if timeout_s is None else timeout_s
    deadline_ns = core.conversation.deadline_ns(limit_s)
    waiting = hear_messages(core)
    while (left_s := core.left_s(deadline_ns)) > 0:
        wait_s = min(left_s, MESSAGE_TIMEOUT_S)
        if not waiting and not (yield from listen(core, lambda: bool(waiting), wait_s)):
            if wait_s == MESSAGE_TIMEOUT_S:
                raise _no_message(core, wait_s)
            break
        message = waiting.popleft()
        if isinstance(message, m.PresenceSingle | m.PresenceMovingList) and (
            message.state != PresenceState.INITIALIZING
        ):
            return message
    raise core.conversation.silence(
        "end of the profile's start", limit_s, "does the room keep it from settling?"
    )


def hear_messages(core: RadarCore) -> deque[m.Response]:
    """From now on keep what the profile says, and return where."""
    if core.messages is None:
        core.messages = deque()
    return core.messages


# --- inside -------------------------------------------------------------------------------------


def _starting_time_s(core: RadarCore) -> float:
    plan = core.plan
    chosen = plan.settings.get(m.NoiseMapSetControl) if isinstance(plan, ProfilePlan) else None
    makes_map = not isinstance(chosen, m.NoiseMapSetControl) or bool(
        chosen.control & NoiseMapControl.NO_DEFAULT
    )
    return (_NEW_MAP_S if makes_map else _START_S) + _RESERVE_S


def _no_message(core: RadarCore, timeout_s: float) -> ResponseTimeout:
    return core.conversation.silence(
        "message of the profile", timeout_s, "does it run, and is an output switched on?"
    )


def _set_mode(core: RadarCore, mode: SensorMode) -> Procedure[None]:
    yield from _need_profile(core)
    yield from request(core, m.SetMode(mode=mode), SLOW_TIMEOUT_S)
    if isinstance(core.plan, ProfilePlan):
        core.plan = replace(core.plan, mode=mode)


def _set(core: RadarCore, command: m.Command[m.Ack]) -> Procedure[None]:
    """Send a setting and remember it; the last of each kind counts."""
    yield from _need_profile(core)
    yield from request(core, command)
    plan = core.plan
    if isinstance(plan, ProfilePlan):
        kind: object = type(command)
        if isinstance(command, m.OutputSetControl):
            kind = (m.OutputSetControl, command.feature)
        kept = {key: value for key, value in plan.settings.items() if key != kind}
        core.plan = replace(plan, settings={**kept, kind: command})


def _need_profile(core: RadarCore) -> Procedure[None]:
    """Check that a profile is loaded: without one, some questions get no answer at all."""
    if isinstance(core.plan, ProfilePlan):
        return
    try:
        found = yield from profile_id(core)
    except DeviceError as error:
        raise LocalProtocolError(f"this module has no profiles: {error}") from error
    if found == ProfileId.XTS_ID_APP_NONE:
        raise LocalProtocolError("no profile is loaded; load() one first")
    core.plan = ProfilePlan(profile_id=found, loaded=False)


def _first(core: RadarCore, values: bytes | tuple[int, ...], what: str) -> int:
    if not values:
        raise RemoteProtocolError(f"{core.path} tells its {what} as nothing")
    return values[0]

"""The mode machine of an X4M300, and which commands it takes in which state.

``python -m emulator.module.modes`` prints `TRANSITIONS` as a Mermaid state diagram. Assumed: MANUAL
and REG unload the profile (their GETs answer as if none were loaded); IDLE pauses a profile that
was loaded but never run, and is refused like RUN when none is loaded.

Rows and columns of `PERMISSIONS` are those of protocol reference 8.3, with columns for
certification mode (as MANUAL), the bare base firmware (2) and the bootloader added, whose own
commands `emulator.module.bootloader` answers.

Source: protocol reference 2, 4.2, 4.3, 8.2, 8.3 and 8.5.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from emulator.chip.chip import Refusal, Silence
from emulator.module.settings import (
    BUSY_PROFILE,
    RUN_WITHOUT_PROFILE,
    VOLATILE,
    DeviceOptions,
    ProductModel,
)
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import ErrorCode, ProfileId, SensorMode


class ModuleState(Enum):
    """What a module is doing, as far as commands can tell."""

    RUN = "profile runs"
    IDLE = "profile paused"
    LOADED = "stopped, profile loaded"
    STOPPED = "stopped, no profile"
    MANUAL = "raw radar"
    REG = "certification"
    XEP = "base firmware"
    SAFE = "safe mode"
    BOOTLOADER = "bootloader"


class Request(Enum):
    """What asks for another state."""

    RUN = "SETMODE RUN"
    IDLE = "SETMODE IDLE"
    MANUAL = "SETMODE MANUAL"
    STOP = "SETMODE STOP"
    REG = "SETMODE REG"
    LOAD = "LOADAPP"


_ANYWHERE = {
    Request.STOP: ModuleState.STOPPED,
    Request.LOAD: ModuleState.LOADED,
    Request.REG: ModuleState.REG,
}
_WITH_PROFILE = {Request.RUN: ModuleState.RUN, Request.IDLE: ModuleState.IDLE}
_RAW = {Request.MANUAL: ModuleState.MANUAL}

TRANSITIONS: dict[ModuleState, dict[Request, ModuleState]] = {
    ModuleState.RUN: _ANYWHERE | _WITH_PROFILE | _RAW,
    ModuleState.IDLE: _ANYWHERE | _WITH_PROFILE | _RAW,
    ModuleState.LOADED: _ANYWHERE | _WITH_PROFILE | _RAW,
    ModuleState.STOPPED: _ANYWHERE | _RAW,
    ModuleState.MANUAL: _ANYWHERE | _RAW,
    ModuleState.REG: _ANYWHERE | _RAW,
}
"""The machine of the sensor firmware; without a profile, RUN and IDLE are refused.

The other states know no modes.
"""

_REQUESTS: dict[int, Request] = {
    SensorMode.XTID_SM_RUN: Request.RUN,
    SensorMode.XTID_SM_IDLE: Request.IDLE,
    SensorMode.XTID_SM_MANUAL: Request.MANUAL,
    SensorMode.XTID_SM_STOP: Request.STOP,
    SensorMode.XTID_SM_REG: Request.REG,
}
_MODES: dict[ModuleState, SensorMode] = {
    ModuleState.RUN: SensorMode.XTID_SM_RUN,
    ModuleState.IDLE: SensorMode.XTID_SM_IDLE,
    ModuleState.LOADED: SensorMode.XTID_SM_STOP,
    ModuleState.STOPPED: SensorMode.XTID_SM_STOP,
    ModuleState.MANUAL: SensorMode.XTID_SM_MANUAL,
    ModuleState.REG: SensorMode.XTID_SM_REG,
    # without modes a module streams its radar frames, as in MANUAL
    ModuleState.XEP: SensorMode.XTID_SM_MANUAL,
    ModuleState.SAFE: SensorMode.XTID_SM_MANUAL,
    ModuleState.BOOTLOADER: SensorMode.XTID_SM_STOP,
}


STREAMING = frozenset(s for s, mode in _MODES.items() if mode is SensorMode.XTID_SM_MANUAL)
"""States in which radar frames go to the host."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """What a module remembers over a reset: the state to enter (RUN, STOPPED), a profile.

    The default is a stock X4M300, whose profile runs.
    """

    state: ModuleState = ModuleState.RUN
    profile_id: int = int(ProfileId.XTS_ID_APP_PRESENCE_2)


class ModeMachine:
    """Mode and loaded profile (0 for none) of one module."""

    def __init__(self, product: ProductModel, start: Start) -> None:
        self._product = product
        self.start = start
        self.power_up(None)

    @property
    def mode(self) -> SensorMode:
        return _MODES[self.state]

    def power_up(self, into: ModuleState | None) -> None:
        """Enter a state after a restart; None for the one that the start asks for."""
        self.state = into or self.start.state
        runs = self.state is ModuleState.RUN
        self.profile_id = self.start.profile_id if runs else int(ProfileId.XTS_ID_APP_NONE)

    def set_mode(self, mode: int) -> None:
        """Change the mode, or raise `Refusal`."""
        request = _REQUESTS.get(mode)
        if request is None:
            raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
        self._enter(request)
        if self.state is ModuleState.RUN:
            self.start = Start(state=ModuleState.RUN, profile_id=self.profile_id)
        elif request is Request.STOP:
            self.start = Start(state=ModuleState.STOPPED, profile_id=self.start.profile_id)
        if self.state not in (ModuleState.RUN, ModuleState.IDLE):
            self.profile_id = int(ProfileId.XTS_ID_APP_NONE)

    def load_profile(self, profile_id: int) -> None:
        """Load a profile without running it, or raise `Refusal` for one this product lacks."""
        if profile_id not in self._product.profiles:
            raise Refusal(ErrorCode.XTS_SPRE_APP_INVALID)
        self._enter(Request.LOAD)
        self.profile_id = profile_id
        self.start = Start(state=ModuleState.STOPPED, profile_id=self.start.profile_id)

    def _enter(self, request: Request) -> None:
        target = TRANSITIONS[self.state].get(request)
        if target is None:
            raise Refusal(RUN_WITHOUT_PROFILE)
        self.state = target


def state_diagram() -> str:
    """Return the machine as a Mermaid state diagram; refused requests are its notes."""
    lines = [
        "stateDiagram-v2",
        "    [*] --> RUN: power-up as shipped, or was running",
        "    [*] --> STOPPED: power-up, was stopped",
    ]
    notes: list[str] = []
    for state, steps in TRANSITIONS.items():
        lines += [
            f"    {state.name} --> {target.name}: {request.value}"
            for request, target in steps.items()
        ]
        refused = [request.value for request in Request if request not in steps]
        if refused:
            notes.append(f"    note right of {state.name}: {', '.join(refused)} get ERROR")
    return "\n".join(lines + notes)


class Group(Enum):
    """Commands that are taken in the same states."""

    # these change nothing that decides what streams, and when
    BASIC = "ping, info, reset, bootloader entry, files, IO pins"
    SENSOR = "what the base firmware lacks, in any mode"
    MODES = "modes and profiles"
    PROFILE_SET = "profile settings"
    PROFILE_ACTION = "noise map store, load, delete"
    PROFILE_GET = "profile GETs of sensitivity and band"
    QUIET_GET = "other profile GETs"
    PRESENCE_OUTPUT = "output control of presence messages"
    STREAM_OUTPUT = "output control of baseband, pulse-Doppler, noise maps"
    RADAR = "X4 driver"
    UNHANDLED = "handled by no firmware"


class Verdict(Enum):
    """How a command is answered; all but TAKEN end it, but for an X4M200's RUNNING_OUTPUT."""

    TAKEN = "ok"
    UNKNOWN = "ERROR 1"
    BUSY_PROFILE = "ERROR 21h"
    RUNNING_OUTPUT = "ERROR 21h, X4M200: ok"
    NO_ANSWER = "no answer"


_OK, _UNKNOWN, _NO_ANSWER = Verdict.TAKEN, Verdict.UNKNOWN, Verdict.NO_ANSWER
_BUSY = Verdict.BUSY_PROFILE
_ORDER = (
    ModuleState.RUN,
    ModuleState.IDLE,
    ModuleState.LOADED,
    ModuleState.STOPPED,
    ModuleState.MANUAL,
    ModuleState.REG,
    ModuleState.SAFE,
    ModuleState.XEP,
    ModuleState.BOOTLOADER,
)
_FIRMWARE_LACKS = (_UNKNOWN, _UNKNOWN, _NO_ANSWER)
_EVERYWHERE = (_OK,) * 8 + (_NO_ANSWER,)
_NOWHERE = (_UNKNOWN,) * 8 + (_NO_ANSWER,)
_SENSOR_ONLY = (_OK,) * 6 + _FIRMWARE_LACKS
# fmt: off
_ROWS: dict[Group, tuple[Verdict, ...]] = {
    #                      RUN    IDLE   LOADED STOPPED MANUAL REG
    Group.BASIC:           _EVERYWHERE,
    Group.RADAR:           _EVERYWHERE,
    Group.SENSOR:          _SENSOR_ONLY,
    Group.MODES:           _SENSOR_ONLY,
    Group.PROFILE_SET:     (_BUSY, _BUSY, _OK,   _UNKNOWN, _BUSY, _BUSY, *_FIRMWARE_LACKS),
    Group.PROFILE_ACTION:  (_OK,   _OK,   _OK,   _UNKNOWN, _BUSY, _BUSY, *_FIRMWARE_LACKS),
    Group.PROFILE_GET:     (_OK,   _OK,   _OK,   _UNKNOWN, _UNKNOWN, _UNKNOWN, *_FIRMWARE_LACKS),
    Group.QUIET_GET:       (_OK,   _OK,   _OK,   _NO_ANSWER, _NO_ANSWER, _NO_ANSWER,
                            *_FIRMWARE_LACKS),
    Group.PRESENCE_OUTPUT: (Verdict.RUNNING_OUTPUT,
                                   _OK,   _OK,   _UNKNOWN, _BUSY, _BUSY, *_FIRMWARE_LACKS),
    Group.STREAM_OUTPUT:   (_OK,   _OK,   _OK,   _UNKNOWN, _BUSY, _BUSY, *_FIRMWARE_LACKS),
    Group.UNHANDLED:       _NOWHERE,
}
# fmt: on

PERMISSIONS: dict[Group, dict[ModuleState, Verdict]] = {
    group: dict(zip(_ORDER, verdicts, strict=True)) for group, verdicts in _ROWS.items()
}
"""The table, by group and state."""


GROUPS: dict[type[m.Message], Group] = {
    m.GetMode: Group.MODES,
    m.SetMode: Group.MODES,
    m.LoadApp: Group.MODES,
    m.GetProfileId: Group.MODES,
    m.SetDetectionZone: Group.PROFILE_SET,
    m.SetSensitivity: Group.PROFILE_SET,
    m.SetTxCenterFrequency: Group.PROFILE_SET,
    m.AppSetLedControl: Group.PROFILE_SET,
    m.SetLedControl: Group.PROFILE_SET,
    m.NoiseMapSetControl: Group.PROFILE_SET,
    m.NoiseMapSetPeriodicStore: Group.PROFILE_SET,
    m.SetParameterFile: Group.PROFILE_SET,
    m.FactoryPreset: Group.PROFILE_SET,
    m.StoreNoiseMap: Group.PROFILE_ACTION,
    m.LoadNoiseMap: Group.PROFILE_ACTION,
    m.DeleteNoiseMap: Group.PROFILE_ACTION,
    m.GetSensitivity: Group.PROFILE_GET,
    m.GetTxCenterFrequency: Group.PROFILE_GET,
    m.GetDetectionZone: Group.QUIET_GET,
    m.GetDetectionZoneLimits: Group.QUIET_GET,
    m.AppGetLedControl: Group.QUIET_GET,
    m.NoiseMapGetControl: Group.QUIET_GET,
    m.NoiseMapGetPeriodicStore: Group.QUIET_GET,
    m.GetParameterFile: Group.QUIET_GET,
    m.OutputGetControl: Group.QUIET_GET,
    m.DebugOutputGetControl: Group.QUIET_GET,
    m.DebugLevel: Group.SENSOR,
    m.IoPinGetControl: Group.SENSOR,
    m.InjectFrame: Group.SENSOR,
    m.PrepareInjectFrame: Group.SENSOR,
    m.X4DriverWriteI2c: Group.SENSOR,
    m.X4DriverReadI2c: Group.SENSOR,
    m.FramePostprocessingSet: Group.SENSOR,
    m.FramePostprocessingGet: Group.SENSOR,
    m.X4DriverInit: Group.RADAR,
    m.X4DriverSet: Group.RADAR,
    m.X4DriverGet: Group.RADAR,
    m.X4DriverWrite: Group.RADAR,
    m.X4DriverRead: Group.RADAR,
    m.BootloaderGetDeviceInfo: Group.UNHANDLED,
    m.BootloaderPageSize: Group.UNHANDLED,
    m.BootloaderPageCount: Group.UNHANDLED,
    m.BootloaderWritePage: Group.UNHANDLED,
    m.BootloaderStartApp: Group.UNHANDLED,
    m.BootloaderEcho: Group.UNHANDLED,
    m.AppPoll: Group.UNHANDLED,
    m.Hil: Group.UNHANDLED,
    m.SetCom: Group.UNHANDLED,
    m.SystemGetDebugData: Group.UNHANDLED,
    m.LegacyGetVersion: Group.UNHANDLED,
    m.LegacyGetVarInt: Group.UNHANDLED,
    m.LegacyDirCommand: Group.UNHANDLED,
    m.UnknownMessage: Group.UNHANDLED,
}
"""Group of each command; those not named are BASIC, OUTPUT control depends on the message."""


def group_of(command: m.Message) -> Group:
    if isinstance(command, m.OutputSetControl | m.DebugOutputSetControl):
        return Group.STREAM_OUTPUT if command.feature in VOLATILE else Group.PRESENCE_OUTPUT
    return GROUPS.get(type(command), Group.BASIC)


def check_permission(command: m.Message, state: ModuleState, options: DeviceOptions) -> None:
    """Raise `Refusal` or `Silence` if a command is not taken in a state."""
    verdict = PERMISSIONS[group_of(command)][state]
    if verdict is Verdict.TAKEN:
        return
    if verdict is Verdict.RUNNING_OUTPUT and options.product.output_while_running:
        return
    if verdict is Verdict.NO_ANSWER:
        raise Silence
    if verdict in (Verdict.BUSY_PROFILE, Verdict.RUNNING_OUTPUT):
        raise Refusal(BUSY_PROFILE)
    raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)


if __name__ == "__main__":
    print(state_diagram())  # noqa: T201 - this is what running the module is for

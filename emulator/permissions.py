"""Which commands a module takes in which state: a table of command groups by states.

Rows and columns are those of protocol reference 8.3, with columns for certification mode (as
MANUAL), the bare base firmware (2) and the bootloader (4.12) added. What the reference leaves
open is an option; a verdict names it. ``python -m emulator.permissions`` prints the table.

Source: protocol reference 2, 8.3, 8.5.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum

from emulator.modes import State
from emulator.options import DeviceOptions
from emulator.outputs import VOLATILE
from emulator.refusal import Refusal, Silence
from xethru_protocol import messages as m
from xethru_protocol.codes import ErrorCode

__all__ = ["GROUPS", "PERMISSIONS", "Group", "Verdict", "check_permission", "permission_table"]


class Group(Enum):
    """Commands that are taken in the same states."""

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
    BOOTLOADER = "bootloader"
    UNHANDLED = "handled by no firmware"


class Verdict(Enum):
    """What becomes of a command; all but TAKEN end it."""

    TAKEN = "ok"
    UNKNOWN = "ERROR 1"
    BUSY_PROFILE = "ERROR, option busy_profile_error"
    NO_PROFILE = "ERROR, option no_profile_error"
    QUIET = "option get_without_profile"
    RUNNING_OUTPUT = "option presence_output_while_running"
    DEAF = "no answer"


_OK, _UNKNOWN, _DEAF = Verdict.TAKEN, Verdict.UNKNOWN, Verdict.DEAF
_BUSY, _NONE, _QUIET = Verdict.BUSY_PROFILE, Verdict.NO_PROFILE, Verdict.QUIET
_ORDER = (
    State.RUN,
    State.IDLE,
    State.LOADED,
    State.STOPPED,
    State.MANUAL,
    State.REG,
    State.SAFE,
    State.XEP,
    State.BOOTLOADER,
)
_FIRMWARE_LACKS = (_UNKNOWN, _UNKNOWN, _DEAF)
_EVERYWHERE = (_OK,) * 8 + (_DEAF,)
_NOWHERE = (_UNKNOWN,) * 8 + (_DEAF,)
_SENSOR_ONLY = (_OK,) * 6 + _FIRMWARE_LACKS
# fmt: off
_ROWS: dict[Group, tuple[Verdict, ...]] = {
    #                      RUN    IDLE   LOADED STOPPED MANUAL REG
    Group.BASIC:           _EVERYWHERE,
    Group.RADAR:           _EVERYWHERE,
    Group.SENSOR:          _SENSOR_ONLY,
    Group.MODES:           _SENSOR_ONLY,
    Group.PROFILE_SET:     (_BUSY, _BUSY, _OK,   _NONE,  _BUSY, _BUSY, *_FIRMWARE_LACKS),
    Group.PROFILE_ACTION:  (_OK,   _OK,   _OK,   _NONE,  _BUSY, _BUSY, *_FIRMWARE_LACKS),
    Group.PROFILE_GET:     (_OK,   _OK,   _OK,   _UNKNOWN, _UNKNOWN, _UNKNOWN, *_FIRMWARE_LACKS),
    Group.QUIET_GET:       (_OK,   _OK,   _OK,   _QUIET, _QUIET, _QUIET, *_FIRMWARE_LACKS),
    Group.PRESENCE_OUTPUT: (Verdict.RUNNING_OUTPUT,
                                   _OK,   _OK,   _NONE,  _BUSY, _BUSY, *_FIRMWARE_LACKS),
    Group.STREAM_OUTPUT:   (_OK,   _OK,   _OK,   _NONE,  _BUSY, _BUSY, *_FIRMWARE_LACKS),
    Group.BOOTLOADER:      (_UNKNOWN,) * 8 + (_OK,),
    Group.UNHANDLED:       _NOWHERE,
}
# fmt: on

PERMISSIONS: dict[Group, dict[State, Verdict]] = {
    group: dict(zip(_ORDER, verdicts, strict=True)) for group, verdicts in _ROWS.items()
}
"""The table, by group and state."""


def _group_of_output(command: m.OutputSetControl | m.DebugOutputSetControl) -> Group:
    return Group.STREAM_OUTPUT if command.feature in VOLATILE else Group.PRESENCE_OUTPUT


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
    m.BootloaderGetDeviceInfo: Group.BOOTLOADER,
    m.BootloaderWritePage: Group.BOOTLOADER,
    m.BootloaderStartApp: Group.BOOTLOADER,
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
    """Return the group of a command."""
    if isinstance(command, m.OutputSetControl | m.DebugOutputSetControl):
        return _group_of_output(command)
    return GROUPS.get(type(command), Group.BASIC)


def check_permission(command: m.Message, state: State, options: DeviceOptions) -> None:
    """Return if a command is taken in a state; raise `Refusal` or `Silence` if not."""
    verdict = PERMISSIONS[group_of(command)][state]
    if verdict is Verdict.TAKEN:
        return
    if verdict is Verdict.RUNNING_OUTPUT and options.presence_output_while_running:
        return
    silent = verdict is Verdict.QUIET and options.get_without_profile == "silence"
    if verdict is Verdict.DEAF or silent:
        raise Silence
    raise Refusal(_ERRORS[verdict](options))


def permission_table() -> str:
    """Return the table as Markdown, a row per group and a column per state.

    Examples
    --------
    >>> permission_table().splitlines()[0].split("|")[2]
    ' RUN '
    """
    lines = [
        "| Commands | " + " | ".join(state.name for state in _ORDER) + " |",
        "|" + "---|" * (len(_ORDER) + 1),
    ]
    for group, verdicts in PERMISSIONS.items():
        cells = (verdicts[state].value for state in _ORDER)
        lines.append(f"| {group.value} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


_ERRORS: dict[Verdict, Callable[[DeviceOptions], int]] = {
    Verdict.UNKNOWN: lambda options: ErrorCode.XTS_SPRE_NOT_RECOGNIZED,
    Verdict.QUIET: lambda options: ErrorCode.XTS_SPRE_NOT_RECOGNIZED,
    Verdict.NO_PROFILE: lambda options: options.no_profile_error,
    Verdict.BUSY_PROFILE: lambda options: options.busy_profile_error,
    Verdict.RUNNING_OUTPUT: lambda options: options.busy_profile_error,
}


if __name__ == "__main__":
    print(permission_table())  # noqa: T201 - this is what running the module is for

"""Rows of the message table: what the host sends.

Names in dumps are those of the golden vectors. Section numbers refer to the Protocol reference.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from xethru_protocol import wire
from xethru_protocol.codes import (
    CommandCode,
    DirCode,
    IoPinCode,
    NoiseMapCode,
    OutputCode,
    SensorMode,
    X4DriverCode,
    X4Setting,
)
from xethru_protocol.responses import Ack, Pong, ReplyByte, ReplyFloat, ReplyInt, ReplyString
from xethru_protocol.table import Command, command

X4Value = int | float | tuple[float, float] | tuple[int, int]


@command(CommandCode.XTS_SPC_PING, name="PING")
@dataclass(frozen=True, slots=True, kw_only=True)
class Ping(Command[Pong]):
    """Ask for a sign of life; the firmware does not check the seed. 4.1."""

    seed: Annotated[int, wire.ID32] = 0xEEAAEAAE


@command(CommandCode.XTS_SPC_MOD_RESET, name="MOD_RESET")
@dataclass(frozen=True, slots=True, kw_only=True)
class ModReset(Command[Ack]):
    """Restart the module about 500 ms after its ACK; a USB port vanishes meanwhile. 4.1."""


@command(
    CommandCode.XTS_SPC_MOD_SETMODE,
    name="SETMODE",
    derived={
        "mode_name": lambda message: next(
            (mode.label for mode in SensorMode if mode == message.mode), None
        )
    },
)
@dataclass(frozen=True, slots=True, kw_only=True)
class SetMode(Command[Ack]):
    """Switch to a `SensorMode`; a host leaves ``param`` out for all but NORMAL and REG. 4.2."""

    mode: Annotated[int, wire.U8]
    param: Annotated[int | None, wire.OptionalByte(shown_if_absent=True)] = None


@command(CommandCode.XTS_SPC_MOD_GETMODE, name="GETMODE")
@dataclass(frozen=True, slots=True, kw_only=True)
class GetMode(Command[ReplyByte]):
    """Ask for the `SensorMode`. 4.2."""


@command(CommandCode.XTS_SPC_MOD_LOADAPP, name="MOD_LOADAPP")
@dataclass(frozen=True, slots=True, kw_only=True)
class LoadApp(Command[Ack]):
    """Load a profile (`ProfileId`) without running it. 4.3."""

    profile_id: Annotated[int, wire.ID32]


@command(
    CommandCode.XTS_SPC_MOD_NOISEMAP, NoiseMapCode.XTS_SPCN_SETCONTROL, name="NOISEMAP_SETCONTROL"
)
@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseMapSetControl(Command[Ack]):
    """Choose where a profile's noise map comes from: three bits. 4.6."""

    control: Annotated[int, wire.U32]


@command(CommandCode.XTS_SPC_OUTPUT, OutputCode.XTS_SPCO_SETCONTROL, name="OUTPUT_SETCONTROL")
@dataclass(frozen=True, slots=True, kw_only=True)
class OutputSetControl(Command[Ack]):
    """Switch one of a profile's messages on or off. 4.7."""

    feature: Annotated[int, wire.ID32]
    control: Annotated[int, wire.U32]


@command(CommandCode.XTS_SPC_IOPIN, IoPinCode.XTS_SPCIOP_SETCONTROL, name="IOPIN_SETCONTROL")
@dataclass(frozen=True, slots=True, kw_only=True)
class IoPinSetControl(Command[Ack]):
    """Say what a pin does: setup bits and feature. 4.8."""

    pin_id: Annotated[int, wire.U32]
    pin_setup: Annotated[int, wire.U32]
    pin_feature: Annotated[int, wire.U32]


@command(CommandCode.XTS_SPC_IOPIN, IoPinCode.XTS_SPCIOP_SETVALUE, name="IOPIN_SETVALUE")
@dataclass(frozen=True, slots=True, kw_only=True)
class IoPinSetValue(Command[Ack]):
    """Drive an output pin high (1) or low (0). 4.8."""

    pin_id: Annotated[int, wire.U32]
    pin_value: Annotated[int, wire.U32]


_DIR = CommandCode.XTS_SPC_DIR_COMMAND


@command(
    _DIR,
    DirCode.XTS_SDC_SYSTEM_GET_INFO,
    name="DIR SYSTEM_GET_INFO",
    reply_content_id=lambda message: DirCode.XTS_SDC_SYSTEM_GET_INFO,
)
@dataclass(frozen=True, slots=True, kw_only=True)
class SystemGetInfo(Command[ReplyString]):
    """Ask for an `InfoItem`. 4.10."""

    item: Annotated[int, wire.Number("B", "info_code")]


@command(_DIR, DirCode.XTS_SDC_GET_PROFILEID, name="DIR GET_PROFILEID")
@dataclass(frozen=True, slots=True, kw_only=True)
class GetProfileId(Command[ReplyInt]):
    """Ask for the loaded profile; 0 if none. 4.3."""


@command(_DIR, DirCode.XTS_SDC_COMM_SETBAUDRATE, name="DIR SETBAUDRATE")
@dataclass(frozen=True, slots=True, kw_only=True)
class SetBaudRate(Command[Ack]):
    """Change the UART rate after the ACK; no effect on USB. 4.10."""

    baudrate: Annotated[int, wire.U32]


_X4 = CommandCode.XTS_SPC_X4DRIVER
_SETTING = wire.Member(X4Setting, "id")
REGISTERS = frozenset({X4Setting.SPIREGISTER, X4Setting.PIFREGISTER, X4Setting.XIFREGISTER})
# Struct codes and names of what SET carries, as the firmware parses it (4.9).
X4_SET_LAYOUTS: Mapping[int, tuple[str, tuple[str, ...]]] = {
    X4Setting.FPS: ("f", ("value",)),
    X4Setting.PULSESPERSTEP: ("I", ("value",)),
    X4Setting.ITERATIONS: ("I", ("value",)),
    X4Setting.DOWNCONVERSION: ("B", ("value",)),
    X4Setting.FRAMEAREA: ("ff", ("start", "end")),
    X4Setting.DACSTEP: ("I", ("value",)),
    X4Setting.DACMIN: ("I", ("value",)),
    X4Setting.DACMAX: ("I", ("value",)),
    X4Setting.FRAMEAREAOFFSET: ("f", ("value",)),
    X4Setting.ENABLE: ("B", ("value",)),
    X4Setting.TXCENTERFREQUENCY: ("B", ("value",)),
    X4Setting.TXPOWER: ("B", ("value",)),
    X4Setting.SPIREGISTER: ("BB", ("address", "value")),
    X4Setting.PIFREGISTER: ("BB", ("address", "value")),
    X4Setting.XIFREGISTER: ("BB", ("address", "value")),
    X4Setting.PRFDIV: ("B", ("value",)),
}
# The document's example sets PULSESPERSTEP in one byte; the vendor's host does so with DACSTEP.
_SHORT = frozenset({X4Setting.PULSESPERSTEP, X4Setting.DACSTEP})


@command(_X4, X4DriverCode.XTS_SPCX_INIT, name="X4DRIVER_INIT")
@dataclass(frozen=True, slots=True, kw_only=True)
class X4DriverInit(Command[Ack]):
    """Restart the radar chip with default settings; takes up to a second. 4.9."""


@command(_X4, X4DriverCode.XTS_SPCX_SET, name="X4DRIVER_SET")
@dataclass(frozen=True, slots=True, kw_only=True)
class X4DriverSet(Command[Ack]):
    """Set one X4 setting. 4.9.

    ``value`` is a number; for FRAMEAREA (start, end) in module metres; for a register
    (address, value). ``value_width`` 1 marks the one-byte form that two settings tolerate.
    """

    setting: Annotated[X4Setting, _SETTING]
    value_width: Annotated[int | None, wire.ShortForm("setting", _SHORT)] = None
    value: Annotated[
        X4Value, wire.ByDiscriminator("setting", X4_SET_LAYOUTS, _SHORT, "value_width")
    ]


@command(
    _X4,
    X4DriverCode.XTS_SPCX_GET,
    name="X4DRIVER_GET",
    reply_content_id=lambda message: message.setting,
)
@dataclass(frozen=True, slots=True, kw_only=True)
class X4DriverGet(Command[ReplyByte | ReplyInt | ReplyFloat]):
    """Read one X4 setting; a register needs its ``address``. 4.9."""

    setting: Annotated[X4Setting, _SETTING]
    address: Annotated[
        int | None,
        wire.OptionalByte(wanted=lambda before: before["setting"] in REGISTERS, required=True),
    ] = None


@command(_X4, X4DriverCode.XTS_SPCX_WRITE, name="X4DRIVER_WRITE")
@dataclass(frozen=True, slots=True, kw_only=True)
class X4DriverWrite(Command[Ack]):
    """Write bytes to consecutive registers from ``address``. 4.9."""

    setting: Annotated[X4Setting, _SETTING] = X4Setting.SPIREGISTER
    address: Annotated[int, wire.U8]
    values: Annotated[bytes, wire.RestBytes(shown=list)]


@command(
    _X4,
    X4DriverCode.XTS_SPCX_READ,
    name="X4DRIVER_READ",
    reply_content_id=lambda message: message.setting,
)
@dataclass(frozen=True, slots=True, kw_only=True)
class X4DriverRead(Command[ReplyByte]):
    """Read ``length`` bytes of registers from ``address``. 4.9."""

    setting: Annotated[X4Setting, _SETTING] = X4Setting.SPIREGISTER
    address: Annotated[int, wire.U8]
    length: Annotated[int, wire.U32]

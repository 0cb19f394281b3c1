"""Rows of the message table: the radar chip, X4DRIVER, and what is done to its frames.

Names in dumps are those of the golden vectors. Section numbers refer to the Protocol reference.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from xethru_protocol import wire
from xethru_protocol.codes import (
    I2C_REGISTER,
    CommandCode,
    ErrorSpace,
    FramePostprocessing,
    FramePostprocessingCode,
    X4DriverCode,
    X4Setting,
)
from xethru_protocol.responses import Ack, ReplyByte, ReplyFloat, ReplyInt
from xethru_protocol.table import Command, command, id32

X4Value = int | float | tuple[float, float] | tuple[int, int]


_X4 = CommandCode.XTS_SPC_X4DRIVER
_ERRORS = ErrorSpace.X4_DRIVER
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


@command(_X4, X4DriverCode.XTS_SPCX_INIT, name="X4DRIVER_INIT", errors=_ERRORS)
@dataclass(frozen=True, slots=True, kw_only=True)
class X4DriverInit(Command[Ack]):
    """Restart the radar chip with default settings; takes up to a second. 4.9."""


@command(_X4, X4DriverCode.XTS_SPCX_SET, name="X4DRIVER_SET", errors=_ERRORS)
@dataclass(frozen=True, slots=True, kw_only=True)
class X4DriverSet(Command[Ack]):
    """Set one X4 setting. 4.9.

    ``value`` is a number, of FPS [1/s], of FRAMEAREAOFFSET [m]; for FRAMEAREA (start, end) in
    module metres; for a register (address, value). ``value_width`` 1 marks the one-byte form that
    two settings tolerate.
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
    errors=_ERRORS,
)
@dataclass(frozen=True, slots=True, kw_only=True)
class X4DriverGet(Command[ReplyByte | ReplyInt | ReplyFloat]):
    """Read one X4 setting; a register needs its ``address``. 4.9."""

    setting: Annotated[X4Setting, _SETTING]
    address: Annotated[
        int | None,
        wire.OptionalByte(wanted=lambda fields: fields["setting"] in REGISTERS, required=True),
    ] = None


@command(_X4, X4DriverCode.XTS_SPCX_WRITE, name="X4DRIVER_WRITE", errors=_ERRORS)
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
    errors=_ERRORS,
)
@dataclass(frozen=True, slots=True, kw_only=True)
class X4DriverRead(Command[ReplyByte]):
    """Read ``length`` bytes of registers from ``address``. 4.9."""

    setting: Annotated[X4Setting, _SETTING] = X4Setting.SPIREGISTER
    address: Annotated[int, wire.U8]
    length: Annotated[int, wire.U32]


@command(
    _X4,
    X4DriverCode.WRITE_I2C,
    *id32(I2C_REGISTER),
    name="X4DRIVER_WRITE_I2C",
    errors=_ERRORS,
)
@dataclass(frozen=True, slots=True, kw_only=True)
class X4DriverWriteI2c(Command[Ack]):
    """Write bytes to the I2C device at ``address``; newer sensor firmware. 16."""

    address: Annotated[int, wire.U8]
    values: Annotated[bytes, wire.RestBytes(shown=list)]


@command(
    _X4,
    X4DriverCode.READ_I2C,
    *id32(I2C_REGISTER),
    name="X4DRIVER_READ_I2C",
    errors=_ERRORS,
)
@dataclass(frozen=True, slots=True, kw_only=True)
class X4DriverReadI2c(Command[ReplyByte]):
    """Read ``length`` bytes from the I2C device; newer sensor firmware. 16."""

    length: Annotated[int, wire.U32]


_POSTPROCESSING = CommandCode.XTS_SPC_FRAME_POSTPROCESSING
PostprocessingValue = int | tuple[int, float]
# Struct codes and names of what SET carries (16).
POSTPROCESSING_LAYOUTS: Mapping[int, tuple[str, tuple[str, ...]]] = {
    FramePostprocessing.NORMALIZATION: ("B", ("value",)),
    FramePostprocessing.PHASE_NOISE_CORRECTION: ("If", ("value", "reference_distance")),
    FramePostprocessing.DECIMATION_FACTOR: ("I", ("value",)),
    FramePostprocessing.NUMBER_FORMAT: ("B", ("value",)),
    FramePostprocessing.LEGACY_OUTPUT: ("B", ("value",)),
}


@command(_POSTPROCESSING, FramePostprocessingCode.SET, name="FRAME_POSTPROCESSING_SET")
@dataclass(frozen=True, slots=True, kw_only=True)
class FramePostprocessingSet(Command[Ack]):
    """Choose one step between chip and host; newer sensor firmware. 16.

    ``value`` is a number; for PHASE_NOISE_CORRECTION (on, reference distance [m]).
    """

    setting: Annotated[FramePostprocessing, wire.Member(FramePostprocessing, "id")]
    value: Annotated[PostprocessingValue, wire.ByDiscriminator("setting", POSTPROCESSING_LAYOUTS)]


@command(_POSTPROCESSING, FramePostprocessingCode.GET, name="FRAME_POSTPROCESSING_GET")
@dataclass(frozen=True, slots=True, kw_only=True)
class FramePostprocessingGet(Command[ReplyByte | ReplyFloat | ReplyInt]):
    """Ask for one setting between chip and host. 16."""

    setting: Annotated[FramePostprocessing, wire.Member(FramePostprocessing, "id")]

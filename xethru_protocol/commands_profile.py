"""Rows of the message table: what a running profile does and sends, and the IO pins.

Names in dumps are those of the golden vectors. Section numbers refer to the Protocol reference.
"""

from dataclasses import dataclass
from typing import Annotated

from xethru_protocol import wire
from xethru_protocol.codes import CommandCode, ErrorSpace, IoPinCode, NoiseMapCode, OutputCode
from xethru_protocol.responses import Ack, ReplyInt
from xethru_protocol.table import Command, command

_NOISEMAP = CommandCode.XTS_SPC_MOD_NOISEMAP
_OUTPUT = CommandCode.XTS_SPC_OUTPUT
_DEBUG_OUTPUT = CommandCode.XTS_SPC_DEBUG_OUTPUT
_IOPIN = CommandCode.XTS_SPC_IOPIN


@command(_NOISEMAP, NoiseMapCode.XTS_SPCN_SETCONTROL, name="NOISEMAP_SETCONTROL")
@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseMapSetControl(Command[Ack]):
    """Choose where a profile's noise map comes from: `NoiseMapControl` bits. 4.6."""

    control: Annotated[int, wire.U32]


@command(_NOISEMAP, NoiseMapCode.XTS_SPCN_GETCONTROL, name="NOISEMAP_GETCONTROL")
@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseMapGetControl(Command[ReplyInt]):
    """Ask for the noise map's `NoiseMapControl` bits. 4.6."""


@command(_NOISEMAP, NoiseMapCode.SET_PERIODIC_STORE, name="NOISEMAP_SET_PERIODIC_STORE")
@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseMapSetPeriodicStore(Command[Ack]):
    """Store the noise map every ``interval_min`` minutes; ``padding`` is sent as 0. 16."""

    interval_min: Annotated[int, wire.U32]
    padding: Annotated[int, wire.U32] = 0


@command(_NOISEMAP, NoiseMapCode.GET_PERIODIC_STORE, name="NOISEMAP_GET_PERIODIC_STORE")
@dataclass(frozen=True, slots=True, kw_only=True)
class NoiseMapGetPeriodicStore(Command[ReplyInt]):
    """Ask for the interval [min] at which the noise map is stored; two integers. 16."""


@command(_OUTPUT, OutputCode.XTS_SPCO_SETCONTROL, name="OUTPUT_SETCONTROL")
@dataclass(frozen=True, slots=True, kw_only=True)
class OutputSetControl(Command[Ack]):
    """Switch a profile's message (`OutputFeature`) on or off. 4.7.

    ``control`` holds `OutputControl` bits; for pulse-Doppler and noise maps `MatrixControl` bits.
    """

    feature: Annotated[int, wire.ID32]
    control: Annotated[int, wire.U32]


@command(_OUTPUT, OutputCode.XTS_SPCO_GETCONTROL, name="OUTPUT_GETCONTROL")
@dataclass(frozen=True, slots=True, kw_only=True)
class OutputGetControl(Command[ReplyInt]):
    """Ask for the control bits of an `OutputFeature`. 4.7."""

    feature: Annotated[int, wire.ID32]


@command(_DEBUG_OUTPUT, OutputCode.XTS_SPCO_SETCONTROL, name="DEBUG_OUTPUT_SETCONTROL")
@dataclass(frozen=True, slots=True, kw_only=True)
class DebugOutputSetControl(Command[Ack]):
    """Switch a message on or off on the debug line; fields as in `OutputSetControl`. 4.7, 16."""

    feature: Annotated[int, wire.ID32]
    control: Annotated[int, wire.U32]


@command(_DEBUG_OUTPUT, OutputCode.XTS_SPCO_GETCONTROL, name="DEBUG_OUTPUT_GETCONTROL")
@dataclass(frozen=True, slots=True, kw_only=True)
class DebugOutputGetControl(Command[ReplyInt]):
    """Ask for a message's control bits on the debug line. 4.7, 16."""

    feature: Annotated[int, wire.ID32]


@command(
    _IOPIN,
    IoPinCode.XTS_SPCIOP_SETCONTROL,
    name="IOPIN_SETCONTROL",
    errors=ErrorSpace.IO_PINS,
)
@dataclass(frozen=True, slots=True, kw_only=True)
class IoPinSetControl(Command[Ack]):
    """Say what a pin does: `IoPinSetup` bits and an `IoPinFeature`. 4.8.

    ``pin_id``: an `IoPin`.
    """

    pin_id: Annotated[int, wire.U32]
    pin_setup: Annotated[int, wire.U32]
    pin_feature: Annotated[int, wire.U32]


@command(
    _IOPIN,
    IoPinCode.XTS_SPCIOP_GETCONTROL,
    name="IOPIN_GETCONTROL",
    errors=ErrorSpace.IO_PINS,
)
@dataclass(frozen=True, slots=True, kw_only=True)
class IoPinGetControl(Command[ReplyInt]):
    """Ask for a pin's setup bits and feature: two integers. 4.8."""

    pin_id: Annotated[int, wire.U32]


@command(_IOPIN, IoPinCode.XTS_SPCIOP_SETVALUE, name="IOPIN_SETVALUE", errors=ErrorSpace.IO_PINS)
@dataclass(frozen=True, slots=True, kw_only=True)
class IoPinSetValue(Command[Ack]):
    """Drive an output pin high (1) or low (0). 4.8."""

    pin_id: Annotated[int, wire.U32]
    pin_value: Annotated[int, wire.U32]


@command(_IOPIN, IoPinCode.XTS_SPCIOP_GETVALUE, name="IOPIN_GETVALUE", errors=ErrorSpace.IO_PINS)
@dataclass(frozen=True, slots=True, kw_only=True)
class IoPinGetValue(Command[ReplyInt]):
    """Ask whether a pin is high (1) or low (0). 4.8."""

    pin_id: Annotated[int, wire.U32]

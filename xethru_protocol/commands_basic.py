"""Rows of the message table: basic commands, modes, profiles, LED, trace output.

Names in dumps are those of the golden vectors. Section numbers refer to the Protocol reference.
"""

from dataclasses import dataclass
from typing import Annotated

from xethru_protocol import wire
from xethru_protocol.codes import CommandCode, DirCode, SensorMode
from xethru_protocol.responses import Ack, Pong, ReplyByte, ReplyInt
from xethru_protocol.table import Command, command


@command(CommandCode.XTS_SPC_PING, name="PING")
@dataclass(frozen=True, slots=True, kw_only=True)
class Ping(Command[Pong]):
    """Ask for a sign of life; the firmware does not check the seed. 4.1."""

    seed: Annotated[int, wire.ID32] = 0xEEAAEAAE


@command(CommandCode.XTS_SPC_START_BOOTLOADER, name="START_BOOTLOADER")
@dataclass(frozen=True, slots=True, kw_only=True)
class StartBootloader(Command[Ack]):
    """Restart into the bootloader about 500 ms after the ACK; ``key`` as `BootloaderKey`. 4.1."""

    key: Annotated[int, wire.ID32]


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


@command(CommandCode.XTS_SPC_DIR_COMMAND, DirCode.XTS_SDC_GET_PROFILEID, name="DIR GET_PROFILEID")
@dataclass(frozen=True, slots=True, kw_only=True)
class GetProfileId(Command[ReplyInt]):
    """Ask for the loaded profile; 0 if none. 4.3."""


@command(CommandCode.XTS_SPC_MOD_SETLEDCONTROL, name="SETLEDCONTROL")
@dataclass(frozen=True, slots=True, kw_only=True)
class SetLedControl(Command[Ack]):
    """Choose what the LED shows (`LedMode`); an intensity, 0 ... 100, is not implemented. 4.5."""

    mode: Annotated[int, wire.U8]
    intensity: Annotated[int, wire.U8] = 0


@command(CommandCode.XTS_SPC_DEBUG_LEVEL, name="DEBUG_LEVEL")
@dataclass(frozen=True, slots=True, kw_only=True)
class DebugLevel(Command[Ack]):
    """Choose how much trace output comes as DATA STRING: a `TraceLevel`, up to 9. 4.5."""

    level: Annotated[int, wire.U8]


@command(CommandCode.XTS_SPC_MOD_SETCOM, name="MOD_SETCOM")
@dataclass(frozen=True, slots=True, kw_only=True)
class SetCom(Command[Ack]):
    """A command that is defined but handled by no firmware: ERROR 1. 2."""

    data: Annotated[bytes, wire.RestBytes()] = b""


@command(CommandCode.XTS_SPC_HIL, name="HIL")
@dataclass(frozen=True, slots=True, kw_only=True)
class Hil(Command[Ack]):
    """A command that every firmware answers with ERROR 1; its content has no known layout. 2."""

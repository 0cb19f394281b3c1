"""Rows of the message table: DIR_COMMAND's system part, and the bootloader.

Names in dumps are those of the golden vectors. Section numbers refer to the Protocol reference.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from xethru_protocol import wire, wire_lists
from xethru_protocol.codes import LEGACY_DIR_CODES, BootloaderCode, CommandCode, DirCode
from xethru_protocol.responses import Ack, ReplyByte, ReplyInt, ReplyString
from xethru_protocol.table import Command, Response, command

_DIR = CommandCode.XTS_SPC_DIR_COMMAND


@command(_DIR, DirCode.XTS_SDC_SYSTEM_TEST, name="DIR SYSTEM_TEST")
@dataclass(frozen=True, slots=True, kw_only=True)
class SystemTest(Command[ReplyByte | Ack]):
    """Run a `TestCode`; 256 bytes, of which the first says if it passed, or an ACK. 4.10."""

    code: Annotated[int, wire.Number("B", "test_code")]


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


@command(_DIR, DirCode.XTS_SDC_SYSTEM_GET_DEBUG_DATA, name="DIR SYSTEM_GET_DEBUG_DATA")
@dataclass(frozen=True, slots=True, kw_only=True)
class SystemGetDebugData(Command[Response]):
    """A command that is not implemented: an emulator answers ERROR 1. 4.10."""

    item: Annotated[int, wire.Number("B", "info_code")]


@command(_DIR, DirCode.XTS_SDC_GET_CRASH_DUMP_LENGTH, name="DIR GET_CRASH_DUMP_LENGTH")
@dataclass(frozen=True, slots=True, kw_only=True)
class GetCrashDumpLength(Command[ReplyInt]):
    """Ask for the size of the crash dump [bytes]; 0 if there is none. 4.10."""


@command(_DIR, DirCode.XTS_SDC_CLEAR_CRASH_DUMP, name="DIR CLEAR_CRASH_DUMP")
@dataclass(frozen=True, slots=True, kw_only=True)
class ClearCrashDump(Command[Ack]):
    """Delete the crash dump. 4.10."""


@command(_DIR, DirCode.XTS_SDC_GET_CRASH_DUMP, name="DIR GET_CRASH_DUMP")
@dataclass(frozen=True, slots=True, kw_only=True)
class GetCrashDump(Command[ReplyByte]):
    """Read ``length`` bytes of the crash dump from ``offset``. 4.10."""

    offset: Annotated[int, wire.U32]
    length: Annotated[int, wire.U32]


@command(_DIR, DirCode.XTS_SDC_PREPARE_INJECT_FRAME, name="DIR PREPARE_INJECT_FRAME")
@dataclass(frozen=True, slots=True, kw_only=True)
class PrepareInjectFrame(Command[Ack]):
    """Announce frames that replace the chip's: how many, of how many bins, `InjectMode`. 4.10."""

    frames: Annotated[int, wire.Number("I", "num_frames")]
    bins: Annotated[int, wire.Number("I", "num_bins")]
    mode: Annotated[int, wire.U32]


@command(_DIR, DirCode.XTS_SDC_INJECT_FRAME, name="DIR INJECT_FRAME")
@dataclass(frozen=True, slots=True, kw_only=True)
class InjectFrame(Command[Ack]):
    """Give one frame in the chip's place: ``values`` are two float32 per bin. 4.10."""

    counter: Annotated[int, wire.Number("I", "frame_counter")]
    bins: ClassVar[Annotated[int, wire_lists.Count(("values",), "frame_length", per=2)]]
    values: Annotated[
        tuple[float, ...], wire_lists.Floats("bins", "samples", per=2, empty_shown=True)
    ]


@command(_DIR, DirCode.XTS_SDC_COMM_SETBAUDRATE, name="DIR SETBAUDRATE")
@dataclass(frozen=True, slots=True, kw_only=True)
class SetBaudRate(Command[Ack]):
    """Change the UART rate after the ACK; no effect on USB. 4.10."""

    baudrate: Annotated[int, wire.U32]


@command(_DIR, DirCode.XTS_SDC_SYSTEM_GET_VERSION, name="DIR SYSTEM_GET_VERSION (legacy)")
@dataclass(frozen=True, slots=True, kw_only=True)
class LegacyGetVersion(Command[Response]):
    """An X2 command; an X4 answers ERROR 1. 4.10."""


@command(_DIR, DirCode.XTS_SDC_RADLIB_GETVARINT, name="DIR RADLIB_GETVARINT (legacy)")
@dataclass(frozen=True, slots=True, kw_only=True)
class LegacyGetVarInt(Command[Response]):
    """An X2 command; an X4 answers ERROR 1. 4.10."""

    variable: Annotated[int, wire.Number("I", "id")]


@command(_DIR, name="DIR (legacy)")
@dataclass(frozen=True, slots=True, kw_only=True)
class LegacyDirCommand(Command[Response]):
    """Any other X2 command, kept whole; an X4 answers ERROR 1. 4.10."""

    sub_code: Annotated[int, wire.Spelling(tuple(sorted(LEGACY_DIR_CODES)))]
    data: Annotated[bytes, wire.RestBytes()] = b""


_BOOTLOADER = CommandCode.XTS_SPC_BOOTLOADER


@command(_BOOTLOADER, BootloaderCode.GET_DEVICE_INFO, name="BOOTLOADER_GET_DEVICE_INFO")
@dataclass(frozen=True, slots=True, kw_only=True)
class BootloaderGetDeviceInfo(Command[Response]):
    """Ask the bootloader about the device; the form of its answer is not known. 4.12."""


@command(_BOOTLOADER, BootloaderCode.WRITE_PAGE, name="BOOTLOADER_WRITE_PAGE")
@dataclass(frozen=True, slots=True, kw_only=True)
class BootloaderWritePage(Command[Response]):
    """Write a page of 512 bytes, the last one padded with FF; answered by one byte. 4.12."""

    # The one big-endian number of the protocol, and a zero byte.
    page: Annotated[int, wire.Number("Hx", "page_address", order=">")]
    data: Annotated[bytes, wire.RestBytes(shown=len, label="data_len")]


@command(_BOOTLOADER, BootloaderCode.START_APP, name="BOOTLOADER_START_APP")
@dataclass(frozen=True, slots=True, kw_only=True)
class BootloaderStartApp(Command[Response]):
    """Leave the bootloader for the application. 4.12."""

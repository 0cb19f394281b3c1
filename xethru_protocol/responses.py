"""Rows of the message table: answers, DATA and HIL; what the module sends but APPDATA.

Names in dumps are those of the golden vectors. Section numbers refer to the Protocol reference.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from xethru_protocol import wire, wire_lists
from xethru_protocol.codes import ElementType, ResponseCode, SystemCode, error_name
from xethru_protocol.table import Response, response

FloatArray = npt.NDArray[np.float32]


@response(ResponseCode.XTS_SPR_ACK, name="ACK")
@dataclass(frozen=True, slots=True, kw_only=True)
class Ack(Response):
    """The command was carried out. 5."""


@response(
    ResponseCode.XTS_SPR_ERROR,
    name="ERROR",
    derived={"code_name": lambda message: error_name(message.code) or None},
)
@dataclass(frozen=True, slots=True, kw_only=True)
class Error(Response):
    """The command was refused; ``code`` is 0 ... 2**32 - 1. 5.1."""

    code: Annotated[int, wire.U32]


@response(ResponseCode.XTS_SPR_PONG, name="PONG")
@dataclass(frozen=True, slots=True, kw_only=True)
class Pong(Response):
    """Answer to Ping: a `PongCode`. 5."""

    value: Annotated[int, wire.ID32]


@response(
    ResponseCode.XTS_SPR_SYSTEM,
    name="SYSTEM",
    derived={
        "code_name": lambda message: next(
            (code.name.removeprefix("XTS_SPRS_") for code in SystemCode if code == message.code),
            None,
        )
    },
)
@dataclass(frozen=True, slots=True, kw_only=True)
class System(Response):
    """The module tells its state unasked: a `SystemCode`. 5."""

    code: Annotated[int, wire.U32]


_REPLY = ResponseCode.XTS_SPR_REPLY
_DATA = ResponseCode.XTS_SPR_DATA
_CONTENT_ID = wire.Number("I", shown=wire.short_hexadecimal)


@response(_REPLY, ElementType.XTS_SPRD_NONE, name="REPLY NONE")
@dataclass(frozen=True, slots=True, kw_only=True)
class ReplyNone(Response):
    """Answer without elements; no firmware is known to send it. 5.2."""

    content_id: Annotated[int, _CONTENT_ID] = 0
    info: Annotated[int, wire.U32] = 0
    trailer: Annotated[int | None, wire.OptionalByte(shown_if_absent=True)] = None


@response(_REPLY, ElementType.XTS_SPRD_BYTE, name="REPLY BYTE")
@dataclass(frozen=True, slots=True, kw_only=True)
class ReplyByte(Response):
    """Answer of bytes. 5.2."""

    content_id: Annotated[int, _CONTENT_ID] = 0
    info: Annotated[int, wire.U32] = 0
    values: Annotated[bytes, wire.Elements("c", 1, "values", trailer=1, trailer_shown=True)]


@response(_REPLY, ElementType.XTS_SPRD_INT, name="REPLY INT")
@dataclass(frozen=True, slots=True, kw_only=True)
class ReplyInt(Response):
    """Answer of signed 32-bit integers; the only REPLY without trailer. 5.2."""

    content_id: Annotated[int, _CONTENT_ID] = 0
    info: Annotated[int, wire.U32] = 0
    values: Annotated[tuple[int, ...], wire.Elements("i", 4, "values", trailer_shown=True)]


@response(_REPLY, ElementType.XTS_SPRD_FLOAT, name="REPLY FLOAT")
@dataclass(frozen=True, slots=True, kw_only=True)
class ReplyFloat(Response):
    """Answer of float32 values, as exact Python floats. 5.2."""

    content_id: Annotated[int, _CONTENT_ID] = 0
    info: Annotated[int, wire.U32] = 0
    values: Annotated[
        tuple[float, ...], wire.Elements("f", 4, "values", trailer=4, trailer_shown=True)
    ]


@response(_REPLY, ElementType.XTS_SPRD_STRING, name="REPLY STRING")
@dataclass(frozen=True, slots=True, kw_only=True)
class ReplyString(Response):
    """Answer of text, one character per byte. 5.2."""

    content_id: Annotated[int, _CONTENT_ID] = 0
    info: Annotated[int, wire.U32] = 0
    text: Annotated[str, wire.Elements("s", 1, "value", trailer=1, trailer_shown=True)]


@response(_REPLY, ElementType.XTS_SPRD_USER, name="REPLY USER")
@dataclass(frozen=True, slots=True, kw_only=True)
class ReplyUser(Response):
    """Answer of a user structure, as bytes. 5.2."""

    content_id: Annotated[int, _CONTENT_ID] = 0
    info: Annotated[int, wire.U32] = 0
    values: Annotated[bytes, wire.Elements("c", 1, "values", trailer=1, trailer_shown=True)]


@response(_DATA, ElementType.XTS_SPRD_FLOAT, name="DATA FLOAT", bulk=True)
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DataFloat(Response):
    """A radar frame. 6.1.

    ``info`` is the frame counter. ``values``, shape (n,), float32, read-only: RF amplitudes by
    increasing range, or all I then all Q of a downconverted frame; the message does not say
    which.
    """

    content_id: Annotated[int, wire.U32] = 0
    info: Annotated[int, wire.U32]
    values: Annotated[FloatArray, wire.Elements("a", 4, "data", count_label="length")]

    def __eq__(self, other: object) -> bool:
        """Equal if every bit of every sample is (NaNs included)."""
        if not isinstance(other, DataFloat):
            return NotImplemented
        return (self.content_id, self.info, self.values.tobytes()) == (
            other.content_id,
            other.info,
            other.values.tobytes(),
        )

    def __hash__(self) -> int:
        """Hash of the header; frames with equal headers are compared by their samples."""
        return hash((self.content_id, self.info, self.values.size))


@response(_DATA, ElementType.XTS_SPRD_BYTE, name="DATA BYTE", bulk=True)
@dataclass(frozen=True, slots=True, kw_only=True)
class DataByte(Response):
    """Generic bytes. 6.2."""

    content_id: Annotated[int, wire.U32] = 0
    info: Annotated[int, wire.U32] = 0
    values: Annotated[bytes, wire.Elements("c", 1, "data", count_label="length")]


@response(_DATA, ElementType.XTS_SPRD_STRING, name="DATA STRING")
@dataclass(frozen=True, slots=True, kw_only=True)
class DataString(Response):
    """Debug text, one character per byte. 6.2."""

    content_id: Annotated[int, wire.U32] = 0
    info: Annotated[int, wire.U32] = 0
    text: Annotated[str, wire.Elements("s", 1, "value", count_label="length")]


@response(_DATA, ElementType.XTS_SPRD_USER, name="DATA USER")
@dataclass(frozen=True, slots=True, kw_only=True)
class DataUser(Response):
    """A user structure. 6.2."""

    content_id: Annotated[int, wire.U32] = 0
    info: Annotated[int, wire.U32] = 0
    values: Annotated[bytes, wire.Elements("c", 1, "data", count_label="length")]


def _type_name(code: int) -> str:
    name = next((kind.name for kind in ElementType if kind == code), f"{code:02X}")
    return name.removeprefix("XTS_SPRD_").lower()


@response(ResponseCode.XTS_SPR_HIL, name="HIL")
@dataclass(frozen=True, slots=True, kw_only=True)
class HilReply(Response):
    """Hardware-in-the-loop traffic, not used by an X4M300: a `HilCommand` and elements. 5.4.

    ``values`` are bytes, text, or a tuple of numbers, as ``datatype`` (`ElementType`) says.
    """

    datatype: Annotated[int, wire.Number("B", shown=_type_name)]
    hil_command: Annotated[int, wire.U32]
    info: Annotated[int, wire.U32] = 0
    values: Annotated[
        bytes | str | tuple[int, ...] | tuple[float, ...],
        wire_lists.TypedElements(
            "datatype",
            {
                ElementType.XTS_SPRD_NONE: wire.Elements("c", 1, "data", count_label="length"),
                ElementType.XTS_SPRD_BYTE: wire.Elements("c", 1, "data", count_label="length"),
                ElementType.XTS_SPRD_INT: wire.Elements("i", 4, "data", count_label="length"),
                ElementType.XTS_SPRD_FLOAT: wire.Elements("f", 4, "data", count_label="length"),
                ElementType.XTS_SPRD_STRING: wire.Elements("s", 1, "data", count_label="length"),
                ElementType.XTS_SPRD_USER: wire.Elements("c", 1, "data", count_label="length"),
            },
        ),
    ] = b""

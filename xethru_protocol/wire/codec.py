"""Payload bytes to messages and back, driven by the message table.

Decoding never raises on wire input: what no row describes, and what is shorter than its row,
becomes an `UnknownMessage`. Bytes behind the last field are ignored, as the firmware ignores
them (Protocol reference 3).
"""

import math
import struct
from typing import Any, cast

import numpy as np

from xethru_protocol.wire.codes import BootloaderCode, CommandCode, ElementType, ResponseCode
from xethru_protocol.wire.errors import LocalProtocolError
from xethru_protocol.wire.fields import FLOAT32, hex_bytes
from xethru_protocol.wire.messages import DataFloat  # importing messages enters all rows
from xethru_protocol.wire.table import (
    COMMANDS,
    RESPONSES,
    ROWS,
    Command,
    Message,
    Prefixes,
    Response,
    Row,
    UnknownMessage,
)


def encode(message: Message, *, bulk: bool | None = None) -> bytes:
    """Payload of ``message``; an `UnknownMessage` is sent as it is.

    ``bulk`` tells whether the packet will travel in NoEscape framing, where an empty element list
    still has its count; None: as a real module sends this message. Raises `LocalProtocolError` if a
    field does not fit its place on the wire.

    >>> from xethru_protocol.wire.messages import Ping
    >>> encode(Ping()).hex(" ")
    '01 ae ea aa ee'
    """
    if isinstance(message, UnknownMessage):
        return message.payload
    row = ROWS[type(message)]
    framed_in_bulk = row.bulk if bulk is None else bulk
    fields = _fields(message, row)
    parts = [row.prefix]
    for name, kind in row.kinds:
        try:
            parts.append(kind.pack(fields.get(name), fields, framed_in_bulk))
        except (struct.error, ValueError, TypeError, OverflowError) as error:
            what = f"{name}={fields[name]!r}" if name in fields else name
            raise LocalProtocolError(f"{row.name} cannot carry {what}: {error}") from None
    return b"".join(parts)


def message_type(prefixes: Prefixes, payload: bytes) -> type[Message] | None:
    """Type whose prefix is the longest that fits a payload; None if there is none."""
    for length in prefixes.lengths.get(payload[0], ()) if payload else ():
        cls = prefixes.types.get(payload[:length])
        if cls is not None:
            return cls
    return None


def decode_command(payload: bytes) -> Command[Response]:
    """Message of a host-to-module payload.

    >>> decode_command(bytes.fromhex("50 10 10 00 00 00 00 00 A0 41"))
    X4DriverSet(setting=<X4Setting.FPS: 16>, value_width=None, value=20.0)
    """
    return cast(Command[Response], _build(COMMANDS, payload))


def decode_response(payload: bytes) -> Response:
    """Message of a module-to-host payload.

    >>> decode_response(bytes.fromhex("20 01 00 00 00"))
    Error(code=1)
    """
    return cast(Response, _build(RESPONSES, payload))


_FRAME_HEADER = struct.Struct("<III")  # content id, info, count: from payload byte 2
_FRAME_CODES = bytes((ResponseCode.XTS_SPR_DATA, ElementType.XTS_SPRD_FLOAT))
_new_frame = object.__new__
# A frozen dataclass pays an object.__setattr__ per field; the slots' own setters do not.
_set_content_id = vars(DataFloat)["content_id"].__set__
_set_info = vars(DataFloat)["info"].__set__
_set_values = vars(DataFloat)["values"].__set__
_array = np.frombuffer


def decode_response_at(buffer: bytes, start: int, end: int) -> Response:
    """Message of the payload ``buffer[start:end]``, copying a frame's samples once.

    The way of every radar frame; same result as ``decode_response(buffer[start:end])``.
    """
    if buffer[start : start + 2] == _FRAME_CODES and end - start > 14:
        content_id, info, count = _FRAME_HEADER.unpack_from(buffer, start + 2)
        first = start + 14
        if first + 4 * count == end:
            frame = _new_frame(DataFloat)
            _set_content_id(frame, content_id)
            _set_info(frame, info)
            _set_values(frame, _array(buffer[first:end], FLOAT32))
            return frame
    return decode_response(buffer[start:end])


_UNKNOWN_SUB_COMMAND = "BOOTLOADER unknown sub-command"  # a bootloader answers it otherwise


def _is_bootloaders(payload: bytes) -> bool:
    bootloader = payload[:1] == bytes((CommandCode.XTS_SPC_BOOTLOADER,))
    return bootloader and len(payload) > 1 and payload[1] not in set(BootloaderCode)


_NOT_FINITE = {math.inf: "Infinity", -math.inf: "-Infinity"}


def describe(message: Message) -> tuple[str, dict[str, Any]]:
    """Name and JSON-able fields of a message, named as in the golden vectors.

    >>> describe(decode_response(bytes.fromhex("01 EA AE EE AA")))
    ('PONG', {'value': '0xAAEEAEEA'})

    Floats that JSON does not have are shown as "NaN", "Infinity" and "-Infinity".
    """
    if isinstance(message, UnknownMessage):
        shown: dict[str, Any] = {"code": message.code, "payload": hex_bytes(message.payload)}
        return _UNKNOWN_SUB_COMMAND if _is_bootloaders(message.payload) else "UNKNOWN", shown
    row = ROWS[type(message)]
    fields = _fields(message, row)
    shown = {}
    for name, kind in row.kinds:
        shown |= kind.show(name, fields.get(name), fields)
    shown |= row.derived(message)
    return row.name, {name: _json_able(value) for name, value in shown.items()}


def _json_able(value: Any) -> Any:  # noqa: ANN401 - any entry of a dump
    """Spell out floats that JSON has no number for."""
    if isinstance(value, list) and not all(map(_is_json_able, value)):
        return [_json_able(item) for item in value]
    return value if _is_json_able(value) else _NOT_FINITE.get(value, "NaN")


def _is_json_able(value: Any) -> bool:  # noqa: ANN401 - likewise
    return not isinstance(value, float) or math.isfinite(value)


def _build(prefixes: Prefixes, payload: bytes) -> Message:
    cls = message_type(prefixes, payload)
    if cls is not None:
        row = ROWS[cls]
        position = len(row.prefix)
        fields: dict[str, Any] = {}
        try:
            for name, kind in row.kinds:
                fields[name], position = kind.unpack(payload, position, fields)
        except (struct.error, ValueError, KeyError):
            pass
        else:
            for name in row.wire_only:
                del fields[name]
            return cls(**fields)
    return UnknownMessage(code=payload[0] if payload else -1, payload=payload)


def _fields(message: Message, row: Row) -> dict[str, Any]:
    return {name: getattr(message, name) for name in row.fields}

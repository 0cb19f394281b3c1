"""What the faults need to see in a packet: its class, its payload, a frame's samples."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from xethru_protocol.codes import ElementType, ResponseCode
from xethru_protocol.connection import Connection, Role
from xethru_protocol.messages import Command, Response
from xethru_protocol.packets import (
    ESCAPE,
    NO_ESCAPE_HEADER_BYTES,
    NO_ESCAPE_START,
    START,
    encode_no_escape,
    unescape,
)

__all__ = [
    "FrameParts",
    "PacketClass",
    "classify",
    "command_bytes",
    "frame_counter",
    "frame_packet",
    "frame_parts",
    "normal_payload",
    "response_bytes",
]

_FRAME = struct.Struct("<4sIxBBIII")
_PAYLOAD = struct.Struct("<BBIII")
_WRAP = 1 << 32
_REPLIES = frozenset(
    {
        ResponseCode.XTS_SPR_PONG,
        ResponseCode.XTS_SPR_ACK,
        ResponseCode.XTS_SPR_REPLY,
        ResponseCode.XTS_SPR_ERROR,
    }
)


class PacketClass(Enum):
    """What a packet from the module is."""

    FRAME = "frame"
    """A radar frame, RF or baseband. Protocol reference 6.1."""
    REPLY = "reply"
    """ACK, ERROR, PONG or REPLY: answers a command. Protocol reference 3."""
    SYSTEM = "system"
    """BOOTING, READY and the like. Protocol reference 5."""
    DATA = "data"
    """Anything else: profile output, strings, and bytes that are no packet."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameParts:
    """A radar frame taken apart; ``samples`` float32, shape (n,), read-only."""

    counter: int
    samples: NDArray[np.float32]


def classify(packet: bytes) -> PacketClass:
    """Return what a packet is, by its first bytes.

    >>> classify(bytes.fromhex("7D 10 6D 7E"))
    <PacketClass.REPLY: 'reply'>
    """
    if packet.startswith(NO_ESCAPE_START):
        return PacketClass.FRAME if frame_counter(packet) is not None else PacketClass.DATA
    if len(packet) < 4 or packet[0] != START:
        return PacketClass.DATA
    code = packet[2] if packet[1] == ESCAPE else packet[1]
    if code in _REPLIES:
        return PacketClass.REPLY
    return PacketClass.SYSTEM if code == ResponseCode.XTS_SPR_SYSTEM else PacketClass.DATA


def frame_counter(packet: bytes) -> int | None:
    """Return the counter of a radar frame; None for anything else."""
    if len(packet) < _FRAME.size:
        return None
    magic, length, code, kind, content_id, counter, count = _FRAME.unpack_from(packet)
    is_frame = (
        magic == NO_ESCAPE_START
        and (code, kind, content_id) == (ResponseCode.XTS_SPR_DATA, ElementType.XTS_SPRD_FLOAT, 0)
        and length == len(packet) - NO_ESCAPE_HEADER_BYTES == _PAYLOAD.size + 4 * count
    )
    return counter if is_frame else None


def frame_parts(packet: bytes) -> FrameParts | None:
    """Return counter and samples of a radar frame; None for anything else."""
    counter = frame_counter(packet)
    if counter is None:
        return None
    return FrameParts(counter=counter, samples=np.frombuffer(packet, "<f4", offset=_FRAME.size))


def frame_packet(counter: int, samples: NDArray[np.float32]) -> bytes:
    """Return a radar frame in NoEscape framing; the counter wraps at 2**32."""
    head = _PAYLOAD.pack(
        ResponseCode.XTS_SPR_DATA,
        ElementType.XTS_SPRD_FLOAT,
        0,
        counter % _WRAP,
        samples.size,
    )
    return encode_no_escape(head + samples.astype("<f4", copy=False).tobytes())


def normal_payload(packet: bytes) -> bytes | None:
    """Return the unescaped payload of a Normal packet; None if it is none."""
    if len(packet) < 4 or packet[0] != START:
        return None
    return unescape(packet[1:-1])[:-1]


def response_bytes(message: Response) -> bytes:
    """Return a message as a module sends it."""
    return Connection(Role.MODULE).send(message)


def command_bytes(command: Command[Response]) -> bytes:
    """Return a command as a host sends it."""
    return Connection(Role.HOST).send(command)

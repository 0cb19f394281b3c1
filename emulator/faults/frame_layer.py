"""Faults of the frame layer: packets that are malformed, or well formed and wrong."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Annotated

from pydantic import Field

from emulator.faults.dice import Dice
from emulator.faults.kind import Context, Kind, Layer, Parameters, Piece, Target
from emulator.faults.packets import (
    normal_payload,
    response_bytes,
)
from xethru_protocol.messages import DataString
from xethru_protocol.packets import (
    END,
    ESCAPE,
    MAX_NORMAL_BYTES,
    NO_ESCAPE_START,
    START,
    encode_normal,
    xor,
)

__all__ = ["KINDS"]

_SPECIAL = (START, END, ESCAPE)
_UNKNOWN_CODE = 0xB7
_UNKNOWN_CONTENT = struct.pack("<BI", 0x50, 0x0DDBA11)
_STRAY_TEXT = "between command and answer"


class _Cut(Parameters):
    keep: Annotated[int, Field(ge=1, le=65_535, description="bytes that are sent")] = 3


def _whole_normal(packet: bytes) -> bytes | None:
    """Return the payload of an intact Normal packet."""
    payload = normal_payload(packet)
    return payload if payload and encode_normal(payload) == packet else None


def _bad_checksum(
    packet: bytes, wanted: Parameters, dice: Dice, context: Context
) -> Sequence[Piece] | None:
    del wanted, context
    payload = _whole_normal(packet)
    if payload is None:
        return None
    right = START ^ xor(payload)
    wrong = [code for code in range(256) if code != right and code not in _SPECIAL]
    body = encode_normal(payload)
    end = -3 if right in _SPECIAL else -2  # the right one was escaped
    return [Piece(body[:end] + bytes((wrong[dice.below(len(wrong))], END)))]


def _cut_normal(
    change: Callable[[bytes], bytes],
) -> Callable[[bytes, Parameters, Dice, Context], Sequence[Piece] | None]:
    def effect(
        packet: bytes, wanted: Parameters, dice: Dice, context: Context
    ) -> Sequence[Piece] | None:
        del wanted, dice, context
        return None if _whole_normal(packet) is None else [Piece(change(packet))]

    return effect


def _before(
    stray: bytes,
) -> Callable[[bytes, Parameters, Dice, Context], Sequence[Piece]]:
    def effect(packet: bytes, wanted: Parameters, dice: Dice, context: Context) -> Sequence[Piece]:
        del wanted, dice, context
        return [Piece(stray + packet)]

    return effect


def _truncated(packet: bytes, wanted: _Cut, dice: Dice, context: Context) -> Sequence[Piece] | None:
    del dice, context
    return None if wanted.keep >= len(packet) else [Piece(packet[: wanted.keep])]


def _cancelling_flips(
    packet: bytes, wanted: Parameters, dice: Dice, context: Context
) -> Sequence[Piece] | None:
    """Flip one bit in two bytes of the content, so that the XOR of all stays the same."""
    del wanted, context
    payload = _whole_normal(packet)
    first = 10  # behind content id and info of a REPLY, so that the answer still fits the question
    if payload is None or len(payload) < first + 6:
        return None
    changed = bytearray(payload)
    mask = 1 << dice.below(8)
    place = first + 4 + dice.below(len(payload) - first - 5)
    for index in (place, place + 1):
        changed[index] ^= mask
    return [Piece(encode_normal(bytes(changed)))]


def _checksum_needs_escape() -> bytes:
    """Return an intact packet of an unknown code whose checksum is 7E."""
    return encode_normal(bytes((_UNKNOWN_CODE, END ^ START ^ _UNKNOWN_CODE)))


def _unescaped_end(packet: bytes) -> bytes:
    """Put an unescaped end behind the first payload byte."""
    return packet[:2] + bytes((END,)) + packet[2:]


_OVERSIZED = bytes((START,)) + bytes(2 * MAX_NORMAL_BYTES + 8) + bytes((END,))
_FALSE_BULK = NO_ESCAPE_START + bytes(4) + b"\x00"


def _row(  # noqa: PLR0917 - the columns of a table
    name: str,
    target: Target,
    summary: str,
    counted: str,
    effect: Callable[..., Sequence[Piece] | None],
    parameters: type[Parameters] = Parameters,
    hidden: str = "",
) -> Kind:
    return Kind(
        name=name,
        layer=Layer.FRAME,
        target=target,
        summary=summary,
        counted=counted,
        effect=effect,
        parameters=parameters,
        hidden=hidden,
    )


_LOST_REPLY = "ResponseTimeout where a reply was waited for"

KINDS = (
    _row(
        "bad_checksum",
        Target.REPLY,
        "The checksum of a Normal packet is wrong.",
        f"1 fault 'wrong checksum'; {_LOST_REPLY}",
        _bad_checksum,
    ),
    _row(
        "escaped_checksum",
        Target.PACKET,
        "An intact packet of an unknown code, whose checksum needs an escape, comes before.",
        "1 unknown",
        _before(_checksum_needs_escape()),
    ),
    _row(
        "missing_end",
        Target.REPLY,
        "The end byte of a Normal packet is missing.",
        f"1 fault at the next packet; {_LOST_REPLY}",
        _cut_normal(lambda packet: packet[:-1]),
    ),
    _row(
        "missing_start",
        Target.REPLY,
        "The start byte of a Normal packet is missing.",
        f"1 fault 'bytes between packets'; {_LOST_REPLY}",
        _cut_normal(lambda packet: packet[1:]),
    ),
    _row(
        "double_start",
        Target.REPLY,
        "A Normal packet has two start bytes.",
        "1 junk byte, no fault: nothing was lost",
        _cut_normal(lambda packet: packet[:1] + packet),
    ),
    _row(
        "double_end",
        Target.REPLY,
        "A Normal packet has two end bytes.",
        "1 fault 'bytes between packets', 1 junk byte",
        _cut_normal(lambda packet: packet + packet[-1:]),
    ),
    _row(
        "early_end",
        Target.REPLY,
        "An unescaped end byte stands inside a Normal packet.",
        f"1 fault; {_LOST_REPLY}",
        _cut_normal(_unescaped_end),
    ),
    _row(
        "truncated_reply",
        Target.REPLY,
        "Only the first bytes of a reply are sent.",
        f"1 fault at the next packet; {_LOST_REPLY}",
        _truncated,
        _Cut,
    ),
    _row(
        "oversized",
        Target.PACKET,
        "A Normal packet that is longer than any receiver accepts comes before.",
        "1 fault 'packet longer than any receiver accepts'",
        _before(_OVERSIZED),
    ),
    _row(
        "empty_packet",
        Target.PACKET,
        "A packet without payload comes before.",
        "1 fault 'packet without payload'",
        _before(bytes((START, END))),
    ),
    _row(
        "unknown_response",
        Target.PACKET,
        "An intact packet of an unknown code comes before.",
        "1 unknown",
        _before(encode_normal(bytes((_UNKNOWN_CODE, 1, 2, 3)))),
    ),
    _row(
        "unknown_content",
        Target.PACKET,
        "An intact profile message with an unknown content id comes before.",
        "1 unknown",
        _before(encode_normal(_UNKNOWN_CONTENT)),
    ),
    _row(
        "stray_data",
        Target.REPLY,
        "A data message stands between a command and its answer.",
        "nothing",
        _before(response_bytes(DataString(text=_STRAY_TEXT))),
        hidden="Data may precede any reply; a driver that stumbles over it is wrong.",
    ),
    _row(
        "false_bulk_start",
        Target.PACKET,
        "A NoEscape start with length 0 comes before.",
        "1 fault 'implausible NoEscape header'",
        _before(_FALSE_BULK),
    ),
    _row(
        "cancelling_flips",
        Target.REPLY,
        "The same bit of two bytes of a reply is inverted.",
        "nothing",
        _cancelling_flips,
        hidden="The 8-bit XOR is the same; of random damage it passes 1 in 256.",
    ),
)

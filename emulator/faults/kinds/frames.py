"""Faults of the frame layer that hit radar frames: their header, their samples, their framing."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from emulator.faults.kind import (
    Context,
    Kind,
    Layer,
    PacketClass,
    Parameters,
    Piece,
    Target,
    frame_packet,
    frame_parts,
    normal_payload,
    response_bytes,
)
from emulator.scene.philox import Dice
from xethru_protocol.wire.framing import (
    END,
    ESCAPE,
    MAX_NORMAL_BYTES,
    NO_ESCAPE_HEADER_BYTES,
    NO_ESCAPE_START,
    START,
    encode_normal,
    xor,
)
from xethru_protocol.wire.messages import Ack, DataString

_SPECIAL = (START, END, ESCAPE)
_UNKNOWN_CODE = 0xB7
_UNKNOWN_CONTENT = struct.pack("<BI", 0x50, 0x0DDBA11)
_STRAY_TEXT = "between command and answer"


class _Cut(Parameters):
    keep: Annotated[int, Field(ge=1, le=65_535, description="bytes that are sent")] = 3


def _whole_normal(packet: bytes) -> bytes | None:
    payload = normal_payload(packet)
    return payload if payload and encode_normal(payload) == packet else None


def _bad_checksum(
    packet: bytes, wanted: Parameters, dice: Dice, context: Context
) -> Sequence[Piece] | None:
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
        return None if _whole_normal(packet) is None else [Piece(change(packet))]

    return effect


def _before(
    stray: bytes,
) -> Callable[[bytes, Parameters, Dice, Context], Sequence[Piece]]:
    def effect(packet: bytes, wanted: Parameters, dice: Dice, context: Context) -> Sequence[Piece]:
        return [Piece(stray + packet)]

    return effect


def _truncated(packet: bytes, wanted: _Cut, dice: Dice, context: Context) -> Sequence[Piece] | None:
    return None if wanted.keep >= len(packet) else [Piece(packet[: wanted.keep])]


def _cancelling_flips(
    packet: bytes, wanted: Parameters, dice: Dice, context: Context
) -> Sequence[Piece] | None:
    """Flip one bit in two bytes of the content, so that the XOR of all stays the same."""
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


class _Samples(Parameters):
    samples: Annotated[int, Field(ge=1, le=1536, description="how many samples")] = 1


class _Bins(Parameters):
    more: Annotated[int, Field(ge=-1536, le=1536, description="bins more than asked for")] = -1


class _Length(Parameters):
    more: Annotated[
        int, Field(ge=-65_535, le=65_535, description="what is added to the length field")
    ] = 1


def _spoiled(
    spoil: Callable[[NDArray[np.float32], Context], NDArray[np.float32] | None],
) -> Callable[[bytes, _Samples, Dice, Context], Sequence[Piece] | None]:
    """Return an effect that replaces some samples of a frame."""

    def effect(
        packet: bytes, wanted: _Samples, dice: Dice, context: Context
    ) -> Sequence[Piece] | None:
        parts = frame_parts(packet)
        if parts is None or parts.samples.size < wanted.samples:
            return None
        places: set[int] = set()
        while len(places) < wanted.samples:
            places.add(dice.below(parts.samples.size))
        chosen = sorted(places)
        samples = parts.samples.copy()
        spoiled = spoil(samples[chosen], context)
        if spoiled is None:
            return None
        samples[chosen] = spoiled
        return [Piece(frame_packet(parts.counter, samples))]

    return effect


def _constant(
    value: float,
) -> Callable[[NDArray[np.float32], Context], NDArray[np.float32]]:
    return lambda samples, context: np.full_like(samples, value)


def _between_values(samples: NDArray[np.float32], context: Context) -> NDArray[np.float32] | None:
    if context.lattice is None:
        return None
    # between two chip counters, whatever the sample was
    half = np.float32(context.lattice.quantum / context.lattice.tap_sum / 2)
    inside = np.where(samples + half > np.float32(context.lattice.highest), -half, half)
    return (samples + inside).astype(np.float32)


def _another_value(samples: NDArray[np.float32], context: Context) -> NDArray[np.float32] | None:
    if context.lattice is None:
        return None
    middle = np.float32((context.lattice.lowest + context.lattice.highest) / 2)
    quarter = np.float32((context.lattice.highest - context.lattice.lowest) / 4)
    return context.lattice.nearest(np.where(samples > middle, samples - quarter, samples + quarter))


def _wrong_bins(packet: bytes, wanted: _Bins, dice: Dice, context: Context) -> list[Piece] | None:
    parts = frame_parts(packet)
    if parts is None or wanted.more == 0 or parts.samples.size + wanted.more < 1:
        return None
    return [
        Piece(
            frame_packet(parts.counter, np.resize(parts.samples, parts.samples.size + wanted.more))
        )
    ]


def _wrong_length(
    packet: bytes, wanted: _Length, dice: Dice, context: Context
) -> list[Piece] | None:
    if not packet.startswith(NO_ESCAPE_START) or wanted.more == 0:
        return None
    length = len(packet) - NO_ESCAPE_HEADER_BYTES + wanted.more
    if not 0 <= length < 1 << 32:
        return None
    return [Piece(NO_ESCAPE_START + length.to_bytes(4, "little") + packet[8:])]


def _inside_frame(
    packet: bytes, wanted: Parameters, dice: Dice, context: Context
) -> list[Piece] | None:
    if context.packet_class is not PacketClass.FRAME:
        return None
    middle = len(packet) // 2
    return [Piece(packet[:middle] + response_bytes(Ack()) + packet[middle:])]


def _normal_framed(
    packet: bytes, wanted: Parameters, dice: Dice, context: Context
) -> list[Piece] | None:
    payload = packet[NO_ESCAPE_HEADER_BYTES:]
    if not packet.startswith(NO_ESCAPE_START) or not 0 < len(payload) < MAX_NORMAL_BYTES:
        return None
    return [Piece(encode_normal(payload))]


def _bulk_row(  # noqa: PLR0917 - the columns of a table
    name: str,
    summary: str,
    counted: str,
    effect: Callable[..., Sequence[Piece] | None],
    parameters: type[Parameters] = Parameters,
    hidden: str = "",
) -> Kind:
    return Kind(
        name=name,
        layer=Layer.FRAME,
        target=Target.FRAME,
        summary=summary,
        counted=counted,
        effect=effect,
        parameters=parameters,
        hidden=hidden,
    )


BULK_KINDS = (
    _bulk_row(
        "truncated_frame",
        "Only the first bytes of a radar frame are sent.",
        "1 frame lost, 1 fault; the next frame's first bytes are taken for samples",
        _truncated,
        _Cut,
    ),
    _bulk_row(
        "nan_samples",
        "Samples of a frame are no numbers.",
        "off_lattice_samples = samples",
        _spoiled(_constant(float("nan"))),
        _Samples,
    ),
    _bulk_row(
        "infinite_samples",
        "Samples of a frame are infinite.",
        "off_lattice_samples = samples",
        _spoiled(_constant(float("inf"))),
        _Samples,
    ),
    _bulk_row(
        "denormal_samples",
        "Samples of a frame are denormal numbers.",
        "off_lattice_samples = samples",
        _spoiled(_constant(1e-40)),
        _Samples,
    ),
    _bulk_row(
        "off_lattice_samples",
        "Samples lie between two values that the chip can give.",
        "off_lattice_samples = samples",
        _spoiled(_between_values),
        _Samples,
    ),
    _bulk_row(
        "in_range_samples",
        "Samples are replaced by other values that the chip can give.",
        "nothing",
        _spoiled(_another_value),
        _Samples,
        hidden="NoEscape packets carry no checksum, and the new values are as good as the old.",
    ),
    _bulk_row(
        "wrong_bin_count",
        "A frame has another number of bins than the settings make.",
        "1 frame discarded, 1 frame lost",
        _wrong_bins,
        _Bins,
    ),
    _bulk_row(
        "wrong_length",
        "The length of a NoEscape packet contradicts its content.",
        "1 fault 'implausible NoEscape header', 1 frame lost",
        _wrong_length,
        _Length,
    ),
    _bulk_row(
        "packet_inside_frame",
        "An ACK stands inside a frame.",
        "1 fault, 4 junk bytes; the frame's later samples are shifted by one",
        _inside_frame,
    ),
    _bulk_row(
        "normal_framed",
        "A frame comes in Normal framing.",
        "nothing",
        _normal_framed,
        hidden="A host must accept both framings for every message.",
    ),
)

"""Faults of the frame layer: wrong framing of any packet, and wrong samples of radar frames."""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np
from pydantic import Field

from emulator.faults.kind import (
    Catalogued,
    Context,
    Layer,
    Parameters,
    Piece,
    Pieces,
    RfSamples,
    Target,
    changed_frame,
    normal_payload,
    response_bytes,
)
from emulator.scene.philox import Rng
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

of_reply = Catalogued(Layer.FRAME, Target.REPLY)
of_packet = Catalogued(Layer.FRAME, Target.PACKET)
of_frame = Catalogued(Layer.FRAME, Target.FRAME)

_SPECIAL = (START, END, ESCAPE)
_UNKNOWN_CODE = 0xB7
_UNKNOWN_CONTENT = struct.pack("<BI", 0x50, 0x0DDBA11)
_LOST_REPLY = "ResponseTimeout where a reply was waited for"


class _BytesSent(Parameters):
    keep: int = Field(3, ge=1, le=65_535, description="bytes that are sent")


class _Samples(Parameters):
    samples: int = Field(1, ge=1, le=1536, description="how many samples")


class _MoreBins(Parameters):
    more: int = Field(-1, ge=-1536, le=1536, description="bins more than asked for")


class _Length(Parameters):
    more: int = Field(1, ge=-65_535, le=65_535, description="what is added to the length field")


def _whole_normal(packet: bytes) -> bytes | None:
    payload = normal_payload(packet)
    return payload if payload and encode_normal(payload) == packet else None


def _changed(packet: bytes, changed: bytes) -> Pieces:
    return None if _whole_normal(packet) is None else [Piece(changed)]


def _replaced(
    packet: bytes,
    wanted: _Samples,
    rng: Rng,
    replace: Callable[[RfSamples], RfSamples],
) -> Pieces:
    """Return a frame of which some samples, chosen at random, are replaced."""

    def change(samples: RfSamples) -> RfSamples | None:
        if samples.size < wanted.samples:
            return None
        places: set[int] = set()
        while len(places) < wanted.samples:
            places.add(rng.below(samples.size))
        chosen = sorted(places)
        changed = samples.copy()
        changed[chosen] = replace(changed[chosen])
        return changed

    return changed_frame(packet, change)


@of_reply(f"1 fault 'wrong checksum'; {_LOST_REPLY}")
def bad_checksum(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """The checksum of a Normal packet is wrong."""
    payload = _whole_normal(packet)
    if payload is None:
        return None
    right = START ^ xor(payload)
    wrong = [code for code in range(256) if code != right and code not in _SPECIAL]
    body = encode_normal(payload)
    end = -3 if right in _SPECIAL else -2  # the right one was escaped
    return [Piece(body[:end] + bytes((wrong[rng.below(len(wrong))], END)))]


@of_packet("1 unknown")
def escaped_checksum(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """An intact packet of an unknown code, whose checksum needs an escape, comes before."""
    checksum_is_end = encode_normal(bytes((_UNKNOWN_CODE, END ^ START ^ _UNKNOWN_CODE)))
    return [Piece(checksum_is_end + packet)]


@of_reply(f"1 fault at the next packet; {_LOST_REPLY}")
def missing_end(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """The end byte of a Normal packet is missing."""
    return _changed(packet, packet[:-1])


@of_reply(f"1 fault 'bytes between packets'; {_LOST_REPLY}")
def missing_start(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """The start byte of a Normal packet is missing."""
    return _changed(packet, packet[1:])


@of_reply("1 junk byte, no fault: nothing was lost")
def double_start(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """A Normal packet has two start bytes."""
    return _changed(packet, packet[:1] + packet)


@of_reply("1 fault 'bytes between packets', 1 junk byte")
def double_end(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """A Normal packet has two end bytes."""
    return _changed(packet, packet + packet[-1:])


@of_reply(f"1 fault; {_LOST_REPLY}")
def early_end(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """An unescaped end byte stands inside a Normal packet."""
    return _changed(packet, packet[:2] + bytes((END,)) + packet[2:])


def _cut(packet: bytes, wanted: _BytesSent) -> Pieces:
    return None if wanted.keep >= len(packet) else [Piece(packet[: wanted.keep])]


@of_reply(f"1 fault at the next packet; {_LOST_REPLY}", _BytesSent)
def truncated_reply(packet: bytes, wanted: _BytesSent, rng: Rng, context: Context) -> Pieces:
    """Only the first bytes of a reply are sent."""
    return _cut(packet, wanted)


@of_packet("1 fault 'packet longer than any receiver accepts'")
def oversized(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """A Normal packet that is longer than any receiver accepts comes before."""
    longest = bytes((START, *bytes(2 * MAX_NORMAL_BYTES + 8), END))
    return [Piece(longest + packet)]


@of_packet("1 fault 'packet without payload'")
def empty_packet(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """A packet without payload comes before."""
    return [Piece(bytes((START, END)) + packet)]


@of_packet("1 unknown")
def unknown_response(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """An intact packet of an unknown code comes before."""
    return [Piece(encode_normal(bytes((_UNKNOWN_CODE, 1, 2, 3))) + packet)]


@of_packet("1 unknown")
def unknown_content(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """An intact profile message with an unknown content id comes before."""
    return [Piece(encode_normal(_UNKNOWN_CONTENT) + packet)]


@of_reply("nothing", hidden="Data may precede any reply; a driver that stumbles over it is wrong.")
def stray_data(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """A data message stands between a command and its answer."""
    return [Piece(response_bytes(DataString(text="between command and answer")) + packet)]


@of_packet("1 fault 'implausible NoEscape header'")
def false_bulk_start(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """A NoEscape start with length 0 comes before."""
    return [Piece(NO_ESCAPE_START + bytes(4) + b"\x00" + packet)]


@of_reply("nothing", hidden="The 8-bit XOR is the same; of random damage it passes 1 in 256.")
def cancelling_flips(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """The same bit of two bytes of a reply is inverted."""
    payload = _whole_normal(packet)
    first = 10  # behind content id and info of a REPLY, so that the answer still fits the question
    if payload is None or len(payload) < first + 6:
        return None
    changed = bytearray(payload)
    mask = 1 << rng.below(8)
    place = first + 4 + rng.below(len(payload) - first - 5)
    for index in (place, place + 1):
        changed[index] ^= mask
    return [Piece(encode_normal(bytes(changed)))]


@of_frame("1 frame lost, 1 fault; the next frame's first bytes are taken for samples", _BytesSent)
def truncated_frame(packet: bytes, wanted: _BytesSent, rng: Rng, context: Context) -> Pieces:
    """Only the first bytes of a radar frame are sent."""
    return _cut(packet, wanted)


@of_frame("off_lattice_samples = samples", _Samples)
def nan_samples(packet: bytes, wanted: _Samples, rng: Rng, context: Context) -> Pieces:
    """Samples of a frame are NaN."""
    return _replaced(packet, wanted, rng, lambda samples: np.full_like(samples, np.nan))


@of_frame("off_lattice_samples = samples", _Samples)
def infinite_samples(packet: bytes, wanted: _Samples, rng: Rng, context: Context) -> Pieces:
    """Samples of a frame are infinite."""
    return _replaced(packet, wanted, rng, lambda samples: np.full_like(samples, np.inf))


@of_frame("off_lattice_samples = samples", _Samples)
def denormal_samples(packet: bytes, wanted: _Samples, rng: Rng, context: Context) -> Pieces:
    """Samples of a frame are denormal numbers."""
    return _replaced(packet, wanted, rng, lambda samples: np.full_like(samples, 1e-40))


@of_frame("off_lattice_samples = samples", _Samples)
def off_lattice_samples(packet: bytes, wanted: _Samples, rng: Rng, context: Context) -> Pieces:
    """Samples lie between two values that the chip can give."""
    lattice = context.lattice
    if lattice is None:
        return None
    half = np.float32(lattice.quantum / 2)
    highest = np.float32(lattice.highest)

    def between(samples: RfSamples) -> RfSamples:
        # between two chip counters, whatever the sample was
        return (samples + np.where(samples + half > highest, -half, half)).astype(np.float32)

    return _replaced(packet, wanted, rng, between)


@of_frame(
    "nothing",
    _Samples,
    hidden="NoEscape packets carry no checksum, and the new values are as good as the old.",
)
def in_range_samples(packet: bytes, wanted: _Samples, rng: Rng, context: Context) -> Pieces:
    """Samples are replaced by other values that the chip can give."""
    lattice = context.lattice
    if lattice is None:
        return None
    middle = np.float32((lattice.lowest + lattice.highest) / 2)
    quarter = np.float32((lattice.highest - lattice.lowest) / 4)
    return _replaced(
        packet,
        wanted,
        rng,
        lambda samples: lattice.nearest(
            np.where(samples > middle, samples - quarter, samples + quarter)
        ),
    )


@of_frame("1 frame discarded, 1 frame lost", _MoreBins)
def wrong_bin_count(packet: bytes, wanted: _MoreBins, rng: Rng, context: Context) -> Pieces:
    """A frame has another number of bins than the settings make."""

    def resized(samples: RfSamples) -> RfSamples | None:
        n_bins = samples.size + wanted.more
        return np.resize(samples, n_bins) if wanted.more and n_bins >= 1 else None

    return changed_frame(packet, resized)


@of_frame("1 fault 'implausible NoEscape header', 1 frame lost", _Length)
def wrong_length(packet: bytes, wanted: _Length, rng: Rng, context: Context) -> Pieces:
    """The length of a NoEscape packet contradicts its content."""
    if not packet.startswith(NO_ESCAPE_START) or wanted.more == 0:
        return None
    length = len(packet) - NO_ESCAPE_HEADER_BYTES + wanted.more
    if not 0 <= length < 1 << 32:
        return None
    return [Piece(NO_ESCAPE_START + length.to_bytes(4, "little") + packet[8:])]


@of_frame("1 fault, 4 junk bytes; the frame's later samples are shifted by one")
def packet_inside_frame(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """An ACK stands inside a frame."""
    middle = len(packet) // 2
    return [Piece(packet[:middle] + response_bytes(Ack()) + packet[middle:])]


@of_frame("nothing", hidden="A host must accept both framings for every message.")
def normal_framed(packet: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """A frame comes in Normal framing."""
    payload = packet[NO_ESCAPE_HEADER_BYTES:]
    if not packet.startswith(NO_ESCAPE_START) or not 0 < len(payload) < MAX_NORMAL_BYTES:
        return None
    return [Piece(encode_normal(payload))]

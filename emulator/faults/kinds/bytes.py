"""Faults of the byte layer: what a bad line does to bytes, whatever they mean."""

from __future__ import annotations

from pydantic import Field

from emulator.faults.kind import Catalogued, Context, Layer, Parameters, Piece, Pieces, Target
from emulator.module.settings import received_bytes
from emulator.scene.philox import Rng
from xethru_protocol.wire.framing import ESCAPE, START

of_packet = Catalogued(Layer.BYTE, Target.PACKET)

_FLOW_CONTROL = b"\x11\x13"
_CALM = bytes(code for code in range(256) if code not in b"\x7c\x7d\x7e\x7f")


class _At(Parameters):
    at: int | None = Field(
        None, ge=0, le=65_535, description="byte of the packet; random if not given"
    )

    def place(self, data: bytes, rng: Rng) -> int:
        return rng.below(len(data)) if self.at is None else min(self.at, len(data) - 1)


class _Several(_At):
    bytes: int = Field(1, ge=1, le=4096, description="how many bytes")


class _Flip(_At):
    bits: int = Field(1, ge=1, le=64, description="how many bits, anywhere from `at` on")


class _Burst(Parameters):
    enter: float = Field(0.01, ge=0, le=1, description="chance per byte that it starts")
    leave: float = Field(0.2, gt=0, le=1, description="chance per byte that it ends")
    flip: float = Field(0.3, gt=0, le=1, description="chance per bit within it")


class _WriteGap(Parameters):
    gap_us: float = Field(0.0, ge=0, le=100_000, description="pause between writes, us")


class _WriteSize(_WriteGap):
    bytes: int = Field(4095, ge=1, le=65_536, description="bytes per write")


class _Baud(Parameters):
    sent: int = Field(921_600, ge=300, le=4_000_000, description="rate of the sender, baud")
    heard: int = Field(115_200, ge=300, le=4_000_000, description="rate of the host, baud")


def _cut(data: bytes, size: int, gap_us: float) -> Pieces:
    return [
        Piece(data[at : at + size], delay_ns=round(at // size * gap_us * 1000))
        for at in range(0, len(data), size)
    ]


_DAMAGE = "one damaged place, of the kind that the byte's role makes it"
_SAME_BYTES = "The bytes are the same; a receiver that depended on how they are cut would be wrong."


@of_packet(_DAMAGE, _Several)
def drop_bytes(data: bytes, wanted: _Several, rng: Rng, context: Context) -> Pieces:
    """Bytes of a packet are lost."""
    at = wanted.place(data, rng)
    return [Piece(data[:at] + data[at + wanted.bytes :])]


@of_packet(_DAMAGE, _Several)
def duplicate_bytes(data: bytes, wanted: _Several, rng: Rng, context: Context) -> Pieces:
    """Bytes of a packet come twice."""
    end = wanted.place(data, rng) + 1
    return [Piece(data[:end] + data[max(end - wanted.bytes, 0) : end] + data[end:])]


@of_packet(f"{_DAMAGE}; in a frame's samples off_lattice_samples", _Flip)
def flip_bits(data: bytes, wanted: _Flip, rng: Rng, context: Context) -> Pieces:
    """Bits of a packet are inverted."""
    flipped = bytearray(data)
    first = 0 if wanted.at is None else wanted.place(data, rng)
    room = 8 * (1 if wanted.at is not None and wanted.bits <= 8 else len(data) - first)
    places: set[int] = set()
    while len(places) < min(wanted.bits, room):
        places.add(rng.below(room))
    for place in places:
        flipped[first + place // 8] ^= 1 << place % 8
    return [Piece(bytes(flipped))]


@of_packet(_DAMAGE, _Several)
def insert_bytes(data: bytes, wanted: _Several, rng: Rng, context: Context) -> Pieces:
    """Random bytes appear inside a packet."""
    at = wanted.place(data, rng)
    return [Piece(data[:at] + rng.data(wanted.bytes) + data[at:])]


@of_packet("1 fault 'bytes between packets' and junk_bytes = bytes", _Several)
def noise_between(data: bytes, wanted: _Several, rng: Rng, context: Context) -> Pieces:
    """Random bytes without a start appear before a packet."""
    noise = bytes(_CALM[rng.below(len(_CALM))] for _ in range(wanted.bytes))
    return [Piece(noise + data)]


@of_packet(f"{_DAMAGE}; in a frame's samples off_lattice_samples", _Burst)
def burst_errors(data: bytes, wanted: _Burst, rng: Rng, context: Context) -> Pieces:
    """Bursts of bit errors after Gilbert and Elliott."""
    bad = False
    damaged = bytearray(data)
    for index in range(len(damaged)):
        bad = not rng.chance(wanted.leave) if bad else rng.chance(wanted.enter)
        if bad:
            damaged[index] ^= sum(1 << bit for bit in range(8) if rng.chance(wanted.flip))
    return None if damaged == data else [Piece(bytes(damaged))]


@of_packet("1 fault; 2 where the byte behind it was 7D, which is a start now")
def escape_lost(data: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """An escape byte of a Normal packet is lost."""
    if data[:1] != bytes((START,)):
        return None
    places, index = [], 1
    while index < len(data):
        if data[index] == ESCAPE:
            places.append(index)
            index += 1  # what follows is literal
        index += 1
    if not places:
        return None
    at = places[rng.below(len(places))]
    return [Piece(data[:at] + data[at + 1 :])]


@of_packet(_DAMAGE)
def flow_control_swallowed(data: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """A line with XON/XOFF swallows bytes 11 and 13."""
    left = data.translate(None, _FLOW_CONTROL)
    return None if left == data else [Piece(left)]


@of_packet(_DAMAGE)
def seven_bits(data: bytes, wanted: Parameters, rng: Rng, context: Context) -> Pieces:
    """A line of seven bits clears the highest bit of every byte."""
    left = bytes(byte & 0x7F for byte in data)
    return None if left == data else [Piece(left)]


@of_packet("nothing", _WriteSize, hidden=_SAME_BYTES)
def split_writes(data: bytes, wanted: _WriteSize, rng: Rng, context: Context) -> Pieces:
    """A packet comes in several writes."""
    return _cut(data, wanted.bytes, wanted.gap_us)


@of_packet("nothing", _WriteGap, hidden=_SAME_BYTES)
def one_byte_writes(data: bytes, wanted: _WriteGap, rng: Rng, context: Context) -> Pieces:
    """A packet comes byte by byte."""
    return _cut(data, 1, wanted.gap_us)


@of_packet("the packet is missing; what is received of it counts as junk", _Baud)
def wrong_baud(data: bytes, wanted: _Baud, rng: Rng, context: Context) -> Pieces:
    """Sender and host disagree on the UART's rate; computed from the bits on the line."""
    if wanted.sent == wanted.heard:
        return None
    return [Piece(received_bytes(data, wanted.sent, wanted.heard))]

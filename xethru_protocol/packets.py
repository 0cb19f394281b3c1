"""Packets and their two framings, towards the wire.

Normal framing escapes 7D, 7E, 7F and ends with an XOR checksum; NoEscape framing announces a
length and has neither (Protocol reference 1.1, 1.3).
"""

from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np

from xethru_protocol.errors import LocalProtocolError
from xethru_protocol.plausibility import MAX_LENGTH

START: Final = 0x7D
END: Final = 0x7E
ESCAPE: Final = 0x7F
NO_ESCAPE_START: Final = b"\x7c\x7c\x7c\x7c"
NO_ESCAPE_HEADER_BYTES: Final = 9
MAX_NORMAL_BYTES: Final = 7999  # payload and checksum, unescaped: the vendor's parser buffer


class Framing(Enum):
    """How a packet is delimited."""

    NORMAL = "normal"
    NO_ESCAPE = "noescape"


class NeedData(Enum):
    """Type of `NEED_DATA`."""

    NEED_DATA = "need data"


NEED_DATA: Final = NeedData.NEED_DATA  # nothing to report until more bytes are received


class FaultKind(Enum):
    """What was wrong with bytes that belong to no packet."""

    GARBAGE = "bytes between packets"
    CHECKSUM = "wrong checksum"
    TRUNCATED = "packet cut short by a new start"
    EMPTY = "packet without payload"
    OVERSIZE = "packet longer than any receiver accepts"
    HEADER = "implausible NoEscape header"
    INCOMPLETE = "packet cut off by the end of the data"


@dataclass(frozen=True, slots=True, kw_only=True)
class FramingFault:
    """Damage on the line; ``offset`` counts bytes from the start of the stream.

    One fault is reported per damaged place: what a rescan rejects inside bytes that were
    already reported is not reported again.
    """

    kind: FaultKind
    offset: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Packet:
    """A received packet: its payload, unescaped and without checksum."""

    framing: Framing
    payload: bytes
    offset: int


def encode_normal(payload: bytes) -> bytes:
    """Frame a payload with escapes and checksum.

    >>> encode_normal(bytes.fromhex("24 02 7D")).hex(" ")
    '7d 24 02 7f 7d 26 7e'

    Raises
    ------
    LocalProtocolError
        If the payload is empty or too long for any receiver.
    """
    if not 1 <= len(payload) < MAX_NORMAL_BYTES:
        raise LocalProtocolError(
            f"a Normal packet carries 1 to {MAX_NORMAL_BYTES - 1} bytes, not {len(payload)}"
        )
    body = payload + bytes((START ^ xor(payload),))
    escaped = body.replace(b"\x7f", b"\x7f\x7f")  # first: the others bring new 7F
    escaped = escaped.replace(b"\x7d", b"\x7f\x7d").replace(b"\x7e", b"\x7f\x7e")
    return b"\x7d" + escaped + b"\x7e"


def encode_no_escape(payload: bytes) -> bytes:
    r"""Frame a payload behind its length.

    >>> encode_no_escape(b"\x01\x02\x03").hex(" ")
    '7c 7c 7c 7c 03 00 00 00 00 01 02 03'

    Raises
    ------
    LocalProtocolError
        If the payload is empty or longer than receivers believe.
    """
    if not 1 <= len(payload) <= MAX_LENGTH:
        raise LocalProtocolError(
            f"a NoEscape packet carries 1 to {MAX_LENGTH} bytes, not {len(payload)}"
        )
    return NO_ESCAPE_START + len(payload).to_bytes(4, "little") + b"\0" + payload


def unescape(body: bytes) -> bytes:
    r"""Drop the escape bytes of a Normal packet's inside; what follows each is literal.

    >>> unescape(b"\x10\x7f\x7e\x7f\x7f\x04")
    b'\x10~\x7f\x04'
    """
    if ESCAPE not in body:
        return body
    parts = body.split(b"\x7f")
    if b"" not in parts:
        return b"".join(parts)
    # Each part stands behind a 7F; an empty one means that the next stands behind two.
    rest = iter(parts[1:])
    literal = [part or b"\x7f" + next(rest, b"") for part in rest]
    return parts[0] + b"".join(literal)


def xor(data: bytes) -> int:
    r"""XOR of all bytes; the checksum of a packet also counts its start byte.

    >>> xor(b"\x01\x02\x04")
    7
    """
    if len(data) < 64:
        folded = 0
        for byte in data:
            folded ^= byte
        return folded
    words = len(data) >> 3
    folded = int(np.bitwise_xor.reduce(np.frombuffer(data, np.uint64, words)))
    folded ^= int.from_bytes(data[words << 3 :], "little")
    folded ^= folded >> 32
    folded ^= folded >> 16
    return (folded ^ folded >> 8) & 0xFF

"""Packets in their two framings, and the receiver that finds them in any bytes.

Normal framing escapes 7D, 7E, 7F and ends with an XOR checksum; NoEscape framing announces a
length and has neither (Protocol reference 1.1, 1.3). A receiver that trusts a damaged length
field loses all that follows, so a NoEscape header is judged by its length and at most the first 14
payload bytes, in the same way by every receiver (1.4).

All positions are offsets in the stream; a buffer is given with the offset ``base`` of its first
byte.

The receiver guarantees, for any bytes in any chunks:

- The packets and faults depend on the bytes only, not on how they were cut into chunks.
- It never raises, and once it asks for data it holds less than one packet (65 544 bytes) that
  is not judged, in whatever chunks these came.
- Starts are tried in the order of their position and the first that holds wins. So an intact
  packet is found unless an earlier start makes a valid packet out of its bytes: a Normal packet
  whose checksum happens to fit (1 in 256 for random bytes; always when the end of an intact
  packet became 7F, since the two checksums cancel) or a NoEscape header that happens to be
  consistent. Junk without a start cannot hide anything; a stray 7D delays what follows until
  it is refuted, by the next unescaped 7D or 7E or at the longest possible packet.
- A Normal packet of an unknown kind gives way to a plausible NoEscape header inside it: its
  checksum fits by chance in 1 of 256 cases, a header in hardly any. A known one is data throughout.
- Every byte is searched and parsed a bounded number of times, for any input. In a
  run of damaged packets all within one window are judged, and counted, together.
- `LinkStatistics` counts every byte: in a packet, junk, or not judged yet.

The last but one rests on one fact. Let a Normal packet started at s be parsed up to its
terminator t. A 7D between the two was not a terminator, so it was escaped, so the parse is in
the same state behind it as a parse started *at* it. Therefore all starts between s and t share
the terminator t, and their contents are suffixes of the first's: one scan serves them all.
"""

import re
import struct
from bisect import bisect_left, bisect_right
from collections import Counter, deque
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from xethru_protocol.wire.codes import AppDataId, CommandCode, ElementType, ResponseCode
from xethru_protocol.wire.errors import LocalProtocolError

HEAD_BYTES = 14  # payload bytes needed to judge
MAX_LENGTH = 65535
_VENDOR_LIMIT = 7995  # what the module's own parser can receive
_LENGTH = struct.Struct("<I")


class Direction(Enum):
    """Which way bytes travel; what a payload may be depends on it."""

    FROM_HOST = "from host"
    FROM_MODULE = "from module"


_KNOWN = {
    Direction.FROM_HOST: frozenset(int(code) for code in CommandCode),
    Direction.FROM_MODULE: frozenset(int(code) for code in ResponseCode),
}

_ELEMENT_BYTES: dict[int, int] = {
    ElementType.XTS_SPRD_BYTE: 1,
    ElementType.XTS_SPRD_INT: 4,
    ElementType.XTS_SPRD_FLOAT: 4,
    ElementType.XTS_SPRD_STRING: 1,
    ElementType.XTS_SPRD_USER: 1,
}
# Messages that end with their elements: bytes per element, by type.
_LISTS: dict[int, dict[int, int]] = {
    ResponseCode.XTS_SPR_DATA: _ELEMENT_BYTES,
    ResponseCode.XTS_SPR_HIL: _ELEMENT_BYTES | {ElementType.XTS_SPRD_NONE: 1},
}
# APPDATA with bulk content: (header bytes, offset of the bin count if within the head, bytes
# per bin). Pulse-Doppler and noise maps count their bins behind the head.
_APPDATA: dict[int, tuple[int, int | None, int]] = {
    AppDataId.XTS_ID_BASEBAND_IQ: (29, 9, 8),
    AppDataId.XTS_ID_BASEBAND_AMPLITUDE_PHASE: (29, 9, 8),
    AppDataId.XTS_ID_PULSEDOPPLER_FLOAT: (49, None, 4),
    AppDataId.XTS_ID_PULSEDOPPLER_BYTE: (57, None, 1),
    AppDataId.XTS_ID_NOISEMAP_FLOAT: (49, None, 4),
    AppDataId.XTS_ID_NOISEMAP_BYTE: (57, None, 1),
    AppDataId.XTS_ID_RADAR_RF: (33, 9, 4),
    AppDataId.XTS_ID_RADAR_RF_NORMALIZED: (33, 9, 4),
    AppDataId.XTS_ID_RADAR_BASEBAND_FLOAT: (49, 9, 8),
    AppDataId.XTS_ID_RADAR_BASEBAND_Q15: (53, 9, 4),
}


def plausible(  # noqa: PLR0911 - one return per kind of message
    length: int, head: bytes, direction: Direction
) -> bool:
    """Whether a NoEscape packet may announce ``length`` payload bytes starting with ``head``.

    ``head`` is the payload's first ``min(length, HEAD_BYTES)`` bytes.

    >>> head = bytes.fromhex("A0 12 00 00 00 00 2A 00 00 00 01 00 00 00")
    >>> plausible(18, head, Direction.FROM_MODULE), plausible(19, head, Direction.FROM_MODULE)
    (True, False)
    """
    if not 1 <= length <= MAX_LENGTH or head[0] not in _KNOWN[direction]:
        return False
    if length < HEAD_BYTES:
        return True
    code = head[0]
    from_module = direction is Direction.FROM_MODULE
    if code in _LISTS and from_module:
        size = _LISTS[code].get(head[1])
        return size is not None and HEAD_BYTES + _count(head, 10) * size == length
    if code == ResponseCode.XTS_SPR_REPLY and from_module:
        size = _ELEMENT_BYTES.get(head[1])
        trailers = (0,) if head[1] == ElementType.XTS_SPRD_INT else (0, 1)  # may be left out
        return size is not None and length - HEAD_BYTES - _count(head, 10) * size in trailers
    if code == ResponseCode.XTS_SPR_APPDATA and from_module:
        layout = _APPDATA.get(_count(head, 1))
        if layout is None:
            return length <= _VENDOR_LIMIT
        header, count_at, size = layout
        if count_at is None:
            return length >= header and (length - header) % size == 0
        return header + _count(head, count_at) * size == length
    # The rest is a few bytes long and never sent this way by a real module or host.
    return length <= (HEAD_BYTES if from_module else _VENDOR_LIMIT)


def _count(head: bytes, offset: int) -> int:
    (count,) = _LENGTH.unpack_from(head, offset)
    return int(count)


# --- packets and faults

START: Final = 0x7D
END: Final = 0x7E
ESCAPE: Final = 0x7F
NO_ESCAPE_START: Final = b"\x7c\x7c\x7c\x7c"
NO_ESCAPE_HEADER_BYTES: Final = 9
MAX_NORMAL_BYTES: Final = 7999  # payload and checksum, unescaped: the vendor's parser buffer
MAX_NORMAL_WIRE_BYTES: Final = 2 * MAX_NORMAL_BYTES + 2  # all escaped, with start and end


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
    """Frame a payload with escapes and checksum; `LocalProtocolError` if it is empty or too long.

    >>> encode_normal(bytes.fromhex("24 02 7D")).hex(" ")
    '7d 24 02 7f 7d 26 7e'
    """
    if not 1 <= len(payload) < MAX_NORMAL_BYTES:
        raise LocalProtocolError(
            f"a Normal packet carries 1 to {MAX_NORMAL_BYTES - 1} bytes, not {len(payload)}"
        )
    body = payload + bytes((START ^ xor(payload),))
    escaped = body.replace(b"\x7f", b"\x7f\x7f")  # first: the others bring new 7F
    escaped = escaped.replace(b"\x7d", b"\x7f\x7d").replace(b"\x7e", b"\x7f\x7e")
    return b"\x7d" + escaped + b"\x7e"


def is_misread(payload: bytes) -> bool:
    r"""Whether a module takes a part of this Normal packet for the start of a NoEscape packet.

    The vendor's parser looks for it everywhere, behind the escapes and in the checksum, and takes
    what follows for a length: it answers no more for as long. Protocol reference 1.2.

    >>> is_misread(b"\x10\x7c\x7c\x7c"), is_misread(b"\x7d\x7c\x7c\x7c")
    (False, True)
    """
    return b"\x7c\x7c\x7c" in payload and NO_ESCAPE_START in payload + bytes(
        (START ^ xor(payload),)
    )


def encode_no_escape(payload: bytes) -> bytes:
    r"""Frame a payload behind its length; `LocalProtocolError` if it is empty or too long.

    >>> encode_no_escape(b"\x01\x02\x03").hex(" ")
    '7c 7c 7c 7c 03 00 00 00 00 01 02 03'
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


@dataclass(slots=True, kw_only=True)
class LinkStatistics:
    """Totals since the link was opened; each part of the receiver counts what it alone can see.

    The receiver: ``bytes`` received, ``packets`` found, ``junk_bytes`` that belong to no packet,
    ``resyncs`` (starts that were rejected and scanned on behind) and ``faults`` by kind, one per
    damaged place. So ``bytes`` = bytes of packets + ``junk_bytes`` + bytes not judged yet.
    The connection: ``unknown`` packets, intact but described by no row of the message table.
    The frame queue: ``frames_lost`` by gaps of the frame counter, over a reconnect by the time
    without frames; and ``off_lattice_samples``, which no chip counter can give, so that they were
    damaged although nothing else showed it (NoEscape packets carry no checksum). Where most
    samples of a frame are off the lattice, it is at least so many: the rest is not judged.

    >>> statistics = LinkStatistics(bytes=8, junk_bytes=8, resyncs=1)
    >>> statistics.faults[FaultKind.CHECKSUM] += 1
    >>> statistics.checksum_failures, statistics.summary()["faults"]
    (1, {'wrong checksum': 1})
    """

    bytes: int = 0
    packets: int = 0
    junk_bytes: int = 0
    resyncs: int = 0
    unknown: int = 0
    frames_lost: int = 0
    off_lattice_samples: int = 0
    faults: Counter[FaultKind] = field(default_factory=Counter)

    @property
    def checksum_failures(self) -> int:
        """Damaged places that were a Normal packet with a wrong checksum."""
        return self.faults[FaultKind.CHECKSUM]

    @property
    def clean(self) -> bool:
        return not (
            self.faults
            or self.junk_bytes
            or self.resyncs
            or self.unknown
            or self.frames_lost
            or self.off_lattice_samples
        )

    def summary(self) -> dict[str, int | dict[str, int]]:
        """JSON-able totals; faults by the text of their kind."""
        return {
            "bytes": self.bytes,
            "packets": self.packets,
            "junk_bytes": self.junk_bytes,
            "resyncs": self.resyncs,
            "checksum_failures": self.checksum_failures,
            "unknown": self.unknown,
            "frames_lost": self.frames_lost,
            "off_lattice_samples": self.off_lattice_samples,
            "faults": {kind.value: count for kind, count in self.faults.items() if count},
        }


# --- search

NEVER: Final = 1 << 62  # a stream offset that is not reached

_NEAR: Final = 256  # in which most packets end: looked at before more is marked
_WORTH_MARKING: Final = 2048  # fewer bytes are searched faster by a regular expression
_WORTH_MARKING_DAMAGED: Final = 512  # there the next terminators are near, and many
_WINDOW: Final = 65536  # most bytes marked at once
_WINDOW_DAMAGED: Final = 8192  # fewer where most are looked at one by one
# Greedy, but never tried again: what is in front of an unescaped 7D or 7E, or of a last 7F.
_CONTENT = re.compile(rb"[^\x7d-\x7f]*(?:\x7f.[^\x7d-\x7f]*)*", re.DOTALL)


class PatternFinder:
    """Where a byte pattern comes next."""

    __slots__ = ("_found", "_pattern", "_searched")

    def __init__(self, pattern: bytes) -> None:
        self._pattern = pattern
        self._found = -1
        self._searched = 0

    def next(self, buffer: bytes, base: int, here: int, stop: int = NEVER) -> int:
        """Find the first pattern that begins at ``here`` or behind, before ``stop``; else NEVER."""
        if here <= self._found:
            return self._found if self._found < stop else NEVER
        begin = max(here, self._searched)
        if begin >= stop:
            return NEVER
        limit = base + len(buffer)
        across = len(self._pattern) - 1
        at = buffer.find(self._pattern, begin - base, min(stop + across, limit) - base)
        if at >= 0:
            self._found = self._searched = base + at
            return self._found
        self._searched = max(begin, min(stop, limit - across))
        return NEVER


class TerminatorFinder:
    """Where the next 7D or 7E stands that is not escaped: it ends a Normal packet, well or badly.

    Escaped is a byte behind an odd number of 7F in a row. A start is not 7F, so that run lies
    behind the start whatever start is asked for: which bytes are terminators depends on none,
    and those of a whole window can be marked at once.

    ``searched`` is the offset up to which the bytes are known; the byte there is not escaped.
    ``window`` are the bytes that were marked last.
    """

    __slots__ = ("_found", "_next", "searched", "window")

    def __init__(self) -> None:
        self._found: list[int] = []  # ascending
        self._next = 0  # index in it of the first behind the last start
        self.window = _MarkedBytes(b"", 0, 0, 0)  # where they were found, unless there is only one
        self.searched = 0

    def after(
        self, buffer: bytes, base: int, start: int, reach: int, *, damaged: bool = False
    ) -> int:
        """Find the first terminator behind the packet start at ``start``.

        -1 if it is not in the buffer, or farther than ``reach`` bytes behind the start.
        Where the stream is ``damaged``, the next ones are near and many.
        """
        while True:
            self._next = bisect_right(self._found, start, self._next)
            if self._next < len(self._found):
                return self._found[self._next]
            at = max(start + 1, self.searched) - base
            left = len(buffer) - at
            if left <= 0 or base + at > start + reach:
                return -1
            few = left < (_WORTH_MARKING_DAMAGED if damaged else _WORTH_MARKING)
            if few or not damaged:
                stop = at + (left if few else _NEAR)
                content = _CONTENT.match(buffer, at, stop)
                at = content.end() if content else at  # it always matches
                self.searched = base + at
                if at < stop and buffer[at] != ESCAPE:
                    self._found, self._next = [base + at], 0
                    self.searched += 1
                    continue
                if stop == len(buffer):
                    return -1
            size = _WINDOW_DAMAGED if damaged else _WINDOW
            self.window = window = _MarkedBytes(buffer, base, at, size)
            self._found, self._next, self.searched = window.found, 0, window.end

    def follower(self, start: int) -> tuple[bytes, int] | None:
        """Content and end of a packet that starts right behind the end found last, or None.

        Only within the window; the end may be a 7D.
        """
        found, end = self._found, self._next + 2
        if end < len(found) and found[end - 1] == start:
            self._next = end
            return self.window.content(end), found[end]
        return None

    def content(self, buffer: bytes, base: int, start: int) -> bytes:
        """Unescape what lies between ``start`` and the terminator just found behind it."""
        if self._next and self._found[self._next - 1] == start:
            return self.window.content(self._next)
        return unescape(buffer[start + 1 - base : self._found[self._next] - base])


Bytes = NDArray[np.uint8]
Places = NDArray[np.intp]


def _mark(raw: Bytes) -> tuple[Places, Places]:
    """Find terminators and escaping bytes; the first byte is not escaped."""
    special = (raw - np.uint8(START) < 3).nonzero()[0]  # 7D to 7F; less wraps around
    is_escape = raw[special] == ESCAPE
    apart = special[1:] - special[:-1] != 1
    apart |= ~is_escape[:-1]
    # Behind a 7F that is not escaped itself stands one that is: pairs, from the left.
    is_free = np.frombuffer(b"\1" + apart.tobytes().replace(b"\0\0", b"\0\1"), np.bool_)
    return special[is_free > is_escape], special[is_free & is_escape]


def _without(raw: Bytes, drop: Places) -> bytes:
    """Drop the escaping bytes."""
    keep = np.ones(raw.size, np.bool_)
    keep[drop] = False
    return raw[keep].tobytes()


class _MarkedBytes:
    """Bytes whose terminators were marked together; the first of them is not escaped.

    ``found`` are the offsets of the terminators, ``end`` is that of the first byte behind the
    window that is not escaped by it.
    """

    __slots__ = ("_base", "_bounds", "_drop", "_judged", "_places", "_raw", "_rest", "end", "found")

    def __init__(self, buffer: bytes, base: int, begin: int, size: int) -> None:
        piece = buffer[begin : begin + size]  # a copy: the buffer may be large, and done with
        self._base = base + begin
        self._raw = np.frombuffer(piece, np.uint8)
        self._places, self._drop = _mark(self._raw)
        self._rest = b""  # the window without escaping bytes, made when the first packet asks
        self._bounds: list[int] = []  # where the terminators lie in that
        self._judged: _Judged | None = None
        self.found: list[int] = (self._places + self._base).tolist()
        splits = self._drop.size and self._drop[-1] == len(piece) - 1
        self.end = self._base + len(piece) - (1 if splits else 0)

    def content(self, index: int) -> bytes:
        """Unescape what lies between the terminator before the ``index``-th and that one."""
        if not self._rest:
            self._rest = _without(self._raw, self._drop)
            self._bounds = (self._places - np.searchsorted(self._drop, self._places)).tolist()
        return self._rest[self._bounds[index - 1] + 1 : self._bounds[index]]

    def judged(self) -> "_Judged":
        """Judge all starts in the window whose terminators lie in it, too."""
        if self._judged is None:
            self._judged = _judge(self._raw, self._places, self._drop, self._base)
        return self._judged


@dataclass(frozen=True, slots=True, kw_only=True)
class _Judged:
    """Packet starts in groups that share a terminator; lists with a value per group.

    ``first`` is the offset of a group's first start, ``resume`` where to go on if all of its
    starts are rejected, ``kind`` the index in _KINDS of what is reported then, ``resyncs`` the
    number of starts rejected up to and with this group. ``special`` are the indices of groups
    that need a closer look: a start that makes a packet, or a very long one. ``good`` are the
    offsets of all starts that make a packet.
    """

    first: list[int]
    resume: list[int]
    kind: list[int]
    resyncs: list[int]
    special: list[int]
    good: list[int]


_KINDS = (None, FaultKind.TRUNCATED, FaultKind.EMPTY, FaultKind.CHECKSUM)  # None: doubled start


def _judge(raw: Bytes, places: Places, drop: Places, base: int) -> _Judged:
    """Judge the packet starts in ``raw``; its terminators and escaping bytes as of _mark()."""
    content = np.frombuffer(_without(raw, drop), np.uint8)
    ends = places - np.searchsorted(drop, places)
    starts = np.flatnonzero(content == START)
    group = np.searchsorted(ends, starts, side="right")  # the terminator behind each
    n_starts = int(np.searchsorted(group, ends.size))
    if not n_starts:
        return _Judged(first=[], resume=[], kind=[], resyncs=[], special=[], good=[])
    starts, group = starts[:n_starts], group[:n_starts]
    offsets = np.flatnonzero(raw == START)[:n_starts] + base  # the same, with escaping bytes
    end, end_offset = ends[group], places[group] + base
    size = end - starts - 1
    folded = np.bitwise_xor.accumulate(content)
    fits = folded[end - 1] ^ folded[starts] == START  # False without content
    cut_short = content[end] == START
    good = fits & ~cut_short & (size > 1)
    doubled = cut_short & (size == 0)
    kind = np.where(cut_short, np.where(doubled, 0, 1), np.where(fits | (size == 0), 2, 3))
    long = end_offset - offsets > MAX_NORMAL_BYTES
    first = np.flatnonzero(np.diff(group, prepend=-1))
    last = np.append(first[1:], n_starts) - 1
    return _Judged(
        first=offsets[first].tolist(),
        resume=(end_offset + ~cut_short)[first].tolist(),
        kind=kind[first].tolist(),
        resyncs=np.cumsum(~doubled)[last].tolist(),
        special=np.flatnonzero(np.logical_or.reduceat(good | long, first)).tolist(),
        good=offsets[good].tolist(),
    )


# --- the receiver

Span = tuple[Framing, bytes, int, int, int]
"""Framing, buffer, payload start and end in it, offset of the packet in the stream."""

_JOIN_BYTES = 65536  # of what came next, to a Normal packet whose end is not known
# Magic and length, then code, type and element count of a DATA FLOAT.
_FRAME_HEADER = struct.Struct("<4sIxBB8xI")
_ESCAPED = re.compile(rb"\x7f(.)", re.DOTALL)
_RUN_OF_7C = re.compile(rb"\x7c{9,}")
_RUN_OF_7D = re.compile(rb"\x7d+")
_LONGEST_RUN = 1024  # of damaged packets that are reported together
_SHORT = 256  # bytes of a packet whose starts are judged faster without numpy
# A NoEscape start whose length may be right, or is not known yet.
_HEADER_INSIDE = re.compile(rb"\x7c{4}(?:..\x00\x00|.{0,3}\Z)", re.DOTALL)
_new_fault = object.__new__
_set_kind = vars(FramingFault)["kind"].__set__
_set_offset = vars(FramingFault)["offset"].__set__


class PacketReader:
    """Finds packets in received bytes: ``receive_data``, then ``next_packet`` until NEED_DATA.

    ``direction``, who sends the bytes, decides which NoEscape headers are plausible.

    >>> reader = PacketReader()
    >>> reader.receive_data(bytes.fromhex("7D 10 6D 7E"))
    >>> reader.next_packet().payload.hex(), reader.next_packet()
    ('10', <NeedData.NEED_DATA: 'need data'>)
    """

    def __init__(
        self,
        direction: Direction = Direction.FROM_MODULE,
        statistics: LinkStatistics | None = None,
    ) -> None:
        self._direction = direction
        self._known = _KNOWN[direction]
        self.statistics = LinkStatistics() if statistics is None else statistics
        self._buffer = b""  # what is being parsed, from _pos on; never changed in place
        self._pos = 0
        self._base = 0  # stream offset of _buffer[0]; all other positions are stream offsets
        self._queue: deque[bytes] = deque()  # received and not in the buffer yet
        self._taken = 0  # bytes of the queue's first chunk that were moved to the buffer
        self._queued = 0
        self._missing = 1  # bytes without which parsing cannot go on; 0: it can
        self._wanted = 1  # bytes worth joining to the buffer at once
        self._ended = False
        self._damage_end = -1  # end of the bytes a fault was reported for; -1: none since a packet
        self._starts = PatternFinder(b"\x7d")
        self._bulk_starts = PatternFinder(NO_ESCAPE_START)
        self._terminators = TerminatorFinder()
        self._judged = -1  # the last terminator for which a Normal start was judged
        # that share it and have a fitting checksum, ascending; None: not looked for yet
        self._good_starts: list[int] | None = None
        self._swallowed = -1  # a plausible NoEscape header in the packet judged last
        self._faults: deque[FramingFault] = deque()  # found together, not returned yet

    def receive_data(self, data: bytes) -> None:
        """Take bytes as they come from the port, in chunks of any size.

        A ``bytes`` object is kept as it is, without a copy.
        """
        if data:
            self._queue.append(bytes(data))
            self._queued += len(data)
            self.statistics.bytes += len(data)

    def end_data(self) -> None:
        """No more bytes will come: what is incomplete now becomes a fault."""
        self._ended = True

    @property
    def buffered(self) -> int:
        """Bytes received that are not yet part of a reported packet or fault."""
        return len(self._buffer) - self._pos + self._queued

    def next_packet(self) -> Packet | FramingFault | NeedData:
        span = self.next_span()
        if isinstance(span, tuple):
            framing, buffer, start, end, offset = span
            return Packet(framing=framing, payload=buffer[start:end], offset=offset)
        return span

    def next_span(self) -> Span | FramingFault | NeedData:
        """Like ``next_packet``, but returns where the payload lies instead of copying it."""
        if self._faults:
            return self._faults.popleft()
        while True:
            if self._missing and not self._refill():  # parsing would give nothing new
                if not self._ended or not self.buffered:
                    return NEED_DATA
                fault = self._reject_last_start()
                if fault is not None:
                    return fault
            buffer, pos = self._buffer, self._pos
            if len(buffer) - pos < 23:
                pass
            elif buffer[pos] != START:
                # The way of nearly every byte: a consistent DATA FLOAT. It accepts nothing that
                # _no_escape() would not.
                magic, length, code, kind, count = _FRAME_HEADER.unpack_from(buffer, pos)
                end = pos + 9 + length
                if (
                    magic == NO_ESCAPE_START
                    and length == 14 + 4 * count
                    and code == 0xA0
                    and kind == 0x12
                    and length <= MAX_LENGTH
                ):
                    if end > len(buffer):
                        self._need(end - len(buffer))
                        continue
                    self._pos = end
                    self._damage_end = -1
                    self.statistics.packets += 1
                    return Framing.NO_ESCAPE, buffer, pos + 9, end, self._base + pos
            elif self._damage_end < 0:
                packet = self._follower()
                if packet is not None:
                    return packet
            found = self._parse()
            if found is not NEED_DATA:
                return found

    def _follower(self) -> Span | None:
        """Return the Normal packet here if its bytes were marked with those of the one before.

        The way of an escaped frame. It accepts nothing that _normal() would not.
        """
        first = self._base + self._pos
        follower = self._terminators.follower(first)
        if follower is None:
            return None
        content, end = follower
        if (
            self._buffer[end - self._base] != END
            or not 1 < len(content) <= MAX_NORMAL_BYTES
            or content[0] not in self._known
            or xor(content) != START
        ):
            return None
        self._pos = end + 1 - self._base
        self.statistics.packets += 1
        return Framing.NORMAL, content, 0, len(content) - 1, first

    def _reject_last_start(self) -> FramingFault | None:
        """Give up a packet whose end will not come, with all that came of it."""
        if self._queued:
            self._need(self._queued)
            self._refill()
        self._missing = 0
        limit = self._base + len(self._buffer)
        return self._reject(FaultKind.INCOMPLETE, self._base + self._pos, limit)

    def _parse(self) -> Span | FramingFault | NeedData:
        """Next packet or fault in the buffer; NEED_DATA if ``_missing`` more bytes are needed."""
        while True:
            here = self._base + self._pos
            limit = self._base + len(self._buffer)
            if self._buffer.startswith(b"\x7d", self._pos):  # nothing to search for
                start, bulk = here, NEVER
            else:
                start = self._starts.next(self._buffer, self._base, here)
                bulk = self._bulk_starts.next(self._buffer, self._base, here, start)
            first = min(start, bulk)
            junk_end = first if first < NEVER else limit - self._trailing_7c()
            if junk_end > here:
                self._skip_to(junk_end)
                clean = self._damage_end < 0
                self._damage_end = max(self._damage_end, junk_end)
                if clean:
                    return self._fault(FaultKind.GARBAGE, here)
            if first == NEVER:
                return self._need(1, HEAD_BYTES)
            found = self._normal(first) if first == start else self._no_escape(first)
            if found is not None:
                return found

    def _trailing_7c(self) -> int:
        """7Cs at the end of a buffer without a start, which may become one (at most 3)."""
        tail = self._buffer[max(self._pos, len(self._buffer) - 3) :]
        return len(tail) - len(tail.rstrip(b"\x7c"))

    def _reject(
        self, kind: FaultKind, first: int, covered_end: int, resume: int = 0
    ) -> FramingFault | None:
        """Give up a start and go on behind it; a fault unless these bytes had theirs.

        Normal starts before ``resume`` have the same fate and need no report of their own.
        """
        after, starts = first + 1, 1
        if resume > after:
            bulk = self._bulk_starts.next(self._buffer, self._base, after, resume)
            at, after = first - self._base, min(resume, bulk)
            doubled = self._buffer[resume - self._base : resume - self._base + 1] == b"\x7d"
            stop = after - self._base - (doubled and after == resume)
            starts = self._buffer.count(b"\x7d", at, stop)
        self._skip_to(after)
        self.statistics.resyncs += starts
        reported = first < self._damage_end
        self._damage_end = max(self._damage_end, covered_end)
        return None if reported else self._fault(kind, first)

    def _reject_run(self, first: int) -> bool:
        """Give up a run of damaged packets from ``first`` on; False if it is not one."""
        judged = self._terminators.window.judged()
        begin = bisect_left(judged.first, first)
        if begin == len(judged.first) or judged.first[begin] != first:
            return False
        stop = bisect_left(judged.special, begin)
        end = judged.special[stop] if stop < len(judged.special) else len(judged.first)
        bulk = self._bulk_starts.next(self._buffer, self._base, first, judged.resume[end - 1])
        end = min(bisect_right(judged.resume, bulk, begin, end), begin + _LONGEST_RUN)
        if end <= begin:
            return False
        self.statistics.resyncs += judged.resyncs[end - 1] - (
            judged.resyncs[begin - 1] if begin else 0
        )
        begin = bisect_left(judged.first, self._damage_end, begin, end)  # those had their fault
        kinds, append = judged.kind[begin:end], self._faults.append
        for index, kind in enumerate(_KINDS):
            if kind is not None:
                self.statistics.faults[kind] += kinds.count(index)
        for index, offset in zip(kinds, judged.first[begin:end], strict=True):
            if index:
                fault = _new_fault(FramingFault)
                _set_kind(fault, _KINDS[index])
                _set_offset(fault, offset)
                append(fault)
        self._skip_to(judged.resume[end - 1])
        self._damage_end = max(self._damage_end, judged.resume[end - 1])
        return True

    def _fault(self, kind: FaultKind, offset: int) -> FramingFault:
        self.statistics.faults[kind] += 1
        return FramingFault(kind=kind, offset=offset)

    def _skip_to(self, offset: int) -> None:
        self.statistics.junk_bytes += offset - self._base - self._pos
        self._pos = offset - self._base

    def _announced(self, first: int) -> tuple[int, int]:
        """Payload length that a plausible NoEscape header at ``first`` announces, else 0.

        Second the number of bytes without which that cannot be judged.
        """
        at = first - self._base
        have = len(self._buffer) - at
        if have < NO_ESCAPE_HEADER_BYTES:
            return 0, NO_ESCAPE_HEADER_BYTES - have
        (length,) = _LENGTH.unpack_from(self._buffer, at + 4)
        if not 1 <= length <= MAX_LENGTH:
            return 0, 0
        begin = at + NO_ESCAPE_HEADER_BYTES
        head = self._buffer[begin : begin + min(length, HEAD_BYTES)]
        missing = min(length, HEAD_BYTES) - len(head)
        return length if not missing and plausible(length, head, self._direction) else 0, missing

    def _no_escape(self, first: int) -> Span | FramingFault | NeedData | None:
        """Judge the NoEscape packet at ``first``; None if it was rejected without a report."""
        length, missing = self._announced(first)
        if missing:
            return self._need(missing)
        at = first - self._base
        begin = at + NO_ESCAPE_HEADER_BYTES
        if length:
            missing = begin + length - len(self._buffer)
            if missing > 0:
                return self._need(missing)
            self._pos = begin + length
            self._damage_end = -1
            self.statistics.packets += 1
            return Framing.NO_ESCAPE, self._buffer, begin, begin + length, first
        fault = self._reject(FaultKind.HEADER, first, first + len(NO_ESCAPE_START))
        run = _RUN_OF_7C.match(self._buffer, at)
        if run:  # a start whose length would be 7C7C7C7C: all but the last 7 of the run
            last_rejected = self._base + run.end() - 8
            self._skip_to(last_rejected + 1)
            self.statistics.resyncs += last_rejected - first
            self._damage_end = max(self._damage_end, last_rejected + len(NO_ESCAPE_START))
        return fault

    def _swallowed_header(self, first: int, end: int) -> NeedData | int:
        """Find a plausible NoEscape header between ``first`` and ``end``; NEVER: there is none."""
        if first < self._swallowed < end:
            return self._swallowed
        at, stop = first + 1 - self._base, end - self._base
        while inside := _HEADER_INSIDE.search(self._buffer, at, stop + NO_ESCAPE_HEADER_BYTES):
            at = inside.start()
            if at >= stop:
                break
            length, missing = 0, 8 - len(inside[0])
            if not missing:
                length, missing = self._announced(self._base + at)
            if missing and not self._ended:
                return self._need(missing)
            if length:
                self._swallowed = self._base + at
                return self._swallowed
            at += 1
        return NEVER

    def _normal(  # noqa: PLR0911 - one return per row of the state table
        self, first: int
    ) -> Span | FramingFault | NeedData | None:
        """Judge the Normal packet at ``first``; None if it was rejected without a report."""
        finder, damaged, reach = self._terminators, self._damage_end >= 0, MAX_NORMAL_WIRE_BYTES
        end = finder.after(self._buffer, self._base, first, reach, damaged=damaged)
        if damaged and end >= 0 and self._reject_run(first):
            return self._faults.popleft() if self._faults else None
        known = end if end >= 0 else finder.searched
        if known - first > reach:
            resume = min(first, known - 2 * reach) + reach
            fault = self._reject(FaultKind.OVERSIZE, first, first + reach, resume)
            last = self._base + self._buffer.rfind(b"\x7d", first - self._base, self._pos)
            self._damage_end = max(self._damage_end, last + reach)
            return fault
        if end < 0:
            return self._need(1, max(len(self._buffer) - self._pos, _JOIN_BYTES))
        at, stop = first - self._base, end - self._base
        if self._buffer[stop] == START:
            run = _RUN_OF_7D.match(self._buffer, at)
            if run and run.end() > at + 1:  # doubled start: nothing is lost
                self._skip_to(self._base + run.end() - 1)
                return None
            return self._reject(FaultKind.TRUNCATED, first, end, end)
        if end != self._judged:
            self._judged, self._good_starts = end, None
            content = finder.content(self._buffer, self._base, first)
            good = xor(content) == START
        else:
            good = first in self._starts_that_fit(first, end)
            content = unescape(self._buffer[at + 1 : stop]) if good else b""
        if good and 1 < len(content) <= MAX_NORMAL_BYTES:
            return self._accept_normal(first, end, content)
        fitting = self._starts_that_fit(first, end)
        behind = bisect_right(fitting, first)
        resume = fitting[behind] if behind < len(fitting) else end + 1
        if good and len(content) > MAX_NORMAL_BYTES:
            return self._reject(FaultKind.OVERSIZE, first, first + MAX_NORMAL_WIRE_BYTES, resume)
        inside = self._buffer[at + 1 : min(stop, at + 4)]
        is_empty = len(inside) <= 2 and unescape(inside) in (b"", b"\x7d")
        kind = FaultKind.EMPTY if is_empty else FaultKind.CHECKSUM
        return self._reject(kind, first, end + 1, resume)

    def _accept_normal(
        self, first: int, end: int, content: bytes
    ) -> Span | FramingFault | NeedData | None:
        if content[0] not in self._known:
            header = self._swallowed_header(first, end)
            if isinstance(header, NeedData):
                self._judged = -1  # come back as if for the first time
                return header
            if header < NEVER:
                return self._reject(FaultKind.TRUNCATED, first, header)
        self._pos = end + 1 - self._base
        self._damage_end = -1
        self.statistics.packets += 1
        return Framing.NORMAL, content, 0, len(content) - 1, first

    def _starts_that_fit(self, first: int, end: int) -> list[int]:
        """Return the starts from ``first`` on that share the terminator and make a packet."""
        if self._good_starts is None:
            packet = self._buffer[first - self._base : end - self._base]
            self._good_starts = _good_starts(packet, first)
        return self._good_starts

    def _need(self, missing: int, wanted: int = 0) -> NeedData:
        self._missing = missing
        self._wanted = max(missing, wanted)
        return NEED_DATA

    def _refill(self) -> bool:
        """Make the buffer longer by what was asked for; False if that has not arrived.

        Only a packet that straddles two chunks is joined; the rest of the second chunk is
        parsed where it is.
        """
        if self._queued < self._missing:
            return False
        self._missing = 0
        self._base += self._pos
        rest = len(self._buffer) - self._pos
        if rest <= self._taken:  # all of it was copied from the chunk that goes on: parse it there
            self._buffer = self._queue.popleft()
            self._queued -= len(self._buffer) - self._taken
            self._pos, self._taken = self._taken - rest, 0
            self._base -= self._pos
            return True
        parts = [memoryview(self._buffer)[self._pos :]]
        wanted = min(self._wanted, self._queued)
        self._queued -= wanted
        while wanted:
            part = memoryview(self._queue[0])[self._taken : self._taken + wanted]
            parts.append(part)
            wanted -= len(part)
            self._taken += len(part)
            if self._taken == len(self._queue[0]):
                self._queue.popleft()
                self._taken = 0
        self._buffer = b"".join(parts)
        self._pos = 0
        return True


def _good_starts(packet: bytes, offset: int) -> list[int]:
    """Find the starts in a Normal packet, itself included, whose checksum fits; ascending.

    ``packet`` lies at ``offset`` in the stream, without its terminator. One pass from the back
    over its escaped bytes, since the content behind each is a suffix of the whole.
    """
    if len(packet) >= _SHORT:
        raw = np.frombuffer(packet + b"\x7e", np.uint8)
        return _judge(raw, *_mark(raw), offset).good
    good = []
    checksum, count, end = 0, 0, len(packet)
    for escaped in reversed(list(_ESCAPED.finditer(packet, 1))):
        tail = packet[escaped.end() : end]
        checksum ^= xor(tail)
        count += len(tail)
        end = escaped.start()
        if packet[end + 1] == START and checksum == START and count > 1:
            good.append(offset + end + 1)
        checksum ^= packet[end + 1]
        count += 1
    tail = packet[1:end]
    if checksum ^ xor(tail) == START and count + len(tail) > 1:
        good.append(offset)
    return good[::-1]

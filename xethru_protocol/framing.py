"""The receiver: finds packets in any bytes (Protocol reference 1.4 with its rescan rule).

What it guarantees, for any bytes in any chunks:

- The packets and faults depend on the bytes only, not on how they were cut into chunks.
- It never raises, and once it asks for data it holds less than one packet (65 544 bytes) that
  is not judged, in whatever chunks these came.
- Starts are tried in the order of their position and the first that holds wins. So an intact
  packet is found unless an earlier start makes a valid packet out of its bytes: a Normal packet
  whose checksum happens to fit (1 in 256 for random bytes; always when the end of an intact
  packet became 7F, since the two checksums cancel) or a NoEscape header that happens to be
  consistent. Junk without a start cannot hide anything; a stray 7D delays what follows until
  it is refuted, by the next unescaped 7D or 7E or at the longest possible packet.
- Every byte is searched and parsed a bounded number of times, also in input made to hurt.
- `LinkStatistics` counts every byte: in a packet, junk, or not judged yet.

The last point rests on one fact. Let a Normal packet started at s be parsed up to its
terminator t. A 7D between the two was not a terminator, so it was escaped, so the parse is in
the same state behind it as a parse started *at* it. Therefore all starts between s and t share
the terminator t, and their contents are suffixes of the first's: one scan serves them all.
"""

import re
import struct
from collections import deque
from typing import Final

from xethru_protocol.finders import NEVER, PatternFinder, TerminatorFinder
from xethru_protocol.packets import (
    MAX_NORMAL_BYTES,
    NEED_DATA,
    NO_ESCAPE_HEADER_BYTES,
    NO_ESCAPE_START,
    START,
    FaultKind,
    Framing,
    FramingFault,
    NeedData,
    Packet,
    encode_no_escape,
    encode_normal,
    unescape,
    xor,
)
from xethru_protocol.plausibility import HEAD_BYTES, MAX_LENGTH, Direction, plausible
from xethru_protocol.statistics import LinkStatistics

__all__ = [
    "NEED_DATA",
    "FaultKind",
    "Framing",
    "FramingFault",
    "NeedData",
    "Packet",
    "PacketReader",
    "Span",
    "encode_no_escape",
    "encode_normal",
]

Span = tuple[Framing, bytes, int, int, int]
"""Framing, buffer, payload start and end in it, offset of the packet in the stream."""

MAX_NORMAL_WIRE_BYTES: Final = 2 * MAX_NORMAL_BYTES + 2  # all escaped, with start and end

_JOIN_BYTES = 4096  # of the next chunk, to a Normal packet whose end is not known
_LENGTH = struct.Struct("<I")
# Magic and length, then code, type and element count of a DATA FLOAT.
_FRAME_HEADER = struct.Struct("<4sIxBB8xI")
_ESCAPED = re.compile(rb"\x7f(.)", re.DOTALL)
_RUN_OF_7C = re.compile(rb"\x7c{9,}")


class PacketReader:
    """Finds packets in received bytes: ``receive_data``, then ``next_packet`` until NEED_DATA.

    Parameters
    ----------
    direction
        Who sends the bytes: it tells which NoEscape headers can be true.
    statistics
        Where to count; None: in new ones.

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
        self._good_starts: frozenset[int] | None = None  # that share it and have a fitting checksum

    def receive_data(self, data: bytes) -> None:
        """Take bytes as they come from the port, in chunks of any size.

        A ``bytes`` object is kept as it is, without a copy.
        """
        if data:
            self._queue.append(bytes(data))
            self._queued += len(data)
            self.statistics.bytes += len(data)

    def end_data(self) -> None:
        """Tell that no more bytes will come: what is incomplete now will be a fault."""
        self._ended = True

    @property
    def buffered(self) -> int:
        """Bytes received that are not yet part of a reported packet or fault."""
        return len(self._buffer) - self._pos + self._queued

    def next_packet(self) -> Packet | FramingFault | NeedData:
        """Next packet or fault, or NEED_DATA."""
        span = self.next_span()
        if isinstance(span, tuple):
            framing, buffer, start, end, offset = span
            return Packet(framing=framing, payload=buffer[start:end], offset=offset)
        return span

    def next_span(self) -> Span | FramingFault | NeedData:
        """Like ``next_packet``, but tells where the payload lies instead of copying it."""
        while True:
            if self._missing and not self._refill():  # parsing would tell nothing new
                if not self._ended or not self.buffered:
                    return NEED_DATA
                fault = self._reject_last_start()
                if fault is not None:
                    return fault
            buffer, pos = self._buffer, self._pos
            if len(buffer) - pos >= 23:
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
            found = self._parse()
            if found is not NEED_DATA:
                return found

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

    def _reject(self, kind: FaultKind, first: int, covered_end: int) -> FramingFault | None:
        """Give up a start and go on behind it; a fault unless these bytes had theirs."""
        self._skip_to(first + 1)
        self.statistics.resyncs += 1
        reported = first < self._damage_end
        self._damage_end = max(self._damage_end, covered_end)
        return None if reported else self._fault(kind, first)

    def _fault(self, kind: FaultKind, offset: int) -> FramingFault:
        self.statistics.faults[kind] += 1
        return FramingFault(kind=kind, offset=offset)

    def _skip_to(self, offset: int) -> None:
        """Go on at ``offset``; the bytes before it belong to no packet."""
        self.statistics.junk_bytes += offset - self._base - self._pos
        self._pos = offset - self._base

    def _no_escape(self, first: int) -> Span | FramingFault | NeedData | None:
        """Judge the NoEscape packet at ``first``; None if it was rejected without a report."""
        at = first - self._base
        have = len(self._buffer) - at
        if have < NO_ESCAPE_HEADER_BYTES:
            return self._need(NO_ESCAPE_HEADER_BYTES - have)
        (length,) = _LENGTH.unpack_from(self._buffer, at + 4)
        begin = at + NO_ESCAPE_HEADER_BYTES
        if 1 <= length <= MAX_LENGTH:
            head = min(length, HEAD_BYTES)
            if have < NO_ESCAPE_HEADER_BYTES + head:
                return self._need(NO_ESCAPE_HEADER_BYTES + head - have)
            if plausible(length, self._buffer[begin : begin + head], self._direction):
                if have < NO_ESCAPE_HEADER_BYTES + length:
                    return self._need(NO_ESCAPE_HEADER_BYTES + length - have)
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

    def _normal(  # noqa: PLR0911 - one return per row of the state table
        self, first: int
    ) -> Span | FramingFault | NeedData | None:
        """Judge the Normal packet at ``first``; None if it was rejected without a report."""
        end = self._terminators.after(self._buffer, self._base, first, MAX_NORMAL_WIRE_BYTES)
        if (end if end >= 0 else self._terminators.searched) - first > MAX_NORMAL_WIRE_BYTES:
            return self._reject(FaultKind.OVERSIZE, first, first + MAX_NORMAL_WIRE_BYTES)
        if end < 0:
            return self._need(1, max(len(self._buffer) - self._pos, _JOIN_BYTES))
        at, stop = first - self._base, end - self._base
        if self._buffer[stop] == START:
            if end == first + 1:  # doubled start: nothing is lost
                self._skip_to(end)
                return None
            return self._reject(FaultKind.TRUNCATED, first, end)
        if end != self._judged:
            self._judged, self._good_starts = end, None
            content = self._terminators.content(self._buffer, self._base, first)
            good = xor(content) == START
        else:
            if self._good_starts is None:
                self._good_starts = _good_starts(self._buffer[at:stop], first)
            good = first in self._good_starts
            content = unescape(self._buffer[at + 1 : stop]) if good else b""
        if good and len(content) > MAX_NORMAL_BYTES:
            return self._reject(FaultKind.OVERSIZE, first, first + MAX_NORMAL_WIRE_BYTES)
        if good and len(content) > 1:
            self._pos = stop + 1
            self._damage_end = -1
            self.statistics.packets += 1
            return Framing.NORMAL, content, 0, len(content) - 1, first
        kind = FaultKind.EMPTY if good or not content else FaultKind.CHECKSUM
        return self._reject(kind, first, end + 1)

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


def _good_starts(packet: bytes, offset: int) -> frozenset[int]:
    """Find the starts in a refuted Normal packet, itself included, whose checksum fits.

    ``packet`` lies at ``offset`` in the stream, without its terminator. One pass from the back
    over its escaped bytes, since the content behind each is a suffix of the whole.
    """
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
    return frozenset(good)

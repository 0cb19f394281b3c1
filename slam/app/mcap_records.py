"""The records of an MCAP file, also of one that ends too early or is damaged.

Every whole record before the end of a file is found; a chunk that the end cuts through is
decompressed as far as its bytes reach. Where a record makes no sense, or a chunk's checksum is
wrong, that place is told, and reading goes on behind it, at the next chunk that is sound if need
be.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Generator, Iterator
from dataclasses import dataclass
from typing import BinaryIO, TypeAlias

import lz4.frame
import zstandard

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 1, 2, 3, 4, 5, 6
MESSAGE_INDEX, ATTACHMENT, METADATA, DATA_END = 7, 9, 12, 15
_OF_SUMMARY = (8, 10, 11, 13, 14)  # indexes and statistics, behind the data
_LAST_CODE = 15  # private ones from 128 on are nobody's here, and more likely damage

_HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")
# A recorder writes chunks of 256 KiB; beyond this a length is damage, not data.
_MOST_BYTES = 1 << 28
# How a chunk names its compression, at a fixed place of its head.
_NAMES = (b"\x04\0\0\0zstd", b"\x03\0\0\0lz4")
_NAME_AT = _HEAD.size + _CHUNK.size
_PIECE_BYTES = 1 << 20
_FOOTER_BYTES, _DATA_END_BYTES = 20, 4

DAMAGES = (struct.error, ValueError, RuntimeError, KeyError, zstandard.ZstdError)
"""What taking a damaged record apart may raise."""


@dataclass(frozen=True, slots=True)
class Record:
    """One record; ``at`` is where in the file it begins, or the chunk that it is in."""

    at: int
    code: int
    body: bytes


@dataclass(frozen=True, slots=True)
class Cut:
    """The file ends too early: in the record that begins at ``at``, or right before one."""

    at: int


@dataclass(frozen=True, slots=True)
class Damage:
    """What stands between two places is not what was written."""

    at: int
    until: int
    reason: str


Found: TypeAlias = Record | Cut | Damage


class RecordReader:
    """Walks through a file once.

    Parameters
    ----------
    stream
        The file; its first bytes are known to be `MAGIC`.
    size
        Of the file in bytes; what a recorder adds meanwhile is not looked at.
    """

    def __init__(self, stream: BinaryIO, size: int) -> None:
        self._stream, self._size = stream, size
        self._is_data_over = False

    def _read(self, n_bytes: int | None = None) -> bytes:
        left = max(self._size - self._stream.tell(), 0)
        return self._stream.read(left if n_bytes is None else min(n_bytes, left))

    def read(self) -> Iterator[Found]:
        """Yield the records, those in chunks one by one, to the footer or as far as it goes."""
        at: int | None = len(MAGIC)
        while at is not None:
            self._stream.seek(at)
            head = self._read(_HEAD.size)
            if len(head) < _HEAD.size or (not any(head) and self._is_zero_from(at)):
                yield Cut(at)
                return
            code, length = _HEAD.unpack(head)
            end = at + _HEAD.size + length
            if not self._is_record(code, length) or end > self._size:
                # A length that is damaged looks like a cut, but then a sound chunk follows.
                at = yield from self._last_or_damaged(at, code, length)
                continue
            body = self._read(length)
            try:
                if code == CHUNK:
                    yield from _records_in(at, _content(body))
                else:
                    self._check(at, code, body)
                    yield Record(at, code, body)
            except DAMAGES as error:
                sound = self._is_head(end)
                at = yield from self._damaged(at, str(error), end if sound else None)
                continue
            self._is_data_over |= code == DATA_END
            at = None if code == FOOTER else end

    def _check(self, at: int, code: int, body: bytes) -> None:
        """Raise ValueError where a record cannot be what its first byte says.

        One flipped bit there would hide a chunk, or end the file.
        """
        end = at + _HEAD.size + len(body)
        if code == HEADER:
            fits = at == len(MAGIC)
        elif code == FOOTER:
            fits = len(body) == _FOOTER_BYTES and end + len(MAGIC) >= self._size
        elif code == DATA_END:
            fits = len(body) == _DATA_END_BYTES
        elif code == MESSAGE_INDEX:
            fits = len(body) >= 6 and struct.unpack_from("<I", body, 2)[0] == len(body) - 6
        elif code == ATTACHMENT:
            at_media = text_at(body, 16)[1]
            at_data = text_at(body, at_media)[1]
            (size,) = struct.unpack_from("<Q", body, at_data)
            fits = len(body) == at_data + 8 + size + 4
        elif code in _OF_SUMMARY:
            fits = self._is_data_over
        else:
            fits = True
        if not fits:
            raise ValueError("the record there is not what it says")

    def _last_or_damaged(
        self, at: int, code: int, length: int
    ) -> Generator[Found, None, int | None]:
        following = self._next_chunk(at + 1)
        if following is None and self._is_record(code, length):
            if code == CHUNK:
                self._stream.seek(at + _HEAD.size)
                yield from _records_in(at, _content_before_cut(self._read()))
            yield Cut(at)
            return None
        yield Damage(at, self._size if following is None else following, "no record stands there")
        return following

    def _damaged(
        self, at: int, reason: str, resume: int | None
    ) -> Generator[Found, None, int | None]:
        resume = self._next_chunk(at + 1) if resume is None else resume
        yield Damage(at, self._size if resume is None else resume, reason)
        return resume

    def _is_record(self, code: int, length: int) -> bool:
        return _is_code(code) and min(length, self._size) <= _MOST_BYTES

    def _is_head(self, at: int) -> bool:
        """Whether a record of a known kind may begin at a place, or the file ends there."""
        self._stream.seek(at)
        head = self._read(_HEAD.size)
        if len(head) < _HEAD.size:
            return True
        code, length = _HEAD.unpack(head)
        return _is_code(code) and at + _HEAD.size + int(length) <= self._size

    def _is_zero_from(self, at: int) -> bool:
        """Whether nothing but zeros follows, as after a loss of power."""
        self._stream.seek(at)
        while piece := self._read(_PIECE_BYTES):
            if any(piece):
                return False
        return True

    def _next_chunk(self, at: int) -> int | None:
        """Return where the next chunk begins whose checksum is right."""
        overlap = max(map(len, _NAMES)) - 1
        place = at + _NAME_AT  # of a name, at the earliest
        while place < self._size:
            self._stream.seek(place)
            piece = self._read(_PIECE_BYTES + overlap)
            for found in _all_in(piece):
                chunk_at = place + found - _NAME_AT
                if self._is_sound(chunk_at):
                    return chunk_at
            place += _PIECE_BYTES
        return None

    def _is_sound(self, at: int) -> bool:
        self._stream.seek(at)
        code, length = _HEAD.unpack(self._read(_HEAD.size))
        if code != CHUNK or length > min(self._size - at - _HEAD.size, _MOST_BYTES):
            return False
        try:
            _content(self._read(length))
        except DAMAGES:
            return False
        return True


def _is_code(code: int) -> bool:
    return 1 <= code <= _LAST_CODE


def text_at(body: bytes, at: int) -> tuple[str, int]:
    """Return a text with its length before it, and the position after it."""
    data, end = bytes_at(body, at)
    return data.decode(), end


def bytes_at(body: bytes, at: int) -> tuple[bytes, int]:
    """Return bytes with their 32-bit length before them, and the position after them."""
    (length,) = struct.unpack_from("<I", body, at)
    start = at + 4
    if start + length > len(body):
        raise ValueError("a text reaches beyond its record")
    return body[start : start + length], start + length


def table_at(body: bytes, at: int) -> tuple[dict[str, str], int]:
    """Return a table of texts with its length in bytes before it, and the position after it."""
    (length,) = struct.unpack_from("<I", body, at)
    at, end = at + 4, at + 4 + length
    table = {}
    while at < end:
        key, at = text_at(body, at)
        table[key], at = text_at(body, at)
    return table, end


def _all_in(piece: bytes) -> list[int]:
    places = []
    for name in _NAMES:
        found = piece.find(name)
        while found >= 0:
            places.append(found)
            found = piece.find(name, found + 1)
    return sorted(places)


def _content(body: bytes) -> bytes:
    """Decompress a whole chunk; raises one of `DAMAGES`."""
    _start, _end, size, checksum = _CHUNK.unpack_from(body)
    name, at = text_at(body, _CHUNK.size)
    (packed_size,) = struct.unpack_from("<Q", body, at)
    packed = body[at + 8 :]
    if len(packed) != packed_size or size > _MOST_BYTES:
        raise ValueError("the chunk's lengths do not fit together")
    content = _unpacked(name, packed, size)
    if len(content) != size or (checksum != 0 and zlib.crc32(content) != checksum):
        raise ValueError("the chunk's checksum is wrong")
    return content


def _content_before_cut(body: bytes) -> bytes:
    """Decompress what there is of a chunk; nothing if that says nothing."""
    try:
        size = _CHUNK.unpack_from(body)[2]
        name, at = text_at(body, _CHUNK.size)
        return _unpacked(name, body[at + 8 :], min(size, _MOST_BYTES))
    except DAMAGES:
        return b""


def _unpacked(name: str, packed: bytes, size: int) -> bytes:
    """Decompress, one byte more than ``size`` at most."""
    if name == "zstd":
        return zstandard.ZstdDecompressor().stream_reader(packed).read(size + 1)
    if name == "lz4":
        unpacked: bytes = lz4.frame.LZ4FrameDecompressor().decompress(packed, size + 1)
        return unpacked
    if name == "":
        return packed
    raise ValueError(f"chunks compressed with {name!r} are not read here")


def _records_in(at: int, content: bytes) -> Iterator[Record]:
    """Yield the whole records of a chunk that begins at a place."""
    here = 0
    while here + _HEAD.size <= len(content):
        code, length = _HEAD.unpack_from(content, here)
        here += _HEAD.size
        if here + length > len(content):
            return  # the chunk was cut here
        yield Record(at, code, content[here : here + length])
        here += length

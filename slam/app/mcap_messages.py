"""The messages of an MCAP file, one after the other, as far as the file goes.

A recorder that is killed leaves a file without index, cut anywhere, also inside a compressed
chunk. Everything before the cut is read: a chunk is decompressed as far as its bytes reach. What
is not an MCAP file, or is damaged in the middle, is one line that says so.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, TypeAlias

import zstandard

from slam.app.errors import AppError

_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQI")
_SCHEMA, _CHANNEL, _MESSAGE_CODE, _CHUNK_CODE, _METADATA, _DATA_END = 3, 4, 5, 6, 12, 15
# A recorder writes chunks of 256 KiB; beyond this a length is damage, not data.
_MOST_BYTES = 1 << 28


class DamagedFileError(AppError):
    """The file is no MCAP file or damaged; one line with the file, the place and what is wrong."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Metadata:
    """A named table of the file."""

    name: str
    values: dict[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class RawMessage:
    """One message as stored; `message_type` is the name of its schema."""

    topic: str
    message_type: str
    sequence: int
    t_ns: int
    publish_ns: int
    data: bytes


Entry: TypeAlias = Metadata | RawMessage


def read_entries(path: Path, on_cut: Callable[[int], None]) -> Iterator[Entry]:
    """Yield metadata and messages in the order of the file, holding one chunk in memory.

    Parameters
    ----------
    path
        The file.
    on_cut
        Called with the position in bytes where the file ends too early, before the end.

    Raises
    ------
    DamagedFileError
        Missing, unreadable, not MCAP, or damaged other than by being cut.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as stream:
            if stream.read(len(_MAGIC)) != _MAGIC:
                raise DamagedFileError(f"{path}: is no MCAP file; give the session.mcap of a run")
            yield from _Entries(path, stream, size, on_cut).read()
    except OSError as error:
        raise DamagedFileError(f"{path}: cannot read: {error.strerror or error}") from None


class _Entries:
    """Walks the records and remembers schemas and channels."""

    def __init__(
        self, path: Path, stream: BinaryIO, size: int, on_cut: Callable[[int], None]
    ) -> None:
        self._path, self._stream, self._size, self._on_cut = path, stream, size, on_cut
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[str, str]] = {}

    def read(self) -> Iterator[Entry]:
        at = self._stream.tell()
        while True:
            head = self._stream.read(_HEAD.size)
            if len(head) < _HEAD.size:
                self._on_cut(at)
                return
            code, length = _HEAD.unpack(head)
            left = self._size - at - _HEAD.size
            if not 1 <= code < 128 or min(length, left) > _MOST_BYTES:
                raise self._damaged(at, "what stands there is no record")
            body = self._stream.read(min(length, left))
            is_whole = len(body) == length
            if not is_whole:
                self._on_cut(at)
            try:
                if code == _CHUNK_CODE:
                    yield from self._chunk(body, is_whole=is_whole)
                elif is_whole:
                    yield from self._record(code, body)
            except (struct.error, ValueError, KeyError, zstandard.ZstdError) as error:
                raise self._damaged(at, str(error)) from None
            if code == _DATA_END or not is_whole:
                return
            at += _HEAD.size + length

    def _chunk(self, body: bytes, *, is_whole: bool) -> Iterator[Entry]:
        try:
            _start, _end, size, checksum = _CHUNK.unpack_from(body)
            compression, at = _text(body, _CHUNK.size)
            packed = body[at + 8 :]
        except (struct.error, ValueError):
            if is_whole:
                raise
            return  # cut within the chunk's own head
        if size > _MOST_BYTES:
            raise ValueError("a chunk of that size is damage")
        if compression == "zstd":
            content = zstandard.ZstdDecompressor().decompressobj().decompress(packed)
        elif compression == "":
            content = packed
        else:
            raise ValueError(f"chunks compressed with {compression} are not read here")
        if is_whole and (
            len(content) != size or (checksum != 0 and zlib.crc32(content) != checksum)
        ):
            raise ValueError("the chunk's checksum is wrong")
        yield from self._records(content)

    def _records(self, content: bytes) -> Iterator[Entry]:
        at = 0
        while at + _HEAD.size <= len(content):
            code, length = _HEAD.unpack_from(content, at)
            at += _HEAD.size
            if at + length > len(content):
                return  # the chunk was cut here
            yield from self._record(code, content[at : at + length])
            at += length

    def _record(self, code: int, body: bytes) -> Iterator[Entry]:
        if code == _MESSAGE_CODE:
            channel, sequence, t_ns, publish_ns = _MESSAGE.unpack_from(body)
            topic, message_type = self._channels[channel]
            yield RawMessage(
                topic=topic,
                message_type=message_type,
                sequence=sequence,
                t_ns=t_ns,
                publish_ns=publish_ns,
                data=body[_MESSAGE.size :],
            )
        elif code == _SCHEMA:
            (number,) = struct.unpack_from("<H", body)
            self._schemas[number] = _text(body, 2)[0]
        elif code == _CHANNEL:
            number, schema = struct.unpack_from("<HH", body)
            self._channels[number] = (_text(body, 4)[0], self._schemas.get(schema, ""))
        elif code == _METADATA:
            name, at = _text(body, 0)
            yield Metadata(name=name, values=_table(body, at))

    def _damaged(self, at: int, reason: str) -> DamagedFileError:
        return DamagedFileError(f"{self._path}: damaged at byte {at}: {reason}")


def _text(body: bytes, at: int) -> tuple[str, int]:
    """Return a text with its length before it, and the position after it."""
    (length,) = struct.unpack_from("<I", body, at)
    start = at + 4
    if start + length > len(body):
        raise ValueError("a text reaches beyond its record")
    return body[start : start + length].decode(), start + length


def _table(body: bytes, at: int) -> dict[str, str]:
    (length,) = struct.unpack_from("<I", body, at)
    at, end = at + 4, at + 4 + length
    table = {}
    while at < end:
        key, at = _text(body, at)
        table[key], at = _text(body, at)
    return table

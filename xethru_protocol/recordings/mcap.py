"""MCAP, which ROS 2, Foxglove and PlotJuggler open: reader, writer, and recordings in such files.

The only file here that loads mcap. Messages are CDR as ROS 2 has it: little-endian, each number
aligned to its size counted from behind the four header bytes.

The reader finds every whole record before the end of a file; of a chunk that the end cuts through
it decompresses what is there. Where a record makes no sense or the checksum of a chunk is wrong,
that place is reported, and reading goes on behind it, at the next sound chunk if need be.

Recordings have topics as the sessions of this project: ``/radar/<name>/frame`` holds radar frames
(DATA FLOAT of content 0) as Float32MultiArray with the counter in the record's sequence number,
``/radar/<name>/info`` once what the recorded module answered for its settings. Every other message
is on ``/radar/<name>/payload``, its payload as UInt8MultiArray, and for reading, if it is a short
one, on ``/radar/<name>/message`` as JSON. Messages without a time have time 0, and their channel is
marked.

Specification of the format: https://mcap.dev/spec
"""

import json
import os
import re
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, Self, TypeAlias

import lz4.frame
import numpy as np
import numpy.typing as npt
import zstandard
from mcap import records as records  # repair reads them, too
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import EndOfFile, McapError
from mcap.reader import make_reader
from mcap.records import Metadata as Metadata  # an `Entry`, for its readers
from mcap.writer import CompressionType, Writer

from xethru_protocol.operating_system import written_whole
from xethru_protocol.recordings.frame_layout import FrameGeometries
from xethru_protocol.recordings.recorded_messages import (
    MCAP_MAGIC,
    MODULE_METRES,
    FaultHandler,
    PieceFile,
    RecordingContent,
    RecordingError,
    RecordingFacts,
    RecordingFault,
    Timed,
    TimedMessages,
    reading,
    report,
    writing,
)
from xethru_protocol.validation import reason_of, shown
from xethru_protocol.wire.codec import decode_response, describe, encode
from xethru_protocol.wire.messages import (
    BasebandAp,
    BasebandIq,
    DataFloat,
)
from xethru_protocol.wire.table import ROWS, Response, UnknownMessage

FLOAT_ARRAY = "std_msgs/msg/Float32MultiArray"
DOUBLE_ARRAY = "std_msgs/msg/Float64MultiArray"
BYTE_ARRAY = "std_msgs/msg/UInt8MultiArray"
STRING = "std_msgs/msg/String"

_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_U32 = struct.Struct("<I")
_DTYPE: Mapping[str, np.dtype[Any]] = {
    FLOAT_ARRAY: np.dtype("<f4"),
    DOUBLE_ARRAY: np.dtype("<f8"),
    BYTE_ARRAY: np.dtype("u1"),
}
_LABEL = {FLOAT_ARRAY: "range_bin", BYTE_ARRAY: "byte"}
_CDR_PADDING = 3  # most bytes that may follow the last value
_RULE = "=" * 80
_ARRAY_PARTS = f"""\
{_RULE}
MSG: std_msgs/MultiArrayLayout
std_msgs/MultiArrayDimension[] dim
uint32 data_offset
{_RULE}
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
"""
SCHEMAS = {
    FLOAT_ARRAY: f"std_msgs/MultiArrayLayout layout\nfloat32[] data\n{_ARRAY_PARTS}",
    BYTE_ARRAY: f"std_msgs/MultiArrayLayout layout\nuint8[] data\n{_ARRAY_PARTS}",
    STRING: "string data\n",
}
"""Definition of each message with all it refers to, as ``ros2msg`` text."""


class CdrPacker:
    """Bytes of a message in CDR, little-endian; numbers are aligned to their size."""

    def __init__(self) -> None:
        self._bytes = bytearray()

    def numbers(self, kind: str, *values: float) -> Self:
        """Append numbers of one kind of `struct`."""
        self._align(struct.calcsize(kind))
        self._bytes += struct.pack(f"<{len(values)}{kind}", *values)
        return self

    def text(self, text: str) -> Self:
        data = text.encode() + b"\0"
        self.numbers("I", len(data))
        self._bytes += data
        return self

    def array(self, values: npt.NDArray[Any]) -> Self:
        """Append the numbers of an array; nothing, not even padding, if it has none."""
        if values.size:
            self._align(values.itemsize)
            self._bytes += values.tobytes()
        return self

    def done(self) -> bytes:
        return _LITTLE_ENDIAN + self._bytes

    def _align(self, size: int) -> None:
        self._bytes += bytes(-len(self._bytes) % size)


def pack_string(text: str) -> bytes:
    return CdrPacker().text(text).done()


def pack_array(message_type: str, values: npt.NDArray[Any], label: str = "") -> bytes:
    """Return the bytes of an array message of one dimension, values of shape (n,).

    The dimension is called ``label``, by default "range_bin" for float32 and "byte" for bytes.
    """
    message = CdrPacker().numbers("I", 1).text(label or _LABEL[message_type])
    message.numbers("I", len(values), len(values), 0, len(values))
    return message.array(np.asarray(values, _DTYPE[message_type])).done()


def unpack_array(message_type: str, data: bytes) -> npt.NDArray[Any]:
    """Return the values, shape (n,), read-only; ValueError or struct.error for other bytes."""
    body, dtype = _body(data), _DTYPE[message_type]
    (dimensions,) = _U32.unpack_from(body, 0)
    position = 4
    for _ in range(dimensions):
        (length,) = _U32.unpack_from(body, position)
        position += 4 + length
        position += -position % 4 + 8
    (count,) = _U32.unpack_from(body, position + 4)
    position += 8
    if count:
        position += -position % dtype.itemsize
    if len(body) - position - count * dtype.itemsize > _CDR_PADDING:
        raise ValueError(f"{len(body)} bytes are too many for an array of {count} numbers")
    return np.frombuffer(body, dtype, count, position)


def unpack_string(data: bytes) -> str:
    """Return the text; ValueError or struct.error if it is not a String message."""
    body = _body(data)
    (length,) = _U32.unpack_from(body)
    return body[4 : 4 + length].rstrip(b"\0").decode()


def _body(data: bytes) -> bytes:
    if data[:4] != _LITTLE_ENDIAN:
        raise ValueError("the message is not little-endian CDR")
    return data[4:]


MAGIC = MCAP_MAGIC
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 2, 3, 4, 5, 6
_HEADER, _MESSAGE_INDEX, _ATTACHMENT, _STATISTICS, _DATA_END = 1, 7, 9, 11, 15
_IN_CHUNKS = (SCHEMA, CHANNEL, MESSAGE)
_OF_SUMMARY = (8, 10, _STATISTICS, 13, 14)  # indexes and statistics, behind the data
_CODES = range(1, 16)  # private ones, from 128 on, are taken for damage
_CONTENTS: Mapping[int, type[Any]] = {
    _HEADER: records.Header,
    FOOTER: records.Footer,
    SCHEMA: records.Schema,
    CHANNEL: records.Channel,
    _ATTACHMENT: records.Attachment,
    _STATISTICS: records.Statistics,
    12: records.Metadata,
    _DATA_END: records.DataEnd,
}

_HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")
MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence, time [ns], time of publication [ns]."""
# A recorder writes chunks of 256 KiB; beyond this a length is damage, not data.
_MOST_BYTES = 1 << 28
# How a chunk names its compression, at a fixed place of its head.
_NAMES = re.compile(rb"\x04\0\0\0zstd|\x03\0\0\0lz4")
_LONGEST_NAME_BYTES = 8
_NAME_AT = _HEAD.size + _CHUNK.size
_PIECE_BYTES = 1 << 20
_FOOTER_BYTES = 20
_TAIL_BYTES = _HEAD.size + _FOOTER_BYTES + len(MAGIC)
_CHECKSUM_BYTES = 4  # at the end of an attachment, which may do without
_MOST_ADDED_BYTES = 255  # by versions to come
_MOST_INDEX_BYTES = 1 << 26

DAMAGES = (struct.error, ValueError, RuntimeError, KeyError, zstandard.ZstdError)
"""What taking a damaged record apart may raise."""


@dataclass(frozen=True, slots=True)
class LocatedRecord:
    """One record; ``at`` is where in the file it begins, or the chunk that it is in."""

    at: int
    code: int
    body: bytes
    is_in_chunk: bool = False  # whose checksum is right, if it has one

    def content(self) -> records.McapRecord | None:
        """Return the content as mcap reads it; None of messages, chunks and most indexes.

        ValueError for bytes that mcap would not write: it takes a text that is cut for a whole one.
        """
        kind = _CONTENTS.get(self.code)
        if kind is None:
            return None
        try:
            content: records.McapRecord = kind.read(ReadDataStream(BytesIO(self.body)))
        except (EndOfFile, OverflowError, struct.error):  # it wants more bytes than there are
            raise ValueError("a record ends before its content") from None
        builder = RecordBuilder()
        content.write(builder)
        written: bytes = builder.end()[_HEAD.size :]  # type: ignore[no-untyped-call]  # mcap annotates in part
        added = len(self.body) - len(written)
        if kind is records.Attachment:
            written = written[:-_CHECKSUM_BYTES]
        most = 0 if self.code in (FOOTER, _DATA_END) else _MOST_ADDED_BYTES
        if not self.body.startswith(written) or not 0 <= added <= most:
            raise ValueError("the record there is not what it says")
        return content


@dataclass(frozen=True, slots=True)
class Cut:
    """The file ends too early: in the record that begins at ``at``, or right before one."""

    at: int


@dataclass(frozen=True, slots=True)
class Damage:
    """The bytes between two places are not what was written."""

    at: int
    until: int
    reason: str


Found: TypeAlias = LocatedRecord | Cut | Damage


class RecordReader:
    """Walks once through a file of ``size`` bytes that begins with `MAGIC`.

    What a recorder adds meanwhile is not looked at.
    """

    def __init__(self, stream: BinaryIO, size: int) -> None:
        self._stream, self._size = stream, size
        self._is_data_over = False
        self._last_chunk_before = size

    def _read(self, n_bytes: int | None = None) -> bytes:
        left = max(self._size - self._stream.tell(), 0)
        return self._stream.read(left if n_bytes is None else min(n_bytes, left))

    def read(self) -> Iterator[Found]:
        """Yield the records, those in chunks one by one, to the footer or as far as it goes."""
        at: int | None = len(MAGIC)
        self._stream.seek(0)
        if self._read(len(MAGIC)) != MAGIC:
            yield self._damage(0, at, "the first bytes of an MCAP file do not stand there")
        while at is not None:
            self._stream.seek(at)
            head = self._read(_HEAD.size)
            if len(head) < _HEAD.size or (not any(head) and self._is_zero_from(at)):
                yield Cut(at)
                return
            code, length = _HEAD.unpack(head)
            is_record = code in _CODES and min(length, self._size) <= _MOST_BYTES
            end = at + _HEAD.size + length
            if not is_record or end > self._size:
                # A length that is damaged looks like a cut, but then a sound chunk follows.
                following = self._next_chunk(at + 1)
                if following is None and is_record:
                    if code == CHUNK:
                        self._stream.seek(at + _HEAD.size)
                        with suppress(ValueError):
                            yield from _records_in(at, _content_before_cut(self._read()))
                    yield Cut(at)
                    return
                yield self._damage(at, following, "no record stands there")
                at = following
                continue
            body = self._read(length)
            try:
                if code == CHUNK:
                    yield from _records_in(at, _content(body))
                else:
                    record = LocatedRecord(at, code, body)
                    self._check(record)
                    yield record
            except DAMAGES as error:
                following = self._behind_damage(at, code, body)
                yield self._damage(at, following, str(error))
                at = following
                continue
            self._is_data_over |= code == _DATA_END
            at = None if code == FOOTER else end

    def _damage(self, at: int, until: int | None, reason: str) -> Damage:
        return Damage(at, self._size if until is None else until, reason)

    def _check(self, record: LocatedRecord) -> None:
        """Raise ValueError where a record does not fit its opcode.

        One flipped bit there would hide a chunk, or end the file.
        """
        code, body = record.code, record.body
        end = record.at + _HEAD.size + len(body)
        if code == _HEADER:
            fits = record.at == len(MAGIC)
        elif code == FOOTER:
            fits = end + len(MAGIC) >= self._size
        elif code == _MESSAGE_INDEX:
            fits = len(body) >= 6 and struct.unpack_from("<I", body, 2)[0] == len(body) - 6
        else:
            fits = code not in _OF_SUMMARY or self._is_data_over
        if not fits:
            raise ValueError("the record there is not what it says")
        if code not in _IN_CHUNKS:
            record.content()

    def _behind_damage(self, at: int, code: int, body: bytes) -> int | None:
        """Return where reading goes on behind a damaged record.

        The length of a chunk stands in it twice; where these fit, the length is right. Any other
        length is trusted only where no chunk follows, as in a file without chunks.
        """
        end = at + _HEAD.size + len(body)
        if code == CHUNK and _is_length_right(body) and self._is_head(end):
            return end
        following = None if at >= self._last_chunk_before else self._next_chunk(at + 1)
        if following is not None:
            return following
        self._last_chunk_before = min(self._last_chunk_before, at)
        return end if self._is_head(end) else None

    def _is_head(self, at: int) -> bool:
        """Whether a record of a known kind may begin at a place, or the file ends there."""
        self._stream.seek(at)
        head = self._read(_HEAD.size)
        if len(head) < _HEAD.size:
            return True
        code, length = _HEAD.unpack(head)
        return code in _CODES and at + _HEAD.size + int(length) <= self._size

    def _is_zero_from(self, at: int) -> bool:
        """Whether nothing but zeros follows, as after a loss of power."""
        self._stream.seek(at)
        while piece := self._read(_PIECE_BYTES):
            if any(piece):
                return False
        return True

    def _next_chunk(self, at: int) -> int | None:
        """Return where the next chunk begins whose checksum is right."""
        overlap = _LONGEST_NAME_BYTES - 1
        place = at + _NAME_AT  # of a name, at the earliest
        while place < self._size:
            self._stream.seek(place)
            piece = self._read(_PIECE_BYTES + overlap)
            for found in _NAMES.finditer(piece):
                chunk_at = place + found.start() - _NAME_AT
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


def _packed(body: bytes) -> tuple[str, int, bytes]:
    """Return how a chunk is compressed, the bytes that it claims to hold, and those it holds."""
    (length,) = _U32.unpack_from(body, _CHUNK.size)
    at = _CHUNK.size + _U32.size + length
    (size,) = struct.unpack_from("<Q", body, at)
    return body[at - length : at].decode(), size, body[at + 8 :]


def _is_length_right(body: bytes) -> bool:
    try:
        _, size, packed = _packed(body)
    except DAMAGES:
        return False
    return size == len(packed)


def _content(body: bytes) -> bytes:
    """Decompress a whole chunk; raises one of `DAMAGES`."""
    _start, _end, size, checksum = _CHUNK.unpack_from(body)
    name, packed_size, packed = _packed(body)
    if len(packed) != packed_size or size > _MOST_BYTES:
        raise ValueError("the chunk's lengths do not fit together")
    content = _unpacked(name, packed, size)
    if len(content) != size or (checksum != 0 and zlib.crc32(content) != checksum):
        raise ValueError("the chunk's checksum is wrong")
    return content


def _content_before_cut(body: bytes) -> bytes:
    """Decompress what there is of a cut chunk, possibly nothing."""
    try:
        size = _CHUNK.unpack_from(body)[2]
        name, _, packed = _packed(body)
        return _unpacked(name, packed, min(size, _MOST_BYTES))
    except DAMAGES:
        return b""


def _unpacked(name: str, packed: bytes, size: int) -> bytes:
    """Decompress, one byte more than ``size`` at most; ValueError if no record comes first.

    A few kilobytes may unpack to hundreds of megabytes of zeros.
    """
    if size > _PIECE_BYTES:
        first = _unpacked(name, packed, _HEAD.size - 1)
        if first and first[0] not in _IN_CHUNKS:
            raise ValueError(f"a chunk cannot hold a record of kind {first[0]}")
    if name == "zstd":
        return zstandard.ZstdDecompressor().stream_reader(packed).read(size + 1)
    if name == "lz4":
        unpacked: bytes = lz4.frame.LZ4FrameDecompressor().decompress(packed, size + 1)
        return unpacked
    if name == "":
        return packed
    raise ValueError(f"chunks compressed with {shown(name)} are not read here")


def _records_in(at: int, content: bytes) -> Iterator[LocatedRecord]:
    """Yield the records of a chunk, up to where it was cut; ValueError for others than it may hold.

    Zeros are such: a few kilobytes may unpack to hundreds of megabytes of them.
    """
    here = 0
    while here + _HEAD.size <= len(content):
        code, length = _HEAD.unpack_from(content, here)
        here += _HEAD.size
        if code not in _IN_CHUNKS:
            raise ValueError(f"a chunk cannot hold a record of kind {code}")
        if here + length > len(content):
            return  # the chunk was cut here
        yield LocatedRecord(at, code, content[here : here + length], is_in_chunk=True)
        here += length


@dataclass(frozen=True, slots=True, kw_only=True)
class Channel:
    """A topic; `message_type` is the name of its schema."""

    topic: str
    message_type: str
    metadata: dict[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class McapMessage:
    """A message as stored; times in ns."""

    channel: Channel
    sequence: int
    t_ns: int
    publish_ns: int
    data: bytes
    at: int
    """Where in the file it begins, or the chunk that it is in."""

    @property
    def topic(self) -> str:
        return self.channel.topic


Entry: TypeAlias = Metadata | Channel | McapMessage


def read_entries(
    stream: BinaryIO, size: int, channels: dict[int, Channel] | None = None
) -> Iterator[Entry | Cut | Damage]:
    """Yield what a file holds, to the end of its data, and where it is cut or damaged.

    One chunk at a time is in memory. ``stream`` and ``size`` are those of `RecordReader`;
    ``channels`` by their numbers, if some are known already, get those that are found: behind
    damage, which may have taken them, also by the file's own index.
    """
    schemas: dict[int, str] = {}
    channels = {} if channels is None else channels
    damaged_at: int | None = None
    for found in RecordReader(stream, size).read():
        if isinstance(found, LocatedRecord) and found.code == _DATA_END:
            return
        entry = _entry_or_damage(found, schemas, channels)
        if isinstance(entry, Damage):
            if damaged_at is None:
                for record in index_of(stream, size):
                    _entry_or_damage(record, schemas, channels)
            if damaged_at == entry.at:
                continue  # as of many records of one chunk
            damaged_at = entry.at
        if entry is not None:
            yield entry


def _entry_or_damage(
    found: Found, schemas: dict[int, str], channels: dict[int, Channel]
) -> Entry | Cut | Damage | None:
    if not isinstance(found, LocatedRecord):
        return found
    try:
        return _entry(found, schemas, channels)
    except DAMAGES as error:
        return Damage(found.at, found.at, str(error))


def _entry(
    record: LocatedRecord, schemas: dict[int, str], channels: dict[int, Channel]
) -> Entry | None:
    if record.code == MESSAGE:
        number, sequence, t_ns, publish_ns = MESSAGE_HEAD.unpack_from(record.body)
        if number not in channels:
            raise ValueError(f"the channel of a message, number {number}, is not named before it")
        return McapMessage(
            channel=channels[number],
            sequence=sequence,
            t_ns=t_ns,
            publish_ns=publish_ns,
            data=record.body[MESSAGE_HEAD.size :],
            at=record.at,
        )
    match record.content():
        case records.Schema(id=number, name=name):
            schemas[number] = name
        case records.Channel(id=number, topic=topic, schema_id=schema, metadata=table):
            channel = Channel(topic=topic, message_type=schemas.get(schema, ""), metadata=table)
            channels[number] = channel
            return channel
        case Metadata() as table:
            return table
    return None


CHUNK_BYTES = 256 * 1024


_LATCHED = re.compile(r"^\s*-?\s*durability: 1$", re.MULTILINE)


def is_latched(metadata: Mapping[str, str]) -> bool:
    """Whether the last message of a channel is kept for whoever comes later, as ROS 2 marks it."""
    return _LATCHED.search(metadata.get("offered_qos_profiles", "")) is not None


class McapWriter(Writer):
    """Writes chunks compressed by zstd, by default of messages of ROS 2; the file stays open.

    Attributes
    ----------
    has_copies
        Whether `end_chunk` repeats all schemas and channels and the last message of each latched
        channel, in a chunk of their own: behind the first chunk, the second, the fourth, and so
        on. Whatever part of a file is lost, one of the few copies is left. Their sequence number
        is how many messages of other channels come before them.
    """

    def __init__(
        self,
        stream: BinaryIO | PieceFile,
        *,
        chunk_bytes: int = CHUNK_BYTES,
        profile: str = "ros2",
        library: str = "xethru-hil",
    ) -> None:
        super().__init__(
            stream,  # type: ignore[arg-type]  # only write, tell and flush are used
            chunk_size=chunk_bytes,
            compression=CompressionType.ZSTD,
            enable_data_crcs=True,
        )
        self.has_copies = False
        self._schema_ids: dict[str, int] = {}
        self._latched: dict[int, tuple[int, bytes, int] | None] = {}  # time, data, published
        self._n_messages = 0  # of channels that are not latched
        self._n_chunks = 0
        self.start(profile=profile, library=library)

    def add_channel(
        self, topic: str, message_type: str, schema: bytes, metadata: Mapping[str, str]
    ) -> int:
        """Return the number of a new channel of CDR messages; ``schema`` is its ros2msg text."""
        if message_type not in self._schema_ids:
            self._schema_ids[message_type] = self.register_schema(message_type, "ros2msg", schema)
        return self.register_channel(topic, "cdr", self._schema_ids[message_type], dict(metadata))

    def register_channel(
        self,
        topic: str,
        message_encoding: str,
        schema_id: int,
        metadata: dict[str, str] | None = None,
    ) -> int:
        number = super().register_channel(topic, message_encoding, schema_id, metadata or {})
        if is_latched(metadata or {}):
            self._latched[number] = None
        return number

    def add_message(
        self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int = 0
    ) -> None:
        if channel_id in self._latched:
            self._latched[channel_id] = log_time, data, publish_time
        else:
            self._n_messages += 1
        super().add_message(channel_id, log_time, data, publish_time, sequence)

    def end_chunk(self) -> None:
        """End the chunk here, whatever its size."""
        self.flush()  # type: ignore[no-untyped-call]  # mcap annotates in part
        self._pack_index()
        self._n_chunks += 1
        if self.has_copies and self._n_chunks.bit_count() == 1:
            self.write_copy()

    def write_copy(self) -> None:
        """Write a copy of what a reader needs, between two chunks."""
        # Private, since registering a schema again would make a new one. pyproject pins the minor
        # version of mcap for these lines; the tests of damaged heads fail if they do less.
        chunk = self._Writer__chunk_builder  # type: ignore[attr-defined]  # private
        for schema in self._Writer__schemas.values():  # type: ignore[attr-defined]  # private
            chunk.add_schema(schema)
        for channel in self._Writer__channels.values():  # type: ignore[attr-defined]  # private
            chunk.add_channel(channel)
        sequence = self._n_messages & 0xFFFFFFFF
        for number, last in self._latched.items():
            if last is not None:
                super().add_message(number, *last, sequence)
        self.flush()  # type: ignore[no-untyped-call]  # mcap annotates in part
        self._pack_index()

    def _pack_index(self) -> None:
        """Turn the entry of the newest chunk, which the writer keeps to the end, into bytes."""
        chunks = self._Writer__chunk_indices  # type: ignore[attr-defined]  # private as well
        if chunks and isinstance(chunks[-1], records.ChunkIndex):
            chunks[-1] = _PackedIndex(chunks[-1])

    def finish(self) -> None:
        if self.has_copies:
            self.end_chunk()
            self.write_copy()
        super().finish()  # type: ignore[no-untyped-call]  # mcap annotates in part


class _PackedIndex:
    """An entry of the index in a fifth of the memory: an hour of a run has thousands."""

    __slots__ = ("_record",)

    def __init__(self, index: records.ChunkIndex) -> None:
        builder = RecordBuilder()
        index.write(builder)
        self._record: bytes = builder.end()  # type: ignore[no-untyped-call]  # mcap annotates in part

    def write(self, stream: RecordBuilder) -> None:
        stream.write(self._record)


def index_of(stream: BinaryIO, size: int) -> Iterator[LocatedRecord]:
    """Yield the records behind a file's data, the footer last; none if their checksum is wrong.

    Of a wrong index no more than `_MOST_INDEX_BYTES` are read.
    """
    stream.seek(max(size - _TAIL_BYTES, 0))
    tail = stream.read(_TAIL_BYTES)
    code, length = _HEAD.unpack_from(tail.ljust(_HEAD.size, b"\0"))
    if (code, length) != (FOOTER, _FOOTER_BYTES) or tail[-len(MAGIC) :] != MAGIC:
        return
    at, _, checksum = struct.unpack_from("<QQI", tail, _HEAD.size)
    if not max(size - _MOST_INDEX_BYTES, len(MAGIC)) <= at < size:
        return
    stream.seek(at)
    index = stream.read(size - len(MAGIC) - at)
    if checksum not in (0, zlib.crc32(index[:-_CHECKSUM_BYTES])):
        return
    here = 0
    while here + _HEAD.size <= len(index):
        code, length = _HEAD.unpack_from(index, here)
        begin = here + _HEAD.size
        yield LocatedRecord(at + here, code, index[begin : begin + length])
        here = begin + length


def end_time_of(stream: BinaryIO, size: int) -> int | None:
    """Return the newest time [ns] of a message by the file's own index; None where it has none."""
    for record in index_of(stream, size):
        with suppress(ValueError):
            if isinstance(found := record.content(), records.Statistics):
                return found.message_end_time
    return None


def statistics_of(path: Path) -> records.Statistics:
    """Return the statistics in the index of a finished file, read by mcap's own reader.

    ValueError if the file cannot be read, or has no index.
    """
    try:
        with path.open("rb") as stream:
            summary = make_reader(stream, validate_crcs=True).get_summary()
    except McapError as error:
        raise ValueError(str(error)) from None
    if summary is None or summary.statistics is None:
        raise ValueError("it has no index")
    return summary.statistics


_FACTS = "xethru-hil recording"
_RADAR = "module"
_CONTENT = frozenset({"frame", "payload"})
"""Topics of messages."""
TEXT_TOPIC = "/text/"
"""Before the name of a column of text; its messages are String, a line each."""
_UNTIMED = {"xethru-hil": "time unknown"}


class RadarTopics:
    """The topics of one radar. ``about`` has what is known of it, by the names in its info."""

    def __init__(
        self, writer: McapWriter, name: str = _RADAR, about: Mapping[str, Any] | None = None
    ) -> None:
        self._writer = writer
        self._name = name
        self._about = about or {}
        self._channels: dict[tuple[str, bool], int] = {}
        self._others = 0
        self._has_info = False
        self._geometries = FrameGeometries()

    def write(self, message: Response, t_ns: int | None) -> None:
        if isinstance(message, DataFloat) and message.content_id == 0:
            self._info(message, t_ns)
            data = pack_array(FLOAT_ARRAY, message.values)
            self._add("frame", FLOAT_ARRAY, data, t_ns, message.info)
            return
        self._geometries.take(message)
        bulk = not isinstance(message, UnknownMessage) and ROWS[type(message)].bulk
        if isinstance(message, BasebandIq | BasebandAp):
            self._info(message, t_ns)
        payload = np.frombuffer(encode(message), np.uint8)
        self._add("payload", BYTE_ARRAY, pack_array(BYTE_ARRAY, payload), t_ns, self._others)
        if not bulk:
            name, fields = describe(message)
            text = json.dumps({"message": name, "fields": fields})
            self._add("message", STRING, pack_string(text), t_ns, self._others)
        self._others = (self._others + 1) & 0xFFFFFFFF

    def _info(self, frame: DataFloat | BasebandIq | BasebandAp, t_ns: int | None) -> None:
        """Write once what is known of the frames; null is unknown."""
        if self._has_info:
            return
        self._has_info = True
        info: dict[str, object] = {
            "name": self._name,
            "serial": "",
            "port": "",
            "x_m": None,
            "y_m": None,
            "yaw_rad": None,
            "range_offset_m": None,
            "rate_hz": None,
            "length_unit": MODULE_METRES,
            **self._geometries.about(frame),
            **self._about,
        }
        self._add("info", STRING, pack_string(json.dumps(info)), t_ns, 0)

    def _add(self, topic: str, schema: str, data: bytes, t_ns: int | None, sequence: int) -> None:
        key = topic, t_ns is not None
        if key not in self._channels:
            self._channels[key] = self._writer.add_channel(
                f"/radar/{self._name}/{topic}",
                schema,
                SCHEMAS[schema].encode(),
                _UNTIMED if t_ns is None else {},
            )
        stamp_ns = t_ns or 0
        if stamp_ns < 0:
            raise RecordingError("MCAP has no place for times before 1970")
        self._writer.add_message(
            channel_id=self._channels[key],
            log_time=stamp_ns,
            publish_time=stamp_ns,
            sequence=sequence,
            data=data,
        )


def write_mcap(
    path: Path,
    messages: Iterable[Timed],
    facts: RecordingFacts,
    about: Mapping[str, Any] | None = None,
) -> None:
    """Write messages to a file, which is there when it is whole; RecordingError if that fails.

    ``about`` is what is known of the module beside them, as for `RadarTopics`.
    """
    with writing(path), written_whole(path) as fresh, fresh.open("wb") as stream:
        writer = McapWriter(stream)
        writer.add_metadata(_FACTS, {"facts": json.dumps(facts.as_json())})
        recording = RadarTopics(writer, about=about)
        for message, t_ns in messages:
            recording.write(message, t_ns)
        writer.finish()


def read_mcap(path: Path, on_fault: FaultHandler | None, radar: str | None = None) -> TimedMessages:
    """Messages of a recording or of a session; of several radars, those of the named one.

    Raises
    ------
    RecordingError
        If it holds no radar, or several and none is named, or is damaged and ``on_fault`` is None.
    """
    radars: set[str] = set()
    faults: list[RecordingFault] = []

    def note(fault: RecordingFault) -> None:
        faults.append(fault)
        report(fault, on_fault)

    for entry in _entries_of(path, note):
        if isinstance(entry, Metadata):
            continue
        name, part = _radar_topic(entry.topic)
        if part not in _CONTENT or radar not in {None, name}:
            continue
        radars.add(name)
        if len(radars) > 1:
            raise RecordingError(
                f"{path} holds several radars ({_names(path)}), not one; "
                "choose one: --radar NAME, in Python radar="
            )
        if isinstance(entry, Channel):
            continue
        try:
            if part == "frame":
                values = unpack_array(FLOAT_ARRAY, entry.data)
                message: Response = DataFloat(info=entry.sequence, values=values)
            else:
                message = decode_response(unpack_array(BYTE_ARRAY, entry.data).tobytes())
        except (ValueError, struct.error) as error:
            note(_fault(path, entry.at, f"a message is damaged: {reason_of(error)}"))
            continue
        yield message, None if "xethru-hil" in entry.channel.metadata else entry.t_ns
    if not radars and radar is not None and (names := _names(path)):
        raise RecordingError(f"{path} holds no radar {shown(radar)}; it holds {names}")
    if not radars and not faults:
        raise RecordingError(f"{path} holds no topic /radar/<name>/frame or .../payload")


def mcap_content(path: Path) -> RecordingContent:
    """Return radars in the order of their first topics, and texts; damage is ignored."""
    radars: dict[str, Mapping[str, Any]] = {}
    infos: dict[str, Mapping[str, Any]] = {}
    texts: dict[str, list[tuple[int, str]]] = {}
    for entry in _entries_of(path, lambda fault: None):
        if isinstance(entry, Metadata):
            continue
        name, part = _radar_topic(entry.topic)
        if entry.topic.startswith(TEXT_TOPIC):
            lines = texts.setdefault(entry.topic.removeprefix(TEXT_TOPIC), [])
            if isinstance(entry, McapMessage):
                with suppress(ValueError, struct.error):
                    lines.append((entry.t_ns, unpack_string(entry.data)))
        elif part in _CONTENT:
            radars.setdefault(name, {})
        elif isinstance(entry, McapMessage) and part == "info":
            with suppress(ValueError, RecursionError, struct.error):
                info = json.loads(unpack_string(entry.data))
                infos[name] = info if isinstance(info, dict) else {}
    described = {name: infos.get(name, {}) for name in radars}
    return RecordingContent(radars=described, texts=texts)


def _names(path: Path) -> str:
    return ", ".join(sorted(mcap_content(path).radars))


def mcap_facts(path: Path, on_fault: FaultHandler | None) -> RecordingFacts:
    """Return what a file holds about itself, or defaults, also for what is damaged."""
    for entry in _entries_of(path, lambda fault: None):
        if isinstance(entry, Metadata) and entry.name == _FACTS:
            read = partial(json.loads, entry.metadata.get("facts", ""))
            return RecordingFacts.read(path, read, on_fault)
        if isinstance(entry, McapMessage):
            break
    return RecordingFacts()


def _radar_topic(topic: str) -> tuple[str, str]:
    found = re.fullmatch(r"/radar/([^/]+)/([^/]+)", topic)
    return (found[1], found[2]) if found else ("", "")


def _entries_of(path: Path, on_fault: FaultHandler | None) -> Iterator[Entry]:
    """Yield what is whole in a file; what is cut or damaged is reported."""
    is_whole = True
    with reading(path), path.open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        for found in read_entries(stream, size):
            if isinstance(found, Cut | Damage):
                is_whole = False
                reason = "it ends too early" if isinstance(found, Cut) else found.reason
                report(_fault(path, found.at, f"it is cut or damaged: {reason}"), on_fault)
            else:
                yield found
        stream.seek(-len(MAGIC), os.SEEK_END)
        if is_whole and stream.read() != MAGIC:
            reason = "it is cut or damaged: all messages are there, its index is cut off"
            report(_fault(path, size, reason), on_fault)


def _fault(path: Path, at: int, reason: str) -> RecordingFault:
    return RecordingFault(file=path.name, offset=at, reason=reason)

"""An MCAP file that is written as things happen and stays readable wherever writing ends.

Every whole record before the end of a file is found; a chunk that the end cuts through is
decompressed as far as its bytes reach. Where a record makes no sense, or a chunk's checksum is
wrong, that place is told, and reading goes on behind it, at the next chunk that is sound if need
be.

A recorder that is killed leaves a file without index, cut anywhere, also inside a compressed
chunk. Everything before the cut is read. What is not an MCAP file, or is damaged in the middle, is
one line that says so.

A chunk is closed and handed to the operating system after 256 KiB or one second, so a killed
process leaves everything but its last chunk. Where the disk refuses a chunk the file goes back to
the one before, and says so in one line.
"""

from __future__ import annotations

import contextlib
import os
import stat
import struct
import time
import zlib
from collections.abc import Callable, Generator, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from io import BufferedWriter, FileIO
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, TypeAlias

import lz4.frame
import zstandard
from mcap.writer import CompressionType, Writer

from slam.app.errors import AppError
from slam.app.session import messages as ros

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_KINDS = {
    b"RRF": "a Rerun recording (.rrd), a view that other versions of Rerun may not open; the "
    "record of the run is the session.mcap beside it",
    b"#ROSBAG V2": "a bag of ROS 1; `uwb-slam convert` makes a session of it",
    b"#ROSBAG": "a bag of ROS 1 of an old version; `rosbag migrate` it first",
    b"SQLite format 3\0": "an SQLite file, like those in a rosbag2 folder; give that folder to "
    "`uwb-slam convert`",
    b"\x89XTWIRE": "a wire capture of one port; `xethru dump` reads it",
    b"MATLAB 5.0 MAT-file": "a MATLAB file; `uwb-slam convert` reads detections from it",
    b"\x89HDF": "an HDF5 file",
    b"PK\x03\x04": "a zip archive; unpack it first",
    b"\x1f\x8b": "a gzip file; unpack it first",
    b"\x28\xb5\x2f\xfd": "a zstd file; unpack it first",
}


def describe_kind(path: Path) -> str:
    r"""Return ``, it is ...`` for a file that is known by its first bytes, or what to give instead.

    >>> from tempfile import NamedTemporaryFile
    >>> with NamedTemporaryFile() as file:
    ...     _ = file.write(b"#ROSBAG V2.0\n")
    ...     file.flush()
    ...     describe_kind(Path(file.name))
    ', it is a bag of ROS 1; `uwb-slam convert` makes a session of it'
    """
    if path.is_dir():
        return " with a rosbag2 in it" if (path / "metadata.yaml").exists() else ""
    with path.open("rb") as stream:
        head = stream.read(32)
    if not head:
        return ", it is empty; whatever was to write it ended before it did"
    for magic, words in _KINDS.items():
        if head.startswith(magic):
            return f", it is {words}"
    return "; give the session.mcap of a run"


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


_MESSAGE = struct.Struct("<HIQQ")


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


@contextmanager
def open_mcap(path: Path, size: int | None = None) -> Iterator[RecordReader]:
    """Open a file whose first bytes are those of MCAP; of one that grows read `size` bytes.

    Raises
    ------
    DamagedFileError
        Missing, unreadable or not MCAP; says what it is instead, where that is known.
    """
    with ExitStack() as stack:
        try:
            if stat.S_ISFIFO(path.stat().st_mode):  # opening one waits for who writes into it
                raise DamagedFileError(f"{path}: is a pipe; give a file, the session.mcap of a run")
            stream = stack.enter_context(path.open("rb"))
            if stream.read(len(MAGIC)) != MAGIC:
                raise DamagedFileError(f"{path}: is no MCAP file{describe_kind(path)}")
            whole = _size(stream)
        except IsADirectoryError:
            raise DamagedFileError(
                f"{path}: is a directory{describe_kind(path)}; give the session.mcap in it"
            ) from None
        except OSError as error:
            raise _unreadable(path, error) from None
        yield RecordReader(stream, whole if size is None else min(size, whole))


def read_entries(
    path: Path, on_cut: Callable[[int], None], size: int | None = None
) -> Iterator[Entry]:
    """Yield metadata and messages in the order of the file, holding one chunk in memory.

    Parameters
    ----------
    path
        The file.
    on_cut
        Called with the position in bytes where the file ends too early, before the end.
    size
        How many bytes of the file to read, so that one that grows reads the same again; None: all.

    Raises
    ------
    DamagedFileError
        Missing, unreadable, not MCAP, or damaged other than by being cut.
    """
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    with open_mcap(path, size) as reader:
        try:
            for found in reader.read():
                if isinstance(found, Cut):
                    on_cut(found.at)
                    return
                if isinstance(found, Damage):
                    raise _damaged(path, found.at, found.reason)
                if found.code == DATA_END:
                    return
                try:
                    entry = _entry(found, schemas, channels)
                except DAMAGES as error:
                    raise _damaged(path, found.at, str(error)) from None
                if entry is not None:
                    yield entry
        except OSError as error:
            raise _unreadable(path, error) from None


def _entry(
    record: Record, schemas: dict[int, str], channels: dict[int, tuple[str, str]]
) -> Entry | None:
    """Return what a record says, if it is one for the reader; remember schemas and channels."""
    body = record.body
    if record.code == MESSAGE:
        return _message(body, channels)
    if record.code == SCHEMA:
        (number,) = struct.unpack_from("<H", body)
        schemas[number] = text_at(body, 2)[0]
    elif record.code == CHANNEL:
        number, schema = struct.unpack_from("<HH", body)
        channels[number] = (text_at(body, 4)[0], schemas.get(schema, ""))
    elif record.code == METADATA:
        name, at = text_at(body, 0)
        return Metadata(name=name, values=table_at(body, at)[0])
    return None


def _message(body: bytes, channels: dict[int, tuple[str, str]]) -> RawMessage:
    channel, sequence, t_ns, publish_ns = _MESSAGE.unpack_from(body)
    topic, message_type = channels[channel]
    return RawMessage(
        topic=topic,
        message_type=message_type,
        sequence=sequence,
        t_ns=t_ns,
        publish_ns=publish_ns,
        data=body[_MESSAGE.size :],
    )


def _unreadable(path: Path, error: OSError) -> DamagedFileError:
    return DamagedFileError(f"{path}: cannot read: {error.strerror or error}")


def _size(stream: BinaryIO) -> int:
    here = stream.tell()
    size = stream.seek(0, 2)
    stream.seek(here)
    return size


def _damaged(path: Path, at: int, reason: str) -> DamagedFileError:
    return DamagedFileError(
        f"{path}: damaged at byte {at}: {reason}; `uwb-slam repair {path}` keeps what is whole"
    )


_CHUNK_BYTES = 256 * 1024
_CHUNK_NS = 1_000_000_000
# MCAP's message record: opcode, length, channel, sequence, two times.
_RECORD_OVERHEAD_BYTES = 31

_LATCHED_QOS = """\
- history: 1
  depth: 1
  reliability: 1
  durability: 1
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: 1
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
"""


class CannotWriteError(AppError):
    """The file cannot be written any further; what was written is kept, the line says how."""


class _Disk(FileIO):
    """Writes until it is told to give up; from then on it swallows, so that closing succeeds."""

    gave_up = False

    def write(self, data: ReadableBuffer, /) -> int:
        if self.gave_up:
            return memoryview(data).nbytes
        return super().write(data)


class SessionFile:
    """An MCAP file of ROS 2 messages, in chunks that are cut by size and by time.

    Parameters
    ----------
    path
        The file; replaced if it exists.
    start_ns
        Session time [ns] at which the file begins.
    clock_ns
        Monotonic time [ns]; ends chunks.

    Raises
    ------
    CannotWriteError
        The file cannot be made.
    """

    def __init__(
        self, path: Path, *, start_ns: int = 0, clock_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.path = path
        self._start_ns = start_ns
        self._clock_ns = clock_ns
        try:
            self._disk = _Disk(path, "wb")
        except OSError as error:
            raise CannotWriteError(
                f"{path}: cannot be written: {error.strerror or error}"
            ) from None
        self._stream = BufferedWriter(self._disk)
        # Chunks are cut here, by size and by time; the writer itself knows size only.
        self._writer = Writer(
            self._stream, chunk_size=2 * _CHUNK_BYTES, compression=CompressionType.ZSTD
        )
        self._pending_bytes = 0
        self._whole_bytes = 0  # of the file, up to its last whole chunk
        self._newest_ns = self._whole_ns = start_ns
        self._chunk_started_ns = clock_ns()
        self._schemas: dict[str, int] = {}
        self._writer.start(profile="ros2", library="xethru-hil")

    def add_metadata(self, name: str, table: Mapping[str, str]) -> None:
        """Write a named table."""
        if self._disk.gave_up:
            return
        with self._giving_up():
            self._writer.add_metadata(name, dict(table))

    def channel(self, topic: str, message_type: str, *, latched: bool = False) -> int:
        """Return the number of a new channel; a latched one keeps its last message for all."""
        if self._disk.gave_up:
            return 0
        with self._giving_up():
            if message_type not in self._schemas:
                self._schemas[message_type] = self._writer.register_schema(
                    message_type, "ros2msg", ros.schema_text(message_type)
                )
            metadata = {"offered_qos_profiles": _LATCHED_QOS} if latched else {}
            return self._writer.register_channel(
                topic, "cdr", self._schemas[message_type], metadata
            )

    def write(
        self,
        channel: int,
        t_ns: int,
        message: ros.Message,
        *,
        sequence: int = 0,
        publish_ns: int | None = None,
    ) -> None:
        """Write a message at a session time [ns]; ``publish_ns`` is the same unless given.

        Raises
        ------
        CannotWriteError
            The disk takes no more. The file is closed, whole chunks stay; what is written from
            then on goes nowhere.
        """
        if self._disk.gave_up:
            return
        # The writer only concatenates, so the serialiser's memoryview needs no copy.
        data = ros.serialise(message)
        size = len(data) + _RECORD_OVERHEAD_BYTES
        late = self._clock_ns() - self._chunk_started_ns >= _CHUNK_NS
        if late or self._pending_bytes + size > _CHUNK_BYTES:
            self.cut_chunk()
        self._pending_bytes += size
        self._newest_ns = max(self._newest_ns, t_ns)
        with self._giving_up():
            self._writer.add_message(
                channel_id=channel,
                log_time=t_ns,
                publish_time=t_ns if publish_ns is None else publish_ns,
                sequence=sequence,
                data=data,  # type: ignore[arg-type]  # annotated bytes, any buffer works
            )

    def cut_chunk(self) -> None:
        """End the chunk here and hand it to the operating system."""
        if self._disk.gave_up:
            return
        with self._giving_up():
            # A private method: mcap's writer closes a chunk by size only and offers no public way
            # to close it by time. pyproject pins the minor version of mcap for this line; before
            # that is raised, see that the method is still there and still writes the pending
            # chunk. The tests of chunks cut by time and of files never finished fail if not.
            self._writer._Writer__finalize_chunk()  # type: ignore[attr-defined]  # see above
            self._stream.flush()
            self._whole_bytes = self._disk.tell()
        self._whole_ns = self._newest_ns
        self._pending_bytes = 0
        self._chunk_started_ns = self._clock_ns()

    def close(self) -> None:
        """Write index and footer, and close the file; doing so again does nothing.

        Raises
        ------
        CannotWriteError
            The disk takes no more; see `write`.
        """
        if self._stream.closed:
            return
        self.cut_chunk()
        with self._giving_up():
            self._writer.finish()  # type: ignore[no-untyped-call]  # mcap annotates in part
            self._stream.close()

    @contextlib.contextmanager
    def _giving_up(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            # Bytes of a chunk that did not fit are of no use to anyone, and their room is.
            with contextlib.suppress(OSError):
                os.ftruncate(self._disk.fileno(), self._whole_bytes)
            self._disk.gave_up = True
            self._stream.close()
            kept = (
                f"its first {(self._whole_ns - self._start_ns) / 1e9:.1f} s are kept there "
                f"without an index: make room, then `uwb-slam repair {self.path}`"
                if self._whole_ns > self._start_ns
                else "nothing was recorded: make room"
            )
            raise CannotWriteError(
                f"{self.path}: cannot be written: {error.strerror or error}; {kept}"
            ) from None

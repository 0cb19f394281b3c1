"""Layouts of the files in a recording directory: binary and text data files, and the meta file.

The directory's files are named in Protocol reference 12. Names, titles, bits and the meta file are
those that the vendor's recorder wrote when it was given messages of known content, one of each kind
(``fixtures/recordings``).

A binary data file holds records without separators: a message's payload without its leading codes.

A text file holds lines: an ISO time stamp and the message's fields, separated by ``;``, below a
line of titles. Lists are in square brackets, separated by commas. A DATA STRING stands there as it
came, line ends included. RESP_STATUS is stored without its counter, and SLEEPSTAGE with a
confidence that the message does not have. A line with other columns is reported and not
interpreted.

The meta file was worked out from recordings that the vendor's library wrote from known messages; a
real one of 2017 and those of 2026 agree in every byte. Its head has 0x59 bytes and the session id::

    0x00 u32  A0B1C2D3
    0x04 u32  13, the version
    0x08 i64  start [ms since 1970]: time of the first record
    0x10 u8   1 (meaning unknown)
    0x11 u32  duration [ms], until the recording was closed
    0x15 u64  size of all records, CSV and user headers included
    0x1D u64  where the index ends
    0x25 u32  data types, one bit each
    0x29 i64  where the name of the next meta file stands, -1 if there is none
    0x31 u32  size of the largest record, a CSV header included
    0x35 u32  profile id
    0x39      28 x CD, the same from both systems that wrote our samples: reserved, not garbage
    0x55 u32  length of the session id with its NUL; the text follows

Index, 33 bytes per entry::

    u32  ms since start
    u8   1 a record, 2 a data file was closed
    u32  data type; all bits inverted for a user header
    u32  size of the record, 0 when a file was closed
    u32  which file of the list below, from 0
    u64  where the record begins in its file
    u64  where it ends, counted over all files

After the index: u32 duration, u8 3, u32 number of files; of each u32 length and name, with NUL. A
recording split into directories has a meta file in each; behind the list of files stand length and
name of the next one, ``../<directory>/xethru_recording_meta.dat``.
"""

import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta, tzinfo
from typing import Any, ClassVar, NamedTuple

import numpy as np

from xethru_protocol.recordings.recorded_messages import (
    EARLIEST_MS,
    LATEST_MS,
    MS_NS,
    RecordingError,
)
from xethru_protocol.validation import shown
from xethru_protocol.wire import fields, messages
from xethru_protocol.wire.codec import encode
from xethru_protocol.wire.table import ROWS, Response


@dataclass(frozen=True, slots=True)
class _DataFileKind:
    """What both kinds of data file have.

    ``name`` stands in the file's name, between ``xethru_`` and a local time stamp; ``data_type`` is
    its bit in the meta file, ``message`` the message that its records hold.
    """

    name: str
    data_type: int
    message: type[Response]

    @property
    def file_prefix(self) -> str:
        return f"xethru_{self.name}_"


@dataclass(frozen=True, slots=True)
class BinaryKind(_DataFileKind):
    """One kind of binary data file."""

    suffix: ClassVar[str] = ".dat"
    titles: ClassVar[bytes] = b""
    header: np.dtype[np.void]  # the message's fields before its elements, packed
    count: str  # header field that counts the elements
    element_bytes: int  # of all columns, where all of one come before all of the other

    @property
    def prefix(self) -> bytes:
        """Codes that the payload begins with and the record leaves out."""
        return ROWS[self.message].prefix

    def record(self, message: Response, time_ms: int, zone: tzinfo | None) -> bytes:
        """Return the record of a message; its time stands in the meta file only."""
        return encode(message, bulk=True)[len(self.prefix) :]

    def record_size(self, header: bytes) -> int:
        """Return the bytes of the record that begins with ``header``."""
        count = int(np.frombuffer(header, self.header, 1)[self.count][0])
        return self.header.itemsize + count * self.element_bytes


def _binary(name: str, bit: int, message: type[Response]) -> BinaryKind:
    kinds = ROWS[message].kinds
    header = [(part, f"<{kind.code}") for part, kind in kinds if isinstance(kind, fields.Number)]
    elements = [kind for _, kind in kinds if not isinstance(kind, fields.Number)]
    match elements[0]:
        case fields.Bins(count_field=count, dtype=dtype):
            value_bytes = dtype.itemsize
        case fields.Block(count=count):
            value_bytes = 1
        case fields.Elements(count_label=count, code=code):  # a u32 count comes before them
            header.append((count, "<u4"))
            value_bytes = 4 if code == "a" else 1
    element_bytes = len(elements) * value_bytes
    return BinaryKind(name, 1 << bit, message, np.dtype(header), count, element_bytes)


BINARY_KINDS = (
    _binary("baseband_ap", 0, messages.BasebandAp),
    _binary("baseband_iq", 1, messages.BasebandIq),
    _binary("pulsedoppler_float", 6, messages.PulseDopplerFloat),
    _binary("pulsedoppler_byte", 7, messages.PulseDopplerByte),
    _binary("noisemap_float", 8, messages.NoiseMapFloat),
    _binary("noisemap_byte", 9, messages.NoiseMapByte),
    _binary("datafloat", 10, messages.DataFloat),
    _binary("databyte", 11, messages.DataByte),
    _binary("radar_rf", 19, messages.RadarRf),
    _binary("radar_rf_normalized", 20, messages.RadarRfNormalized),
    _binary("radar_baseband_float", 21, messages.RadarBasebandFloat),
    _binary("radar_baseband_q15", 22, messages.RadarBasebandQ15),
)


def float_text(value: float) -> str:
    """Text of a float32 as the vendor writes it, with more digits only where six lose bits.

    >>> [float_text(x) for x in (21.75, 22.0, 0.10000000149011612, 1e-8)]
    ['21.75', '22', '0.1', '1e-08']
    """
    exact = np.float32(value).tobytes()
    for digits in range(6, 10):
        text = f"{value:.{digits}g}"
        if np.float32(text).tobytes() == exact:
            return text
    return text


_FLOAT = struct.Struct("<f")


def _float32(text: str) -> float:
    value: float = _FLOAT.unpack(_FLOAT.pack(float(text)))[0]
    return value


def _list_text(values: Iterable[float]) -> str:
    return "[" + ",".join(float_text(float(value)) for value in values) + "]"


def _list(text: str) -> tuple[float, ...]:
    if not (text.startswith("[") and text.endswith("]")):
        raise ValueError(f"a list in square brackets was expected, not {shown(text)}")
    numbers = [float(item) for item in text[1:-1].split(",") if item]
    layout = f"<{len(numbers)}f"
    return struct.unpack(layout, struct.pack(layout, *numbers))


class _Column(NamedTuple):
    """A column of a text file: the message's field, the field as text and back.

    ``field`` is empty where the message has none; ``is_count``: the column counts the list
    ``field``.
    """

    field: str
    text: Callable[[Any], str]
    value: Callable[[str], Any]
    is_count: bool = False


@dataclass(frozen=True, slots=True)
class TextKind(_DataFileKind):
    """One kind of text file."""

    suffix: ClassVar[str] = ".csv"
    titles: bytes  # first line of a file, with its end of line
    columns: tuple[_Column, ...]  # behind that of the time
    absent: Mapping[str, Any]  # fields that the file has no column for, as they are read back
    is_free_text: bool  # the last column may hold separators and line ends

    def record(self, message: Response, time_ms: int, zone: tzinfo | None) -> bytes:
        """Return the line of a message and its time [ms since 1970], with its end of line."""
        time = local_time(time_ms, zone)
        cells = (column.text(getattr(message, column.field, None)) for column in self.columns)
        return (";".join((time.isoformat(timespec="milliseconds"), *cells)) + "\n").encode(
            "latin-1"
        )

    def parse(self, line: str) -> tuple[Response, int]:
        """Return the message of a line and its time [ns since 1970].

        ValueError, OverflowError or LocalProtocolError if the line is not of this kind.
        """
        line = line.removesuffix("\n") if self.is_free_text else line.rstrip("\r\n")
        stamp, *cells = line.split(";", len(self.columns) if self.is_free_text else -1)
        if len(cells) != len(self.columns):
            n_columns = len(self.columns) + 1
            raise ValueError(f"{n_columns} columns were expected, not {len(cells) + 1}")
        values: dict[str, Any] = dict(self.absent)
        counts: dict[str, int] = {}
        for (name, _, value_of, is_count), cell in zip(self.columns, cells, strict=True):
            if name:
                (counts if is_count else values)[name] = value_of(cell)
        for name, count in counts.items():
            if len(values[name]) != count:
                raise ValueError(f"{name} has {len(values[name])} values, not {count}")
        message = self.message(**values)
        encode(message)  # raises if a value does not fit its field on the wire
        return message, _time_ns(stamp)


def _text(name: str, bit: int, message: type[Response], titles: str, **absent: int) -> TextKind:
    """Return the kind with these titles, behind that of the time.

    Its columns are the message's fields in their order, but for those that are ``absent``; one
    behind them has no field and is written as 0.
    """
    kinds = [(field, kind) for field, kind in ROWS[message].kinds if field not in absent]
    columns = [_column(field, kind) for field, kind in kinds]
    columns += [_Column("", lambda _: "0", str)] * (titles.count(";") + 1 - len(columns))
    is_free_text = any(isinstance(kind, fields.Elements) for _, kind in kinds)
    line = f"TimeStamp;{titles}\n".encode()
    return TextKind(name, 1 << bit, message, line, tuple(columns), absent, is_free_text)


def _column(name: str, kind: fields.FieldKind) -> _Column:
    match kind:
        case fields.Number(code="f"):
            return _Column(name, float_text, _float32)
        case fields.Floats():
            return _Column(name, _list_text, _list)
        case fields.Elements():
            return _Column(name, str, str)
        case fields.Count(of=(counted, *_)):
            return _Column(counted, lambda of: str(len(of)), int, is_count=True)
    return _Column(name, str, int)


_UNIX = datetime.fromisoformat("1970-01-01T00:00:00+00:00")


def local_time(time_ms: int, zone: tzinfo | None) -> datetime:
    return (_UNIX + timedelta(milliseconds=time_ms)).astimezone(zone)


def _time_ns(stamp: str) -> int:
    time = datetime.fromisoformat(stamp)
    if time.tzinfo is None:
        time = time.astimezone()  # a stamp without zone is taken to be in that of this machine
    time_ms = (time - _UNIX) // timedelta(milliseconds=1)
    if not EARLIEST_MS <= time_ms <= LATEST_MS:
        raise ValueError(f"{stamp} is beyond what 64 bits of nanoseconds hold")
    return time_ms * MS_NS


TEXT_KINDS = (
    _text(
        "presence_single",
        12,
        messages.PresenceSingle,
        "Counter;PresenceState;Distance;Direction;SignalQuality",
    ),
    _text(
        "presence_movinglist",
        13,
        messages.PresenceMovingList,
        "Counter;PresenceState;MovementIntervalCount;DetectionCount;MovementSlowItem;"
        "MovementFastItem;DetectionDistance;DetectionRadarCrossSection;DetectionVelocity",
    ),
    _text(
        "sleep",
        2,
        messages.SleepStatus,
        "FrameCounter;State;RPM;ObjectDistance;SignalQuality;MovementSlow;MovementFast",
    ),
    _text(
        "respiration",
        3,
        messages.RespStatus,
        "State;RPM;ObjectDistance;ObjectMovement;SignalQuality",
        counter=0,
    ),
    _text(
        "datastring",
        5,
        messages.DataString,
        "ContentId;Info;Message",
    ),
    _text(
        "respiration_detectionlist",
        14,
        messages.RespirationDetectionList,
        "Counter;DetectionCount;DetectionDistanceItems;DetectionRadarCrossSectionItems;"
        "DetectionVelocityItems",
    ),
    _text(
        "respiration_movinglist",
        15,
        messages.RespirationMovingList,
        "Counter;MovementIntervalCount;MovementSlowItems;MovementFastItems",
    ),
    _text(
        "vitalsigns",
        16,
        messages.VitalSigns,
        "FrameCounter;State;RPM;Distance;RespirationConfidence;HeartBPM;HeartDistance;"
        "HeartConfidence;NormalizedMovementSlow;NormalizedMovementFast;NormalizedMovementStart;"
        "NormalizedMovementEnd",
    ),
    _text(
        "sleepstage",
        17,
        messages.SleepStage,
        "FrameCounter;SleepStage;Confidence",
    ),
    _text(
        "respiration_normalizedmovementlist",
        18,
        messages.RespirationNormalizedMovementList,
        "Counter;Start;BinLength;Count;NormalizedMovementSlowItems;NormalizedMovementFastItems",
    ),
)

DataFileKind = BinaryKind | TextKind
KINDS: tuple[DataFileKind, ...] = (*BINARY_KINDS, *TEXT_KINDS)
"""All kinds. The vendor's bit 1 << 4 (performance status) has no row: its layout is not known."""
KIND_OF_MESSAGE = {kind.message: kind for kind in KINDS}
KIND_OF_TYPE = {kind.data_type: kind for kind in KINDS}
# The vendor's recorder closes files in the order of their bits, but for these.
_CLOSED_AFTER = {1 << 14: 1 << 15, 1 << 18: (1 << 15) + 1}
_LONGEST_FIRST = sorted(KINDS, key=lambda kind: -len(kind.name))


def closing_order(kind: DataFileKind) -> int:
    """Sort key of data files that end together."""
    return 2 * _CLOSED_AFTER.get(kind.data_type, kind.data_type) + (kind.data_type in _CLOSED_AFTER)


def kind_of_file(name: str) -> DataFileKind | None:
    for kind in _LONGEST_FIRST:
        if name.startswith(kind.file_prefix) and name.endswith((kind.suffix, WRITING_SUFFIX)):
            return kind
    return None


META_NAME = "xethru_recording_meta.dat"
WRITING_SUFFIX = ".writing"
"""Of files that the vendor's recorder has not completed, in place of their own."""
PARAMETER_FILE_NAME = "xethru_parameter_file.par"
ABOUT_NAME = "xethru_radar.json"
"""Our own file beside the vendor's, whose reader opens what the meta file lists: ``session_id``
and, in ``radar``, what is known of the module, by the names in the info of an MCAP file."""
VERSION = 13

ALL_BITS = 0xFFFFFFFF
_MAGIC = 0xA0B1C2D3
_HEAD = struct.Struct("<IIqBIQQIqII28sI")
_ENTRY = struct.Struct("<IBIIIQQ")
ENTRY = np.dtype(
    [("ms", "<u4"), ("kind", "u1"), ("data_type", "<u4"), ("size", "<u4"), ("file", "<u4"),
     ("begin", "<u8"), ("end", "<u8")]
)  # fmt: skip
"""An entry of the index, as `Entry` names its parts."""
_FILES = struct.Struct("<IBI")
_LENGTH = struct.Struct("<I")
RECORD, CLOSED, _FILE_LIST = 1, 2, 3
_UNKNOWN_BYTE = 1
_NO_NEXT = -1
_RESERVED = b"\xcd" * 28


class Entry(NamedTuple):
    """One entry of the index, in the order of its bytes; ``kind`` is `RECORD` or `CLOSED`."""

    since_start_ms: int
    kind: int
    data_type: int
    size: int
    file: int
    begin: int
    end: int

    def pack(self) -> bytes:
        return _ENTRY.pack(*self)


@dataclass(slots=True, kw_only=True)
class Meta:
    """A meta file.

    ``index_end`` is 0 until the recording is closed. ``next_name`` is the path of the next meta
    file of a recording split into directories, from this one's directory on. ``index`` holds the
    entries as they were read, packed; ``complete``: the recording was closed and nothing is
    missing.
    """

    start_ms: int = 0
    duration_ms: int = 0
    size: int = 0
    index_end: int = 0
    data_types: int = 0
    largest_record: int = 0
    profile_id: int = 0
    session_id: bytes = b""
    files: list[str] = field(default_factory=list)
    next_name: str = ""
    index: bytes = b""
    complete: bool = False

    def entries(self) -> Iterator[Entry]:
        """Yield the entries of the index that was read, one at a time."""
        return map(Entry._make, _ENTRY.iter_unpack(self.index))

    def pack_head(self) -> bytes:
        text = self.session_id + b"\0"
        head = _HEAD.pack(
            _MAGIC,
            VERSION,
            self.start_ms,
            _UNKNOWN_BYTE,
            self.duration_ms,
            self.size,
            self.index_end,
            self.data_types,
            self.index_end + len(self._pack_list()) if self.next_name else _NO_NEXT,
            self.largest_record,
            self.profile_id,
            _RESERVED,
            len(text),
        )
        return head + text

    def pack_files(self) -> bytes:
        """Return the bytes behind the index: the list of files and the next meta file."""
        return self._pack_list() + (_counted(self.next_name) if self.next_name else b"")

    def _pack_list(self) -> bytes:
        head = _FILES.pack(self.duration_ms, _FILE_LIST, len(self.files))
        return head + b"".join(map(_counted, self.files))


def _counted(name: str) -> bytes:
    text = name.encode() + b"\0"
    return _LENGTH.pack(len(text)) + text


def parse_meta(data: bytes) -> Meta:
    """Read a meta file, as much of it as is there; RecordingError if its head is damaged."""
    if len(data) < _HEAD.size:
        raise RecordingError(f"it is cut: {len(data)} of {_HEAD.size} bytes of its head are there")
    (magic, version, start_ms, _, duration_ms, size, index_end, data_types, next_at, largest,
     profile, _, length) = _HEAD.unpack_from(data)  # fmt: skip
    if magic != _MAGIC:
        raise RecordingError("it does not begin like a meta file of a recording")
    if version != VERSION:
        raise RecordingError(f"its format version is {version}, known is {VERSION}")
    if not EARLIEST_MS <= start_ms <= LATEST_MS:
        raise RecordingError(f"its start is not a time: {start_ms} ms since 1970")
    begin = _HEAD.size + length
    stop = min(index_end, len(data)) if index_end else len(data)
    count = max(stop - begin, 0) // _ENTRY.size
    files = _parse_files(data, index_end) if 0 < index_end <= len(data) else None
    if files is None:  # the list of files of a recording that was never completed is not an entry
        kinds = data[begin + 4 : begin + count * _ENTRY.size : _ENTRY.size]
        count = next((at for at, kind in enumerate(kinds) if kind not in (RECORD, CLOSED)), count)
    end = begin + count * _ENTRY.size
    return Meta(
        start_ms=start_ms,
        duration_ms=duration_ms,
        size=size,
        index_end=index_end,
        data_types=data_types,
        largest_record=largest,
        profile_id=profile,
        session_id=data[_HEAD.size : begin].rstrip(b"\0"),
        files=files or [],
        next_name=_name_at(data, next_at)[0] if files and next_at > index_end else "",
        index=data[begin:end],
        complete=end == index_end and files is not None,
    )


def _parse_files(data: bytes, position: int) -> list[str] | None:
    """Return the names of the data files; None if the list is cut or damaged."""
    names: list[str] = []
    try:
        _, kind, count = _FILES.unpack_from(data, position)
    except struct.error:
        return None
    position += _FILES.size
    while kind == _FILE_LIST and len(names) < count:
        name, position = _name_at(data, position)
        if not name or "\0" in name:
            return None
        names.append(name)
    return names if kind == _FILE_LIST else None


def _name_at(data: bytes, position: int) -> tuple[str, int]:
    """Return a name and the position behind it; an empty one if it is cut or damaged."""
    try:
        (length,) = _LENGTH.unpack_from(data, position)
        end = position + _LENGTH.size + length
        name = data[end - length : end].rstrip(b"\0").decode()
    except (struct.error, UnicodeDecodeError):
        return "", position
    return (name, end) if end <= len(data) and "\0" not in name else ("", position)


def id_in_names(session_id: str) -> str:
    """Return a session id as names of directories have it."""
    return re.sub(r"[^\w.+-]", "_", session_id)

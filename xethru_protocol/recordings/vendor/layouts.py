"""Layouts of the files in a recording directory: binary and text data files, and the meta file.

The directory's files are named in Protocol reference 12. How each part is known: [OBS] seen in
recordings of known content; [HDR] data type bit taken from the public header of the vendor's
library, no sample at hand; [FMT] name from Protocol reference 12; [INF] inferred from the message's
fields, or from what others report of such files.

A binary data file holds records without separators: a message's payload without its leading codes.

A text file holds lines: an ISO time stamp and the message's fields, separated by ``;``, below a
line of titles. Lists are in square brackets, separated by commas. Only PRESENCE_SINGLE is known
from a recording; a line with other columns is reported and not interpreted.

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
    0x29      8 x FF (meaning unknown)
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

After the index: u32 duration, u8 3, u32 number of files; of each u32 length and name, with NUL.

Our samples have one file each, so they do not show the file number and the two origins of begin and
end; these are what others report of split recordings in the same format.
"""

import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from datetime import datetime, timedelta, tzinfo
from typing import Any, ClassVar, NamedTuple

import numpy as np

from xethru_protocol.recordings.records import EARLIEST_MS, LATEST_MS, MS_NS, RecordingError
from xethru_protocol.wire import fields, messages
from xethru_protocol.wire.codec import encode
from xethru_protocol.wire.rows import ROWS, Response


@dataclass(frozen=True, slots=True)
class _Kind:
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
class BinaryKind(_Kind):
    """One kind of binary data file."""

    suffix: ClassVar[str] = ".dat"
    titles: ClassVar[bytes] = b""
    header: np.dtype[np.void]  # the message's fields before its elements, packed
    count: str  # header field that counts the elements
    columns: int  # values per element: 2 where all of one column come before all of the other
    values: str  # numpy type of one value

    @property
    def prefix(self) -> bytes:
        """Codes that the payload begins with and the record leaves out."""
        return ROWS[self.message].prefix

    @property
    def element_bytes(self) -> int:
        return self.columns * np.dtype(self.values).itemsize

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
        case fields.Bins(count_field=count):
            values = "<f4"
        case fields.Block(count=count):
            values = "u1"
        case fields.Elements(count_label=count, code=code):  # a u32 count comes before them
            header.append((count, "<u4"))
            values = "<f4" if code == "a" else "u1"
    return BinaryKind(name, 1 << bit, message, np.dtype(header), count, len(elements), values)


BINARY_KINDS = (
    _binary("baseband_ap", 0, messages.BasebandAp),  # bit [OBS], name [FMT]
    _binary("baseband_iq", 1, messages.BasebandIq),  # bit, name and records [OBS]
    _binary("pulsedoppler_float", 6, messages.PulseDopplerFloat),  # bit [OBS], name [FMT]
    _binary("pulsedoppler_byte", 7, messages.PulseDopplerByte),  # bit [OBS], name [FMT]
    # bits [HDR], names [FMT] (their endings inferred from pulse-Doppler)
    _binary("noisemap_float", 8, messages.NoiseMapFloat),
    _binary("noisemap_byte", 9, messages.NoiseMapByte),
    _binary("datafloat", 10, messages.DataFloat),  # bit, name and records [OBS]
    _binary("databyte", 11, messages.DataByte),  # bit [HDR], name [FMT]
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
        raise ValueError(f"a list in square brackets was expected, not {text!r}")
    numbers = [float(item) for item in text[1:-1].split(",") if item]
    layout = f"<{len(numbers)}f"
    return struct.unpack(layout, struct.pack(layout, *numbers))


_ESCAPES = str.maketrans({"\\": "\\\\", "\n": "\\n", "\r": "\\r", ";": "\\x3b"})


def _escaped(text: str) -> str:
    return text.translate(_ESCAPES)


def _unescaped(text: str) -> str:
    return text.encode("latin-1").decode("unicode_escape")


class _Column(NamedTuple):
    """A column of a text file: its title, the message's field, the field as text and back."""

    title: str
    field: str
    text: Callable[[Any], str]
    value: Callable[[str], Any]
    is_count: bool = False  # of the list ``field``


@dataclass(frozen=True, slots=True)
class TextKind(_Kind):
    """One kind of text file."""

    suffix: ClassVar[str] = ".csv"
    columns: tuple[_Column, ...]

    @property
    def titles(self) -> bytes:
        """First line of a file, with its end of line."""
        return (";".join(("TimeStamp", *(column.title for column in self.columns))) + "\n").encode()

    def record(self, message: Response, time_ms: int, zone: tzinfo | None) -> bytes:
        """Return the line of a message and its time [ms since 1970], with its end of line."""
        time = (_UNIX + timedelta(milliseconds=time_ms)).astimezone(zone)
        cells = (column.text(getattr(message, column.field)) for column in self.columns)
        return (";".join((time.isoformat(timespec="milliseconds"), *cells)) + "\n").encode(
            "latin-1"
        )

    def parse(self, line: str) -> tuple[Response, int]:
        """Return the message of a line and its time [ns since 1970].

        ValueError, OverflowError or LocalProtocolError if the line is not of this kind.
        """
        stamp, *cells = line.rstrip("\r\n").split(";")
        if len(cells) != len(self.columns):
            n_columns = len(self.columns) + 1
            raise ValueError(f"{n_columns} columns were expected, not {len(cells) + 1}")
        values: dict[str, Any] = {}
        counts: dict[str, int] = {}
        for (_, name, _, value_of, is_count), cell in zip(self.columns, cells, strict=True):
            (counts if is_count else values)[name] = value_of(cell)
        for name, count in counts.items():
            if len(values[name]) != count:
                raise ValueError(f"{name} has {len(values[name])} values, not {count}")
        message = self.message(**values)
        encode(message)  # raises if a value does not fit its field on the wire
        return message, _time_ns(stamp)


def _text(name: str, bit: int, message: type[Response], titles: dict[str, str]) -> TextKind:
    """Return the kind whose columns have these titles and hold these fields, in their order."""
    kinds = dict(ROWS[message].kinds)
    columns = []
    for title, field_name in titles.items():
        match kinds[field_name]:
            case fields.Number(code="f"):
                column = _Column(title, field_name, float_text, _float32)
            case fields.Floats():
                column = _Column(title, field_name, _list_text, _list)
            case fields.Elements():
                column = _Column(title, field_name, _escaped, _unescaped)
            case fields.Count(of=(counted, *_)):
                column = _Column(title, counted, lambda of: str(len(of)), int, is_count=True)
            case _:
                column = _Column(title, field_name, str, int)
        columns.append(column)
    return TextKind(name, 1 << bit, message, tuple(columns))


_UNIX = datetime.fromisoformat("1970-01-01T00:00:00+00:00")


def _time_ns(stamp: str) -> int:
    time = datetime.fromisoformat(stamp)
    if time.tzinfo is None:
        time = time.astimezone()  # a stamp without zone is taken to be in that of this machine
    time_ms = (time - _UNIX) // timedelta(milliseconds=1)
    if not EARLIEST_MS <= time_ms <= LATEST_MS:
        raise ValueError(f"{stamp} is beyond what 64 bits of nanoseconds hold")
    return time_ms * MS_NS


_FRAME_STATE = {"FrameCounter": "counter", "State": "state", "RPM": "rpm"}
_MOVEMENT = {"MovementSlowItem": "movement_slow", "MovementFastItem": "movement_fast"}
_DETECTION = {
    "DetectionDistance": "detection_distance_m",
    "DetectionRadarCrossSection": "detection_rcs",
    "DetectionVelocity": "detection_velocity",
}

TEXT_KINDS = (
    _text(  # bit, name and columns [OBS]
        "presence_single",
        12,
        messages.PresenceSingle,
        {
            "Counter": "counter",
            "PresenceState": "state",
            "Distance": "distance_m",
            "Direction": "direction",
            "SignalQuality": "signal_quality",
        },
    ),
    _text(  # bit [OBS]; name, columns and brackets as others report them [INF]
        "presence_movinglist",
        13,
        messages.PresenceMovingList,
        {
            "Counter": "counter",
            "PresenceState": "state",
            "MovementIntervalCount": "interval_count",
            "DetectionCount": "detection_count",
        }
        | _MOVEMENT
        | _DETECTION,
    ),
    _text(  # bit [HDR]; name and columns as others report them, the last two [INF]
        "sleep",
        2,
        messages.SleepStatus,
        _FRAME_STATE
        | {
            "ObjectDistance": "distance_m",
            "SignalQuality": "signal_quality",
            "MovementSlow": "movement_slow",
            "MovementFast": "movement_fast",
        },
    ),
    _text(  # bit [HDR]; name as others report it, columns [INF]
        "respiration",
        3,
        messages.RespStatus,
        _FRAME_STATE
        | {
            "ObjectDistance": "distance_m",
            "ObjectMovement": "movement_mm",
            "SignalQuality": "signal_quality",
        },
    ),
    # bits [HDR], names and columns [INF] from here on
    _text(
        "string",
        5,
        messages.DataString,
        {"ContentId": "content_id", "Info": "info", "Text": "text"},
    ),
    _text(
        "respiration_detectionlist",
        14,
        messages.RespirationDetectionList,
        {"Counter": "counter", "DetectionCount": "detection_count"} | _DETECTION,
    ),
    _text(
        "respiration_movinglist",
        15,
        messages.RespirationMovingList,
        {"Counter": "counter", "MovementIntervalCount": "interval_count"} | _MOVEMENT,
    ),
    _text(
        "vitalsigns",
        16,
        messages.VitalSigns,
        {
            "Counter": "counter",
            "State": "state",
            "RespirationRate": "respiration_rate",
            "RespirationDistance": "respiration_distance_m",
            "RespirationConfidence": "respiration_confidence",
            "HeartRate": "heart_rate",
            "HeartDistance": "heart_distance_m",
            "HeartConfidence": "heart_confidence",
            "NormalizedMovementSlow": "normalized_movement_slow",
            "NormalizedMovementFast": "normalized_movement_fast",
            "NormalizedMovementStart": "normalized_movement_start_m",
            "NormalizedMovementEnd": "normalized_movement_end_m",
        },
    ),
    _text(
        "sleepstage",
        17,
        messages.SleepStage,
        {"Counter": "counter", "SleepStage": "stage"},
    ),
    _text(
        "respiration_normalizedmovementlist",
        18,
        messages.RespirationNormalizedMovementList,
        {
            "Counter": "counter",
            "Start": "start_m",
            "BinLength": "bin_length_m",
            "Count": "count",
            "MovementSlow": "movement_slow",
            "MovementFast": "movement_fast",
        },
    ),
)

KINDS: tuple[BinaryKind | TextKind, ...] = (*BINARY_KINDS, *TEXT_KINDS)
"""All kinds. Bits 1 << 4 (performance status) and 1 << 19 ... 22 (frames of newer firmware) of the
vendor's header have no row: their layout is not known (Protocol reference 7.5)."""
KIND_OF_MESSAGE = {kind.message: kind for kind in KINDS}
KIND_OF_TYPE = {kind.data_type: kind for kind in KINDS}
_LONGEST_FIRST = sorted(KINDS, key=lambda kind: -len(kind.name))


def kind_of_file(name: str) -> BinaryKind | TextKind | None:
    for kind in _LONGEST_FIRST:
        if name.startswith(kind.file_prefix) and name.endswith(kind.suffix):
            return kind
    return None


META_NAME = "xethru_recording_meta.dat"
PARAMETER_FILE_NAME = "xethru_parameter_file.par"
VERSION = 13

ALL_BITS = 0xFFFFFFFF
_MAGIC = 0xA0B1C2D3
_HEAD = struct.Struct("<IIqBIQQI8sII28sI")
_ENTRY = struct.Struct("<IBIIIQQ")
_FILES = struct.Struct("<IBI")
_LENGTH = struct.Struct("<I")
RECORD, CLOSED, _FILE_LIST = 1, 2, 3
_UNKNOWN_BYTE = 1
_UNKNOWN = b"\xff" * 8
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

    ``index_end`` is 0 until the recording is closed. ``index`` holds the entries as they were read,
    packed; ``complete``: the recording was closed and nothing is missing.
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
            _UNKNOWN,
            self.largest_record,
            self.profile_id,
            _RESERVED,
            len(text),
        )
        return head + text

    def pack_files(self) -> bytes:
        """Return the bytes of the list of files, which ends the meta file."""
        parts = [_FILES.pack(self.duration_ms, _FILE_LIST, len(self.files))]
        for name in self.files:
            text = name.encode() + b"\0"
            parts.append(_LENGTH.pack(len(text)) + text)
        return b"".join(parts)


def parse_meta(data: bytes) -> Meta:
    """Read a meta file, as much of it as is there; RecordingError if its head is damaged."""
    if len(data) < _HEAD.size:
        raise RecordingError(f"it is cut: {len(data)} of {_HEAD.size} bytes of its head are there")
    (magic, version, start_ms, _, duration_ms, size, index_end, data_types, _, largest, profile, _,
     length) = _HEAD.unpack_from(data)  # fmt: skip
    if magic != _MAGIC:
        raise RecordingError("it does not begin like a meta file of a recording")
    if version != VERSION:
        raise RecordingError(f"its format version is {version}, known is {VERSION}")
    if not EARLIEST_MS <= start_ms <= LATEST_MS:
        raise RecordingError(f"its start is no time: {start_ms} ms since 1970")
    begin = _HEAD.size + length
    stop = min(index_end, len(data)) if index_end else len(data)
    count = max(stop - begin, 0) // _ENTRY.size
    # The list of files of a recording whose head was never completed is no entry.
    kinds = data[begin + 4 : begin + count * _ENTRY.size : _ENTRY.size]
    count = next((at for at, kind in enumerate(kinds) if kind not in (RECORD, CLOSED)), count)
    end = begin + count * _ENTRY.size
    files = _parse_files(data, index_end) if 0 < index_end <= len(data) else None
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
        index=data[begin:end],
        complete=end == index_end and files is not None,
    )


def _parse_files(data: bytes, position: int) -> list[str] | None:
    """Return the names of the data files; None if the list is cut or damaged."""
    names: list[str] = []
    try:
        _, kind, count = _FILES.unpack_from(data, position)
        position += _FILES.size
        while kind == _FILE_LIST and len(names) < count:
            (length,) = _LENGTH.unpack_from(data, position)
            position += _LENGTH.size + length
            if position > len(data):
                return None
            names.append(data[position - length : position].rstrip(b"\0").decode())
    except (struct.error, UnicodeDecodeError):
        return None
    return names if kind == _FILE_LIST else None

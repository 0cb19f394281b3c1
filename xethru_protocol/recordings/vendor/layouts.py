"""The data files of ModuleConnector, binary and text: one row per data type.

A data file holds records without separators: a message's payload without its leading codes
(Protocol reference 12). Data type bits: [OBS] seen in recordings of known content; [HDR] taken
from the public header of the vendor's library, no sample at hand. File names: [FMT] Protocol
reference 12, [OBS] seen. The kinds that are text are in `CSV_KINDS`.

A line is an ISO time stamp and the message's fields, separated by ``;``; the first line names the
columns. Lists are in square brackets, separated by commas. Known from a recording [OBS]:
PRESENCE_SINGLE with its header, bit and name. Bits [HDR] as in ``layouts``. Everything else is
inferred [INF] from the message's fields in the same manner, or from what others report of such
files; a line of another column count or order is reported, not guessed at.

Worked out from recordings that the vendor's library wrote from known messages; a real one of 2017
and those of 2026 agree in every byte. What it means is known where the vendor's own reader gives
the same number; the rest is marked.

Head, 0x59 bytes and the session id::

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

The file number and the two different origins of begin and end do not follow from our samples,
which have one file each; they are what others report of split recordings in the same format.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta, tzinfo
from typing import Any

import numpy as np
import numpy.typing as npt

from xethru_protocol.recordings.records import EARLIEST_MS, LATEST_MS, MS_NS, RecordingError
from xethru_protocol.wire import responses
from xethru_protocol.wire.codec import encode
from xethru_protocol.wire.codes import AppDataId, ElementType, ResponseCode
from xethru_protocol.wire.table import Response


@dataclass(frozen=True, slots=True)
class Layout:
    """One kind of binary data file.

    Attributes
    ----------
    file_prefix
        What its file names begin with; a local time stamp and ``.dat`` follow.
    data_type
        Its bit in the meta file.
    prefix
        What the payload has and the record has not.
    header
        Fields before the elements, as a packed numpy type.
    count
        Name of the header field that counts the elements.
    columns
        Values per element: 2 where all of one column come before all of the other.
    values
        numpy type of one value.
    """

    file_prefix: str
    data_type: int
    prefix: bytes
    header: np.dtype[np.void]
    count: str
    columns: int
    values: str

    @property
    def element_bytes(self) -> int:
        return self.columns * np.dtype(self.values).itemsize

    def record_size(self, header: bytes) -> int:
        count = int(np.frombuffer(header, self.header, 1)[self.count][0])
        return self.header.itemsize + count * self.element_bytes


def _appdata(content: AppDataId) -> bytes:
    return bytes((ResponseCode.XTS_SPR_APPDATA, *content.to_bytes(4, "little")))


_DATA_HEADER = np.dtype([("content_id", "<u4"), ("info", "<u4"), ("length", "<u4")])
_BASEBAND_HEADER = np.dtype(
    [
        ("counter", "<u4"),
        ("num_bins", "<u4"),
        ("bin_length_m", "<f4"),
        ("sampling_frequency_hz", "<f4"),
        ("carrier_frequency_hz", "<f4"),
        ("range_offset_m", "<f4"),
    ]
)
_MATRIX_HEAD = [
    ("counter", "<u4"),
    ("matrix_counter", "<u4"),
    ("range_idx", "<u4"),
    ("range_bins", "<u4"),
    ("frequency_count", "<u4"),
    ("pulsedoppler_instance", "<u4"),
]
_MATRIX_TAIL = [
    ("fps", "<f4"),
    ("fps_decimated", "<f4"),
    ("frequency_start", "<f4"),
    ("frequency_step", "<f4"),
    ("range_m", "<f4"),
]
_FLOAT_MATRIX = np.dtype(_MATRIX_HEAD + _MATRIX_TAIL)
_BYTE_MATRIX = np.dtype(
    [*_MATRIX_HEAD, ("byte_step_start", "<f4"), ("byte_step_size", "<f4"), *_MATRIX_TAIL]
)
_DATA = ResponseCode.XTS_SPR_DATA

LAYOUTS = (
    Layout(  # bit [OBS], name [FMT]
        "xethru_baseband_ap_",
        1 << 0,
        _appdata(AppDataId.XTS_ID_BASEBAND_AMPLITUDE_PHASE),
        _BASEBAND_HEADER,
        "num_bins",
        2,
        "<f4",
    ),
    Layout(  # bit, name and records [OBS]
        "xethru_baseband_iq_",
        1 << 1,
        _appdata(AppDataId.XTS_ID_BASEBAND_IQ),
        _BASEBAND_HEADER,
        "num_bins",
        2,
        "<f4",
    ),
    Layout(  # bit [OBS], name [FMT]
        "xethru_pulsedoppler_float_",
        1 << 6,
        _appdata(AppDataId.XTS_ID_PULSEDOPPLER_FLOAT),
        _FLOAT_MATRIX,
        "frequency_count",
        1,
        "<f4",
    ),
    Layout(  # bit [OBS], name [FMT]
        "xethru_pulsedoppler_byte_",
        1 << 7,
        _appdata(AppDataId.XTS_ID_PULSEDOPPLER_BYTE),
        _BYTE_MATRIX,
        "frequency_count",
        1,
        "u1",
    ),
    Layout(  # bit [HDR], name [FMT] (its ending inferred from pulse-Doppler)
        "xethru_noisemap_float_",
        1 << 8,
        _appdata(AppDataId.XTS_ID_NOISEMAP_FLOAT),
        _FLOAT_MATRIX,
        "frequency_count",
        1,
        "<f4",
    ),
    Layout(  # bit [HDR], name [FMT] (its ending inferred from pulse-Doppler)
        "xethru_noisemap_byte_",
        1 << 9,
        _appdata(AppDataId.XTS_ID_NOISEMAP_BYTE),
        _BYTE_MATRIX,
        "frequency_count",
        1,
        "u1",
    ),
    Layout(  # bit, name and records [OBS]
        "xethru_datafloat_",
        1 << 10,
        bytes((_DATA, ElementType.XTS_SPRD_FLOAT)),
        _DATA_HEADER,
        "length",
        1,
        "<f4",
    ),
    Layout(  # bit [HDR], name [FMT]
        "xethru_databyte_",
        1 << 11,
        bytes((_DATA, ElementType.XTS_SPRD_BYTE)),
        _DATA_HEADER,
        "length",
        1,
        "u1",
    ),
)

BY_PREFIX = {layout.prefix: layout for layout in LAYOUTS}
"""Layout of a payload by its first two or five bytes."""


def layout_of(payload: bytes) -> Layout | None:
    """Return the layout of a payload in NoEscape form; None if it is no bulk message."""
    layout = BY_PREFIX.get(payload[:2]) or BY_PREFIX.get(payload[:5])
    if layout is None:
        return None
    start = len(layout.prefix)
    header = payload[start : start + layout.header.itemsize]
    if len(header) < layout.header.itemsize or layout.record_size(header) != len(payload) - start:
        return None
    return layout


_EPOCH_DIGITS = "milliseconds"


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


def _exact_float32(text: str) -> float:
    (value,) = struct.unpack("<f", struct.pack("<f", float(text)))
    return float(value)


def _list_text(values: Any) -> str:  # noqa: ANN401 - an array or a tuple of numbers
    return "[" + ",".join(float_text(float(value)) for value in values) + "]"


def _list(text: str) -> Any:  # noqa: ANN401 - what the message's field holds
    if not (text.startswith("[") and text.endswith("]")):
        raise ValueError(f"a list in square brackets was expected, not {text!r}")
    return tuple(_exact_float32(item) for item in text[1:-1].split(",") if item)


_ESCAPES = {"\\": "\\\\", "\n": "\\n", "\r": "\\r", ";": "\\x3b"}


def _escaped(text: str) -> str:
    return "".join(_ESCAPES.get(character, character) for character in text)


def _unescaped(text: str) -> str:
    return text.encode("latin-1").decode("unicode_escape")


@dataclass(frozen=True, slots=True)
class Column:
    """A column: its title, the message's field, and the field as text and back."""

    title: str
    field: str
    text: Callable[[Any], str] = str
    value: Callable[[str], Any] = int
    is_count: bool = False  # the length of the list ``field``, not a field of its own


def _real(title: str, field: str) -> Column:
    return Column(title, field, float_text, _exact_float32)


def _listed(title: str, field: str) -> Column:
    return Column(title, field, _list_text, _list)


def _counted(title: str, field: str) -> Column:
    return Column(title, field, lambda values: str(len(values)), int, is_count=True)


@dataclass(frozen=True, slots=True)
class CsvKind:
    """One kind of text file; ``message`` is the row of the message table it holds."""

    file_prefix: str
    data_type: int
    message: type[Response]
    columns: tuple[Column, ...]

    @property
    def header(self) -> str:
        """First line of a file, with its end of line."""
        return ";".join(("TimeStamp", *(column.title for column in self.columns))) + "\n"

    def line(self, message: Response, time_ms: int, zone: tzinfo | None) -> str:
        """Line of a message with its time [ms since 1970], with its end of line."""
        cells = (column.text(getattr(message, column.field)) for column in self.columns)
        return ";".join((_stamp(time_ms, zone), *cells)) + "\n"

    def parse(self, line: str) -> tuple[Response, int]:
        """Message of a line and its time [ns since 1970].

        Raises
        ------
        ValueError, OverflowError, LocalProtocolError
            If the line is of another kind.
        """
        cells = line.rstrip("\r\n").split(";")
        if len(cells) != len(self.columns) + 1:
            raise ValueError(f"{len(self.columns) + 1} columns were expected, not {len(cells)}")
        fields: dict[str, Any] = {}
        counts: dict[str, int] = {}
        for column, cell in zip(self.columns, cells[1:], strict=True):
            (counts if column.is_count else fields)[column.field] = column.value(cell)
        for field, count in counts.items():
            if len(fields[field]) != count:
                raise ValueError(f"{field} has {len(fields[field])} values, not {count}")
        message = self.message(**fields)
        encode(message)  # it must fit the wire, or nothing can be done with it
        return message, _time_ns(cells[0])


_UNIX = datetime.fromisoformat("1970-01-01T00:00:00+00:00")


def _stamp(time_ms: int, zone: tzinfo | None) -> str:
    time = (_UNIX + timedelta(milliseconds=time_ms)).astimezone(zone)
    return time.isoformat(timespec=_EPOCH_DIGITS)


def _time_ns(stamp: str) -> int:
    time = datetime.fromisoformat(stamp)
    if time.tzinfo is None:
        time = time.astimezone()  # the zone it was written in is not stored: this machine's
    time_ms = (time - _UNIX) // timedelta(milliseconds=1)
    if not EARLIEST_MS <= time_ms <= LATEST_MS:
        raise ValueError(f"{stamp} is beyond what 64 bits of nanoseconds hold")
    return time_ms * MS_NS


_COUNTER = Column("Counter", "counter")
_STATE = Column("State", "state")
_RATE = _real("RPM", "rpm")
_DISTANCE = _real("ObjectDistance", "distance_m")
_QUALITY = Column("SignalQuality", "signal_quality")
_MOVEMENT = (
    _counted("MovementIntervalCount", "movement_slow"),
    _listed("MovementSlowItem", "movement_slow"),
    _listed("MovementFastItem", "movement_fast"),
)
_DETECTION_COUNT = _counted("DetectionCount", "detection_distance_m")
_DETECTION = (
    _listed("DetectionDistance", "detection_distance_m"),
    _listed("DetectionRadarCrossSection", "detection_rcs"),
    _listed("DetectionVelocity", "detection_velocity"),
)

CSV_KINDS: tuple[CsvKind, ...] = (
    CsvKind(  # bit, name and columns [OBS]
        "xethru_presence_single_",
        1 << 12,
        responses.PresenceSingle,
        (
            _COUNTER,
            Column("PresenceState", "state"),
            _real("Distance", "distance_m"),
            Column("Direction", "direction"),
            _QUALITY,
        ),
    ),
    CsvKind(  # bit [OBS]; name, columns and brackets as others report them [INF]
        "xethru_presence_movinglist_",
        1 << 13,
        responses.PresenceMovingList,
        (
            _COUNTER,
            Column("PresenceState", "state"),
            _MOVEMENT[0],
            _DETECTION_COUNT,
            *_MOVEMENT[1:],
            *_DETECTION,
        ),
    ),
    CsvKind(  # bit [HDR]; name and columns as others report them, the last two [INF]
        "xethru_sleep_",
        1 << 2,
        responses.SleepStatus,
        (
            Column("FrameCounter", "counter"),
            _STATE,
            _RATE,
            _DISTANCE,
            _QUALITY,
            _real("MovementSlow", "movement_slow"),
            _real("MovementFast", "movement_fast"),
        ),
    ),
    CsvKind(  # bit [HDR]; name as others report it, columns [INF]
        "xethru_respiration_",
        1 << 3,
        responses.RespStatus,
        (
            Column("FrameCounter", "counter"),
            _STATE,
            Column("RPM", "rpm"),
            _DISTANCE,
            _real("ObjectMovement", "movement_mm"),
            _QUALITY,
        ),
    ),
    CsvKind(  # bit [HDR], name and columns [INF]
        "xethru_string_",
        1 << 5,
        responses.DataString,
        (
            Column("ContentId", "content_id"),
            Column("Info", "info"),
            Column("Text", "text", _escaped, _unescaped),
        ),
    ),
    CsvKind(  # bit [HDR], name and columns [INF]
        "xethru_respiration_detectionlist_",
        1 << 14,
        responses.RespirationDetectionList,
        (_COUNTER, _DETECTION_COUNT, *_DETECTION),
    ),
    CsvKind(  # bit [HDR], name and columns [INF]
        "xethru_respiration_movinglist_",
        1 << 15,
        responses.RespirationMovingList,
        (_COUNTER, *_MOVEMENT),
    ),
    CsvKind(  # bit [HDR], name and columns [INF]
        "xethru_vitalsigns_",
        1 << 16,
        responses.VitalSigns,
        (
            _COUNTER,
            _STATE,
            _real("RespirationRate", "respiration_rate"),
            _real("RespirationDistance", "respiration_distance_m"),
            _real("RespirationConfidence", "respiration_confidence"),
            _real("HeartRate", "heart_rate"),
            _real("HeartDistance", "heart_distance_m"),
            _real("HeartConfidence", "heart_confidence"),
            _real("NormalizedMovementSlow", "normalized_movement_slow"),
            _real("NormalizedMovementFast", "normalized_movement_fast"),
            _real("NormalizedMovementStart", "normalized_movement_start_m"),
            _real("NormalizedMovementEnd", "normalized_movement_end_m"),
        ),
    ),
    CsvKind(  # bit [HDR], name and columns [INF]
        "xethru_sleepstage_",
        1 << 17,
        responses.SleepStage,
        (_COUNTER, Column("SleepStage", "stage")),
    ),
    CsvKind(  # bit [HDR], name and columns [INF]
        "xethru_respiration_normalizedmovementlist_",
        1 << 18,
        responses.RespirationNormalizedMovementList,
        (
            _COUNTER,
            _real("Start", "start_m"),
            _real("BinLength", "bin_length_m"),
            _counted("Count", "movement_slow"),
            _listed("MovementSlow", "movement_slow"),
            _listed("MovementFast", "movement_fast"),
        ),
    ),
)
"""All kinds. Bits 1 << 4 (performance status) and 1 << 19 ... 22 (frames of newer firmware) of the
vendor's header have no row: their layout is not known (Protocol reference 7.5)."""
BY_MESSAGE: dict[type[Response], CsvKind] = {kind.message: kind for kind in CSV_KINDS}


META_NAME = "xethru_recording_meta.dat"
PARAMETER_FILE_NAME = "xethru_parameter_file.par"
VERSION = 13

ALL_BITS = 0xFFFFFFFF
_MAGIC = 0xA0B1C2D3
_HEAD = struct.Struct("<IIqBIQQI8sII28sI")
_ENTRY = struct.Struct("<IBIIIQQ")
_ROW = np.dtype(
    [
        ("since_ms", "<u4"),
        ("kind", "u1"),
        ("data_type", "<u4"),
        ("size", "<u4"),
        ("file", "<u4"),
        ("begin", "<u8"),
        ("end", "<u8"),
    ]
)
_AT_ONCE = 4096  # entries unpacked together
_FILES = struct.Struct("<IBI")
_LENGTH = struct.Struct("<I")
_RECORD, _CLOSED, _FILE_LIST = 1, 2, 3
_UNKNOWN_BYTE = 1
_UNKNOWN = b"\xff" * 8
_RESERVED = b"\xcd" * 28


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One entry of the index; ``size`` 0 and ``closed`` when a data file was closed."""

    since_start_ms: int
    closed: bool = False
    data_type: int
    size: int
    file: int
    begin: int
    end: int

    def pack(self) -> bytes:
        kind = _CLOSED if self.closed else _RECORD
        return _ENTRY.pack(
            self.since_start_ms, kind, self.data_type, self.size, self.file, self.begin, self.end
        )


class Index:
    """The entries of a meta file, one after the other; they stay packed, 33 bytes each."""

    def __init__(self, rows: npt.NDArray[np.void]) -> None:
        self._rows = rows

    def __len__(self) -> int:
        """Return the number of entries."""
        return len(self._rows)

    def __iter__(self) -> Iterator[Entry]:
        """Return the entries in order."""
        for begin in range(0, len(self), _AT_ONCE):
            for since_ms, kind, data_type, size, file, start, end in self._rows[
                begin : begin + _AT_ONCE
            ].tolist():
                yield Entry(
                    since_start_ms=since_ms,
                    closed=kind == _CLOSED,
                    data_type=data_type,
                    size=size,
                    file=file,
                    begin=start,
                    end=end,
                )

    def stops_ms(self) -> list[int]:
        """Return when data files were closed [ms since start]."""
        found: list[int] = self._rows["since_ms"][self._rows["kind"] == _CLOSED].tolist()
        return found


@dataclass(frozen=True, slots=True, kw_only=True)
class MetaHead:
    """Head of the meta file; ``index_end`` is 0 until the recording is closed."""

    start_ms: int
    duration_ms: int = 0
    size: int = 0
    index_end: int = 0
    data_types: int = 0
    largest_record: int = 0
    profile_id: int = 0
    session_id: bytes = b""

    def pack(self) -> bytes:
        text = self.session_id + b"\0"
        return (
            _HEAD.pack(
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
            + text
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Meta:
    """A meta file as read; ``complete``: it was closed and nothing is missing."""

    head: MetaHead
    entries: Index
    files: tuple[str, ...]
    complete: bool


def pack_files(duration_ms: int, names: list[str]) -> bytes:
    """Bytes of the list of files, which ends the meta file."""
    parts = [_FILES.pack(duration_ms, _FILE_LIST, len(names))]
    for name in names:
        text = name.encode() + b"\0"
        parts.append(_LENGTH.pack(len(text)) + text)
    return b"".join(parts)


def parse_meta(data: bytes) -> Meta:
    """Read a meta file, as much of it as is there.

    Raises
    ------
    RecordingError
        If the head is damaged or not of this format.
    """
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
    index = _HEAD.size + length
    head = MetaHead(
        start_ms=start_ms,
        duration_ms=duration_ms,
        size=size,
        index_end=index_end,
        data_types=data_types,
        largest_record=largest,
        profile_id=profile,
        session_id=data[_HEAD.size : index].rstrip(b"\0"),
    )
    entries, position = _parse_entries(data, index, index_end)
    names = _parse_files(data, index_end) if 0 < index_end <= len(data) else None
    complete = position == index_end and names is not None
    return Meta(head=head, entries=entries, files=names or (), complete=complete)


def _parse_entries(data: bytes, index: int, index_end: int) -> tuple[Index, int]:
    stop = min(index_end, len(data)) if index_end else len(data)
    count = max(stop - index, 0) // _ENTRY.size
    rows = np.frombuffer(data, _ROW, count, index) if count else np.empty(0, _ROW)
    # The list of files of a recording whose head was never completed is no entry.
    strange = np.flatnonzero((rows["kind"] != _RECORD) & (rows["kind"] != _CLOSED))
    rows = rows[: strange[0]] if len(strange) else rows
    return Index(rows), index + len(rows) * _ENTRY.size


def _parse_files(data: bytes, position: int) -> tuple[str, ...] | None:
    """Names of the data files; None if the list is cut or damaged."""
    try:
        _, kind, count = _FILES.unpack_from(data, position)
        position += _FILES.size
        names: list[str] = []
        while kind == _FILE_LIST and len(names) < count:
            (length,) = _LENGTH.unpack_from(data, position)
            position += _LENGTH.size + length
            if position > len(data):
                return None
            names.append(data[position - length : position].rstrip(b"\0").decode())
    except (struct.error, UnicodeDecodeError):
        return None
    return tuple(names) if kind == _FILE_LIST else None

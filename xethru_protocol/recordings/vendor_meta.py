"""``xethru_recording_meta.dat``, format version 13, byte by byte.

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

The file number and the two different origins of begin and end cannot be told from our samples,
which have one file each; they are what others report of split recordings in the same format.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from xethru_protocol.recordings.errors import RecordingError
from xethru_protocol.recordings.records import EARLIEST_MS, LATEST_MS

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
        """Bytes of the entry."""
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
        """Bytes of the head."""
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
    """A meta file as read; ``complete`` says that it was closed and nothing is missing."""

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
    """Return the entries from ``index`` on and where they end."""
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

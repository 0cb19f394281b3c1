"""Reads recording directories of the vendor's ModuleConnector: what was received, and when.

The data files alone give every message (`vendor_files`); the index of the meta file adds the
times and the order among several files. An error in the index costs times, never messages.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from xethru_protocol.recordings.records import (
    MS_NS,
    FaultHandler,
    RecordingError,
    RecordingFacts,
    RecordingFault,
    Timed,
    TimedMessages,
    report,
    unreadable,
)
from xethru_protocol.recordings.vendor.layouts import (
    ALL_BITS,
    CSV_KINDS,
    LAYOUTS,
    META_NAME,
    PARAMETER_FILE_NAME,
    CsvKind,
    Entry,
    Layout,
    Meta,
    parse_meta,
)
from xethru_protocol.wire.codec import decode_response
from xethru_protocol.wire.errors import LocalProtocolError
from xethru_protocol.wire.table import Response

_KINDS: tuple[Layout | CsvKind, ...] = (*LAYOUTS, *CSV_KINDS)
_BY_TYPE: dict[int, Layout | CsvKind] = {kind.data_type: kind for kind in _KINDS}
_BY_LENGTH = sorted(_KINDS, key=lambda kind: -len(kind.file_prefix))
_LONGEST_USER_HEADER = 4096  # bytes; looked for where no index gives its length
_LARGEST_PLAUSIBLE_RECORD = 1 << 16
_LAST_CONTENT_ID = 14  # Protocol reference 6.1


def kind_of(file_or_type: str | int) -> Layout | CsvKind | None:
    """Kind of a data file by its name or its data type bit; None if it is not known."""
    if isinstance(file_or_type, int):
        return _BY_TYPE.get(file_or_type)
    for kind in _BY_LENGTH:
        if file_or_type.startswith(kind.file_prefix) and file_or_type.endswith(_suffix(kind)):
            return kind
    return None


def _suffix(kind: Layout | CsvKind) -> str:
    return ".csv" if isinstance(kind, CsvKind) else ".dat"


class DataFile:
    """A data file, read from its beginning.

    Parameters
    ----------
    path
        The file; its name determines its kind.
    on_fault
        Called with what could not be read; None: that raises.

    Attributes
    ----------
    position
        Bytes read so far.
    faulty
        Whether its end could not be read.
    ended
        Whether nothing more can be read.

    Raises
    ------
    RecordingError
        If the file cannot be read.
    """

    def __init__(self, path: Path, on_fault: FaultHandler | None) -> None:
        kind = kind_of(path.name)
        assert kind is not None, path
        self.path = path
        self.kind = kind
        self.position = 0
        self.faulty = False
        self.ended = False
        self._on_fault = on_fault
        try:
            self._stream: BinaryIO = path.open("rb")
            self._size = os.fstat(self._stream.fileno()).st_size
        except OSError as error:
            raise unreadable(path, error) from None

    def close(self) -> None:
        self._stream.close()

    def skip_user_header(self) -> None:
        """Leave out a user header of unknown length.

        Raises
        ------
        RecordingError
            If the file cannot be read.
        """
        try:
            start = self._stream.read(_LONGEST_USER_HEADER + 2 * _LARGEST_PLAUSIBLE_RECORD)
        except OSError as error:
            raise unreadable(self.path, error) from None
        self.skip(_user_header_bytes(start, self._size, self.kind))

    def skip(self, size: int) -> None:
        """Leave out a user header of ``size`` bytes."""
        self.position = min(self.position + size, self._size)
        self._stream.seek(self.position)

    def take(self, listed: int | None = None) -> tuple[Response | None, int | None] | None:
        """Next record.

        Parameters
        ----------
        listed
            Its size by the index; None if the index lists no more. A binary record that claims
            more than the file holds is given up and this much skipped.

        Returns
        -------
        None at the end, or when nothing more can be read, which is reported once. Else the
        message, None for a damaged record and the header line of a text file, and the record's
        own time [ns since 1970], None in binary files.
        """
        if self.ended:
            return None
        try:
            if isinstance(self.kind, Layout):
                record = self._binary(self.kind, listed)
                if record is None:
                    return None if self.ended else (None, None)
                return decode_response(self.kind.prefix + record), None
            return self._line(self.kind)
        except OSError as error:
            raise unreadable(self.path, error) from None

    def _binary(self, layout: Layout, listed: int | None) -> bytes | None:
        left = self._size - self.position
        header = self._stream.read(layout.header.itemsize)
        whole = len(header) == layout.header.itemsize
        size = layout.record_size(header) if whole else layout.header.itemsize
        if size > left:
            if listed is not None and layout.header.itemsize <= listed <= left:
                self._fault(f"a record is damaged: it claims {size} bytes, the index {listed}")
                self.skip(listed)
            else:
                self._cut(left)
            return None
        self.position += size
        return header + self._stream.read(size - len(header))

    def _line(self, kind: CsvKind) -> tuple[Response | None, int | None] | None:
        left = self._size - self.position
        line = self._stream.readline(left)
        if not line.endswith(b"\n"):
            self._cut(left)
            return None
        if line.startswith(b"TimeStamp;"):
            if line.rstrip().decode("latin-1") != kind.header.rstrip():
                self._fault(f"its columns are not those known: {line.rstrip()!r}")
                self.ended = self.faulty = True
                return None
            self.position += len(line)
            return None, None
        try:
            found = kind.parse(line.decode("latin-1"))
        except (ValueError, OverflowError, LocalProtocolError) as error:
            self._fault(f"a line cannot be read: {error}")
            self.position += len(line)
            return None, None
        self.position += len(line)
        return found

    def _cut(self, left: int) -> None:
        self.ended = True
        if left:
            self.faulty = True
            self._fault(f"the last record is cut: {left} bytes of it are there")

    def _fault(self, reason: str) -> None:
        fault = RecordingFault(file=self.path.name, offset=self.position, reason=reason)
        report(fault, self._on_fault)


def _user_header_bytes(start: bytes, size: int, kind: Layout | CsvKind) -> int:
    """Length of what precedes the first record, as far as the records themselves show.

    ``start`` is the beginning of the file of ``size`` bytes. 0 where records begin at once, and
    where no place is better.
    """
    if isinstance(kind, CsvKind):
        return max(start.find(kind.header.encode()), 0)
    places = range(min(len(start), _LONGEST_USER_HEADER))
    return next((at for at in places if _records_follow(start, at, size, kind)), 0)


def _records_follow(start: bytes, position: int, size: int, layout: Layout) -> bool:
    """Whether plausible records stand from ``position`` on: two of them, or one and the end."""
    for _ in range(2):
        header = start[position : position + layout.header.itemsize]
        if len(header) < layout.header.itemsize:
            return False
        record = layout.record_size(header)
        if record == layout.header.itemsize or record > _LARGEST_PLAUSIBLE_RECORD:
            return False
        if layout.count == "length" and int.from_bytes(header[:4], "little") > _LAST_CONTENT_ID:
            return False
        position += record
        if position == size:
            return True
    return True


_DIRECTORY_PREFIX = "xethru_recording_"


def read_vendor(path: Path, on_fault: FaultHandler | None) -> TimedMessages:
    """Messages of a recording directory, of its meta file or of one data file, with times.

    In the order in which they were recorded; without a usable index, file by file. A directory
    that holds only directories of one session (a recording split by directory) is read as one.

    Raises
    ------
    RecordingError
        If there is nothing to read, or messages are lost and ``on_fault`` is None.
    """
    whole = path.is_dir() or path.name == META_NAME
    for directory, files in _parts(path):
        yield from _Part(directory, files, on_fault, whole=whole).messages()


def vendor_facts(path: Path) -> RecordingFacts:
    """Return the facts about a recording; almost none without a meta file.

    Raises
    ------
    RecordingError
        If there is no recording.
    """
    (directory, _), *rest = _parts(path)
    try:
        meta = _read_meta(directory)
    except RecordingError:
        meta = None
    parameters = directory / PARAMETER_FILE_NAME
    try:
        parameter_file = parameters.read_bytes() if parameters.is_file() else None
    except OSError as error:
        raise unreadable(parameters, error) from None
    if meta is None:
        return RecordingFacts(parameter_file=parameter_file)
    stops = meta.entries.stops_ms()
    at_once = not rest and meta.complete
    return RecordingFacts(
        session_id=meta.head.session_id.decode("utf-8", "replace"),
        profile_id=meta.head.profile_id or None,
        parameter_file=parameter_file,
        user_header=_user_header(directory, meta),
        stopped_ns=_time_ns(meta, max(stops)) if stops and at_once else None,
        closed_ns=_time_ns(meta, meta.head.duration_ms) if at_once else None,
    )


def is_vendor_file(path: Path) -> bool:
    return path.name == META_NAME or kind_of(path.name) is not None


def _time_ns(meta: Meta, since_start_ms: int) -> int:
    return (meta.head.start_ms + since_start_ms) * MS_NS


def _user_header(directory: Path, meta: Meta) -> bytes:
    """Bytes before the first record of the first data file that has any."""
    for entry in meta.entries:
        if kind_of(entry.data_type ^ ALL_BITS) is None:
            continue
        if entry.file < len(meta.files):
            try:
                with (directory / Path(meta.files[entry.file]).name).open("rb") as stream:
                    stream.seek(entry.begin)
                    return stream.read(entry.size)
            except OSError:
                return b""
    return b""


def _parts(path: Path) -> list[tuple[Path, list[Path]]]:
    """Directories of a recording in order, each with the data files to read in it."""
    try:
        if not path.exists():
            raise RecordingError(f"there is no recording {path}")
        if not path.is_dir():
            files = [path] if kind_of(path.name) else _data_files(path.parent)
            parts = [(path.parent, files)]
        else:
            parts = [(path, _data_files(path))]
            if not parts[0][1]:
                parts = _split_directories(path)
    except OSError as error:
        raise unreadable(path, error) from None
    if not any(files for _, files in parts):
        wanted = "xethru_baseband_iq_*.dat, xethru_datafloat_*.dat or the like"
        raise RecordingError(f"{path} holds no recording this can read; it needs a file {wanted}")
    return parts


def _data_files(directory: Path) -> list[Path]:
    return sorted(path for path in directory.iterdir() if kind_of(path.name) and path.is_file())


def _split_directories(path: Path) -> list[tuple[Path, list[Path]]]:
    names = sorted(child for child in path.iterdir() if child.name.startswith(_DIRECTORY_PREFIX))
    parts = [(child, files) for child in names if child.is_dir() and (files := _data_files(child))]
    # Without a session id, two directories cannot be assigned to one radar.
    sessions = {_session(directory) or directory for directory, _ in parts}
    if len(sessions) > 1:
        raise RecordingError(
            f"{path} holds {len(parts)} recordings of {len(sessions)} sessions; name one of them"
        )
    return parts


def _session(directory: Path) -> bytes | None:
    """Session id of a directory; None without a usable meta file."""
    try:
        meta = _read_meta(directory)
    except RecordingError:
        return None
    return meta.head.session_id if meta else None


def _read_meta(directory: Path) -> Meta | None:
    """Meta file of a directory; None if there is none, RecordingError if it is unusable."""
    path = directory / META_NAME
    try:
        data = path.read_bytes() if path.is_file() else None
    except OSError as error:
        raise unreadable(path, error) from None
    if data is None:
        return None
    return parse_meta(data)


@dataclass(slots=True)
class _Reading:
    """A data file while it is read along the index."""

    file: DataFile
    times_hold: bool = True


class _Part:
    """One directory of a recording."""

    def __init__(
        self, directory: Path, files: list[Path], on_fault: FaultHandler | None, *, whole: bool
    ) -> None:
        self._directory = directory
        self._paths = files
        self._on_fault = on_fault
        self._whole = whole  # all files are read, not one of several
        self._meta: Meta | None = None

    def messages(self) -> TimedMessages:
        try:
            self._meta = _read_meta(self._directory)
            if self._meta is None and self._whole:
                self._report_meta("it is missing, so no message has a time")
        except RecordingError as error:
            self._report_meta(f"it is of no use, so no message has a time: {error}")
        readings = [_Reading(DataFile(path, self._on_fault)) for path in self._paths]
        try:
            if self._meta is not None:
                yield from self._along_index(self._meta, readings)
            for reading in readings:
                yield from self._rest(reading)
        finally:
            for reading in readings:
                reading.file.close()

    def _along_index(self, meta: Meta, readings: list[_Reading]) -> Iterator[Timed]:
        if not meta.complete and self._whole:
            self._report_meta("it was never completed: the recorder did not end as it should")
        reading_of = self._file_numbers(meta, readings)
        for entry in meta.entries:
            reading = reading_of(entry)
            if reading is None or entry.closed:
                continue
            if entry.data_type == reading.file.kind.data_type ^ ALL_BITS:
                reading.file.skip(entry.size)
                continue
            if reading.file.ended:
                continue
            begin = reading.file.position
            found = reading.file.take(entry.size if reading.times_hold else None)
            if found is None:
                if not reading.file.faulty and reading.times_hold:
                    self._disagree(reading, begin, "the index lists more records than it holds")
                continue
            size = reading.file.position - begin
            if size != entry.size and reading.times_hold:
                reason = f"the index gives this record {entry.size} bytes, it has {size}"
                self._disagree(reading, begin, reason)
            message, stamp_ns = found
            if message is not None:
                yield (
                    message,
                    _time_ns(meta, entry.since_start_ms) if reading.times_hold else stamp_ns,
                )

    def _rest(self, reading: _Reading) -> Iterator[Timed]:
        """Read what lies behind the index: recorded last, or with no index at all."""
        if reading.file.position == 0:  # no index gave the length of a user header
            reading.file.skip_user_header()
        while (found := reading.file.take()) is not None:
            message, stamp_ns = found
            if message is not None:
                yield message, stamp_ns

    def _file_numbers(
        self, meta: Meta, readings: list[_Reading]
    ) -> Callable[[Entry], _Reading | None]:
        """Return what finds the file of an entry: by the list of files, else by type and order."""
        by_name = {reading.file.path.name: reading for reading in readings}
        by_number: dict[tuple[int, int], _Reading | None] = {}
        unlisted = [path.name for path in _data_files(self._directory)]

        def find(entry: Entry) -> _Reading | None:
            kind = kind_of(entry.data_type) or kind_of(entry.data_type ^ ALL_BITS)
            key = (kind.data_type if kind else entry.data_type, entry.file)
            if key not in by_number:
                if entry.file < len(meta.files):
                    name = Path(meta.files[entry.file]).name
                    by_number[key] = by_name.get(name)
                elif kind is not None:
                    numbered = sum(data_type == kind.data_type for data_type, _ in by_number)
                    names = [name for name in unlisted if kind_of(name) is kind]
                    name = f"{kind.file_prefix}*"
                    if numbered < len(names):
                        name = names[numbered]
                    by_number[key] = by_name.get(name)
                else:
                    name = f"of data type {entry.data_type}"
                    by_number[key] = None
                if by_number[key] is None and self._whole:
                    self._report_missing(name, known=kind is not None)
            return by_number[key]

        return find

    def _report_missing(self, name: str, *, known: bool) -> None:
        reason = "the index lists it, and it is missing"
        if not known:
            reason = "the index lists it, and its layout is not known"
        report(RecordingFault(file=name, offset=0, reason=reason), self._on_fault)

    def _report_meta(self, reason: str) -> None:
        fault = RecordingFault(file=META_NAME, offset=0, reason=reason, minor=True)
        report(fault, self._on_fault)

    def _disagree(self, reading: _Reading, offset: int, reason: str) -> None:
        reading.times_hold = False
        name = reading.file.path.name
        fault = RecordingFault(file=name, offset=offset, reason=reason, minor=True)
        report(fault, self._on_fault)

"""Reads recording directories of the vendor's ModuleConnector: what was received, and when.

The data files alone give every message; the index of the meta file adds the times and the order
among several files. An error in the index costs times, never messages.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from xethru_protocol.recordings.records import (
    MS_NS,
    FaultHandler,
    RecordingError,
    RecordingFacts,
    RecordingFault,
    Timed,
    TimedMessages,
    reading,
    report,
)
from xethru_protocol.recordings.vendor.layouts import (
    ALL_BITS,
    CLOSED,
    ENTRY,
    KIND_OF_TYPE,
    META_NAME,
    PARAMETER_FILE_NAME,
    BinaryKind,
    Entry,
    Kind,
    Meta,
    TextKind,
    kind_of_file,
    parse_meta,
)
from xethru_protocol.validation import shown
from xethru_protocol.wire.codec import decode_response
from xethru_protocol.wire.errors import LocalProtocolError
from xethru_protocol.wire.rows import Response

_LONGEST_USER_HEADER = 4096  # bytes; searched where no index gives its length
_LARGEST_PLAUSIBLE_RECORD = 1 << 16
_LAST_CONTENT_ID = 14  # Protocol reference 6.1
_DIRECTORY_PREFIX = "xethru_recording_"
_STAMP = re.compile(rb"\d{4}-\d\d-\d\dT")


class _DataFile:
    """A data file, read from its beginning."""

    def __init__(self, path: Path, kind: Kind, on_fault: FaultHandler | None) -> None:
        self.path = path
        self.kind = kind
        self.position = 0  # bytes read so far
        self.faulty = False  # its end could not be read
        self.ended = False  # nothing more can be read
        self.times_hold = True  # the index has agreed with the file so far
        self._on_fault = on_fault
        with reading(path):
            self._stream: BinaryIO = path.open("rb")
            self._size = os.fstat(self._stream.fileno()).st_size

    def close(self) -> None:
        self._stream.close()

    def skip_user_header(self) -> None:
        """Skip a user header whose length no index gives."""
        with reading(self.path):
            start = self._stream.read(_LONGEST_USER_HEADER + 2 * _LARGEST_PLAUSIBLE_RECORD)
        self.skip(_user_header_bytes(start, self._size, self.kind))

    def skip(self, size: int) -> None:
        self.position = min(self.position + size, self._size)
        self._stream.seek(self.position)

    def take(self, listed: int | None = None) -> tuple[Response | None, int | None] | None:
        """Read the next record, of ``listed`` bytes by the index; None if that lists no more.

        A binary record that claims more than the file holds is given up and ``listed`` skipped.

        Returns
        -------
        None at the end, or when nothing more can be read, which is reported once. Else the
        message, None for a damaged record and the header line of a text file, and the record's
        own time [ns since 1970], None in binary files.
        """
        if self.ended:
            return None
        try:
            if isinstance(self.kind, TextKind):
                return self._line(self.kind)
            return self._record(self.kind, listed)
        except OSError as error:  # `reading` would cost a tenth of the time of a line
            raise RecordingError(f"{self.path} cannot be read: {error.strerror or error}") from None

    def _record(
        self, kind: BinaryKind, listed: int | None
    ) -> tuple[Response | None, int | None] | None:
        left = self._size - self.position
        smallest = kind.header.itemsize
        header = self._stream.read(smallest)
        size = kind.record_size(header) if len(header) == smallest else smallest
        if size <= left:
            self.position += size
            record = header + self._stream.read(size - len(header))
            return decode_response(kind.prefix + record), None
        if listed is None or not smallest <= listed <= left:
            self._cut(left)
            return None
        self.report(f"a record is damaged: it claims {size} bytes, the index {listed}")
        self.skip(listed)
        return None, None

    def _line(self, kind: TextKind) -> tuple[Response | None, int | None] | None:
        left = self._size - self.position
        line = self._stream.readline(left)
        if kind.is_free_text:
            line += self._continued()
        if not line.endswith(b"\n"):
            self._cut(left)
            return None
        found: tuple[Response | None, int | None] = None, None
        if line.startswith(b"TimeStamp;"):
            if line.rstrip() != kind.titles.rstrip():
                columns = line.rstrip().decode("latin-1")
                self.report(f"its columns are not the known ones: {shown(columns)}")
                self.ended = self.faulty = True
                return None
        else:
            try:
                found = kind.parse(line.decode("latin-1"))
            except (ValueError, OverflowError, LocalProtocolError) as error:
                self.report(f"a line cannot be read: {error}")
        self.position += len(line)
        return found

    def _continued(self) -> bytes:
        """Read the lines without a time stamp that follow: the text of the record has them."""
        begin = end = self._stream.tell()
        while (line := self._stream.readline()) and not _STAMP.match(line):
            end += len(line)
        self._stream.seek(begin)
        return self._stream.read(end - begin)

    def _cut(self, left: int) -> None:
        self.ended = True
        if left:
            self.faulty = True
            self.report(f"the last record is cut: {left} bytes of it are there")

    def disagree(self, offset: int, reason: str) -> None:
        """Report that the index and the file differ; the file's times are unknown from here on."""
        self.times_hold = False
        self.report(reason, offset, minor=True)

    def report(self, reason: str, offset: int | None = None, *, minor: bool = False) -> None:
        at = self.position if offset is None else offset
        fault = RecordingFault(file=self.path.name, offset=at, reason=reason, minor=minor)
        report(fault, self._on_fault)


def _user_header_bytes(start: bytes, size: int, kind: Kind) -> int:
    """Return the length of what precedes the first record, as far as the records show it.

    ``start`` is the beginning of the file of ``size`` bytes. 0 where records begin at once, and
    where no place is better.
    """
    if isinstance(kind, TextKind):
        return max(start.find(kind.titles), 0)
    places = range(min(len(start), _LONGEST_USER_HEADER))
    return next((at for at in places if _records_follow(start, at, size, kind)), 0)


def _records_follow(start: bytes, position: int, size: int, kind: BinaryKind) -> bool:
    """Whether plausible records stand from ``position`` on: two of them, or one and the end."""
    for _ in range(2):
        header = start[position : position + kind.header.itemsize]
        if len(header) < kind.header.itemsize:
            return False
        record = kind.record_size(header)
        if record == kind.header.itemsize or record > _LARGEST_PLAUSIBLE_RECORD:
            return False
        if kind.count == "length" and int.from_bytes(header[:4], "little") > _LAST_CONTENT_ID:
            return False
        position += record
        if position == size:
            return True
    return True


def read_vendor(path: Path, on_fault: FaultHandler | None) -> TimedMessages:
    """Messages of a recording directory, of its meta file or of one data file, with times.

    In the order in which they were recorded; without a usable index, file by file. A directory
    that holds only directories of one session (a recording split by directory) is read as one; a
    meta file is read with those that follow it.
    """
    whole = path.is_dir() or path.name == META_NAME  # else one of several files is read
    meta: Meta | None = None
    for directory, kinds in parts_of(path):
        meta = None
        try:
            meta = read_meta(directory)
            if meta is None and whole:
                _report_meta("it is missing, so no message has a time", on_fault)
        except RecordingError as error:
            _report_meta(f"it is of no use, so no message has a time: {error}", on_fault)
        if meta is not None and not meta.complete and whole:
            reason = "it was never completed: the recorder did not end as it should"
            _report_meta(reason, on_fault)
        files = [_DataFile(file, kind, on_fault) for file, kind in kinds.items()]
        try:
            if meta is not None:
                file_of = _files_by_entry(directory, meta, files, on_fault, whole=whole)
                yield from _along_index(meta, file_of)
            for file in files:
                yield from _rest(file)
        finally:
            for file in files:
                file.close()
    if meta is not None and meta.next_name and path.name == META_NAME:
        fault = f"the recording goes on in {meta.next_name}, which is missing"
        report(RecordingFault(file=META_NAME, offset=0, reason=fault), on_fault)


def _report_meta(reason: str, on_fault: FaultHandler | None) -> None:
    report(RecordingFault(file=META_NAME, offset=0, reason=reason, minor=True), on_fault)


def _along_index(meta: Meta, file_of: Callable[[Entry], _DataFile | None]) -> Iterator[Timed]:
    for entry in meta.entries():
        file = file_of(entry)
        if file is None or entry.kind == CLOSED:
            continue
        if entry.data_type == file.kind.data_type ^ ALL_BITS:
            file.skip(entry.size)
            continue
        if file.ended:
            continue
        begin = file.position
        found = file.take(entry.size if file.times_hold else None)
        if found is None:
            if not file.faulty and file.times_hold:
                file.disagree(begin, "the index lists more records than it holds")
            continue
        size = file.position - begin
        if size != entry.size and file.times_hold:
            reason = f"the index gives this record {entry.size} bytes, it has {size}"
            file.disagree(begin, reason)
        message, stamp_ns = found
        if message is not None:
            yield message, _time_ns(meta, entry.since_start_ms) if file.times_hold else stamp_ns


def _rest(file: _DataFile) -> Iterator[Timed]:
    """Read what the index does not list: recorded last, or all of it where there is no index."""
    if file.position == 0:
        file.skip_user_header()
    while (found := file.take()) is not None:
        message, stamp_ns = found
        if message is not None:
            yield message, stamp_ns


def _files_by_entry(
    directory: Path,
    meta: Meta,
    files: list[_DataFile],
    on_fault: FaultHandler | None,
    *,
    whole: bool,
) -> Callable[[Entry], _DataFile | None]:
    """Return a function from an entry to its file: by the list of files, else by type and order.

    Where the ``whole`` recording is read, a file that is listed and not there is reported once.
    """
    by_path = {file.path: file for file in files}
    found: dict[tuple[int, int], _DataFile | None] = {}
    known = files_by_number(directory, meta)

    def file_of(entry: Entry) -> _DataFile | None:
        kind = _kind_of_entry(entry)
        key = (kind.data_type if kind else entry.data_type, entry.file)
        if key in found:
            return found[key]
        path = known[key][0] if key in known else _listed_path(directory, meta, key)
        found[key] = by_path.get(path)
        if found[key] is None and whole:
            problem = "it is missing" if kind is not None else "its layout is not known"
            reason = f"the index lists it, and {problem}"
            report(RecordingFault(file=path.name, offset=0, reason=reason), on_fault)
        return found[key]

    return file_of


def files_by_number(directory: Path, meta: Meta) -> dict[tuple[int, int], tuple[Path, Kind]]:
    """Return the data files of an index by data type and number.

    Where the list of files is missing, those of a type in their order.
    """
    entries = np.frombuffer(meta.index, ENTRY)
    on_disk = data_files(directory)
    found: dict[tuple[int, int], tuple[Path, Kind]] = {}
    for bit in map(int, np.unique(entries["data_type"])):
        kind = KIND_OF_TYPE.get(bit)
        if kind is None:
            continue
        same = [path for path, other in on_disk.items() if other is kind]
        numbers = map(int, np.unique(entries["file"][entries["data_type"] == bit]))
        for at, number in enumerate(numbers):
            path = _listed_path(directory, meta, (bit, number))
            if number >= len(meta.files) and at < len(same):
                path = same[at]
            found[bit, number] = path, kind
    return found


def _listed_path(directory: Path, meta: Meta, key: tuple[int, int]) -> Path:
    """Return the path of a file by the list of files; without one, a name for reports."""
    data_type, number = key
    if number < len(meta.files):
        return directory / Path(meta.files[number]).name
    kind = KIND_OF_TYPE.get(data_type)
    return directory / (f"{kind.file_prefix}*" if kind else f"of data type {data_type}")


def _kind_of_entry(entry: Entry) -> Kind | None:
    return KIND_OF_TYPE.get(entry.data_type) or KIND_OF_TYPE.get(entry.data_type ^ ALL_BITS)


def vendor_facts(path: Path) -> RecordingFacts:
    (directory, _), *rest = parts_of(path)
    meta = _usable_meta(directory)
    last = _usable_meta(rest[-1][0]) if rest else meta
    parameters = directory / PARAMETER_FILE_NAME
    with reading(parameters):
        parameter_file = parameters.read_bytes() if parameters.is_file() else None
    if meta is None:
        return RecordingFacts(parameter_file=parameter_file)
    ended = last if last is not None and last.complete else None
    entries = ended.entries() if ended else ()
    stops = [entry.since_start_ms for entry in entries if entry.kind == CLOSED]
    return RecordingFacts(
        session_id=meta.session_id.decode("utf-8", "replace"),
        profile_id=meta.profile_id or None,
        parameter_file=parameter_file,
        user_header=_user_header(directory, meta),
        stopped_ns=_time_ns(ended, max(stops)) if ended and stops else None,
        closed_ns=_time_ns(ended, ended.duration_ms) if ended else None,
    )


def is_vendor_file(path: Path) -> bool:
    return path.name == META_NAME or kind_of_file(path.name) is not None


def _time_ns(meta: Meta, since_start_ms: int) -> int:
    return (meta.start_ms + since_start_ms) * MS_NS


def _user_header(directory: Path, meta: Meta) -> bytes:
    """Return the bytes before the first record of the first data file that has any."""
    for entry in meta.entries():
        if entry.data_type ^ ALL_BITS in KIND_OF_TYPE and entry.file < len(meta.files):
            try:
                with (directory / Path(meta.files[entry.file]).name).open("rb") as stream:
                    stream.seek(entry.begin)
                    return stream.read(entry.size)
            except OSError:
                return b""
    return b""


_Part = tuple[Path, dict[Path, Kind]]
"""A directory, and the data files to read in it."""


def parts_of(path: Path) -> list[_Part]:
    """Return the directories of a recording in order."""
    with reading(path):
        if not path.exists():
            raise RecordingError(f"there is no recording {path}")
        kind = kind_of_file(path.name)
        if path.is_dir():
            parts = [(path, data_files(path))]
            if not parts[0][1]:
                parts = _split_directories(path)
        elif kind is not None:
            parts = [(path.parent, {path: kind})]
        else:
            parts = [(directory, data_files(directory)) for directory in _chain(path.parent)]
    if not any(files for _, files in parts):
        wanted = "xethru_baseband_iq_*.dat, xethru_datafloat_*.dat or the like"
        raise RecordingError(f"{path} holds no recording this can read; it needs a file {wanted}")
    return parts


def data_files(directory: Path) -> dict[Path, Kind]:
    """Return the data files of a directory: by their names, others by the index."""
    found = {
        path: kind for path in directory.iterdir() if (kind := kind_of_file(path.name)) is not None
    }
    meta = _usable_meta(directory)
    if meta is not None:
        listed = [directory / Path(name).name for name in meta.files]
        others = {at: path for at, path in enumerate(listed) if path not in found}
        for entry in meta.entries() if others else ():
            if (kind := _kind_of_entry(entry)) is not None and entry.file in others:
                found[others.pop(entry.file)] = kind
    return {path: found[path] for path in sorted(found) if path.is_file()}


def _chain(directory: Path) -> list[Path]:
    """Return a directory and those in which its recording goes on, by their meta files."""
    found = [directory]
    while (following := _next_directory(found[-1])) is not None and following not in found:
        found.append(following)
    return found


def _next_directory(directory: Path) -> Path | None:
    meta = _usable_meta(directory)
    match meta.next_name.replace("\\", "/").split("/") if meta is not None else ():
        case ["..", name, str(file)] if name not in {"", ".."} and file == META_NAME:
            following = directory.resolve().parent / name
            return following if following.is_dir() else None
    return None


def _split_directories(path: Path) -> list[_Part]:
    """Return the directories of recordings in a directory, and in directories of theirs."""
    parts: list[_Part] = []
    names = (child for child in path.iterdir() if child.name.startswith(_DIRECTORY_PREFIX))
    for child in sorted(filter(Path.is_dir, names), key=_by_number):
        files = data_files(child)
        inner = sorted(child.glob(f"{_DIRECTORY_PREFIX}*/"), key=_by_number) if not files else ()
        parts += [(child, files)] if files else [(part, data_files(part)) for part in inner]
    parts = [(directory, files) for directory, files in parts if files]
    # Without a session id, two directories cannot be assigned to one radar.
    metas = ((directory, _usable_meta(directory)) for directory, _ in parts)
    sessions = {(meta.session_id if meta else b"") or directory for directory, meta in metas}
    if len(sessions) > 1:
        raise RecordingError(
            f"{path} holds {len(parts)} recordings of {len(sessions)} sessions; name one of them"
        )
    return parts


def _by_number(path: Path) -> list[str | int]:
    """Sort key of names that end in numbers: 2 comes before 10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.name)]


def _usable_meta(directory: Path) -> Meta | None:
    try:
        return read_meta(directory)
    except RecordingError:
        return None


def read_meta(directory: Path) -> Meta | None:
    """Return the meta file of a directory; None if there is none, RecordingError if unusable."""
    path = directory / META_NAME
    with reading(path):
        return parse_meta(path.read_bytes()) if path.is_file() else None

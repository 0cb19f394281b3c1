"""Reads recordings of the vendor's ModuleConnector: all that was received, or single records.

`read_vendor` gives every message: the data files alone are enough for that, and the index of the
meta file adds the times and the order among several files. An error in the index costs times, never
messages.

`RecordingReader` reads by the index, at any place: seek, peek, filter. That is what the vendor's
DataReader can do, with two differences. That one cannot seek into the last record of a meta file;
this one can. Of a recording split into directories that one adds the durations up, so that
positions leave out the time between them; here a position is the time since the start.
"""

from __future__ import annotations

import heapq
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, BinaryIO, Self

import numpy as np
import numpy.typing as npt

from xethru_protocol.recordings.clock import counter_of, steady, steady_times
from xethru_protocol.recordings.recorded_messages import (
    MS_NS,
    FaultHandler,
    RecordingError,
    RecordingFacts,
    RecordingFault,
    Timed,
    TimedMessages,
    format_by_magic,
    is_like,
    reading,
    report,
)
from xethru_protocol.recordings.vendor.layouts import (
    ABOUT_NAME,
    ALL_BITS,
    CLOSED,
    ENTRY,
    KIND_OF_MESSAGE,
    KIND_OF_TYPE,
    META_NAME,
    PARAMETER_FILE_NAME,
    VERSION,
    WRITING_SUFFIX,
    BinaryKind,
    DataFileKind,
    Entry,
    Meta,
    TextKind,
    id_in_names,
    kind_of_file,
    parse_meta,
)
from xethru_protocol.validation import shown
from xethru_protocol.wire.codec import decode_response
from xethru_protocol.wire.errors import LocalProtocolError
from xethru_protocol.wire.messages import BasebandAp, BasebandIq
from xethru_protocol.wire.table import Response

_LONGEST_USER_HEADER = 4096  # bytes; searched where no index gives its length
_LARGEST_PLAUSIBLE_RECORD = 1 << 16
_LAST_CONTENT_ID = 14  # Protocol reference 6.1
_FURTHEST = 1 << 48  # byte of a recording; sums of such numbers stay within 64 bits
_NUMBERED_DIRECTORY = re.compile(r"xethru_recording_[0-9]{8}_[0-9]{6}_(.+)_[0-9]+")
_MOST_NAMED = 4
_MOST_LOOKED_AT = 100  # files of a directory
_DIRECTORY_PREFIX = "xethru_recording_"
_STAMP = re.compile(rb"\d{4}-\d\d-\d\dT")


# --- directories and their files ----------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class _RecordingDirectory:
    """A directory of a recording.

    ``files`` are the data files to read in it; ``meta`` is None without a usable meta file, and
    ``problem`` says why.
    """

    directory: Path
    files: dict[Path, DataFileKind]
    meta: Meta | None
    problem: str

    def files_by_number(self) -> dict[tuple[int, int], Path]:
        """Return the data files of the index by data type and number.

        Where the list of files is missing, those of a type in their order.
        """
        meta = self.meta or Meta()
        entries = np.frombuffer(meta.index, ENTRY)
        on_disk = _data_files(self.directory, meta)
        found: dict[tuple[int, int], Path] = {}
        for bit in map(int, np.unique(entries["data_type"])):
            kind = KIND_OF_TYPE.get(bit)
            if kind is None:
                continue
            same = [path for path, other in on_disk.items() if other is kind]
            numbers = map(int, np.unique(entries["file"][entries["data_type"] == bit]))
            for at, number in enumerate(numbers):
                is_listed = number < len(meta.files) or at >= len(same)
                found[bit, number] = self.listed_path(bit, number) if is_listed else same[at]
        return found

    def listed_path(self, data_type: int, number: int) -> Path:
        """Return the path of a file by the list of files; without one, a name for reports."""
        listed = self.meta.files if self.meta is not None else ()
        if number < len(listed):
            return self.directory / Path(listed[number]).name
        kind = KIND_OF_TYPE.get(data_type)
        return self.directory / (f"{kind.file_prefix}*" if kind else f"of data type {data_type}")


def _part(directory: Path, files: dict[Path, DataFileKind] | None = None) -> _RecordingDirectory:
    """Return a directory with its meta file; ``files``: which are read, None for all."""
    meta, problem = None, "it is missing"
    path = directory / META_NAME
    try:
        with reading(path):
            if path.is_file():
                meta = parse_meta(path.read_bytes())
    except RecordingError as error:
        problem = f"it is of no use: {error}"
    if meta is None and (directory / META_NAME).with_suffix(WRITING_SUFFIX).exists():
        problem = f"it is missing, and files *{WRITING_SUFFIX} tell that the recorder was killed"
    found = _data_files(directory, meta) if files is None else files
    return _RecordingDirectory(directory=directory, files=found, meta=meta, problem=problem)


def data_files(directory: Path) -> dict[Path, DataFileKind]:
    """Return the data files of a directory: by their names, others by the index."""
    return _part(directory).files


def _data_files(directory: Path, meta: Meta | None) -> dict[Path, DataFileKind]:
    found = {
        path: kind for path in directory.iterdir() if (kind := kind_of_file(path.name)) is not None
    }
    if meta is not None:
        listed = [directory / Path(name).name for name in meta.files]
        others = {at: path for at, path in enumerate(listed) if path not in found}
        for entry in meta.entries() if others else ():
            if (kind := _kind_of_entry(entry)) is not None and entry.file in others:
                found[others.pop(entry.file)] = kind
    return {path: found[path] for path in sorted(found) if path.is_file()}


def _kind_of_entry(entry: Entry) -> DataFileKind | None:
    return KIND_OF_TYPE.get(entry.data_type) or KIND_OF_TYPE.get(entry.data_type ^ ALL_BITS)


def is_vendor_file(path: Path) -> bool:
    return path.name == META_NAME or kind_of_data_file(path) is not None


def kind_of_data_file(path: Path) -> DataFileKind | None:
    """Return what a data file holds by its name, else by its content; None if it holds nothing.

    RecordingError if its records may be of several kinds: only its name tells.
    """
    kind = kind_of_file(path.name)
    if kind is not None or path.name == META_NAME or not path.is_file():
        return kind
    with path.open("rb") as stream:
        start = stream.read(2 * _LARGEST_PLAUSIBLE_RECORD)
    if format_by_magic(start) is not None:  # what follows it may look like any records
        return None
    size = path.stat().st_size
    found = [
        kind
        for kind in KIND_OF_TYPE.values()
        if (
            start.startswith(kind.titles)
            if isinstance(kind, TextKind)
            else _records_follow(start, 0, size, kind)
        )
    ]
    if not found:
        return None
    if KIND_OF_MESSAGE[BasebandIq] in found:  # amplitude and phase have the same layout
        kind = KIND_OF_MESSAGE[BasebandIq]
        assert isinstance(kind, BinaryKind)
        first = decode_response(kind.prefix + start[: kind.record_size(start)])
        assert isinstance(first, BasebandIq)
        is_polar = (first.i >= 0).all() and (np.abs(first.q) <= np.float32(np.pi)).all()
        return KIND_OF_MESSAGE[BasebandAp] if is_polar else kind
    if len(found) > 1:
        names = " or ".join(kind.file_prefix for kind in found)
        raise RecordingError(
            f"{path} is of several kinds by its records; begin its name with {names}"
        )
    return found[0]


def _parts_of(path: Path) -> list[_RecordingDirectory]:
    """Return the directories of a recording in order."""
    with reading(path):
        if not path.exists():
            raise RecordingError(f"there is no recording {path}")
        kind = kind_of_data_file(path)
        if path.is_dir():
            parts = [_part(path)]
            if not parts[0].files:
                parts = _split_directories(path)
        elif kind is not None:
            parts = [_part(path.parent, {path: kind})]
        else:
            parts = _chain(path.parent)
    if not any(part.files for part in parts):
        wanted = "xethru_baseband_iq_*.dat, xethru_datafloat_*.dat or the like"
        others = sorted(path.iterdir())[:_MOST_LOOKED_AT] if path.is_dir() else []
        if renamed := next(filter(kind_of_data_file, others), None):
            wanted += f"; {renamed} is one by its content: files under other names are read singly"
        if held := [one.name for one in others if one.suffix in {".mcap", ".xtwire"}]:
            raise RecordingError(f"{path} holds {', '.join(held[:_MOST_NAMED])}; name one of them")
        raise RecordingError(f"{path} holds no recording this can read; it needs a file {wanted}")
    return parts


def _chain(directory: Path) -> list[_RecordingDirectory]:
    """Return a directory and those in which its recording goes on, by their meta files."""
    found = [_part(directory)]
    while (following := _next_directory(found[-1])) is not None:
        if following in {part.directory for part in found}:
            break
        found.append(_part(following))
    return found


def _next_directory(part: _RecordingDirectory) -> Path | None:
    match part.meta.next_name.replace("\\", "/").split("/") if part.meta is not None else ():
        case ["..", name, str(file)] if name not in {"", ".."} and file == META_NAME:
            following = part.directory.resolve().parent / name
            return following if following.is_dir() else None
    return None


def _split_directories(path: Path) -> list[_RecordingDirectory]:
    """Return the directories of recordings in a directory, and in directories of theirs."""
    parts: list[_RecordingDirectory] = []
    names = (child for child in path.iterdir() if child.name.startswith(_DIRECTORY_PREFIX))
    for child in sorted(filter(Path.is_dir, names), key=_by_number):
        part = _part(child)
        inner = sorted(child.glob(f"{_DIRECTORY_PREFIX}*/"), key=_by_number)
        parts += [part] if part.files else map(_part, inner)
    parts = [part for part in parts if part.files]
    known = {part.meta.session_id for part in parts if part.meta}
    ids = {id_in_names(one.decode(errors="replace")): one for one in known}
    # Without a session id, two directories cannot be assigned to one radar.
    sessions = {
        (part.meta.session_id if part.meta else ids.get(_id_in_name(part))) or part.directory
        for part in parts
    }
    if len(sessions) > 1:
        raise RecordingError(
            f"{path} holds {len(parts)} recordings of {len(sessions)} sessions; name one of them"
        )
    return parts


def _id_in_name(part: _RecordingDirectory) -> str:
    """Return the session id as the name of one of several directories has it, else the name."""
    found = _NUMBERED_DIRECTORY.fullmatch(part.directory.name)
    return part.directory.name if found is None else found[1]


def _by_number(path: Path) -> list[str | int]:
    """Sort key of names that end in numbers: 2 comes before 10."""
    return [int(part) if part.isdecimal() else part for part in re.split(r"(\d+)", path.name)]


# --- all messages -------------------------------------------------------------------------------


class _DataFileReader:
    """A data file, read from its beginning."""

    def __init__(self, path: Path, kind: DataFileKind, on_fault: FaultHandler | None) -> None:
        self.path = path
        self.kind = kind
        self.position = 0  # bytes read so far
        self.faulty = False  # its end could not be read
        self.ended = False  # nothing more can be read
        self._last_bytes = 0  # size of the last whole record
        self._agrees = True  # with the index so far
        self._before = 0  # where the last record began, or the last damaged one if that is behind
        self._on_fault = on_fault
        with reading(path):
            self._stream: BinaryIO = path.open("rb")
            self.size = os.fstat(self._stream.fileno()).st_size

    def close(self) -> None:
        self._stream.close()

    def skip_user_header(self) -> None:
        """Skip a user header whose length no index gives."""
        with reading(self.path):
            start = self._stream.read(_LONGEST_USER_HEADER + 2 * _LARGEST_PLAUSIBLE_RECORD)
        self.skip(_user_header_bytes(start, self.size, self.kind))

    def skip(self, size: int) -> None:
        self.position = min(self.position + size, self.size)
        self._stream.seek(self.position)

    def take(self, listed: int | None = None) -> tuple[Response | None, int | None] | None:
        """Read the next record, of ``listed`` bytes by the index; None if that does not tell.

        A binary record that claims another size than it has is given up: the next one begins
        behind ``listed`` bytes, or where records follow each other again.

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
        begin, left = self.position, self.size - self.position
        smallest = kind.header.itemsize
        header = self._stream.read(smallest)
        size = kind.record_size(header) if len(header) == smallest else smallest
        # after a loss of power; a record without elements is one where the index has it
        if size == smallest != listed and (
            self._data_end <= begin or self._data_end < begin + smallest < self.size
        ):
            self._cut(left)
            return None
        following: int | None = None
        before, self._before = self._before, max(self._before, begin)
        if listed not in (None, size) and not self._is_record_at(begin + size, kind):
            following = begin + listed if self._is_record_at(begin + listed, kind) else None
        if size > left and following is None:
            # one as large as the last, or without a whole header, is not damaged but cut
            is_cut = size == self._last_bytes or left < smallest
            if not is_cut and (listed is None or begin + listed <= self.size):
                following = self._next_records(before + 1, begin, kind)
            if following is None:
                self._cut(left)
                return None
        if following is None:
            self._stream.seek(begin + smallest)
            self.position, self._last_bytes = begin + size, size
            record = header + self._stream.read(size - len(header))
            return decode_response(kind.prefix + record), None
        self.report(f"a record is damaged: it claims {size} bytes", min(begin, following - 1))
        self.skip(following - begin)
        return None, None

    @cached_property
    def _data_end(self) -> int:
        """From where on the file holds nothing but zeros."""
        end = self.size
        while end:
            begin = max(end - _LARGEST_PLAUSIBLE_RECORD, 0)
            self._stream.seek(begin)
            if data := self._stream.read(end - begin).rstrip(b"\0"):
                return begin + len(data)
            end = begin
        return 0

    def _is_record_at(self, at: int, kind: BinaryKind) -> bool:
        """Whether a plausible record stands at a place, or the file ends there."""
        self._stream.seek(at)
        header = self._stream.read(kind.header.itemsize)
        return at == self.size or _record_end(header, 0, self.size - at, kind) is not None

    def _next_records(self, first: int, damaged: int, kind: BinaryKind) -> int | None:
        """Return where plausible records go on: behind a damaged one, or already in the one before.

        For it may be the size of that one that is damaged. ``first`` is where the search begins.
        """
        self._stream.seek(first)
        start = self._stream.read(2 * _LARGEST_PLAUSIBLE_RECORD)
        size = self.size - first
        for place in range(len(start)):
            # one record before the end is found by chance too easily among values
            may_be_last = first + place > damaged
            if _records_follow(start, place, size, kind, may_be_last=may_be_last):
                return first + place
        return None

    def _line(self, kind: TextKind) -> tuple[Response | None, int | None] | None:
        left = self.size - self.position
        line = self._stream.readline(left)
        if kind.is_free_text:
            line += self._continued()
        if not line.endswith(b"\n"):
            self._cut(left)
            return None
        found: tuple[Response | None, int | None] = None, None
        if line.startswith(b"TimeStamp;"):
            columns, known = line.rstrip(), kind.titles.rstrip()
            if columns != known:
                reason = f"its columns are not the known ones: {shown(columns.decode('latin-1'))}"
                behind = columns[len(known) : len(known) + 1]  # the first line, if not its end
                is_damaged = is_like(columns[: len(known)], known) and behind != b";"
                self.report(reason, minor=is_damaged)
                if is_damaged:
                    self.position += len(line)
                    return found
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
        while (line := self._stream.readline().rstrip(b"\0")) and not _STAMP.match(line):
            end += len(line)
        self._stream.seek(begin)
        return self._stream.read(end - begin)

    def _cut(self, left: int) -> None:
        self.ended = True
        if left:
            self.faulty = True
            is_zero = self._data_end <= self.position
            cut = f"the last record is cut: {left} bytes of it are there"
            self.report(f"only zeros follow: {left} bytes" if is_zero else cut)

    def disagree(self, offset: int, reason: str) -> None:
        """Report the first place where the index and the file differ, which costs times."""
        if self._agrees:
            self._agrees = False
            self.report(reason, offset, minor=True)

    def report(self, reason: str, offset: int | None = None, *, minor: bool = False) -> None:
        at = self.position if offset is None else offset
        fault = RecordingFault(file=self.path.name, offset=at, reason=reason, minor=minor)
        report(fault, self._on_fault)


def _user_header_bytes(start: bytes, size: int, kind: DataFileKind) -> int:
    """Return the length of what precedes the first record, as far as the records show it.

    ``start`` is the beginning of the file of ``size`` bytes. 0 where records begin at once, and
    where no place is better.
    """
    if isinstance(kind, TextKind):
        return max(start.find(kind.titles), 0)
    places = range(min(len(start), _LONGEST_USER_HEADER))
    return next((at for at in places if _records_follow(start, at, size, kind)), 0)


def _records_follow(
    start: bytes, position: int, size: int, kind: BinaryKind, *, may_be_last: bool = True
) -> bool:
    """Whether plausible records stand from ``position`` on: two, or one if it may be the last."""
    header_bytes = kind.header.itemsize
    end = _record_end(start[position : position + header_bytes], position, size, kind)
    if end is None or end == size:
        return end is not None and may_be_last
    return _record_end(start[end : end + header_bytes], end, size, kind) is not None


def _record_end(header: bytes, position: int, size: int, kind: BinaryKind) -> int | None:
    """Return where a record ends; None if its header is cut or implausible."""
    if len(header) < kind.header.itemsize:
        return None
    record = kind.record_size(header)
    if not kind.header.itemsize < record <= min(_LARGEST_PLAUSIBLE_RECORD, size - position):
        return None
    if kind.count == "length" and int.from_bytes(header[:4], "little") > _LAST_CONTENT_ID:
        return None
    return position + record


def read_vendor(path: Path, on_fault: FaultHandler | None) -> TimedMessages:
    """Messages of a recording directory, of its meta file or of one data file, with times.

    In the order in which they were recorded; without a usable index, file by file. A directory
    that holds only directories of one session (a recording split by directory) is read as one; a
    meta file is read with those that follow it.
    """
    parts = _parts_of(path)
    if all(part.meta for part in parts):
        yield from steady(_messages(path, parts, on_fault), path.name, on_fault)
    else:  # file by file, so that times of the next begin before those of the last end
        yield from _messages(path, parts, on_fault)


def _messages(
    path: Path, parts: list[_RecordingDirectory], on_fault: FaultHandler | None
) -> TimedMessages:
    whole = path.is_dir() or path.name == META_NAME  # else one of several files is read
    meta: Meta | None = None
    for part in parts:
        meta = part.meta
        if meta is None and (whole or (part.directory / META_NAME).is_file()):
            _report_meta(f"{part.problem}; no message has a time", on_fault)
        if meta is not None and not meta.complete and whole:
            reason = "it was never completed: the recorder did not end as it should"
            _report_meta(reason, on_fault)
        files = [_DataFileReader(file, kind, on_fault) for file, kind in part.files.items()]
        try:
            if meta is not None:
                file_of = _files_by_entry(part, files, on_fault, whole=whole)
                yield from _along_index(meta, file_of)
                # lines have times of their own, which are those of the other files' lines, too
                yield from heapq.merge(*map(_rest, files), key=lambda timed: timed[1] or 0)
            else:
                for file in files:
                    yield from steady(_rest(file), file.path.name, on_fault)
        finally:
            for file in files:
                file.close()
    if meta is not None and meta.next_name and path.name == META_NAME:
        reason = f"the recording goes on in {meta.next_name}, which is missing"
        _report_meta(reason, on_fault, minor=False)


def _report_meta(reason: str, on_fault: FaultHandler | None, *, minor: bool = True) -> None:
    report(RecordingFault(file=META_NAME, offset=0, reason=reason, minor=minor), on_fault)


def _along_index(meta: Meta, file_of: Callable[[Entry], _DataFileReader | None]) -> Iterator[Timed]:
    for entry in meta.entries():
        file = file_of(entry)
        if file is None or entry.kind == CLOSED or not entry.size:
            continue
        if entry.data_type == file.kind.data_type ^ ALL_BITS:
            file.skip(entry.size)
            continue
        if entry.begin <= file.size:
            yield from _rest(file, entry.begin)
        if file.ended:
            continue
        begin = file.position
        if entry.begin != begin:
            file.disagree(begin, f"the index has a record at byte {entry.begin}, none begins there")
            continue
        found = file.take(entry.size)
        if found is None:
            if not file.faulty:
                file.disagree(begin, "the index lists more records than it holds")
            continue
        size = file.position - begin
        if size != entry.size:
            reason = f"the index gives this record {entry.size} bytes, it has {size}"
            file.disagree(begin, reason)
        message, _ = found
        if message is not None:
            yield message, _time_ns(meta, entry.since_start_ms)


def _rest(file: _DataFileReader, end: int | None = None) -> Iterator[Timed]:
    """Read what the index does not list, before a place: lost entries, those behind the last."""
    if file.position == 0 != end:
        file.skip_user_header()
    while (end is None or file.position < end) and (found := file.take()) is not None:
        message, stamp_ns = found
        if message is not None:
            yield message, stamp_ns


def _files_by_entry(
    part: _RecordingDirectory,
    files: list[_DataFileReader],
    on_fault: FaultHandler | None,
    *,
    whole: bool,
) -> Callable[[Entry], _DataFileReader | None]:
    """Return a function from an entry to its file: by the list of files, else by type and order.

    Where the ``whole`` recording is read, a file that is listed and not there is reported once.
    """
    by_path = {file.path: file for file in files}
    known = part.files_by_number()

    @cache
    def file_at(data_type: int, number: int) -> _DataFileReader | None:
        path = known.get((data_type, number)) or part.listed_path(data_type, number)
        if path not in by_path and whole:
            problem = "it is missing" if data_type in KIND_OF_TYPE else "its layout is not known"
            reason = f"the index lists it, and {problem}"
            report(RecordingFault(file=path.name, offset=0, reason=reason), on_fault)
        return by_path.get(path)

    def file_of(entry: Entry) -> _DataFileReader | None:
        kind = _kind_of_entry(entry)
        return file_at(kind.data_type if kind else entry.data_type, entry.file)

    return file_of


def vendor_facts(path: Path) -> RecordingFacts:
    parts = _parts_of(path)
    first, meta, last = parts[0], parts[0].meta, parts[-1].meta
    parameters = first.directory / PARAMETER_FILE_NAME
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
        user_header=_user_header(first.directory, meta),
        stopped_ns=_time_ns(ended, max(stops)) if ended and stops else None,
        closed_ns=_time_ns(ended, ended.duration_ms) if ended else None,
    )


def vendor_about(path: Path) -> Mapping[str, Any]:
    """Return what a recorder of ours stored of the module beside a recording; empty if nothing.

    Of a recording that is split into directories it lies in the one that holds them.
    """
    part = _parts_of(path)[0]
    session = None if part.meta is None else part.meta.session_id.decode("utf-8", "replace")
    for directory in (part.directory, part.directory.parent):
        try:
            table = json.loads((directory / ABOUT_NAME).read_bytes())
        except (OSError, ValueError, RecursionError):
            continue
        if isinstance(table, dict) and isinstance(about := table.get("radar"), dict):
            is_alone = session is None and directory == part.directory
            if is_alone or table.get("session_id") == session:
                return about
    return {}


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


# --- single records -----------------------------------------------------------------------------


@dataclass(frozen=True, slots=True, kw_only=True)
class Record:
    """A record: the message, when it came [ns since 1970], its bytes as stored.

    ``position`` is where it begins in the recording, counted over all files and headers.
    """

    message: Response
    t_ns: int
    data: bytes
    position: int


class RecordingReader:
    """Reads a recording of the vendor's format record by record; a context manager.

    As long as the files are there, records may be read in any order; iterating goes on where
    `read` or a seek left off. User headers and lines of titles are skipped. Times do not fall:
    where the recorder's clock was set back, the frame counter tells how much later they are.

    Parameters
    ----------
    path
        A directory, or a meta file, which is read with those that follow it. RecordingError if
        there is no usable meta file: `read_recording` does without.

    Attributes
    ----------
    start_ns, duration_ns
        When the recording begins [ns since 1970], and how long it was on.
    size_bytes, largest_record_bytes
        Of all records, headers included, and of the largest.
    session_id, profile_id, meta_version
        As stored; profile 0 is unknown.

    Examples
    --------
    ::

        with RecordingReader("rec") as reader:
            reader.set_filter(DataFloat)
            reader.seek_ms(60_000)
            for record in reader:
                print(record.t_ns, record.message.info)
    """

    meta_version = VERSION

    def __init__(self, path: Path | str) -> None:
        parts = _parts_of(Path(path))
        for part in parts:
            if part.meta is None:
                raise RecordingError(
                    f"{part.directory} has no {META_NAME} to read by, {part.problem}; "
                    "read_recording does without"
                )
        metas = [part.meta for part in parts if part.meta is not None]
        self._files = [part.files_by_number() for part in parts]
        first, last = metas[0], metas[-1]
        self.start_ns = first.start_ms * MS_NS
        self.session_id = first.session_id.decode("utf-8", "replace")
        self.profile_id = first.profile_id
        self._build_index([part.directory for part in parts], metas)
        self.duration_ns = (last.start_ms + last.duration_ms) * MS_NS - self.start_ns
        self._wanted: npt.NDArray[np.bool_] | None = None  # by record; None for all
        self._filter: frozenset[type[Response]] = frozenset()
        self._next = 0
        self._streams: dict[Path, BinaryIO] = {}
        self._exits = ExitStack()
        self._t_ns = steady_times(self._t_ms * MS_NS, self._counters())
        if not last.complete and len(self):  # its recorder was killed
            self.duration_ns = 0
        if len(self):
            self.duration_ns = max(self.duration_ns, int(self._t_ns[-1]) - self.start_ns)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files; calling it again does nothing."""
        self._exits.close()
        self._streams.clear()

    def __len__(self) -> int:
        """Return the number of records, those that the filter leaves out included."""
        return len(self._t_ms)

    def __iter__(self) -> Iterator[Record]:
        while not self.at_end:
            yield self.read()

    @property
    def kinds(self) -> frozenset[type[Response]]:
        """Types of the messages that the recording holds."""
        return frozenset(
            KIND_OF_TYPE[int(bit)].message for bit in np.unique(self._entries["data_type"])
        )

    @property
    def filter(self) -> frozenset[type[Response]]:
        """Types of the messages that are read; empty for all."""
        return self._filter

    def set_filter(self, *kinds: type[Response]) -> None:
        """Read only messages of these types from here on; none given: all.

        RecordingError for a type that no recording holds.
        """
        for kind in kinds:
            if kind not in KIND_OF_MESSAGE:
                raise RecordingError(f"a recording holds no {kind.__name__}")
        bits = [KIND_OF_MESSAGE[kind].data_type for kind in kinds]
        self._wanted = np.isin(self._entries["data_type"], bits) if kinds else None
        self._filter = frozenset(kinds)

    @property
    def at_end(self) -> bool:
        """Whether nothing more can be read."""
        return self._following() >= len(self)

    def peek(self) -> Record:
        """Return the next record and stay before it; RecordingError at the end or if damaged."""
        return self._record(self._following())

    def read(self) -> Record:
        """Return the next record and go behind it; RecordingError at the end or if damaged."""
        at = self._following()
        self._next = min(at + 1, len(self))
        return self._record(at)

    def seek_ms(self, position_ms: float) -> None:
        """Go to the first record at or after a time since the start.

        RecordingError before the start and beyond the duration.
        """
        if not 0 <= position_ms * MS_NS <= self.duration_ns:
            raise RecordingError(
                f"{position_ms:g} ms lies outside the recording, 0 ... "
                f"{self.duration_ns // MS_NS} ms"
            )
        self._next = int(np.searchsorted(self._t_ns, self.start_ns + round(position_ms * MS_NS)))

    def seek_byte(self, position: int) -> None:
        """Go to the record that holds a byte, or behind the header that does.

        RecordingError before the start and beyond the end.
        """
        if not 0 <= position <= self.size_bytes:
            raise RecordingError(
                f"byte {position} lies outside the recording, 0 ... {self.size_bytes}"
            )
        self._next = int(np.searchsorted(self._end, position, side="right"))

    def _following(self) -> int:
        """Return the number of the next record that the filter lets pass."""
        if self._wanted is None or self._next >= len(self):
            return self._next
        found = int(np.argmax(self._wanted[self._next :]))
        return self._next + found if self._wanted[self._next + found] else len(self)

    def _build_index(self, directories: list[Path], metas: list[Meta]) -> None:
        """Join the indexes of all meta files: records in order, without headers."""
        kept, t_ms, ends = [], [], []
        self.size_bytes = 0
        self.largest_record_bytes = 0
        for directory, meta in zip(directories, metas, strict=True):
            all_of = np.frombuffer(meta.index, ENTRY)
            records = all_of[(all_of["kind"] != CLOSED) & (all_of["size"] > 0)]
            if (np.maximum(records["begin"], records["end"]) > _FURTHEST).any():
                raise RecordingError(
                    f"the index of {directory} is damaged: it has a record beyond "
                    f"byte {_FURTHEST}; read_recording does without"
                )
            known = np.isin(records["data_type"], list(KIND_OF_TYPE)) & ~_are_titles(records)
            kept.append(records[known])
            t_ms.append(kept[-1]["ms"].astype(np.int64) + meta.start_ms)
            ends.append(kept[-1]["end"].astype(np.int64) + self.size_bytes)
            if len(records):
                self.size_bytes += int(records["end"].max())
                self.largest_record_bytes = max(
                    self.largest_record_bytes, int(records["size"].max())
                )
        self._entries = np.concatenate(kept)
        self._in_part = np.repeat(np.arange(len(kept)), [len(entries) for entries in kept])
        self._t_ms, self._end = np.concatenate(t_ms), np.concatenate(ends)

    def _counters(self) -> Iterator[tuple[str, int] | None]:
        for at in range(len(self)):
            try:
                message, _ = self._read(at)
            except RecordingError:  # which reading it will report
                yield None
            else:
                yield counter_of(message)

    def _record(self, at: int) -> Record:
        if at >= len(self):
            raise RecordingError("the recording is at its end; look at at_end before you read")
        message, data = self._read(at)
        return Record(
            message=message,
            t_ns=int(self._t_ns[at]),
            data=data,
            position=int(self._end[at]) - len(data),
        )

    def _read(self, at: int) -> tuple[Response, bytes]:
        entry = self._entries[at]
        size = int(entry["size"])
        bit = int(entry["data_type"])
        path = self._files[self._in_part[at]][bit, int(entry["file"])]
        with reading(path):
            stream = self._streams.get(path)
            if stream is None:
                stream = self._streams[path] = self._exits.enter_context(path.open("rb"))
            stream.seek(int(entry["begin"]))
            data = stream.read(size)
        return _message(path, KIND_OF_TYPE[bit], data, size), data


def _message(path: Path, kind: DataFileKind, data: bytes, size: int) -> Response:
    """Return the message of a record; RecordingError if it is not what the index says."""
    if len(data) < size:
        raise RecordingError(f"{path} is cut: a record of {size} bytes is not there whole")
    if isinstance(kind, TextKind):
        try:
            return kind.parse(data.decode("latin-1"))[0]
        except (ValueError, OverflowError, LocalProtocolError) as error:
            raise RecordingError(f"{path}: a line cannot be read: {error}") from None
    header = data[: kind.header.itemsize]
    if len(header) < kind.header.itemsize or kind.record_size(header) != size:
        raise RecordingError(f"{path}: a record is damaged: the index gives it {size} bytes")
    return decode_response(kind.prefix + data)


def _are_titles(records: npt.NDArray[np.void]) -> npt.NDArray[np.bool_]:
    """Tell lines of titles: the first records of text files, shape (len(records),)."""
    is_title = np.zeros(len(records), bool)
    for bit, kind in KIND_OF_TYPE.items():
        if isinstance(kind, TextKind):
            (rows,) = np.nonzero(records["data_type"] == bit)
            is_title[rows[np.unique(records["file"][rows], return_index=True)[1]]] = True
    return is_title

"""Reads recording directories of the vendor's ModuleConnector: what was received, and when.

The data files alone give every message (`vendor_files`); the index of the meta file adds the
times and the order among several files. What the index says wrong costs times, never messages.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from xethru_protocol.recordings.errors import (
    FaultHandler,
    RecordingError,
    RecordingFault,
    report,
    unreadable,
)
from xethru_protocol.recordings.records import MS_NS, RecordingFacts, Timed, TimedMessages
from xethru_protocol.recordings.vendor_files import DataFile, kind_of
from xethru_protocol.recordings.vendor_meta import (
    ALL_BITS,
    META_NAME,
    PARAMETER_FILE_NAME,
    Entry,
    Meta,
    parse_meta,
)

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
    """Return what a recording says about itself; next to nothing without a meta file.

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
    """Whether a file's name is one that ModuleConnector gives."""
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
    # Without a session id, nothing says that two directories are of one radar.
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
    """Meta file of a directory; None if there is none, RecordingError if it is of no use."""
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
        if reading.file.position == 0:  # no index told of a user header
            reading.file.skip_user_header()
        while (found := reading.file.take()) is not None:
            message, stamp_ns = found
            if message is not None:
                yield message, stamp_ns

    def _file_numbers(
        self, meta: Meta, readings: list[_Reading]
    ) -> Callable[[Entry], _Reading | None]:
        """Tell which open file an entry means: by the list of files, else by type and order."""
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

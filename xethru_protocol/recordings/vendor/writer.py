"""Writes recording directories as the vendor's ModuleConnector does, down to the meta index.

Every record and its index entry are handed to the operating system at once, the record first, so
a recorder that is unplugged, killed or out of disk leaves all it wrote: the data files are whole
up to the last record and the index up to the last entry. Only the totals in the head of the meta
file and its list of files are missing then; the reader does without them.
"""

import json
import re
import uuid
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import timedelta, tzinfo
from functools import partial
from pathlib import Path
from typing import Any, Self, TypedDict

from xethru_protocol.recordings.recorded_messages import (
    MODULE_METRES,
    MS_NS,
    GrowingFile,
    RecordingError,
    writing,
)
from xethru_protocol.recordings.vendor.layouts import (
    ABOUT_NAME,
    ALL_BITS,
    CLOSED,
    KIND_OF_MESSAGE,
    META_NAME,
    PARAMETER_FILE_NAME,
    RECORD,
    DataFileKind,
    Entry,
    Meta,
    closing_order,
    id_in_names,
    local_time,
)
from xethru_protocol.validation import shown
from xethru_protocol.wire.table import Response


@dataclass(frozen=True, slots=True, kw_only=True)
class Split:
    """When a data file, or a directory, ends and the next begins: at the first limit reached.

    ``records`` and ``bytes`` count what it holds, ``seconds`` since its first record;
    ``daily_hour``, 0 ... 23, is a time of day in the recorder's time zone. None: no limit.
    """

    records: int | None = None
    bytes: int | None = None
    seconds: float | None = None
    daily_hour: int | None = None

    def __post_init__(self) -> None:
        for limit in (self.records, self.bytes, self.seconds):
            if limit is not None and not limit > 0:
                raise RecordingError(f"a limit of a data file must be positive, not {limit}")
        if self.daily_hour is not None and self.daily_hour not in range(24):
            raise RecordingError(f"the hour of a day must be 0 ... 23, not {self.daily_hour}")

    def is_full(self, records: int, size: int) -> bool:
        """Whether so many records of ``size`` bytes in all are enough."""
        return (self.records is not None and records >= self.records) or (
            self.bytes is not None and size >= self.bytes
        )

    def is_over(self, first_ms: int, time_ms: int, zone: tzinfo | None) -> bool:
        """Whether what began at one time has ended before another [ms since 1970]."""
        if self.seconds is not None and time_ms - first_ms >= 1000 * self.seconds:
            return True
        if self.daily_hour is None:
            return False
        began = local_time(first_ms, zone)
        end = began.replace(hour=self.daily_hour, minute=0, second=0, microsecond=0)
        if end <= began:
            end += timedelta(days=1)
        if zone is None:  # its offset may be another by then
            end = end.replace(tzinfo=None).astimezone()
        return local_time(time_ms, zone) >= end


FileListener = Callable[[type[Response], Path], None]
MetaFileListener = Callable[[str, Path], None]


class WriterOptions(TypedDict, total=False):
    """The parameters of `RecordingWriter` but the directory."""

    session_id: str | None
    profile_id: int | None
    parameter_file: bytes | str | None
    user_header: bytes
    split: Split | None
    split_directories: Split | None
    basenames: Mapping[type[Response], str] | None
    interval_s: float | None
    flush_on_write: bool
    timezone: tzinfo | None
    on_file: FileListener | None
    on_meta_file: MetaFileListener | None


class _DataFileWriter(GrowingFile):
    """One data file being written; ``number`` is its place in the list of files."""

    def __init__(
        self, path: Path, kind: DataFileKind, number: int, first_ms: int, *, flush: bool
    ) -> None:
        super().__init__(path, flush=flush)
        self.kind = kind
        self.number = number
        self.first_ms = first_ms
        self.records = 0


@dataclass(slots=True)
class _OpenDirectory:
    """One directory being written; all of its recording unless that is split into directories."""

    directory: Path
    meta: Meta
    user_header: bytes
    split: Split
    basenames: Mapping[type[Response], str]
    flush_on_write: bool
    timezone: tzinfo | None
    on_file: FileListener | None
    on_meta_file: MetaFileListener | None
    records: int = 0
    last_ms: int = 0  # of the last record, since the start
    meta_file: GrowingFile = field(init=False)
    files: dict[int, _DataFileWriter] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        self.meta_file = GrowingFile(self.directory / META_NAME, flush=self.flush_on_write)
        self.meta_file.append(self.meta.pack_head())

    def write(self, message: Response, kind: DataFileKind, time_ms: int) -> None:
        since_ms = self.since(time_ms)
        data = kind.record(message, self.meta.start_ms + since_ms, self.timezone)
        file = self.files.get(kind.data_type)
        if file is not None and self.split.is_over(file.first_ms, time_ms, self.timezone):
            self._close_file(file, since_ms)
            file = None
        if file is None:
            file = self._open_file(kind, since_ms)
            if self.user_header:
                self._append(file, self.user_header, kind.data_type ^ ALL_BITS, since_ms)
            if kind.titles:
                self._append(file, kind.titles, kind.data_type, since_ms)
        self._append(file, data, kind.data_type, since_ms)
        file.records += 1
        self.records += 1
        self.last_ms = max(self.last_ms, since_ms)
        if self.split.is_full(file.records, file.size):
            self._close_file(file, since_ms)

    def close(self, stopped_ms: int, closed_ms: int, next_name: str = "") -> None:
        """Write the totals; times are since the start, ``next_name`` is of the next meta file."""
        meta = self.meta
        meta.duration_ms = closed_ms
        meta.next_name = next_name
        try:
            for file in sorted(self.files.values(), key=lambda file: closing_order(file.kind)):
                self._close_file(file, stopped_ms)
            self.meta_file.append(meta.pack_files())
        finally:
            # The head's bytes exist already, so this works on a full disk, too.
            self.meta_file.finish(meta.pack_head())
        if self.on_meta_file is not None:
            self.on_meta_file(meta.session_id.decode(), self.meta_file.path)

    def since(self, time_ms: int) -> int:
        return min(max(time_ms - self.meta.start_ms, 0), ALL_BITS)

    def _open_file(self, kind: DataFileKind, since_ms: int) -> _DataFileWriter:
        time_ms = self.meta.start_ms + since_ms
        base = self.basenames.get(kind.message, kind.file_prefix.removesuffix("_"))
        stem = f"{base}_{local_time(time_ms, self.timezone):%Y%m%d_%H%M%S}"
        name = stem + kind.suffix
        again_ms = time_ms % 1000
        # Several files within one second; the vendor's recorder takes the time of their end.
        while name in self.meta.files:
            name = f"{stem}_{again_ms:03d}ms{kind.suffix}"
            again_ms += 1
        file = _DataFileWriter(
            self.directory / name,
            kind,
            len(self.meta.files),
            time_ms,
            flush=self.flush_on_write,
        )
        self.meta.files.append(name)
        self.files[kind.data_type] = file
        self.meta.data_types |= kind.data_type
        return file

    def _append(self, file: _DataFileWriter, data: bytes, data_type: int, since_ms: int) -> None:
        begin = file.size
        file.append(data)
        self.meta.size += len(data)
        self.meta.largest_record = max(self.meta.largest_record, len(data))
        end = self.meta.size
        self._index(Entry(since_ms, RECORD, data_type, len(data), file.number, begin, end))

    def _close_file(self, file: _DataFileWriter, since_ms: int) -> None:
        del self.files[file.kind.data_type]
        file.close()
        end = self.meta.size
        data_type = file.kind.data_type
        self._index(Entry(since_ms, CLOSED, data_type, 0, file.number, file.size, end))
        if self.on_file is not None:
            self.on_file(file.kind.message, file.path)

    def _index(self, entry: Entry) -> None:
        self.meta_file.append(entry.pack())
        self.meta.index_end = self.meta_file.size


class RecordingWriter:
    """Writes one recording; RecordingError if it cannot be made or there is one already.

    Parameters
    ----------
    directory
        Where; made if missing. Must hold no recording yet. The vendor's recorder takes one named
        as `session_directory` does.
    session_id
        The recorder's name for the session; None or empty: a random UUID, as the vendor's recorder
        gives. Its reader takes no recording without one.
    profile_id
        Profile that runs; None: written as 0.
    parameter_file
        Content of the module's parameter file, stored beside the data; None: none is stored.
    user_header
        Bytes to put before the records of each data file.
    split
        When to begin a new data file; None: never.
    split_directories
        When to begin a new directory; None: never. ``directory`` holds them then.
    basenames
        Beginnings of the names of data files, in place of the vendor's, by type of message.
    interval_s
        Messages of one type that come sooner after the one stored before are left out; None: all
        are stored.
    flush_on_write
        Have each record on the disk before the next one is written; slow.
    timezone
        Of the stamps in file names and text files; None: this machine's.
    on_file
        Called with type of message and path of each data file that is complete.
    on_meta_file
        Called with session id and path of each meta file that is complete.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from xethru_protocol.wire.messages import DataFloat
    >>> import numpy as np
    >>> from datetime import UTC
    >>> with TemporaryDirectory() as folder, RecordingWriter(folder, timezone=UTC) as writer:
    ...     _ = writer.write(DataFloat(info=1, values=np.zeros(3, np.float32)), 0)
    ...     sorted(path.name for path in Path(folder).iterdir())
    ['xethru_datafloat_19700101_000000.dat', 'xethru_recording_meta.dat']
    """

    def __init__(
        self,
        directory: Path | str,
        *,
        session_id: str | None = None,
        profile_id: int | None = None,
        parameter_file: bytes | str | None = None,
        user_header: bytes = b"",
        split: Split | None = None,
        split_directories: Split | None = None,
        basenames: Mapping[type[Response], str] | None = None,
        interval_s: float | None = None,
        flush_on_write: bool = False,
        timezone: tzinfo | None = None,
        on_file: FileListener | None = None,
        on_meta_file: MetaFileListener | None = None,
    ) -> None:
        self.directory = Path(directory)
        self.session_id = session_id or new_session_id()
        self._profile_id = profile_id or 0
        self._parameter_file = (
            parameter_file.encode() if isinstance(parameter_file, str) else parameter_file
        )
        self._split_directories = split_directories
        self._timezone = timezone
        self._open_directory = partial(
            _OpenDirectory,
            user_header=user_header,
            split=split or Split(),
            basenames=_checked_basenames(basenames or {}),
            flush_on_write=flush_on_write,
            timezone=timezone,
            on_file=on_file,
            on_meta_file=on_meta_file,
        )
        self._interval_ms = 0.0 if interval_s is None else 1000 * interval_s
        self._stored_ms: dict[int, int] = {}  # when the last message of each kind was stored
        self._part: _OpenDirectory | None = None
        self._parts = 0
        self._closed = False
        with writing(self.directory):
            self.directory.mkdir(parents=True, exist_ok=True)
            if _holds_recording(self.directory):
                raise RecordingError(
                    f"{self.directory} already holds a recording; name another directory"
                )
        if split_directories is None:
            self._store_parameter_file(self.directory)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        try:
            self.close()
        except RecordingError:
            if error is None:  # the first error is raised
                raise

    def write(self, message: Response, t_ns: int) -> bool:
        """Append a message of time ``t_ns`` [ns since 1970] and return whether it was stored.

        The format has no place for answers, system messages and the like. Times are stored with
        1 ms, never before the first message's. RecordingError if the disk is full or the directory
        went away; what was written before stays.
        """
        if self._closed:
            raise RecordingError(f"{self.directory}: the recording is closed")
        kind = KIND_OF_MESSAGE.get(type(message))
        if kind is None:
            return False
        time_ms = t_ns // MS_NS
        stored_ms = self._stored_ms.get(kind.data_type)
        if stored_ms is not None and 0 <= time_ms - stored_ms < self._interval_ms:
            return False
        self._part_at(time_ms).write(message, kind, time_ms)
        self._stored_ms[kind.data_type] = time_ms
        return True

    def describe(self, about: Mapping[str, Any]) -> None:
        """Store what is known of the module beside the recording, for `load`.

        ``about`` is by the names in the info of an MCAP file; lengths are module metres.
        RecordingError if the file cannot be written.
        """
        radar = {"length_unit": MODULE_METRES, **about}
        path = self.directory / ABOUT_NAME
        with writing(path):
            path.write_text(json.dumps({"session_id": self.session_id, "radar": radar}), "utf-8")

    def close(self, *, stopped_ns: int | None = None, closed_ns: int | None = None) -> None:
        """Write the totals and close all files; calling it again does nothing.

        ``stopped_ns`` and ``closed_ns`` are when the data files and when the recording ended [ns
        since 1970]; None: with the last message, and with ``stopped_ns``.
        """
        if self._closed:
            return
        self._closed = True
        part = self._part
        if part is None:
            return
        stopped_ms = part.last_ms if stopped_ns is None else part.since(stopped_ns // MS_NS)
        closed_ms = stopped_ms if closed_ns is None else part.since(closed_ns // MS_NS)
        part.close(stopped_ms, closed_ms)

    def _part_at(self, time_ms: int) -> _OpenDirectory:
        """Return the directory that takes the next record; a new one where the last is full."""
        part, split, zone = self._part, self._split_directories or Split(), self._timezone
        if part is not None and not (
            split.is_full(part.records, part.meta.size)
            or split.is_over(part.meta.start_ms, time_ms, zone)
        ):
            return part
        directory = self.directory
        if self._split_directories is not None:
            name = session_directory(directory, self.session_id, time_ms * MS_NS, zone).name
            directory = directory / f"{name}_{self._parts}"
            with writing(directory):
                directory.mkdir()
            self._store_parameter_file(directory)
        if part is not None:
            part.close(part.last_ms, part.last_ms, f"../{directory.name}/{META_NAME}")
        meta = Meta(
            session_id=self.session_id.encode(), profile_id=self._profile_id, start_ms=time_ms
        )
        self._parts += 1
        self._part = self._open_directory(directory, meta)
        return self._part

    def _store_parameter_file(self, directory: Path) -> None:
        if self._parameter_file is not None:
            with GrowingFile(directory / PARAMETER_FILE_NAME) as file:
                file.append(self._parameter_file)


def _holds_recording(directory: Path) -> bool:
    """Whether there are files of a recording, or directories of one that are not empty."""
    found = (path for path in directory.iterdir() if path.name.startswith("xethru_"))
    return any(not path.is_dir() or any(path.glob("xethru_*")) for path in found)


def new_session_id() -> str:
    """Return a random UUID, which a session without a name is called."""
    return str(uuid.uuid4())


def session_directory(
    folder: Path | str, session_id: str, t_ns: int, timezone: tzinfo | None = None
) -> Path:
    """Return the directory that the vendor's recorder makes in ``folder`` for a session.

    ``t_ns`` is when the session begins [ns since 1970]. Characters of the id that do not belong
    into names of files become ``_``.

    >>> from datetime import UTC
    >>> str(session_directory("recordings", "my session/1", 0, UTC))
    'recordings/xethru_recording_19700101_000000_my_session_1'
    """
    stamp = local_time(t_ns // MS_NS, timezone)
    return Path(folder) / f"xethru_recording_{stamp:%Y%m%d_%H%M%S}_{id_in_names(session_id)}"


def _checked_basenames(names: Mapping[type[Response], str]) -> Mapping[type[Response], str]:
    for message, name in names.items():
        if message not in KIND_OF_MESSAGE:
            raise RecordingError(f"a recording has no file of {message.__name__}")
        if not re.fullmatch(r"[\w.+-]+", name):
            raise RecordingError(
                f"{shown(name)} cannot begin the name of a file: use letters, digits, _"
            )
    if len(set(names.values())) < len(names):
        raise RecordingError("two kinds of data file have the same base name")
    return names

"""Writes recording directories as the vendor's ModuleConnector does, down to the meta index.

Every record and its index entry are handed to the operating system at once, the record first, so
a recorder that is unplugged, killed or out of disk leaves all it wrote: the data files are whole
up to the last record and the index up to the last entry. Only the totals in the head of the meta
file and its list of files are missing then; the reader does without them.
"""

import os
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, tzinfo
from io import FileIO
from pathlib import Path
from types import TracebackType
from typing import Self

from xethru_protocol.recordings.records import MS_NS, RecordingError, unwritable
from xethru_protocol.recordings.vendor.layouts import (
    ALL_BITS,
    BY_MESSAGE,
    META_NAME,
    PARAMETER_FILE_NAME,
    CsvKind,
    Entry,
    Layout,
    MetaHead,
    layout_of,
    pack_files,
)
from xethru_protocol.wire.codec import encode
from xethru_protocol.wire.table import ROWS, Response, UnknownMessage


@dataclass(frozen=True, slots=True, kw_only=True)
class Split:
    """When a data file ends and the next of its kind begins: at the first limit reached.

    ``records`` and ``bytes`` count one file, ``seconds`` since its first record; None: no limit.
    """

    records: int | None = None
    bytes: int | None = None
    seconds: float | None = None

    def __post_init__(self) -> None:
        for limit in (self.records, self.bytes, self.seconds):
            if limit is not None and not limit > 0:
                raise RecordingError(f"a limit of a data file must be positive, not {limit}")


class _DataFile:
    """One data file being written."""

    def __init__(self, path: Path, data_type: int, number: int, first_ms: int) -> None:
        self.stream = _create(path)
        self.path = path
        self.data_type = data_type
        self.number = number
        self.first_ms = first_ms
        self.size = 0
        self.records = 0

    def is_full(self, split: Split, since_ms: int) -> bool:
        return (
            (split.records is not None and self.records >= split.records)
            or (split.bytes is not None and self.size >= split.bytes)
            or (split.seconds is not None and since_ms - self.first_ms >= 1000 * split.seconds)
        )


class RecordingWriter:
    """Writes one recording directory.

    Parameters
    ----------
    directory
        Where; made if missing. Must hold no recording yet.
    session_id
        The recorder's name for the session.
    profile_id
        Profile that runs; None: written as 0.
    parameter_file
        Content of the module's parameter file, stored beside the data; None: none is stored.
    user_header
        Bytes to put before the records of each data file.
    split
        When to begin a new data file; None: never.
    timezone
        Of the stamps in file names and text files; None: this machine's.

    Raises
    ------
    RecordingError
        If the directory cannot be made or holds a recording.

    Examples
    --------
    >>> from tempfile import TemporaryDirectory
    >>> from xethru_protocol.wire.messages import DataFloat
    >>> import numpy as np
    >>> with TemporaryDirectory() as folder, RecordingWriter(folder, timezone=UTC) as writer:
    ...     _ = writer.write(DataFloat(info=1, values=np.zeros(3, np.float32)), 0)
    ...     sorted(path.name for path in Path(folder).iterdir())
    ['xethru_datafloat_19700101_000000.dat', 'xethru_recording_meta.dat']
    """

    def __init__(
        self,
        directory: Path | str,
        *,
        session_id: str = "",
        profile_id: int | None = None,
        parameter_file: bytes | str | None = None,
        user_header: bytes = b"",
        split: Split | None = None,
        timezone: tzinfo | None = None,
    ) -> None:
        self.directory = Path(directory)
        self._session_id = session_id.encode()
        self._profile_id = profile_id or 0
        self._user_header = user_header
        self._split = split or Split()
        self._zone = timezone
        self._meta: FileIO | None = None
        self._start_ms = 0
        self._files: dict[int, _DataFile] = {}
        self._names: list[str] = []
        self._size = 0
        self._index_end = 0
        self._data_types = 0
        self._largest = 0
        self._last_ms = 0
        self._closed = False
        self.messages = 0
        """Messages written so far."""
        _make_directory(self.directory)
        if parameter_file is not None:
            content = parameter_file.encode() if isinstance(parameter_file, str) else parameter_file
            with _create(self.directory / PARAMETER_FILE_NAME) as stream:
                _append(stream, self.directory / PARAMETER_FILE_NAME, content, 0)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exception: type[BaseException] | None,
        value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            self.close()
        except RecordingError:
            if value is None:  # the first error is raised
                raise

    def write(self, message: Response, t_ns: int) -> bool:
        """Append a message.

        Parameters
        ----------
        message
            Any message from a module.
        t_ns
            Its time [ns since 1970]; stored with 1 ms, never before the first message's.

        Returns
        -------
        Whether it was stored: the format has no place for answers, system messages and the like.

        Raises
        ------
        RecordingError
            If the disk is full or the directory went away. What was written before stays.
        """
        if self._closed:
            raise RecordingError(f"{self.directory}: the recording is closed")
        time_ms = t_ns // MS_NS
        kind = BY_MESSAGE.get(type(message))
        if kind is not None:
            start_ms = self._started_at(time_ms)
            line = kind.line(message, max(time_ms, start_ms), self._zone)
            self._record(kind, line.encode("latin-1"), time_ms, kind.header.encode("ascii"))
            return True
        if isinstance(message, UnknownMessage) or not ROWS[type(message)].bulk:
            return False
        payload = encode(message, bulk=True)
        layout = layout_of(payload)
        if layout is None:
            return False
        self._started_at(time_ms)
        self._record(layout, payload[len(layout.prefix) :], time_ms, b"")
        return True

    def close(self, *, stopped_ns: int | None = None, closed_ns: int | None = None) -> None:
        """Write the totals and close all files; calling it again does nothing.

        Parameters
        ----------
        stopped_ns, closed_ns
            When the data files and when the recording ended [ns since 1970]; None: with the
            last message, and with ``stopped_ns``.
        """
        if self._closed:
            return
        self._closed = True
        meta = self._meta
        if meta is None:
            return
        stopped_ms = self._last_ms if stopped_ns is None else self._since(stopped_ns // MS_NS)
        duration_ms = stopped_ms if closed_ns is None else self._since(closed_ns // MS_NS)
        path = self.directory / META_NAME
        try:
            for file in self._files.values():
                self._close_file(file, stopped_ms)
            _append(meta, path, pack_files(duration_ms, self._names), self._index_end)
        finally:
            # The head's bytes exist: this works on a full disk, too.
            head = self._head(duration_ms=duration_ms, index_end=self._index_end)
            _overwrite(meta, path, head.pack())

    def _started_at(self, time_ms: int) -> int:
        """Begin the meta file with the first message; return when the recording began."""
        if self._meta is None:
            self._start_ms = time_ms
            self._meta = _create(self.directory / META_NAME)
            head = self._head(duration_ms=0, index_end=0).pack()
            _append(self._meta, self.directory / META_NAME, head, 0)
            self._index_end = len(head)
        return self._start_ms

    def _head(self, *, duration_ms: int, index_end: int) -> MetaHead:
        return MetaHead(
            start_ms=self._start_ms,
            duration_ms=duration_ms,
            size=self._size,
            index_end=index_end,
            data_types=self._data_types,
            largest_record=self._largest,
            profile_id=self._profile_id,
            session_id=self._session_id,
        )

    def _since(self, time_ms: int) -> int:
        return min(max(time_ms - self._start_ms, 0), ALL_BITS)

    def _record(self, kind: Layout | CsvKind, data: bytes, time_ms: int, header: bytes) -> None:
        since_ms = self._since(time_ms)
        file = self._files.get(kind.data_type)
        if file is not None and file.is_full(self._split, since_ms):
            self._close_file(file, since_ms)
            file = None
        if file is None:
            file = self._open_file(kind, since_ms)
            if self._user_header:
                self._append(file, self._user_header, kind.data_type ^ ALL_BITS, since_ms)
            if header:
                self._append(file, header, kind.data_type, since_ms)
        self._append(file, data, kind.data_type, since_ms)
        file.records += 1
        self.messages += 1
        self._last_ms = max(self._last_ms, since_ms)

    def _open_file(self, kind: Layout | CsvKind, since_ms: int) -> _DataFile:
        seconds = (self._start_ms + since_ms) // 1000
        time = (datetime.fromtimestamp(0, UTC) + timedelta(seconds=seconds)).astimezone(self._zone)
        stem = f"{kind.file_prefix}{time:%Y%m%d_%H%M%S}"
        suffix = ".csv" if isinstance(kind, CsvKind) else ".dat"
        name = stem + suffix
        again = 0
        while name in self._names:  # several files within one second
            again += 1
            name = f"{stem}_{again:03d}{suffix}"
        path = self.directory / name
        file = _DataFile(path, kind.data_type, len(self._names), since_ms)
        self._names.append(name)
        self._files[kind.data_type] = file
        self._data_types |= kind.data_type
        return file

    def _append(self, file: _DataFile, data: bytes, data_type: int, since_ms: int) -> None:
        begin = file.size
        _append(file.stream, file.path, data, begin)
        file.size += len(data)
        self._size += len(data)
        self._largest = max(self._largest, len(data))
        self._index(file, data_type, since_ms, size=len(data), begin=begin)

    def _close_file(self, file: _DataFile, since_ms: int) -> None:
        file.stream.close()
        self._index(file, file.data_type, since_ms, size=0, begin=file.size, closed=True)

    def _index(
        self,
        file: _DataFile,
        data_type: int,
        since_ms: int,
        *,
        size: int,
        begin: int,
        closed: bool = False,
    ) -> None:
        assert self._meta is not None
        entry = Entry(
            since_start_ms=since_ms,
            closed=closed,
            data_type=data_type,
            size=size,
            file=file.number,
            begin=begin,
            end=self._size,
        ).pack()
        _append(self._meta, self.directory / META_NAME, entry, self._index_end)
        self._index_end += len(entry)


def _make_directory(directory: Path) -> None:
    try:
        directory.mkdir(parents=True, exist_ok=True)
        if any(path.name.startswith("xethru_") for path in directory.iterdir()):
            raise RecordingError(f"{directory} already holds a recording; name another directory")
    except OSError as error:
        raise unwritable(directory, error) from None


def _create(path: Path) -> FileIO:
    try:
        return FileIO(path, "x")
    except OSError as error:
        raise unwritable(path, error) from None


def _append(stream: FileIO, path: Path, data: bytes, position: int) -> None:
    """Write all of ``data`` at the file's end, or leave the file as it was."""
    view = memoryview(data)
    try:
        while view:
            view = view[stream.write(view) :]
    except OSError as error:
        with suppress(OSError):  # the disk itself may be gone
            os.ftruncate(stream.fileno(), position)  # no half record stays behind
            stream.seek(position)
        raise unwritable(path, error) from None


def _overwrite(stream: FileIO, path: Path, data: bytes) -> None:
    try:
        with stream:
            stream.seek(0)
            stream.write(data)
    except OSError as error:
        raise unwritable(path, error) from None

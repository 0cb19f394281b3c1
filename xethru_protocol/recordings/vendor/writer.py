"""Writes recording directories as the vendor's ModuleConnector does, down to the meta index.

Every record and its index entry are handed to the operating system at once, the record first, so
a recorder that is unplugged, killed or out of disk leaves all it wrote: the data files are whole
up to the last record and the index up to the last entry. Only the totals in the head of the meta
file and its list of files are missing then; the reader does without them.
"""

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path
from typing import Self

from xethru_protocol.recordings.records import MS_NS, GrowingFile, RecordingError, writing
from xethru_protocol.recordings.vendor.layouts import (
    ALL_BITS,
    CLOSED,
    KIND_OF_MESSAGE,
    META_NAME,
    PARAMETER_FILE_NAME,
    RECORD,
    BinaryKind,
    Entry,
    Meta,
    TextKind,
)
from xethru_protocol.wire.rows import Response


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


class _DataFile(GrowingFile):
    """One data file being written; ``number`` is its place in the list of files."""

    def __init__(self, path: Path, number: int, first_ms: int) -> None:
        super().__init__(path)
        self.number = number
        self.first_ms = first_ms
        self.records = 0

    def is_full(self, split: Split, since_ms: int) -> bool:
        return (
            (split.records is not None and self.records >= split.records)
            or (split.bytes is not None and self.size >= split.bytes)
            or (split.seconds is not None and since_ms - self.first_ms >= 1000 * split.seconds)
        )


class RecordingWriter:
    """Writes one recording directory; RecordingError if it cannot be made or holds a recording.

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
        self._user_header = user_header
        self._split = split or Split()
        self._zone = timezone
        self._meta = Meta(session_id=session_id.encode(), profile_id=profile_id or 0)
        self._meta_file: GrowingFile | None = None
        self._files: dict[int, _DataFile] = {}
        self._last_ms = 0
        self._closed = False
        with writing(self.directory):
            self.directory.mkdir(parents=True, exist_ok=True)
            if any(path.name.startswith("xethru_") for path in self.directory.iterdir()):
                raise RecordingError(
                    f"{self.directory} already holds a recording; name another directory"
                )
        if parameter_file is not None:
            content = parameter_file.encode() if isinstance(parameter_file, str) else parameter_file
            with GrowingFile(self.directory / PARAMETER_FILE_NAME) as file:
                file.append(content)

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
        start_ms = time_ms if self._meta_file is None else self._meta.start_ms
        data = kind.record(message, max(time_ms, start_ms), self._zone)
        if self._meta_file is None:
            self._meta.start_ms = start_ms
            self._meta_file = GrowingFile(self.directory / META_NAME)
            self._meta_file.append(self._meta.pack_head())
        since_ms = self._since(time_ms)
        file = self._files.get(kind.data_type)
        if file is not None and file.is_full(self._split, since_ms):
            self._close_file(kind.data_type, since_ms)
            file = None
        if file is None:
            file = self._open_file(kind, since_ms)
            if self._user_header:
                self._append(file, self._user_header, kind.data_type ^ ALL_BITS, since_ms)
            if kind.titles:
                self._append(file, kind.titles, kind.data_type, since_ms)
        self._append(file, data, kind.data_type, since_ms)
        file.records += 1
        self._last_ms = max(self._last_ms, since_ms)
        return True

    def close(self, *, stopped_ns: int | None = None, closed_ns: int | None = None) -> None:
        """Write the totals and close all files; calling it again does nothing.

        ``stopped_ns`` and ``closed_ns`` are when the data files and when the recording ended [ns
        since 1970]; None: with the last message, and with ``stopped_ns``.
        """
        if self._closed:
            return
        self._closed = True
        if self._meta_file is None:
            return
        stopped_ms = self._last_ms if stopped_ns is None else self._since(stopped_ns // MS_NS)
        self._meta.duration_ms = (
            stopped_ms if closed_ns is None else self._since(closed_ns // MS_NS)
        )
        try:
            for data_type in self._files:
                self._close_file(data_type, stopped_ms)
            self._meta_file.append(self._meta.pack_files())
        finally:
            # The head's bytes exist already, so this works on a full disk, too.
            self._meta_file.finish(self._meta.pack_head())

    def _since(self, time_ms: int) -> int:
        return min(max(time_ms - self._meta.start_ms, 0), ALL_BITS)

    def _open_file(self, kind: BinaryKind | TextKind, since_ms: int) -> _DataFile:
        seconds = (self._meta.start_ms + since_ms) // 1000
        time = (datetime.fromtimestamp(0, UTC) + timedelta(seconds=seconds)).astimezone(self._zone)
        stem = f"{kind.file_prefix}{time:%Y%m%d_%H%M%S}"
        name = stem + kind.suffix
        again = 0
        while name in self._meta.files:  # several files within one second
            again += 1
            name = f"{stem}_{again:03d}{kind.suffix}"
        file = _DataFile(self.directory / name, len(self._meta.files), since_ms)
        self._meta.files.append(name)
        self._files[kind.data_type] = file
        self._meta.data_types |= kind.data_type
        return file

    def _append(self, file: _DataFile, data: bytes, data_type: int, since_ms: int) -> None:
        begin = file.size
        file.append(data)
        self._meta.size += len(data)
        self._meta.largest_record = max(self._meta.largest_record, len(data))
        end = self._meta.size
        self._index(Entry(since_ms, RECORD, data_type, len(data), file.number, begin, end))

    def _close_file(self, data_type: int, since_ms: int) -> None:
        file = self._files[data_type]
        file.close()
        end = self._meta.size
        self._index(Entry(since_ms, CLOSED, data_type, 0, file.number, file.size, end))

    def _index(self, entry: Entry) -> None:
        assert self._meta_file is not None
        self._meta_file.append(entry.pack())
        self._meta.index_end = self._meta_file.size

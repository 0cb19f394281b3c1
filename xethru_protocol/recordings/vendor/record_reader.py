"""Reads single records of a recording directory, at any place: seek, peek, filter.

What the vendor's DataReader can do, with two differences. That one cannot seek into the last record
of a meta file; this one can. Of a recording split into directories that one adds the durations up,
so that positions leave out the time between them; here a position is the time since the start.
"""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Self

import numpy as np
import numpy.typing as npt

from xethru_protocol.recordings.records import MS_NS, RecordingError, reading
from xethru_protocol.recordings.vendor.layouts import (
    ENTRY,
    KIND_OF_MESSAGE,
    KIND_OF_TYPE,
    META_NAME,
    RECORD,
    VERSION,
    Kind,
    Meta,
    TextKind,
)
from xethru_protocol.recordings.vendor.reader import files_by_number, parts_of, read_meta
from xethru_protocol.wire.codec import decode_response
from xethru_protocol.wire.errors import LocalProtocolError
from xethru_protocol.wire.rows import Response

_FURTHEST = 1 << 48  # byte of a recording; sums of such numbers stay within 64 bits


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
    `read` or a seek left off. User headers and lines of titles are skipped.

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
        path = Path(path)
        metas: list[Meta] = []
        entries: list[npt.NDArray[np.void]] = []
        self._files: list[dict[tuple[int, int], tuple[Path, Kind]]] = []
        directories = [directory for directory, _ in parts_of(path)]
        for directory in directories:
            meta = read_meta(directory)
            if meta is None:
                raise RecordingError(f"{directory} has no {META_NAME}; read_recording does without")
            metas.append(meta)
            entries.append(np.frombuffer(meta.index, ENTRY))
            self._files.append(files_by_number(directory, meta))
        first, last = metas[0], metas[-1]
        self.start_ns = first.start_ms * MS_NS
        self.session_id = first.session_id.decode("utf-8", "replace")
        self.profile_id = first.profile_id
        self._build_index(directories, metas, entries)
        end_ms = last.start_ms + last.duration_ms
        if not last.complete and len(self._t_ms):  # its recorder was killed
            end_ms = int(self._t_ms[-1])
        self.duration_ns = end_ms * MS_NS - self.start_ns
        self._wanted: npt.NDArray[np.bool_] | None = None  # by record; None for all
        self._filter: frozenset[type[Response]] = frozenset()
        self._next = 0
        self._streams: dict[Path, BinaryIO] = {}
        self._exits = ExitStack()

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
        return frozenset(KIND_OF_TYPE[int(bit)].message for bit in np.unique(self._data_type))

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
        self._wanted = np.isin(self._data_type, bits) if kinds else None
        self._filter = frozenset(kinds)

    @property
    def at_end(self) -> bool:
        """Whether nothing more can be read."""
        return self._following() >= len(self)

    def peek(self) -> Record:
        """Return the next record and stay before it; RecordingError at the end or if damaged."""
        at = self._following()
        if at >= len(self):
            raise RecordingError("the recording is at its end; look at at_end before you read")
        return self._record(at)

    def read(self) -> Record:
        """Return the next record and go behind it; RecordingError at the end or if damaged."""
        at = self._following()
        self._next = min(at + 1, len(self))
        if at >= len(self):
            raise RecordingError("the recording is at its end; look at at_end before you read")
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
        start_ms = self.start_ns // MS_NS
        self._next = int(np.searchsorted(self._latest_ms, start_ms + position_ms))

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

    def _build_index(
        self, directories: list[Path], metas: list[Meta], entries: list[npt.NDArray[np.void]]
    ) -> None:
        """Join the indexes of all meta files: records in order, without headers."""
        columns: list[tuple[npt.NDArray[np.int64], ...]] = []
        self.size_bytes = 0
        self.largest_record_bytes = 0
        for part, (meta, all_of) in enumerate(zip(metas, entries, strict=True)):
            records = all_of[all_of["kind"] == RECORD]
            if (np.maximum(records["begin"], records["end"]) > _FURTHEST).any():
                raise RecordingError(
                    f"the index of {directories[part]} is damaged: it has a record beyond "
                    f"byte {_FURTHEST}; read_recording does without"
                )
            known = np.isin(records["data_type"], list(KIND_OF_TYPE))
            known &= ~_are_titles(records)
            kept = records[known]
            end = kept["end"].astype(np.int64) + self.size_bytes
            columns.append(
                (
                    kept["ms"].astype(np.int64) + meta.start_ms,
                    kept["data_type"].astype(np.int64),
                    kept["file"].astype(np.int64),
                    kept["begin"].astype(np.int64),
                    kept["size"].astype(np.int64),
                    end,
                    np.full(len(kept), part),
                )
            )
            if len(records):
                self.size_bytes += int(records["end"].max())
                self.largest_record_bytes = max(
                    self.largest_record_bytes, int(records["size"].max())
                )
        joined = [np.concatenate(column) for column in zip(*columns, strict=True)]
        (self._t_ms, self._data_type, self._file, self._begin, self._size, self._end,
         self._in_part) = joined  # fmt: skip
        self._latest_ms = np.maximum.accumulate(self._t_ms)

    def _record(self, at: int) -> Record:
        data_type, size = int(self._data_type[at]), int(self._size[at])
        path, kind = self._files[int(self._in_part[at])][data_type, int(self._file[at])]
        with reading(path):
            stream = self._streams.get(path)
            if stream is None:
                stream = self._streams[path] = self._exits.enter_context(path.open("rb"))
            stream.seek(int(self._begin[at]))
            data = stream.read(size)
        return Record(
            message=_message(path, kind, data, size),
            t_ns=int(self._t_ms[at]) * MS_NS,
            data=data,
            position=int(self._end[at]) - size,
        )


def _message(path: Path, kind: Kind, data: bytes, size: int) -> Response:
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

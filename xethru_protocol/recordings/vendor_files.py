"""One data file of a ModuleConnector recording: its records one after the other."""

from __future__ import annotations

import os
from pathlib import Path
from typing import BinaryIO

from xethru_protocol.codec import decode_response
from xethru_protocol.errors import LocalProtocolError
from xethru_protocol.recordings.csv_kinds import CSV_KINDS, CsvKind
from xethru_protocol.recordings.errors import (
    FaultHandler,
    RecordingFault,
    report,
    unreadable,
)
from xethru_protocol.recordings.layouts import LAYOUTS, Layout
from xethru_protocol.table import Response

_KINDS: tuple[Layout | CsvKind, ...] = (*LAYOUTS, *CSV_KINDS)
_BY_TYPE: dict[int, Layout | CsvKind] = {kind.data_type: kind for kind in _KINDS}
_BY_LENGTH = sorted(_KINDS, key=lambda kind: -len(kind.file_prefix))
_LONGEST_USER_HEADER = 4096  # bytes; looked for where no index tells how long it is
_LARGEST_PLAUSIBLE_RECORD = 1 << 16
_LAST_CONTENT_ID = 14  # Protocol reference 6.1


def kind_of(file_or_type: str | int) -> Layout | CsvKind | None:
    """Kind of a data file by its name or its data type bit; None if it is none we know."""
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
        The file; its name tells its kind.
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
        """Close the file."""
        self._stream.close()

    def skip_user_header(self) -> None:
        """Leave out a user header whose length nobody tells.

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
    """Length of what stands before the first record, as far as the records themselves tell.

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

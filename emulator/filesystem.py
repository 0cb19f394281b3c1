"""The file system in a module's flash: files of a type and an identifier, some of them open.

Files are as long as they were created; erased bytes are FF. Assumed: sizes add up to the storage
without overhead, and a write may change erased and written bytes alike.

Source: protocol reference 4.11 and 5.1.
"""

from __future__ import annotations

from collections.abc import Mapping

from emulator.refusal import Refusal
from xethru_protocol.codes import FORMAT_KEY, FileError

__all__ = ["MAX_FILES", "MAX_OPEN", "FileKey", "FileSystem"]

MAX_FILES = 20
MAX_OPEN = 10
ERASED = b"\xff"

FileKey = tuple[int, int]
"""Type and identifier of a file."""


class FileSystem:
    """Files of one module.

    Parameters
    ----------
    storage_bytes
        Size of all files together.
    files
        Content as it was saved; none is open.
    """

    def __init__(self, storage_bytes: int, files: Mapping[FileKey, bytes] | None = None) -> None:
        self._storage_bytes = storage_bytes
        self._files = {key: bytearray(data) for key, data in (files or {}).items()}
        self._open: set[FileKey] = set()

    @property
    def contents(self) -> dict[FileKey, bytes]:
        """All files, oldest first."""
        return {key: bytes(data) for key, data in self._files.items()}

    def names(self) -> list[FileKey]:
        """Return type and identifier of all files, oldest first."""
        return list(self._files)

    def create(self, key: FileKey, length: int) -> None:
        """Create a file; it is open and erased then."""
        if key in self._open:
            raise Refusal(FileError.ALREADY_OPEN)
        if key in self._files:
            raise Refusal(FileError.ALREADY_EXISTS)
        if len(self._files) >= MAX_FILES or length > self.free_bytes:
            raise Refusal(FileError.FULL)
        self._check_room_to_open()
        self._files[key] = bytearray(ERASED * length)
        self._open.add(key)

    def open(self, key: FileKey) -> None:
        """Open a file."""
        if key in self._open:
            raise Refusal(FileError.ALREADY_OPEN)
        self._check_exists(key)
        self._check_room_to_open()
        self._open.add(key)

    def close(self, key: FileKey) -> None:
        """Close a file."""
        self._check_open(key)
        self._open.remove(key)

    def close_all(self) -> None:
        """Close every file, as a reset does."""
        self._open.clear()

    def length(self, key: FileKey) -> int:
        """Return a file's size [bytes]; it need not be open."""
        self._check_exists(key)
        return len(self._files[key])

    def read(self, key: FileKey, offset: int, length: int) -> bytes:
        """Read from an open file."""
        self._check_open(key)
        self._check_range(key, offset, length)
        return bytes(self._files[key][offset : offset + length])

    def write(self, key: FileKey, offset: int, data: bytes) -> None:
        """Write into an open file."""
        self._check_open(key)
        self._check_range(key, offset, len(data))
        self._files[key][offset : offset + len(data)] = data

    def delete(self, key: FileKey) -> None:
        """Delete a closed file."""
        if key in self._open:
            raise Refusal(FileError.ALREADY_OPEN)
        self._check_exists(key)
        del self._files[key]

    def format(self, key: int) -> None:
        """Delete all files, open ones too."""
        if key != FORMAT_KEY:
            raise Refusal(FileError.INVALID_PARAMETER)
        self._files.clear()
        self._open.clear()

    def replace(self, key: FileKey, data: bytes) -> None:
        """Give a file a new content, as the firmware does with files of its own."""
        if key in self._open:
            raise Refusal(FileError.ALREADY_OPEN)
        freed = len(self._files.get(key, b""))
        full = key not in self._files and len(self._files) >= MAX_FILES
        if full or len(data) > self.free_bytes + freed:
            raise Refusal(FileError.FULL)
        self._files[key] = bytearray(data)

    def get(self, key: FileKey) -> bytes | None:
        """Return a file's content, open or not; None if there is no such file."""
        data = self._files.get(key)
        return None if data is None else bytes(data)

    def is_open(self, key: FileKey) -> bool:
        """Whether a file is open."""
        return key in self._open

    @property
    def free_bytes(self) -> int:
        """Room for further files [bytes]."""
        return self._storage_bytes - sum(len(data) for data in self._files.values())

    def _check_room_to_open(self) -> None:
        if len(self._open) >= MAX_OPEN:
            raise Refusal(FileError.TOO_MANY_OPEN)

    def _check_exists(self, key: FileKey) -> None:
        if key not in self._files:
            raise Refusal(FileError.NOT_FOUND)

    def _check_open(self, key: FileKey) -> None:
        if key not in self._open:
            raise Refusal(FileError.NOT_OPEN)

    def _check_range(self, key: FileKey, offset: int, length: int) -> None:
        if offset + length > len(self._files[key]):
            raise Refusal(FileError.OUT_OF_RANGE)

"""What a module keeps: its identity, files in flash, what survives resets.

Files are as long as they were created; erased bytes are FF. Assumed: sizes add up to the storage
without overhead, and a write may change erased and written bytes alike.

Source: protocol reference 4.7, 4.10, 4.11, 5.1, 8.2, 8.5 and 11, row 18.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from emulator.chip.chip import Refusal
from emulator.module.modes import Start
from emulator.module.settings import ProfileSettings
from xethru_protocol.wire.codes import FORMAT_KEY, FileError, InfoItem

MAX_FILES = 20
MAX_OPEN = 10
ERASED = b"\xff"

FileKey = tuple[int, int]
"""Type and identifier of a file."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Identity:
    """The strings a stock X4M300 with sensor firmware answers.

    The DSP library's name and version are assumed; the reference gives none. `ValueError` is
    raised unless the serial number has 12 digits.

    Source: protocol reference 4.10, table of system info items.
    """

    serial: str
    order_code: str = "X4M300"
    item_number: str = "000112-001"
    firmware_id: str = "Annapurna"
    version: str = "1.6.8"
    xep_version: str = "3.4.8"
    dsp_library: str = "DSP:1.0.0"
    build: str = "0" * 40

    def __post_init__(self) -> None:
        if len(self.serial) != 12 or not self.serial.isascii() or not self.serial.isdigit():
            raise ValueError(f"serial number {self.serial!r}: an X4M300 has 12 digits")

    @property
    def core_id(self) -> str:
        """The microcontroller's own number, 16 characters."""
        return f"EMUL{self.serial}"

    def info(self, item: int, *, base_firmware: bool = False) -> str | None:
        """Return the text of one info item; None for an item this firmware does not know.

        The base firmware knows no product: neither item number, order code nor serial number.

        Examples
        --------
        >>> Identity(serial="202611210001").info(0x01)
        'X4M300'
        >>> Identity(serial="202611210001").info(0x05) is None
        True
        """
        name, version = (
            ("XEP", self.xep_version) if base_firmware else (self.firmware_id, self.version)
        )
        parts = f"XEP:{self.xep_version};X4C51:2.1.0"
        texts: dict[int, str] = {
            InfoItem.XTID_SSIC_FIRMWAREID: name,
            InfoItem.XTID_SSIC_VERSION: version,
            InfoItem.XTID_SSIC_BUILD: f"{version}+0.sha.{self.build}",
            InfoItem.XTID_SSIC_VERSIONLIST: parts,
            InfoItem.XTID_SSIC_SYSTEMCOREID: self.core_id,
            InfoItem.XTID_SSIC_BOOTLOADER: "XETHRU OPENBOOTLOADER",
        }
        # the application id list is answered with an error by released firmware
        if not base_firmware:
            texts |= {
                InfoItem.XTID_SSIC_ITEMNUMBER: self.item_number,
                InfoItem.XTID_SSIC_ORDERCODE: self.order_code,
                InfoItem.XTID_SSIC_SERIALNUMBER: self.serial,
                InfoItem.XTID_SSIC_VERSIONLIST: f"{name}:{version};{parts};{self.dsp_library}",
            }
        return texts.get(item)


class FileSystem:
    """Files of one module; what the firmware answers with an ERROR raises `Refusal`."""

    def __init__(self, storage_bytes: int, files: Mapping[FileKey, bytes] | None = None) -> None:
        self._storage_bytes = storage_bytes
        self._files = {key: bytearray(data) for key, data in (files or {}).items()}
        self._open: set[FileKey] = set()

    @property
    def contents(self) -> dict[FileKey, bytes]:
        """All files, oldest first."""
        return {key: bytes(data) for key, data in self._files.items()}

    def names(self) -> list[FileKey]:
        return list(self._files)

    def create(self, key: FileKey, length: int) -> None:
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
        if key in self._open:
            raise Refusal(FileError.ALREADY_OPEN)
        self._check_exists(key)
        self._check_room_to_open()
        self._open.add(key)

    def close(self, key: FileKey) -> None:
        self._check_open(key)
        self._open.remove(key)

    def close_all(self) -> None:
        self._open.clear()

    def length(self, key: FileKey) -> int:
        self._check_exists(key)
        return len(self._files[key])

    def read(self, key: FileKey, offset: int, length: int) -> bytes:
        self._check_open(key)
        self._check_range(key, offset, length)
        return bytes(self._files[key][offset : offset + length])

    def write(self, key: FileKey, offset: int, data: bytes) -> None:
        self._check_open(key)
        self._check_range(key, offset, len(data))
        self._files[key][offset : offset + len(data)] = data

    def delete(self, key: FileKey) -> None:
        if key in self._open:
            raise Refusal(FileError.ALREADY_OPEN)
        self._check_exists(key)
        del self._files[key]

    def format(self, key: int) -> None:
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
        return key in self._open

    @property
    def free_bytes(self) -> int:
        return self._storage_bytes - sum(len(data) for data in self._files.values())

    def _check_room_to_open(self) -> None:
        if len(self._open) >= MAX_OPEN:
            raise Refusal(FileError.TOO_MANY_FILES_OPEN)

    def _check_exists(self, key: FileKey) -> None:
        if key not in self._files:
            raise Refusal(FileError.NOT_FOUND)

    def _check_open(self, key: FileKey) -> None:
        if key not in self._open:
            raise Refusal(FileError.NOT_OPEN)

    def _check_range(self, key: FileKey, offset: int, length: int) -> None:
        if offset + length > len(self._files[key]):
            raise Refusal(FileError.OUT_OF_RANGE)


@dataclass(frozen=True, slots=True, kw_only=True)
class SavedState:
    """Content of a module's flash.

    Attributes
    ----------
    profiles
        Settings of each profile as of its last start, by profile id.
    files
        Content of the file system; noise maps and the crash dump are files.
    unfinished_update
        Whether the bootloader left the flash unlocked.
    """

    start: Start = field(default_factory=Start)
    profiles: Mapping[int, ProfileSettings] = field(default_factory=dict)
    files: Mapping[FileKey, bytes] = field(default_factory=dict)
    parameter_file_name: str = ""
    certification: bool = False
    unfinished_update: bool = False


class Memory(Protocol):
    """Where a module's flash is kept while the emulator does not run."""

    def load(self) -> SavedState | None:
        """Return what was saved; None for a module fresh from the factory."""
        ...

    def save(self, state: SavedState) -> None: ...

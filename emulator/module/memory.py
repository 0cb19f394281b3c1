"""What a module keeps: its identity, files in flash, what survives resets.

Files are as long as they were created and take whole blocks of the flash; erased bytes are FF.
Assumed: a write may change erased and written bytes alike.

Source: protocol reference 4.7, 4.10, 4.11, 5.1, 8.2, 8.5 and 11, row 18.
"""

from __future__ import annotations

from base64 import b64decode, b64encode
from bisect import bisect_right
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Literal, Protocol

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer

from emulator.chip.chip import Refusal
from emulator.module.settings import U32, ProfileSettings
from xethru_protocol.validation import shown
from xethru_protocol.wire.codes import FORMAT_KEY, FileError, InfoItem
from xethru_protocol.wire.versions import FIRMWARE_ID, FirmwareVersions

MAX_FILES = 20
MAX_OPEN = 10
BLOCK_BYTES = 8192
"""What the flash erases at once; the first block holds the table of files."""
LONGEST_READ = BLOCK_BYTES
"""Bytes of a file that are worth making at once; no reply is as long."""
_WORD = 0xFFFFFFFF
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
            raise ValueError(f"serial number {shown(self.serial)}: an X4M300 has 12 digits")

    @property
    def core_id(self) -> str:
        """The microcontroller's own number, 16 characters."""
        return f"EMUL{self.serial}"

    def with_firmware(self, firmware: FirmwareVersions) -> Identity:
        """Return the strings that the module answers with firmware of other versions."""
        old = not FIRMWARE_ID.is_in(firmware)
        return replace(
            self,
            firmware_id=self.order_code if old else self.firmware_id,
            version=firmware.sensor or self.version,
            xep_version=firmware.xep or self.xep_version,
        )

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


def _decoded(content: object) -> object:
    return b64decode(content, validate=True) if isinstance(content, str) else content


class StoredFile(BaseModel):
    """A file in the flash.

    Attributes
    ----------
    data
        Its content; bytes to which the flash does not reach are left out.
    offset
        Where it begins behind the table, in bytes; None: wherever there is room.
    length
        Bytes it was created with; None: as many as it has.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)

    type: U32
    identifier: U32
    data: Annotated[
        bytes,
        BeforeValidator(_decoded),
        PlainSerializer(lambda data: b64encode(data).decode("ascii"), when_used="json"),
    ] = Field(alias="base64")
    # not in states written before files had places
    offset: U32 | None = None
    length: U32 | None = None

    @property
    def key(self) -> FileKey:
        return self.type, self.identifier


@dataclass(slots=True, kw_only=True)
class _File:
    key: FileKey
    offset: int
    length: int
    data: bytearray

    @property
    def end(self) -> int:
        """Where the next file may begin."""
        return (self.offset + _blocks(self.length)) & _WORD


def part_limits(offset: int, length: int) -> tuple[int, int]:
    """Return where a part of a file begins and ends.

    The firmware adds offset and length in 32 bits; where the sum wraps, the part begins below 0.
    """
    end = (offset + length) & _WORD
    return end - length, end


def stored_part(data: bytes | bytearray, begin: int, length: int) -> bytes:
    """Return a part of stored data, with erased bytes where there are none."""
    length = min(length, LONGEST_READ)
    before = ERASED * min(max(-begin, 0), length)
    part = bytes(data[max(begin, 0) : max(begin + length, 0)])
    return (before + part).ljust(length, ERASED)


def _blocks(length: int) -> int:
    """Return the size of the blocks that a file takes; the firmware counts in 32 bits."""
    return -(-length // BLOCK_BYTES) * BLOCK_BYTES & _WORD


class FileSystem:
    """Files of one module; what the firmware answers with an ERROR raises `Refusal`.

    A file takes whole blocks in the first gap that is large enough and never moves. The first file
    of an empty table is not checked against the storage, and the room behind one that is too large
    is counted as a large positive number: both as in the firmware.
    """

    def __init__(self, storage_bytes: int, files: Iterable[StoredFile] = ()) -> None:
        self._data_bytes = storage_bytes // BLOCK_BYTES * BLOCK_BYTES - BLOCK_BYTES
        self._files: list[_File] = []  # in the order of their places
        self._open: set[FileKey] = set()
        for file in {file.key: file for file in files}.values():  # the last one of a key
            length = len(file.data) if file.length is None else file.length
            offset = self._gap(_blocks(length)) if file.offset is None else file.offset
            if offset is not None and len(self._files) < MAX_FILES:
                self._add(file.key, offset, length).data[: len(file.data)] = file.data

    @property
    def contents(self) -> list[StoredFile]:
        """All files, in the order of their places."""
        return [
            StoredFile(
                type=file.key[0],
                identifier=file.key[1],
                data=bytes(file.data),
                offset=file.offset,
                length=file.length,
            )
            for file in self._files
        ]

    def names(self) -> list[FileKey]:
        return [file.key for file in self._files]

    def create(self, key: FileKey, length: int) -> None:
        """Make a file of erased bytes, and leave it open."""
        self._check_handle(key)
        self._create(key, length)
        self._open.add(key)

    def open(self, key: FileKey) -> None:
        if key not in self._open:
            self._find(key)
        self._check_handle(key)
        self._open.add(key)

    def close(self, key: FileKey) -> None:
        self._check_open(key)
        self._open.remove(key)

    def close_all(self) -> None:
        self._open.clear()

    def length(self, key: FileKey) -> int:
        return self._find(key).length

    def read(self, key: FileKey, offset: int, length: int) -> bytes:
        """Return bytes of an open file; erased ones where none are kept."""
        file, begin = self._opened(key, offset, length)
        return stored_part(file.data, begin, length)

    def write(self, key: FileKey, offset: int, data: bytes) -> None:
        file, begin = self._opened(key, offset, len(data))
        data, begin = data[max(-begin, 0) :], max(begin, 0)
        kept = data[: max(len(file.data) - begin, 0)]
        file.data[begin : begin + len(kept)] = kept

    def delete(self, key: FileKey) -> None:
        if key not in self._open:
            self._find(key)
        self._check_handle(key)  # the firmware takes one for it
        self._files.remove(self._find(key))

    def format(self, key: int) -> None:
        if key != FORMAT_KEY:
            raise Refusal(FileError.INVALID_PARAMETER)
        self._files.clear()
        self._open.clear()

    def replace(self, key: FileKey, data: bytes) -> None:
        """Give a file a new content, as the firmware does with files of its own."""
        if key in self._open:
            raise Refusal(FileError.ALREADY_OPEN)
        before = list(self._files)
        self._files = [file for file in self._files if file.key != key]
        try:
            self._create(key, len(data))
        except Refusal:
            self._files = before
            raise
        file = self._find(key)
        file.data[:] = data[: len(file.data)]

    def get(self, key: FileKey) -> bytes | None:
        """Return a file's content, open or not; None if there is no such file."""
        return next((bytes(file.data) for file in self._files if file.key == key), None)

    def _create(self, key: FileKey, length: int) -> None:
        if length == 0:
            raise Refusal(FileError.UNKNOWN_FAILURE)
        if key in self.names():
            raise Refusal(FileError.ALREADY_EXISTS)
        offset = self._gap(_blocks(length))
        if len(self._files) >= MAX_FILES or offset is None:
            raise Refusal(FileError.FULL)
        self._add(key, offset, length)

    def _gap(self, size: int) -> int | None:
        """Return the first place for so many bytes; None if there is none."""
        if not self._files or self._files[0].offset >= size:
            return 0
        for before, after in pairwise(self._files):
            if (after.offset - before.end) & _WORD >= size:
                return before.end
        last = self._files[-1]
        return last.end if (self._data_bytes - last.end) & _WORD >= size else None

    def _add(self, key: FileKey, offset: int, length: int) -> _File:
        reachable = max(min(length, self._data_bytes - offset), 0)
        file = _File(key=key, offset=offset, length=length, data=bytearray(ERASED * reachable))
        self._files.insert(bisect_right(self._files, offset, key=lambda other: other.offset), file)
        return file

    def _find(self, key: FileKey) -> _File:
        for file in self._files:
            if file.key == key:
                return file
        raise Refusal(FileError.NOT_FOUND)

    def _opened(self, key: FileKey, offset: int, length: int) -> tuple[_File, int]:
        """Return an open file, and where in it a part begins, as of `part_limits`."""
        self._check_open(key)
        file = self._find(key)
        begin, end = part_limits(offset, length)
        if end > file.length:
            raise Refusal(FileError.OUT_OF_RANGE)
        return file, begin

    def _check_handle(self, key: FileKey) -> None:
        """Refuse what needs a handle of its own for a file."""
        if key in self._open:
            raise Refusal(FileError.ALREADY_OPEN)
        if len(self._open) >= MAX_OPEN:
            raise Refusal(FileError.TOO_MANY_FILES_OPEN)

    def _check_open(self, key: FileKey) -> None:
        if key not in self._open:
            raise Refusal(FileError.NOT_OPEN)


class SavedState(BaseModel):
    """Content of a module's flash, and the document in which it is kept.

    Attributes
    ----------
    start, profile_id
        What the module begins with: see `emulator.module.modes.Start`.
    profiles
        Settings of each profile as of its last start.
    files
        Content of the file system; noise maps and the crash dump are files.
    unfinished_update
        Whether the bootloader left the flash unlocked.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    format: Literal["xethru-emulator state"] = "xethru-emulator state"
    version: Literal[1] = 1
    serial: str
    start: Literal["RUN", "STOPPED"]
    profile_id: U32
    profiles: list[ProfileSettings]
    files: list[StoredFile] = Field(max_length=MAX_FILES)
    parameter_file_name: str
    certification: bool
    unfinished_update: bool = False


class Memory(Protocol):
    """Where a module's flash is kept while the emulator does not run."""

    def load(self) -> SavedState | None:
        """Return what was saved; None for a module fresh from the factory."""
        ...

    def save(self, state: SavedState) -> None: ...

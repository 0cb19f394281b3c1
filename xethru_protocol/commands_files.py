"""Rows of the message table: the module's file system, DIR_COMMAND. Protocol reference 4.11.

Names in dumps are those of the golden vectors. ``file_type`` is a `FileType` or any user-defined
one from 80000000h on; identifiers, offsets and lengths are 0 ... 2**32 - 1.
"""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from xethru_protocol import wire, wire_lists
from xethru_protocol.codes import CommandCode, DirCode, ErrorSpace
from xethru_protocol.responses import Ack, ReplyByte, ReplyInt
from xethru_protocol.table import Command, command

_DIR = CommandCode.XTS_SPC_DIR_COMMAND
_ERRORS = ErrorSpace.FILES
_TYPE = wire.Number("I", "type", shown=wire.hexadecimal)


@command(_DIR, DirCode.XTS_SDC_SEARCH_FILE_TYPE, name="DIR SEARCH_FILE_TYPE", errors=_ERRORS)
@dataclass(frozen=True, slots=True, kw_only=True)
class SearchFileType(Command[ReplyInt]):
    """Ask for the identifiers of all files of a type. 4.11."""

    file_type: Annotated[int, _TYPE]


@command(_DIR, DirCode.XTS_SDC_FIND_ALL_FILES, name="DIR FIND_ALL_FILES", errors=_ERRORS)
@dataclass(frozen=True, slots=True, kw_only=True)
class FindAllFiles(Command[ReplyInt]):
    """Ask for all files: n types, then n identifiers. 4.11."""


@command(_DIR, DirCode.XTS_SDC_CREATE_NEW_FILE, name="DIR CREATE_NEW_FILE", errors=_ERRORS)
@dataclass(frozen=True, slots=True, kw_only=True)
class CreateFile(Command[Ack]):
    """Create a file of ``length`` bytes; it is open and erased then. 4.11."""

    file_type: Annotated[int, _TYPE]
    identifier: Annotated[int, wire.U32]
    length: Annotated[int, wire.U32]


@command(_DIR, DirCode.XTS_SDC_OPEN_FILE, name="DIR OPEN_FILE", errors=_ERRORS)
@dataclass(frozen=True, slots=True, kw_only=True)
class OpenFile(Command[Ack]):
    """Open a file; at most 10 may be open. 4.11."""

    file_type: Annotated[int, _TYPE]
    identifier: Annotated[int, wire.U32]


@command(_DIR, DirCode.XTS_SDC_SET_FILE_DATA, name="DIR SET_FILE_DATA", errors=_ERRORS)
@dataclass(frozen=True, slots=True, kw_only=True)
class SetFileData(Command[Ack]):
    """Write ``data``, at most 1024 bytes, into an open file. 4.11."""

    file_type: Annotated[int, _TYPE]
    identifier: Annotated[int, wire.U32]
    offset: Annotated[int, wire.U32]
    length: ClassVar[Annotated[int, wire_lists.Count(("data",), "length")]]
    data: Annotated[bytes, wire_lists.Block("length")]


@command(_DIR, DirCode.XTS_SDC_CLOSE_FILE, name="DIR CLOSE_FILE", errors=_ERRORS)
@dataclass(frozen=True, slots=True, kw_only=True)
class CloseFile(Command[Ack]):
    """Close a file; the firmware ignores ``commit``. 4.11."""

    file_type: Annotated[int, _TYPE]
    identifier: Annotated[int, wire.U32]
    commit: Annotated[int, wire.U32] = 1


@command(_DIR, DirCode.XTS_SDC_GET_FILE_LENGTH, name="DIR GET_FILE_LENGTH", errors=_ERRORS)
@dataclass(frozen=True, slots=True, kw_only=True)
class GetFileLength(Command[ReplyInt]):
    """Ask for a file's size [bytes]; it need not be open. 4.11."""

    file_type: Annotated[int, _TYPE]
    identifier: Annotated[int, wire.U32]


@command(_DIR, DirCode.XTS_SDC_GET_FILE_DATA, name="DIR GET_FILE_DATA", errors=_ERRORS)
@dataclass(frozen=True, slots=True, kw_only=True)
class GetFileData(Command[ReplyByte]):
    """Read ``length`` bytes, at most 1024, of an open file. 4.11."""

    file_type: Annotated[int, _TYPE]
    identifier: Annotated[int, wire.U32]
    offset: Annotated[int, wire.U32]
    length: Annotated[int, wire.U32]


@command(_DIR, DirCode.XTS_SDC_DELETE_FILE, name="DIR DELETE_FILE", errors=_ERRORS)
@dataclass(frozen=True, slots=True, kw_only=True)
class DeleteFile(Command[Ack]):
    """Delete a closed file; takes about 100 ms. 4.11."""

    file_type: Annotated[int, _TYPE]
    identifier: Annotated[int, wire.U32]


@command(_DIR, DirCode.XTS_SDC_FORMAT_FILESYSTEM, name="DIR FORMAT_FILESYSTEM", errors=_ERRORS)
@dataclass(frozen=True, slots=True, kw_only=True)
class FormatFilesystem(Command[Ack]):
    """Delete all files; ``key`` must be `FORMAT_KEY`. 4.11."""

    key: Annotated[int, wire.ID32]

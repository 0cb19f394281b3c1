"""The messages of an MCAP file, one after the other, as far as the file goes.

A recorder that is killed leaves a file without index, cut anywhere, also inside a compressed
chunk. Everything before the cut is read. What is not an MCAP file, or is damaged in the middle, is
one line that says so.
"""

from __future__ import annotations

import stat
import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, TypeAlias

from slam.app import mcap_records as mcap
from slam.app.errors import AppError
from slam.app.file_kinds import describe_kind

_MESSAGE = struct.Struct("<HIQQ")


class DamagedFileError(AppError):
    """The file is no MCAP file or damaged; one line with the file, the place and what is wrong."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Metadata:
    """A named table of the file."""

    name: str
    values: dict[str, str]


@dataclass(frozen=True, slots=True, kw_only=True)
class RawMessage:
    """One message as stored; `message_type` is the name of its schema."""

    topic: str
    message_type: str
    sequence: int
    t_ns: int
    publish_ns: int
    data: bytes


Entry: TypeAlias = Metadata | RawMessage


@contextmanager
def open_mcap(path: Path, size: int | None = None) -> Iterator[mcap.RecordReader]:
    """Open a file whose first bytes are those of MCAP; of one that grows read `size` bytes.

    Raises
    ------
    DamagedFileError
        Missing, unreadable or not MCAP; says what it is instead, where that is known.
    """
    with ExitStack() as stack:
        try:
            if stat.S_ISFIFO(path.stat().st_mode):  # opening one waits for who writes into it
                raise DamagedFileError(f"{path}: is a pipe; give a file, the session.mcap of a run")
            stream = stack.enter_context(path.open("rb"))
            if stream.read(len(mcap.MAGIC)) != mcap.MAGIC:
                raise DamagedFileError(f"{path}: is no MCAP file{describe_kind(path)}")
            whole = _size(stream)
        except IsADirectoryError:
            raise DamagedFileError(
                f"{path}: is a directory{describe_kind(path)}; give the session.mcap in it"
            ) from None
        except OSError as error:
            raise _unreadable(path, error) from None
        yield mcap.RecordReader(stream, whole if size is None else min(size, whole))


def read_entries(
    path: Path, on_cut: Callable[[int], None], size: int | None = None
) -> Iterator[Entry]:
    """Yield metadata and messages in the order of the file, holding one chunk in memory.

    Parameters
    ----------
    path
        The file.
    on_cut
        Called with the position in bytes where the file ends too early, before the end.
    size
        How many bytes of the file to read, so that one that grows reads the same again; None: all.

    Raises
    ------
    DamagedFileError
        Missing, unreadable, not MCAP, or damaged other than by being cut.
    """
    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    with open_mcap(path, size) as reader:
        try:
            for found in reader.read():
                if isinstance(found, mcap.Cut):
                    on_cut(found.at)
                    return
                if isinstance(found, mcap.Damage):
                    raise _damaged(path, found.at, found.reason)
                if found.code == mcap.DATA_END:
                    return
                try:
                    entry = _entry(found, schemas, channels)
                except mcap.DAMAGES as error:
                    raise _damaged(path, found.at, str(error)) from None
                if entry is not None:
                    yield entry
        except OSError as error:
            raise _unreadable(path, error) from None


def _entry(
    record: mcap.Record, schemas: dict[int, str], channels: dict[int, tuple[str, str]]
) -> Entry | None:
    """Return what a record says, if it is one for the reader; remember schemas and channels."""
    body = record.body
    if record.code == mcap.MESSAGE:
        return _message(body, channels)
    if record.code == mcap.SCHEMA:
        (number,) = struct.unpack_from("<H", body)
        schemas[number] = mcap.text_at(body, 2)[0]
    elif record.code == mcap.CHANNEL:
        number, schema = struct.unpack_from("<HH", body)
        channels[number] = (mcap.text_at(body, 4)[0], schemas.get(schema, ""))
    elif record.code == mcap.METADATA:
        name, at = mcap.text_at(body, 0)
        return Metadata(name=name, values=mcap.table_at(body, at)[0])
    return None


def _message(body: bytes, channels: dict[int, tuple[str, str]]) -> RawMessage:
    channel, sequence, t_ns, publish_ns = _MESSAGE.unpack_from(body)
    topic, message_type = channels[channel]
    return RawMessage(
        topic=topic,
        message_type=message_type,
        sequence=sequence,
        t_ns=t_ns,
        publish_ns=publish_ns,
        data=body[_MESSAGE.size :],
    )


def _unreadable(path: Path, error: OSError) -> DamagedFileError:
    return DamagedFileError(f"{path}: cannot read: {error.strerror or error}")


def _size(stream: BinaryIO) -> int:
    here = stream.tell()
    size = stream.seek(0, 2)
    stream.seek(here)
    return size


def _damaged(path: Path, at: int, reason: str) -> DamagedFileError:
    return DamagedFileError(
        f"{path}: damaged at byte {at}: {reason}; `uwb-slam repair {path}` keeps what is whole"
    )

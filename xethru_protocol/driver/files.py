"""Files in the module's flash as part of a driver: ``radar.files``."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

from xethru_protocol.driver.link import SLOW_TIMEOUT_S, KindT, Link, Part, Steps, sends, sends_once
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codec import encode
from xethru_protocol.wire.codes import FileError
from xethru_protocol.wire.errors import (
    DeviceError,
    LocalProtocolError,
    RemoteProtocolError,
    XeThruError,
)
from xethru_protocol.wire.framing import NO_ESCAPE_START, is_misread

CHUNK_BYTES = 256  # as the vendor's host reads and writes

OnProgress = Callable[[int, int], None]
T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True, order=True)
class FileName:
    """What a file is known by: a `FileType` or a user-defined type, and a number."""

    file_type: int
    identifier: int

    def __str__(self) -> str:
        """Return type and number as messages show them."""
        return f"{self.file_type:08X}/{self.identifier}"


class Files(Part[KindT]):
    """The file system of a module. Protocol reference 4.11.

    A transfer is not repeated when the line breaks: it raises `Disconnected`.
    """

    __slots__ = ()

    @sends
    def find_all(link: Link) -> Steps[tuple[FileName, ...]]:
        values = (yield from link.request(m.FindAllFiles())).values
        if len(values) % 2:
            raise RemoteProtocolError(
                f"{link.path} lists {len(values)} numbers, no pairs, as files"
            )
        half = len(values) // 2
        return tuple(
            FileName(file_type=kind & 0xFFFFFFFF, identifier=number & 0xFFFFFFFF)
            for kind, number in zip(values[:half], values[half:], strict=True)
        )

    @sends
    def find(link: Link, file_type: int) -> Steps[tuple[FileName, ...]]:
        """List the files of one type; empty if the module answers NOT_FOUND."""
        try:
            values = (yield from link.request(m.SearchFileType(file_type=file_type))).values
        except DeviceError as error:
            if error.code != FileError.NOT_FOUND:
                raise
            values = ()
        return tuple(FileName(file_type=file_type, identifier=one & 0xFFFFFFFF) for one in values)

    @sends
    def length(link: Link, file_type: int, identifier: int) -> Steps[int]:
        """Ask for the size of a file [bytes]."""
        return _file_length(link, file_type, identifier)

    @sends_once
    def read(
        link: Link, file_type: int, identifier: int, on_progress: OnProgress | None = None
    ) -> Steps[bytes]:
        """Read a whole file.

        ``on_progress`` is called with the bytes read so far and their total: at the start and after
        each chunk. Raises `DeviceError`, whose code is a `FileError`, if the file does not exist or
        the module cannot read it.
        """
        total = yield from _file_length(link, file_type, identifier)
        whole = m.GetFileData(file_type=file_type, identifier=identifier, offset=0, length=total)
        return (yield from _read(link, whole, on_progress))

    @sends_once
    def write(
        link: Link,
        file_type: int,
        identifier: int,
        data: bytes,
        on_progress: OnProgress | None = None,
    ) -> Steps[None]:
        """Create a file and write it; if that fails midway it is deleted again.

        User-defined types begin at 80000000h. ``on_progress`` is called with the bytes written so
        far and their total: at the start and after each chunk. Raises `LocalProtocolError` if
        there is nothing to write, `DeviceError` if the file exists already, there is no room, or
        the module cannot write.
        """
        if not data:
            name = FileName(file_type=file_type, identifier=identifier)
            raise LocalProtocolError(f"file {name} must have at least one byte")
        yield from link.request(
            m.CreateFile(file_type=file_type, identifier=identifier, length=len(data)),
            SLOW_TIMEOUT_S,
        )
        whole = m.SetFileData(file_type=file_type, identifier=identifier, offset=0, data=data)
        body = write_chunks(link, whole, on_progress)
        try:
            yield from _then_close(link, file_type, identifier, body)
        except GeneratorExit:
            raise
        except BaseException:
            yield from _clean_up(link, _delete(link, file_type, identifier))
            raise

    @sends_once
    def read_part(
        link: Link, file_type: int, identifier: int, offset: int, count: int
    ) -> Steps[bytes]:
        """Read ``count`` bytes of a file from ``offset`` on."""
        part = m.GetFileData(
            file_type=file_type, identifier=identifier, offset=offset, length=count
        )
        return _read(link, part)

    @sends_once
    def write_part(
        link: Link, file_type: int, identifier: int, offset: int, data: bytes
    ) -> Steps[None]:
        """Write into a file that exists, from ``offset`` on; it does not grow."""
        part = m.SetFileData(file_type=file_type, identifier=identifier, offset=offset, data=data)
        yield from _open(link, file_type, identifier)
        body = write_chunks(link, part)
        yield from _then_close(link, file_type, identifier, body)

    @sends_once
    def create(link: Link, file_type: int, identifier: int, size: int) -> Steps[None]:
        """Create an erased file of ``size`` bytes, for `write_part`."""
        command = m.CreateFile(file_type=file_type, identifier=identifier, length=size)
        yield from link.request(command, SLOW_TIMEOUT_S)
        yield from link.request(m.CloseFile(file_type=file_type, identifier=identifier))

    @sends_once
    def delete(link: Link, file_type: int, identifier: int) -> Steps[None]:
        return _delete(link, file_type, identifier)

    @sends_once
    def format_all(link: Link, key: int) -> Steps[None]:
        """Delete all files, the module's own among them; ``key`` shows that this is meant.

        It is `xethru_protocol.wire.codes.FORMAT_KEY`; the module refuses any other.
        """
        yield from link.request(m.FormatFilesystem(key=key), SLOW_TIMEOUT_S)

    @sends_once
    def crash_dump(link: Link, on_progress: OnProgress | None = None) -> Steps[bytes]:
        """Read what the firmware left when it crashed last; empty if it did not."""
        total = yield from _length(link, m.GetCrashDumpLength(), "its crash dump's length")
        chunk = m.GetCrashDump(offset=0, length=0)
        return (yield from read_chunks(link, chunk, total, on_progress))

    @sends_once
    def clear_crash_dump(link: Link) -> Steps[None]:
        """Delete the crash dump, if there is one."""
        yield from link.request(m.ClearCrashDump(), SLOW_TIMEOUT_S)


def _file_length(link: Link, file_type: int, identifier: int) -> Steps[int]:
    command = m.GetFileLength(file_type=file_type, identifier=identifier)
    return _length(link, command, "a file's length")


def _read(link: Link, part: m.GetFileData, on_progress: OnProgress | None = None) -> Steps[bytes]:
    yield from _open(link, part.file_type, part.identifier)
    body = read_chunks(link, part, part.length, on_progress)
    return (yield from _then_close(link, part.file_type, part.identifier, body))


def _delete(link: Link, file_type: int, identifier: int) -> Steps[None]:
    command = m.DeleteFile(file_type=file_type, identifier=identifier)
    yield from link.request(command, SLOW_TIMEOUT_S)


def _length(link: Link, command: m.Command[m.ReplyInt], what: str) -> Steps[int]:
    values = (yield from link.request(command)).values
    if len(values) != 1 or values[0] < 0:
        raise RemoteProtocolError(f"{link.path} reports {what} as {values}")
    return values[0]


def _open(link: Link, file_type: int, identifier: int) -> Steps[None]:
    command = m.OpenFile(file_type=file_type, identifier=identifier)
    try:
        yield from link.request(command)
    except DeviceError as error:
        if error.code != FileError.ALREADY_OPEN:
            raise
        # an earlier host left it open
        yield from link.request(m.CloseFile(file_type=file_type, identifier=identifier))
        yield from link.request(command)


def read_chunks(
    link: Link,
    chunk: m.GetFileData | m.GetCrashDump,
    total: int,
    on_progress: OnProgress | None = None,
) -> Steps[bytes]:
    """Read ``total`` bytes from where ``chunk`` begins, of a file that is open."""
    data = bytearray()
    while True:
        if on_progress is not None:
            on_progress(len(data), total)
        wanted = min(CHUNK_BYTES, total - len(data))
        if not wanted:
            return bytes(data)
        at = chunk.offset + len(data)
        got = (yield from link.request(replace(chunk, offset=at, length=wanted))).values
        if len(got) != wanted:
            raise RemoteProtocolError(
                f"{link.path} sent {len(got)} bytes from {at} on, not {wanted}"
            )
        data += got


def write_chunks(
    link: Link, part: m.SetFileData, on_progress: OnProgress | None = None
) -> Steps[None]:
    """Write a part of a file that is open."""
    total = len(part.data)
    done = 0
    while done < total:
        if on_progress is not None:
            on_progress(done, total)
        data = bytes(part.data[done : done + CHUNK_BYTES])
        piece = _receivable(replace(part, offset=part.offset + done, data=data))
        yield from link.request(piece, SLOW_TIMEOUT_S)
        done += len(piece.data)
    if on_progress is not None:
        on_progress(total, total)


def _receivable(piece: m.SetFileData) -> m.SetFileData:
    """Return as much of a piece as a module does not misread."""
    begin = piece.data.find(NO_ESCAPE_START)
    if begin >= 0:
        piece = replace(piece, data=piece.data[: begin + len(NO_ESCAPE_START) - 1])
    while is_misread(encode(piece)) and len(piece.data) > 1:  # by its checksum
        piece = replace(piece, data=piece.data[:-1])
    return piece


def _then_close(link: Link, file_type: int, identifier: int, body: Steps[T]) -> Steps[T]:
    """Close the open file after ``body``, also if it fails."""
    close = link.request(m.CloseFile(file_type=file_type, identifier=identifier))
    try:
        result = yield from body
    except GeneratorExit:  # the steps are no longer carried out
        raise
    except BaseException:  # also an interrupt: the module has room for ten open files
        yield from _clean_up(link, close)
        raise
    yield from close
    return result


def _clean_up(link: Link, procedure: Steps[object]) -> Steps[None]:
    """Clean up after a failure; what fails meanwhile is only a warning."""
    try:
        yield from procedure
    except XeThruError as error:
        link.warn(f"could not clean up: {error}")

"""The file of a session: written as things happen, readable wherever writing ends.

A recorder that is killed leaves a file without index, cut anywhere, also inside a compressed
chunk. Everything before the cut is read. A file that is not MCAP, or is damaged in the middle, is
an error of one line.

A chunk is closed and handed to the operating system after 256 KiB or one second, so a killed
process loses its last chunk only. If the disk refuses a chunk the file goes back to the one
before, and one line reports it.
"""

from __future__ import annotations

import contextlib
import os
import stat
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from io import BufferedWriter, FileIO
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from slam.app.errors import AppError
from slam.app.session.messages import schema_text
from xethru_protocol.recordings.mcap import (
    CHUNK_BYTES,
    MAGIC,
    Channel,
    Cut,
    Damage,
    McapWriter,
    Message,
    Metadata,
)
from xethru_protocol.recordings.mcap import read_entries as entries_of

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_KINDS = {
    b"RRF": "a Rerun recording (.rrd), a view that other versions of Rerun may not open; the "
    "record of the run is the session.mcap beside it",
    b"#ROSBAG V2": "a bag of ROS 1; `uwb-slam convert` makes a session of it",
    b"#ROSBAG": "a bag of ROS 1 of an old version; `rosbag migrate` it first",
    b"SQLite format 3\0": "an SQLite file, like those in a rosbag2 folder; give that folder to "
    "`uwb-slam convert`",
    b"\x89XTWIRE": "a wire capture of one port; `xethru dump` reads it",
    b"MATLAB 5.0 MAT-file": "a MATLAB file; `uwb-slam convert` reads detections from it",
    b"\x89HDF": "an HDF5 file",
    b"PK\x03\x04": "a zip archive; unpack it first",
    b"\x1f\x8b": "a gzip file; unpack it first",
    b"\x28\xb5\x2f\xfd": "a zstd file; unpack it first",
}


def describe_kind(path: Path) -> str:
    r"""Return ``, it is ...`` for a file that is known by its first bytes, or what to give instead.

    >>> from tempfile import NamedTemporaryFile
    >>> with NamedTemporaryFile() as file:
    ...     _ = file.write(b"#ROSBAG V2.0\n")
    ...     file.flush()
    ...     describe_kind(Path(file.name))
    ', it is a bag of ROS 1; `uwb-slam convert` makes a session of it'
    """
    if path.is_dir():
        return " with a rosbag2 in it" if (path / "metadata.yaml").exists() else ""
    with path.open("rb") as stream:
        head = stream.read(32)
    if not head:
        return ", it is empty; whatever was to write it ended before it did"
    for magic, kind in _KINDS.items():
        if head.startswith(magic):
            return f", it is {kind}"
    return "; give the session.mcap of a run"


class DamagedFileError(AppError):
    """The file is no MCAP file or damaged; one line with the file, the place and what is wrong."""


@contextmanager
def open_mcap(path: Path, size: int | None = None) -> Iterator[tuple[BinaryIO, int]]:
    """Open a file whose first bytes are those of MCAP; yield it and how much of it to read [bytes].

    That is `size`, if given, of a file that grows.

    Raises
    ------
    DamagedFileError
        Missing, unreadable or not MCAP; the message names the kind of file if it is known.
    """
    with ExitStack() as stack:
        try:
            if stat.S_ISFIFO(path.stat().st_mode):  # opening one waits for who writes into it
                raise DamagedFileError(f"{path}: is a pipe; give a file, the session.mcap of a run")
            stream = stack.enter_context(path.open("rb"))
            if stream.read(len(MAGIC)) != MAGIC:
                raise DamagedFileError(f"{path}: is no MCAP file{describe_kind(path)}")
            whole = os.fstat(stream.fileno()).st_size
        except IsADirectoryError:
            raise DamagedFileError(
                f"{path}: is a directory{describe_kind(path)}; give the session.mcap in it"
            ) from None
        except OSError as error:
            raise _unreadable(path, error) from None
        yield stream, whole if size is None else min(size, whole)


def read_entries(
    path: Path, on_cut: Callable[[int], None], size: int | None = None
) -> Iterator[Metadata | Message]:
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
    with open_mcap(path, size) as (stream, n_bytes):
        try:
            for found in entries_of(stream, n_bytes):
                if isinstance(found, Cut):
                    on_cut(found.at)
                    return
                if isinstance(found, Damage):
                    raise DamagedFileError(
                        f"{path}: damaged at byte {found.at}: {found.reason}; "
                        f"`uwb-slam repair {path}` keeps what is whole"
                    )
                if not isinstance(found, Channel):
                    yield found
        except OSError as error:
            raise _unreadable(path, error) from None


def _unreadable(path: Path, error: OSError) -> DamagedFileError:
    return DamagedFileError(f"{path}: cannot read: {error.strerror or error}")


_CHUNK_NS = 1_000_000_000
# MCAP's message record: opcode, length, channel, sequence, two times.
_RECORD_OVERHEAD_BYTES = 31

_LATCHED_QOS = """\
- history: 1
  depth: 1
  reliability: 1
  durability: 1
  deadline: {sec: 9223372036, nsec: 854775807}
  lifespan: {sec: 9223372036, nsec: 854775807}
  liveliness: 1
  liveliness_lease_duration: {sec: 9223372036, nsec: 854775807}
  avoid_ros_namespace_conventions: false
"""


class CannotWriteError(AppError):
    """The file cannot be written any further; the line describes what is kept."""


class _Disk(FileIO):
    """Writes until `gave_up` is set, and then discards, so that closing succeeds."""

    gave_up = False

    def write(self, data: ReadableBuffer, /) -> int:
        if self.gave_up:
            return memoryview(data).nbytes
        return super().write(data)


class SessionFile:
    """An MCAP file of ROS 2 messages, in chunks that are cut by size and by time.

    Parameters
    ----------
    path
        The file; replaced if it exists.
    start_ns
        Session time [ns] at which the file begins.
    clock_ns
        Monotonic time [ns]; ends chunks.

    Raises
    ------
    CannotWriteError
        The file cannot be made.
    """

    def __init__(
        self, path: Path, *, start_ns: int = 0, clock_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self.path = path
        self._start_ns = start_ns
        self._clock_ns = clock_ns
        try:
            self._disk = _Disk(path, "wb")
        except OSError as error:
            raise CannotWriteError(
                f"{path}: cannot be written: {error.strerror or error}"
            ) from None
        self._stream = BufferedWriter(self._disk)
        # Chunks are cut here, by size and by time; the writer itself knows size only.
        self._writer = McapWriter(self._stream, chunk_bytes=2 * CHUNK_BYTES)
        self._pending_bytes = 0
        self._whole_bytes = 0  # of the file, up to its last whole chunk
        self._newest_ns = self._whole_ns = start_ns
        self._chunk_started_ns = clock_ns()

    def add_metadata(self, name: str, table: Mapping[str, str]) -> None:
        if self._disk.gave_up:
            return
        with self._giving_up():
            self._writer.add_metadata(name, dict(table))

    def channel(self, topic: str, message_type: str, *, latched: bool = False) -> int:
        """Return the number of a new channel; a latched one keeps its last message for all."""
        if self._disk.gave_up:
            return 0
        metadata = {"offered_qos_profiles": _LATCHED_QOS} if latched else {}
        with self._giving_up():
            return self._writer.add_channel(
                topic, message_type, schema_text(message_type), metadata
            )

    def write(
        self,
        channel: int,
        t_ns: int,
        data: bytes | memoryview,
        *,
        sequence: int = 0,
        publish_ns: int | None = None,
    ) -> None:
        """Write a message in CDR at a session time [ns]; ``publish_ns`` is the same if None.

        Raises
        ------
        CannotWriteError
            The disk takes no more. The file is closed, whole chunks stay; what is written from
            then on goes nowhere.
        """
        if self._disk.gave_up:
            return
        size = len(data) + _RECORD_OVERHEAD_BYTES
        late = self._clock_ns() - self._chunk_started_ns >= _CHUNK_NS
        if late or self._pending_bytes + size > CHUNK_BYTES:
            self.cut_chunk()
        self._pending_bytes += size
        self._newest_ns = max(self._newest_ns, t_ns)
        with self._giving_up():
            self._writer.add_message(
                channel_id=channel,
                log_time=t_ns,
                publish_time=t_ns if publish_ns is None else publish_ns,
                sequence=sequence,
                data=data,  # type: ignore[arg-type]  # annotated bytes; it only concatenates
            )

    def cut_chunk(self) -> None:
        """End the chunk here and hand it to the operating system."""
        if self._disk.gave_up:
            return
        with self._giving_up():
            self._writer.end_chunk()
            self._stream.flush()
            self._whole_bytes = self._disk.tell()
        self._whole_ns = self._newest_ns
        self._pending_bytes = 0
        self._chunk_started_ns = self._clock_ns()

    def close(self) -> None:
        """Write index and footer, and close the file; doing so again does nothing.

        Raises
        ------
        CannotWriteError
            The disk takes no more; see `write`.
        """
        if self._stream.closed:
            return
        self.cut_chunk()
        with self._giving_up():
            self._writer.finish()
            self._stream.close()

    @contextlib.contextmanager
    def _giving_up(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            # the bytes of an incomplete chunk are useless, and their room is needed
            with contextlib.suppress(OSError):
                os.ftruncate(self._disk.fileno(), self._whole_bytes)
            self._disk.gave_up = True
            self._stream.close()
            kept = (
                f"its first {(self._whole_ns - self._start_ns) / 1e9:.1f} s are kept there "
                f"without an index: make room, then `uwb-slam repair {self.path}`"
                if self._whole_ns > self._start_ns
                else "nothing was recorded: make room"
            )
            raise CannotWriteError(
                f"{self.path}: cannot be written: {error.strerror or error}; {kept}"
            ) from None

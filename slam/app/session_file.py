"""An MCAP file that is written as things happen and stays readable wherever writing ends.

A chunk is closed and handed to the operating system after 256 KiB or one second, so a killed
process leaves everything but its last chunk. Where the disk refuses a chunk the file goes back to
the one before, and says so in one line.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Iterator, Mapping
from io import BufferedWriter, FileIO
from pathlib import Path
from typing import TYPE_CHECKING

from mcap.writer import CompressionType, Writer

from slam.app import ros_messages as ros
from slam.app.errors import AppError

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

_CHUNK_BYTES = 256 * 1024
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
    """The file cannot be written any further; what was written is kept, the line says how."""


class _Disk(FileIO):
    """Writes until it is told to give up; from then on it swallows, so that closing succeeds."""

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
        self._writer = Writer(
            self._stream, chunk_size=2 * _CHUNK_BYTES, compression=CompressionType.ZSTD
        )
        self._pending_bytes = 0
        self._whole_bytes = 0  # of the file, up to its last whole chunk
        self._newest_ns = self._whole_ns = start_ns
        self._chunk_started_ns = clock_ns()
        self._schemas: dict[str, int] = {}
        self._writer.start(profile="ros2", library="xethru-hil")

    def add_metadata(self, name: str, table: Mapping[str, str]) -> None:
        """Write a named table."""
        if self._disk.gave_up:
            return
        with self._giving_up():
            self._writer.add_metadata(name, dict(table))

    def channel(self, topic: str, message_type: str, *, latched: bool = False) -> int:
        """Return the number of a new channel; a latched one keeps its last message for all."""
        if self._disk.gave_up:
            return 0
        with self._giving_up():
            if message_type not in self._schemas:
                self._schemas[message_type] = self._writer.register_schema(
                    message_type, "ros2msg", ros.schema_text(message_type)
                )
            metadata = {"offered_qos_profiles": _LATCHED_QOS} if latched else {}
            return self._writer.register_channel(
                topic, "cdr", self._schemas[message_type], metadata
            )

    def write(
        self,
        channel: int,
        t_ns: int,
        message: ros.Message,
        *,
        sequence: int = 0,
        publish_ns: int | None = None,
    ) -> None:
        """Write a message at a session time [ns]; ``publish_ns`` is the same unless given.

        Raises
        ------
        CannotWriteError
            The disk takes no more. The file is closed, whole chunks stay; what is written from
            then on goes nowhere.
        """
        if self._disk.gave_up:
            return
        # The writer only concatenates, so the serialiser's memoryview needs no copy.
        data = ros.serialise(message)
        size = len(data) + _RECORD_OVERHEAD_BYTES
        late = self._clock_ns() - self._chunk_started_ns >= _CHUNK_NS
        if late or self._pending_bytes + size > _CHUNK_BYTES:
            self.cut_chunk()
        self._pending_bytes += size
        self._newest_ns = max(self._newest_ns, t_ns)
        with self._giving_up():
            self._writer.add_message(
                channel_id=channel,
                log_time=t_ns,
                publish_time=t_ns if publish_ns is None else publish_ns,
                sequence=sequence,
                data=data,  # type: ignore[arg-type]  # annotated bytes, any buffer works
            )

    def cut_chunk(self) -> None:
        """End the chunk here and hand it to the operating system."""
        if self._disk.gave_up:
            return
        with self._giving_up():
            # A private method: mcap's writer closes a chunk by size only and offers no public way
            # to close it by time. pyproject pins the minor version of mcap for this line; before
            # that is raised, see that the method is still there and still writes the pending
            # chunk. The tests of chunks cut by time and of files never finished fail if not.
            self._writer._Writer__finalize_chunk()  # type: ignore[attr-defined]  # see above
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
            self._writer.finish()  # type: ignore[no-untyped-call]  # mcap annotates in part
            self._stream.close()

    @contextlib.contextmanager
    def _giving_up(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            # Bytes of a chunk that did not fit are of no use to anyone, and their room is.
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

"""Records what drivers receive: one, while the program goes on using it, or several in one file."""

import threading
import time
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self, Unpack

from xethru_protocol.driver.matching import Listeners
from xethru_protocol.recordings.recorded_messages import (
    PieceFile,
    RecordingError,
    optional_packages,
)
from xethru_protocol.recordings.vendor.layouts import KIND_OF_MESSAGE
from xethru_protocol.recordings.vendor.writer import (
    RecordingWriter,
    WriterOptions,
    new_session_id,
    session_directory,
)
from xethru_protocol.wire.table import Response

if TYPE_CHECKING:
    from xethru_protocol.recordings.mcap import RadarTopics


class HasListeners(Protocol):
    """A driver: `listeners` are called with every message and its arrival on its clock [ns]."""

    @property
    def listeners(self) -> Listeners[Response, int]: ...


class Recorder:
    """Records what a driver receives, from `start` to `stop`; a context manager that does both.

    Other listeners of the driver, and other recorders, hear the same. An error of a file ends the
    recording; it is kept in ``failure`` and reported to ``on_error``, not raised: the driver is in
    the middle of receiving.

    Parameters
    ----------
    radar
        The driver, synchronous or with asyncio.
    folder
        Where a new directory for the session is made, named as the vendor's recorder does:
        ``xethru_recording_<local time>_<session id>``.
    kinds
        Types of messages to record; None: all that the format holds.
    on_error
        Called with the error that ended the recording.
    clock
        The driver's clock [ns].
    options
        Those of `RecordingWriter`, such as ``split=Split(seconds=600)``.

    Attributes
    ----------
    kinds
        As given.
    session_id
        Of the recording, empty before `start`.
    directory
        Of the recording, None before `start`.
    messages
        How many were stored.
    failure
        Why nothing more is stored; None if all is well.

    Examples
    --------
    ::

        with X4M300.open(port) as radar, Recorder(radar, "recordings") as recorder:
            radar.configure_raw()
            radar.start(fps=17)
            for frame in radar.frames(1000):
                ...
        print(recorder.directory, recorder.messages)
    """

    def __init__(
        self,
        radar: HasListeners,
        folder: Path | str,
        *,
        kinds: Iterable[type[Response]] | None = None,
        on_error: Callable[[RecordingError], None] | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
        **options: Unpack[WriterOptions],
    ) -> None:
        self.session_id = ""
        self.directory: Path | None = None
        self.messages = 0
        self.failure: RecordingError | None = None
        self._radar = radar
        self._folder = Path(folder)
        self.kinds = None if kinds is None else frozenset(kinds)
        for kind in self.kinds or ():
            if kind not in KIND_OF_MESSAGE:
                raise RecordingError(f"a recording has no file of {kind.__name__}")
        self._on_error = on_error
        self._clock = clock
        self._options = options
        self._since_1970_ns = 0
        self._writer: RecordingWriter | None = None
        # One thread may stop it while another receives; a callback of a file may stop it, too.
        self._lock = threading.RLock()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()

    def start(self) -> None:
        """Make the directory and record from now on; RecordingError if it cannot be made."""
        if self._writer is not None:
            raise RecordingError(f"{self.directory} is being recorded already")
        self._since_1970_ns = time.time_ns() - self._clock()
        options = self._options.copy()
        options["session_id"] = self.session_id = options.get("session_id") or new_session_id()
        self.directory = session_directory(
            self._folder, self.session_id, time.time_ns(), options.get("timezone")
        )
        self._writer = RecordingWriter(self.directory, **options)
        self._radar.listeners.add(self._take)

    def stop(self, *, at_ns: int | None = None) -> None:
        """Complete the files; calling it again does nothing.

        ``at_ns`` is when the recording ends [ns since 1970]; None: with the last message.
        """
        with self._lock:
            writer, self._writer = self._writer, None
            if writer is None:
                return
            self._radar.listeners.remove(self._take)
            try:
                writer.close(stopped_ns=at_ns, closed_ns=at_ns)
            except RecordingError as error:
                self._fail(error)

    def is_recording(self, kind: type[Response] | None = None) -> bool:
        """Whether messages are stored, or those of one type."""
        if self._writer is None or self.failure is not None:
            return False
        return kind is None or self._is_wanted(kind)

    def _is_wanted(self, kind: type[Response]) -> bool:
        return kind in KIND_OF_MESSAGE and (self.kinds is None or kind in self.kinds)

    def _take(self, message: Response, arrival_ns: int) -> None:
        with self._lock:
            if self._writer is not None and self.failure is None and self._is_wanted(type(message)):
                try:
                    self.messages += self._writer.write(message, arrival_ns + self._since_1970_ns)
                    if self.messages == 1 and (about := getattr(self._radar, "description", {})):
                        self._writer.describe(about)
                except RecordingError as error:
                    self._fail(error)

    def _fail(self, error: RecordingError) -> None:
        if self.failure is None:
            self.failure = error
            if self._on_error is not None:
                self._on_error(error)


class SessionRecorder:
    """Writes what several radars send, and lines of other sensors, to one new MCAP file.

    Its methods may be called by several threads. A chunk is handed to the operating system after
    256 KiB or a second, whole or not at all: a process that is killed, or a full disk, costs the
    last one. Needs the extra ``mcap``.

    Parameters
    ----------
    path
        RecordingError if it exists or cannot be made.
    clock
        That of all drivers [ns]; the file has its times since 1970, by the system's clock when the
        file was made.

    Attributes
    ----------
    failure
        Why nothing more is written; None if all is well.
    """

    def __init__(self, path: Path, *, clock: Callable[[], int] = time.monotonic_ns) -> None:
        with optional_packages():
            from xethru_protocol.recordings import mcap
        self._mcap = mcap
        self.path = path
        self.failure: RecordingError | None = None
        self._clock = clock
        self._since_1970_ns = time.time_ns() - clock()
        self._flushed_ns = clock()
        self._lock = threading.Lock()
        self._closed = False
        self._pieces = PieceFile(path)
        self._writer = mcap.McapWriter(self._pieces)
        self._pieces.hand_over()
        self._radars: dict[str, RadarTopics] = {}
        self._texts: dict[str, int] = {}

    def add_radar(self, name: str, about: Mapping[str, Any]) -> None:
        """Name a radar before its first message; ``about`` is by the names in its info topic."""
        self._radars[name] = self._mcap.RadarTopics(self._writer, name, about)

    def add_text(self, name: str) -> None:
        """Name a column of text before its first line."""
        schema = self._mcap.SCHEMAS[self._mcap.STRING].encode()
        topic = f"{self._mcap.TEXT_TOPIC}{name}"
        self._texts[name] = self._writer.add_channel(topic, self._mcap.STRING, schema, {})

    def write(self, name: str, message: Response, arrival_ns: int) -> bool:
        """Write what a radar sent; returns whether that went well."""
        t_ns = arrival_ns + self._since_1970_ns
        return self._write(lambda: self._radars[name].write(message, t_ns))

    def write_line(self, name: str, line: str, arrival_ns: int) -> bool:
        """Write a line of another sensor; returns whether that went well."""
        t_ns = arrival_ns + self._since_1970_ns
        data = self._mcap.pack_string(line)
        return self._write(lambda: self._writer.add_message(self._texts[name], t_ns, data, t_ns))

    def close(self) -> None:
        """Complete the file; calling it again does nothing."""
        self._write(self._writer.finish, is_last=True)
        with self._lock:
            self._closed = True
            self._pieces.close()

    def _write(self, write: Callable[[], None], *, is_last: bool = False) -> bool:
        """Write, and hand to the operating system what is due; nothing after a failure."""
        with self._lock:
            if self._closed or self.failure is not None:
                return False
            try:
                write()
                now_ns = self._clock()
                if now_ns - self._flushed_ns >= _CHUNK_NS and not is_last:
                    self._flushed_ns = now_ns
                    self._writer.end_chunk()
                self._pieces.hand_over()
            except RecordingError as error:
                self.failure = error
            return self.failure is None


_CHUNK_NS = 1_000_000_000

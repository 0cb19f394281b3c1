"""Records what a driver receives while the program goes on using it."""

import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Protocol, Self, Unpack

from xethru_protocol.driver.conversation import Listener
from xethru_protocol.recordings.records import RecordingError
from xethru_protocol.recordings.vendor.layouts import KIND_OF_MESSAGE
from xethru_protocol.recordings.vendor.writer import (
    RecordingOptions,
    RecordingWriter,
    new_session_id,
    session_directory,
)
from xethru_protocol.wire.rows import Response


class HasListener(Protocol):
    """A driver: `listener` is called with every message and its arrival on its clock [ns]."""

    listener: Listener | None


class Recorder:
    """Records what a driver receives, from `start` to `stop`; a context manager that does both.

    Messages go on to the listener that the driver had. An error of a file ends the recording; it is
    kept in ``failure`` and reported to ``on_error``, not raised: the driver is in the middle of
    receiving.

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
        radar: HasListener,
        folder: Path | str,
        *,
        kinds: Iterable[type[Response]] | None = None,
        on_error: Callable[[RecordingError], None] | None = None,
        clock: Callable[[], int] = time.monotonic_ns,
        **options: Unpack[RecordingOptions],
    ) -> None:
        self.directory: Path | None = None
        self.messages = 0
        self.failure: RecordingError | None = None
        self._radar = radar
        self._folder = Path(folder)
        self._kinds = None if kinds is None else frozenset(kinds)
        for kind in self._kinds or ():
            if kind not in KIND_OF_MESSAGE:
                raise RecordingError(f"a recording has no file of {kind.__name__}")
        self._on_error = on_error
        self._clock = clock
        self._options = options
        self._since_1970_ns = 0
        self._writer: RecordingWriter | None = None
        self._before: Listener | None = None
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
        options["session_id"] = session_id = options.get("session_id") or new_session_id()
        self.directory = session_directory(
            self._folder, session_id, time.time_ns(), options.get("timezone")
        )
        self._writer = RecordingWriter(self.directory, **options)
        if self._radar.listener != self._take:  # one that stayed behind another recorder's
            self._before = self._radar.listener
            self._radar.listener = self._take

    def stop(self) -> None:
        """Complete the files; calling it again does nothing."""
        with self._lock:
            writer, self._writer = self._writer, None
            if writer is None:
                return
            if self._radar.listener == self._take:
                self._radar.listener = self._before
            try:
                writer.close()
            except RecordingError as error:
                self._fail(error)

    def is_recording(self, kind: type[Response] | None = None) -> bool:
        """Whether messages are stored, or those of one type."""
        if self._writer is None or self.failure is not None:
            return False
        return kind is None or self._is_wanted(kind)

    def _is_wanted(self, kind: type[Response]) -> bool:
        return kind in KIND_OF_MESSAGE and (self._kinds is None or kind in self._kinds)

    def _take(self, message: Response, arrival_ns: int) -> None:
        with self._lock:
            if self._writer is not None and self.failure is None and self._is_wanted(type(message)):
                try:
                    self.messages += self._writer.write(message, arrival_ns + self._since_1970_ns)
                except RecordingError as error:
                    self._fail(error)
        if self._before is not None:
            self._before(message, arrival_ns)

    def _fail(self, error: RecordingError) -> None:
        if self.failure is None:
            self.failure = error
            if self._on_error is not None:
                self._on_error(error)

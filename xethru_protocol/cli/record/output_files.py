"""The files of one module: a directory in the vendor's format, a wire capture, or both."""

import time
from argparse import Namespace
from collections.abc import Mapping
from copy import deepcopy
from pathlib import Path
from typing import Any, Literal, Self

from xethru_protocol.cli.output import (
    bytes_text,
    counted,
    rate_text,
)
from xethru_protocol.cli.record.modes import ANSWERS
from xethru_protocol.cli.recordings import (
    files_to_replace,
    remove_older,
    remove_unfinished,
)
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.recordings import (
    RecordingError,
    RecordingWriter,
    Split,
    WireCapture,
    WriterOptions,
    session_directory,
)
from xethru_protocol.recordings.vendor.layouts import KINDS
from xethru_protocol.recordings.vendor.writer import new_session_id
from xethru_protocol.validation import shown
from xethru_protocol.wire.errors import (
    XeThruError,
)
from xethru_protocol.wire.framing import LinkStatistics
from xethru_protocol.wire.table import Response


class RecordingFiles:
    """Writes what a driver receives to files.

    Files are made, and older ones removed, only by `open`: a module that does not answer must
    not cost an older recording. Bytes that come before that are kept until then.

    An error of a file is kept in ``failure``, not raised: the caller is in the middle of
    receiving.
    """

    def __init__(
        self, arguments: Namespace, profile_id: int | None, options: WriterOptions
    ) -> None:
        self.messages = 0  # taken
        self.failure: XeThruError | None = None  # why nothing more is written
        self._session_id = arguments.session_id or new_session_id()
        self._options = options
        self._directory = Path(arguments.out) if arguments.out else None
        if self._directory is not None and arguments.new_directory:
            self._directory = session_directory(self._directory, self._session_id, time.time_ns())
        self._wire_path = Path(arguments.wire) if arguments.wire else None
        paths = (self._directory, self._wire_path)
        self.paths = tuple(path for path in paths if path is not None)
        self._arguments = arguments
        self._profile_id = profile_id
        self._statistics = LinkStatistics()
        self._began_ns = self._newest_ns = time.monotonic_ns()
        self._since_1970_ns = time.time_ns() - self._began_ns
        self._early: list[tuple[Literal["rx", "tx"], bytes, int]] | None = []
        self._were_there: dict[Path, bool] = {}
        self._writer: RecordingWriter | None = None
        self._wire: WireCapture | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        """Complete the files, however it ended; files without records are removed."""
        for file in (self._writer, self._wire):
            try:
                if file is not None:
                    file.close()
            except RecordingError as failure:
                self.fail(failure)
        if not self.messages:
            # the wire capture first: it may lie in the directory
            for path, was_there in reversed(self._were_there.items()):
                remove_unfinished(path, was_there=was_there)

    def check(self) -> None:
        """Raise RecordingError if something is in the way and must stay."""
        directory, wire = self._directory, self._wire_path
        if directory is not None and directory.exists() and not directory.is_dir():
            raise RecordingError(f"{directory} is not a directory; name a new one")
        if wire is not None and wire.is_dir():
            raise RecordingError(f"{wire} is a directory; name a file in it")
        files_to_replace(self.paths, replace=self._arguments.force)

    def open(self, parameter_file: bytes | None = None) -> None:
        """Remove older files if that is allowed, and make new ones; RecordingError if not."""
        remove_older(self.paths, replace=self._arguments.force)
        self._were_there = {path: path.exists() for path in self.paths}
        if self._directory is not None:
            options = self._options.copy()
            options["session_id"] = self._session_id
            options["profile_id"] = self._profile_id
            options["parameter_file"] = parameter_file
            self._writer = RecordingWriter(self._directory, **options)
        if self._wire_path is not None:
            self._wire = WireCapture(self._wire_path, {"port": self._arguments.port})
        early, self._early = self._early or [], None
        for received in early:
            self.take_bytes(*received)

    def describe(self, about: Mapping[str, Any]) -> None:
        """Store what is known of the module, by the names in an MCAP file's info."""
        if self._writer is not None and about:
            try:
                self._writer.describe(about)
            except RecordingError as error:
                self.fail(error)

    def listen_to(self, radar: X4M300) -> None:
        """Take the module's messages from now on; the time of the recording begins."""
        self._statistics = radar.statistics
        self._began_ns = self._newest_ns = time.monotonic_ns()
        radar.listeners.add(self.take)

    def stop_listening(self, radar: X4M300) -> None:
        """Take nothing more; what the module sends while it is stopped is not recorded."""
        radar.listeners.remove(self.take)
        self._statistics = deepcopy(radar.statistics)

    def fail(self, error: XeThruError) -> None:
        """Take nothing more; the first reason is the one that counts."""
        self.failure = self.failure or error

    def take(self, message: Response, arrival_ns: int) -> None:
        """Write a message, if it is of a kind that a recording holds."""
        if self.is_enough or isinstance(message, ANSWERS):
            return
        try:
            if self._writer is None or self._writer.write(
                message, arrival_ns + self._since_1970_ns
            ):
                self.messages += 1
                self._newest_ns = arrival_ns
        except RecordingError as error:
            self.fail(error)

    def take_bytes(self, direction: Literal["rx", "tx"], data: bytes, t_ns: int) -> None:
        if self._early is not None and self._wire_path is not None:
            self._early.append((direction, bytes(data), t_ns))
        if self._wire is None or self.failure is not None:
            return
        try:
            self._wire.write(direction, data, t_ns + self._since_1970_ns)
        except RecordingError as error:
            self.fail(error)

    @property
    def is_enough(self) -> bool:
        """Whether nothing more will be taken."""
        count = self._arguments.count
        return self.failure is not None or (count is not None and self.messages >= count)

    @property
    def elapsed_s(self) -> float:
        return (time.monotonic_ns() - self._began_ns) * 1e-9

    @property
    def silent_s(self) -> float:
        return (time.monotonic_ns() - self._newest_ns) * 1e-9

    def numbers(self) -> str:
        span_s = (self._newest_ns - self._began_ns) * 1e-9
        return (
            f"{counted(self.messages, 'message')} in {span_s:.1f} s"
            f"{rate_text(self.messages, span_s)}, "
            f"{bytes_text(self._statistics.bytes)}, {self._statistics.frames_lost} lost"
        )

    def summary(self) -> dict[str, Any]:
        return {
            "directory": None if self._directory is None else str(self._directory),
            "wire": None if self._wire_path is None else str(self._wire_path),
            "messages": self.messages,
            "duration_s": (self._newest_ns - self._began_ns) * 1e-9,
            "link": self._statistics.summary(),
        }


def writer_options(arguments: Namespace) -> WriterOptions:
    """Return the parameters of `RecordingWriter`; ends the program on wrong usage."""
    limits = (
        {name: min(value for key, value in given if key == name) for name, _ in given}
        for given in (arguments.split_files, arguments.split_directories)
    )
    split, directories = (Split(**found) if found else None for found in limits)
    kinds = {kind.name: kind.message for kind in KINDS}
    for name, _ in arguments.basename:
        if name not in kinds:
            arguments.refuse(
                f"--basename: no data files are called {shown(name)}; {', '.join(kinds)}"
            )
    options: WriterOptions = {
        "user_header": arguments.user_header.encode(),
        "split": split,
        "split_directories": directories,
        "basenames": {kinds[kind]: name for kind, name in arguments.basename},
        "interval_s": arguments.interval,
        "flush_on_write": arguments.flush_on_write,
    }
    if arguments.out is None and (any(options.values()) or arguments.new_directory):
        arguments.refuse("options of the vendor's format need --out DIR")
    return options

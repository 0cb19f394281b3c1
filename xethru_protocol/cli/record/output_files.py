"""The files of one module: a directory in the vendor's format, a wire capture, or both."""

import time
from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

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
from xethru_protocol.wire.table import Response


class ModuleFiles:
    """Writes what one module sends, as `SessionRecorder` does for several.

    Files are made by `open`; bytes that come before that are kept until then. An error of a file is
    kept in ``failure``, not raised: the caller is in the middle of receiving.
    """

    def __init__(
        self, arguments: Namespace, profile_id: int | None, options: WriterOptions
    ) -> None:
        self.failure: RecordingError | None = None  # why nothing more is written
        self.directory = Path(arguments.out) if arguments.out else None
        self.wire_path = Path(arguments.wire) if arguments.wire else None
        self._options = options
        self._options["session_id"] = session_id = arguments.session_id or new_session_id()
        self._options["profile_id"] = profile_id
        if self.directory is not None and arguments.new_directory:
            self.directory = session_directory(self.directory, session_id, time.time_ns())
        self._since_1970_ns = time.time_ns() - time.monotonic_ns()
        self._early: list[tuple[Literal["rx", "tx"], bytes, int]] | None = []
        self._writer: RecordingWriter | None = None
        self._wire: WireCapture | None = None

    def check(self) -> None:
        """Raise RecordingError if something else is where the files shall be."""
        directory, wire = self.directory, self.wire_path
        if directory is not None and directory.exists() and not directory.is_dir():
            raise RecordingError(f"{directory} is not a directory; name a new one")
        if wire is not None and wire.is_dir():
            raise RecordingError(f"{wire} is a directory; name a file in it")

    def open(self, port: str, parameter_file: bytes | None) -> None:
        """Make the files; RecordingError if that fails."""
        if self.directory is not None:
            self._options["parameter_file"] = parameter_file
            self._writer = RecordingWriter(self.directory, **self._options)
        if self.wire_path is not None:
            self._wire = WireCapture(self.wire_path, {"port": port})
        early, self._early = self._early or [], None
        for received in early:
            self.take_bytes(*received)

    def close(self) -> None:
        """Complete the files."""
        for file in (self._writer, self._wire):
            try:
                if file is not None:
                    file.close()
            except RecordingError as error:
                self._fail(error)

    def add_radar(self, name: str, about: Mapping[str, Any]) -> None:
        """Store what is known of the module, by the names in an MCAP file's info."""
        if self._writer is not None and about:
            try:
                self._writer.describe(about)
            except RecordingError as error:
                self._fail(error)

    def write(self, name: str, message: Response, arrival_ns: int) -> bool:
        """Write a message; returns whether that went well, and the files have a place for it."""
        try:
            return self.failure is None and (
                self._writer is None
                or self._writer.write(message, arrival_ns + self._since_1970_ns)
            )
        except RecordingError as error:
            self._fail(error)
            return False

    def take_bytes(self, direction: Literal["rx", "tx"], data: bytes, t_ns: int) -> None:
        if self._early is not None and self.wire_path is not None:
            self._early.append((direction, bytes(data), t_ns))
        if self._wire is None or self.failure is not None:
            return
        try:
            self._wire.write(direction, data, t_ns + self._since_1970_ns)
        except RecordingError as error:
            self._fail(error)

    def _fail(self, error: RecordingError) -> None:
        self.failure = self.failure or error


def writer_options(arguments: Namespace, *, has_directory: bool) -> WriterOptions:
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
    if not has_directory and (any(options.values()) or arguments.new_directory):
        arguments.refuse("options of the vendor's format need --out DIR")
    return options

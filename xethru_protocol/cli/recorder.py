"""Files that take what a driver hears, until they are full or it is enough."""

import time
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from xethru_protocol.cli.output import one_line
from xethru_protocol.cli.overwriting import make_room, remove_unfinished, what_must_go
from xethru_protocol.cli.progress import bytes_text, counted
from xethru_protocol.driver import X4M300
from xethru_protocol.errors import XeThruError
from xethru_protocol.messages import (
    Ack,
    Error,
    Pong,
    ReplyByte,
    ReplyFloat,
    ReplyInt,
    ReplyNone,
    ReplyString,
    ReplyUser,
    Response,
    System,
)
from xethru_protocol.recordings import RecordingError, RecordingWriter, WireCapture
from xethru_protocol.statistics import LinkStatistics

_ANSWERS = (
    *(Ack, Error, Pong, System),
    *(ReplyByte, ReplyFloat, ReplyInt, ReplyNone, ReplyString, ReplyUser),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Targets:
    """Where a recording goes.

    Attributes
    ----------
    directory
        For the vendor's format; None: not wanted.
    wire
        File for all bytes of both directions; None: not wanted.
    session_id
        Name kept in the vendor's format.
    profile_id
        Profile that runs, kept in the vendor's format; None: none, or not known.
    port
        Where the module is, kept in the wire capture.
    """

    directory: Path | None
    wire: Path | None
    session_id: str = ""
    profile_id: int | None = None
    port: str = ""

    @property
    def text(self) -> str:
        """Both names, for people."""
        return " and ".join(one_line(str(path)) for path in self.paths)

    @property
    def paths(self) -> tuple[Path, ...]:
        """What there is of both."""
        return tuple(path for path in (self.directory, self.wire) if path is not None)

    def check(self, *, replace: bool) -> None:
        """Raise RecordingError if something is in the way and must stay."""
        if self.directory is not None and self.directory.exists() and not self.directory.is_dir():
            raise RecordingError(f"{self.directory} is no directory; name a new one")
        if self.wire is not None and self.wire.is_dir():
            raise RecordingError(f"{self.wire} is a directory; name a file in it")
        what_must_go(self.paths, replace=replace)


class Recorder:
    """Writes down what a driver hears.

    Files are made, and older ones removed, only by `open`: a module that does not answer must
    cost nobody an older recording. Bytes that come before that are kept until then.

    An error of a file is kept, not raised: whoever calls is in the middle of receiving.

    Parameters
    ----------
    targets
        Where to.
    count
        Messages after which it is enough; None: never.

    Attributes
    ----------
    messages
        Messages taken.
    failure
        Why nothing more is written; None: all is well.
    """

    def __init__(self, targets: Targets, count: int | None) -> None:
        self.messages = 0
        self.failure: XeThruError | None = None
        self._targets = targets
        self._count = count
        self._statistics = LinkStatistics()
        self._began_ns = self._newest_ns = time.monotonic_ns()
        self._since_1970_ns = time.time_ns() - self._began_ns
        self._early: list[tuple[Literal["rx", "tx"], bytes, int]] | None = []
        self._were_there: dict[Path, bool] = {}
        self._writer: RecordingWriter | None = None
        self._wire: WireCapture | None = None

    def __enter__(self) -> Self:
        """Return the recorder itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Complete the files, however it ended; what was recorded into none goes."""
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

    def open(self, *, replace: bool) -> None:
        """Make the files.

        Raises
        ------
        RecordingError
            If something is in the way and must stay, or a file cannot be made.
        """
        targets = self._targets
        make_room(targets.paths, replace=replace)
        self._were_there = {path: path.exists() for path in targets.paths}
        if targets.directory is not None:
            self._writer = RecordingWriter(
                targets.directory,
                session_id=targets.session_id,
                profile_id=targets.profile_id,
            )
        if targets.wire is not None:
            self._wire = WireCapture(targets.wire, {"port": targets.port})
        early, self._early = self._early or [], None
        for heard in early:
            self.take_bytes(*heard)

    def listen_to(self, radar: X4M300) -> None:
        """Take the module's messages from now on; the time of the recording begins."""
        self._statistics = radar.statistics
        self._began_ns = self._newest_ns = time.monotonic_ns()
        radar.listener = self.take

    def stop_listening(self, radar: X4M300) -> None:
        """Take nothing more; what the module says while it is stopped counts for nothing."""
        radar.listener = None
        self._statistics = deepcopy(radar.statistics)

    def fail(self, error: XeThruError) -> None:
        """Take nothing more; the first reason is the one that counts."""
        self.failure = self.failure or error

    def take(self, message: Response, arrival_ns: int) -> None:
        """Write a message, if it is of a kind that a recording holds."""
        if self.is_enough or isinstance(message, _ANSWERS):
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
        """Write bytes of the line."""
        if self._early is not None and self._targets.wire is not None:
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
        return self.failure is not None or (
            self._count is not None and self.messages >= self._count
        )

    @property
    def elapsed_s(self) -> float:
        """Time since the recording began."""
        return (time.monotonic_ns() - self._began_ns) * 1e-9

    @property
    def silent_s(self) -> float:
        """Time since the newest message."""
        return (time.monotonic_ns() - self._newest_ns) * 1e-9

    def numbers(self) -> str:
        """Say what was recorded so far, for people."""
        span_s = (self._newest_ns - self._began_ns) * 1e-9
        rate = f", {self.messages / span_s:.1f}/s" if span_s > 0 else ""
        return (
            f"{counted(self.messages, 'message')} in {span_s:.1f} s{rate}, "
            f"{bytes_text(self._statistics.bytes)}, {self._statistics.frames_lost} lost"
        )

    def summary(self) -> dict[str, Any]:
        """Say what was recorded, as JSON."""
        directory, wire = self._targets.directory, self._targets.wire
        return {
            "directory": None if directory is None else str(directory),
            "wire": None if wire is None else str(wire),
            "messages": self.messages,
            "duration_s": (self._newest_ns - self._began_ns) * 1e-9,
            "link": self._statistics.summary(),
        }

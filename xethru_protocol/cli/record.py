"""``xethru record``: what a module sends, written to files as it comes.

Whatever ends it, the recording is closed and complete: a signal only asks for the end, so that
none comes while a record is half written; a second one insists.
"""

import time
from argparse import Namespace
from contextlib import suppress
from copy import deepcopy
from pathlib import Path
from typing import Any, Literal, Self

from xethru_protocol.cli.arguments import raw_config
from xethru_protocol.cli.output import (
    CommandFailed,
    Progress,
    bytes_text,
    counted,
    module_at,
    one_line,
    print_json,
    print_line,
    print_warnings,
    warn,
)
from xethru_protocol.cli.recordings import files_to_replace, remove_unfinished
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.recordings import RecordingError, RecordingWriter, WireCapture
from xethru_protocol.system import StopFlag
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import ProfileId
from xethru_protocol.wire.errors import ResponseTimeout, XeThruError
from xethru_protocol.wire.framing import LinkStatistics
from xethru_protocol.wire.rows import Response

_FRAMES_AT_ONCE = 100


class Listen:
    """How to get a module to send what is recorded: here, whatever it sends by itself."""

    profile_id: int | None = None  # that runs then; None if there is none, or it is not known

    def prepare(self, radar: X4M300) -> None:
        """Bring the module to where it sends nothing yet; what comes meanwhile is old."""

    def start(self, radar: X4M300) -> float:
        """Let it send; returns after how much silence [s] something must be wrong."""
        return float("inf")

    def wait(self, radar: X4M300, timeout_s: float) -> None:
        """Receive until a frame came or the time is over; other messages are not kept."""
        with suppress(ResponseTimeout):
            radar.read_frame(timeout_s)


class RawFrames(Listen):
    """Radar frames of raw mode."""

    def __init__(self, config: RawConfig, fps: float) -> None:
        self._config = config
        self._fps = fps

    def prepare(self, radar: X4M300) -> None:
        radar.configure_raw(self._config)

    def start(self, radar: X4M300) -> float:
        return max(2.0, 3.0 / radar.start(self._fps))


class Presence(Listen):
    """Messages of the X4M300's own profile, about one a second."""

    profile_id = ProfileId.XTS_ID_APP_PRESENCE_2

    def prepare(self, radar: X4M300) -> None:
        radar.profile.load()

    def start(self, radar: X4M300) -> float:
        radar.profile.run()
        return 10.0

    def wait(self, radar: X4M300, timeout_s: float) -> None:
        """Take a message, and the frames that the profile sends if its outputs are on."""
        with suppress(ResponseTimeout):
            radar.read_message(m.Response, timeout_s)
        with suppress(ResponseTimeout):
            for _ in radar.frames(_FRAMES_AT_ONCE, timeout_s=0.0):
                pass


_ANSWERS = (
    *(m.Ack, m.Error, m.Pong, m.System),
    *(m.ReplyByte, m.ReplyFloat, m.ReplyInt, m.ReplyNone, m.ReplyString, m.ReplyUser),
)


class Recorder:
    """Writes what a driver receives to files.

    Files are made, and older ones removed, only by `open`: a module that does not answer must
    not cost an older recording. Bytes that come before that are kept until then.

    An error of a file is kept in ``failure``, not raised: the caller is in the middle of
    receiving.
    """

    def __init__(self, arguments: Namespace, profile_id: int | None) -> None:
        self.messages = 0  # taken
        self.failure: XeThruError | None = None  # why nothing more is written
        self._directory = Path(arguments.out) if arguments.out else None
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

    def check(self) -> None:
        """Raise RecordingError if something is in the way and must stay."""
        directory, wire = self._directory, self._wire_path
        if directory is not None and directory.exists() and not directory.is_dir():
            raise RecordingError(f"{directory} is no directory; name a new one")
        if wire is not None and wire.is_dir():
            raise RecordingError(f"{wire} is a directory; name a file in it")
        files_to_replace(self.paths, replace=self._arguments.force)

    def open(self) -> None:
        """Remove older files if that is allowed, and make new ones; RecordingError if not."""
        for path in files_to_replace(self.paths, replace=self._arguments.force):
            try:
                path.unlink()
            except OSError as error:
                raise RecordingError(f"{path} cannot be removed: {error.strerror}") from None
        self._were_there = {path: path.exists() for path in self.paths}
        if self._directory is not None:
            session_id = self._arguments.session_id
            self._writer = RecordingWriter(
                self._directory, session_id=session_id, profile_id=self._profile_id
            )
        if self._wire_path is not None:
            self._wire = WireCapture(self._wire_path, {"port": self._arguments.port})
        early, self._early = self._early or [], None
        for received in early:
            self.take_bytes(*received)

    def listen_to(self, radar: X4M300) -> None:
        """Take the module's messages from now on; the time of the recording begins."""
        self._statistics = radar.statistics
        self._began_ns = self._newest_ns = time.monotonic_ns()
        radar.listener = self.take

    def stop_listening(self, radar: X4M300) -> None:
        """Take nothing more; what the module sends while it is stopped is not recorded."""
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
        rate = f", {self.messages / span_s:.1f}/s" if span_s > 0 else ""
        return (
            f"{counted(self.messages, 'message')} in {span_s:.1f} s{rate}, "
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


_POLL_S = 0.2  # how late a signal, or the end, may be noticed


def record(arguments: Namespace) -> int:
    """Record until ``--count``, ``--duration``, a signal, unplugging or a full disk."""
    config = raw_config(arguments)
    if arguments.out is None and arguments.wire is None:
        arguments.refuse("--out DIR is missing, or --wire FILE, or both")
    if arguments.out == arguments.wire:
        arguments.refuse("--out and --wire must not be the same")
    mode = Listen()
    if arguments.profile == "raw":
        mode = RawFrames(config=config, fps=arguments.fps)
    elif arguments.profile == "presence":
        mode = Presence()
    stop = StopFlag("previous")
    with Recorder(arguments, mode.profile_id) as recorder:
        recorder.check()
        try:
            with module_at(arguments.port, arguments.baudrate) as radar:
                radar.raw_listener = recorder.take_bytes
                mode.prepare(radar)
                print_warnings(radar)
                recorder.open()
                with stop:
                    _record_from(radar, recorder, mode, arguments.duration, stop)
        except XeThruError as error:
            recorder.fail(error)
    targets = " and ".join(one_line(str(path)) for path in recorder.paths)
    if arguments.json:
        print_json(recorder.summary() | {"ended_by": _end(recorder, stop)})
    elif recorder.failure is None and recorder.messages:
        print_line(f"{targets}: {recorder.numbers()}")
    elif recorder.failure is None:
        warn("xethru record: nothing came, so nothing was written")
    if recorder.failure is not None:
        text = str(recorder.failure)
        if recorder.messages:
            text += f"; kept {counted(recorder.messages, 'message')} in {targets}"
        if stop.received is None:
            raise CommandFailed(text)
        warn(f"xethru record: {one_line(text)}")
    return 0 if stop.received is None else 128 + stop.received


def _record_from(
    radar: X4M300, recorder: Recorder, mode: Listen, duration_s: float | None, stop: StopFlag
) -> None:
    progress = Progress("xethru record")
    recorder.listen_to(radar)
    try:
        silence_s = mode.start(radar)
        print_warnings(radar)
        while not (stop.requested or recorder.is_enough):
            if duration_s is not None and recorder.elapsed_s >= duration_s:
                if not recorder.messages:
                    raise ResponseTimeout(f"the module sent nothing to record in {duration_s:g} s")
                break
            if recorder.silent_s > silence_s:
                likely = "it has restarted meanwhile" if radar.reboots else "did it stop?"
                raise ResponseTimeout(
                    f"the module sent nothing to record for {silence_s:g} s; {likely}"
                )
            left_s = _POLL_S if duration_s is None else duration_s - recorder.elapsed_s
            mode.wait(radar, min(_POLL_S, left_s))  # the recorder gets what comes
            progress.show(recorder.numbers)
    finally:
        recorder.stop_listening(radar)
        progress.finish(recorder.numbers)


def _end(recorder: Recorder, stop: StopFlag) -> str:
    if recorder.failure is not None:
        return "failure"
    if stop.requested:
        return "signal"
    return "count" if recorder.is_enough else "duration"

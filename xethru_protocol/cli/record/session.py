"""What is recorded and until when: modules, and lines of other sensors."""

import os
import re
import select
import threading
import time
from argparse import Namespace
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from copy import copy
from pathlib import Path
from typing import Any

from xethru_protocol.cli.output import (
    CommandFailed,
    Progress,
    bytes_text,
    counted,
    module_at,
    print_warnings,
    rate_text,
    warn,
)
from xethru_protocol.cli.record.modes import POLL_S, Listen
from xethru_protocol.cli.record.output_files import ModuleFiles
from xethru_protocol.cli.recordings import files_to_replace, remove_older, remove_unfinished
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.operating_system import StopFlag
from xethru_protocol.recordings import SessionRecorder, WriterOptions
from xethru_protocol.transport import open_line
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.errors import ResponseTimeout, XeThruError
from xethru_protocol.wire.framing import LinkStatistics
from xethru_protocol.wire.table import Response

_ONLY_IN_WIRE_CAPTURES = (*m.ANSWERS, m.System, m.ReplyNone, m.ReplyUser)
_LONGEST_LINE = 65536  # bytes; a line without end is cut there


class _Source(threading.Thread):
    """A module or a text column while it is recorded."""

    noun = ""

    def __init__(self, session: "Session", name: str, port: str) -> None:
        super().__init__(name=name)
        self.session = session
        self.port = port
        self.recorded = 0
        self.failure: XeThruError | None = None
        self.crash: Exception | None = None  # what nobody expected; raised where the session waits

    def fail(self, error: XeThruError) -> None:
        """Keep the reason of the end; of the only module it is raised, else it is reported here."""
        self.failure = self.failure or error
        if self.session.is_of_one:
            return
        others = any(each.is_alive() for each in self.session.modules if each is not self)
        kept = f"{counted(self.recorded, self.noun)} kept"
        warn(f"xethru record: {self.name}: {error}; {kept}{'; the others go on' * others}")

    def numbers(self) -> str:
        return f"{self.name} {counted(self.recorded, self.noun)}"

    def summary(self) -> dict[str, Any]:
        failure = None if self.failure is None else str(self.failure)
        return {"port": self.port, f"{self.noun}s": self.recorded, "failure": failure}

    def run(self) -> None:
        try:
            self._record()
        except XeThruError as error:
            self.fail(error)
        except Exception as error:
            self.crash = error

    def _record(self) -> None:
        raise NotImplementedError


class _RecordedModule(_Source):
    noun = "message"

    def __init__(self, session: "Session", name: str, port: str, mode: Listen) -> None:
        super().__init__(session, name, port)
        self.statistics = LinkStatistics()
        self.mode = mode
        self._about: dict[str, Any] = {}
        self._silence_s = float("inf")
        self._began_ns = self._newest_ns = time.monotonic_ns()
        # before it is described, which a file of several radars needs first
        self._early: list[tuple[Response, int]] | None = None if session.is_of_one else []

    @property
    def span_s(self) -> float:
        """Time to the newest message."""
        return (self._newest_ns - self._began_ns) * 1e-9

    def open(self, opened: ExitStack, arguments: Namespace) -> None:
        """Bring it to where it sends nothing yet."""
        self._radar: X4M300 = opened.enter_context(module_at(self.port, arguments.baudrate))
        self.statistics = self._radar.statistics
        if isinstance(self.session.recorder, ModuleFiles):
            self._radar.raw_listeners.add(self.session.recorder.take_bytes)
        self.mode.prepare(self._radar)
        if not self.session.is_of_one:
            serial = None if arguments.profile == "none" else self._radar.info().serial_number
            self._about = {"serial": serial or "", "port": self.port}
        print_warnings(self._radar)

    def let_it_send(self, opened: ExitStack) -> None:
        """Start what it sends, which is recorded from now on until it is closed."""
        self._began_ns = self._newest_ns = time.monotonic_ns()
        self._radar.listeners.add(self._take)
        opened.callback(self._radar.listeners.remove, self._take)
        try:
            self._silence_s = self.mode.start(self._radar)
        finally:
            print_warnings(self._radar)
        about = self._about | self.mode.about(self._radar)
        self.session.opened_recorder.add_radar(self.name, about)
        early, self._early = self._early or [], None
        for message, arrival_ns in early:
            self._take(message, arrival_ns)

    def numbers(self) -> str:
        rate = rate_text(self.recorded, self.span_s)
        return f"{super().numbers()}{rate}, {self.statistics.frames_lost} lost"

    def summary(self) -> dict[str, Any]:
        return super().summary() | {"link": self.statistics.summary()}

    def _take(self, message: Response, arrival_ns: int) -> None:
        if self._is_enough or isinstance(message, _ONLY_IN_WIRE_CAPTURES):
            return
        if self._early is not None:
            self._early.append((message, arrival_ns))
        elif self.session.opened_recorder.write(self.name, message, arrival_ns):
            self.recorded += 1
            self._newest_ns = arrival_ns

    @property
    def _is_enough(self) -> bool:
        return self.session.count is not None and self.recorded >= self.session.count

    def _record(self) -> None:
        while not (self.session.ends.is_set() or self._is_enough):
            self.mode.wait(self._radar, POLL_S)
            if time.monotonic_ns() - self._newest_ns > self._silence_s * 1e9:
                likely = "it has restarted meanwhile" if self._radar.reboots else "did it stop?"
                raise ResponseTimeout(
                    f"the module sent nothing to record for {self._silence_s:g} s; {likely}"
                )


class _RecordedText(_Source):
    """Lines from standard input or a serial port; the end of standard input is not a failure."""

    noun = "line"

    def __init__(self, session: "Session", name: str, port: str, baudrate: int) -> None:
        super().__init__(session, name, port)
        self._line = None if port == "-" else open_line(port, baudrate)

    def open(self, recorder: SessionRecorder) -> None:
        self._recorder = recorder
        recorder.add_text(self.name)

    def close(self) -> None:
        if self._line is not None:
            self._line.close()

    def _record(self) -> None:
        waiting = b""
        try:
            while not self.session.ends.is_set():
                data = _standard_input(POLL_S) if self._line is None else self._line.read(POLL_S)
                if data is None:
                    return
                arrival_ns = time.monotonic_ns()
                *lines, waiting = re.split(rb"[\r\n]+", waiting + data)
                if len(waiting) > _LONGEST_LINE:
                    lines, waiting = [*lines, waiting], b""
                for line in lines:
                    self._take(line, arrival_ns)
        finally:
            self._take(waiting, time.monotonic_ns())

    def _take(self, line: bytes, arrival_ns: int) -> None:
        text = line.decode("utf-8", "replace").replace("\0", "").strip()
        if text and self._recorder.write_line(self.name, text, arrival_ns):
            self.recorded += 1


def _standard_input(timeout_s: float) -> bytes | None:
    """Return what has come, b"" if nothing; None at the end.

    Read without Python's buffer, for which another thread could not end the program.
    """
    waiting = select.poll()
    waiting.register(0, select.POLLIN)
    try:
        return (os.read(0, _LONGEST_LINE) or None) if waiting.poll(timeout_s * 1000) else b""
    except OSError:  # it is closed
        return None


class Session:
    """What is recorded: one module into files of its own, or all into one MCAP file.

    Older files are removed only when all modules are set up and all lines are open: one that does
    not answer must not cost an older recording.

    Parameters
    ----------
    options
        Of a module's own files; None: one MCAP file.
    """

    def __init__(self, arguments: Namespace, mode: Listen, options: WriterOptions | None) -> None:
        self.is_of_one = options is not None
        self.count: int | None = arguments.count
        self.recorder: ModuleFiles | SessionRecorder | None = None  # an MCAP file is made later
        paths = [Path(arguments.out)] if arguments.out else []
        if options is not None:
            self.recorder = files = ModuleFiles(arguments, mode.profile_id, options)
            paths = [path for path in (files.directory, files.wire_path) if path is not None]
        self.modules = [
            _RecordedModule(self, name, port, copy(mode)) for name, port in arguments.ports
        ]
        self.texts: list[_RecordedText] = []
        self.ends = threading.Event()
        self.ended_by = "failure"
        self._arguments = arguments
        self._paths = paths
        self._were_there: dict[Path, bool] = {}
        self._failure: XeThruError | None = None
        self._began_s = self._ended_s = time.monotonic()

    @property
    def opened_recorder(self) -> ModuleFiles | SessionRecorder:
        assert self.recorder is not None, "opened before"
        return self.recorder

    @property
    def sources(self) -> list[_Source]:
        return [*self.modules, *self.texts]

    @property
    def is_empty(self) -> bool:
        return not any(source.recorded for source in self.sources)

    @property
    def failure(self) -> XeThruError | None:
        """Why it could not go on; what ended one of several sources is its own."""
        return self._failure or (None if self.recorder is None else self.recorder.failure)

    @property
    def targets(self) -> str:
        return " and ".join(map(str, self._paths))

    @property
    def elapsed_s(self) -> float:
        return time.monotonic() - self._began_s

    def record(self, stop: StopFlag) -> None:
        """Record until something ends it; RecordingError if something is in the way."""
        if isinstance(self.recorder, ModuleFiles):
            self.recorder.check()
        files_to_replace(self._paths, replace=self._arguments.force)
        with closing(self):
            try:
                with ExitStack() as opened:
                    for module in self.modules:
                        with self._naming(module):
                            module.open(opened, self._arguments)
                    for name, port, baudrate in self._arguments.text:
                        self.texts.append(_RecordedText(self, name, port, baudrate))
                        opened.callback(self.texts[-1].close)
                    self._open_files()
                    with stop:
                        for module in self.modules:
                            with self._naming(module):
                                module.let_it_send(opened)
                        self.ended_by = self._run(stop)
            except XeThruError as error:
                self._failure = error

    def close(self) -> None:
        """Complete the files; those without records are removed."""
        if self.recorder is not None:
            self.recorder.close()
        if self.is_empty:
            # the wire capture first: it may lie in the directory
            for path, was_there in reversed(self._were_there.items()):
                remove_unfinished(path, was_there=was_there)

    def numbers(self) -> str:
        if not self.is_of_one:
            parts = "; ".join(source.numbers() for source in self.sources)
            return f"{parts}; in {self._ended_s - self._began_s:.1f} s"
        (module,) = self.modules
        rate = rate_text(module.recorded, module.span_s)
        return (
            f"{counted(module.recorded, 'message')} in {module.span_s:.1f} s{rate}, "
            f"{bytes_text(module.statistics.bytes)}, {module.statistics.frames_lost} lost"
        )

    def kept(self) -> str:
        """Return what is there after a failure."""
        if self.is_of_one:
            return f"kept {counted(self.modules[0].recorded, 'message')} in {self.targets}"
        return f"all but the last second of {self.numbers()} is kept"

    def summary(self) -> dict[str, Any]:
        if isinstance(self.recorder, ModuleFiles):
            (module,) = self.modules
            directory, wire = self.recorder.directory, self.recorder.wire_path
            return {
                "directory": None if directory is None else str(directory),
                "wire": None if wire is None else str(wire),
                "messages": module.recorded,
                "duration_s": module.span_s,
                "link": module.statistics.summary(),
            }
        return {
            "file": self.targets,
            "radars": {module.name: module.summary() for module in self.modules},
            "texts": {text.name: text.summary() for text in self.texts},
            "duration_s": self._ended_s - self._began_s,
        }

    @contextmanager
    def _naming(self, module: _RecordedModule) -> Iterator[None]:
        try:
            yield
        except XeThruError as error:
            if self.is_of_one:
                raise
            raise CommandFailed(f"{module.name}: {error}") from error

    def _open_files(self) -> None:
        """Remove older files if that is allowed, and make new ones; RecordingError if not."""
        remove_older(self._paths, replace=self._arguments.force)
        self._were_there = {path: path.exists() for path in self._paths}
        if isinstance(self.recorder, ModuleFiles):
            (module,) = self.modules
            self.recorder.open(module.port, module.mode.parameter_file)
            return
        self.recorder = SessionRecorder(self._paths[0])
        for text in self.texts:
            text.open(self.recorder)

    def _run(self, stop: StopFlag) -> str:
        """Let the sources run until something ends it; returns what."""
        progress = Progress("xethru record")
        self._began_s = time.monotonic()
        try:
            for source in self.sources:
                source.start()
            ended_by = self._await_end(stop, progress)
        finally:
            self.ends.set()
            for source in self.sources:
                if source.ident is not None:  # it was started
                    source.join()
            progress.show(self.numbers())
            progress.finish()
        for source in self.sources:
            if source.crash is not None:
                raise source.crash
        for module in self.modules:
            is_silent = not module.recorded and module.failure is None
            if ended_by == "duration" and is_silent:
                limit = f"{self._arguments.duration:g} s"
                module.fail(ResponseTimeout(f"the module sent nothing to record in {limit}"))
            if self.is_of_one and module.failure is not None:
                raise module.failure
        return ended_by

    def _await_end(self, stop: StopFlag, progress: Progress) -> str:
        duration_s = self._arguments.duration
        while not stop.requested:
            self._ended_s = time.monotonic()
            if duration_s is not None and self.elapsed_s >= duration_s:
                return "duration"
            if not any(module.is_alive() for module in self.modules):
                failed = any(module.failure for module in self.modules)
                return "failure" if failed else "count"
            if self.opened_recorder.failure is not None:
                return "failure"
            progress.show(self.numbers())
            time.sleep(POLL_S / 4)
        return "signal"

"""Several modules, and lines of other sensors, recorded into one MCAP file."""

import os
import re
import select
import threading
import time
from argparse import Namespace
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from copy import copy
from pathlib import Path
from typing import Any

from xethru_protocol.cli.output import (
    CommandFailed,
    Progress,
    counted,
    module_at,
    print_json,
    print_line,
    print_warnings,
    rate_text,
    warn,
)
from xethru_protocol.cli.record.modes import ANSWERS, POLL_S, Listen
from xethru_protocol.cli.record.output_files import writer_options
from xethru_protocol.cli.recordings import files_to_replace, remove_older, remove_unfinished
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.operating_system import StopFlag
from xethru_protocol.recordings import (
    SessionRecorder,
)
from xethru_protocol.transport import open_line
from xethru_protocol.wire.errors import (
    ResponseTimeout,
    XeThruError,
)
from xethru_protocol.wire.table import Response

_MOST_MODULES = 8
_LONGEST_LINE = 65536  # bytes; a line without end is cut there


class _Source:
    """A module or a text column while it is recorded, by a thread of its own."""

    noun = ""

    session: "_Session"

    def __init__(self, name: str, port: str) -> None:
        self.name = name
        self.port = port
        self.recorded = 0
        self.failure: XeThruError | None = None
        self._thread = threading.Thread(target=self._run_to_end, name=name)

    def start(self) -> None:
        self._thread.start()

    @property
    def is_running(self) -> bool:
        return self._thread.is_alive()

    def join(self) -> None:
        if self._thread.ident is not None:
            self._thread.join()

    def fail(self, error: XeThruError) -> None:
        self.failure = self.failure or error
        others = any(each.is_running for each in self.session.modules if each is not self)
        kept = f"{counted(self.recorded, self.noun)} kept"
        warn(f"xethru record: {self.name}: {error}; {kept}{'; the others go on' * others}")

    def numbers(self) -> str:
        return f"{self.name} {counted(self.recorded, self.noun)}"

    def summary(self) -> dict[str, Any]:
        failure = None if self.failure is None else str(self.failure)
        return {"port": self.port, f"{self.noun}s": self.recorded, "failure": failure}

    def _run_to_end(self) -> None:
        try:
            self._run()
        except XeThruError as error:
            self.fail(error)

    def _run(self) -> None:
        raise NotImplementedError


class _RecordedModule(_Source):
    noun = "message"

    def __init__(self, name: str, port: str, *, radar: X4M300, mode: Listen, serial: str) -> None:
        super().__init__(name, port)
        self._radar = radar
        self._mode = mode
        self._serial = serial
        self._silence_s = float("inf")
        self._began_ns = self._newest_ns = time.monotonic_ns()
        self._early: list[tuple[Response, int]] | None = []  # before it is described

    def let_it_send(self) -> None:
        """Start what it sends, which is recorded from now on."""
        self._began_ns = self._newest_ns = time.monotonic_ns()
        self._radar.listeners.add(self._take)
        try:
            self._silence_s = self._mode.start(self._radar)
        finally:
            print_warnings(self._radar)
        about = {"serial": self._serial, "port": self.port} | self._mode.about(self._radar)
        self.session.recorder.add_radar(self.name, about)
        early, self._early = self._early or [], None
        for message, arrival_ns in early:
            self._take(message, arrival_ns)

    def numbers(self) -> str:
        rate = rate_text(self.recorded, (self._newest_ns - self._began_ns) * 1e-9)
        return f"{super().numbers()}{rate}, {self._radar.frames_lost} lost"

    def summary(self) -> dict[str, Any]:
        return super().summary() | {"link": self._radar.statistics.summary()}

    def _take(self, message: Response, arrival_ns: int) -> None:
        if self._is_enough or isinstance(message, ANSWERS):
            return
        if self._early is not None:
            self._early.append((message, arrival_ns))
        elif self.session.recorder.write(self.name, message, arrival_ns):
            self.recorded += 1
            self._newest_ns = arrival_ns

    @property
    def _is_enough(self) -> bool:
        return self.session.count is not None and self.recorded >= self.session.count

    def _run(self) -> None:
        try:
            while not (self.session.ends.is_set() or self._is_enough):
                self._mode.wait(self._radar, POLL_S)
                if time.monotonic_ns() - self._newest_ns > self._silence_s * 1e9:
                    raise ResponseTimeout(
                        f"the module sent nothing to record for {self._silence_s:g} s; did it stop?"
                    )
        finally:
            self._radar.listeners.remove(self._take)


class _RecordedText(_Source):
    """Lines from standard input or a serial port; the end of standard input is not a failure."""

    noun = "line"

    def __init__(self, name: str, port: str, session: "_Session", baudrate: int) -> None:
        super().__init__(name, port)
        self.session = session
        self._line = None if port == "-" else open_line(port, baudrate)
        session.recorder.add_text(name)

    def close(self) -> None:
        if self._line is not None:
            self._line.close()

    def _run(self) -> None:
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
        if text and self.session.recorder.write_line(self.name, text, arrival_ns):
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


class _Session:
    """What is recorded into one file, and until when."""

    def __init__(self, path: Path, count: int | None, modules: list[_RecordedModule]) -> None:
        self.path = path
        self.count = count
        self.modules = modules
        for module in modules:
            module.session = self
        self.texts: list[_RecordedText] = []
        self.ends = threading.Event()
        self.recorder = SessionRecorder(path)
        self._began_s = self._ended_s = time.monotonic()

    @property
    def sources(self) -> list[_Source]:
        return [*self.modules, *self.texts]

    @property
    def is_empty(self) -> bool:
        return not any(source.recorded for source in self.sources)

    def run(self, duration_s: float | None, stop: StopFlag) -> str:
        """Record until something ends it; returns what."""
        progress = Progress("xethru record")
        self._began_s = time.monotonic()
        for source in self.sources:
            source.start()
        try:
            while not stop.requested:
                self._ended_s = time.monotonic()
                if duration_s is not None and self._ended_s - self._began_s >= duration_s:
                    return "duration"
                if not any(module.is_running for module in self.modules):
                    failed = any(module.failure for module in self.modules)
                    return "failure" if failed else "count"
                if self.recorder.failure is not None:
                    return "failure"
                progress.show(self.numbers)
                time.sleep(POLL_S / 4)
            return "signal"
        finally:
            self.ends.set()
            for source in self.sources:
                source.join()
            progress.finish(self.numbers)

    def numbers(self) -> str:
        parts = "; ".join(source.numbers() for source in self.sources)
        return f"{parts}; in {self._ended_s - self._began_s:.1f} s"

    def summary(self) -> dict[str, Any]:
        return {
            "file": str(self.path),
            "radars": {module.name: module.summary() for module in self.modules},
            "texts": {text.name: text.summary() for text in self.texts},
            "duration_s": self._ended_s - self._began_s,
        }


def record_session(arguments: Namespace, mode: Listen) -> int:
    """Record modules and other sensors into one MCAP file."""
    _check_session(arguments)
    path = Path(arguments.out)
    files_to_replace((path,), replace=arguments.force)
    stop = StopFlag("previous")
    ended_by = "failure"
    with ExitStack() as opened:
        modules = [
            _opened_module(opened, name, port, arguments, copy(mode))
            for name, port in arguments.ports
        ]
        remove_older((path,), replace=arguments.force)
        session = _Session(path, arguments.count, modules)
        try:
            for name, port, baudrate in arguments.text:
                session.texts.append(_RecordedText(name, port, session, baudrate))
                opened.callback(session.texts[-1].close)
            with stop:
                for module in modules:
                    with _naming(module.name):
                        module.let_it_send()
                ended_by = session.run(arguments.duration, stop)
        finally:
            session.recorder.close()
            if session.is_empty:
                remove_unfinished(path, was_there=False)
    failure = session.recorder.failure
    if arguments.json:
        print_json(session.summary() | {"ended_by": "failure" if failure else ended_by})
    elif failure is None and not session.is_empty:
        print_line(f"{path}: {session.numbers()}")
    elif failure is None:
        warn("xethru record: nothing came, so nothing was written")
    if failure is not None:
        warn(f"xethru record: {failure}; all but the last second of {session.numbers()} is kept")
    if stop.received is not None:
        return 128 + stop.received
    if failure is not None:
        return 1
    silent = [module.name for module in session.modules if not module.recorded]
    if ended_by == "duration" and silent:
        raise CommandFailed(f"{', '.join(silent)} sent nothing to record")
    return 1 if any(source.failure for source in session.sources) else 0


def _opened_module(
    opened: ExitStack, name: str, port: str, arguments: Namespace, mode: Listen
) -> "_RecordedModule":
    """Open a module and bring it to where it sends nothing yet."""
    with _naming(name):
        radar = opened.enter_context(module_at(port, arguments.baudrate))
        mode.prepare(radar)
        serial = None if arguments.profile == "none" else radar.info().serial_number
        print_warnings(radar)
    return _RecordedModule(name, port, radar=radar, mode=mode, serial=serial or "")


@contextmanager
def _naming(name: str) -> Iterator[None]:
    try:
        yield
    except XeThruError as error:
        raise CommandFailed(f"{name}: {error}") from error


def _check_session(arguments: Namespace) -> None:
    """End the program on wrong usage."""
    ports = [port for _, port in arguments.ports]
    sources = [source for _, source, _ in arguments.text]
    if len(ports) > _MOST_MODULES:
        arguments.refuse(f"at most {_MOST_MODULES} modules are recorded together")
    if arguments.wire is not None:
        arguments.refuse("--wire is for one module, with --out DIR or alone")
    for what, given in (
        ("port", ports + [source for source in sources if source != "-"]),
        ("module", [name for name, _ in arguments.ports]),
        ("--text", [name for name, _, _ in arguments.text]),
    ):
        twice = sorted({each for each in given if given.count(each) > 1})
        if twice:
            remedy = "; name them: --port NAME=PORT" if what == "module" else ""
            arguments.refuse(f"{what} {twice[0]} is given twice{remedy}")
    if sources.count("-") > 1:
        arguments.refuse("only one --text can be standard input")
    out, arguments.out = arguments.out, None
    writer_options(arguments)
    arguments.out = out

"""``xethru record``: what a module sends, written to files as it comes.

Whatever ends it, the recording is closed and complete: a signal only asks for the end, so that
none comes while a record is half written; a second one insists.
"""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from xethru_protocol.cli.output import one_line, print_json, print_line, warn
from xethru_protocol.cli.progress import Progress, counted
from xethru_protocol.cli.recorder import Recorder, Targets
from xethru_protocol.cli.recording_modes import RecordingMode
from xethru_protocol.cli.session import CommandFailed, module_at, say_warnings
from xethru_protocol.driver import X4M300
from xethru_protocol.errors import ResponseTimeout, XeThruError

_GLANCE_S = 0.2  # how late a signal, or the end, may be noticed


def record(
    port: str,
    baudrate: int,
    mode: RecordingMode,
    targets: Targets,
    *,
    count: int | None,
    duration_s: float | None,
    replace: bool,
    as_json: bool,
) -> int:
    """Record until ``count`` messages, ``duration_s``, a signal, unplugging or a full disk."""
    targets.check(replace=replace)
    signals: list[int] = []
    with Recorder(targets, count) as recorder:
        try:
            with module_at(port, baudrate) as radar:
                radar.raw_listener = recorder.take_bytes
                mode.prepare(radar)
                say_warnings(radar)
                recorder.open(replace=replace)
                with _noted(signals):
                    _record_from(radar, recorder, mode, duration_s, signals)
        except XeThruError as error:
            recorder.fail(error)
    if as_json:
        print_json(recorder.summary() | {"ended_by": _end(recorder, signals)})
    elif recorder.failure is None and recorder.messages:
        print_line(f"{targets.text}: {recorder.numbers()}")
    elif recorder.failure is None:
        warn("xethru record: nothing came, so nothing was written")
    if recorder.failure is not None:
        text = str(recorder.failure)
        if recorder.messages:
            text += f"; kept {counted(recorder.messages, 'message')} in {targets.text}"
        if not signals:
            raise CommandFailed(text)
        warn(f"xethru record: {one_line(text)}")
    return 128 + signals[0] if signals else 0


def _record_from(
    radar: X4M300,
    recorder: Recorder,
    mode: RecordingMode,
    duration_s: float | None,
    signals: list[int],
) -> None:
    progress = Progress("xethru record")
    recorder.listen_to(radar)
    try:
        silence_s = mode.start(radar)
        say_warnings(radar)
        while not (signals or recorder.is_enough):
            if duration_s is not None and recorder.elapsed_s >= duration_s:
                if not recorder.messages:
                    raise ResponseTimeout(f"the module sent nothing to record in {duration_s:g} s")
                break
            if recorder.silent_s > silence_s:
                likely = "it has restarted meanwhile" if radar.reboots else "did it stop?"
                raise ResponseTimeout(
                    f"the module sent nothing to record for {silence_s:g} s; {likely}"
                )
            left_s = _GLANCE_S if duration_s is None else duration_s - recorder.elapsed_s
            mode.wait(radar, min(_GLANCE_S, left_s))  # the recorder hears what comes
            progress.show(recorder.numbers)
    finally:
        recorder.stop_listening(radar)
        progress.finish(recorder.numbers)


def _end(recorder: Recorder, signals: list[int]) -> str:
    if recorder.failure is not None:
        return "failure"
    if signals:
        return "signal"
    return "count" if recorder.is_enough else "duration"


@contextmanager
def _noted(signals: list[int]) -> Iterator[None]:
    """Note the first signal to end; the second does what it did before."""

    def note(number: int, frame: FrameType | None) -> None:
        signals.append(number)
        signal.signal(number, previous[signal.Signals(number)])

    previous = {
        number: signal.signal(number, note)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        if signal.getsignal(number) is not signal.SIG_IGN  # after nohup
    }
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)

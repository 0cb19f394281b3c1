"""The command ``xethru record``.

Whatever ends it, the recording is closed and complete: a signal only asks for the end, so that
none comes while a record is half written; a second one insists.
"""

from argparse import Namespace
from contextlib import suppress
from pathlib import Path

from xethru_protocol.cli.arguments import raw_config
from xethru_protocol.cli.output import (
    CommandFailed,
    Progress,
    counted,
    module_at,
    print_json,
    print_line,
    print_warnings,
    warn,
)
from xethru_protocol.cli.record.modes import POLL_S, Listen, RawFrames, profile_of
from xethru_protocol.cli.record.output_files import RecordingFiles, writer_options
from xethru_protocol.cli.record.session import record_session
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.operating_system import StopFlag
from xethru_protocol.wire.errors import (
    ResponseTimeout,
    XeThruError,
)


def record(arguments: Namespace) -> int:
    """Record until ``--count``, ``--duration``, a signal, unplugging or a full disk."""
    config = raw_config(arguments)
    if arguments.out is None and arguments.wire is None:
        arguments.refuse("--out DIR is missing, or --wire FILE, or both")
    if arguments.out == arguments.wire:
        arguments.refuse("--out and --wire must not be the same")
    if config is None and arguments.profile != "raw":
        arguments.refuse("--attach takes radar frames: leave --profile out")
    mode = Listen()
    profile = profile_of(arguments)
    if arguments.profile == "raw":
        mode = RawFrames(config=config, fps=arguments.fps)
    elif profile is not None:
        mode = profile
    if arguments.out is not None and Path(arguments.out).suffix == ".mcap":
        return record_session(arguments, mode)
    if len(arguments.ports) > 1 or arguments.text:
        arguments.refuse("several --port, and --text, need one file for all: --out FILE.mcap")
    ((_, arguments.port),) = arguments.ports
    options = writer_options(arguments)
    stop = StopFlag("previous")
    with RecordingFiles(arguments, mode.profile_id, options) as recorder:
        recorder.check()
        try:
            with module_at(arguments.port, arguments.baudrate) as radar:
                radar.raw_listeners.add(recorder.take_bytes)
                mode.prepare(radar)
                print_warnings(radar)
                recorder.open(mode.parameter_file)
                with stop:
                    _record_from(radar, recorder, mode, arguments.duration, stop)
        except XeThruError as error:
            recorder.fail(error)
    if stop.received is None:
        _print_end(recorder, stop, arguments)
        return 0
    with suppress(CommandFailed, BrokenPipeError):  # the terminal may have closed
        _print_end(recorder, stop, arguments)
    return 128 + stop.received


def _print_end(recorder: RecordingFiles, stop: StopFlag, arguments: Namespace) -> None:
    """Print what was recorded; CommandFailed if not all could be, and no signal was the reason."""
    targets = " and ".join(str(path) for path in recorder.paths)
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
        warn(f"xethru record: {text}")


def _record_from(
    radar: X4M300, recorder: RecordingFiles, mode: Listen, duration_s: float | None, stop: StopFlag
) -> None:
    progress = Progress("xethru record")
    recorder.listen_to(radar)
    try:
        silence_s = mode.start(radar)
        print_warnings(radar)
        recorder.describe(mode.about(radar))
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
            left_s = POLL_S if duration_s is None else duration_s - recorder.elapsed_s
            mode.wait(radar, min(POLL_S, left_s))  # the recorder gets what comes
            progress.show(recorder.numbers)
    finally:
        recorder.stop_listening(radar)
        progress.finish(recorder.numbers)


def _end(recorder: RecordingFiles, stop: StopFlag) -> str:
    if recorder.failure is not None:
        return "failure"
    if stop.requested:
        return "signal"
    return "count" if recorder.is_enough else "duration"

"""``xethru record``: what a module sends, written to files as it comes.

Whatever ends it, the recording is closed and complete: a signal only asks for the end, so that
none comes while a record is half written; a second one insists.
"""

import os
import re
import select
import threading
import time
from argparse import Namespace
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from copy import copy, deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

from xethru_protocol.cli.arguments import raw_config
from xethru_protocol.cli.output import (
    CommandFailed,
    Progress,
    bytes_text,
    counted,
    frame_rate,
    module_at,
    print_json,
    print_line,
    print_warnings,
    warn,
)
from xethru_protocol.cli.recordings import (
    files_to_replace,
    remove_empty_directories,
    remove_unfinished,
)
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.recordings import (
    RecordingError,
    RecordingOptions,
    RecordingWriter,
    SessionRecorder,
    Split,
    WireCapture,
    session_directory,
)
from xethru_protocol.recordings.records import writing
from xethru_protocol.recordings.vendor.layouts import KINDS
from xethru_protocol.recordings.vendor.writer import new_session_id
from xethru_protocol.system import StopFlag
from xethru_protocol.transport import open_line
from xethru_protocol.validation import shown
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import (
    FileType,
    MatrixControl,
    OutputFeature,
    ProfileId,
    X4Setting,
)
from xethru_protocol.wire.errors import (
    DeviceError,
    OldFirmwareError,
    RemoteProtocolError,
    ResponseTimeout,
    XeThruError,
)
from xethru_protocol.wire.framing import LinkStatistics
from xethru_protocol.wire.rows import Response


class Listen:
    """How to get a module to send what is recorded: here, whatever it sends by itself."""

    profile_id: int | None = None  # that runs then; None if there is none, or it is not known
    parameter_file: bytes | None = None  # the module's own

    def prepare(self, radar: X4M300) -> None:
        """Bring the module to where it sends nothing yet; what comes meanwhile is old."""

    def start(self, radar: X4M300) -> float:
        """Let it send; returns after how much silence [s] something must be wrong."""
        return float("inf")

    def about(self, radar: X4M300) -> dict[str, Any]:
        """Return what is known of it once it sends, by the names in an MCAP file's info."""
        return {}

    def wait(self, radar: X4M300, timeout_s: float) -> None:
        """Receive until a message came or the time is over, and empty the driver's queues."""
        with suppress(ResponseTimeout):
            radar.read_message(m.Response, timeout_s)
        for _ in range(radar.messages_waiting()):
            radar.read_message(m.Response)
        for _ in range(radar.frames_waiting()):
            radar.read_frame()


class RawFrames(Listen):
    """Radar frames of raw mode."""

    def __init__(self, config: RawConfig, fps: float | None) -> None:
        self._config = config
        self._fps = fps
        self._rate_hz = 0.0

    def prepare(self, radar: X4M300) -> None:
        radar.configure_raw(self._config)

    def start(self, radar: X4M300) -> float:
        self._rate_hz = radar.start(frame_rate(radar, self._fps))
        return max(2.0, 3.0 / self._rate_hz)

    def about(self, radar: X4M300) -> dict[str, Any]:
        geometry = radar.geometry
        assert geometry is not None, "configured before"
        settings = {setting.name: value for setting, value in self._config.settings()}
        return {
            "range_start_m": geometry.range_start_m,
            "bin_length_m": geometry.bin_length_m,
            "n_bins": geometry.n_bins,
            "rate_hz": self._rate_hz,
            "settings": settings
            | {
                X4Setting.FRAMEAREA.name: geometry.area_m,
                X4Setting.FRAMEBINCOUNT.name: geometry.n_bins,
            },
        }

    def wait(self, radar: X4M300, timeout_s: float) -> None:
        """Receive until a frame came or the time is over; other messages are not kept."""
        with suppress(ResponseTimeout):
            radar.read_frame(timeout_s)


_BOTH = MatrixControl.SLOW | MatrixControl.FAST
_COMMON_OUTPUTS = {
    "iq": (OutputFeature.BASEBAND_IQ, 1),
    "ap": (OutputFeature.BASEBAND_AMPLITUDE_PHASE, 1),
    "pulsedoppler": (OutputFeature.PULSEDOPPLER_FLOAT, _BOTH),
    "pulsedoppler-byte": (OutputFeature.PULSEDOPPLER_BYTE, _BOTH),
    "noisemap": (OutputFeature.NOISEMAP_FLOAT, _BOTH),
    "noisemap-byte": (OutputFeature.NOISEMAP_BYTE, _BOTH),
}
_RIVALS = [
    ("iq", "ap"),
    ("pulsedoppler", "pulsedoppler-byte"),
    ("noisemap", "noisemap-byte"),
]
"""Outputs of which the module sends one: the one that is switched on last (4.7)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ProfileKind:
    """A profile: its id, which modules have it, its own outputs by name."""

    profile_id: ProfileId
    modules: str
    own_outputs: Mapping[str, OutputFeature]

    @property
    def outputs(self) -> dict[str, tuple[OutputFeature, int]]:
        """All outputs with the control that switches them on."""
        return _COMMON_OUTPUTS | {name: (one, 1) for name, one in self.own_outputs.items()}


PROFILES = {
    "presence": ProfileKind(
        profile_id=ProfileId.XTS_ID_APP_PRESENCE_2,
        modules="an X4M300",
        own_outputs={
            "single": OutputFeature.PRESENCE_SINGLE,
            "movinglist": OutputFeature.PRESENCE_MOVINGLIST,
        },
    ),
    "respiration": ProfileKind(
        profile_id=ProfileId.XTS_ID_APP_RESPIRATION_2,
        modules="an X4M200 or X4M210",
        own_outputs={
            "status": OutputFeature.RESP_STATUS,
            "sleep": OutputFeature.SLEEP_STATUS,
            "vitalsigns": OutputFeature.VITAL_SIGNS,
            "movinglist": OutputFeature.RESPIRATION_MOVINGLIST,
            "detectionlist": OutputFeature.RESPIRATION_DETECTIONLIST,
            "normalizedmovementlist": OutputFeature.RESPIRATION_NORMALIZEDMOVEMENTLIST,
        },
    ),
}


class Profile(Listen):
    """Messages of a profile, about one a second, and what else its outputs bring."""

    def __init__(
        self,
        name: str,
        *,
        outputs: Sequence[str] | None,
        zone_m: tuple[float, float] | None,
        sensitivity: int | None,
    ) -> None:
        self._name = name
        self._kind = PROFILES[name]
        self._outputs = outputs
        self._zone_m = zone_m
        self._sensitivity = sensitivity
        self.profile_id = self._kind.profile_id

    def prepare(self, radar: X4M300) -> None:
        try:
            radar.profile.load(self._kind.profile_id)
        except DeviceError as error:
            raise CommandFailed(
                f"this module does not load the profile {self._name}, which {self._kind.modules} "
                f"has: {error}"
            ) from error
        # the vendor's recorder stores this file beside the data; a module need not have it
        with suppress(DeviceError, OldFirmwareError, RemoteProtocolError):
            self.parameter_file = radar.files.read(FileType.PARAMETER_FILE, 0)
        if self._zone_m is not None:
            zone_m = radar.profile.set_zone(*self._zone_m)
            warn(f"xethru record: the detection zone is {zone_m[0]:.3f} ... {zone_m[1]:.3f} m")
        if self._sensitivity is not None:
            radar.profile.set_sensitivity(self._sensitivity)
        if self._outputs is not None:
            self._set_outputs(radar, self._outputs)

    def _set_outputs(self, radar: X4M300, names: Sequence[str]) -> None:
        """Switch others off first: switching one off switches its rival off, too (4.7)."""
        for name, (feature, _) in self._kind.outputs.items():
            # a module without this output does not send it
            with suppress(DeviceError, OldFirmwareError):
                if name not in names and _may_be_on(radar, feature):
                    radar.profile.set_output(feature, 0)
        for name in names:
            try:
                radar.profile.set_output(*self._kind.outputs[name])
            except DeviceError as error:
                raise CommandFailed(f"this module does not take output {name}: {error}") from error

    def start(self, radar: X4M300) -> float:
        radar.profile.run()
        # noise maps alone are sent only now and then
        return 10.0 if self._outputs is None or {*self._outputs} - {*_COMMON_OUTPUTS} else 60.0


def _may_be_on(radar: X4M300, feature: OutputFeature) -> bool:
    try:
        return radar.profile.output(feature) != 0
    except OldFirmwareError:  # it has the output perhaps, and no question for it
        return True


_ANSWERS = (
    *(m.Ack, m.Error, m.Pong, m.System),
    *(m.ReplyByte, m.ReplyFloat, m.ReplyInt, m.ReplyNone, m.ReplyString, m.ReplyUser),
)


class RecordingFiles:
    """Writes what a driver receives to files.

    Files are made, and older ones removed, only by `open`: a module that does not answer must
    not cost an older recording. Bytes that come before that are kept until then.

    An error of a file is kept in ``failure``, not raised: the caller is in the middle of
    receiving.
    """

    def __init__(
        self, arguments: Namespace, profile_id: int | None, options: RecordingOptions
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

    def open(self, parameter_file: bytes | None = None) -> None:
        """Remove older files if that is allowed, and make new ones; RecordingError if not."""
        for path in files_to_replace(self.paths, replace=self._arguments.force):
            try:
                path.unlink()
            except OSError as error:
                raise RecordingError(f"{path} cannot be removed: {error.strerror}") from None
        for path in self.paths:
            remove_empty_directories(path)
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


def _profile_of(arguments: Namespace) -> Profile | None:
    """Return the profile to record, None for none; ends the program on wrong usage."""
    name = arguments.profile
    if name not in PROFILES:
        for option in ("output", "zone", "sensitivity"):
            if getattr(arguments, option) is not None:
                arguments.refuse(f"--{option} needs --profile presence or respiration")
        return None
    names: list[str] | None = None
    if arguments.output is not None:
        known = PROFILES[name].outputs
        names = [part.strip() for part in arguments.output.split(",")]
        for part in names:
            others = [other for other, kind in PROFILES.items() if part in kind.own_outputs]
            if part not in known and others:
                arguments.refuse(f"output {part} belongs to --profile {others[0]}, not {name}")
            if part not in known:
                arguments.refuse(
                    f"profile {name} has no output {shown(part)}; known: {', '.join(known)}"
                )
        for rivals in _RIVALS:
            both = [part for part in names if part in rivals]
            if len(set(both)) > 1:
                warn(
                    f"xethru record: outputs {rivals[0]} and {rivals[1]} exclude each other; "
                    f"the module sends {both[-1]}"
                )
    if arguments.zone is not None and arguments.zone[0] >= arguments.zone[1]:
        arguments.refuse("argument --zone: START must be smaller than END")
    return Profile(name, outputs=names, zone_m=arguments.zone, sensitivity=arguments.sensitivity)


def _writer_options(arguments: Namespace) -> RecordingOptions:
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
    options: RecordingOptions = {
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


_POLL_S = 0.2  # how late a signal, or the end, may be noticed


def record(arguments: Namespace) -> int:
    """Record until ``--count``, ``--duration``, a signal, unplugging or a full disk."""
    config = raw_config(arguments)
    if arguments.out is None and arguments.wire is None:
        arguments.refuse("--out DIR is missing, or --wire FILE, or both")
    if arguments.out == arguments.wire:
        arguments.refuse("--out and --wire must not be the same")
    if arguments.wire is not None and Path(arguments.wire).suffix in {".mcap", ".npz", ".pcap"}:
        arguments.refuse(
            "--wire FILE is a wire capture, .xtwire; --out FILE.mcap writes MCAP, and "
            "'xethru convert' any other format"
        )
    mode = Listen()
    profile = _profile_of(arguments)
    if arguments.profile == "raw":
        mode = RawFrames(config=config, fps=arguments.fps)
    elif profile is not None:
        mode = profile
    if arguments.out is not None and Path(arguments.out).suffix == ".mcap":
        return _record_session(arguments, mode)
    if len(arguments.ports) > 1 or arguments.text:
        arguments.refuse("several --port, and --text, need one file for all: --out FILE.mcap")
    ((_, arguments.port),) = arguments.ports
    options = _writer_options(arguments)
    stop = StopFlag("previous")
    with RecordingFiles(arguments, mode.profile_id, options) as recorder:
        recorder.check()
        try:
            with module_at(arguments.port, arguments.baudrate) as radar:
                radar.raw_listener = recorder.take_bytes
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


def _end(recorder: RecordingFiles, stop: StopFlag) -> str:
    if recorder.failure is not None:
        return "failure"
    if stop.requested:
        return "signal"
    return "count" if recorder.is_enough else "duration"


# --- several modules and other sensors in one file ----------------------------------------------

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


class _Module(_Source):
    noun = "message"

    def __init__(self, name: str, port: str, *, radar: X4M300, mode: Listen, serial: str) -> None:
        super().__init__(name, port)
        self._radar = radar
        self._mode = mode
        self._serial = serial
        self._silence_s = float("inf")
        self._newest_ns = time.monotonic_ns()
        self._early: list[tuple[Response, int]] | None = []  # before it is described

    def let_it_send(self) -> None:
        """Start what it sends, which is recorded from now on."""
        self._newest_ns = time.monotonic_ns()
        self._radar.listener = self._take
        try:
            self._silence_s = self._mode.start(self._radar)
        finally:
            print_warnings(self._radar)
        about = {"serial": self._serial, "port": self.port} | self._mode.about(self._radar)
        self.session.recorder.add_radar(self.name, about)
        early, self._early = self._early or [], None
        for message, arrival_ns in early:
            self._take(message, arrival_ns)

    def summary(self) -> dict[str, Any]:
        return super().summary() | {"link": self._radar.statistics.summary()}

    def _take(self, message: Response, arrival_ns: int) -> None:
        if self._is_enough or isinstance(message, _ANSWERS):
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
                self._mode.wait(self._radar, _POLL_S)
                if time.monotonic_ns() - self._newest_ns > self._silence_s * 1e9:
                    raise ResponseTimeout(
                        f"the module sent nothing to record for {self._silence_s:g} s; did it stop?"
                    )
        finally:
            self._radar.listener = None


class _Text(_Source):
    """Lines from standard input or a serial port; its end is no failure of standard input."""

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
                data = _standard_input(_POLL_S) if self._line is None else self._line.read(_POLL_S)
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

    def __init__(self, path: Path, count: int | None, modules: list[_Module]) -> None:
        self.path = path
        self.count = count
        self.modules = modules
        for module in modules:
            module.session = self
        self.texts: list[_Text] = []
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
                time.sleep(_POLL_S / 4)
            return "signal"
        finally:
            self.ends.set()
            for source in self.sources:
                source.join()
            progress.finish(self.numbers)

    def numbers(self) -> str:
        parts = ", ".join(source.numbers() for source in self.sources)
        return f"{parts} in {self._ended_s - self._began_s:.1f} s"

    def summary(self) -> dict[str, Any]:
        return {
            "file": str(self.path),
            "radars": {module.name: module.summary() for module in self.modules},
            "texts": {text.name: text.summary() for text in self.texts},
            "duration_s": self._ended_s - self._began_s,
        }


def _record_session(arguments: Namespace, mode: Listen) -> int:
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
        for old in files_to_replace((path,), replace=arguments.force):
            with writing(old):
                old.unlink()
        session = _Session(path, arguments.count, modules)
        try:
            for name, port, baudrate in arguments.text:
                session.texts.append(_Text(name, port, session, baudrate))
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
) -> "_Module":
    """Open a module and bring it to where it sends nothing yet."""
    with _naming(name):
        radar = opened.enter_context(module_at(port, arguments.baudrate))
        mode.prepare(radar)
        serial = None if arguments.profile == "none" else radar.info().serial_number
        print_warnings(radar)
    return _Module(name, port, radar=radar, mode=mode, serial=serial or "")


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
    _writer_options(arguments)
    arguments.out = out

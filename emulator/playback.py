"""Recordings played at emulated ports.

Playing begins anew for every host that opens the port: at once when it starts the radar (FPS > 0
or SETMODE RUN), else after half a second without a command, so that a host that only listens has
had time to flush its side. It ends when the last host has closed the port. Meanwhile the module
answers every command like any other; FPS, mode and geometry settings are acknowledged and change
nothing about what is played. Nothing is dropped: a host that reads slowly makes the recording
wait.

A host takes only frames of the size that the module reports for its frame area, so while a
recording plays the module reports the frame area of the recording.

Times of the recording are mapped to times of the device piece by piece: within a piece
``due = anchor + (position - anchor position) / rate``, and every pause, seek and change of rate
begins a new piece.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from emulator.chip.chip import NS_PER_S, Chip
from emulator.echo.echo import echo_source
from emulator.module.memory import Identity
from emulator.module.outbox import LosslessOutbox, MessageStream
from emulator.module.state import Module
from emulator.scene.scene import empty_room
from emulator.x4m300 import Device
from xethru_protocol.driver.frames import FrameGeometry
from xethru_protocol.recordings import RecordingError, RecordingFault, read_recording
from xethru_protocol.recordings.formats import recording_content
from xethru_protocol.recordings.recorded_messages import TimedMessages
from xethru_protocol.wire import x4
from xethru_protocol.wire.codes import BootloaderReply, ResponseCode, SensorMode, X4Setting
from xethru_protocol.wire.messages import (
    Command,
    DataFloat,
    ReplyFloat,
    Response,
    SetMode,
    X4DriverSet,
    X4Value,
)
from xethru_protocol.wire.table import ROWS, UnknownMessage

SLOWEST_RATE = 1e-6
"""Least rate above 0 that a playback in progress takes; a year for half a minute."""
QUIET_NS = NS_PER_S // 2
NOMINAL_PERIOD_NS = NS_PER_S // 17
"""Spacing of records that carry no time: the profile's nominal 17 messages per second."""
_LONGEST_S = 20 * 86400  # the system waits at most 24 days for anything
_ONLY_NAME = "player"
_PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_SERIAL = re.compile(r"[0-9]{12}")
_NO_SERIAL = "0" * 12
_ANSWERS = frozenset(
    (
        ResponseCode.XTS_SPR_ACK,
        ResponseCode.XTS_SPR_ERROR,
        ResponseCode.XTS_SPR_PONG,
        ResponseCode.XTS_SPR_REPLY,
        ResponseCode.XTS_SPR_HIL,
        *BootloaderReply,
    )
)


class PlayClock:
    """The time of a recording on the clock of the device that plays it.

    At rate 0 everything is due at once, and the position is that of the last message played.
    """

    def __init__(self, rate: float) -> None:
        self.rate = rate
        self.paused = False
        self.anchor_ns = 0  # when the piece in force begins, or began
        self._anchor_position_ns = 0

    def start(self, position_ns: int, at_ns: int) -> None:
        """Be at a position of the recording at a time of the device, which may lie ahead."""
        self._anchor_position_ns = position_ns
        self.anchor_ns = at_ns

    def due_ns(self, position_ns: int) -> int | None:
        """Return when the device's clock reaches a position; None while paused."""
        if self.paused:
            return None
        if not self.rate:
            return self.anchor_ns
        return self.anchor_ns + round((position_ns - self._anchor_position_ns) / self.rate)

    def position_ns(self, now_ns: int) -> int:
        if self.paused or not self.rate or now_ns <= self.anchor_ns:
            return self._anchor_position_ns
        return self._anchor_position_ns + math.floor((now_ns - self.anchor_ns) * self.rate)

    def reached(self, position_ns: int) -> None:
        """Note that a message was played; at rate 0 nothing else moves the position."""
        if not self.rate:
            self._anchor_position_ns = max(self._anchor_position_ns, position_ns)

    def wrap(self, round_ns: int) -> None:
        """Count positions from the next round on, which begins a round's length later."""
        self._anchor_position_ns -= round_ns

    def pause(self, now_ns: int) -> None:
        self._settle(now_ns)
        self.paused = True

    def resume(self, now_ns: int) -> None:
        if self.paused:
            self.paused = False
            self.anchor_ns = max(self.anchor_ns, now_ns)

    def set_rate(self, rate: float, now_ns: int) -> None:
        self._settle(now_ns)
        self.rate = rate

    def _settle(self, now_ns: int) -> None:
        if now_ns > self.anchor_ns:
            self._anchor_position_ns = self.position_ns(now_ns)
            self.anchor_ns = now_ns


def is_answer(message: Response) -> bool:
    if isinstance(message, UnknownMessage):
        return message.code in _ANSWERS
    return not ROWS[type(message)].opcodes.isdisjoint(_ANSWERS)


class TimedMessage(NamedTuple):
    """A message and its time since the first one of the recording, ns."""

    time_ns: int
    message: Response


def schedule(messages: Iterable[tuple[Response, int | None]]) -> Iterator[TimedMessage]:
    """Yield the messages of a recording with the time at which each is played.

    ``messages`` come in order with the recording's own time of each, ns, or None. Times never
    decrease: a message whose stamp runs backwards is played at once.

    Examples
    --------
    >>> from xethru_protocol.wire.messages import Ack
    >>> [item.time_ns for item in schedule([(Ack(), 5), (Ack(), 1005), (Ack(), 905)])]
    [0, 1000, 1000]
    """
    elapsed_ns = 0
    previous_ns: int | None = None
    for index, (message, stamp_ns) in enumerate(messages):
        if index:
            if stamp_ns is None or previous_ns is None:
                elapsed_ns += NOMINAL_PERIOD_NS
            else:
                elapsed_ns += max(stamp_ns - previous_ns, 0)
        previous_ns = stamp_ns
        yield TimedMessage(elapsed_ns, message)


class PlayStream(MessageStream):
    """The messages of a recording, due one after the other while a host has the port open.

    Where the system does not report who opens the port, a host's first command counts as opening.
    No control brings a message twice or out of order, or loses one, but for what a seek leaves out.
    Pause, rate and loop outlast the host.

    Parameters
    ----------
    timed
        What to play, as from `schedule`; gone through anew for every host, round and seek, one
        message ahead, so that it need not lie in memory.
    loop_gap_ns
        Time of the recording between the last message and the first when playing in a loop; None
        to play once.
    rate
        Multiple of real time; 0 for as fast as the port takes it.
    """

    def __init__(
        self,
        timed: Iterable[TimedMessage],
        *,
        loop_gap_ns: int | None = None,
        rate: float = 1.0,
    ) -> None:
        self._timed = timed
        self._loop = loop_gap_ns is not None
        self._gap_ns = NOMINAL_PERIOD_NS if loop_gap_ns is None else loop_gap_ns
        self._clock = PlayClock(rate)
        self._coming: Iterator[TimedMessage] = iter(())
        self._next: TimedMessage | None = None
        self._last_ns = 0  # time of the last message gone through
        self._round_waits = False  # whether a further round was entered and none of it is played
        self._listening = False
        self._begun = False
        self._sought_ns: int | None = None

    def next_due_ns(self) -> int | None:
        """Return when the next message is due; None with no host, paused or at the end."""
        if not self._listening or self._next is None:
            return None
        return self._clock.due_ns(self._next.time_ns)

    def take(self) -> Response:
        taken = self._next
        assert taken is not None
        self._begun = True
        self._round_waits = False
        self._clock.reached(taken.time_ns)
        self._advance()
        if self._next is None and self._loop:
            self._next_round()
        return taken.message

    def skip_due_before(self, time_ns: int) -> None:
        """Skip nothing: a recording is played whole."""

    def command_done(self, command: Command[Response], now_ns: int) -> None:
        """Begin when the host starts the radar; wait on while it asks and configures."""
        if self._begun:
            return
        if not self._listening:
            self.port_opened(now_ns)
        if self._clock.anchor_ns > now_ns:
            self._clock.anchor_ns = now_ns if _starts_radar(command) else now_ns + QUIET_NS

    def port_opened(self, now_ns: int) -> None:
        """Play from the beginning, or from where a seek without a host went, soon."""
        self._begun = False
        self._listening = True
        self._go(self._sought_ns or 0, now_ns + QUIET_NS)
        self._sought_ns = None

    def port_closed(self, now_ns: int) -> None:
        self._begun = self._listening = self._round_waits = False
        self._coming = iter(())
        self._next = None

    def state(self, now_ns: int) -> dict[str, Any]:
        """Return what it is doing, as JSON-able values.

        ``playing``: a host has the port and something is left to play. ``position_s``, since the
        first message, lies below 0 in the gap between two rounds.
        """
        return {
            "playing": self._listening and self._next is not None,
            "paused": self._clock.paused,
            "position_s": self._clock.position_ns(now_ns) / NS_PER_S,
            "rate": self._clock.rate,
            "loop": self._loop,
        }

    def pause(self, now_ns: int) -> None:
        """Stand still: no message becomes due until `resume`, not even one the line made wait."""
        self._clock.pause(now_ns)

    def resume(self, now_ns: int) -> None:
        """Go on where `pause` stopped; the time between two messages is that of the recording."""
        self._clock.resume(now_ns)

    def set_rate(self, rate: float, now_ns: int) -> None:
        """Go on at another multiple of real time; 0 for as fast as the line takes it.

        Raises
        ------
        ValueError
            When it is neither 0 nor a finite number of at least `SLOWEST_RATE`.
        """
        if rate and not SLOWEST_RATE <= rate < math.inf:
            raise ValueError(f"rate {rate:g} is neither 0 nor a number from {SLOWEST_RATE:g} on")
        self._clock.set_rate(rate, now_ns)

    def seek(self, position_ns: int, now_ns: int) -> None:
        """Go on at once with the first message at or after a time of the recording.

        At the end it stops, or in a loop the next round follows. Without a host,
        the next one begins there.

        Raises
        ------
        ValueError
            When the time lies before the first message.
        """
        if position_ns < 0:
            raise ValueError("a recording begins at 0 s")
        if not self._listening:
            self._sought_ns = position_ns
            return
        self._go(position_ns, max(now_ns, self._clock.anchor_ns))

    def set_loop(self, loop: bool, now_ns: int) -> None:
        """Begin again at the end, or not; at the end already, begin again at once."""
        self._loop = loop
        if not self._listening:
            return
        if loop and self._next is None:
            self._go(0, now_ns)
        elif not loop and self._round_waits:
            self._next = None

    def _go(self, position_ns: int, at_ns: int) -> None:
        self._round_waits = False
        self._open(position_ns)
        past_the_end = self._next is None and self._last_ns < position_ns
        self._clock.start(self._last_ns if past_the_end else position_ns, at_ns)
        if self._next is None and self._loop:
            self._next_round()

    def _next_round(self) -> None:
        self._clock.wrap(self._last_ns + self._gap_ns)
        self._round_waits = True
        self._open(0)

    def _open(self, position_ns: int) -> None:
        self._coming = iter(self._timed)
        self._last_ns = 0
        self._advance()
        while self._next is not None and self._next.time_ns < position_ns:
            self._advance()

    def _advance(self) -> None:
        self._next = next(self._coming, None)
        if self._next is not None:
            self._last_ns = self._next.time_ns


def _starts_radar(command: Command[Response]) -> bool:
    match command:
        case X4DriverSet(setting=X4Setting.FPS, value=float(fps)):
            return fps > 0
        case SetMode(mode=SensorMode.XTID_SM_RUN):
            return True
    return False


class PlayedChip(Chip):
    """A chip whose frames come from a recording.

    It takes every setting. FRAMEBINCOUNT answers the recorded frames' bins, RF or baseband as
    DOWNCONVERSION was set, since a frame does not say which it is (protocol reference 6.1).
    FRAMEAREA answers the recorded area, if known, else the requested start and as many bins.

    Parameters
    ----------
    n_values
        float32 values per frame: bins of RF, or twice the bins of baseband.
    area_m
        Frame area as the recorded module read it back last [module metres]; None if unknown.
    """

    def __init__(self, n_values: int, area_m: tuple[float, float] | None) -> None:
        self._n_values = n_values
        self._area_m = area_m
        super().__init__(echo_source(empty_room(), 0, 0))

    def get(self, setting: X4Setting) -> X4Value:
        downconverted = self.settings.is_baseband
        n_bins = self._n_values // 2 if downconverted else self._n_values
        if setting is X4Setting.FRAMEBINCOUNT:
            return n_bins
        if setting is X4Setting.FRAMEAREA:
            if self._area_m is not None:
                return self._area_m
            start_m = self.area.start_m
            bin_m = x4.BASEBAND_BIN_M if downconverted else x4.RF_BIN_M
            end_m = start_m + bin_m * (n_bins - 1 if downconverted else n_bins)
            return start_m, float(np.float32(end_m))
        return super().get(setting)


@dataclass(frozen=True, slots=True, kw_only=True)
class PlayedRadar:
    """One radar of a recording, played by a module of its own.

    Its port is called as in the recording where there are several radars and all names are plain
    ones, else ``player`` or ``radar0``, ``radar1`` and so on.
    """

    name: str
    serial: str
    device: Device
    stream: PlayStream


def played_radars(
    recording: Path,
    *,
    rate: float = 1.0,
    loop: bool = False,
    on_fault: Callable[[RecordingFault], None],
    warn: Callable[[str], None] = lambda line: None,
) -> tuple[PlayedRadar, ...]:
    """Return one module per radar of a recording; each plays to the host that opens its port.

    The recording is read once per radar now and again for every host, so that it may be larger
    than the memory. Times of all radars count from the first message of any. Recorded answers are
    not played: the module answers for itself.

    Parameters
    ----------
    recording
        Anything that `read_recording` takes, and sessions of several radars.
    rate
        As of `PlayStream`.
    on_fault
        Called with what could not be read; the rest plays.
    warn
        Called with one line about what the recording does not say.

    Raises
    ------
    RecordingError
        When the recording cannot be read, holds nothing to play or would play for weeks.
    """
    surveys: list[_Survey] = []
    for name, about in (recording_content(recording).radars or {"": {}}).items():
        surveys.append(_Survey(recording, name or None, about, on_fault))
        on_fault = _reported_already
    zero_ns = min((s.first_ns for s in surveys if s.first_ns is not None), default=0)
    _check(recording, surveys, zero_ns, rate=rate, loop=loop)
    end_ns = max(survey.offset_ns(zero_ns) + survey.lasts_ns for survey in surveys)
    playing = [survey for survey in surveys if survey.plays]
    port_names = _port_names([survey.name for survey in playing])
    played = []
    for port_name, survey in zip(port_names, playing, strict=True):
        offset_ns = survey.offset_ns(zero_ns)
        stream = PlayStream(
            _Program(recording, survey.name, offset_ns, warn),
            # rounds of all radars are equally long, so that a loop keeps them in step
            loop_gap_ns=end_ns - offset_ns - survey.lasts_ns + NOMINAL_PERIOD_NS,
            rate=rate,
        )
        stream.set_loop(loop, 0)
        serial = survey.serial
        module = Module(Identity(serial=serial), _chip(recording, survey, warn))
        device = Device(module, stream, LosslessOutbox())
        played.append(PlayedRadar(name=port_name, serial=serial, device=device, stream=stream))
    return tuple(played)


class _Survey:
    """What one reading of a radar's recording shows, before anything is played."""

    def __init__(
        self,
        recording: Path,
        name: str | None,
        about: Mapping[str, Any],
        on_fault: Callable[[RecordingFault], None],
    ) -> None:
        self.name = name
        self.serial, self.area_m = _described(about)
        self.messages = 0
        self.plays = False
        self.first_ns: int | None = None
        self.lasts_ns = 0
        self.frame_sizes: Counter[int] = Counter()
        records = read_recording(recording, on_fault, radar=name)
        for timed in schedule(self._played(records)):
            self.plays = True
            self.lasts_ns = timed.time_ns

    def offset_ns(self, zero_ns: int) -> int:
        """How much later than the recording this radar begins, ns."""
        return 0 if self.first_ns is None else self.first_ns - zero_ns

    def _played(self, records: Iterable[tuple[Response, int | None]]) -> TimedMessages:
        for message, stamp_ns in records:
            self.messages += 1
            match message:
                case DataFloat(content_id=0):
                    self.frame_sizes[message.values.size] += 1
                case ReplyFloat(content_id=X4Setting.FRAMEAREA, values=(start_m, end_m)):
                    self.area_m = start_m, end_m  # overrides the description of the radar
            if not is_answer(message):
                if not self.plays:
                    self.first_ns = stamp_ns
                yield message, stamp_ns


def _described(about: Mapping[str, Any]) -> tuple[str, tuple[float, float] | None]:
    """Return serial number and frame area [module metres] in a radar's description, if valid."""
    try:
        bin_m = float(about["bin_length_m"])
        area_m = FrameGeometry(
            range_start_m=float(about["range_start_m"]),
            bin_length_m=bin_m,
            n_bins=int(about["n_bins"]),
            downconversion=bin_m > 4 * x4.RF_BIN_M,
        ).area_m
    except (KeyError, ValueError, TypeError, OverflowError):
        return _NO_SERIAL, None
    serial = about.get("serial")
    return (
        serial if isinstance(serial, str) and _SERIAL.fullmatch(serial) else _NO_SERIAL,
        area_m if all(map(math.isfinite, area_m)) else None,
    )


def _check(
    recording: Path,
    surveys: Iterable[_Survey],
    zero_ns: int,
    *,
    rate: float,
    loop: bool,
) -> None:
    if not any(survey.messages for survey in surveys):
        raise RecordingError(f"{recording}: the recording holds no messages")
    if not any(survey.plays for survey in surveys):
        raise RecordingError(f"{recording}: the recording holds answers only, nothing to play")
    last_ns = max(s.offset_ns(zero_ns) + s.lasts_ns for s in surveys if s.plays)
    longest_ns = max(last_ns, NOMINAL_PERIOD_NS if loop else 0)
    if rate and longest_ns > _LONGEST_S * NS_PER_S * rate:
        raise RecordingError(
            f"{recording}: at rate {rate:g} it would play for more than "
            f"{_LONGEST_S // 86400} days; rate 0 plays as fast as the port takes it"
        )


def _chip(recording: Path, survey: _Survey, warn: Callable[[str], None]) -> Chip:
    if not survey.frame_sizes:
        return Chip(echo_source(empty_room(), 0, 0))
    if survey.area_m is None:
        warn(
            f"{recording} does not say where its radar frames lie in range: bins count from the "
            "start of the frame area that the host sets"
        )
    # of several sizes the most frequent counts
    return PlayedChip(survey.frame_sizes.most_common(1)[0][0], survey.area_m)


def _port_names(names: Sequence[str | None]) -> list[str]:
    """Return what ports are called; names come from a file and shall not lead anywhere else."""
    if len(names) == 1:
        return [_ONLY_NAME]
    if all(name is not None and _PLAIN_NAME.fullmatch(name) for name in names):
        return [str(name) for name in names]
    return [f"radar{index}" for index in range(len(names))]


@dataclass(frozen=True, slots=True)
class _Program:
    """What is played, read from the disk again each time; its faults were reported before."""

    recording: Path
    radar: str | None
    offset_ns: int
    warn: Callable[[str], None]

    def __iter__(self) -> Iterator[TimedMessage]:
        try:
            records = read_recording(self.recording, _reported_already, radar=self.radar)
            played = (item for item in records if not is_answer(item[0]))
            for item in schedule(played):
                yield TimedMessage(item.time_ns + self.offset_ns, item.message)
        except RecordingError as error:  # it was moved or changed meanwhile
            self.warn(str(error))


def _reported_already(fault: RecordingFault) -> None:
    del fault

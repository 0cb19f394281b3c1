"""From a recording on disk to the modules that play it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from emulator.chip import Chip
from emulator.commands import Module
from emulator.device import BootTiming, Device
from emulator.echo import echo_source
from emulator.identity import Identity
from emulator.outbox import LosslessOutbox
from emulator.playback_control import is_answer
from emulator.played_chip import FrameSurvey, PlayedChip, PlayedFrames
from emulator.player import NOMINAL_PERIOD_NS, NS_PER_S, PlayStream, TimedMessage, schedule
from emulator.scene import empty_room
from xethru_protocol.messages import Response
from xethru_protocol.recordings import (
    RadarFacts,
    RecordingError,
    RecordingFault,
    read_recording,
    recording_radars,
)
from xethru_protocol.recordings.records import TimedMessages

__all__ = ["PlayOptions", "PlayedRadar", "RecordingError", "played_radars"]

_ONLY_NAME = "player"
_PLAIN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")
_SERIAL = re.compile(r"[0-9]{12}")
_NO_SERIAL = "0" * 12
_LONGEST_S = 20 * 86400  # the system waits at most 24 days for anything


@dataclass(frozen=True, slots=True, kw_only=True)
class PlayOptions:
    """How a recording is played; all of it can be changed while it plays.

    Attributes
    ----------
    rate
        Multiple of real time; 0 for as fast as the port takes it.
    loop
        Whether to begin again at the end.
    from_ns
        Where every host and round begins, ns since the first message of the recording.
    kinds
        Which kinds of messages, as from `playback_control.kinds`; None for all.
    """

    rate: float = 1.0
    loop: bool = False
    from_ns: int = 0
    kinds: frozenset[str] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class PlayedRadar:
    """One radar of a recording, played by a module of its own.

    Attributes
    ----------
    name
        What its port is called: its name in the recording where there are several radars and all
        names are plain ones, else ``player`` or ``radar0``, ``radar1`` and so on.
    serial
        Serial number it answers with: the recorded one where that is known.
    device
        The module.
    stream
        What it plays; takes the controls.
    """

    name: str
    serial: str
    device: Device
    stream: PlayStream


def played_radars(
    recording: Path,
    options: PlayOptions,
    *,
    identity: Identity | None = None,
    on_fault: Callable[[RecordingFault], None],
    warn: Callable[[str], None] = lambda line: None,
) -> tuple[PlayedRadar, ...]:
    """Return one module per radar of a recording; each plays its own to whoever opens its port.

    The recording is read once per radar now and again for every host, so that it may be larger
    than the memory. Times of all radars count from the first message of any.

    Recorded answers are not played: nobody asks for them, and the module answers for itself.

    Parameters
    ----------
    recording
        Anything that `read_recording` takes, and sessions of several radars.
    options
        How it is played.
    identity
        What every module says about itself; None: a stock one with the recorded serial number.
    on_fault
        Called with what could not be read; the rest plays.
    warn
        Called with one line about what the recording does not tell.

    Raises
    ------
    RecordingError
        When the recording cannot be read, holds nothing to play or would play for weeks.
    """
    surveys: list[_Survey] = []
    for facts in recording_radars(recording) or (RadarFacts(),):
        surveys.append(_Survey(recording, facts, on_fault))
        on_fault = _told_already
    zero_ns = min((s.first_ns for s in surveys if s.first_ns is not None), default=0)
    _check(recording, surveys, zero_ns, options)
    end_ns = max(survey.offset_ns(zero_ns) + survey.lasts_ns for survey in surveys)
    playing = [survey for survey in surveys if survey.plays]
    names = _port_names([survey.facts.name for survey in playing])
    played = []
    for name, survey in zip(names, playing, strict=True):
        who = identity or Identity(serial=_serial(survey.facts))
        device, stream = _player(
            recording, survey, who, options, zero_ns=zero_ns, end_ns=end_ns, warn=warn
        )
        played.append(PlayedRadar(name=name, serial=who.serial, device=device, stream=stream))
    return tuple(played)


class _Survey:
    """What one reading of a radar's recording tells, before anything is played."""

    def __init__(
        self, recording: Path, facts: RadarFacts, on_fault: Callable[[RecordingFault], None]
    ) -> None:
        self.facts = facts
        self.messages = 0
        self.plays = False
        self.first_ns: int | None = None
        self.lasts_ns = 0
        self._frames = FrameSurvey()
        records = read_recording(recording, on_fault, radar=facts.name)
        for timed in schedule(self._played(records), rate=1.0):
            self.plays = True
            self.lasts_ns = timed.time_ns

    @property
    def frames(self) -> PlayedFrames | None:
        """The radar frames; what a module answered counts more than what is said of it."""
        found = self._frames.found()
        if found is None or found.area_m is not None:
            return found
        return PlayedFrames(n_values=found.n_values, area_m=self.facts.area_m)

    def offset_ns(self, zero_ns: int) -> int:
        """How much later than the recording this radar begins, ns."""
        return 0 if self.first_ns is None else self.first_ns - zero_ns

    def _played(self, records: Iterable[tuple[Response, int | None]]) -> TimedMessages:
        """Pass on what will be played."""
        for message, stamp_ns in records:
            self.messages += 1
            self._frames.look_at(message)
            if not is_answer(message):
                if not self.plays:
                    self.first_ns = stamp_ns
                yield message, stamp_ns


def _check(recording: Path, surveys: Iterable[_Survey], zero_ns: int, options: PlayOptions) -> None:
    """Refuse what would play nothing, or for ever."""
    if not any(survey.messages for survey in surveys):
        raise RecordingError(f"{recording}: the recording holds no messages")
    if not any(survey.plays for survey in surveys):
        raise RecordingError(f"{recording}: the recording holds answers only, nothing to play")
    last_ns = max(s.offset_ns(zero_ns) + s.lasts_ns for s in surveys if s.plays)
    if options.from_ns > last_ns:
        raise RecordingError(f"{recording} is over after {last_ns / NS_PER_S:.3f} s")
    longest_ns = max(last_ns, NOMINAL_PERIOD_NS if options.loop else 0)
    if options.rate and longest_ns > _LONGEST_S * NS_PER_S * options.rate:
        raise RecordingError(
            f"{recording}: at rate {options.rate:g} it would play for more than "
            f"{_LONGEST_S // 86400} days; rate 0 plays as fast as the port takes it"
        )


def _player(
    recording: Path,
    survey: _Survey,
    identity: Identity,
    options: PlayOptions,
    *,
    zero_ns: int,
    end_ns: int,
    warn: Callable[[str], None],
) -> tuple[Device, PlayStream]:
    frames, offset_ns = survey.frames, survey.offset_ns(zero_ns)
    if frames is not None and frames.area_m is None:
        warn(
            f"{recording} does not say where its radar frames lie in range: bins count from the "
            "start of the frame area that the host sets"
        )
    stream = PlayStream(
        _Program(recording, survey.facts.name, offset_ns, warn),
        # rounds of all radars are equally long, so that a loop keeps them in step
        loop_gap_ns=end_ns - offset_ns - survey.lasts_ns + NOMINAL_PERIOD_NS,
        rate=options.rate,
        from_ns=options.from_ns,
        kinds=options.kinds,
    )
    stream.set_loop(options.loop, 0)
    chip = Chip(echo_source(empty_room(), 0, 0)) if frames is None else PlayedChip(frames)
    return Device(Module(identity, chip), stream, LosslessOutbox(), boot=BootTiming()), stream


def _port_names(names: Sequence[str | None]) -> list[str]:
    """Return what ports are called; names come from a file and shall not lead anywhere else."""
    if len(names) == 1:
        return [_ONLY_NAME]
    if all(name is not None and _PLAIN_NAME.fullmatch(name) for name in names):
        return [str(name) for name in names]
    return [f"radar{index}" for index in range(len(names))]


def _serial(facts: RadarFacts) -> str:
    serial = facts.serial or ""
    return serial if _SERIAL.fullmatch(serial) else _NO_SERIAL


@dataclass(frozen=True, slots=True)
class _Program:
    """What is played, read from the disk again each time; its faults are told already."""

    recording: Path
    radar: str | None
    offset_ns: int
    warn: Callable[[str], None]

    def __iter__(self) -> Iterator[TimedMessage]:
        try:
            records = read_recording(self.recording, _told_already, radar=self.radar)
            played = (item for item in records if not is_answer(item[0]))
            for item in schedule(played, rate=1.0):
                yield TimedMessage(time_ns=item.time_ns + self.offset_ns, message=item.message)
        except RecordingError as error:  # somebody moved it meanwhile
            self.warn(str(error))


def _told_already(fault: RecordingFault) -> None:
    del fault

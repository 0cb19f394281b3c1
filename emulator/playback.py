"""From a recording on disk to a module that plays it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from emulator.chip import Chip
from emulator.commands import Module
from emulator.device import BootTiming, Device
from emulator.echo import echo_source
from emulator.identity import Identity
from emulator.outbox import LosslessOutbox
from emulator.played_chip import FrameSurvey, PlayedChip
from emulator.player import NOMINAL_PERIOD_NS, NS_PER_S, PlayStream, TimedMessage, schedule
from emulator.scene import empty_room
from xethru_protocol.codes import ResponseCode
from xethru_protocol.messages import Response
from xethru_protocol.recordings import RecordingError, RecordingFault, read_recording
from xethru_protocol.recordings.records import TimedMessages
from xethru_protocol.table import ROWS, UnknownMessage

__all__ = ["RecordingError", "recording_device"]

_LONGEST_S = 20 * 86400  # the system waits at most 24 days for anything
_ANSWERS = frozenset(
    (
        ResponseCode.XTS_SPR_ACK,
        ResponseCode.XTS_SPR_ERROR,
        ResponseCode.XTS_SPR_PONG,
        ResponseCode.XTS_SPR_REPLY,
        ResponseCode.XTS_SPR_HIL,
    )
)


def recording_device(
    recording: Path,
    identity: Identity,
    *,
    rate: float,
    loop: bool,
    on_fault: Callable[[RecordingFault], None],
    warn: Callable[[str], None] = lambda line: None,
) -> Device:
    """Return a module that plays a recording to whoever opens its port.

    The recording is read once now and again for every host, so that it may be larger than the
    memory.

    Recorded answers are not played: nobody asks for them, and the module answers for itself.

    Parameters
    ----------
    recording
        Anything that `read_recording` takes.
    identity
        What the module says about itself.
    rate
        Multiple of real time; 0 for as fast as the port takes it.
    loop
        Whether to begin again at the end.
    on_fault
        Called with what could not be read; the rest plays.
    warn
        Called with one line about what the recording does not tell.

    Raises
    ------
    RecordingError
        When the recording cannot be read, holds nothing to play or would play for weeks.
    """
    survey = _Survey()
    last_ns: int | None = None
    try:
        for timed in schedule(survey.played(read_recording(recording, on_fault)), rate):
            last_ns = timed.time_ns
        gap_ns = round(NOMINAL_PERIOD_NS / rate) if rate else 0
    except OverflowError:
        raise _too_long(recording, rate) from None
    if not survey.messages:
        raise RecordingError(f"{recording}: the recording holds no messages")
    if last_ns is None:
        raise RecordingError(f"{recording}: the recording holds answers only, nothing to play")
    if max(last_ns, gap_ns) > _LONGEST_S * NS_PER_S:
        raise _too_long(recording, rate)
    frames = survey.frames.found()
    if frames is not None and frames.area_m is None:
        warn(
            f"{recording} does not say where its radar frames lie in range: bins count from the "
            "start of the frame area that the host sets"
        )
    stream = PlayStream(_Program(recording, rate, warn), loop_gap_ns=gap_ns if loop else None)
    chip = Chip(echo_source(empty_room(), 0, 0)) if frames is None else PlayedChip(frames)
    return Device(Module(identity, chip), stream, LosslessOutbox(), boot=BootTiming())


class _Survey:
    """What one reading of the recording tells, before anything is played."""

    def __init__(self) -> None:
        self.messages = 0
        self.frames = FrameSurvey()

    def played(self, records: Iterable[tuple[Response, int | None]]) -> TimedMessages:
        """Pass on what will be played."""
        for message, stamp_ns in records:
            self.messages += 1
            self.frames.look_at(message)
            if not _is_answer(message):
                yield message, stamp_ns


@dataclass(frozen=True, slots=True)
class _Program:
    """What is played, read from the disk again each time; its faults are told already."""

    recording: Path
    rate: float
    warn: Callable[[str], None]

    def __iter__(self) -> Iterator[TimedMessage]:
        try:
            records = read_recording(self.recording, lambda fault: None)
            yield from schedule((item for item in records if not _is_answer(item[0])), self.rate)
        except RecordingError as error:  # somebody moved it meanwhile
            self.warn(str(error))


def _is_answer(message: Response) -> bool:
    if isinstance(message, UnknownMessage):
        return message.code in _ANSWERS
    return ROWS[type(message)].prefix[0] in _ANSWERS


def _too_long(recording: Path, rate: float) -> RecordingError:
    return RecordingError(
        f"{recording}: at rate {rate:g} it would play for more than {_LONGEST_S // 86400} days; "
        "rate 0 plays as fast as the port takes it"
    )

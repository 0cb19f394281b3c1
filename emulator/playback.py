"""From a recording on disk to a module that plays it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from emulator.chip import Chip
from emulator.commands import Module
from emulator.device import BootTiming, Device
from emulator.echo import echo_source
from emulator.identity import Identity
from emulator.outbox import LosslessOutbox
from emulator.played_chip import PlayedChip, PlayedFrames
from emulator.player import NOMINAL_PERIOD_NS, NS_PER_S, PlayStream, schedule
from emulator.scene import empty_room
from xethru_protocol.codec import encode
from xethru_protocol.codes import ResponseCode
from xethru_protocol.messages import Response
from xethru_protocol.recordings import RecordingError, RecordingFault, read_recording

__all__ = ["RecordingError", "recording_device"]

_LONGEST_S = 20 * 86400  # the system waits at most 24 days for anything
_ANSWERS = bytes(
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
    records = list(read_recording(recording, on_fault))
    if not records:
        raise RecordingError(f"{recording}: the recording holds no messages")
    frames = PlayedFrames.of(message for message, _ in records)
    played = [(message, stamp_ns) for message, stamp_ns in records if not _is_answer(message)]
    if not played:
        raise RecordingError(f"{recording}: the recording holds answers only, nothing to play")
    messages = [message for message, _ in played]
    try:
        timed = schedule(messages, [stamp_ns for _, stamp_ns in played], rate)
        gap_ns = round(NOMINAL_PERIOD_NS / rate) if rate else 0
    except OverflowError:
        raise _too_long(recording, rate) from None
    if max(timed[-1].time_ns, gap_ns) > _LONGEST_S * NS_PER_S:
        raise _too_long(recording, rate)
    if frames is not None and frames.area_m is None:
        warn(
            f"{recording} does not say where its radar frames lie in range: bins count from the "
            "start of the frame area that the host sets"
        )
    stream = PlayStream(timed, loop_gap_ns=gap_ns if loop else None)
    chip = Chip(echo_source(empty_room(), 0, 0)) if frames is None else PlayedChip(frames)
    return Device(Module(identity, chip), stream, LosslessOutbox(), boot=BootTiming())


def _is_answer(message: Response) -> bool:
    payload = encode(message)
    return bool(payload) and payload[0] in _ANSWERS


def _too_long(recording: Path, rate: float) -> RecordingError:
    return RecordingError(
        f"{recording}: at rate {rate:g} it would play for more than {_LONGEST_S // 86400} days; "
        "rate 0 plays as fast as the port takes it"
    )

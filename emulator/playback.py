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
from emulator.player import NOMINAL_PERIOD_NS, PlayStream, schedule
from emulator.scene import empty_room
from xethru_protocol.recordings import RecordingError, RecordingFault, read_recording

__all__ = ["RecordingError", "recording_device"]


def recording_device(
    recording: Path,
    identity: Identity,
    *,
    rate: float,
    loop: bool,
    on_fault: Callable[[RecordingFault], None],
) -> Device:
    """Return a module that plays a recording to whoever opens its port.

    Parameters
    ----------
    recording
        Directory in the format of ModuleConnector.
    identity
        What the module says about itself.
    rate
        Multiple of real time; 0 for as fast as the port takes it.
    loop
        Whether to begin again at the end.
    on_fault
        Called with what could not be read; the rest plays.

    Raises
    ------
    RecordingError
        When the recording cannot be read or is empty.
    """
    records = list(read_recording(recording, on_fault))
    if not records:
        raise RecordingError(f"{recording}: the recording holds no messages")
    messages = [message for message, _ in records]
    timed = schedule(messages, [stamp_ns for _, stamp_ns in records], rate)
    gap_ns = round(NOMINAL_PERIOD_NS / rate) if rate else 0
    stream = PlayStream(timed, loop_gap_ns=gap_ns if loop else None)
    module = Module(identity, Chip(echo_source(empty_room(), 0, 0)))
    return Device(module, stream, LosslessOutbox(), boot=BootTiming())

"""What can be wrong with a recording: an error ends the reading, a fault costs a part of it."""

from collections.abc import Callable
from dataclasses import dataclass

from xethru_protocol.errors import XeThruError


class RecordingError(XeThruError):
    """A recording cannot be read or written."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordingFault:
    """A damaged part: what could not be read of ``file`` at byte ``offset``, and why.

    ``minor`` says that no message is lost, only its time or the order among several files.
    """

    file: str
    offset: int
    reason: str
    minor: bool = False


FaultHandler = Callable[[RecordingFault], None]


def report(fault: RecordingFault, on_fault: FaultHandler | None) -> None:
    """Hand a fault over; without a handler, one that costs messages raises `RecordingError`."""
    if on_fault is not None:
        on_fault(fault)
    elif not fault.minor:
        raise RecordingError(f"{fault.file}: {fault.reason} (at byte {fault.offset})")


def unreadable(path: object, error: OSError) -> RecordingError:
    """Return the error that says why the operating system refused to read ``path``."""
    return RecordingError(f"{path} cannot be read: {error.strerror or error}")


def unwritable(path: object, error: OSError) -> RecordingError:
    """Return the error that says why the operating system refused to write ``path``."""
    return RecordingError(f"{path} cannot be written: {error.strerror or error}")

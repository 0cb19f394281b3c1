"""What of a recording could not be read, for people."""

from collections.abc import Sequence

from xethru_protocol.cli.output import one_line, warn
from xethru_protocol.recordings import RecordingFault

_MOST = 10  # lines; a damaged text file has as many faults as lines


def warn_of(command: str, faults: Sequence[RecordingFault]) -> None:
    """Say the first faults one by one, and how many more there are."""
    for fault in faults[:_MOST]:
        warn(
            f"xethru {command}: {one_line(fault.file)}: {one_line(fault.reason)} "
            f"(at byte {fault.offset})"
        )
    if len(faults) > _MOST:
        warn(f"xethru {command}: and {len(faults) - _MOST} faults more")

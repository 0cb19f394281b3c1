"""``xethru convert``: a recording in another format."""

from pathlib import Path

from xethru_protocol.cli.faults import warn_of
from xethru_protocol.cli.output import one_line, print_json, print_line, warn
from xethru_protocol.cli.overwriting import is_part_of, set_aside
from xethru_protocol.cli.progress import Progress, counted
from xethru_protocol.recordings import RecordingError, recording_facts
from xethru_protocol.recordings import convert as convert_recording


def convert(source: str, target: str, *, replace: bool, as_json: bool, radar: str | None) -> int:
    """Write ``source`` again as ``target``; 1 if a part of it could not be read."""
    recording_facts(source)  # raises before anything is removed
    path = Path(target)
    if is_part_of(Path(source), path):
        raise RecordingError(f"{source} cannot be converted into itself")
    progress = Progress("xethru convert")
    newest = 0

    def show(messages: int) -> None:
        nonlocal newest
        newest = messages
        progress.show(lambda: f"{newest} messages")

    with set_aside(path, replace=replace):
        try:
            done = convert_recording(source, target, show, radar=radar)
        finally:
            progress.finish(lambda: f"{newest} messages")
    if as_json:
        print_json(
            {
                "target": target,
                "messages": done.messages,
                "skipped": done.skipped,
                "faults": [
                    {"file": fault.file, "offset": fault.offset, "reason": fault.reason}
                    for fault in done.faults
                ],
            }
        )
    else:
        print_line(f"{one_line(target)}: {counted(done.messages, 'message')}")
    for name, number in sorted(done.skipped.items()):
        warn(f"xethru convert: {number} {name} left out: the format has no place for them")
    warn_of("convert", done.faults)
    return 1 if done.faults else 0

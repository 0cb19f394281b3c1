"""``xethru convert``: a recording in another format."""

import os
from pathlib import Path

from xethru_protocol.cli.output import one_line, print_json, print_line, warn
from xethru_protocol.cli.overwriting import make_room, remove_unfinished
from xethru_protocol.cli.progress import Progress
from xethru_protocol.recordings import RecordingError, recording_facts
from xethru_protocol.recordings import convert as convert_recording


def convert(source: str, target: str, *, replace: bool, as_json: bool) -> int:
    """Write ``source`` again as ``target``; 1 if a part of it could not be read."""
    recording_facts(source)  # raises before anything is removed
    path = Path(target)
    was_there = path.exists()
    if was_there and os.path.samefile(source, target):
        raise RecordingError(f"{source} cannot be converted into itself")
    make_room((path,), replace=replace)
    progress = Progress("xethru convert")
    newest = 0

    def show(messages: int) -> None:
        nonlocal newest
        newest = messages
        progress.show(lambda: f"{newest} messages")

    try:
        done = convert_recording(source, target, show)
    except BaseException:  # a half-written file would pass for a whole one
        remove_unfinished(path, was_there=was_there)
        raise
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
        print_line(f"{one_line(target)}: {done.messages} messages")
    for name, number in sorted(done.skipped.items()):
        warn(f"xethru convert: {number} {name} left out: the format has no place for them")
    for fault in done.faults:
        warn(f"xethru convert: {one_line(fault.file)}: {fault.reason} (at byte {fault.offset})")
    return 1 if done.faults else 0

"""From any kind of recording to any other.

What is lost, and nothing else: vendor directories cut times to 1 ms, know none before the first
message's, give a message without a time that of the one before, and have no place for answers,
system messages and the like; text files of theirs lose the payload bits of a NaN. Only wire
captures hold what the host sent and how messages lay in packets. Messages are written as the
message table encodes them: with a trailer or NUL that was left out, without what lies behind the
last field.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from xethru_protocol.connection import Connection, Role
from xethru_protocol.recordings import npz, wire_capture
from xethru_protocol.recordings.detect import message_name, read_recording, recording_facts
from xethru_protocol.recordings.errors import RecordingError, RecordingFault
from xethru_protocol.recordings.records import RecordingFacts, Timed
from xethru_protocol.recordings.vendor_writer import RecordingWriter

_PROGRESS_EVERY = 1000


@dataclass(frozen=True, slots=True, kw_only=True)
class Conversion:
    """What a conversion did.

    Attributes
    ----------
    messages
        How many messages were written.
    skipped
        By name, how many the target's format has no place for.
    faults
        What could not be read from the source.
    """

    messages: int
    skipped: dict[str, int]
    faults: tuple[RecordingFault, ...]


def convert(
    source: Path | str,
    target: Path | str,
    on_progress: Callable[[int], None] | None = None,
    *,
    radar: str | None = None,
) -> Conversion:
    """Write a recording again in the format that the target's suffix names.

    Parameters
    ----------
    source
        Any recording that `read_recording` takes.
    target
        A new file ``*.mcap``, ``*.npz`` or ``*.xtwire``; a name without suffix is a new
        directory of ModuleConnector.
    on_progress
        Called with the number of messages so far, every thousand and at the end.
    radar
        Which radar of a session of several, as in `read_recording`.

    Raises
    ------
    RecordingError
        If the source cannot be read, the target exists or cannot be written, or its suffix
        names no format.
    """
    source, target = Path(source), Path(target)
    write = _writer(target)
    faults: list[RecordingFault] = []
    facts = recording_facts(source)
    counted = _Counted(read_recording(source, faults.append, radar=radar), on_progress)
    skipped = write(target, iter(counted), facts)
    if on_progress is not None:
        on_progress(counted.messages)
    return Conversion(
        messages=counted.messages - sum(skipped.values()),
        skipped=dict(skipped),
        faults=tuple(faults),
    )


@dataclass(slots=True)
class _Counted:
    """Counts the messages that pass."""

    source: Iterator[Timed]
    on_progress: Callable[[int], None] | None
    messages: int = 0

    def __iter__(self) -> Iterator[Timed]:
        for timed in self.source:
            yield timed
            self.messages += 1
            if self.on_progress is not None and self.messages % _PROGRESS_EVERY == 0:
                self.on_progress(self.messages)


_Writer = Callable[[Path, Iterator[Timed], RecordingFacts], Counter[str]]


def _writer(target: Path) -> _Writer:
    if target.is_dir() or not target.suffix:
        return _to_vendor
    writers: dict[str, _Writer] = {
        ".mcap": _to_mcap,
        npz.SUFFIX: _to_npz,
        wire_capture.SUFFIX: _to_wire,
    }
    writer = writers.get(target.suffix)
    if writer is None:
        known = ", ".join(writers)
        raise RecordingError(
            f"{target}: no format has the suffix {target.suffix}; known are {known},"
            " and none for a directory of ModuleConnector"
        )
    if target.exists():
        raise RecordingError(f"{target} exists already")
    return writer


def _to_vendor(target: Path, messages: Iterator[Timed], facts: RecordingFacts) -> Counter[str]:
    skipped: Counter[str] = Counter()
    last_ns = 0
    with RecordingWriter(
        target,
        session_id=facts.session_id,
        profile_id=facts.profile_id,
        parameter_file=facts.parameter_file,
        user_header=facts.user_header,
    ) as writer:
        for message, t_ns in messages:
            last_ns = last_ns if t_ns is None else t_ns
            if not writer.write(message, last_ns):
                skipped[message_name(message)] += 1
        writer.close(stopped_ns=facts.stopped_ns, closed_ns=facts.closed_ns)
    return skipped


def _to_npz(target: Path, messages: Iterator[Timed], facts: RecordingFacts) -> Counter[str]:
    npz.write_npz(target, messages, facts)
    return Counter()


def _to_mcap(target: Path, messages: Iterator[Timed], facts: RecordingFacts) -> Counter[str]:
    from xethru_protocol.recordings.mcap_file import write_mcap

    write_mcap(target, messages, facts)
    return Counter()


def _to_wire(target: Path, messages: Iterator[Timed], facts: RecordingFacts) -> Counter[str]:
    module = Connection(Role.MODULE)
    with wire_capture.WireCapture(target, {"facts": facts.as_json()}) as capture:
        for message, t_ns in messages:
            capture.write("rx", module.send(message), t_ns)
    return Counter()

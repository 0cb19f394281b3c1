"""Conversion of any recording into any format.

What is lost, and nothing else: vendor directories cut times to 1 ms, know none before the first
message's, give a message without a time that of the one before, have no place for answers, system
messages and the like, nor for the counter of RESP_STATUS; text files of theirs lose the payload
bits of a NaN. A recording that was split into files or directories comes out as one. Only wire
captures hold what the host sent and how messages lay in packets. Messages are written as the
message table encodes them: with a trailer or NUL that was left out, without what lies behind the
last field. ``.csv``, ``.mat`` and ``.npz`` hold the frames only, as `load` gives them. Lines of
other sensors are in MCAP only.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from xethru_protocol.recordings import pcap, wire_capture
from xethru_protocol.recordings.array_files import SUFFIXES, is_array_file, write_array_file
from xethru_protocol.recordings.formats import (
    message_name,
    read_recording,
    recording_content,
    recording_facts,
    recording_format,
    refuse_name,
)
from xethru_protocol.recordings.frame_layout import FrameGeometries
from xethru_protocol.recordings.loading import load
from xethru_protocol.recordings.recorded_messages import (
    RecordingError,
    RecordingFacts,
    RecordingFault,
    TimedMessages,
    optional_packages,
)
from xethru_protocol.recordings.vendor.writer import RecordingWriter
from xethru_protocol.validation import suffix_of
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.messages import DataFloat


@dataclass(frozen=True, slots=True, kw_only=True)
class Conversion:
    """What a conversion did: messages written, and by name those the format has no place for.

    A file of arrays has frames in place of messages; ``inferred`` says what they are, if that is a
    conclusion from their samples.
    """

    messages: int
    skipped: dict[str, int]
    faults: tuple[RecordingFault, ...]
    inferred: str | None = None


def convert(
    source: Path | str,
    target: Path | str,
    on_progress: Callable[[int], None] | None = None,
    *,
    radar: str | None = None,
    area_m: tuple[float, float] | None = None,
    downconversion: bool | None = None,
) -> Conversion:
    """Write a recording again in the format that the target's suffix names.

    RecordingError if the source cannot be read, the target exists or cannot be written, or its
    suffix names no format.

    Parameters
    ----------
    source
        Any recording that `read_recording` takes.
    target
        A new file ``*.mcap``, ``*.xtwire`` or, of a wire capture, ``*.pcap``; ``*.csv``, ``*.mat``
        or ``*.npz`` for arrays; a name without suffix is a new directory of ModuleConnector.
    on_progress
        Called with the number of messages so far, every thousand and at the end.
    radar
        Which radar of a session of several, as in `read_recording`.
    area_m, downconversion
        What the frames of a file of arrays are, where the source does not say it, as in `load`.
    """
    source, target = Path(source), Path(target)
    faults: list[RecordingFault] = []
    suffix = suffix_of(target)
    if suffix and target.exists():
        raise RecordingError(f"{target} exists already")
    if suffix in SUFFIXES:
        loaded = load(source, faults.append, area_m=area_m, downconversion=downconversion)
        frames = loaded.named(radar).frames
        write_array_file(target, frames)
        if on_progress is not None:
            on_progress(frames.n_frames)
        skipped = {f"lines of {name}": len(text.lines) for name, text in loaded.texts.items()}
        return Conversion(
            messages=frames.n_frames,
            skipped=skipped,
            faults=tuple(faults),
            inferred=frames.about if frames.inferred else None,
        )
    if is_array_file(source):
        raise RecordingError(
            f"{source} holds arrays; it converts to {', '.join(SUFFIXES)}. Messages of an older"
            " .npz are converted by the version that wrote it"
        )
    if suffix == pcap.SUFFIX:
        if recording_format(source) != "wire":
            raise RecordingError(
                f"{source} has no raw bytes, which {target} needs; record them with"
                " 'xethru record --wire', or take them out of a session with 'uwb-slam convert'"
            )
        refuse_name(source, radar)
        packets = pcap.write_pcap(source, target, faults.append)
        return Conversion(messages=packets, skipped={}, faults=tuple(faults))
    write = _writer(target, suffix)
    facts, content = recording_facts(source, faults.append), recording_content(source)
    described = content.radars.get(radar or next(iter(content.radars), ""), {})
    about = {
        name: value for name, value in described.items() if name != "name" and value is not None
    }
    n_messages = 0

    def counted() -> TimedMessages:
        nonlocal n_messages
        for timed in read_recording(source, faults.append, radar=radar):
            yield timed
            n_messages += 1
            if on_progress is not None and n_messages % 1000 == 0:
                on_progress(n_messages)

    skipped = write(target, counted(), facts, about) or {}
    n_messages -= sum(skipped.values())
    if on_progress is not None:
        on_progress(n_messages)
    for name, lines in content.texts.items():
        skipped[f"lines of {name}"] = len(lines)
    return Conversion(messages=n_messages, skipped=skipped, faults=tuple(faults))


_Writer = Callable[[Path, TimedMessages, RecordingFacts, Mapping[str, Any]], dict[str, int] | None]


def _writer(target: Path, suffix: str) -> _Writer:
    """Return what writes ``target``; it returns by name how many messages it left out, if any."""
    match suffix:
        case "":
            return _write_vendor
        case ".mcap":
            with optional_packages():
                from xethru_protocol.recordings.mcap import write_mcap

            return write_mcap
        case wire_capture.SUFFIX:
            return _write_wire
    raise RecordingError(
        f"{target}: no format has the suffix {suffix}; known are .mcap, {wire_capture.SUFFIX},"
        f" {pcap.SUFFIX}, {', '.join(SUFFIXES)}, and none for a directory of ModuleConnector"
    )


def _write_vendor(
    target: Path, messages: TimedMessages, facts: RecordingFacts, about: Mapping[str, Any]
) -> dict[str, int]:
    skipped: Counter[str] = Counter()
    last_ns = 0
    geometries = FrameGeometries()  # by answers, for which there is no place
    answered: dict[str, Any] = {}
    with RecordingWriter(
        target,
        session_id=facts.session_id,
        profile_id=facts.profile_id,
        parameter_file=facts.parameter_file,
        user_header=facts.user_header,
    ) as writer:
        for message, t_ns in messages:
            last_ns = last_ns if t_ns is None else t_ns
            geometries.take(message)
            if not answered and isinstance(message, DataFloat) and geometries.of(message):
                answered = geometries.about(message)
            if not writer.write(message, last_ns):
                skipped[message_name(message)] += 1
        if answered or about:
            writer.describe(answered | {**about})
        writer.close(stopped_ns=facts.stopped_ns, closed_ns=facts.closed_ns)
    return dict(skipped)


def _write_wire(
    target: Path, messages: TimedMessages, facts: RecordingFacts, about: Mapping[str, Any]
) -> None:
    module = Connection(Role.MODULE)
    note = {"facts": facts.as_json(), "radar": dict(about)}
    with wire_capture.WireCapture(target, note) as capture:
        for message, t_ns in messages:
            capture.write("rx", module.send(message), t_ns)

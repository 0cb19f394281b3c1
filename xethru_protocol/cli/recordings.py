"""``xethru decode``, ``dump`` and ``convert``, and the files that a new recording replaces."""

import json
import sys
from argparse import Namespace
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from xethru_protocol.cli.output import (
    CommandFailed,
    Progress,
    bytes_text,
    counted,
    print_json,
    print_line,
    print_text,
    profile_name,
    warn,
    warn_of,
)
from xethru_protocol.export.kaitai import structure
from xethru_protocol.export.wireshark import dissector
from xethru_protocol.operating_system import (
    PathInUseError,
    built_aside,
    one_line,
    sync,
    written_whole,
)
from xethru_protocol.recordings import (
    FrameLayout,
    RecordingError,
    RecordingFault,
    RecordingSummary,
    describe_recording,
    read_recording,
    recording_facts,
)
from xethru_protocol.recordings import convert as convert_recording
from xethru_protocol.recordings.array_files import SUFFIXES, is_array_file
from xethru_protocol.recordings.recorded_messages import doing, writing
from xethru_protocol.recordings.vendor.reader import data_files
from xethru_protocol.recordings.wire_capture import MAGIC as WIRE_CAPTURE
from xethru_protocol.validation import shown, suffix_of
from xethru_protocol.wire.codec import decode_command, decode_response, describe, encode
from xethru_protocol.wire.codes import PongCode
from xethru_protocol.wire.errors import LocalProtocolError
from xethru_protocol.wire.fields import hex_bytes
from xethru_protocol.wire.framing import (
    Direction,
    Framing,
    FramingFault,
    LinkStatistics,
    Packet,
    PacketReader,
)
from xethru_protocol.wire.messages import Ack, DataFloat, Message, Pong, Response, UnknownMessage
from xethru_protocol.wire.table import ROWS

_CHUNK_BYTES = 65536


def decode(arguments: Namespace) -> int:
    """Print one JSON object per packet and per fault; totals at the end, on stderr, if wanted."""
    file = None if arguments.file == "-" else arguments.file
    sender = arguments.sender
    name = file or "standard input"
    statistics = LinkStatistics()
    if file is None and sys.stdin is None:
        raise CommandFailed("standard input is closed; there is nothing to decode")
    try:
        with Path(file).open("rb") if file else nullcontext(sys.stdin.buffer) as source:
            if arguments.hex:
                for number, line in enumerate(source, start=1):
                    _print_all(iter((_from_hex(line, name, number),)), sender, statistics)
            else:
                _print_all(_chunks(source, name), sender, statistics)
    except BrokenPipeError:  # of stdout
        raise
    except OSError as error:
        raise CommandFailed(f"{name} cannot be read: {error.strerror}") from None
    finally:
        if arguments.statistics:
            warn(json.dumps(statistics.summary()))
    return 0


def message_of(packet: Packet, sender: str) -> Message:
    """Message of a packet from ``sender``: "host", "module", or "auto" to judge by structure.

    Of two readings the one that explains every byte wins. PING and PONG look alike: a value
    that modules answer with is a PONG. An ACK is its code alone: with more behind it the code
    is APPCOMMAND's, also if its content is not known.
    """
    payload = packet.payload
    if sender == "host":
        return decode_command(payload)
    response = decode_response(payload)
    if sender == "module" or packet.framing is Framing.NO_ESCAPE:
        return response
    command = decode_command(payload)
    if isinstance(response, Ack) and len(payload) == 1:
        return response
    if not _explains(command, payload):
        return command if isinstance(response, UnknownMessage | Ack) else response
    if isinstance(response, Pong):
        return response if response.value in set(PongCode) else command
    return response if _explains(response, payload) else command


def _explains(message: Message, payload: bytes) -> bool:
    try:
        return not isinstance(message, UnknownMessage) and encode(message, bulk=False) == payload
    except LocalProtocolError:
        return False


def _print_all(chunks: Iterable[bytes], sender: str, statistics: LinkStatistics) -> None:
    direction = Direction.FROM_HOST if sender == "host" else Direction.FROM_MODULE
    reader = PacketReader(direction, statistics)
    for chunk in chunks:
        reader.receive_data(chunk)
        _print_found(reader, sender)
    reader.end_data()
    _print_found(reader, sender)


def _print_found(reader: PacketReader, sender: str) -> None:
    while isinstance(found := reader.next_packet(), Packet | FramingFault):
        if isinstance(found, FramingFault):
            print_json({"fault": found.kind.value, "offset": found.offset})
            continue
        message = message_of(found, sender)
        reader.statistics.unknown += isinstance(message, UnknownMessage)
        print_json(_as_json(found.framing, found.payload, message))


def _chunks(source: BinaryIO, name: str) -> Iterator[bytes]:
    read = getattr(source, "read1", source.read)  # read1 returns what there is, not a full chunk
    chunk = read(_CHUNK_BYTES)
    if chunk.startswith(WIRE_CAPTURE):
        raise CommandFailed(f"{name} is a wire capture and no bare bytes; use xethru dump")
    while chunk:
        yield chunk
        chunk = read(_CHUNK_BYTES)


def _from_hex(line: bytes, name: str, number: int) -> bytes:
    try:
        return bytes.fromhex(line.decode("ascii"))
    except ValueError:
        text = line.strip()[:40].decode("ascii", "replace")
        raise CommandFailed(
            f"{name} line {number} is not hexadecimal bytes: {shown(text)}; write them like "
            "7D 10 6D 7E"
        ) from None


_DOWNCONVERSION = {"baseband": True, "rf": False}  # by --frames
_FEW = 3  # elements of an array that are shown
_LONGEST_TEXT = 60


def dump(arguments: Namespace) -> int:
    """Print every message of a recording; 1 if a part could not be read."""
    file, radar = arguments.file, arguments.radar
    faults: list[RecordingFault] = []
    recording_facts(file, faults.append)
    if arguments.json:
        for message, t_ns in read_recording(file, faults.append, radar=radar):
            bulk = not isinstance(message, UnknownMessage) and ROWS[type(message)].bulk
            framing = Framing.NO_ESCAPE if bulk else Framing.NORMAL
            payload = encode(message, bulk=bulk)
            print_json(_as_json(framing, payload, message) | {"t_ns": t_ns})
    else:
        downconversion = _DOWNCONVERSION.get(arguments.frames)
        summary = describe_recording(file, radar=radar, downconversion=downconversion)
        for line in _head(summary):
            print_line(line)
        for message, t_ns in read_recording(file, faults.append, radar=radar):
            time = _since(t_ns, summary.start_ns)
            line = message_line(message, with_samples=arguments.samples, frames=summary.frames)
            print_line(f"{time}  {line}")
    warn_of("dump", faults)
    return 1 if faults else 0


def message_line(
    message: Response, *, with_samples: bool, frames: Mapping[int, FrameLayout] | None = None
) -> str:
    """One line about a message: its name and fields, long ones cut unless asked for.

    Frames that are complex baseband by ``frames`` are shown as bins of I and Q.

    >>> from xethru_protocol.wire.messages import DataFloat
    >>> import numpy as np
    >>> message = DataFloat(info=7, values=np.arange(5, dtype=np.float32) / 3)
    >>> message_line(message, with_samples=False)
    'DATA FLOAT content_id=0 info=7 length=5 data=[0, 0.333333, 0.666667, ... 5 in all]'
    """
    name, shown = describe(message)
    if isinstance(message, DataFloat) and message.content_id == 0:
        layout = (frames or {}).get(len(message.values))
        if layout is not None and layout.downconversion:
            del shown["length"], shown["data"]
            i, q = np.split(message.values, 2)
            shown |= {"bins": layout.bins, "i": i.tolist(), "q": q.tolist()}
    parts = (f"{key}={_text(value, with_samples)}" for key, value in shown.items())
    return " ".join([name, *parts])


def _as_json(framing: Framing, payload: bytes, message: Message) -> dict[str, Any]:
    name, shown = describe(message)
    return {
        "framing": framing.value,
        "payload_hex": hex_bytes(payload),
        "message": name,
        "fields": shown,
    }


_HINT = ", by how smooth they are (--frames rf or baseband if not)"


def _head(summary: RecordingSummary) -> Iterator[str]:
    total = sum(summary.messages.values())
    yield (
        f"{summary.path}: {summary.format} recording, {counted(total, 'message')}, "
        f"{bytes_text(summary.size_bytes)}"
    )
    for name, count in sorted(summary.messages.items()):
        yield f"  {count} {name}"
    told = [layout for layout in summary.frames.values() if layout.downconversion is not None]
    if summary.frames and not told:
        yield f"  frames of {next(iter(summary.frames.values()))}; --frames rf or baseband says it"
    for layout in told[:_FEW]:
        yield f"  frames of {layout}{_HINT if layout.inferred else ''}"
    if len(told) > _FEW:
        yield f"  and of {len(told) - _FEW} other sizes"
    if summary.start_ns is not None and summary.duration_ns is not None:
        start = datetime.fromtimestamp(summary.start_ns // 10**9, UTC)
        ms = summary.start_ns % 10**9 // 10**6
        yield f"  from {start:%Y-%m-%d %H:%M:%S}.{ms:03d} UTC, {summary.duration_ns * 1e-9:.3f} s"
    else:
        yield "  times are not known"
    if summary.session_id:
        yield f"  session {summary.session_id}"
    if summary.profile_id:
        yield f"  profile {profile_name(summary.profile_id)}"
    if summary.parameter_file is not None:
        yield f"  parameter file {summary.parameter_file}"
    yield ""


def _since(t_ns: int | None, start_ns: int | None) -> str:
    if t_ns is None or start_ns is None:
        return f"{'-':>12}"
    return f"{(t_ns - start_ns) * 1e-9:12.6f}"


def _text(value: Any, whole: bool) -> str:  # noqa: ANN401 - any JSON value
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        shown = [_text(item, whole) for item in (value if whole else value[:_FEW])]
        if len(shown) < len(value):
            shown.append(f"... {len(value)} in all")
        return f"[{', '.join(shown)}]"
    if isinstance(value, dict):
        return " ".join(f"{key}={_text(item, whole)}" for key, item in value.items())
    text = one_line(str(value))
    return text if whole or len(text) <= _LONGEST_TEXT else f"{text[:_LONGEST_TEXT]}..."


def convert(arguments: Namespace) -> int:
    """Write a recording in another format; 1 if a part of it could not be read."""
    source, target = arguments.source, arguments.target
    if not is_array_file(Path(source)):
        recording_facts(source)  # raises before anything is removed
    path = Path(target)
    area_m, downconversion = arguments.frame_area, _DOWNCONVERSION.get(arguments.frames)
    is_given = area_m is not None or downconversion is not None
    if is_given and suffix_of(path) not in SUFFIXES:
        arguments.refuse(f"--frame-area and --frames are for {', '.join(SUFFIXES)}, not {target}")
    if is_part_of(Path(source), path):
        raise RecordingError(f"{source} cannot be converted into itself")
    progress = Progress("xethru convert")
    files_to_replace((path,), replace=arguments.force)
    with _whole(path, replace=arguments.force) as fresh:
        try:
            done = convert_recording(
                source,
                str(fresh),
                lambda messages: progress.show(f"{messages} messages"),
                radar=arguments.radar,
                area_m=area_m,
                downconversion=downconversion,
            )
        finally:
            progress.finish()
    if arguments.json:
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
        noun = "frame" if path.suffix in SUFFIXES else "message"
        print_line(f"{target}: {counted(done.messages, noun)}")
    for name, number in sorted(done.skipped.items()):
        warn(f"xethru convert: {number} {name} left out: the format has no place for them")
    if done.inferred is not None:
        warn(f"xethru convert: frames are probably {done.inferred}{_HINT}")
    warn_of("convert", done.faults)
    return 1 if done.faults else 0


def export(arguments: Namespace) -> int:
    """Write the message table for another tool."""
    text = {"kaitai": structure, "wireshark": dissector}[arguments.tool]()
    if arguments.out is None:
        print_text(text)
        return 0
    wanted = {"kaitai": ".ksy", "wireshark": ".lua"}[arguments.tool]
    if suffix_of(Path(arguments.out)) not in ("", wanted):
        arguments.refuse(f"{arguments.tool} gets a file *{wanted}, not {arguments.out}")
    if Path(arguments.out).exists() and not arguments.force:
        raise CommandFailed(f"{arguments.out} exists already; --force replaces it")
    with writing(arguments.out), written_whole(Path(arguments.out)) as fresh:
        fresh.write_text(text, "utf-8")
    return 0


# --- older recordings ---------------------------------------------------------------------------


def files_to_replace(targets: Iterable[Path], *, replace: bool) -> list[Path]:
    """Files of older recordings where new ones shall be.

    Of a directory only the files of a recording are in the way. RecordingError if something is
    there and must stay.
    """
    old = [path for target in targets for path in _recording_files(target)]
    for path in old:
        if not path.is_file():  # --force must not remove a device
            raise RecordingError(f"{path} is not a file; name a new one")
    if old and not replace:
        raise RecordingError(f"there is a recording already: {old[0]}; --force replaces it")
    return old


def remove_older(targets: Sequence[Path], *, replace: bool) -> None:
    """Remove what `files_to_replace` finds, with the directories that are empty then."""
    for path in files_to_replace(targets, replace=replace):
        with doing("removed", path):
            path.unlink()
    for target in targets:
        remove_empty_directories(target)


def is_part_of(source: Path, target: Path) -> bool:
    """Whether writing to ``target`` would replace ``source``."""
    return target.exists() and any(
        path.exists() and path.samefile(source) for path in (target, *_recording_files(target))
    )


@contextmanager
def _whole(target: Path, *, replace: bool) -> Iterator[Path]:
    """Give the block a path for a recording, which replaces an older one when it is whole.

    Whatever ends the block, or kills it, the older one is there until then.
    """
    fresh = target
    try:
        with writing(target):
            if not suffix_of(target):
                target.parent.mkdir(parents=True, exist_ok=True)
        with writing(target), built_aside(target) as fresh:
            if target.is_dir():
                fresh.mkdir()
            yield fresh
            if replace and fresh.is_file() and target.is_file():
                sync(fresh)
                fresh.replace(target)  # at once: whatever kills it finds one of both there
            else:
                with set_aside(target, replace=replace):
                    _move(fresh, target)
    except PathInUseError:
        raise RecordingError(f"{target} is being written by another conversion") from None
    except RecordingError as error:
        raise RecordingError(str(error).replace(str(fresh), str(target))) from None


def _move(fresh: Path, target: Path) -> None:
    if not target.is_dir():
        fresh.replace(target)
        return
    for path in fresh.iterdir():
        path.replace(target / path.name)


@contextmanager
def set_aside(target: Path, *, replace: bool) -> Iterator[None]:
    """Keep an older recording under other names meanwhile; it is put back if the block fails.

    What the failed block has written is removed: it would pass for a whole recording.
    RecordingError if something is there and must stay, or cannot be moved.
    """
    was_there = target.exists()
    kept = [
        (path, path.with_name(f".{path.name}.old"))
        for path in files_to_replace((target,), replace=replace)
    ]
    try:
        for path, aside in kept:
            path.replace(aside)
    except OSError as error:
        _put_back(kept)
        raise RecordingError(f"{target} cannot be replaced: {error.strerror}") from None
    try:
        yield
    except BaseException:
        remove_unfinished(target, was_there=was_there)
        _put_back(kept)
        raise
    for _, aside in kept:
        with suppress(OSError):
            aside.unlink()
    remove_empty_directories(target)


def _put_back(kept: Iterable[tuple[Path, Path]]) -> None:
    for path, aside in kept:
        with suppress(OSError):
            aside.replace(path)


def remove_unfinished(target: Path, *, was_there: bool) -> None:
    """Remove what was written so far and is of no use."""
    with suppress(OSError):
        for path in _recording_files(target):
            if path.is_file():
                path.unlink()
        remove_empty_directories(target)
        if target.is_dir() and not was_there:
            target.rmdir()


def _recording_files(target: Path) -> list[Path]:
    """Return the files of a recording: those of the vendor's names, and others by its index."""
    if not target.is_dir():
        return [target] if target.exists() else []
    found = {
        path
        for directory in (target, *_directories_in(target))
        for path in (*directory.glob("xethru_*"), *data_files(directory))
    }
    return sorted(path for path in found if not path.is_dir())


def _directories_in(target: Path) -> list[Path]:
    """Return the directories that a recording in ``target`` was split into."""
    return [path for path in target.glob("xethru_recording_*_[0-9]*") if path.is_dir()]


def remove_empty_directories(target: Path) -> None:
    """Remove what is left of a recording that was split into directories."""
    for path in _directories_in(target):
        with suppress(OSError):  # it holds something else
            path.rmdir()

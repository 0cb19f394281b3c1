"""Raw wire captures: every byte of one port, both ways, with nanosecond stamps.

Our own format, made to be read by a few lines in any language; numbers are little-endian.

Head::

    8 bytes  89 58 54 57 49 52 45 0A  (0x89 "XTWIRE" LF)
    u32      1, the version
    u32      length of the note that follows
    note     JSON object, UTF-8: what the writer knows, such as the port

Then chunks until the end of the file::

    u8   3C "<" from the module, 3E ">" from the host
    i64  time [ns since 1970] at which the chunk was complete; -2**63 where unknown
    u32  length of the bytes that follow
    the bytes, as the port gave or took them: packets may begin and end anywhere in them

A file may end anywhere: whole chunks before the cut are good. Suffix ``.xtwire``.
"""

import json
import os
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal

from xethru_protocol.recordings.recorded_messages import (
    NO_TIME_NS,
    FaultHandler,
    GrowingFile,
    RecordingError,
    RecordingFacts,
    RecordingFault,
    TimedMessages,
    reading,
    report,
)
from xethru_protocol.validation import reason_of
from xethru_protocol.wire.codec import decode_response
from xethru_protocol.wire.framing import Direction, FramingFault, NeedData, PacketReader

MAGIC = b"\x89XTWIRE\n"
VERSION = 1
SUFFIX = ".xtwire"

Way = Literal["rx", "tx"]
"""``rx``: from the module; ``tx``: from the host."""

_HEAD = struct.Struct("<8sII")
_CHUNK = struct.Struct("<BqI")
_MARKS: dict[Way, int] = {"rx": ord("<"), "tx": ord(">")}
_WAYS: dict[int, Way] = {mark: way for way, mark in _MARKS.items()}
_LARGEST_PIECE = 1 << 20  # bytes: what a reader holds does not depend on what a chunk claims


@dataclass(frozen=True, slots=True)
class Chunk:
    """Bytes that passed the port together; ``t_ns`` since 1970, None where unknown."""

    way: Way
    data: bytes
    t_ns: int | None


class WireCapture(GrowingFile):
    """Writes a wire capture; each chunk is handed to the operating system at once.

    ``note`` holds JSON-able values about the capture. RecordingError if the file exists or cannot
    be made.
    """

    def __init__(self, path: Path | str, note: Mapping[str, Any] | None = None) -> None:
        text = json.dumps(dict(note or {})).encode()
        super().__init__(Path(path))
        self.append(_HEAD.pack(MAGIC, VERSION, len(text)) + text)

    def write(self, direction: Way, data: bytes, t_ns: int | None) -> None:
        """Append a chunk; ``t_ns`` since 1970, None if unknown.

        RecordingError if the disk is full or the file went away; what was written before stays.
        """
        if not data:
            return
        if self.closed:
            raise RecordingError(f"{self.path}: the capture is closed")
        stamp_ns = NO_TIME_NS if t_ns is None else t_ns
        self.append(_CHUNK.pack(_MARKS[direction], stamp_ns, len(data)) + data)


def read_chunks(path: Path | str, on_fault: FaultHandler | None = None) -> Iterator[Chunk]:
    """Chunks of a wire capture in the order in which they passed.

    A cut last chunk is yielded as far as it is there, then reported. A chunk of more than 1 MiB,
    which a damaged length makes, comes in pieces of that size. RecordingError if the file is not
    a wire capture, or is cut and ``on_fault`` is None.
    """
    path = Path(path)

    def report_at(offset: int, reason: str) -> None:
        report(RecordingFault(file=path.name, offset=offset, reason=reason), on_fault)

    with reading(path), path.open("rb") as stream:
        size = os.fstat(stream.fileno()).st_size
        _read_note(path, stream)
        while head := stream.read(_CHUNK.size):
            begin = stream.tell() - len(head)
            if len(head) < _CHUNK.size:
                report_at(begin, f"the last chunk is cut: {len(head)} bytes")
                return
            mark, stamp_ns, length = _CHUNK.unpack(head)
            way = _WAYS.get(mark)
            if way is None:
                report_at(begin, f"no chunk begins with byte {mark:02X}")
                return
            t_ns = None if stamp_ns == NO_TIME_NS else stamp_ns
            there = min(length, size - stream.tell())
            left = there
            while left and (data := stream.read(min(left, _LARGEST_PIECE))):
                left -= len(data)
                yield Chunk(way, data, t_ns)
            if there < length:
                report_at(begin, f"the last chunk is cut: {there} of its {length} bytes are there")
                return


def read_note(path: Path | str) -> dict[str, Any]:
    """Return the note; RecordingError if the file is not a wire capture."""
    path = Path(path)
    with reading(path), path.open("rb") as stream:
        return _read_note(path, stream)


def wire_facts(path: Path) -> RecordingFacts:
    """Return the facts in the note; defaults for those that it lacks."""
    try:
        return RecordingFacts.from_json(read_note(path).get("facts", {}))
    except (ValueError, TypeError, AttributeError) as error:
        raise RecordingError(f"{path}: its description is damaged: {reason_of(error)}") from None


def read_wire(path: Path, on_fault: FaultHandler | None) -> TimedMessages:
    """Messages from the module in a wire capture, each with the time its last byte came.

    Damage on the line is reported as a fault whose offset counts the bytes from the module.
    """
    reader = PacketReader(Direction.FROM_MODULE)
    cuts: list[RecordingFault] = []
    t_ns: int | None = None

    def packets() -> TimedMessages:
        while not isinstance(found := reader.next_packet(), NeedData):
            if isinstance(found, FramingFault):
                reason = f"on the line: {found.kind.value}"
                report(RecordingFault(file=path.name, offset=found.offset, reason=reason), on_fault)
            else:
                yield decode_response(found.payload), t_ns

    for chunk in read_chunks(path, cuts.append):
        if chunk.way == "rx":
            t_ns = chunk.t_ns
            reader.receive_data(chunk.data)
            yield from packets()
    if not cuts:
        reader.end_data()
        yield from packets()
    for cut in cuts:
        report(cut, on_fault)


def _read_note(path: Path, stream: BinaryIO) -> dict[str, Any]:
    head = stream.read(_HEAD.size)
    if len(head) < _HEAD.size:
        raise RecordingError(f"{path} is cut: {len(head)} of {_HEAD.size} bytes of its head")
    magic, version, length = _HEAD.unpack(head)
    if magic != MAGIC:
        raise RecordingError(f"{path} is no wire capture")
    if version != VERSION:
        raise RecordingError(f"{path} is a wire capture of version {version}, known is {VERSION}")
    text = stream.read(min(length, os.fstat(stream.fileno()).st_size))
    try:
        note = json.loads(text)
    except (ValueError, RecursionError):
        note = None
    if len(text) < length or not isinstance(note, dict):
        raise RecordingError(f"{path}: the head of the capture is cut or damaged")
    return note

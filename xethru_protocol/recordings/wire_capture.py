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
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal

from xethru_protocol.recordings.recorded_messages import (
    NO_TIME_NS,
    WIRE_MAGIC,
    FaultHandler,
    GrowingFile,
    RecordingError,
    RecordingFacts,
    RecordingFault,
    TimedMessages,
    is_like,
    reading,
    report,
)
from xethru_protocol.wire.codec import decode_response
from xethru_protocol.wire.framing import Direction, FramingFault, NeedData, PacketReader

MAGIC = WIRE_MAGIC
VERSION = 1
SUFFIX = ".xtwire"

Way = Literal["rx", "tx"]
"""``rx``: from the module; ``tx``: from the host."""

_HEAD = struct.Struct("<8sII")
_CHUNK = struct.Struct("<BqI")
_MARKS: dict[Way, int] = {"rx": ord("<"), "tx": ord(">")}
_WAYS: dict[int, Way] = {mark: way for way, mark in _MARKS.items()}
_MARK = re.compile(b"[<>]")
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


class _Chunks:
    """Finds chunks in an open capture."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self.size = os.fstat(stream.fileno()).st_size

    def head(self, at: int) -> tuple[int, int, int]:
        """Return mark, time and length at a place; zeros for what is cut off."""
        self._stream.seek(at)
        mark, t_ns, length = _CHUNK.unpack(self._stream.read(_CHUNK.size).ljust(_CHUNK.size, b"\0"))
        return mark, t_ns, length

    def end_of(self, at: int) -> int | None:
        """Return where the chunk at a place ends; None if none does that begins there."""
        mark, _, length = self.head(at)
        end = at + _CHUNK.size + length
        return end if mark in _WAYS and end <= self.size else None

    def is_followed(self, end: int) -> bool:
        """Whether at the end of a chunk the next one begins, or the file ends."""
        return end == self.size or self.head(end)[0] in _WAYS

    def next_from(self, at: int) -> int | None:
        """Return where the next chunk begins that another or the end of the file follows."""
        while at < self.size:
            self._stream.seek(at)
            for found in _MARK.finditer(self._stream.read(_LARGEST_PIECE)):
                end = self.end_of(at + found.start())
                if end is not None and self.is_followed(end):
                    return at + found.start()
            at += _LARGEST_PIECE
        return None

    def read(self, at: int, end: int) -> Iterator[Chunk]:
        """Yield what lies between the head at a place and ``end``; nothing without its mark."""
        mark, stamp_ns, _ = self.head(at)
        if mark in _WAYS:
            t_ns = None if stamp_ns == NO_TIME_NS else stamp_ns
            left = end - at - _CHUNK.size
            while left > 0 and (data := self._stream.read(min(left, _LARGEST_PIECE))):
                left -= len(data)
                yield Chunk(_WAYS[mark], data, t_ns)


def read_chunks(path: Path | str, on_fault: FaultHandler | None = None) -> Iterator[Chunk]:
    """Chunks of a wire capture in the order in which they passed.

    Damage is reported, and reading goes on at the next whole chunk; of one whose length is damaged
    the bytes before that are yielded. A cut last chunk is yielded as far as it is there, then
    reported. A chunk of more than 1 MiB, which a damaged length makes, comes in pieces of that
    size. RecordingError if the file is not a wire capture, or is damaged and ``on_fault`` is None.
    """
    path = Path(path)

    def report_at(offset: int, reason: str, *, minor: bool = False) -> None:
        fault = RecordingFault(file=path.name, offset=offset, reason=reason, minor=minor)
        report(fault, on_fault)

    with reading(path), path.open("rb", _LARGEST_PIECE) as stream:
        chunks = _Chunks(stream)
        note, at = _read_note(path, stream, chunks)
        if note is None:
            report_at(_HEAD.size, _DAMAGED_NOTE, minor=True)
        while at < chunks.size:
            end = chunks.end_of(at)
            if end is None or not chunks.is_followed(end):
                following = chunks.next_from(at + 1)
                mark, _, length = chunks.head(at)
                reason = f"no chunk begins with byte {mark:02X}"
                if following is not None:
                    # where it is the mark of the next chunk that is damaged, this one is whole
                    if end is None or end + _CHUNK.size + chunks.head(end)[2] != following:
                        end = following
                        report_at(at, "its length is damaged" if mark in _WAYS else reason)
                elif end is None:
                    there = chunks.size - at - _CHUNK.size
                    if there < 0:
                        reason = f"the last chunk is cut: {there + _CHUNK.size} bytes"
                    elif mark in _WAYS:
                        yield from chunks.read(at, chunks.size)
                        reason = f"the last chunk is cut: {there} of its {length} bytes are there"
                    report_at(at, reason)
                    return
            yield from chunks.read(at, end)
            at = end


def read_note(path: Path | str) -> dict[str, Any]:
    """Return the note; RecordingError if the file is not a wire capture, or its head is damaged."""
    path = Path(path)
    with reading(path), path.open("rb") as stream:
        note, _ = _read_note(path, stream, _Chunks(stream))
    if note is None:
        raise RecordingError(f"{path}: {_DAMAGED_NOTE}")
    return note


_DAMAGED_NOTE = "the head of the capture is damaged"


def wire_facts(path: Path, on_fault: FaultHandler | None) -> RecordingFacts:
    """Return the facts in the note; defaults for those that it lacks, also for what is damaged."""
    return RecordingFacts.read(path, lambda: read_note(path).get("facts", {}), on_fault)


def wire_about(path: Path) -> Mapping[str, Any]:
    """Return what the note says of the module, by the names in an MCAP file's info."""
    try:
        about = read_note(path).get("radar", {})
    except RecordingError:  # damaged; the messages are there
        return {}
    return about if isinstance(about, dict) else {}


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


def _read_note(path: Path, stream: BinaryIO, chunks: _Chunks) -> tuple[dict[str, Any] | None, int]:
    """Return the note, None if it is damaged, and where the first chunk begins."""
    head = stream.read(_HEAD.size)
    if len(head) < _HEAD.size:
        raise RecordingError(f"{path} is cut: {len(head)} of {_HEAD.size} bytes of its head")
    magic, version, length = _HEAD.unpack(head)
    if not is_like(magic, MAGIC):
        raise RecordingError(f"{path} is not a wire capture")
    if version != VERSION:
        raise RecordingError(f"{path} is a wire capture of version {version}, known is {VERSION}")
    try:
        note = json.loads(stream.read(min(length, chunks.size)))
    except (ValueError, RecursionError):
        note = None
    begin = _HEAD.size + length
    if isinstance(note, dict) and begin <= chunks.size:
        return note, begin
    following = begin if chunks.end_of(begin) else chunks.next_from(_HEAD.size)
    if following is None:
        raise RecordingError(f"{path}: the head of the capture is cut or damaged")
    return None, following

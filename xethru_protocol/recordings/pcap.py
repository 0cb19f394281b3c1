"""Wire captures as pcap files, for Wireshark with the dissector of `xethru export wireshark`.

Classic pcap with nanoseconds, little-endian, link type 147 (DLT_USER0). One record per packet of
the wire: a byte, 3C from the module or 3E from the host, then the packet as it was captured, with
its framing. Bytes that belong to no packet are a record of their own in front of the packet behind
them, and have its time: that of the chunk that completed the packet, of the chunk before where it
is unknown, 0 if none is known.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from xethru_protocol.recordings.clock import counter_of, steady
from xethru_protocol.recordings.recorded_messages import FaultHandler, writing
from xethru_protocol.recordings.wire_capture import Way, read_chunks
from xethru_protocol.wire.codec import decode_response
from xethru_protocol.wire.framing import Direction, NeedData, Packet, PacketReader

SUFFIX = ".pcap"
_HEAD = struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 262144, 147)
_RECORD = struct.Struct("<IIII")
_MARKS: dict[Way, bytes] = {"rx": b"<", "tx": b">"}
_LONGEST = 65536  # of bytes that belong to no packet


class _Record(NamedTuple):
    data: bytes
    counter: tuple[str, int] | None  # of a frame


class _Side:
    """Packets of one direction as they lie on the wire."""

    def __init__(self, way: Way) -> None:
        self._reader = PacketReader(Direction.FROM_MODULE if way == "rx" else Direction.FROM_HOST)
        self._way = way
        self._bytes = bytearray()
        self._begin = 0  # offset of the first of them in the stream

    def take(self, data: bytes) -> Iterator[_Record]:
        self._reader.receive_data(data)
        self._bytes += data
        yield from self._found()

    def end(self) -> Iterator[_Record]:
        self._reader.end_data()
        yield from self._found()
        yield from self._cut(len(self._bytes))

    def _found(self) -> Iterator[_Record]:
        while not isinstance(packet := self._reader.next_packet(), NeedData):
            if isinstance(packet, Packet):
                yield from self._cut(packet.offset - self._begin)
                is_answer = self._way == "rx"
                counter = counter_of(decode_response(packet.payload)) if is_answer else None
                yield from self._cut(len(self._bytes) - self._reader.buffered, counter)

    def _cut(self, size: int, counter: tuple[str, int] | None = None) -> Iterator[_Record]:
        data = bytes(self._bytes[:size])
        del self._bytes[:size]
        self._begin += size
        for at in range(0, size, _LONGEST + 9):
            yield _Record(_MARKS[self._way] + data[at : at + _LONGEST + 9], counter)


def write_pcap(source: Path, target: Path, on_fault: FaultHandler) -> int:
    """Write a wire capture as pcap and return how many records it has.

    ``RecordingError`` if one of the files cannot be read or written.
    """
    timed = steady(_records(source, on_fault), source.name, on_fault, lambda record: record.counter)
    n_records = 0
    with writing(target), target.open("xb") as stream:
        stream.write(_HEAD)
        for record, t_ns in timed:
            seconds, rest_ns = divmod(max(t_ns or 0, 0), 10**9)
            size = len(record.data)
            stream.write(_RECORD.pack(seconds & 0xFFFFFFFF, rest_ns, size, size) + record.data)
            n_records += 1
    return n_records


def _records(source: Path, on_fault: FaultHandler) -> Iterator[tuple[_Record, int | None]]:
    """Yield what becomes records, each with the newest time that is known."""
    sides: dict[Way, _Side] = {"rx": _Side("rx"), "tx": _Side("tx")}
    t_ns: int | None = None
    for chunk in read_chunks(source, on_fault):
        t_ns = t_ns if chunk.t_ns is None else chunk.t_ns
        for record in sides[chunk.way].take(chunk.data):
            yield record, t_ns
    for side in sides.values():
        for record in side.end():
            yield record, t_ns

"""Wire captures as pcap files, for Wireshark with the dissector of `xethru export wireshark`.

Classic pcap with nanoseconds, little-endian, link type 147 (DLT_USER0). One record per packet of
the wire: a byte, 3C from the module or 3E from the host, then the packet as it was captured, with
its framing. Bytes that belong to no packet are a record of their own in front of the packet behind
them, and have its time: that of the chunk that completed the packet, of the chunk before where it
is unknown, 0 if none is known.
"""

import struct
from pathlib import Path

from xethru_protocol.recordings.recorded_messages import FaultHandler, writing
from xethru_protocol.recordings.wire_capture import Chunk, Way, read_chunks
from xethru_protocol.wire.framing import Direction, NeedData, Packet, PacketReader

SUFFIX = ".pcap"
_HEAD = struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 262144, 147)
_RECORD = struct.Struct("<IIII")
_MARKS: dict[Way, bytes] = {"rx": b"<", "tx": b">"}
_LONGEST = 65536  # of bytes that belong to no packet


class _Side:
    """Packets of one direction as they lie on the wire."""

    def __init__(self, way: Way) -> None:
        self._reader = PacketReader(Direction.FROM_MODULE if way == "rx" else Direction.FROM_HOST)
        self._bytes = bytearray()
        self._begin = 0  # offset of the first of them in the stream

    def take(self, data: bytes) -> list[bytes]:
        self._reader.receive_data(data)
        self._bytes += data
        return self._found()

    def end(self) -> list[bytes]:
        self._reader.end_data()
        return [*self._found(), *self._cut(len(self._bytes))]

    def _found(self) -> list[bytes]:
        found: list[bytes] = []
        while not isinstance(packet := self._reader.next_packet(), NeedData):
            if isinstance(packet, Packet):
                found += self._cut(packet.offset - self._begin)
                found += self._cut(len(self._bytes) - self._reader.buffered)
        return found

    def _cut(self, size: int) -> list[bytes]:
        data = bytes(self._bytes[:size])
        del self._bytes[:size]
        self._begin += size
        return [data[at : at + _LONGEST + 9] for at in range(0, size, _LONGEST + 9)]


def write_pcap(source: Path, target: Path, on_fault: FaultHandler) -> int:
    """Write a wire capture as pcap and return how many records it has.

    ``RecordingError`` if one of the files cannot be read or written.
    """
    sides: dict[Way, _Side] = {"rx": _Side("rx"), "tx": _Side("tx")}
    records, t_ns = 0, 0
    with writing(target), target.open("xb") as stream:
        stream.write(_HEAD)

        def write(way: Way, found: list[bytes]) -> None:
            nonlocal records
            for data in found:
                seconds, rest_ns = divmod(max(t_ns, 0), 10**9)
                size = len(data) + 1
                stream.write(_RECORD.pack(seconds & 0xFFFFFFFF, rest_ns, size, size))
                stream.write(_MARKS[way] + data)
                records += 1

        chunk: Chunk
        for chunk in read_chunks(source, on_fault):
            t_ns = t_ns if chunk.t_ns is None else chunk.t_ns
            write(chunk.way, sides[chunk.way].take(chunk.data))
        for way, side in sides.items():
            write(way, side.end())
    return records

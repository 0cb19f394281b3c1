"""What ``xethru decode`` finds of mixed traffic when some of all bytes are damaged.

Each packet that no damage touched and that was not found is explained by what stands in its place.
"""

import json
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from xethru_protocol.cli.recordings import message_of
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import SystemCode
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import (
    Direction,
    Framing,
    FramingFault,
    LinkStatistics,
    Packet,
    PacketReader,
    encode_normal,
)

CHUNK_BYTES = 65536  # as the command reads
BLOCK_BYTES = 1_000_000  # made at once

SWALLOWED_NORMAL = "inside a longer Normal packet whose checksum fits by chance"
SWALLOWED_MERGED = "behind a packet whose end became an escape: both checksums cancel"
SWALLOWED_BULK = "inside a damaged NoEscape packet whose lengths fit"
UNEXPLAINED = "unexplained"


@dataclass(slots=True, kw_only=True)
class Outcome:
    bytes: int = 0
    damaged_bytes: int = 0
    packets: int = 0
    untouched: int = 0
    found: int = 0
    missed: Counter[str] = field(default_factory=Counter)
    found_besides: int = 0  # packets found where none was sent
    statistics: LinkStatistics = field(default_factory=LinkStatistics)


def packet_pool(rng: np.random.Generator, *, short: bool) -> list[bytes]:
    """Return packets of all kinds a module sends, escapes among their bytes."""
    module = Connection(Role.MODULE)

    def number() -> int:
        return int(rng.integers(1 << 32))

    def floats(count: int) -> np.ndarray[tuple[int], np.dtype[np.float32]]:
        counters = rng.integers(0, 729_600, count).astype(np.float32)
        return counters * np.float32(2.0345053e-07) - np.float32(0.07421875)

    pool = []
    for _ in range(200):
        pool += [
            module.send(m.Ack()),
            module.send(m.Error(code=number() & 0x1F)),
            module.send(m.Pong(value=0xAAEEAEEA)),
            module.send(m.System(code=SystemCode.XTS_SPRS_READY)),
            module.send(m.ReplyInt(content_id=number(), info=0, values=(number() >> 1,))),
            module.send(m.ReplyString(content_id=5, info=0, text=rng.bytes(20).decode("latin-1"))),
            module.send(m.ReplyByte(content_id=number(), info=0, values=rng.bytes(9))),
        ]
    if short:
        return pool
    for _ in range(40):
        pool += [module.send(m.DataFloat(info=number(), values=floats(1431))) for _ in range(20)]
        pool += [
            module.send(m.DataFloat(info=number(), values=floats(362))),
            module.send(m.DataFloat(info=number(), values=floats(1431)), Framing.NORMAL),
            module.send(m.DataFloat(info=number(), values=floats(54)), Framing.NORMAL),
            module.send(
                m.BasebandIq(
                    counter=number(),
                    num_bins=180,
                    bin_length_m=0.0514,
                    sampling_frequency_hz=2.916e9,
                    carrier_frequency_hz=7.29e9,
                    range_offset_m=0.18,
                    i=floats(180),
                    q=floats(180),
                )
            ),
        ]
    return pool


def blocks(pool: list[bytes], size: int, rng: np.random.Generator) -> Iterator[list[bytes]]:
    """Packets of at least ``size`` bytes in all, a block at a time."""
    sent = 0
    mean = sum(map(len, pool)) / len(pool)
    while sent < size:
        count = max(1, int(min(BLOCK_BYTES, size - sent) / mean))
        block = [pool[index] for index in rng.integers(0, len(pool), count).tolist()]
        sent += sum(map(len, block))
        yield block


class Corruption:
    """Makes the damaged stream chunk by chunk and remembers what was sent untouched."""

    def __init__(self, size: int, rate: float, seed: int, *, short: bool) -> None:
        self._rng = np.random.default_rng(seed)
        self._pool = packet_pool(self._rng, short=short)
        self._size = size
        self._rate = rate
        self.outcome = Outcome()
        self.untouched: dict[int, bytes] = {}  # by offset: sent, not found yet
        self.merged: set[int] = set()  # offsets of packets whose predecessor's end became 7F

    def chunks(self) -> Iterator[bytes]:
        base = 0
        rest = b""
        for packets in blocks(self._pool, self._size, self._rng):
            stream = rest + self._damage(packets, base)
            base += len(stream) - len(rest)
            whole = len(stream) - len(stream) % CHUNK_BYTES
            for begin in range(0, whole, CHUNK_BYTES):
                yield stream[begin : begin + CHUNK_BYTES]
            rest = stream[whole:]
        yield rest

    def _damage(self, packets: list[bytes], base: int) -> bytes:
        lengths = np.array([len(packet) for packet in packets])
        ends = np.cumsum(lengths)
        stream = np.frombuffer(b"".join(packets), np.uint8).copy()
        at = np.flatnonzero(self._rng.random(stream.size) < self._rate)
        stream[at] ^= self._rng.integers(1, 256, at.size).astype(np.uint8)
        touched = np.zeros(len(packets), np.bool_)
        hit = np.searchsorted(ends, at, side="right")
        touched[hit] = True
        begins = ends - lengths + base
        self.merged.update((base + at[(stream[at] == 0x7F) & (at + 1 == ends[hit])] + 1).tolist())
        for index in np.flatnonzero(~touched).tolist():
            self.untouched[int(begins[index])] = packets[index]
        outcome = self.outcome
        outcome.bytes += stream.size
        outcome.damaged_bytes += at.size
        outcome.packets += len(packets)
        outcome.untouched += len(packets) - int(touched.sum())
        return stream.tobytes()


def run(size: int, rate: float, seed: int, *, short: bool) -> Outcome:
    line = Corruption(size, rate, seed, short=short)
    outcome = line.outcome
    swallowing: list[tuple[int, Packet]] = []
    for found in packets_in(line.chunks(), outcome.statistics):
        message = message_of(found, "module")
        outcome.statistics.unknown += isinstance(message, m.UnknownMessage)
        sent = line.untouched.get(found.offset)
        if sent is not None and _carries(sent, found):
            del line.untouched[found.offset]
            outcome.found += 1
        else:
            swallowing.append((found.offset, found))
    outcome.found_besides = outcome.statistics.packets - outcome.found
    offsets = np.array([offset for offset, _ in swallowing] or [-1])
    for offset in line.untouched:
        index = int(np.searchsorted(offsets, offset, side="right")) - 1
        before = swallowing[index][1] if index >= 0 and swallowing else None
        outcome.missed[_why(before, offset, line.merged)] += 1
    return outcome


def packets_in(chunks: Iterator[bytes], statistics: LinkStatistics) -> Iterator[Packet]:
    reader = PacketReader(Direction.FROM_MODULE, statistics)
    for chunk in chunks:
        reader.receive_data(chunk)
        yield from _complete(reader)
    reader.end_data()
    yield from _complete(reader)


def _complete(reader: PacketReader) -> Iterator[Packet]:
    while isinstance(found := reader.next_packet(), Packet | FramingFault):
        if isinstance(found, Packet):
            yield found


def _carries(sent: bytes, found: Packet) -> bool:
    if found.framing is Framing.NO_ESCAPE:
        return sent[:4] == b"\x7c" * 4 and sent[9:] == found.payload
    return sent == encode_normal(found.payload)


def _why(before: Packet | None, offset: int, merged: set[int]) -> str:
    if before is None:
        return UNEXPLAINED
    if before.framing is Framing.NO_ESCAPE:
        covers = before.offset + 9 + len(before.payload) > offset
        return SWALLOWED_BULK if covers else UNEXPLAINED
    if before.offset + len(encode_normal(before.payload)) <= offset:
        return UNEXPLAINED
    return SWALLOWED_MERGED if offset in merged else SWALLOWED_NORMAL


@dataclass(slots=True, kw_only=True)
class CommandRun:
    exit_code: int
    lines: int
    faults: int
    statistics: dict[str, object]


def run_command(size: int, rate: float, seed: int, *, short: bool) -> CommandRun:
    """Decode the same stream by ``xethru decode``, fed through a pipe."""
    command = [sys.executable, "-m", "xethru_protocol.cli", "decode", "--from", "module"]
    line = Corruption(size, rate, seed, short=short)
    with (
        tempfile.TemporaryFile() as output,
        subprocess.Popen(
            [*command, "--statistics"],
            stdin=subprocess.PIPE,
            stdout=output,
            stderr=subprocess.PIPE,
        ) as process,
    ):
        assert process.stdin is not None
        for chunk in line.chunks():
            process.stdin.write(chunk)
            line.untouched.clear()
            line.merged.clear()
        _, messages = process.communicate()
        output.seek(0)
        are_faults = Counter(text.startswith(b'{"fault"') for text in output)
    return CommandRun(
        exit_code=process.returncode,
        lines=are_faults.total(),
        faults=are_faults[True],
        statistics=json.loads(messages),
    )

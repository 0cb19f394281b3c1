"""The receiver at single points: what damage it sees, what it keeps, what it costs."""

import re
import sys
from collections.abc import Callable
from types import FrameType
from typing import Any

import numpy as np
import pytest

from hil_tests.property.wire_streams import drain
from hil_tests.property.wire_streams import read_all as read
from xethru_protocol.wire import framing
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.errors import LocalProtocolError
from xethru_protocol.wire.framing import (
    MAX_NORMAL_WIRE_BYTES,
    NEED_DATA,
    FaultKind,
    FramingFault,
    Packet,
    PacketReader,
    encode_no_escape,
    encode_normal,
    xor,
)

ACK = bytes.fromhex("7D 10 6D 7E")


def frame(counter: int = 0, bins: int = 1431, seed: int = 0) -> bytes:
    values = np.random.default_rng(seed).standard_normal(bins).astype("<f4")
    header = b"\xa0\x12" + bytes(4) + counter.to_bytes(4, "little") + bins.to_bytes(4, "little")
    return encode_no_escape(header + values.tobytes())


def payloads(found: list[Packet | FramingFault]) -> list[bytes]:
    return [item.payload for item in found if isinstance(item, Packet)]


def faults(found: list[Packet | FramingFault]) -> list[tuple[FaultKind, int]]:
    return [(item.kind, item.offset) for item in found if isinstance(item, FramingFault)]


@pytest.mark.parametrize("seed", range(20))
def test_stray_start_does_not_swallow_the_next_frames(seed: int) -> None:
    sent = [frame(k, 200, 10 * seed + k) for k in range(5)]
    stream = b"\x7d" + b"".join(sent) + ACK
    assert payloads(read(stream))[-6:] == [*(one[9:] for one in sent), b"\x10"]


@pytest.mark.parametrize("lost", [1, 2, 3, 4, 8, 9, 20, 500])
def test_damaged_start_loses_one_frame_only(lost: int) -> None:
    """Protocol reference 1.4: 0.78 following frames were lost without the rescan rule."""
    for seed in range(10):
        sent = [frame(k, 200, 10 * seed + k) for k in range(4)]
        stream = sent[0] + sent[1][lost:] + sent[2] + sent[3] + ACK
        wanted = [sent[0][9:], sent[2][9:], sent[3][9:], b"\x10"]
        assert [one for one in payloads(read(stream)) if one in wanted] == wanted


@pytest.mark.parametrize("length", [0, 65536, 0xFFFFFFFF, 5737, 5739])
def test_wrong_length_field_is_not_waited_for(length: int) -> None:
    damaged = bytearray(frame(0))
    damaged[4:8] = length.to_bytes(4, "little")
    found = read(bytes(damaged) + frame(1, seed=1) + ACK)
    assert payloads(found)[-2:] == [frame(1, seed=1)[9:], b"\x10"]
    assert faults(found)[0] == (FaultKind.HEADER, 0)


@pytest.mark.parametrize(
    ("stream", "expected"),
    [
        (b"\x7d\x7e", [(FaultKind.EMPTY, 0)]),
        (b"\x7d\x7f\x7d\x7e", [(FaultKind.EMPTY, 0)]),
        (b"\x7d\x7d" + ACK, []),
        (b"\x00\x01" + ACK + b"\x02" + ACK, [(FaultKind.GARBAGE, 0), (FaultKind.GARBAGE, 6)]),
        (b"\x7d\x10\x6c\x7e" * 2 + ACK, [(FaultKind.CHECKSUM, 0), (FaultKind.CHECKSUM, 4)]),
        (b"\x7d\x10" + ACK, [(FaultKind.TRUNCATED, 0)]),
        (
            b"\x7d\x01" + encode_no_escape(b"\x10") + b"\x7f\x7d\x05\x06\x7e" + ACK,
            [(FaultKind.CHECKSUM, 0), (FaultKind.GARBAGE, 12), (FaultKind.CHECKSUM, 13)],
        ),
        (b"\x7c" * 50 + ACK, [(FaultKind.HEADER, 0)]),
        (b"\x7d" + bytes(MAX_NORMAL_WIRE_BYTES) + ACK, [(FaultKind.OVERSIZE, 0)]),
    ],
)
def test_each_damaged_place_is_one_fault(
    stream: bytes, expected: list[tuple[FaultKind, int]]
) -> None:
    assert faults(read(stream)) == expected


def test_noescape_frame_wins_over_an_unknown_packet_that_swallows_it() -> None:
    """A stray 7D, an intact frame, and a 7E behind it where the checksum happens to fit."""
    intact = frame(bins=1, counter=7)[:23] + b"\x10\x20\x30\x40"
    assert not set(intact) & {0x7D, 0x7E, 0x7F}
    tail = bytes([0x7D ^ xor(intact)]) + b"\x7e"
    found = read(b"\x7d" + intact + tail + ACK)
    assert payloads(found) == [intact[9:], b"\x10"]
    assert faults(found)[0] == (FaultKind.TRUNCATED, 0)
    # a known packet is data throughout, and so is an unknown one around an implausible header
    known = b"\x10" + intact
    assert payloads(read(encode_normal(known) + ACK)) == [known, b"\x10"]
    unknown = b"\x77" + intact[:5] + b"\x01" + intact[6:]
    assert payloads(read(encode_normal(unknown) + ACK)) == [unknown, b"\x10"]


def test_a_header_cut_off_in_an_unknown_packet_is_waited_for_until_the_data_end() -> None:
    packet = encode_normal(b"\x77" + frame()[:9])
    assert payloads(read(packet + b"\xa0")) == []
    assert payloads(read(packet, ended=True)) == [b"\x77" + frame()[:9]]


def test_end_of_data_turns_waiting_into_a_fault_and_finds_what_is_inside() -> None:
    inner = frame(bins=3)[:23] + bytes(12)  # no 7D or 7E that could refute the stray start
    assert read(b"\x7d" + inner) == []
    found = read(b"\x7d" + inner, ended=True)
    assert payloads(found) == [inner[9:]]
    assert faults(found) == [(FaultKind.INCOMPLETE, 0)]
    assert faults(read(frame()[:-1], ended=True)) == [(FaultKind.INCOMPLETE, 0)]


def test_frames_are_not_copied_out_of_a_chunk_that_holds_them() -> None:
    stream = frame(0) + frame(1)
    reader = PacketReader()
    reader.receive_data(stream)
    span = reader.next_span()
    assert isinstance(span, tuple)
    assert span[1] is stream


@pytest.mark.parametrize(
    ("frame_payload", "longest"), [(encode_normal, 7998), (encode_no_escape, 65535)]
)
def test_packets_that_no_receiver_takes_are_refused(
    frame_payload: Callable[[bytes], bytes], longest: int
) -> None:
    for payload in (b"", bytes(longest + 1)):
        with pytest.raises(LocalProtocolError):
            frame_payload(payload)
    assert payloads(read(encode_normal(bytes(7998)))) == [bytes(7998)]


def test_a_command_that_a_module_would_misread_is_refused() -> None:
    unknown = m.UnknownMessage(code=0xB7, payload=b"\xb7||||")
    known = m.X4DriverSet(setting=X4Setting.PRFDIV, value=0x7C)
    data = m.SetFileData(file_type=0, identifier=0, offset=0, data=b"||||")
    for message in (unknown, data):
        with pytest.raises(LocalProtocolError):
            Connection(Role.HOST).send(message)
        assert Connection(Role.MODULE).send(message)
    assert Connection(Role.HOST).send(known)


@pytest.mark.parametrize("size", [0, 1, 7, 63, 64, 65, 1431, 5738])
def test_xor_equals_the_bytewise_one(size: int) -> None:
    data = np.random.default_rng(size).bytes(size)
    expected = 0
    for byte in data:
        expected ^= byte
    assert xor(data) == expected


# --- cost ---------------------------------------------------------------------------------------

HOSTILE = {
    "7C": b"\x7c",
    "7D": b"\x7d",
    "7E": b"\x7e",
    "7F": b"\x7f",
    "escaped starts": b"\x7f\x7d",
    "starts and escaped starts": b"\x7d\x7f\x7d\x7f\x7d",
    "escaped ends": b"\x7f\x7e",
    "noescape starts": b"\x7c\x7c\x7c\x7c\x00",
    "small packets behind escaped starts": b"\x7f\x7d" + encode_no_escape(b"\x10"),
    "bad packets of escaped starts": b"\x7d" + b"\x7f\x7d" * 2000 + b"\x01\x7e",
    "empty packets": b"\x7d\x7e",
    "bad packets": b"\x7d\x11\x7e",
    "bad packets of escaped starts without end": b"\x7d" + b"\x7f\x7d" * 9000 + b"\x01",
    "unknown packets around headers": encode_normal(b"\x77" + b"\x7c\x7c\x7c\x7c\x01\0\0\0\0" * 50),
    "half frames": frame()[:3000],
    "zeros behind starts": b"\x7d" + bytes(5000),
}


class _CountingBytes(bytes):
    """Bytes that count what is searched in them."""

    searched = 0

    def find(self, sub: Any, *where: Any) -> int:  # noqa: ANN401 - as bytes.find
        at = super().find(sub, *where)
        start = where[0] if where else 0
        end = where[1] if len(where) > 1 else len(self)
        _CountingBytes.searched += (at if at >= 0 else end) - start
        return at


def _lines_run(size: int, pattern: bytes, chunk: int) -> int:
    """Python lines that the receiver runs for ``size`` bytes of a pattern."""
    data = (pattern * (size // len(pattern) + 1))[:size]
    reader = PacketReader()
    lines = 0

    def trace(_frame: FrameType, event: str, _argument: object) -> Any:  # noqa: ANN401 - as sys.settrace wants
        nonlocal lines
        lines += event == "line"
        return trace

    previous = sys.gettrace()
    sys.settrace(trace)
    try:
        for begin in range(0, size, chunk):
            reader.receive_data(data[begin : begin + chunk])
            while reader.next_packet() is not NEED_DATA:
                pass
    finally:
        sys.settrace(previous)
    assert reader.buffered <= 65_544 + chunk
    return lines


@pytest.mark.parametrize("name", HOSTILE)
def test_work_grows_with_the_bytes_only(name: str) -> None:
    """Lines of Python per byte do not grow with the length of hostile input."""
    # the shorter is already longer than any packet that has to be waited for
    small = _lines_run(70_000, HOSTILE[name], 1 << 20) / 70_000
    large = _lines_run(140_000, HOSTILE[name], 1 << 20) / 140_000
    assert large < 1.3 * small + 0.1
    assert large < 60


@pytest.mark.parametrize(
    "name",
    [
        "7D",
        "escaped starts",
        "starts and escaped starts",
        "bad packets of escaped starts",
        "bad packets of escaped starts without end",
    ],
)
def test_rejected_starts_cost_little(name: str) -> None:
    """Starts that share their fate are given up together: below three lines of Python per byte."""
    assert _lines_run(140_000, HOSTILE[name], 1 << 16) / 140_000 < 3.0


@pytest.mark.parametrize("name", HOSTILE)
def test_bytes_are_searched_a_bounded_number_of_times(name: str) -> None:
    size = 200_000
    pattern = HOSTILE[name]
    _CountingBytes.searched = 0
    reader = PacketReader()
    data = _CountingBytes((pattern * (size // len(pattern) + 1))[:size])
    reader.receive_data(data)
    reader._queue[0] = data  # not the plain bytes that were made of it
    while reader.next_packet() is not NEED_DATA:
        pass
    assert _CountingBytes.searched < 8 * size


class _CountingContent:
    """A regular expression that counts the bytes it goes over."""

    def __init__(self, pattern: re.Pattern[bytes]) -> None:
        self._pattern = pattern
        self.searched = 0

    def match(self, buffer: bytes, begin: int, stop: int) -> re.Match[bytes] | None:
        found = self._pattern.match(buffer, begin, stop)
        assert found is not None
        self.searched += found.end() - begin
        return found


@pytest.mark.parametrize("chunk", [100, 3000, 1 << 20])
@pytest.mark.parametrize("name", HOSTILE)
def test_terminators_are_looked_for_once_in_every_byte(
    name: str, chunk: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    size = 50_000
    pattern = HOSTILE[name]
    data = (pattern * (size // len(pattern) + 1))[:size]
    content = _CountingContent(framing._CONTENT)
    marked = []

    class CountingWindow(framing._MarkedBytes):
        def __init__(self, buffer: bytes, base: int, begin: int, size: int) -> None:
            super().__init__(buffer, base, begin, size)
            marked.append(self.end - base - begin)

    monkeypatch.setattr(framing, "_CONTENT", content)
    monkeypatch.setattr(framing, "_MarkedBytes", CountingWindow)
    reader = PacketReader()
    for begin in range(0, size, chunk):
        reader.receive_data(data[begin : begin + chunk])
        drain(reader)
    assert content.searched + sum(marked) <= size

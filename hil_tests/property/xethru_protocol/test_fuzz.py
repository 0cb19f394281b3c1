"""The receiver on the committed corpus of nasty streams, and on generated ones: books balance."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil_tests.property.examples import examples
from hil_tests.property.fuzz_corpus import corpus
from hil_tests.property.wire_streams import STREAMS, drain, oracle, read_all
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import (
    NEED_DATA,
    Direction,
    Framing,
    FramingFault,
    LinkStatistics,
    Packet,
    PacketReader,
)

CORPUS = corpus()
LARGEST_PACKET = 9 + 65535
NASTY = st.lists(
    st.sampled_from([b"\x7c\x7c\x7c\x7c", b"\x7c", b"\x7d", b"\x7e", b"\x7f", b"\x7d\x10\x6d\x7e"])
    | st.sampled_from([b"\xa0\x12", b"\x11\x10", b"\x01\x00\x00\x00", b"\x12\x00\x00\x00\x00"])
    | st.binary(max_size=6),
    max_size=60,
).map(b"".join)


def read(
    stream: bytes, cuts: list[int], direction: Direction = Direction.FROM_MODULE
) -> tuple[list[Packet | FramingFault], LinkStatistics]:
    reader = PacketReader(direction)
    found: list[Packet | FramingFault] = []
    previous = 0
    for cut in [*cuts, len(stream)]:
        reader.receive_data(stream[previous:cut])
        previous = cut
        found += drain(reader)
        assert reader.buffered <= LARGEST_PACKET
    reader.end_data()
    found += drain(reader)
    assert reader.buffered == 0
    return found, reader.statistics


def end_of(packet: Packet, stream: bytes) -> int:
    """Offset behind a packet, found byte by byte."""
    if packet.framing is Framing.NO_ESCAPE:
        return packet.offset + 9 + len(packet.payload)
    at = packet.offset + 1
    while stream[at] != 0x7E:
        at += 2 if stream[at] == 0x7F else 1
    return at + 1


def check_books(
    stream: bytes, found: list[Packet | FramingFault], statistics: LinkStatistics
) -> None:
    packets = [item for item in found if isinstance(item, Packet)]
    faults = [item.kind for item in found if isinstance(item, FramingFault)]
    ends = [0, *(end_of(packet, stream) for packet in packets)]
    assert all(end <= packet.offset for end, packet in zip(ends, packets, strict=False))
    in_packets = sum(end - packet.offset for end, packet in zip(ends[1:], packets, strict=True))
    assert statistics.bytes == len(stream)
    assert statistics.packets == len(packets)
    assert statistics.junk_bytes == len(stream) - in_packets
    assert statistics.faults.total() == len(faults)
    assert all(statistics.faults[kind] == faults.count(kind) for kind in set(faults))
    assert statistics.resyncs <= statistics.junk_bytes
    assert statistics.clean == (len(stream) == in_packets)


def test_the_corpus_is_there() -> None:
    assert len(CORPUS) >= 30


@pytest.mark.parametrize("file", CORPUS, ids=lambda file: file.stem)
@pytest.mark.parametrize("direction", Direction)
def test_nasty_stream(file: Path, direction: Direction) -> None:
    stream = file.read_bytes()
    whole = read(stream, [], direction)
    check_books(stream, *whole)
    step = 1 if len(stream) < 5000 else 13
    for chunk in (step, 7, 64, 1000):
        assert read(stream, list(range(chunk, len(stream), chunk)), direction) == whole


SHORT = [
    file for file in CORPUS if file.stat().st_size < 7000
]  # the oracle knows no longest packet


@pytest.mark.parametrize("file", SHORT, ids=lambda file: file.stem)
def test_nasty_stream_holds_the_packets_of_the_rescan_rule(file: Path) -> None:
    stream = file.read_bytes()
    found = [item for item in read_all(stream) if isinstance(item, Packet)]
    assert [(packet.offset, packet.payload) for packet in found] == oracle(stream)


@pytest.mark.parametrize(
    ("name", "acks"),
    [
        ("nested_false_starts", 1),
        ("header_lies", 10),
        ("escape_runs", 9),
        ("start_without_end", 1),
        ("longer_than_any_normal", 1),
        ("deprecated_fast_mode", 1),
        ("doubled_start_and_end", 2),
        ("missing_starts", 1),
        ("line_noise", 1),
    ],
)
def test_intact_answers_survive(name: str, acks: int) -> None:
    (file,) = [file for file in CORPUS if file.stem == name]
    found, _ = read(file.read_bytes(), [])
    assert [isinstance(item, Packet) and item.payload for item in found].count(b"\x10") == acks


@settings(max_examples=examples(100, 300))
@given(STREAMS | NASTY | st.binary(max_size=300), st.lists(st.integers(0, 400), max_size=5))
def test_books_balance_for_any_bytes_in_any_chunks(stream: bytes, cuts: list[int]) -> None:
    for direction in Direction:
        found, statistics = read(stream, [], direction)
        check_books(stream, found, statistics)
        assert read(stream, sorted(c for c in cuts if c < len(stream)), direction) == (
            found,
            statistics,
        )


@given(STREAMS | NASTY | st.binary(max_size=200))
def test_messages_of_any_bytes_are_counted(stream: bytes) -> None:
    for role in Role:
        connection = Connection(role)
        connection.receive_data(stream)
        unknown = packets = 0
        while (event := connection.next_event()) is not NEED_DATA:
            packets += not isinstance(event, FramingFault)
            unknown += type(event).__name__ == "UnknownMessage"
        assert (connection.statistics.packets, connection.statistics.unknown) == (packets, unknown)
        assert connection.statistics.bytes == len(stream)


def test_totals_go_on_over_connections() -> None:
    statistics = LinkStatistics()
    for _ in range(3):
        connection = Connection(Role.HOST, statistics)
        connection.receive_data(bytes.fromhex("7D 10 6C 7E 7D 10 6D 7E"))
        while connection.next_event() is not NEED_DATA:
            pass
    assert (statistics.packets, statistics.checksum_failures, statistics.junk_bytes) == (3, 3, 12)
    assert not statistics.clean
    assert statistics.summary() == {
        "bytes": 24,
        "packets": 3,
        "junk_bytes": 12,
        "resyncs": 3,
        "checksum_failures": 3,
        "unknown": 0,
        "frames_lost": 0,
        "off_lattice_samples": 0,
        "faults": {"wrong checksum": 3},
    }

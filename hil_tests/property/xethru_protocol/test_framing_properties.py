"""The receiver on any bytes in any chunks."""

from contextlib import AbstractContextManager
from unittest import mock

from hypothesis import example, given, settings
from hypothesis import strategies as st

from hil_tests.property.examples import examples
from hil_tests.property.wire_streams import STREAMS, oracle, packets, read_all
from xethru_protocol.wire import framing
from xethru_protocol.wire.framing import FramingFault, Packet, encode_no_escape, encode_normal


def marking_windows(size: int) -> AbstractContextManager[object]:
    """Let the receiver mark terminators in windows of ``size`` bytes, also in short streams."""
    return mock.patch.multiple(
        framing,
        _NEAR=2,
        _WORTH_MARKING=3,
        _WORTH_MARKING_DAMAGED=3,
        _WINDOW=size,
        _WINDOW_DAMAGED=size,
        _SHORT=4,
    )


def packets_in(found: list[Packet | FramingFault]) -> list[tuple[int, bytes]]:
    return [(item.offset, item.payload) for item in found if isinstance(item, Packet)]


@settings(max_examples=examples(120, 400))
@given(STREAMS, st.data())
@example(b"\x01" + b"\x7c" * 12 + b"\x09", None)  # found when a run of 7C was reported twice
def test_any_chunking_gives_the_same_events(stream: bytes, data: st.DataObject | None) -> None:
    cuts = [] if data is None else data.draw(st.lists(st.integers(0, len(stream)), max_size=6))
    for ended in (False, True):
        whole = read_all(stream, ended=ended)
        assert read_all(stream, list(range(len(stream))), ended=ended) == whole
        assert read_all(stream, cuts, ended=ended) == whole


@settings(max_examples=examples(180, 600))
@given(STREAMS)
def test_packets_are_those_of_the_rescan_rule(stream: bytes) -> None:
    assert packets_in(read_all(stream)) == oracle(stream)


@settings(max_examples=examples(120, 400))
@given(STREAMS, st.integers(2, 70), st.lists(st.integers(0, 300), max_size=3))
def test_marking_terminators_in_windows_changes_nothing(
    stream: bytes, size: int, cuts: list[int]
) -> None:
    expected = read_all(stream, ended=True)
    with marking_windows(size):
        assert read_all(stream, [cut for cut in cuts if cut < len(stream)], ended=True) == expected


@settings(max_examples=examples(100, 300))
@given(
    st.lists(st.sampled_from([0x10, 0x7D, 0x7E, 0x7F]), max_size=60).map(bytes),
    st.integers(2, 20),
    st.integers(1, 60),
)
def test_terminators_are_those_that_a_reader_of_single_bytes_stops_at(
    stream: bytes, size: int, chunk: int
) -> None:
    finder = framing.TerminatorFinder()
    with marking_windows(size):
        start = stream.find(b"\x7d")
        for limit in range(chunk, len(stream) + chunk, chunk):
            while 0 <= start < min(limit, len(stream)):
                end = finder.after(stream[:limit], 0, start, 1000)
                assert end == _stops_at(stream[:limit], start)
                if end < 0:
                    break
                between = stream[start + 1 : end]
                literal = bytes(byte for byte, is_literal in _literals(between) if is_literal)
                assert finder.content(stream[:limit], 0, start) == literal
                start = stream.find(b"\x7d", start + 1)


def _literals(between: bytes) -> list[tuple[int, bool]]:
    marked, escaped = [], False
    for byte in between:
        escaped = byte == 0x7F and not escaped
        marked.append((byte, not escaped))
    return marked


def _stops_at(stream: bytes, start: int) -> int:
    at = start + 1
    while at < len(stream):
        if stream[at] in (0x7D, 0x7E):
            return at
        at += 2 if stream[at] == 0x7F else 1
    return -1


def holds_a_start(packet: bytes) -> bool:
    """Whether a Normal packet holds the start of a NoEscape one, as none should (Reference 1.2)."""
    return packet[:1] == b"\x7d" and b"\x7c" * 4 in packet


@given(
    st.lists(
        st.tuples(
            st.binary(max_size=30).map(lambda raw: raw.translate(None, b"\x7c\x7d")),
            packets().filter(lambda packet: not holds_a_start(packet)),
        ),
        max_size=6,
    )
)
def test_intact_packets_are_found_and_garbage_between_them_is_one_fault_each(
    parts: list[tuple[bytes, bytes]],
) -> None:
    stream = b"".join(junk + packet for junk, packet in parts)
    found = read_all(stream)
    offsets, at = [], 0
    for junk, packet in parts:
        offsets.append(at + len(junk))
        at += len(junk) + len(packet)
    assert [offset for offset, _ in packets_in(found)] == offsets
    assert len(found) == len(parts) + sum(junk != b"" for junk, _ in parts)


@given(st.binary(min_size=1, max_size=200))
def test_what_is_framed_is_read_back(payload: bytes) -> None:
    packet = encode_normal(payload)
    if not holds_a_start(packet):
        assert packets_in(read_all(packet)) == [(0, payload)]
    frame = b"\xa0\x10" + bytes(8) + len(payload).to_bytes(4, "little") + payload
    assert packets_in(read_all(encode_no_escape(frame))) == [(0, frame)]


def test_a_packet_that_holds_a_start_waits_for_what_follows() -> None:
    """Its first byte begins no known message, so it may be a false start in front of a frame."""
    packet = bytes.fromhex("7D 7C7C7C7C 7F7D 7E")
    expected = [(0, b"\x7c" * 4)]
    assert packets_in(read_all(packet)) == []
    assert packets_in(read_all(packet, ended=True)) == expected
    ack = bytes.fromhex("7D 10 6D 7E")
    assert packets_in(read_all(packet + ack)) == [*expected, (len(packet), b"\x10")]

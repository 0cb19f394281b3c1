"""Strategies for packets and damaged streams, the receiver on such, and a slow oracle of it."""

from collections.abc import Iterable

from hypothesis import strategies as st

from xethru_protocol.wire.framing import (
    Direction,
    FramingFault,
    NeedData,
    Packet,
    PacketReader,
    encode_no_escape,
    encode_normal,
)

_NASTY = st.sampled_from([0x7C, 0x7D, 0x7E, 0x7F, 0x00, 0x01, 0x0E, 0x10, 0x12, 0xA0])


@st.composite
def packets(draw: st.DrawFn) -> bytes:
    payload = bytes(draw(st.lists(_NASTY | st.integers(0, 0xFF), min_size=1, max_size=24)))
    kind = draw(st.sampled_from(["normal", "short", "reply", "frame"]))
    if kind == "normal":
        return encode_normal(payload)
    if kind == "short":
        return encode_no_escape(
            bytes([draw(st.sampled_from([0x01, 0x10, 0x20, 0x30]))]) + payload[:9]
        )
    if kind == "reply":  # of bytes, with or without trailer
        trailer = draw(st.sampled_from([b"", b"\x01"]))
        header = b"\x11\x10" + bytes(8) + len(payload).to_bytes(4, "little")
        return encode_no_escape(header + payload + trailer)
    samples = payload[: len(payload) & ~3]
    header = b"\xa0\x12" + bytes(8) + (len(samples) // 4).to_bytes(4, "little")
    return encode_no_escape(header + samples)


@st.composite
def _damaged(draw: st.DrawFn) -> bytes:
    packet = bytearray(draw(packets()))
    at = draw(st.integers(0, len(packet) - 1))
    match draw(st.sampled_from(["cut", "flip", "drop", "insert"])):
        case "cut":
            return bytes(packet[:at])
        case "flip":
            packet[at] = draw(_NASTY)
        case "drop":
            del packet[at]
        case "insert":
            packet.insert(at, draw(_NASTY))
    return bytes(packet)


GARBAGE = st.lists(_NASTY, max_size=14).map(bytes) | st.integers(1, 14).map(lambda n: b"\x7c" * n)
STREAMS = st.lists(packets() | _damaged() | GARBAGE | st.binary(max_size=9), max_size=9).map(
    b"".join
)


def drain(reader: PacketReader) -> list[Packet | FramingFault]:
    found: list[Packet | FramingFault] = []
    while not isinstance(item := reader.next_packet(), NeedData):
        found.append(item)
    return found


def read_all(
    data: bytes,
    cuts: Iterable[int] = (),
    *,
    direction: Direction = Direction.FROM_MODULE,
    ended: bool = False,
) -> list[Packet | FramingFault]:
    """Read a stream that comes in pieces; ``ended``: nothing comes behind it."""
    reader = PacketReader(direction)
    found: list[Packet | FramingFault] = []
    previous = 0
    for cut in [*sorted(cuts), len(data)]:
        reader.receive_data(data[previous:cut])
        previous = cut
        if ended and cut == len(data):
            reader.end_data()
        found += drain(reader)
    return found


def oracle(data: bytes) -> list[tuple[int, bytes]]:
    """Offsets and payloads of the packets in ``data``, straight from the rescan rule.

    Tries every start in order of its position, one byte at a time, and restarts behind each
    rejected one: quadratic, and nothing to get wrong. Protocol reference 1.4.
    """
    found = []
    at = 0
    while at < len(data):
        end = _normal_end(data, at) if data[at] == 0x7D else _bulk_end(data, at)
        if end == "more":
            break
        if isinstance(end, tuple):
            found.append((at, end[0]))
            at = end[1]
        else:
            at += 1
    return found


def _normal_end(data: bytes, at: int) -> tuple[bytes, int] | str | None:
    content = bytearray()
    position = at + 1
    while position < len(data) and data[position] not in (0x7D, 0x7E):
        position += data[position] == 0x7F
        if position < len(data):
            content.append(data[position])
        position += 1
    if position >= len(data):
        return "more"
    checksum = 0
    for byte in content:
        checksum ^= byte
    if data[position] == 0x7E and checksum == 0x7D and len(content) > 1:
        inside = _header_inside(data, at, position) if content[0] not in _KNOWN else False
        if isinstance(inside, str):
            return inside
        return None if inside else (bytes(content[:-1]), position + 1)
    return None


_KNOWN = (0x01, 0x10, 0x11, 0x12, 0x20, 0x30, 0x50, 0xA0)


def _header_inside(data: bytes, start: int, end: int) -> bool | str:
    """Whether a plausible NoEscape header begins between the ends of a packet."""
    for at in range(start + 1, end):
        if data[at : at + 4] != b"\x7c" * 4:
            continue
        if len(data) < at + 8:
            return "more"
        length = int.from_bytes(data[at + 4 : at + 8], "little")
        if not 1 <= length <= 65535:
            continue
        payload = data[at + 9 : at + 9 + length]
        if len(payload) < min(length, 14):
            return "more"
        if _plausible(length, payload):
            return True
    return False


def _bulk_end(data: bytes, at: int) -> tuple[bytes, int] | str | None:
    if data[at : at + 4] != b"\x7c" * 4:
        return None
    length = int.from_bytes(data[at + 4 : at + 8], "little")
    payload = data[at + 9 : at + 9 + length]
    if len(data) < at + 9:
        return "more"
    if not 1 <= length <= 65535:
        return None
    if len(payload) < min(length, 14):
        return "more"
    if not _plausible(length, payload):
        return None
    return (payload, at + 9 + length) if len(payload) == length else "more"


def _plausible(length: int, payload: bytes) -> bool:  # noqa: PLR0911 - one return per rule
    if payload[0] not in _KNOWN:
        return False
    if length < 14:
        return True
    sizes = {0x10: 1, 0x11: 4, 0x12: 4, 0x13: 1, 0x50: 1}
    count = int.from_bytes(payload[10:14], "little")
    if payload[0] == 0x12:
        sizes[0x00] = 1
    if payload[0] in (0xA0, 0x12):
        return payload[1] in sizes and 14 + count * sizes[payload[1]] == length
    if payload[0] == 0x11:
        if payload[1] not in sizes:
            return False
        # Protocol reference 5.2: 14 bytes, the elements, a trailer byte unless the elements are
        # INT; "accept with or without trailer"
        elements_end = 14 + count * sizes[payload[1]]
        return length == elements_end or (length == elements_end + 1 and payload[1] != 0x11)
    if payload[0] == 0x50:
        kind = int.from_bytes(payload[1:5], "little")
        bins = int.from_bytes(payload[9:13], "little")
        if kind in (0x0C, 0x0D):
            return length == 29 + 8 * bins
        if kind in (0x10, 0x12):
            return length >= 49 and (length - 49) % 4 == 0
        return length >= 57 if kind in (0x11, 0x13) else length <= 7995
    return length <= 14

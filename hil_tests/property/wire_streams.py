"""Hypothesis strategies for messages, packets and damaged streams, and a slow oracle receiver."""

from typing import Any

import numpy as np
from hypothesis import strategies as st

from xethru_protocol import wire
from xethru_protocol.codes import X4Setting
from xethru_protocol.messages import REGISTERS, X4_SET_LAYOUTS, X4DriverGet, X4DriverSet
from xethru_protocol.packets import encode_no_escape, encode_normal
from xethru_protocol.table import ROWS, Message

FLOATS = st.floats(width=32, allow_nan=False)
_SCALARS: dict[str, st.SearchStrategy[Any]] = {
    "B": st.integers(0, 0xFF),
    "I": st.integers(0, 0xFFFFFFFF),
    "i": st.integers(-(1 << 31), (1 << 31) - 1),
    "f": FLOATS,
}


def messages(kinds: type[Message] | None = None) -> st.SearchStrategy[Any]:
    """Any message of the table (or of one base), built from its row."""
    rows = [cls for cls in ROWS if kinds is None or issubclass(cls, kinds)]
    return st.sampled_from(rows).flatmap(of_type)


def of_type(cls: type[Message]) -> st.SearchStrategy[Any]:
    """Messages of one type."""
    if cls is X4DriverSet:
        return _x4_set()
    if cls is X4DriverGet:
        plain = st.sampled_from([s for s in X4Setting if s not in REGISTERS])
        register = st.sampled_from(sorted(REGISTERS))
        return st.builds(X4DriverGet, setting=plain) | st.builds(
            X4DriverGet, setting=register, address=_SCALARS["B"]
        )
    return st.integers(0, 40).flatmap(
        lambda bins: st.builds(
            cls, **{name: _field(name, kind, bins) for name, kind in ROWS[cls].kinds}
        )
    )


def _field(  # noqa: PLR0911 - one return per kind of field
    name: str, kind: wire.Kind, bins: int
) -> st.SearchStrategy[Any]:
    match kind:
        case wire.Number():
            return st.just(bins) if name == "num_bins" else _SCALARS[kind.code]
        case wire.Member():
            return st.sampled_from(X4Setting)
        case wire.OptionalByte():
            return st.none() | _SCALARS["B"]
        case wire.Bins():
            return _array(bins)
        case wire.RestBytes():
            return st.binary(max_size=40)
        case wire.Elements(code="a"):
            return _array(bins)
        case wire.Elements(code="c"):
            return st.binary(max_size=40)
        case wire.Elements(code="s"):
            return st.binary(max_size=40).map(lambda raw: raw.decode("latin-1"))
        case wire.Elements():
            return st.lists(_SCALARS[kind.code], max_size=9).map(tuple)
    raise AssertionError(f"no strategy for {kind}")


def _array(size: int) -> st.SearchStrategy[Any]:
    # Specials of the framing are likely among the bytes: 7C 7D 7E 7F are what can go wrong.
    byte = st.sampled_from([0, 1, 0x3F, 0x7C, 0x7D, 0x7E, 0x7F])
    raw = st.lists(byte, min_size=4 * size, max_size=4 * size).map(bytes)
    return raw.map(lambda data: np.frombuffer(data, dtype="<f4"))


def _x4_set() -> st.SearchStrategy[X4DriverSet]:
    def of_setting(setting: int) -> st.SearchStrategy[X4DriverSet]:
        codes, names = X4_SET_LAYOUTS[setting]
        scalars = [_SCALARS[code] for code in codes]
        value = st.tuples(*scalars) if len(names) > 1 else scalars[0]
        return st.builds(X4DriverSet, setting=st.just(X4Setting(setting)), value=value)

    return st.sampled_from(sorted(X4_SET_LAYOUTS)).flatmap(of_setting)


_NASTY = st.sampled_from([0x7C, 0x7D, 0x7E, 0x7F, 0x00, 0x01, 0x0E, 0x10, 0x12, 0xA0])


@st.composite
def packets(draw: st.DrawFn) -> bytes:
    """Draw an intact packet that a receiver on the host side accepts."""
    payload = bytes(draw(st.lists(_NASTY | _SCALARS["B"], min_size=1, max_size=24)))
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
        return bytes(content[:-1]), position + 1
    return None


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
    if payload[0] not in (0x01, 0x10, 0x11, 0x12, 0x20, 0x30, 0x50, 0xA0):
        return False
    if length < 14:
        return True
    sizes = {0x10: 1, 0x11: 4, 0x12: 4, 0x13: 1, 0x50: 1}
    count = int.from_bytes(payload[10:14], "little")
    if payload[0] == 0xA0:
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

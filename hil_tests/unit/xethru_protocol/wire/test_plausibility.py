"""Which NoEscape headers can be true, by the layouts of the Protocol reference."""

import pytest

from xethru_protocol.wire.framing import (
    Direction,
    plausible,
)

FROM_HOST, FROM_MODULE = Direction.FROM_HOST, Direction.FROM_MODULE
BYTE, INT, FLOAT, STRING, USER, NONE = 0x10, 0x11, 0x12, 0x13, 0x50, 0x00


def lengths(head: bytes, direction: Direction = FROM_MODULE) -> list[int]:
    """Lengths from 14 to 99 that ``head`` may announce."""
    assert len(head) == 14
    return [length for length in range(14, 100) if plausible(length, head, direction)]


def elements(code: int, kind: int, count: int) -> bytes:
    return bytes((code, kind)) + bytes(8) + count.to_bytes(4, "little")


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        (BYTE, [17, 18]),
        (INT, [26]),
        (FLOAT, [26, 27]),
        (STRING, [17, 18]),
        (USER, [17, 18]),
        (NONE, []),
    ],
)
def test_reply_has_its_elements_and_perhaps_a_trailer(kind: int, expected: list[int]) -> None:
    """5.2: 14 bytes, the elements, a trailer that may be left out and that INT never has."""
    assert lengths(elements(0x11, kind, 3)) == expected


@pytest.mark.parametrize(
    ("kind", "expected"), [(BYTE, [17]), (FLOAT, [26]), (STRING, [17]), (USER, [17]), (NONE, [])]
)
def test_data_have_their_elements_and_nothing_else(kind: int, expected: list[int]) -> None:
    assert lengths(elements(0xA0, kind, 3)) == expected


@pytest.mark.parametrize(
    ("kind", "expected"),
    [(NONE, [17]), (BYTE, [17]), (INT, [26]), (FLOAT, [26]), (STRING, [17]), (USER, [17])],
)
def test_hil_has_its_elements_and_nothing_else(kind: int, expected: list[int]) -> None:
    """5.4, and 1.3: a host accepts both framings for the same message."""
    assert lengths(elements(0x12, kind, 3)) == expected


def test_what_a_host_sends_is_not_judged_by_what_a_module_sends() -> None:
    """2: A0 and 50 are HIL and X4DRIVER then, not DATA and APPDATA."""
    everything = list(range(14, 100))
    assert lengths(elements(0xA0, FLOAT, 3), FROM_HOST) == everything
    assert lengths(b"\x50\x0c" + bytes(12), FROM_HOST) == everything


@pytest.mark.parametrize(
    ("message_id", "expected"),
    [
        (0x0C, [45]),  # 29 + 8 N at two bins
        (0x0D, [45]),
        (0x10, list(range(49, 100, 4))),  # 49 + 4 F, with F behind the head
        (0x12, list(range(49, 100, 4))),
        (0x11, list(range(57, 100))),  # 57 + F
        (0x13, list(range(57, 100))),
        (0xC1A3117E, [41]),  # 33 + 4 N
        (0xB13B8F12, [41]),
        (0x026F1379, [65]),  # 49 + 8 N
        (0xEC8D0AA5, [61]),  # 53 + 4 N
        (0x723BFA1E, list(range(14, 100))),
    ],
    ids=lambda value: hex(value) if isinstance(value, int) else "",
)
def test_application_data_have_the_length_of_their_layout(
    message_id: int, expected: list[int]
) -> None:
    """7.1, 7.2 and 7.5: the length fields."""
    fields = (7).to_bytes(4, "little") + (2).to_bytes(4, "little")
    assert lengths(b"\x50" + message_id.to_bytes(4, "little") + fields + b"\x00") == expected


def test_direction_tells_what_a_first_byte_means() -> None:
    ping = b"\x01\xae\xea\xaa\xee"
    reset = b"\x22"
    assert plausible(5, ping, FROM_HOST)
    assert plausible(5, ping, FROM_MODULE)  # it may be a PONG
    assert plausible(1, reset, FROM_HOST)
    assert not plausible(1, reset, FROM_MODULE)

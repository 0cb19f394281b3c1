"""No id of the protocol reference is nameless: each has an enum member and a vector.

``fixtures/wire/reference_ids.toml`` transcribes the reference's tables of ids by hand. Vectors are
searched by their bytes; that they decode, and to which message, is `test_protocol_vectors`' matter.
"""

import re
import tomllib
from enum import IntEnum, IntFlag
from typing import Any

import pytest

from hil_tests.golden.vectors import load, load_hand_made
from hil_tests.paths import FIXTURES
from xethru_protocol.wire import codes
from xethru_protocol.wire.codec import decode_command, decode_response
from xethru_protocol.wire.messages import Hil, LegacyDirCommand, SetCom, UnknownMessage

TABLES: list[dict[str, Any]] = tomllib.loads(
    (FIXTURES / "wire" / "reference_ids.toml").read_text("utf-8")
)["table"]
VECTORS = [v for v in (*load(), *load_hand_made()) if v.payload]


def members(name: str) -> dict[str, int]:
    enum = getattr(codes, name)
    assert issubclass(enum, IntEnum | IntFlag)
    return {member.name: int(member) for member in enum}


def values_in_vectors(place: str) -> set[int]:
    """Numbers at one place of all vectors' payloads, ``"command 10 11 @2/4"`` for example."""
    sender, head, offset, size = re.fullmatch(r"(\w+) (.*)@(\d+)/([14])", place).groups()  # type: ignore[union-attr] # a malformed place must fail
    start, end = int(offset), int(offset) + int(size)
    return {
        int.from_bytes(vector.payload[start:end], "little")
        for vector in VECTORS
        if vector.payload is not None
        and vector.from_host == (sender == "command")
        and vector.payload.startswith(bytes.fromhex(head))
        and len(vector.payload) >= end
    }


def test_every_enum_stands_in_the_reference() -> None:
    enums = {
        name
        for name in vars(codes)
        if isinstance(entry := getattr(codes, name), type) and issubclass(entry, IntEnum | IntFlag)
        if entry.__module__ == codes.__name__
    }
    listed = [table["enum"] for table in TABLES]
    assert set(listed) == enums
    assert len(listed) == len(enums)


def test_rates_of_a_uart_are_the_references() -> None:
    """Protocol reference 10."""
    assert (
        *(9_600, 19_200, 38_400, 115_200, 230_400, 460_800, 500_000, 576_000, 921_600),
        *(10**6, 2 * 10**6, 3 * 10**6, 4 * 10**6),
    ) == codes.BAUD_RATES


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table["enum"])
def test_enums_have_the_references_ids_and_names(table: dict[str, Any]) -> None:
    found = {
        name.removeprefix(table.get("prefix", "")): code
        for name, code in members(table["enum"]).items()
    }
    assert found == table["ids"]


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table["enum"])
def test_every_id_is_in_a_vector(table: dict[str, Any]) -> None:
    seen = set().union(*(values_in_vectors(place) for place in table["seen_in"]))
    if table.get("bits"):
        missing = {name for name, bit in table["ids"].items() if not any(bit & n for n in seen)}
    else:
        missing = {name for name, code in table["ids"].items() if code not in seen}
    assert not missing


def test_codes_of_the_x2_era_are_commands_of_their_own() -> None:
    """4.10: 10 to 40, 51 to 57 and 60 have builders on the host; 12 and 55 have rows."""
    legacy = {*range(0x10, 0x41), *range(0x51, 0x58), 0x60} - {0x12, 0x55}
    for code in range(256):
        message = decode_command(bytes((0x90, code, 0xAB)))
        if code in legacy:
            assert message == LegacyDirCommand(sub_code=code, data=b"\xab")
        else:
            assert not isinstance(message, LegacyDirCommand)


def test_commands_that_no_firmware_handles_have_a_class() -> None:
    assert decode_command(b"\x23\x01\x02") == SetCom(data=b"\x01\x02")
    assert decode_command(b"\xa0") == Hil()


@pytest.mark.parametrize(
    "payload",
    ["51 00", "02", "50 BB 95 36 A5 00", "11 99 00 00 00 00 00 00 00 00", "A0 11" + " 00" * 12, ""],
)
def test_responses_that_the_reference_does_not_name_are_unknown(payload: str) -> None:
    data = bytes.fromhex(payload)
    assert decode_response(data) == UnknownMessage(code=data[0] if data else -1, payload=data)


@pytest.mark.parametrize("payload", ["51 00", "10 10 BB 95 36 A5", "10 17", "90 77", "50 16", "EE"])
def test_commands_that_the_reference_does_not_name_are_unknown(payload: str) -> None:
    data = bytes.fromhex(payload)
    assert decode_command(data) == UnknownMessage(code=data[0], payload=data)

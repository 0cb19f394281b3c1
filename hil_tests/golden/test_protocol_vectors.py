"""Every byte string of the vendor's documents and parser, through codec and framing.

Rows that those do not show have vectors put together by hand. The former were run through the
vendor's own parser; where our receiver is stricter or more robust (Protocol reference 1.2, 1.4),
the difference is asserted by name.
"""

from collections import Counter
from typing import Any

import pytest

from hil_tests.golden.builders import BUILDERS, message_of
from hil_tests.golden.vectors import ABOUT, Vector, for_each, load, load_hand_made
from hil_tests.property.wire_streams import read_all
from xethru_protocol.wire.codec import decode_command, decode_response, describe
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import (
    NEED_DATA,
    Direction,
    FaultKind,
    Framing,
    FramingFault,
    Packet,
)
from xethru_protocol.wire.messages import DeleteNoiseMap, Message, UnknownMessage, X4DriverSet
from xethru_protocol.wire.table import ROWS

DOCUMENTED = load()
HAND_MADE = load_hand_made()
VECTORS = (*DOCUMENTED, *HAND_MADE)
BY_NAME = {vector.name: vector for vector in VECTORS}
MESSAGES = [v for v in VECTORS if v.valid and not v.is_stream]
KNOWN = [v for v in MESSAGES if v.message in BUILDERS]
NAMELESS = [
    v
    for v in MESSAGES
    if v.name in {"doc_noescape_example", "opcode_unknown_EE", "bl_unknown_command"}
]
STREAMS = [v for v in VECTORS if v.valid and v.is_stream]
INVALID = [v for v in VECTORS if not v.valid]


def packets_of(vector: Vector, chunk: int = 1 << 20) -> list[Packet | FramingFault]:
    direction = Direction.FROM_HOST if vector.from_host else Direction.FROM_MODULE
    return read_all(vector.wire, range(chunk, len(vector.wire), chunk), direction=direction)


def received(vector: Vector) -> Message:
    connection = Connection(Role.MODULE if vector.from_host else Role.HOST)
    connection.receive_data(vector.wire)
    event = connection.next_event()
    assert isinstance(event, Message)
    assert connection.next_event() is NEED_DATA
    return event


def test_every_vector_is_in_exactly_one_group() -> None:
    groups = [KNOWN, NAMELESS, STREAMS, INVALID]
    assert Counter(v.name for group in groups for v in group) == Counter(v.name for v in VECTORS)
    assert all(groups)
    assert all(v in KNOWN for v in HAND_MADE)


def test_every_row_of_the_message_table_has_a_vector() -> None:
    assert {type(message_of(vector)) for vector in KNOWN} == set(ROWS)


@for_each(KNOWN)
def test_wire_decodes_to_the_described_message(vector: Vector) -> None:
    found, described = received(vector), message_of(vector)
    if "nan" in vector.name:  # which equals nothing
        assert str(found) == str(described)
    else:
        assert found == described


@for_each(KNOWN)
def test_described_message_encodes_to_the_wire(vector: Vector) -> None:
    role = Role.HOST if vector.from_host else Role.MODULE
    framing = Framing(vector.decoded["framing"])
    assert Connection(role).send(message_of(vector), framing) == vector.wire


@for_each(
    # the same message in the framing a module does not use for it
    [v for v in KNOWN if v.name not in {"data_float_normal_framing", "data_byte_normal_framing"}]
)
def test_default_framing_is_the_one_real_devices_use(vector: Vector) -> None:
    role = Role.HOST if vector.from_host else Role.MODULE
    assert Connection(role).send(message_of(vector)) == vector.wire


@for_each(KNOWN)
def test_dump_has_the_vectors_names_and_fields(vector: Vector) -> None:
    name, fields = describe(received(vector))
    expected: dict[str, Any] = {k: v for k, v in vector.decoded.items() if k not in ABOUT}
    if vector.name == "reply_system_test_x4_conn_pass":
        assert expected.pop("values") == "see payload"
        assert fields.pop("values") == [1, *[0] * 255]
    if vector.name == "data_float_baseband_181bins":
        assert fields.pop("data") == [(k - 90) / 1024 for k in range(362)]
    assert name == vector.message
    assert fields == expected


@for_each(NAMELESS)
def test_message_without_row_arrives_whole(vector: Vector) -> None:
    message = received(vector)
    assert vector.payload is not None
    assert message == UnknownMessage(code=vector.payload[0], payload=vector.payload)
    name, fields = describe(message)
    assert name == (vector.message if vector.from_host else "UNKNOWN")
    assert fields == {"code": vector.payload[0], "payload": vector.decoded["payload"]}


@for_each([*MESSAGES, *STREAMS])
def test_packets_are_those_of_the_vendors_parser(vector: Vector) -> None:
    for chunk in (1, 7, 1 << 20):
        check_packets(vector, chunk)


def check_packets(vector: Vector, chunk: int) -> None:
    packets = [p.payload for p in packets_of(vector, chunk) if isinstance(p, Packet)]
    if vector.name == "stream_missing_start_accepted":
        # 1.2 recommends to drop what has no start byte
        assert packets == [bytes.fromhex(vector.decoded["packets"][0])]
    elif vector.decoded["framing"] == "stream":
        assert packets == [bytes.fromhex(text) for text in vector.decoded["packets"]]
    elif vector.payload is None:
        assert len(packets[0]) == vector.decoded["length_field"]
    else:
        assert packets == [vector.payload]


@pytest.mark.parametrize(
    ("name", "faults"),
    [
        ("stream_bad_checksum_then_good", [(FaultKind.CHECKSUM, 0)]),
        ("stream_garbage_between_packets", [(FaultKind.GARBAGE, 8)]),
        ("stream_start_in_mid_packet", [(FaultKind.TRUNCATED, 0)]),
        ("stream_double_start", []),
        ("stream_lone_end", [(FaultKind.GARBAGE, 0)]),
        ("stream_missing_start_accepted", [(FaultKind.GARBAGE, 8)]),
        ("stream_empty_packet", [(FaultKind.EMPTY, 0)]),
        ("stream_escape_before_ordinary_byte", []),
        ("stream_noescape_then_normal", []),
        ("stream_noescape_after_junk", [(FaultKind.GARBAGE, 0)]),
        ("stream_ack_between_two_frames", []),
    ],
)
def test_damage_is_reported_where_it_begins(name: str, faults: list[tuple[FaultKind, int]]) -> None:
    found = [(f.kind, f.offset) for f in packets_of(BY_NAME[name]) if isinstance(f, FramingFault)]
    assert found == faults


def test_every_invalid_vector_has_its_own_test_below() -> None:
    assert {v.name for v in INVALID} == {
        "doc_escaping_example",
        "doc_x4_set_pps_20_short",
        "noisemap_delete_as_documented",
        "x4_set_pps_20_as_float",
        "stream_7c7c7c7c_inside_normal_packet",
    }


def test_wrongly_printed_checksum_is_dropped() -> None:
    assert packets_of(BY_NAME["doc_escaping_example"]) == [
        FramingFault(kind=FaultKind.CHECKSUM, offset=0)
    ]


def test_one_byte_pulses_per_step_are_accepted_and_never_sent() -> None:
    message = received(BY_NAME["doc_x4_set_pps_20_short"])
    assert isinstance(message, X4DriverSet)
    assert message.value == 20
    sent = Connection(Role.HOST).send(X4DriverSet(setting=message.setting, value=20))
    assert sent == BY_NAME["x4_set_pps_20"].wire


def test_pulses_per_step_sent_as_float_are_read_as_the_firmware_reads_them() -> None:
    message = received(BY_NAME["x4_set_pps_20_as_float"])
    assert isinstance(message, X4DriverSet)
    assert message.value == BY_NAME["x4_set_pps_20_as_float"].decoded["value_as_uint32"]


def test_delete_noise_map_as_printed_deletes_it_too() -> None:
    """11 row 2: 16 is what the firmware parses, 15 what the document prints."""
    vector = BY_NAME["noisemap_delete_as_documented"]
    message = received(vector)
    assert message == DeleteNoiseMap(sub_code=0x15)
    assert describe(message) == ("APP_DELETE_NOISEMAP", {"sub_code": "0x15"})
    assert Connection(Role.HOST).send(message) == vector.wire


@pytest.mark.parametrize("chunk", [1, 1 << 20])
def test_noescape_start_inside_a_good_normal_packet_is_data(chunk: int) -> None:
    vector = BY_NAME["stream_7c7c7c7c_inside_normal_packet"]
    (packet,) = packets_of(vector, chunk)
    assert isinstance(packet, Packet)
    assert packet.payload == vector.payload
    message = decode_command(packet.payload)
    assert isinstance(message, X4DriverSet)
    assert message.value == vector.decoded["value"]


def test_noescape_example_of_the_document_is_a_packet_but_no_pong() -> None:
    (packet,) = packets_of(BY_NAME["doc_noescape_example"])
    assert isinstance(packet, Packet)
    assert decode_response(packet.payload) == UnknownMessage(code=1, payload=b"\x01\x02\x03")

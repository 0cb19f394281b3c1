"""Every row of the message table, both ways, and any bytes."""

import json
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hil_tests.property.message_strategies import messages
from xethru_protocol import wire
from xethru_protocol.codec import (
    decode_command,
    decode_response,
    decode_response_at,
    describe,
    encode,
)
from xethru_protocol.codes import X4Setting
from xethru_protocol.messages import X4DriverSet
from xethru_protocol.table import ROWS, Command, Message, Response, UnknownMessage


@given(messages(Command), st.booleans())
def test_commands_survive_the_wire(message: Any, bulk: bool) -> None:  # noqa: ANN401 - any row
    assert decode_command(encode(message, bulk=bulk)) == message


@given(messages(Response), st.booleans())
def test_responses_survive_the_wire(message: Any, bulk: bool) -> None:  # noqa: ANN401 - any row
    assert decode_response(encode(message, bulk=bulk)) == message


@given(st.binary(max_size=80))
def test_any_payload_is_some_message(payload: bytes) -> None:
    for decode in (decode_command, decode_response):
        message = decode(payload)
        if isinstance(message, UnknownMessage):
            assert message.payload == payload
            assert encode(message) == payload
        else:
            # bytes behind the last field are ignored, so a second trip changes nothing
            assert decode(encode(message)) == message


@settings(max_examples=400)
@given(messages(), st.data())
def test_short_payloads_are_never_misread(message: Any, data: st.DataObject) -> None:  # noqa: ANN401 - any row
    """What is cut is unknown, or the same message with nothing in it that was not sent."""
    payload = encode(message)
    cut = payload[: data.draw(st.integers(0, len(payload) - 1))]
    decode = decode_command if isinstance(message, Command) else decode_response
    read = decode(cut)
    if isinstance(read, UnknownMessage):
        assert read.payload == cut
        return
    assert type(read) is type(message)
    if isinstance(message, X4DriverSet) and read != message:
        # two settings also travel in one byte (Protocol reference 11, 1 and 3)
        assert message.setting in {X4Setting.PULSESPERSTEP, X4Setting.DACSTEP}
        assert read == X4DriverSet(setting=message.setting, value_width=1, value=cut[-1])
        return
    for name, kind in ROWS[type(message)].kinds:
        found, sent = getattr(read, name), getattr(message, name)
        if isinstance(kind, wire.Elements):
            assert len(found) == 0 or np.array_equal(found, sent)
        elif isinstance(kind, wire.RestBytes):
            assert sent[: len(found)] == found
        elif isinstance(kind, wire.OptionalByte):
            assert found in {None, sent}
        else:
            assert np.array_equal(found, sent)


@given(st.binary(max_size=9), st.binary(max_size=80), st.binary(max_size=9))
def test_decoding_in_place_equals_decoding_a_copy(
    before: bytes, payload: bytes, after: bytes
) -> None:
    for head in (b"", b"\xa0\x12", b"\xa0\x12" + bytes(8) + (4).to_bytes(4, "little")):
        whole = before + head + payload + after
        start, end = len(before), len(before) + len(head) + len(payload)
        assert decode_response_at(whole, start, end) == decode_response(whole[start:end])


@given(messages())
def test_dumps_are_json(message: Any) -> None:  # noqa: ANN401 - any row
    name, fields = describe(message)
    assert name == ROWS[type(message)].name
    json.dumps(fields)


def test_no_two_rows_share_a_name_per_direction() -> None:
    for base in (Command, Response):
        names = [row.name for cls, row in ROWS.items() if issubclass(cls, base)]
        assert len(names) == len(set(names))


def test_every_command_names_its_reply() -> None:
    for cls, row in ROWS.items():
        if issubclass(cls, Command):
            assert row.replies, cls
            assert all(issubclass(reply, Message) for reply in row.replies)

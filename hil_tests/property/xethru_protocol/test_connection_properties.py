"""Two ends of a line without the line."""

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from hil_tests.property.message_strategies import messages
from hil_tests.property.wire_streams import STREAMS
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import NEED_DATA, FramingFault
from xethru_protocol.wire.table import Command, Message, Response


def events(connection: Connection) -> list[Any]:
    found = []
    while (event := connection.next_event()) is not NEED_DATA:
        found.append(event)
    return found


@given(st.lists(messages(Response), max_size=5), st.integers(1, 40))
def test_a_host_hears_what_a_module_says(sent: list[Any], chunk: int) -> None:
    module, host = Connection(Role.MODULE), Connection(Role.HOST)
    line = b"".join(map(module.send, sent))
    heard = []
    for begin in range(0, len(line), chunk):
        host.receive_data(line[begin : begin + chunk])
        heard += events(host)
    assert heard == sent


@given(st.lists(messages(Command), max_size=5))
def test_a_module_hears_what_a_host_says(sent: list[Any]) -> None:
    host, module = Connection(Role.HOST), Connection(Role.MODULE)
    module.receive_data(b"".join(map(host.send, sent)))
    assert events(module) == sent


@given(STREAMS)
def test_any_bytes_give_messages_and_faults_and_never_raise(stream: bytes) -> None:
    for role in Role:
        connection = Connection(role)
        connection.receive_data(stream)
        assert all(isinstance(event, Message | FramingFault) for event in events(connection))

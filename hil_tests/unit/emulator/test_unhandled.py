"""Commands that have a row but no handler are answered as the firmware answers unknown ones."""

import pytest

from emulator.chip import Chip
from emulator.commands import HANDLERS, Module, answer
from hil_tests.golden.builders import message_of
from hil_tests.golden.test_protocol_vectors import KNOWN
from hil_tests.golden.vectors import Vector
from hil_tests.unit.emulator.doubles import IDENTITY, RampSource
from xethru_protocol import messages as m

UNHANDLED = [v for v in KNOWN if v.from_host and type(message_of(v)) not in HANDLERS]


@pytest.mark.parametrize("vector", UNHANDLED, ids=lambda v: v.name)
def test_a_command_without_handler_gets_error_1(vector: Vector) -> None:
    """3: unknown opcode, sub-code or id, or no handler."""
    module = Module(IDENTITY, Chip(RampSource()))
    assert answer(module, message_of(vector)) == m.Error(code=1)

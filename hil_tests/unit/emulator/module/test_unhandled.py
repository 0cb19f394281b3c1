"""Commands that a module answers with ERROR 1 in every mode, and no others, have no handler."""

import pytest

from emulator.chip.chip import Chip
from emulator.module.commands import HANDLERS, answer
from emulator.module.settings import DeviceOptions
from emulator.module.state import Module
from hil_tests.golden.builders import message_of
from hil_tests.golden.test_protocol_vectors import KNOWN
from hil_tests.golden.vectors import Vector
from hil_tests.unit.emulator.doubles import IDENTITY, RampSource
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.table import ROWS, Command

UNHANDLED = [v for v in KNOWN if v.from_host and type(message_of(v)) not in HANDLERS]

# 2 and 4.10: defined but handled by no firmware; HIL always ERROR 1; X2 codes; 4.12: the
# bootloader's commands, which it takes as bytes
HANDLED_BY_NO_FIRMWARE = {
    m.BootloaderEcho,
    m.BootloaderGetDeviceInfo,
    m.BootloaderPageCount,
    m.BootloaderPageSize,
    m.BootloaderStartApp,
    m.BootloaderWritePage,
    m.AppPoll,
    m.Hil,
    m.LegacyDirCommand,
    m.LegacyGetVarInt,
    m.LegacyGetVersion,
    m.SetCom,
    m.SystemGetDebugData,
}


def test_every_other_command_has_a_handler() -> None:
    commands = {kind for kind in ROWS if issubclass(kind, Command)}
    assert len(commands) > 70
    assert commands - set(HANDLERS) == HANDLED_BY_NO_FIRMWARE


@pytest.mark.parametrize("firmware", ["sensor", "xep"])
@pytest.mark.parametrize("vector", UNHANDLED, ids=lambda v: v.name)
def test_a_command_without_handler_gets_error_1(vector: Vector, firmware: str) -> None:
    """3: unknown opcode, sub-code or id, or no handler."""
    options = DeviceOptions(firmware="sensor" if firmware == "sensor" else "xep")
    module = Module(IDENTITY, Chip(RampSource()), options)
    assert answer(module, message_of(vector)) == m.Error(code=1)

"""Handlers of system info, system tests, baud rate and injected frames.

Source: protocol reference 4.10.
"""

from __future__ import annotations

from collections.abc import Callable

from emulator.handler_table import answers
from emulator.module import Module
from emulator.refusal import Refusal
from emulator.serial_rate import accepted_baudrate
from xethru_protocol import messages as m
from xethru_protocol.codes import DirCode, ErrorCode, TestCode, X4Error, X4Setting

TEST_REPLY_BYTES = 256
_TEST_CONTENT_ID = 0x5090


@answers(m.SystemGetInfo)
def _system_get_info(module: Module, command: m.SystemGetInfo) -> m.Response:
    text = module.identity.info(command.item, base_firmware=module.base_firmware)
    if text is None:
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    return m.ReplyString(content_id=DirCode.XTS_SDC_SYSTEM_GET_INFO, info=command.item, text=text)


@answers(m.SetBaudRate)
def _set_baud_rate(module: Module, command: m.SetBaudRate) -> m.Response:
    module.change_baudrate(accepted_baudrate(command.baudrate, module.uart_baudrate))
    return m.Ack()


@answers(m.PrepareInjectFrame, m.InjectFrame)
def _inject(module: Module, command: m.Message) -> m.Response:
    return m.Ack()  # accepted; this emulator's frames come from its scene


@answers(m.SystemTest)
def _system_test(module: Module, command: m.SystemTest) -> m.Response:
    if command.code in _ACKNOWLEDGED:
        _ACKNOWLEDGED[command.code](module)
        return m.Ack()
    test = _TESTS.get(command.code)
    if test is None:
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    data = test(module)
    return m.ReplyByte(
        content_id=_TEST_CONTENT_ID,
        info=command.code | data[0] << 8,
        values=data.ljust(TEST_REPLY_BYTES, b"\x00"),
    )


def _external_ram(module: Module) -> bytes:
    return b"\x01"


def _read_io_pins(module: Module) -> bytes:
    return b"\x01" + module.pins.levels().to_bytes(4, "little")


def _x4_connection(module: Module) -> bytes:
    if module.chip.powered:
        return b"\x01"
    return bytes([0, X4Error.REGISTER_TIMEOUT, 0])


def _certification(on: bool) -> Callable[[Module], bytes]:
    def switch(module: Module) -> bytes:
        module.certification = on
        module.save()
        return b"\x00"  # "not passed" although it worked, as the firmware says

    return switch


def _hardware_config(module: Module) -> bytes:
    return b"\x01" + module.identity.serial.encode("ascii")


def _sleep(module: Module) -> None:
    module.asleep = True


def _transmitter_off(module: Module) -> None:
    module.chip.set(X4Setting.TXPOWER, 0)


_TESTS: dict[int, Callable[[Module], bytes]] = {
    TestCode.EXTERNAL_RAM: _external_ram,
    TestCode.READ_IO_PINS: _read_io_pins,
    TestCode.X4_CONNECTION: _x4_connection,
    TestCode.CERTIFICATION_ON: _certification(on=True),
    TestCode.CERTIFICATION_OFF: _certification(on=False),
    TestCode.HARDWARE_CONFIG: _hardware_config,
}
"""Data of each test; the first byte is 1 if it passed."""
_ACKNOWLEDGED: dict[int, Callable[[Module], None]] = {
    TestCode.TX_ONLY: _sleep,
    TestCode.TX_ONLY_TX_OFF: _sleep,
    TestCode.STREAM_TX_OFF: _transmitter_off,
}

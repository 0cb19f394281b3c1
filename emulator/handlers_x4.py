"""Handlers of the radar chip: settings, registers, I2C, and what is done to its frames.

Source: protocol reference 4.9, 11 and 16.
"""

from __future__ import annotations

from emulator.handler_table import answers
from emulator.module import Module
from emulator.refusal import Refusal
from xethru_protocol import messages as m
from xethru_protocol.codes import I2C_REGISTER, ErrorCode, FramePostprocessing, X4Setting

LONGEST_READ = 4096
"""Register bytes one READ may ask for; the firmware checks nothing, its reply buffer would end."""


@answers(m.X4DriverInit)
def _x4_init(module: Module, command: m.X4DriverInit) -> m.Response:
    module.chip.init()
    module.reply_delay_ns = module.options.x4_init_ns
    return m.Ack()


@answers(m.X4DriverSet)
def _x4_set(module: Module, command: m.X4DriverSet) -> m.Response:
    module.chip.set(command.setting, command.value)
    return m.Ack()


_BYTE_REPLIES = frozenset(
    {
        X4Setting.DOWNCONVERSION,
        X4Setting.DACSTEP,
        X4Setting.TXCENTERFREQUENCY,
        X4Setting.TXPOWER,
        X4Setting.PRFDIV,
    }
)


@answers(m.X4DriverGet)
def _x4_get(module: Module, command: m.X4DriverGet) -> m.Response:
    setting = command.setting
    if command.address is not None:
        byte = module.chip.read_register(setting, command.address)
        return m.ReplyByte(content_id=setting, values=bytes([byte]))
    value = module.chip.get(setting)
    if isinstance(value, tuple):
        return m.ReplyFloat(content_id=setting, values=(float(value[0]), float(value[1])))
    if isinstance(value, float):
        return m.ReplyFloat(content_id=setting, values=(value,))
    if setting in _BYTE_REPLIES:
        return m.ReplyByte(content_id=setting, values=bytes([value]))
    return m.ReplyInt(content_id=setting, values=(value,))


@answers(m.X4DriverWrite)
def _x4_write(module: Module, command: m.X4DriverWrite) -> m.Response:
    _check_block_access(command.setting)
    # Assumed: consecutive registers, wrapping at 256; the reference names only the first.
    for address, byte in enumerate(command.values, start=command.address):
        module.chip.write_register(command.setting, address, byte)
    return m.Ack()


@answers(m.X4DriverRead)
def _x4_read(module: Module, command: m.X4DriverRead) -> m.Response:
    _check_block_access(command.setting)
    if command.length > LONGEST_READ:
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    addresses = range(command.address, command.address + command.length)  # as in WRITE
    values = bytes(module.chip.read_register(command.setting, address) for address in addresses)
    return m.ReplyByte(content_id=command.setting, values=values)


def _check_block_access(setting: X4Setting) -> None:
    if setting is not X4Setting.SPIREGISTER:
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)


@answers(m.X4DriverWriteI2c)
def _write_i2c(module: Module, command: m.X4DriverWriteI2c) -> m.Response:
    module.i2c[command.address] = command.values
    module.i2c_address = command.address
    return m.Ack()


@answers(m.X4DriverReadI2c)
def _read_i2c(module: Module, command: m.X4DriverReadI2c) -> m.Response:
    """Answer what was written last, as a device that keeps its registers; zeros beyond."""
    if command.length > LONGEST_READ:
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    values = module.i2c.get(module.i2c_address, b"").ljust(command.length, b"\x00")
    return m.ReplyByte(content_id=I2C_REGISTER, values=values[: command.length])


@answers(m.FramePostprocessingSet)
def _set_postprocessing(module: Module, command: m.FramePostprocessingSet) -> m.Response:
    module.postprocessing[command.setting] = command.value
    return m.Ack()


_POSTPROCESSING_DEFAULTS: dict[int, m.PostprocessingValue] = {
    FramePostprocessing.NORMALIZATION: 1,
    FramePostprocessing.PHASE_NOISE_CORRECTION: (0, 0.0),
    FramePostprocessing.DECIMATION_FACTOR: 1,
    FramePostprocessing.NUMBER_FORMAT: 0,
    FramePostprocessing.LEGACY_OUTPUT: 0,
}
"""Assumed: what leaves frames as chapter 6 describes them."""


@answers(m.FramePostprocessingGet)
def _get_postprocessing(module: Module, command: m.FramePostprocessingGet) -> m.Response:
    setting = command.setting
    value = module.postprocessing.get(setting, _POSTPROCESSING_DEFAULTS[setting])
    if isinstance(value, tuple):
        return m.ReplyFloat(content_id=setting, values=(value[1],))
    if setting is FramePostprocessing.DECIMATION_FACTOR:
        return m.ReplyInt(content_id=setting, values=(value - (1 << 32) if value >> 31 else value,))
    return m.ReplyByte(content_id=setting, values=bytes([value]))

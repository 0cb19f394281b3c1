"""Handlers of ping, reset, bootloader, modes, profiles and trace output.

Source: protocol reference 4.1 to 4.3, 4.5 and 4.12.
"""

from __future__ import annotations

from emulator.handler_table import answers
from emulator.modes import State
from emulator.module import Module
from emulator.refusal import Refusal
from xethru_protocol import messages as m
from xethru_protocol.codes import BootloaderKey, ErrorCode, PongCode, SensorMode, TraceLevel

HIGHEST_TRACE_LEVEL = 9


@answers(m.Ping)
def _ping(module: Module, command: m.Ping) -> m.Response:
    safe = module.state is State.SAFE
    return m.Pong(value=PongCode.XTS_SPRP_SAFEMODE if safe else PongCode.XTS_SPRP_READY)


@answers(m.ModReset)
def _reset(module: Module, command: m.ModReset) -> m.Response:
    module.request_restart()
    return m.Ack()


@answers(m.StartBootloader)
def _start_bootloader(module: Module, command: m.StartBootloader) -> m.Response:
    if command.key != BootloaderKey.CURRENT:
        module.notices.append(m.DataString(text="Wrong bootloader key."))
        raise Refusal(ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
    module.request_restart(into_bootloader=True)
    return m.Ack()


@answers(m.SetMode)
def _set_mode(module: Module, command: m.SetMode) -> m.Response:
    options, modes = module.options, module.modes
    if options.profile_switch == "restart" and modes.switches_profile(command.mode):
        modes.restart_with_profile()
        module.save()
        module.request_restart()
        raise Refusal(ErrorCode.XTS_SPRE_RESTARTING)
    before = module.state
    module.set_mode(command.mode)
    entered = module.state is not before
    if entered and module.state is State.MANUAL and options.manual_settings == "init":
        module.chip.init()
    module.trace(TraceLevel.INFO, f"Mode {SensorMode(command.mode).label}.")
    return m.Ack()


@answers(m.GetMode)
def _get_mode(module: Module, command: m.GetMode) -> m.Response:
    return m.ReplyByte(values=bytes([module.modes.mode]))


@answers(m.LoadApp)
def _load_app(module: Module, command: m.LoadApp) -> m.Response:
    module.load_profile(command.profile_id)
    module.trace(TraceLevel.INFO, f"Profile {command.profile_id:08X} loaded.")
    return m.Ack()


@answers(m.GetProfileId)
def _get_profile_id(module: Module, command: m.GetProfileId) -> m.Response:
    profile_id = module.modes.profile_id
    return m.ReplyInt(values=(profile_id - (1 << 32) if profile_id >> 31 else profile_id,))


@answers(m.DebugLevel)
def _debug_level(module: Module, command: m.DebugLevel) -> m.Response:
    if command.level > HIGHEST_TRACE_LEVEL:
        raise Refusal(module.options.bad_value_error)
    module.trace_level = command.level
    return m.Ack()


@answers(m.BootloaderGetDeviceInfo, m.BootloaderWritePage)
def _bootloader(module: Module, command: m.Message) -> m.Response:
    # Assumed: written pages are taken and forgotten; the firmware of an emulator is its program.
    return _status(module)


@answers(m.BootloaderStartApp)
def _start_app(module: Module, command: m.BootloaderStartApp) -> m.Response:
    module.request_restart()
    return _status(module)


def _status(module: Module) -> m.Response:
    status = module.options.bootloader_status
    return m.UnknownMessage(code=status, payload=bytes([status]))

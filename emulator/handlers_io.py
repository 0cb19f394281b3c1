"""Handlers of the IO pins.

Source: protocol reference 4.8.
"""

from __future__ import annotations

from emulator.handler_table import answers
from emulator.module import Module
from xethru_protocol import messages as m
from xethru_protocol.codes import IoPinCode


@answers(m.IoPinSetControl)
def _set_control(module: Module, command: m.IoPinSetControl) -> m.Response:
    module.pins.set_control(command.pin_id, command.pin_setup, command.pin_feature)
    return m.Ack()


@answers(m.IoPinGetControl)
def _get_control(module: Module, command: m.IoPinGetControl) -> m.Response:
    control = module.pins.control(command.pin_id)
    values = (control.setup, control.feature)
    return m.ReplyInt(content_id=IoPinCode.XTS_SPCIOP_GETCONTROL, values=values)


@answers(m.IoPinSetValue)
def _set_value(module: Module, command: m.IoPinSetValue) -> m.Response:
    module.pins.set_value(command.pin_id, command.pin_value)
    return m.Ack()


@answers(m.IoPinGetValue)
def _get_value(module: Module, command: m.IoPinGetValue) -> m.Response:
    level = module.pins.value(command.pin_id)
    return m.ReplyInt(content_id=IoPinCode.XTS_SPCIOP_GETVALUE, values=(level,))

"""What a module answers to each command: permission first, then the command's handler.

To add a command, write a function ``(module, command) -> response`` under ``@answers(Command)`` in
the ``handlers_*`` module of its section, and name its group in `permissions`. Commands without a
handler get ERROR 1, as the firmware does.

Source: protocol reference 3, 4 and 5.
"""

from __future__ import annotations

# Each of these enters its handlers into the table.
from emulator import (
    handlers_basic,  # noqa: F401
    handlers_files,  # noqa: F401
    handlers_io,  # noqa: F401
    handlers_profile,  # noqa: F401
    handlers_system,  # noqa: F401
    handlers_x4,  # noqa: F401
)
from emulator.handler_table import HANDLERS, answers
from emulator.module import Module
from emulator.permissions import check_permission
from emulator.refusal import Refusal, Silence
from xethru_protocol import messages as m
from xethru_protocol.codes import ErrorCode

__all__ = ["HANDLERS", "Module", "answer", "answers"]


def answer(module: Module, command: m.Message) -> m.Response | None:
    """Carry out one command and return its reply, None if it gets none.

    Never raises on anything a host can send.
    """
    try:
        check_permission(command, module.state, module.options)
        handler = HANDLERS.get(type(command))
        if handler is None:
            return m.Error(code=ErrorCode.XTS_SPRE_NOT_RECOGNIZED)
        return handler(module, command)
    except Refusal as refusal:
        return m.Error(code=refusal.code)
    except Silence:
        return None

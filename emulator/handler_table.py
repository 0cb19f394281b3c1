"""The table of handlers: which function answers which command.

A handler is ``(module, command) -> response``; it raises `Refusal` for an ERROR and `Silence` for
no answer at all.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from emulator.module import Module
from xethru_protocol import messages as m

__all__ = ["HANDLERS", "Handler", "answers"]

Handler = Callable[[Module, Any], m.Response]
HANDLERS: dict[type[m.Message], Handler] = {}
HandlerT = TypeVar("HandlerT", bound=Handler)


def answers(*commands: type[m.Command[Any]]) -> Callable[[HandlerT], HandlerT]:
    """Enter a handler into the table."""

    def enter(handler: HandlerT) -> HandlerT:
        HANDLERS.update(dict.fromkeys(commands, handler))
        return handler

    return enter

"""Procedures as methods: of a driver that blocks, and of one whose methods are awaited."""

import functools
import inspect
from collections.abc import Callable, Coroutine
from typing import Any, Concatenate, ParamSpec, TypeVar, get_args

from xethru_protocol.core import RadarCore
from xethru_protocol.reconnection import resilient
from xethru_protocol.steps import Procedure

P = ParamSpec("P")
T = TypeVar("T")
_Written = Callable[Concatenate[RadarCore, P], Procedure[T]]
_MethodT = TypeVar("_MethodT", bound=Callable[..., Any])


def _documented_as(procedure: Callable[..., Procedure[Any]]) -> Callable[[_MethodT], _MethodT]:
    """Give a method the name and text of its procedure, and the signature that its user sees."""

    def document(method: _MethodT) -> _MethodT:
        functools.update_wrapper(method, procedure)
        signature = inspect.signature(procedure)
        core, *parameters = signature.parameters.values()
        whole = signature.replace(
            parameters=[core.replace(name="self", annotation=core.empty), *parameters],
            return_annotation=get_args(signature.return_annotation)[2],  # of Generator
        )
        method.__signature__ = whole  # type: ignore[attr-defined]  # as inspect looks for it
        return method

    return document


def blocking(procedure: _Written[P, T]) -> Callable[Concatenate[Any, P], T]:
    """Make a method that returns the procedure's result; repeated after a reconnect, if on."""

    @_documented_as(procedure)
    def method(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> T:  # noqa: ANN401 - any part of a driver
        core: RadarCore = self._core
        if core.reconnect_s > 0:
            whole = resilient(core, lambda: procedure(core, *args, **kwargs))
        else:
            whole = procedure(core, *args, **kwargs)
        result: T = self._run(whole)
        return result

    return method


def blocking_once(procedure: _Written[P, T]) -> Callable[Concatenate[Any, P], T]:
    """Do the same, but never repeat: a broken line is the caller's business."""

    @_documented_as(procedure)
    def method(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> T:  # noqa: ANN401 - as above
        result: T = self._run(procedure(self._core, *args, **kwargs))
        return result

    return method


def awaited(procedure: _Written[P, T]) -> Callable[Concatenate[Any, P], Coroutine[Any, Any, T]]:
    """Make a coroutine method; repeated after a reconnect, if that is on."""

    @_documented_as(procedure)
    async def method(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> T:  # noqa: ANN401 - as above
        core: RadarCore = self._core
        result: T = await self._run(resilient(core, lambda: procedure(core, *args, **kwargs)))
        return result

    return method


def awaited_once(
    procedure: _Written[P, T],
) -> Callable[Concatenate[Any, P], Coroutine[Any, Any, T]]:
    """Do the same, but never repeat."""

    @_documented_as(procedure)
    async def method(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> T:  # noqa: ANN401 - as above
        result: T = await self._run(procedure(self._core, *args, **kwargs))
        return result

    return method

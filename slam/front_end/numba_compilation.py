"""Functions of numbers and arrays that are compiled by numba when they are first called.

The same input gives the same bits: no fast mathematics, no threads, nothing reordered. What is
compiled is kept beside the source, or, where that cannot be written, in the user's cache folder
(``NUMBA_CACHE_DIR`` names another). If neither can be written, each process compiles again.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial, update_wrapper
from types import FunctionType
from typing import Any, TypeVar

_Function = TypeVar("_Function", bound=Callable[..., Any])

_KERNELS: list[_Kernel] = []


class _Kernel:
    """A function that is compiled once, for one signature."""

    def __init__(self, function: FunctionType, signature: str, *, has_long_loops: bool) -> None:
        self._function = function
        self._signature = signature
        self._has_long_loops = has_long_loops
        self.compiled = cache(self._compiled)
        update_wrapper(self, function)
        _KERNELS.append(self)

    def __call__(self, *args: object) -> object:
        return self.compiled()(*args)

    def _compiled(self) -> Callable[..., Any]:
        import numba  # takes half a second, and not every process calls a kernel

        function = self._function
        known = dict(function.__globals__)
        for name in function.__code__.co_names:  # what it calls must be compiled, too
            if isinstance(called := known.get(name), _Kernel):
                known[name] = called.compiled()
        bound = FunctionType(function.__code__, known, function.__name__)
        bound.__module__, bound.__qualname__ = function.__module__, function.__qualname__
        # Where loops are short, their vectorised variants would take a third of the compilation.
        vectorise = numba.config.LOOP_VECTORIZE
        numba.config.LOOP_VECTORIZE = vectorise if self._has_long_loops else 0
        compile_with = partial(numba.njit, error_model="numpy", nogil=True)
        try:
            kept = compile_with(cache=True)(bound)
        except RuntimeError:  # no folder can be written
            kept = compile_with()(bound)
        try:
            kept.compile(self._signature)
        finally:
            numba.config.LOOP_VECTORIZE = vectorise
        kept.disable_compile()
        compiled: Callable[..., Any] = kept
        return compiled


def kernel(signature: str, *, has_long_loops: bool = False) -> Callable[[_Function], _Function]:
    """Return a decorator that compiles a function for a signature when it is first called.

    Only ``has_long_loops`` makes vectorised loops, which give the same bits.

    A kernel may call kernels and read constants of its own module only: what is kept on disk is
    renewed when that file changes. Arrays are C-contiguous.
    """

    def decorate(function: _Function) -> _Function:
        assert isinstance(function, FunctionType)
        kept = _Kernel(function, signature, has_long_loops=has_long_loops)
        return kept  # type: ignore[return-value]  # the same function, faster

    return decorate


def compile_kernels(before_each: Callable[[], object] = lambda: None) -> None:
    """Compile or load every kernel of the modules imported so far: seconds the first time."""
    for each in _KERNELS:
        before_each()
        each.compiled()

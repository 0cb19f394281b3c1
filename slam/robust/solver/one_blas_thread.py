"""BLAS with one thread, which gives the same bits on every machine."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from threading import Lock

from threadpoolctl import ThreadpoolController

_lock = Lock()
_n_users = 0
_restore: Callable[[], None] | None = None


@cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()  # looks through all that is loaded


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let BLAS have one thread until the last of all threads that are in here has left.

    Its limit is one of the process, so what each thread restores by itself would be wrong.
    """
    global _n_users, _restore
    with _lock:
        _n_users += 1
        if _restore is None:
            _restore = _libraries().limit(limits=1).restore_original_limits
    try:
        yield
    finally:
        with _lock:
            _n_users -= 1
            if not _n_users and _restore is not None:
                _restore()
                _restore = None

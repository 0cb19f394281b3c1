"""A full disk in tests: a limit on the size of files, which needs no rights.

Python does not notice that such a limit cuts a file of bytecode, and cannot load that file later.
Under the limit no bytecode is written.
"""

import os
import resource
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

NO_BYTECODE = "PYTHONDONTWRITEBYTECODE"  # `python -B`, also for the processes that a child starts


def child_on_full_disk(n_bytes: int) -> dict[str, Any]:
    """Return arguments of `subprocess.run`: no file of the child grows beyond ``n_bytes``."""
    limits = (n_bytes, n_bytes)
    return {
        "preexec_fn": lambda: resource.setrlimit(resource.RLIMIT_FSIZE, limits),
        "env": {**os.environ, NO_BYTECODE: "1"},
    }


@contextmanager
def full_disk(n_bytes: int) -> Iterator[None]:
    """Let no file of this process and its children grow beyond ``n_bytes`` meanwhile."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "dont_write_bytecode", True)
        patch.setenv(NO_BYTECODE, "1")
        resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

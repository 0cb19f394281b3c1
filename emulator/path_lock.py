"""A lock on a file or folder that leaves nothing behind and that a killed owner loses."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["PathInUseError", "locked"]


class PathInUseError(Exception):
    """Somebody else who still runs holds the path."""


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold an existing file or folder while the block runs.

    Only those who ask here keep each other out. A file system without locks keeps nobody out.

    Raises
    ------
    PathInUseError
        Another holds it.
    OSError
        It cannot be opened.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise PathInUseError(f"{path}: in use") from None
        except OSError:
            pass  # no locks here
        yield
    finally:
        os.close(descriptor)

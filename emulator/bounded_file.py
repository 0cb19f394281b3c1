"""Hand-written files are short; what never ends, like /dev/zero, is refused and not read."""

from __future__ import annotations

import errno
from pathlib import Path

MOST_BYTES = 1 << 20


def read_bounded(path: Path, most_bytes: int = MOST_BYTES) -> bytes:
    """Return all of a file, which may be a pipe.

    Raises
    ------
    OSError
        It cannot be read, or has more bytes than that.
    """
    with path.open("rb") as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise OSError(errno.EFBIG, f"longer than {most_bytes >> 20} MiB")
    return content

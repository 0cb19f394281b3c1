"""Rerun's files seen from outside: which version wrote one, and whether ours can open it."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

from slam.app.errors import AppError

_MAGIC = b"RRF"
_END = b"FOOT"
"""Ends a finished file, with four bytes behind it."""
_OLDEST = (0, 23)
"""Of files that later versions open."""


def require_readable(path: Path) -> None:
    """See that the installed Rerun opens a recording.

    Raises
    ------
    AppError
        It is no recording, one of a version that is too new or too old, or one that was never
        closed; names the remedy.
    """
    try:
        with path.open("rb") as stream:
            head = stream.read(8)
    except OSError as error:
        raise AppError(f"{path}: cannot be read: {error.strerror or error}") from None
    if len(head) < 8 or not head.startswith(_MAGIC):
        raise AppError(f"{path}: is no Rerun recording")
    written = (head[4], head[5])
    major, minor, *_ = version("rerun-sdk").split(".")
    ours = (int(major), int(minor))
    if not _OLDEST <= written <= ours:
        kind = "newer" if written > ours else "older"
        raise AppError(
            f"{path}: written by Rerun {written[0]}.{written[1]}, {kind} than the {major}.{minor} "
            "here can open; make it again from its session: "
            f"uwb-slam view session.mcap --out {path.name}"
        )
    if not is_finished(path):  # the viewer refuses it in many words, and only in its window
        raise AppError(
            f"{path}: was never closed, its program was killed; make it again from its session: "
            f"uwb-slam view session.mcap --out {path.name}; or: rerun rrd merge {path.name} -o NEW"
        )


def is_finished(path: Path) -> bool:
    """Return whether a recording was closed; of a killed program's the last rows are missing."""
    with path.open("rb") as stream:
        stream.seek(max(path.stat().st_size - len(_END) - 4, 0))
        return stream.read().startswith(_END)

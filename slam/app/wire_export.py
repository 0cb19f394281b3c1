"""The raw bytes of one port out of a session, as a wire capture that `xethru` and emulator play."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from slam.app.errors import AppError
from slam.app.session_reader import RecordedSession
from xethru_protocol.recordings import RecordingError, WireCapture


def write_wire(
    session: RecordedSession, out: Path, radar: str | None, check: Callable[[], None]
) -> str:
    """Write the bytes of a radar's port, both ways; return in words what was written.

    Their times are those of the host's own clock, whose zero means nothing.

    Raises
    ------
    AppError
        The session has no such radar, or several and none is named, or no raw bytes; the file
        exists or cannot be written.
    """
    known = [info.name for info in session.info.radars]
    names = ", ".join(known)
    if radar is None and len(known) != 1:
        raise AppError(f"{session.path}: holds several radars ({names}); choose one: --radar NAME")
    chosen = known[0] if radar is None else radar
    if chosen not in known:
        raise AppError(f"{session.path}: holds no radar {chosen!r}; it holds {names}")
    sizes = {"rx": 0, "tx": 0}
    try:
        with WireCapture(out, {"radar": chosen, "clock": "monotonic"}) as capture:
            for row in session.wire():
                check()
                if row.radar == chosen:
                    capture.write(row.way, row.data, row.host_ns)
                    sizes[row.way] += len(row.data)
    except RecordingError as error:
        raise AppError(str(error)) from None
    if not any(sizes.values()):
        out.unlink()
        raise AppError(f"{session.path}: holds no raw bytes; record with --wire")
    return f"{out}: {sizes['rx']} bytes from the module, {sizes['tx']} to it"

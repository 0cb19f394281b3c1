"""What `view` and `report` share: the file that a path means, and all of it for sinks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from slam.app.errors import AppError, UsageError
from slam.app.records import SessionObserver, Snapshot
from slam.app.run.output import Progress, note
from slam.app.run.recorded import play_states
from slam.app.run.replay import recorded_source
from slam.app.run.runner import LostFrames, RunRecord, execute
from slam.app.session.reader import RecordedSession
from xethru_protocol.recordings.mcap import MAGIC
from xethru_protocol.system import StopFlag

SESSION_NAME, VIEW_NAME = "session.mcap", "session.rrd"
_END = b"FOOT"
"""Ends a finished file, with four bytes behind it."""


def session_file(given: Path, *, allow_view: bool = False) -> Path:
    """Return a file as it is, or the session of a run's folder.

    `allow_view` prefers the .rrd of a folder, which is drawn already, if it was closed.
    """
    if not given.is_dir():
        if not given.exists():
            raise AppError(f"{given}: no such file")
        return given
    session, view = given / SESSION_NAME, given / VIEW_NAME
    if allow_view and view.is_file() and (is_finished(view) or not session.is_file()):
        return view
    if session.is_file():
        return session
    names = f"{VIEW_NAME} nor {SESSION_NAME}" if allow_view else SESSION_NAME
    raise AppError(f"{given}: holds no {names}; name a session.mcap")


def refuse_overwriting(recorded: Path, out: Path | None) -> None:
    """Raise UsageError if a result would replace its own session or another recording."""
    if out is None or not out.is_file():
        return
    if out.samefile(recorded):
        raise UsageError(f"{out}: is the session itself; write to another file")
    with out.open("rb") as stream:
        is_recording = stream.read(len(MAGIC)) == MAGIC
    if is_recording:
        raise UsageError(f"{out}: is a recording, which cannot be repeated; write to another file")


def play(session: RecordedSession, sinks: Sequence[SessionObserver], stop: StopFlag) -> RunRecord:
    """Give what was recorded to sinks, with a progress line.

    A session without a state, such as an imported one, goes through SLAM first.

    Raises
    ------
    AppError
        The file is damaged other than by being cut, or has no state and cannot be replayed.
    """
    lost = LostFrames()
    progress = Progress(session.info, lambda: lost.n_lost, end_ns=session.end_ns)
    if _has_state(session, stop):
        record = play_states(session, [lost, progress, *sinks], stop)
    else:
        note(f"{session.path} holds no state of SLAM, so SLAM runs over its frames")
        record = execute(recorded_source(session, stop), [lost, progress, *sinks])
    if session.cut_at_byte is not None:
        note(f"{session.path} was cut at byte {session.cut_at_byte}; this is what is left of it")
    return record


def _has_state(session: RecordedSession, stop: StopFlag) -> bool:
    for record in session.records():
        stop.check()
        if isinstance(record, Snapshot):
            return True
    return False


def is_finished(path: Path) -> bool:
    """Return whether a recording was closed; that of a killed program lacks its last rows."""
    with path.open("rb") as stream:
        stream.seek(max(path.stat().st_size - len(_END) - 4, 0))
        return stream.read().startswith(_END)

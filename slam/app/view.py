"""`uwb-slam view`: a recorded session in Rerun, in a window, a browser, a file or a picture.

A session is replayed into the view, so it shows what the run itself would have shown, whatever
version of Rerun the run had. An .rrd is opened as it is.
"""

from __future__ import annotations

import sys
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from slam.app.errors import AppError, UsageError, naming
from slam.app.live_view import LiveView
from slam.app.mcap_records import MAGIC
from slam.app.progress import Progress
from slam.app.replay import LostFrames, replay_session, settings_of
from slam.app.rrd_file import is_finished, require_readable
from slam.app.session import SessionObserver
from slam.app.session_reader import RecordedSession, open_session
from slam.app.stop import StopFlag
from slam.app.view_targets import SERVE_WEB, SPAWN

SESSION_NAME, VIEW_NAME = "session.mcap", "session.rrd"


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewOptions:
    """What the command line of `uwb-slam view` says; at most one of the ways to show is given."""

    session: Path
    web: bool = False
    out: Path | None = None
    screenshot: Path | None = None
    at_s: float | None = None


def run_view(options: ViewOptions, stop: StopFlag) -> None:
    """Show a session.

    Raises
    ------
    AppError
        The session cannot be read, or there is nothing to show it with; one line with the remedy.
    StopRequestedError
        A signal arrived; also the way to end serving a browser.
    """
    if options.at_s is not None and options.screenshot is None:
        raise UsageError("--at: says when a --screenshot is taken; name its file, too")
    path = session_file(options.session, allow_view=options.out is None)
    for written in (options.out, options.screenshot):
        refuse_overwriting(path, written)
    if path.suffix == ".rrd":
        if options.out is not None:
            raise UsageError(f"{path}: is an .rrd already; --out makes one of a session.mcap")
        require_readable(path)
        _show_file(path, options, stop)
        return
    session = open_session(path)
    if options.out is not None:
        write_view(session, options.out, stop)
        sys.stdout.write(f"{options.out}\n")
    elif options.screenshot is not None:
        with tempfile.TemporaryDirectory(prefix="uwb-slam-view-") as folder:
            made = Path(folder) / VIEW_NAME
            write_view(session, made, stop)
            _take_picture(made, options.screenshot, options, stop)
    else:
        _show_replay(session, options, stop)


def session_file(given: Path, *, allow_view: bool = False) -> Path:
    """Return the file that a user means by a file or by the folder of a run.

    `allow_view` prefers the .rrd of a folder, which needs no replay, if its run lived to close it.

    Raises
    ------
    AppError
        There is none.
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
    """See that a result does not take the place of what it is made of, or of another recording.

    Raises
    ------
    UsageError
        It would.
    """
    if out is None or not out.is_file():
        return
    if out.samefile(recorded):
        raise UsageError(f"{out}: is the session itself; write to another file")
    with out.open("rb") as stream:
        is_recording = stream.read(len(MAGIC)) == MAGIC
    if is_recording:
        raise UsageError(f"{out}: is a recording, which cannot be repeated; write to another file")


def write_view(session: RecordedSession, path: Path, stop: StopFlag) -> None:
    """Replay a session into an .rrd file.

    Raises
    ------
    AppError
        It cannot be replayed, or the file not be written.
    """
    from slam.app.rerun_view import RerunView  # half a second, only where it is needed

    settings_of(session)  # before a file that is there already is given up for this one
    with naming(path):
        path.open("wb").close()  # Rerun's own words on this would not name the remedy
    with ExitStack() as stack:
        view = RerunView(path, session.info)
        stack.callback(view.close)
        _replay(session, view, stop, stack)


def _show_replay(session: RecordedSession, options: ViewOptions, stop: StopFlag) -> None:
    with LiveView(SERVE_WEB if options.web else SPAWN, stop.check, is_replay=True) as live:
        with ExitStack() as stack:
            view = live.observer(session.info)
            stack.callback(view.close)
            _replay(session, view, stop, stack)
        live.keep_serving()


def _replay(
    session: RecordedSession, view: SessionObserver, stop: StopFlag, stack: ExitStack
) -> None:
    losses = LostFrames(session.info.radars)
    progress = Progress(session.info, None, lambda: losses.count)
    stack.callback(progress.close)
    replay_session(session, [view, losses, progress], stop.check)
    if session.cut_at_byte is not None:
        stack.callback(_say_cut, session)


def _say_cut(session: RecordedSession) -> None:
    sys.stderr.write(
        f"uwb-slam: {session.path} was cut at byte {session.cut_at_byte}; "
        "the view shows what is left of it\n"
    )


def _show_file(path: Path, options: ViewOptions, stop: StopFlag) -> None:
    if options.screenshot is not None:
        _take_picture(path, options.screenshot, options, stop)
        return
    with LiveView(SERVE_WEB if options.web else SPAWN, stop.check, path) as live:
        live.keep_serving()


def _take_picture(rrd: Path, out: Path, options: ViewOptions, stop: StopFlag) -> None:
    from slam.app.rerun_screenshot import take_screenshot  # half a second, as above

    take_screenshot(rrd, out, at_s=options.at_s, check=stop.check)
    sys.stdout.write(f"{out}\n")

"""`uwb-slam view`: a recorded session in Rerun, in a window, a browser, a file or a picture.

What a session recorded is shown as the run itself would have shown it, whatever version of Rerun
the run had; SLAM does not run again. An .rrd is opened as it is. Rerun's API to control a viewer is
experimental: it is used in this file only.
"""

from __future__ import annotations

import io
import tempfile
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from PIL import Image

from slam.app.errors import AppError, UsageError, naming
from slam.app.records import SessionObserver, Snapshot
from slam.app.run.output import Progress, note, print_text
from slam.app.run.recorded import play_states
from slam.app.run.replay import recorded_source
from slam.app.run.runner import LostFrames, RunRecord, execute
from slam.app.session.reader import RecordedSession, open_session
from slam.app.view import SERVE_WEB, SPAWN
from slam.app.view.rerun_recording import DEVICE_TIME, ViewerClient
from slam.app.view.viewer import LiveView, ViewerKind, ViewerProcess
from xethru_protocol.recordings.mcap import MAGIC
from xethru_protocol.system import StopFlag, one_line, written_whole

_MAGIC = b"RRF"
_END = b"FOOT"
"""Ends a finished file, with four bytes behind it."""
_OLDEST = (0, 23)
"""Of files that later versions open."""


def _require_readable(path: Path) -> None:
    """Require that the installed Rerun opens a recording, else raise AppError."""
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
    if not is_finished(path):  # the viewer would report it in its window only
        raise AppError(
            f"{path}: was never closed, its program was killed; make it again from its session: "
            f"uwb-slam view session.mcap --out {path.name}; or: rerun rrd merge {path.name} -o NEW"
        )


def is_finished(path: Path) -> bool:
    """Return whether a recording was closed; that of a killed program lacks its last rows."""
    with path.open("rb") as stream:
        stream.seek(max(path.stat().st_size - len(_END) - 4, 0))
        return stream.read().startswith(_END)


_SETTLE_LIMIT_S = 30.0
_PERIOD_S = 0.5
_ENDING_S = 2.0
"""A viewer without a graphics driver drops its connections before it has ended."""
_PALETTE = 256
_MENU_PIXELS = 36
"""The viewer's own bar on top, which names the machine that drew it."""


def _take_screenshot(rrd: Path, out: Path, at_s: float | None, stop: StopFlag) -> None:
    """Open a recording in a viewer that draws in memory, and write what it shows as PNG.

    `at_s` is where the cursor of `device_time` stands; None for the end.

    Raises
    ------
    AppError
        There is no graphics driver, the recording is no view of a session, the viewer does not
        come to rest, or the picture cannot be written.
    """
    with ViewerProcess(ViewerKind.HEADLESS) as process:
        process.wait_until_ready(stop)
        try:
            picture = _settled(process, rrd, at_s, stop)
        except (ConnectionError, RuntimeError, TimeoutError) as error:
            process.require_alive(_ENDING_S)  # or its end is the reason
            reason = (str(error).strip() or type(error).__name__).splitlines()[0]
            raise AppError(f"{rrd}: the viewer gave no picture: {reason}") from None
    with Image.open(io.BytesIO(picture)) as full:
        shown = full.convert("RGB").crop((0, _MENU_PIXELS, full.width, full.height))
        # An octree keeps colours that few points have, like landmarks; a median cut does not.
        few = shown.quantize(_PALETTE, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    with naming(out), written_whole(out) as fresh:
        few.save(fresh, format="png", optimize=True)
    print_text(one_line(str(out)))


def _settled(process: ViewerProcess, rrd: Path, at_s: float | None, stop: StopFlag) -> bytes:
    """Return the picture once two in a row are the same: all data are loaded and drawn."""
    client = ViewerClient.connect(process.url)
    client.open(str(rrd.resolve()))
    give_up = time.monotonic() + _SETTLE_LIMIT_S
    while client.get_state().loading or not client.get_state().recordings:
        _wait(stop, give_up)
    lines = {line.name: line for line in client.get_state().recordings[0].timelines}
    if DEVICE_TIME not in lines:
        raise AppError(f"{rrd}: has no timeline {DEVICE_TIME}, so it is no view of a session")
    end_s = (lines[DEVICE_TIME].end or 0) / 1e9
    client.set_time(
        DEVICE_TIME, duration=end_s if at_s is None else min(at_s, end_s), play_state="paused"
    )
    before = b""
    while (picture := client.take_screenshot()) != before:
        before = picture
        _wait(stop, give_up)
    return picture


def _wait(stop: StopFlag, give_up: float) -> None:
    stop.check()
    if time.monotonic() > give_up:
        raise TimeoutError(f"it was still busy after {_SETTLE_LIMIT_S:g} s")
    time.sleep(_PERIOD_S)


_SESSION_NAME, _VIEW_NAME = "session.mcap", "session.rrd"


def run_view(
    stop: StopFlag,
    *,
    session: Path,
    web: bool,
    out: Path | None,
    screenshot: Path | None,
    at_s: float | None,
) -> None:
    """Show a session; at most one of `web`, `out` and `screenshot` is given."""
    if at_s is not None and screenshot is None:
        raise UsageError("--at: says when a --screenshot is taken; name its file, too")
    path = session_file(session, allow_view=out is None)
    for written in (out, screenshot):
        refuse_overwriting(path, written)
    where = SERVE_WEB if web else SPAWN
    if path.suffix == ".rrd":
        if out is not None:
            raise UsageError(f"{path}: is an .rrd already; --out makes one of a session.mcap")
        _require_readable(path)
        if screenshot is not None:
            _take_screenshot(path, screenshot, at_s, stop)
            return
        with LiveView(where, stop, path) as live:
            live.keep_serving()
        return
    recorded = open_session(path, stop)
    if out is not None:
        _write_view(recorded, out, stop)
        print_text(one_line(str(out)))
    elif screenshot is not None:
        with tempfile.TemporaryDirectory(prefix="uwb-slam-view-") as folder:
            made = Path(folder) / _VIEW_NAME
            _write_view(recorded, made, stop)
            _take_screenshot(made, screenshot, at_s, stop)
    else:
        with LiveView(where, stop, is_replay=True) as live:
            play(recorded, [live.observer(recorded.info)], stop)
            live.keep_serving()


def session_file(given: Path, *, allow_view: bool = False) -> Path:
    """Return a file as it is, or the session of a run's folder.

    `allow_view` prefers the .rrd of a folder, which is drawn already, if it was closed.
    """
    if not given.is_dir():
        if not given.exists():
            raise AppError(f"{given}: no such file")
        return given
    session, view = given / _SESSION_NAME, given / _VIEW_NAME
    if allow_view and view.is_file() and (is_finished(view) or not session.is_file()):
        return view
    if session.is_file():
        return session
    names = f"{_VIEW_NAME} nor {_SESSION_NAME}" if allow_view else _SESSION_NAME
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


def _write_view(session: RecordedSession, path: Path, stop: StopFlag) -> None:
    """Write a session as an .rrd file, which replaces an earlier one when it is whole."""
    from slam.app.view.panels import RerunView  # half a second, loaded only if needed

    with naming(path), written_whole(path) as fresh:
        fresh.open("wb").close()  # Rerun's own message would not name the remedy
        play(session, [RerunView(fresh, session.info, called=str(path))], stop)


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

"""`uwb-slam view`: a recorded session in Rerun, in a window, a browser, a file or a picture.

What a session recorded is shown as the run itself would have shown it, whatever version of Rerun
the run had; SLAM does not run again. An .rrd is opened as it is. Rerun's API to control a viewer is
experimental: it is used in this file only.
"""

from __future__ import annotations

import io
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

from PIL import Image

from slam.app.errors import UsageError, naming
from slam.app.run.output import print_text
from slam.app.run.replay import (
    is_finished,
    play,
    refuse_overwriting,
    session_file,
)
from slam.app.run.result_files import VIEW
from slam.app.view import SERVE_WEB, SPAWN
from slam.app.view.rerun_recording import DEVICE_TIME, ViewerClient
from slam.app.view.viewer import LiveView, SlamViewerProcess
from slam.live.errors import AppError, refuse_pipe
from slam.live.session.reader import RecordedSession, open_session
from xethru_protocol.cli.live.viewer import ViewerKind
from xethru_protocol.operating_system import StopFlag, one_line, written_whole
from xethru_protocol.recordings.recorded_messages import RERUN_MAGIC

_OLDEST = (0, 23)
"""Of files that later versions open."""


def _require_readable(path: Path) -> None:
    """Require that the installed Rerun opens a recording, else raise AppError."""
    try:
        with path.open("rb") as stream:
            head = stream.read(8)
    except OSError as error:
        raise AppError(f"{path}: cannot be read: {error.strerror or error}") from None
    if len(head) < 8 or not head.startswith(RERUN_MAGIC):
        raise AppError(f"{path}: is not a Rerun recording")
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
        No graphics driver is found, the recording is not a view of a session, the viewer does not
        come to rest, or the picture cannot be written.
    """
    with SlamViewerProcess(ViewerKind.HEADLESS) as process:
        process.wait_until_ready(stop.check)
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


def _settled(process: SlamViewerProcess, rrd: Path, at_s: float | None, stop: StopFlag) -> bytes:
    """Return the picture once two in a row are the same: all data are loaded and drawn."""
    client = ViewerClient.connect(process.url)
    client.open(str(rrd.resolve()))
    give_up = time.monotonic() + _SETTLE_LIMIT_S
    while client.get_state().loading or not client.get_state().recordings:
        _wait(stop, give_up)
    lines = {line.name: line for line in client.get_state().recordings[0].timelines}
    if DEVICE_TIME not in lines:
        raise AppError(f"{rrd}: has no timeline {DEVICE_TIME}, so it is not a view of a session")
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
    for opened in (path, out):  # by Rerun, which seeks
        if opened is not None:
            refuse_pipe(opened)
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
            made = Path(folder) / VIEW
            _write_view(recorded, made, stop)
            _take_screenshot(made, screenshot, at_s, stop)
    else:
        with LiveView(where, stop, is_replay=True) as live:
            play(recorded, [live.observer(recorded.info)], stop)
            live.keep_serving()


def _write_view(session: RecordedSession, path: Path, stop: StopFlag) -> None:
    """Write a session as an .rrd file, which replaces an earlier one when it is whole."""
    from slam.app.view.session_view import RerunView  # half a second, loaded only if needed

    with naming(path), written_whole(path) as fresh:
        fresh.open("wb").close()  # Rerun's own message would not name the remedy
        play(session, [RerunView(fresh, session.info, called=str(path))], stop)

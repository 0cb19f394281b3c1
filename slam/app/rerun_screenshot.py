"""A picture of a view, taken without any window: the viewer draws in memory.

Rerun calls the way to steer a viewer experimental: it is used in this file only.
"""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from pathlib import Path

from PIL import Image

from slam.app.errors import AppError, naming
from slam.app.rerun_recording import DEVICE_TIME
from slam.app.rerun_sdk import ViewerClient
from slam.app.rerun_viewer import ViewerKind, ViewerProcess

_SETTLE_LIMIT_S = 30.0
_PERIOD_S = 0.5
_PALETTE = 256
_MENU_PIXELS = 36
"""The viewer's own bar on top, which says what machine drew it."""


def take_screenshot(rrd: Path, out: Path, *, at_s: float | None, check: Callable[[], None]) -> None:
    """Open a recording in a viewer that draws in memory, and write what it shows as PNG.

    Parameters
    ----------
    rrd
        The recording, with its blueprint.
    out
        The picture.
    at_s
        Where the cursor of `device_time` stands; None for the end.
    check
        Called again and again; may raise to stop.

    Raises
    ------
    AppError
        There is no graphics driver, the recording is no view of a session, the viewer does not
        come to rest, or the picture cannot be written.
    """
    with ViewerProcess(ViewerKind.HEADLESS) as process:
        process.wait_until_ready(check)
        try:
            picture = _settled(process, rrd, at_s, check)
        except (ConnectionError, RuntimeError, TimeoutError) as error:
            said = str(error).strip() or type(error).__name__
            raise AppError(f"{rrd}: the viewer gave no picture: {said.splitlines()[0]}") from None
    with Image.open(io.BytesIO(picture)) as full:
        shown = full.convert("RGB").crop((0, _MENU_PIXELS, full.width, full.height))
        # An octree keeps colours that few points have, like landmarks; a median cut does not.
        few = shown.quantize(_PALETTE, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    with naming(out):
        few.save(out, format="png", optimize=True)


def _settled(
    process: ViewerProcess, rrd: Path, at_s: float | None, check: Callable[[], None]
) -> bytes:
    """Return the picture once it shows the same twice: all data are there and drawn."""
    client = ViewerClient.connect(process.url)
    client.open(str(rrd.resolve()))
    give_up = time.monotonic() + _SETTLE_LIMIT_S
    while client.get_state().loading or not client.get_state().recordings:
        _wait(check, give_up)
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
        _wait(check, give_up)
    return picture


def _wait(check: Callable[[], None], give_up: float) -> None:
    check()
    if time.monotonic() > give_up:
        raise TimeoutError(f"it was still busy after {_SETTLE_LIMIT_S:g} s")
    time.sleep(_PERIOD_S)

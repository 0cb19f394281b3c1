"""A session in Rerun: what observers hear, drawn on a map, as echoes, numbers and links.

The recording is re-creatable from the session log and never the only copy: Rerun reads files of
adjacent versions only.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

from slam.app.rerun_blueprint import blueprint
from slam.app.rerun_frames import BLOCK_FRAMES, FrameLayer
from slam.app.rerun_link import LinkLayer
from slam.app.rerun_map import TRAIL_STATES, MapLayer
from slam.app.rerun_numbers import NumberLayer
from slam.app.rerun_recording import FileTarget, Recording, ViewerTarget
from slam.app.rerun_sdk import rr
from slam.app.session import LogLine, Scan, SessionInfo, SessionObserver, Snapshot
from slam.app.tum import NS_PER_S
from slam.app.view_echoes import beams_of
from slam.app.view_guide import about

_BLOCK_STATES = 128


class RerunView(SessionObserver):
    """Draws a session, into a file in large blocks, or live as it happens.

    Parameters
    ----------
    target
        A path for an .rrd file, or where a viewer listens.
    info
        What the run is.
    flush_s
        Live: longest time that a row waits before it is sent; None for full blocks only.
    clock_s
        Monotonic, for `flush_s`.
    time_of_day_ns
        Live: tells when a scan arrived that does not say so itself; None leaves it unknown.

    Raises
    ------
    AppError
        From `close`, when the finished file does not hold every row that was sent.
    """

    def __init__(
        self,
        target: Path | ViewerTarget,
        info: SessionInfo,
        *,
        flush_s: float | None = None,
        clock_s: Callable[[], float] = time.monotonic,
        time_of_day_ns: Callable[[], int] | None = None,
    ) -> None:
        self._clock_s, self._flush_s = clock_s, flush_s
        self._time_of_day_ns = time_of_day_ns
        self._flushed_s = clock_s()
        self._n_waiting = 0
        self._host_ns: int | None = None
        self._began = False
        seed = "" if info.seed is None else f"-{info.seed}"
        self._recording = Recording(
            FileTarget(path=target) if isinstance(target, Path) else target,
            blueprint(info),
            recording_id=f"{info.scene}-{info.preset}{seed}",
        )
        of_seed = "" if info.seed is None else f", seed {info.seed}"
        name = f"{info.scene}, preset {info.preset}{of_seed}"
        self._recording.name(name, info.started_unix_ns or 0)
        guide = rr.TextDocument(
            about(info, block=BLOCK_FRAMES, states=TRAIL_STATES), media_type=rr.MediaType.MARKDOWN
        )
        self._recording.static("about", guide)
        settings = json.dumps([asdict(radar) for radar in info.radars], indent=1)
        self._recording.static("radars", rr.TextDocument(settings))
        self._frames = FrameLayer(self._recording, info.radars)
        self._map = MapLayer(self._recording, info, beams_of(info.config_json))
        self._numbers = NumberLayer(self._recording)
        self._link = LinkLayer(self._recording, info.radars)

    def on_scan(self, scan: Scan) -> None:
        """Take the frames of one counter; a block of them goes out at once."""
        if not self._began:
            # Session time is the odometry's: that of a robot's drive begins anywhere.
            self._began, self._recording.epoch_ns = True, scan.t_ns
        if not scan.host_ns and self._time_of_day_ns is not None:
            scan = replace(scan, host_ns=(self._time_of_day_ns(),) * len(scan.frames))
        self._host_ns = scan.host_ns[-1] if scan.host_ns else None
        self._frames.on_scan(scan)
        self._link.on_scan(scan, self._host_ns)
        if self._flush_s is not None and self._clock_s() - self._flushed_s >= self._flush_s:
            self._send(scan.t_ns - round(self._flush_s * NS_PER_S))

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Take a state of SLAM: poses and scalars in blocks, the map once per second."""
        self._map.on_snapshot(snapshot, self._host_ns)
        self._numbers.on_snapshot(snapshot, self._host_ns)
        self._frames.on_snapshot(snapshot, self._host_ns)
        self._n_waiting += 1
        if self._n_waiting == _BLOCK_STATES:
            self._send_states()

    def on_log(self, line: LogLine) -> None:
        """Take a line about the link."""
        if self._recording.is_finished:
            raise ValueError("the view is closed already")
        self._link.on_log(line)

    def close(self) -> None:
        """Send what is left, finish, and count the rows of a file."""
        if self._recording.is_finished:
            return
        self._frames.send()
        self._map.finish()
        self._numbers.send()
        self._link.finish()
        self._recording.finish()

    def _send(self, older_than_ns: int) -> None:
        self._flushed_s = self._clock_s()
        # Of fast radars the next full block is never far; parts of blocks would cost twice.
        self._frames.send_older(older_than_ns)
        self._link.send()
        self._send_states()

    def _send_states(self) -> None:
        self._n_waiting = 0
        self._map.send()
        self._numbers.send()
        self._frames.send_detections()
        self._link.send()

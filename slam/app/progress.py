"""How a run is going, on stderr: one live line on a terminal, else a plain line now and then."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable
from typing import TextIO

import numpy as np

from slam.app.session import LogLine, Scan, SessionInfo, SessionObserver, Snapshot
from slam.app.tum import NS_PER_S
from slam.geometry import transform

_LIVE_PERIOD_S = 0.2
_PLAIN_PERIOD_S = 10.0
_NO_RADARS = frozenset({"odometry", "run"})
"""Who else log lines are about."""


class Progress(SessionObserver):
    """Shows scene time, frames per second and radar, pose error, landmarks and lost frames.

    The pose error compares with the truth, which SLAM itself never sees.

    Parameters
    ----------
    info
        The run; its radars are counted.
    duration_ns
        Session time the run will cover; None where nobody knows.
    lost_frames
        Asked when a line is shown.
    also
        Asked for more words when a line is shown.
    stream
        Where lines go; a terminal gets one line that is rewritten.
    """

    def __init__(
        self,
        info: SessionInfo,
        duration_ns: int | None,
        lost_frames: Callable[[], int],
        *,
        also: Callable[[], str] = str,
        stream: TextIO | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._n_radars, self._duration_ns = max(len(info.radars), 1), duration_ns
        self._lost_frames, self._also, self._clock = lost_frames, also, clock
        self._is_terminal = self._stream.isatty()
        self._period_s = _LIVE_PERIOD_S if self._is_terminal else _PLAIN_PERIOD_S
        self._started = self._shown = clock()
        self._n_frames = self._t_ns = 0
        self._start_ns: int | None = None
        self._snapshot: Snapshot | None = None

    def on_scan(self, scan: Scan) -> None:
        """Count frames; show a line when it is time."""
        self._n_frames += len(scan.frames)
        if self._start_ns is None:  # in the real world session time begins anywhere
            self._start_ns = 0 if self._duration_ns is not None else scan.t_ns
        self._t_ns = scan.t_ns - self._start_ns
        if self._clock() - self._shown >= self._period_s:
            self._show()

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Remember the newest state."""
        self._snapshot = snapshot

    def on_log(self, line: LogLine) -> None:
        """Show warnings about the link at once."""
        if line.warning:
            who = line.radar if line.radar in _NO_RADARS else f"radar {line.radar}"
            self._write(f"warning: {who}: {line.text}\n")

    def close(self) -> None:
        """Show the last line and leave it standing."""
        self._show()
        if self._is_terminal:
            self._stream.write("\n")
            self._stream.flush()

    def line(self) -> str:
        """Return the line as it would be shown now."""
        wall_s = max(self._clock() - self._started, 1e-9)
        rate = self._n_frames / self._n_radars / wall_s
        text = f"scene time {self._t_ns / NS_PER_S:6.1f} "
        text += "s" if self._duration_ns is None else f"of {self._duration_ns / NS_PER_S:.1f} s"
        text += f"  {rate:5.0f} frames/s per radar"
        if self._snapshot is not None:
            state = self._snapshot
            estimate = transform(state.world_from_map, state.estimate[:2])
            error_m = float(np.linalg.norm(estimate - state.truth[:2]))
            if not np.isnan(error_m):
                text += f"  pose error {1e3 * error_m:6.1f} mm"
            text += f"  {len(state.landmark_ids)} landmarks"
        return f"{text}  {self._lost_frames()} frames lost{self._also()}"

    def _show(self) -> None:
        self._shown = self._clock()
        if self._is_terminal:  # erasing reaches one row only, so the line must not wrap
            self._write(self.line()[: shutil.get_terminal_size().columns - 1])
        else:
            self._write(f"{self.line()}\n")

    def _write(self, text: str) -> None:
        # Carriage return and erase: the live line stays one line.
        self._stream.write(f"\r\x1b[K{text}" if self._is_terminal else text)
        self._stream.flush()

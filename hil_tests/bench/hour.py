"""An hour of `uwb-slam demo` in virtual time, without ports: its memory, minute by minute.

`python -m hil_tests.bench.hour` drives laps of scene `lab` with preset `robust`, 5 scans/s of four
radars, 14 landmarks, and writes what a demo writes: session, view, results. It prints a line per
minute of session time and, at the end, by how much the resident memory grew from minute 10 on.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from itertools import cycle, islice
from pathlib import Path

from emulator.scene.scene import Scene
from slam.app.publish.sinks import Publishing
from slam.app.rig.emulated import rig_of, scene_and_config, wheels_of
from slam.app.run.maps import MapSaver
from slam.app.run.result_files import finish
from slam.app.run.runner import execute
from slam.app.session.writer import SessionLog
from slam.app.sweep.run import loopback_source
from slam.app.view.session_view import RerunView
from slam.library.slam import make_slam
from slam.live.odometry_track import NS_PER_S, OdometryTrack
from slam.live.session_records import Scan, SessionObserver, Snapshot
from xethru_protocol.operating_system import StopFlag

BYTES_PER_MB = 1_000_000
SETTLED_MIN = 10
"""Until then what a run has once, buffers and the map, has its size."""
LIMIT_MB = 25.0
_STATUS = Path("/proc/self/status")


def resident_mb() -> float:
    """Return the resident memory of this process, as Linux counts it."""
    (line,) = (row for row in _STATUS.read_text().splitlines() if row.startswith("VmRSS:"))
    return int(line.split()[1]) * 1024 / BYTES_PER_MB


class MemoryCurve(SessionObserver):
    """Prints and keeps the resident memory at every whole minute of session time.

    Attributes
    ----------
    resident_mb
        By minute since session time 0.
    """

    def __init__(self, folder: Path) -> None:
        self.resident_mb: list[float] = []
        self._folder = folder
        self._started = time.monotonic()
        self._n_landmarks = 0

    def on_snapshot(self, snapshot: Snapshot) -> None:
        self._n_landmarks = len(snapshot.landmark_ids)

    def on_scan(self, scan: Scan) -> None:
        minute = len(self.resident_mb)
        if scan.t_ns < minute * 60 * NS_PER_S:
            return
        self.resident_mb.append(resident_mb())
        written = sum(file.stat().st_size for file in self._folder.iterdir()) / BYTES_PER_MB
        sys.stdout.write(
            f"minute {minute:3}  {self.resident_mb[-1]:7.1f} MB resident  {written:8.1f} MB on disk"
            f"  {self._n_landmarks:3} landmarks  {time.monotonic() - self._started:6.1f} s\n"
        )
        sys.stdout.flush()


def endless(scene: Scene, minutes: float) -> Scene:
    """Return a scene whose laps are driven again and again for so long, and a little longer."""
    once = scene.path.laps
    n_laps = round(minutes * 60 * NS_PER_S * len(once) / scene.trajectory().duration_ns) + 1
    path = scene.path.model_copy(update={"laps": tuple(islice(cycle(once), n_laps))})
    return scene.model_copy(update={"path": path})


def curve(
    folder: Path,
    *,
    scene: str = "lab",
    preset: str = "robust",
    minutes: float = 60,
    seed: int = 0,
    views: bool = True,
) -> list[float]:
    """Drive for so long; return the resident memory [MB] by minute."""
    loaded, config = scene_and_config(scene, preset)
    loaded = endless(loaded, minutes)
    slam = make_slam(config, rig_of(loaded), wheels_of(loaded))
    source = loopback_source(loaded, preset, slam, seed)
    memory = MemoryCurve(folder)
    assert isinstance(source.odometry, OdometryTrack)
    sinks: list[SessionObserver] = [
        SessionLog(folder / "session.mcap", source.info, source.odometry, truth_at=source.truth_at),
        memory,
    ]
    if views:
        sinks.append(RerunView(folder / "session.rrd", source.info))
    record = execute(source, sinks)
    saver = MapSaver(None, slam, source.info)
    finish(folder, source, record, StopFlag(), publishing=Publishing(()), map_saver=saver)
    return memory.resident_mb


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, prog="python -m hil_tests.bench.hour")
    parser.add_argument("--scene", default="lab")
    parser.add_argument("--preset", default="robust")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--no-views", action="store_true", help="without the recording for Rerun")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        resident = curve(
            Path(folder),
            scene=given.scene,
            preset=given.preset,
            minutes=given.minutes,
            seed=given.seed,
            views=not given.no_views,
        )
    grown = resident[-1] - resident[min(SETTLED_MIN, len(resident) - 1)]
    sys.stdout.write(
        f"from minute {SETTLED_MIN} to minute {len(resident) - 1}: {grown:+.1f} MB, "
        f"limit {LIMIT_MB:g} MB\n"
    )
    return int(grown > LIMIT_MB)


if __name__ == "__main__":
    sys.exit(main())

"""A short recorded session without ports: the emulated robot in this process, in two seconds."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from emulator.scene.wheels import scene_odometry
from hil_tests.system.short_scene import write_short_scene
from slam.app.rig.emulated import (
    FRAME_RATE_HZ,
    RAW_CONFIG,
    end_tick,
    open_loopback,
    outlines_m,
    rig_of,
    scene_and_config,
    true_landmarks_m,
    versions,
    wheels_of,
)
from slam.app.run.runner import RunRecord, RunSource, execute, unknown_truth
from slam.app.session.constants import slam_constants
from slam.app.session.writer import SessionLog
from slam.library.slam import make_slam
from slam.live.odometry_track import OdometryTrack
from slam.live.session.description import settings_text
from slam.live.session_records import LogLine, Scan, SessionInfo
from slam.robust.parameters import BackEndParameters
from xethru_protocol.operating_system import StopFlag

STARTED_UNIX_NS = 1_790_000_000_000_000_000
LOST_RADAR, LOST_COUNTER = 1, 40
FAULT = "fault CRC of 5731 bytes <does not fit>"

_SHORTER = ("waypoints_m = [[0.0, 0.0], [0.5, 0.0]]", "waypoints_m = [[0.0, 0.0], [0.2, 0.0]]")


def write_shorter_scene(folder: Path) -> Path:
    file = write_short_scene(folder)
    text = file.read_text()
    assert text.count(_SHORTER[0]) == 1
    file.write_text(text.replace(*_SHORTER))
    return file


def record_session(
    path: Path,
    preset: str,
    seed: int = 5,
    *,
    has_truth: bool = True,
    rules: BackEndParameters | None = None,
    constants: Mapping[str, object] | None = None,
) -> RunRecord:
    """Record 0.2 m there and back, with one frame lost and one fault on the links.

    Without truth it is as a drive in the real world. A session that was recorded before in this
    process is copied.
    """
    if rules is None and constants is None:
        file, record = _recorded(preset, seed, has_truth=has_truth)
        path.write_bytes(file)
        return record
    return _record(path, preset, seed, has_truth=has_truth, rules=rules, constants=constants)


@cache
def _recorded(preset: str, seed: int, *, has_truth: bool) -> tuple[bytes, RunRecord]:
    with TemporaryDirectory() as folder:
        path = Path(folder, "session.mcap")
        record = _record(path, preset, seed, has_truth=has_truth)
        return path.read_bytes(), record


def _record(
    path: Path,
    preset: str,
    seed: int,
    *,
    has_truth: bool,
    rules: BackEndParameters | None = None,
    constants: Mapping[str, object] | None = None,
) -> RunRecord:
    scene, config = scene_and_config(str(write_shorter_scene(path.parent)), preset)
    trajectory = scene.trajectory()
    odometry = OdometryTrack.from_lines(scene_odometry(scene, seed))
    with open_loopback(scene, seed) as source:
        source.start(RAW_CONFIG, FRAME_RATE_HZ)
        info = SessionInfo(
            scene=scene.name,
            preset=preset,
            seed=seed if has_truth else None,
            radars=source.radars,
            true_landmarks_m=true_landmarks_m(scene)[: None if has_truth else 0],
            versions=versions(),
            config_json=settings_text(config),
            constants=slam_constants() if constants is None else constants,
            wheels=asdict(wheels_of(scene)),
            outlines_m=outlines_m(scene),
            simulated=has_truth,
            started_unix_ns=None if has_truth else STARTED_UNIX_NS,
            odometry_clock="" if has_truth else "monotonic",
        )
        truth = trajectory.poses if has_truth else unknown_truth
        log = SessionLog(path, info, odometry, truth_at=truth if has_truth else None)
        scans = source.scans(end_tick(trajectory.duration_ns), StopFlag())
        slam = make_slam(config, rig_of(scene), wheels_of(scene), rules=rules)
        run = RunSource(
            info=info,
            rig=rig_of(scene),
            slam=slam,
            scans=_damaged(scans, log, info),
            odometry=odometry,
            truth_at=truth,
        )
        return execute(run, [log])


def _damaged(scans: Iterator[Scan], log: SessionLog, info: SessionInfo) -> Iterator[Scan]:
    name = info.radars[LOST_RADAR].name
    for scan in scans:
        if scan.counter == LOST_COUNTER:
            log.on_log(LogLine(t_ns=scan.t_ns, radar=name, warning=True, text=FAULT))
            kept = tuple(frame for frame in scan.frames if frame.radar != LOST_RADAR)
            yield replace(scan, frames=kept)
        else:
            yield scan

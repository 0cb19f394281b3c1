"""A made-up session for the tests of logs and viewers: known frames, poses and landmarks."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import NonSeekingReader
from numpy.typing import NDArray

from slam.app.cli import main
from slam.app.run.runner import (
    Odometry,
    RunRecord,
    RunRecorder,
    RunSource,
    snapshot_of_step,
    unknown_truth,
)
from slam.app.session.writer import SessionLog
from slam.config import load_preset
from slam.frames import Detection, RadarFrame
from slam.geometry import paper_rig
from slam.live.odometry_track import OdometryTrack, format_tum_line
from slam.live.session_records import (
    LogLine,
    RadarInfo,
    Scan,
    SessionInfo,
    SessionObserver,
    Snapshot,
    TruthAt,
)
from slam.results import Pipeline, PoseAt, SmoothedRun, StepResult

FRAME_NS = 199_261_498
N_BINS = 1431


class SlowClock:
    """Every look at it takes 0.15 s, so that a chunk holds half a dozen messages."""

    def __init__(self) -> None:
        self.now_ns = 0

    def __call__(self) -> int:
        self.now_ns += 150_000_000
        return self.now_ns


def session_info(n_radars: int = 2) -> SessionInfo:
    radars = tuple(
        RadarInfo(
            name=f"radar{index}",
            serial=f"00000000000{index}",
            port=f"port{index}",
            x_m=0.1,
            y_m=0.2 + 0.3 * index,
            yaw_rad=1.57 - index,
            range_offset_m=0.0,
            range_start_m=0.2,
            bin_length_m=0.0064,
            n_bins=N_BINS,
            rate_hz=5.018533,
            settings={"iterations": 16},
        )
        for index in range(n_radars)
    )
    return SessionInfo(
        scene="made_up",
        preset="paper",
        seed=7,
        radars=radars,
        true_landmarks_m=np.array([[1.0, 0.5], [-0.5, 2.0]]),
        versions={"numpy": "2"},
    )


def source_of_scans(
    scans: Iterable[Scan],
    odometry: Odometry,
    slam: Pipeline,
    truth_at: TruthAt = unknown_truth,
    radars: tuple[RadarInfo, ...] | None = None,
) -> RunSource:
    """Return scans as the source of a run; their radars are those of `session_info` if None."""
    info = session_info()
    return RunSource(
        info=info if radars is None else replace(info, radars=radars),
        rig=paper_rig(),
        slam=slam,
        scans=scans,
        odometry=odometry,
        truth_at=truth_at,
    )


def scan(counter: int, n_radars: int = 2, n_bins: int = N_BINS) -> Scan:
    t_ns = counter * FRAME_NS
    frames = tuple(
        RadarFrame(
            radar=radar,
            t_ns=t_ns,
            counter=counter,
            samples=np.random.default_rng((counter, radar)).normal(0, 1e-3, n_bins).astype("f4"),
            range_start_m=0.2,
            bin_length_m=0.0064,
        )
        for radar in range(n_radars)
    )
    return Scan(counter=counter, t_ns=t_ns, frames=frames)


def snapshot(counter: int) -> Snapshot:
    pose = np.array([0.01 * counter, 0.002 * counter, 0.1])  # three unequal headings
    return Snapshot(
        counter=counter,
        t_ns=counter * FRAME_NS,
        truth=pose,
        odometry=pose + np.array([0.02, 0.0, -0.6]),
        estimate=pose + np.array([0.0, 0.01, 0.3]),
        world_from_map=np.zeros(3),
        pose_covariance=np.diag([1e-4, 1e-4, 1e-5]),
        landmark_ids=np.array([3, 8]),
        landmarks_m=np.array([[1.01, 0.5], [-0.5, 2.02]]),
        landmark_covariances_m2=np.array([np.diag([4e-4, 1e-4]), [[2e-4, 1e-4], [1e-4, 2e-4]]]),
        nis_per_dof=(0.5, 1.5) if counter % 2 else (),
    )


def smoothed_run(n_states: int) -> SmoothedRun:
    """Return a solution over the first states of `feed`, its numbers no short decimals."""
    k = np.arange(1.0, n_states + 1)
    return SmoothedRun(
        t_ns=FRAME_NS * np.arange(n_states),
        poses=np.column_stack([k / 90, k / 700, k / 1100]),
        pose_covariances=np.diag([1e-4, 2e-4, 3e-5]) + 1e-5 / k[:, None, None],
        landmark_ids=(3, 8),
        landmarks_m=np.array([[1.0, 0.5], [-0.5, 2.0]]) + 1 / 300,
        landmark_covariances_m2=np.array([np.diag([4e-4, 1e-4]), [[2e-4, 1e-4], [1e-4, 2e-4]]]),
    )


def record_of_steps(
    results: Iterable[StepResult],
    truth: np.ndarray,
    world_from_map: np.ndarray,
    true_landmarks_m: np.ndarray,
    *observers: SessionObserver,
) -> RunRecord:
    """Return the record of states without scans, and give them to observers; truth (n, 3)."""
    recorder = RunRecorder(true_landmarks_m)
    for counter, (result, pose) in enumerate(zip(results, truth, strict=True)):
        state = snapshot_of_step(
            result,
            counter=counter,
            truth=pose,
            world_from_map=world_from_map,
            wall_spans_m=np.empty((0, 2, 2)),
        )
        for observer in (recorder, *observers):
            observer.on_snapshot(state)
    return recorder.record()


class Listener(SessionObserver):
    def __init__(self) -> None:
        self.scans: list[Scan] = []
        self.snapshots: list[Snapshot] = []
        self.lines: list[LogLine] = []

    def on_scan(self, scan: Scan) -> None:
        self.scans.append(scan)

    def on_snapshot(self, snapshot: Snapshot) -> None:
        self.snapshots.append(snapshot)

    def on_log(self, line: LogLine) -> None:
        self.lines.append(line)


class NoSlam:
    """A pipeline that estimates nothing; tests define what they need of it."""

    config = load_preset("robust")

    def step(
        self, frames: Sequence[RadarFrame], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        return ()

    def step_detections(
        self, detections: Sequence[Detection], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        return ()

    def flush(self) -> tuple[StepResult, ...]:
        return ()

    def smoothed(self) -> SmoothedRun | None:
        return None

    def wall_spans_m(self) -> NDArray[np.float64]:
        return np.empty((0, 2, 2))

    def saved_map(self) -> None:
        """Return no map."""

    def map_changes(self) -> None:
        """Return no changes."""


def feed(observer: SessionObserver, n_scans: int) -> None:
    """Give an observer a whole session of two radars, without closing it."""
    observer.take(LogLine(t_ns=0, radar="radar0", warning=False, text="Ping -> Pong"))
    for counter in range(n_scans):
        observer.take(scan(counter))
        observer.take(snapshot(counter))
    observer.take(LogLine(t_ns=5, radar="radar1", warning=True, text="CRC fault"))


def odometry(n_poses: int) -> OdometryTrack:
    """Return odometry at almost the times of frames, its numbers no short decimals."""
    poses = [np.array([k / 3, k / 7, k / 11]) for k in range(n_poses)]
    return OdometryTrack.from_lines(
        [format_tum_line(k * 200_000_000 + k, pose) for k, pose in enumerate(poses)]
    )


def write_session(
    path: Path, n_scans: int, track: OdometryTrack | None = None, info: SessionInfo | None = None
) -> Path:
    log = SessionLog(path, info or session_info(), track)
    feed(log, n_scans)
    log.close()
    return path


def write_scans(
    path: Path,
    scans: Iterable[Scan],
    track: OdometryTrack | None = None,
    info: SessionInfo | None = None,
) -> Path:
    """Write a session of nothing but scans, and the odometry that they need."""
    log = SessionLog(path, info or session_info(), track)
    for one in scans:
        log.on_scan(one)
    log.close()
    return path


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main([str(argument) for argument in arguments])
    said = capsys.readouterr()
    return code, said.out, said.err


def surviving_counters(path: Path, topic: str) -> list[int]:
    """Read the counters of one topic from a session that was never finished."""
    counters = []
    with path.open("rb") as stream:
        try:
            for _, channel, message in NonSeekingReader(stream).iter_messages(log_time_order=False):
                if channel.topic == topic:
                    counters.append(message.sequence)
        except EndOfFile:
            pass
    return counters

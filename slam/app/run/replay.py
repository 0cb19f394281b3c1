"""`uwb-slam replay`: a recorded session through SLAM again, with the same numbers.

Frames come with the stamps that the run used, odometry as the floats it parsed, settings, rig and
wheels as they were: every number but the speed is the run's own, to the last bit. The states that
the run recorded are compared on the way.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from slam.app.errors import AppError, OdometryError
from slam.app.odometry.track import OdometryTrack
from slam.app.odometry.tum import TumSample
from slam.app.records import LogLine, RadarInfo, Scan, SessionObserver, Snapshot
from slam.app.run.output import Progress, print_run_table
from slam.app.run.output import print_summary as print_table
from slam.app.run.results import RESULTS, prepare_folder, saying_what_is_left, write_results
from slam.app.run.runner import RunRecord, run_slam
from slam.app.session.messages import state_row
from slam.app.session.reader import RecordedSession, open_session
from slam.config import ConfigError, SlamConfig, WheelNoise, without_removed_keys
from slam.frames import Detection, RadarFrame
from slam.pipelines import make_slam
from slam.results import PoseAt, Slam, StepResult
from xethru_protocol.system import StopFlag


class RecordedSlam:
    """Steps a pipeline with recorded detections; frames, if any came along, are for the eye.

    Parameters
    ----------
    slam
        The pipeline.
    detections
        By the time of the scan [ns]; a scan without entry heard nothing.
    """

    def __init__(self, slam: Slam, detections: Mapping[int, Sequence[Detection]]) -> None:
        self._slam = slam
        self._detections = detections
        self.config = slam.config

    def step(
        self, frames: Sequence[RadarFrame], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        """Take in what was detected at a time; return the states that became ready."""
        return self._slam.step_detections(self._detections.get(t_ns, ()), pose_at, t_ns)

    def step_detections(
        self, detections: Sequence[Detection], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        """Do what the pipeline does."""
        return self._slam.step_detections(detections, pose_at, t_ns)

    def flush(self) -> tuple[StepResult, ...]:
        """Return the states still held back at the end of a run."""
        return self._slam.flush()

    def wall_spans_m(self) -> NDArray[np.float64]:
        """Return the pipeline's stretches of wall, shape (k, 2, 2) [m], map frame."""
        return self._slam.wall_spans_m()


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayOptions:
    """What the command line of `uwb-slam replay` says."""

    session: Path
    out: Path


def run_replay(options: ReplayOptions, stop: StopFlag) -> None:
    """Replay a session, write its results into a folder and print its table.

    Raises
    ------
    AppError
        The session cannot be read, or its folder not be written; one line.
    StopRequestedError
        A signal arrived.
    """
    session = open_session(options.session)
    config = settings_of(session)
    with ExitStack() as held:
        prepare_folder(options.out, RESULTS, held)
        losses = LostFrames(session.info.radars)
        comparison = Comparison()
        progress = Progress(session.info, None, lambda: losses.count)
        held.callback(progress.close)
        observers: list[SessionObserver] = [losses, comparison, progress]
        record = replay_session(session, observers, stop.check, comparison.expect)
        held.pop_all().close()  # the progress line stands before what follows
        with saying_what_is_left(f"; {options.out} is not complete"):
            stop.check()
            summary = write_results(options.out, session.info, record, session.rig)
            stop.check()
    if session.cut_at_byte is not None:
        _warn(f"{session.path} was cut at byte {session.cut_at_byte}; this is what is left of it")
    _warn(comparison.verdict())
    if summary is None:
        print_run_table(session.info, record, lost_frames=losses.count, stream=sys.stdout)
    else:
        print_table(
            summary,
            lag_states=config.window.size - 1,
            wall_s=record.wall_s,
            lost_frames=losses.count,
            stream=sys.stdout,
        )


def settings_of(session: RecordedSession) -> SlamConfig:
    """Return the settings that the run had.

    Raises
    ------
    AppError
        The file does not tell them, or this version does not know them.
    """
    if not session.info.config_json or not session.info.wheels:
        raise AppError(
            f"{session.path}: does not hold SLAM's settings; "
            "its frames can be read, but not be replayed; record it again"
        )
    return recorded_config(session)


def recorded_config(session: RecordedSession) -> SlamConfig:
    """Return the settings that a session tells.

    Raises
    ------
    AppError
        This version does not know them, or they cannot be read.
    """
    try:
        tables = json.loads(session.info.config_json)
        if isinstance(tables, dict):
            tables = without_removed_keys(tables, str(session.path))
        return SlamConfig.model_validate(tables)
    except json.JSONDecodeError as error:
        raise AppError(f"{session.path}: its settings cannot be read: {error}") from None
    except ConfigError as error:
        raise AppError(str(error)) from None
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        key = ".".join(str(part) for part in first["loc"])
        raise AppError(
            f"{session.path}: its setting {key} is not one of this version ({first['msg']}); "
            f"it was recorded with xethru-hil {session.info.versions.get('xethru-hil', '?')}"
        ) from None


def replay_session(
    session: RecordedSession,
    observers: Sequence[SessionObserver],
    check: Callable[[], None],
    expect: Callable[[Snapshot], None] | None = None,
) -> RunRecord:
    """Step SLAM through a session as the run did; no file is written, nothing printed.

    Parameters
    ----------
    session
        What was recorded.
    observers
        Told of scans, states and log lines, as in the run.
    check
        Called once per scan; may raise to stop.
    expect
        Told every recorded state before the replay begins.

    Raises
    ------
    AppError
        The session cannot be replayed.
    """
    config = settings_of(session)
    try:
        wheels = WheelNoise(**session.info.wheels)
    except TypeError:
        raise AppError(f"{session.path}: its description of the wheels is unknown here") from None
    samples: list[TumSample] = []
    lines: list[LogLine] = []
    for record in session.records():
        if isinstance(record, TumSample):
            samples.append(record)
        elif isinstance(record, LogLine):
            lines.append(record)
        elif isinstance(record, Snapshot) and expect is not None:
            expect(record)
    try:
        odometry = OdometryTrack(samples)
    except OdometryError as error:
        raise AppError(f"{session.path}: {error}") from None
    truth = _Truth()
    slam = make_slam(config, session.rig, wheels)
    if session.info.has_detections:
        slam = RecordedSlam(slam, session.detections())
    return run_slam(
        _scans(session, truth, lines, observers, check),
        odometry,
        slam,
        truth.at,
        observers,
        gains_db=[radar.gain_db for radar in session.info.radars],
    )


class _Truth:
    """The true poses at the scans so far."""

    def __init__(self) -> None:
        self._poses: dict[int, NDArray[np.float64]] = {}

    def take(self, t_ns: int, pose: NDArray[np.float64] | None) -> None:
        self._poses[t_ns] = np.full(3, np.nan) if pose is None else pose

    def at(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.array([self._poses[t_ns] for t_ns in stamps_ns.tolist()]).reshape(-1, 3)


def _scans(
    session: RecordedSession,
    truth: _Truth,
    lines: Sequence[LogLine],
    observers: Sequence[SessionObserver],
    check: Callable[[], None],
) -> Iterator[Scan]:
    waiting = iter(lines)
    line = next(waiting, None)
    for scan, pose in session.scans():
        check()
        while line is not None and line.t_ns <= scan.t_ns:
            for observer in observers:
                observer.on_log(line)
            line = next(waiting, None)
        truth.take(scan.t_ns, pose)
        yield scan
    while line is not None:
        for observer in observers:
            observer.on_log(line)
        line = next(waiting, None)


class LostFrames(SessionObserver):
    """Counts the frames missing between counters, over all radars."""

    def __init__(self, radars: Sequence[RadarInfo]) -> None:
        self._last: list[int | None] = [None] * len(radars)
        self.count = 0

    def on_scan(self, scan: Scan) -> None:
        """Take the frames of one scan; a counter that begins anew is no loss."""
        for frame in scan.frames:
            last = self._last[frame.radar]
            if last is not None and frame.counter > last:
                self.count += frame.counter - last - 1
            self._last[frame.radar] = frame.counter


class Comparison(SessionObserver):
    """Compares every state with the one that was recorded, to the last bit."""

    def __init__(self) -> None:
        self._expected: dict[int, bytes] = {}
        self._n_same = 0
        self._first_other_ns: int | None = None

    def expect(self, snapshot: Snapshot) -> None:
        """Take a recorded state."""
        self._expected[snapshot.t_ns] = _digest(snapshot)

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Compare a state of the replay."""
        expected = self._expected.get(snapshot.t_ns)
        if expected is None:
            return
        if expected == _digest(snapshot):
            self._n_same += 1
        elif self._first_other_ns is None:
            self._first_other_ns = snapshot.t_ns

    @property
    def is_same(self) -> bool:
        """Whether every recorded state came again."""
        return self._n_same == len(self._expected)

    def verdict(self) -> str:
        """Return what to tell the user."""
        if not self._expected:
            return "no states are recorded, so there are none to compare with"
        if self.is_same:
            return f"all {self._n_same} recorded states came again, to the last bit"
        where = ""
        if self._first_other_ns is not None:
            where = f", the first other one at {self._first_other_ns / 1e9:.3f} s"
        return (
            f"only {self._n_same} of {len(self._expected)} recorded states came again{where}; "
            "another version, or another processor's arithmetic?"
        )


def _digest(snapshot: Snapshot) -> bytes:
    return hashlib.blake2b(state_row(snapshot).tobytes(), digest_size=16).digest()


def _warn(text: str) -> None:
    sys.stderr.write(f"uwb-slam: {text}\n")
    sys.stderr.flush()

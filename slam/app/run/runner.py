"""The run loop of every command: scans of a source go through SLAM, and sinks get what comes out.

Also what happens on the radars' links: log lines stamped with session time, and link states.
"""

from __future__ import annotations

import math
import time
from array import array
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from slam.frames import RadarFrame, StepInputError
from slam.geometry import Rig
from slam.library.evaluation import TrueAssociationNis, true_range_nis
from slam.library.saved_map import MapFile
from slam.live.errors import AppError
from slam.live.frame_sources import less_gain
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
from slam.robust.solver.growing_arrays import PackedRows
from xethru_protocol.driver.frames import Frame
from xethru_protocol.driver.matching import ProtocolRecord

Step: TypeAlias = Callable[[Sequence[RadarFrame], PoseAt, int], tuple[StepResult, ...]]
"""As `Pipeline.step`."""


def unknown_truth(stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the truth of a run in the real world: NaN, shape (n, 3)."""
    return np.full((len(stamps_ns), 3), np.nan)


class Odometry(Protocol):
    """Gives the wheels' pose, shape (3,), odometry frame, at a session time; see `PoseTrack`."""

    def pose_at(self, t_ns: int) -> NDArray[np.float64]: ...

    def frame_at(self, t_ns: int) -> NDArray[np.float64]: ...


class StepGivenUpError(BaseException):
    """SLAM broke off a step since the run has to end; it must not be used afterwards.

    No `Exception`: it comes in the middle of anything, as KeyboardInterrupt does.
    """


class LinkLog(SessionObserver):
    """Stamps what is logged with session time; lines wait until sinks are attached."""

    def __init__(self) -> None:
        self._t_ns = 0
        self._waiting: list[LogLine] = []
        self._sinks: tuple[SessionObserver, ...] | None = None

    def attach(self, *sinks: SessionObserver) -> None:
        """Pass on the lines that wait, and every later one."""
        self._sinks = sinks
        waiting, self._waiting = self._waiting, []
        for line in waiting:
            self.pass_on(line)

    def on_record(self, radar: str, record: ProtocolRecord) -> None:
        text = f"{record.direction} {record.summary}"
        self.log(radar, text, warning=record.direction == "fault")

    def log(self, subject: str, text: str, *, warning: bool) -> None:
        """Log a line about a radar, "odometry" or "run"."""
        self.pass_on(LogLine(t_ns=self._t_ns, radar=subject, warning=warning, text=text))

    def pass_on(self, line: LogLine) -> None:
        """Give a line that has its stamp to the sinks."""
        if self._sinks is None:
            self._waiting.append(line)
            return
        for sink in self._sinks:
            sink.take(line)

    def on_scan(self, scan: Scan) -> None:
        self._t_ns = scan.t_ns


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunSource:
    """The input of a run: an emulated rig, live modules or a recorded session, and its SLAM.

    `truth_at` is for sinks and results only. `lost_frames` returns the frames missing so far
    between counters, over all radars. `close` is called before sinks are closed: what it logs is
    still recorded. `smoothing_asked` is called after every scan: whether sinks shall get the
    smoothed run so far. `map_file` is the map that SLAM began with, None if it was an empty one.
    `step` is called in place of that of `slam`, if there is one.
    """

    info: SessionInfo
    rig: Rig
    slam: Pipeline
    scans: Iterable[Scan]
    odometry: Odometry
    truth_at: TruthAt = unknown_truth
    lost_frames: Callable[[], int] = int
    link_log: LinkLog = field(default_factory=LinkLog)
    close: Callable[[], None] = lambda: None
    smoothing_asked: Callable[[], bool] = lambda: False
    map_file: MapFile | None = None
    step: Step | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class States:
    """The states of a run in time order, as packed arrays.

    Attributes
    ----------
    t_ns
        Shape (n,), int64.
    truth, odometry, estimate
        Shape (n, 3), [x m, y m, heading rad]; world (NaN if unknown), odom and map frame.
    pose_covariances
        Shape (n, 3, 3), of the estimates.
    nis, nis_dof
        Shape (n,): summed NIS of the measurements of what they are truly of, before gates, and its
        degrees of freedom; 0 of a state without truth or without such measurements.
    lost
        Shape (n,): whether SLAM reported the robot as lost.
    """

    t_ns: NDArray[np.int64]
    truth: NDArray[np.float64]
    odometry: NDArray[np.float64]
    estimate: NDArray[np.float64]
    pose_covariances: NDArray[np.float64]
    nis: NDArray[np.float64]
    nis_dof: NDArray[np.int32]
    lost: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def has_truth(self) -> bool:
        """Whether the true pose is known at every state, and there is a state."""
        return len(self) > 0 and bool(np.isfinite(self.truth).all())

    @property
    def driven_m(self) -> float:
        """The way by the estimate; the jump with which a lost robot is found is none."""
        steps_m = np.linalg.norm(np.diff(self.estimate[:, :2], axis=0), axis=1)
        return float(steps_m[~self.lost[:-1] | self.lost[1:]].sum())


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RunRecord:
    """The outcome of a run.

    Attributes
    ----------
    last
        The last state with its map; None if there is none.
    smoothed
        The newest solution over all states until then; None if there is none. That of a run which
        ended covers all its states.
    lagged_ns, lagged
        Shapes (m,) and (m, 3): times of the lagged poses (`slam.results.LaggedPose`), and these,
        map frame; empty of preset `paper`.
    n_frames
        Radar frames used, over all radars.
    start_ns, duration_ns, wall_s
        Session time of the first scan, session time covered, and the time it took.
    """

    states: States
    last: Snapshot | None
    n_frames: int
    duration_ns: int
    wall_s: float
    start_ns: int = 0
    smoothed: SmoothedRun | None = None
    lagged_ns: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    lagged: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def whole_smoothed(self) -> SmoothedRun | None:
        """Return the smoothed run if it covers every state."""
        smoothed = self.smoothed
        if smoothed is None or not np.array_equal(smoothed.t_ns, self.states.t_ns):
            return None
        return smoothed

    @property
    def world_from_map(self) -> NDArray[np.float64]:
        """Return where the map frame lies in the world, shape (3,); zeros if unknown."""
        return np.zeros(3) if self.last is None else self.last.world_from_map


_FIX_DOF = 2
_FLOAT = np.dtype(np.float64)


class RunRecorder(SessionObserver):
    """Packs what a run's record needs, state by state; the states may be recorded ones.

    `true_landmarks_m` has shape (m, 2), world frame.
    """

    def __init__(self, true_landmarks_m: NDArray[np.float64]) -> None:
        self._true_landmarks_m = true_landmarks_m
        self._fixes_nis = TrueAssociationNis(true_landmarks_m)
        self._t_ns = PackedRows(np.dtype(np.int64))
        self._truth, self._odometry, self._estimate = (PackedRows(_FLOAT, 3) for _ in range(3))
        self._covariances = PackedRows(_FLOAT, 3, 3)
        self._nis, self._nis_dof = PackedRows(_FLOAT), PackedRows(np.dtype(np.int32))
        self._lost = PackedRows(np.dtype(np.bool_))
        self._lagged_ns, self._lagged = PackedRows(np.dtype(np.int64)), PackedRows(_FLOAT, 3)
        self._last: Snapshot | None = None
        self._smoothed: SmoothedRun | None = None
        self._start_ns: int | None = None
        self._n_frames = self._duration_ns = 0
        self._started = time.monotonic()

    def on_scan(self, scan: Scan) -> None:
        self._start_ns = scan.t_ns if self._start_ns is None else self._start_ns
        self._duration_ns = scan.t_ns - self._start_ns
        if scan.used:
            self._n_frames += len(scan.frames)

    def on_snapshot(self, snapshot: Snapshot) -> None:
        self._t_ns.append(snapshot.t_ns)
        self._truth.append(snapshot.truth)
        self._odometry.append(snapshot.odometry)
        self._estimate.append(snapshot.estimate)
        self._covariances.append(snapshot.pose_covariance)
        nis, dof = self._true_nis(snapshot)
        self._nis.append(nis)
        self._nis_dof.append(dof)
        self._lost.append(snapshot.step is not None and snapshot.step.is_lost)
        for one in () if snapshot.step is None else snapshot.step.lagged:
            self._lagged_ns.append(one.t_ns)
            self._lagged.append(one.pose)
        self._last = snapshot

    def on_smoothed(self, smoothed: SmoothedRun) -> None:
        self._smoothed = smoothed

    def record(self) -> RunRecord:
        """Return the record of the run until now."""
        return RunRecord(
            states=States(
                t_ns=self._t_ns.rows,
                truth=self._truth.rows,
                odometry=self._odometry.rows,
                estimate=self._estimate.rows,
                pose_covariances=self._covariances.rows,
                nis=self._nis.rows,
                nis_dof=self._nis_dof.rows,
                lost=self._lost.rows,
            ),
            last=self._last,
            n_frames=self._n_frames,
            duration_ns=self._duration_ns,
            start_ns=self._start_ns or 0,
            wall_s=time.monotonic() - self._started,
            smoothed=self._smoothed,
            lagged_ns=self._lagged_ns.rows,
            lagged=self._lagged.rows,
        )

    def _true_nis(self, snapshot: Snapshot) -> tuple[float, int]:
        step, truth = snapshot.step, snapshot.truth
        if step is None or not np.isfinite(truth).all():
            return 0.0, 0
        if step.report is None:
            fixes = [nis for nis in self._fixes_nis.add(step, truth) if math.isfinite(nis)]
            return sum(fixes), _FIX_DOF * len(fixes)
        ranges = true_range_nis(step, truth, self._true_landmarks_m)
        return sum(ranges), len(ranges)


def execute(source: RunSource, sinks: Sequence[SessionObserver] = ()) -> RunRecord:
    """Run a source through SLAM into sinks, and close these in their order.

    A scan that is not `used` goes to the sinks only, and so does the truth. One whose step SLAM
    gave up, at the end of a run, counts as not used, and nothing is smoothed then. Sinks get the
    smoothed run at the end, and after a scan when `smoothing_asked` returns True. BLAS runs on one
    thread, as everywhere else, so that results are the same bits. Sinks get frames as received,
    SLAM gets them without each radar's gain.

    Raises
    ------
    OdometryError
        Odometry does not cover the time of a scan.
    AppError
        SLAM cannot be stepped with a scan, such as one that is before the last one.
    """
    with ExitStack() as closing:
        for observer in reversed([*sinks, source.link_log]):
            closing.enter_context(observer)
        closing.callback(source.close)
        source.link_log.attach(*sinks)
        recorder = RunRecorder(source.info.true_landmarks_m)
        _run(source, [recorder, source.link_log, *sinks])
        return recorder.record()


def _run(source: RunSource, observers: Sequence[SessionObserver]) -> None:
    """Feed scans to SLAM as they come, and scans and states to the observers."""
    slam, truth_at, radars = source.slam, source.truth_at, source.info.radars
    step = source.step or slam.step
    world_from_map: NDArray[np.float64] | None = None
    if source.map_file is not None and source.map_file.world_from_map is not None:
        world_from_map = np.array(source.map_file.world_from_map)
    stamps_ns, counters = array("q"), array("q")  # of the scans

    def take(new: Iterable[StepResult]) -> None:
        for result in new:
            assert world_from_map is not None
            snapshot = snapshot_of_step(
                result,
                counter=counters[bisect_right(stamps_ns, result.t_ns) - 1],
                truth=truth_at(np.array([result.t_ns]))[0],
                world_from_map=world_from_map,
                wall_spans_m=slam.wall_spans_m(),
            )
            for observer in observers:
                observer.take(snapshot)

    def smooth() -> None:
        smoothed = slam.smoothed()
        if smoothed is not None:
            for observer in observers:
                observer.take(smoothed)

    with threadpool_limits(limits=1):
        given_up = False
        for scan in source.scans:
            results: tuple[StepResult, ...] = ()
            try:
                if scan.used:
                    scan = replace(scan, odom_frame=source.odometry.frame_at(scan.t_ns))
                    if world_from_map is None:
                        world_from_map = np.nan_to_num(truth_at(np.array([scan.t_ns]))[0])
                    stamps_ns.append(scan.t_ns)
                    counters.append(scan.counter)
                    frames = [less_gain(f, radars[f.radar].gain_db) for f in scan.frames]
                    results = step(frames, source.odometry.pose_at, scan.t_ns)
            except StepGivenUpError:
                given_up, scan = True, replace(scan, used=False)
            except StepInputError as error:
                raise AppError(f"scan {scan.counter}: {error}") from None
            finally:
                for observer in observers:
                    observer.take(scan)
            take(results)
            if not given_up and source.smoothing_asked():
                smooth()
        if not given_up:  # SLAM is in the middle of a step then
            take(slam.flush())
            smooth()


def snapshot_of_step(
    result: StepResult,
    *,
    counter: int,
    truth: NDArray[np.float64],
    world_from_map: NDArray[np.float64],
    wall_spans_m: NDArray[np.float64],
) -> Snapshot:
    """Return the state that a step of SLAM led to; see `Snapshot`."""
    belief = result.belief
    return Snapshot(
        counter=counter,
        t_ns=result.t_ns,
        truth=truth,
        odometry=result.odometry_pose,
        estimate=belief.pose,
        world_from_map=world_from_map,
        pose_covariance=belief.pose_covariance,
        landmark_ids=np.array(belief.landmark_ids, dtype=np.int64),
        landmarks_m=belief.landmarks,
        landmark_covariances_m2=belief.landmark_covariances(),
        nis_per_dof=result.nis_per_dof,
        wall_spans_m=wall_spans_m,
        step=result,
    )


def frames_between(last: RadarFrame | Frame, frame: RadarFrame | Frame) -> int:
    """Return how many frames of a radar are missing between two; 0 if a new stream began.

    Sessions of older versions hold no numbers of streams: a counter that falls is a new stream.
    """
    return max(frame.counter - last.counter - 1, 0) if frame.stream == last.stream else 0


class LostFrames(SessionObserver):
    """Counts the frames missing between counters of one stream, over all radars."""

    def __init__(self) -> None:
        self.n_lost = 0
        self._last: dict[int, RadarFrame] = {}

    def on_scan(self, scan: Scan) -> None:
        for frame in scan.frames:
            last = self._last.get(frame.radar)
            self.n_lost += 0 if last is None else frames_between(last, frame)
            self._last[frame.radar] = frame


class LinkState(StrEnum):
    """State of a radar's link."""

    SETTING_UP = "setting up"
    STREAMING = "streaming"
    FRAMES_LOST = "frames lost"
    SILENT = "silent"
    FAULT = "fault"
    ENDED = "ended"


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkChange:
    """A radar's link is in this state from session time `t_ns` on."""

    t_ns: int
    radar: str
    state: LinkState


@dataclass(slots=True, kw_only=True)
class LinkCount:
    """Frames received and lost of one radar.

    `lost` counts the counters missing between frames, `longest_gap` the most of them in a row,
    `faults` the warnings in the log of its link.
    """

    frames: int = 0
    lost: int = 0
    faults: int = 0
    last: RadarFrame | None = None
    longest_gap: int = 0
    state: LinkState | None = None


class LinkStates:
    """Follows the links of all radars, given in the order of the frames' radar index."""

    def __init__(self, radars: Sequence[RadarInfo]) -> None:
        self.radars = radars
        self.counts = {radar.name: LinkCount() for radar in radars}

    def on_scan(self, scan: Scan) -> Iterator[LinkChange]:
        """Yield the changes in one tick; a radar without a frame in it is silent.

        A scan that SLAM did not use may hold late frames only, so other radars are not silent then.
        """
        frames = {frame.radar: frame for frame in scan.frames}
        for index, radar in enumerate(self.radars):
            count = self.counts[radar.name]
            frame = frames.get(index)
            if frame is None:
                if scan.used:
                    yield from self._change(radar.name, scan.t_ns, LinkState.SILENT)
                continue
            gap = 0 if count.last is None else frames_between(count.last, frame)
            count.frames += 1
            count.lost += gap
            count.longest_gap = max(count.longest_gap, gap)
            count.last = frame
            state = LinkState.FRAMES_LOST if gap else LinkState.STREAMING
            yield from self._change(radar.name, frame.t_ns, state)

    def on_log(self, line: LogLine) -> Iterator[LinkChange]:
        count = self.counts.get(line.radar)
        if count is None:
            return  # a line about something else than a radar
        if line.warning:
            count.faults += 1
            yield from self._change(line.radar, line.t_ns, LinkState.FAULT)
        elif count.state is None:
            yield from self._change(line.radar, line.t_ns, LinkState.SETTING_UP)

    def end(self, t_ns: int) -> Iterator[LinkChange]:
        for radar in self.radars:
            yield from self._change(radar.name, t_ns, LinkState.ENDED)

    def _change(self, radar: str, t_ns: int, state: LinkState) -> Iterator[LinkChange]:
        count = self.counts[radar]
        if count.state is not state:
            count.state = state
            yield LinkChange(t_ns=t_ns, radar=radar, state=state)

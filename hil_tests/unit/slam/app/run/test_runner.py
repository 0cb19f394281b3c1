"""The runner hands every state on with its own counter, its truth and the place of the map."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from hil_tests.unit.slam.app.sessions import FRAME_NS, scan
from slam.app.odometry.track import OdometryTrack
from slam.app.odometry.tum import TumSample
from slam.app.records import Scan, SessionObserver, Snapshot
from slam.app.run.runner import nobody_knows, run_slam
from slam.frames import RadarFrame
from slam.paper.pipeline import UwbRadarSlam
from slam.results import Belief, PoseAt, StepResult

COUNTERS = (5, 6, 8, 11, 12)
LAG = 2


class LateSlam:
    """Believes odometry, two scans late; what is left at the end comes from `flush`."""

    def __init__(self) -> None:
        self.waiting: list[StepResult] = []

    def step(
        self, frames: Sequence[RadarFrame], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        odometry_pose = pose_at(t_ns)
        belief = Belief(mean=odometry_pose, covariance=np.eye(3), landmark_ids=(), next_id=0)
        self.waiting.append(
            StepResult(
                t_ns=t_ns,
                odometry_pose=odometry_pose,
                belief=belief,
                detections=(),
                fixes=(),
                observations=(),
                associations=(),
                rejected=(),
            )
        )
        return (self.waiting.pop(0),) if len(self.waiting) > LAG else ()

    def flush(self) -> tuple[StepResult, ...]:
        return tuple(self.waiting)

    def wall_spans_m(self) -> NDArray[np.float64]:
        return np.array([[[0.0, 1.0], [2.0, 1.0]]])


class Listener(SessionObserver):
    def __init__(self) -> None:
        self.scans: list[int] = []
        self.snapshots: list[Snapshot] = []

    def on_scan(self, scan: Scan) -> None:
        self.scans.append(scan.counter)

    def on_snapshot(self, snapshot: Snapshot) -> None:
        self.snapshots.append(snapshot)


def truth_at(stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    counters = stamps_ns / FRAME_NS
    return np.column_stack([counters, 100 - counters, 0.1 * counters])


def test_every_state_comes_with_its_own_counter_truth_and_place() -> None:
    ends = [
        TumSample(t_ns=counter * FRAME_NS, x_m=2.0 * counter, y_m=0.0, qz=0.0, qw=1.0)
        for counter in (0, 20)
    ]
    listener = Listener()
    record = run_slam(
        map(scan, COUNTERS),
        OdometryTrack(ends),
        cast(UwbRadarSlam, LateSlam()),
        truth_at,
        [listener],
    )
    assert tuple(listener.scans) == COUNTERS
    assert tuple(snapshot.counter for snapshot in listener.snapshots) == COUNTERS
    assert len(record.results) == len(COUNTERS)
    np.testing.assert_allclose(record.world_from_map, [5.0, 95.0, 0.5])
    for counter, snapshot, truth in zip(COUNTERS, listener.snapshots, record.truth, strict=True):
        assert snapshot.t_ns == counter * FRAME_NS
        np.testing.assert_allclose(snapshot.truth, [counter, 100 - counter, 0.1 * counter])
        np.testing.assert_allclose(snapshot.estimate, [2.0 * counter, 0.0, 0.0])
        np.testing.assert_array_equal(snapshot.world_from_map, record.world_from_map)
        np.testing.assert_array_equal(truth, snapshot.truth)
    assert record.n_frames == 2 * len(COUNTERS)
    assert record.start_ns == COUNTERS[0] * FRAME_NS
    assert record.start_ns + record.duration_ns == COUNTERS[-1] * FRAME_NS
    np.testing.assert_array_equal(record.wall_spans_m, [[[0.0, 1.0], [2.0, 1.0]]])


def test_an_unused_scan_is_told_and_not_stepped() -> None:
    ends = [TumSample(t_ns=t_ns, x_m=0.0, y_m=0.0, qz=0.0, qw=1.0) for t_ns in (0, 20 * FRAME_NS)]
    listener = Listener()
    scans = [replace(scan(counter), used=counter not in (5, 8)) for counter in COUNTERS]
    slam = cast(UwbRadarSlam, LateSlam())
    record = run_slam(scans, OdometryTrack(ends), slam, nobody_knows, [listener])
    assert tuple(listener.scans) == COUNTERS
    assert [snapshot.counter for snapshot in listener.snapshots] == [6, 11, 12]
    assert record.n_frames == 2 * 3
    np.testing.assert_array_equal(record.world_from_map, np.zeros(3))
    assert np.isnan(record.truth).all()


def test_slam_hears_radars_less_their_gains_and_observers_as_they_are() -> None:
    """6.02 dB are a factor of two, so the limits and what lies at them stay equal."""
    heard: list[RadarFrame] = []

    class Hearing(LateSlam):
        def step(
            self, frames: Sequence[RadarFrame], pose_at: PoseAt, t_ns: int
        ) -> tuple[StepResult, ...]:
            heard.extend(frames)
            return super().step(frames, pose_at, t_ns)

    ends = [TumSample(t_ns=t_ns, x_m=0.0, y_m=0.0, qz=0.0, qw=1.0) for t_ns in (0, FRAME_NS)]
    made = scan(0)
    low, high = (
        float(limit) for limit in (made.frames[1].samples.min(), made.frames[1].samples.max())
    )
    made = replace(made, frames=(made.frames[0], replace(made.frames[1], limits=(low, high))))
    run_slam(
        [made],
        OdometryTrack(ends),
        cast(UwbRadarSlam, Hearing()),
        nobody_knows,
        gains_db=[0.0, 20.0 * math.log10(2.0)],
    )
    as_it_was, halved = heard
    assert as_it_was is made.frames[0]
    np.testing.assert_allclose(halved.samples, made.frames[1].samples / 2.0, rtol=1e-6)
    assert halved.samples.dtype == np.float32
    assert halved.limits == (float(halved.samples.min()), float(halved.samples.max()))

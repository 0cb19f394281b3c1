"""How long the front end takes per frame, and one SLAM step against the size of the map."""

import math
import time

import numpy as np
import pytest
from numpy.typing import NDArray
from pytest_benchmark.fixture import BenchmarkFixture
from threadpoolctl import threadpool_limits

from emulator.scene.scene import load_scene
from hil_tests.unit.slam.simulation import BIN_LENGTH_M, frame_of
from slam.app.rig.emulated import FRAME_RATE_HZ, RAW_CONFIG, open_loopback
from slam.config import (
    AssociationConfig,
    ClusteringConfig,
    DetectionConfig,
    FrontEnd,
    SlamConfig,
    TrilaterationConfig,
    load_preset,
)
from slam.frames import RadarFrame
from slam.front_end import make_detector
from slam.front_end.paper import PaperDetector
from slam.geometry import paper_rig
from slam.paper.association import update_map
from slam.paper.clustering import CollectedState, filter_window
from slam.paper.ekf import predict, update
from slam.paper.trilateration import Trilaterator
from slam.results import Belief, Fix
from xethru_protocol.operating_system import StopFlag

Array = NDArray[np.float64]
Q = np.diag([0.15**2, 1.0])


def frame(radar: int) -> RadarFrame:
    """Return a frame of 1431 bins with four echoes, 30 dB for the strongest."""
    labels = 0.2 + BIN_LENGTH_M * np.arange(1431)
    samples = 5e-4 * np.random.default_rng(radar).standard_normal(1431)
    for range_m in (0.6, 1.0, 2.0, 4.0):
        envelope = 0.015 * np.exp(-0.5 * ((labels - range_m) / 0.0517) ** 2)
        samples += envelope * np.cos(2 * math.pi * (labels - range_m) / 0.02056)
    return frame_of(samples.astype(np.float32), radar=radar)


def large_belief(n: int) -> Belief:
    """Return n landmarks around the pose with a full covariance."""
    rng = np.random.default_rng(n)
    size = 3 + 2 * n
    root = 0.1 * rng.standard_normal((size, 40)) / math.sqrt(40)
    covariance = root @ root.T + 1e-3 * np.eye(size)
    return Belief(
        mean=np.concatenate([np.zeros(3), rng.uniform(-20, 20, 2 * n)]),
        covariance=(covariance + covariance.T) / 2,
        landmark_ids=tuple(range(n)),
        next_id=n,
    )


@pytest.mark.parametrize("name", list(FrontEnd))
@pytest.mark.benchmark(group="front end, one frame of 1431 bins (bar: 100 us)")
def test_front_end_per_frame(benchmark: BenchmarkFixture, name: FrontEnd) -> None:
    detector = make_detector(SlamConfig(detection=DetectionConfig(front_end=name)))
    one = frame(0)
    benchmark.extra_info["frames"] = 1
    detections = benchmark(detector.detect, one)
    assert len(detections) >= 2


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lab", "store"])
@pytest.mark.benchmark(
    group="preset robust: front end, 50 scans of a scene (bar: lab 250 us a frame, store 400)",
    timer=time.process_time,
)
def test_front_end_of_a_scene(benchmark: BenchmarkFixture, name: str) -> None:
    """Frames of a scene have clutter, echoes that overlap, and pulses that are cut."""
    scene = load_scene(name)
    with open_loopback(scene, seed=5) as radars:
        radars.start(RAW_CONFIG, FRAME_RATE_HZ)
        ticks = radars.scans(400, StopFlag())
        scans = [scan.frames for tick, scan in enumerate(ticks) if tick % 8 == 0]
    detector = make_detector(load_preset("robust"))

    def detect() -> int:
        found = [detector.detect_many(frames, [0.0] * len(frames)) for frames in scans]
        return sum(len(detections) for of_scan in found for detections in of_scan)

    benchmark.extra_info["frames"] = sum(map(len, scans))
    with threadpool_limits(1):
        detect()  # the pulses are estimated then
        assert benchmark(detect) > len(scans)


@pytest.mark.parametrize(
    ("name", "n"), [(FrontEnd.PAPER, 16), (FrontEnd.MATCHED_FILTER, 4), (FrontEnd.JOINT, 4)]
)
@pytest.mark.benchmark(group="front end, n frames of 1431 bins at once (bar: n x 100 us)")
def test_front_end_batched(benchmark: BenchmarkFixture, name: FrontEnd, n: int) -> None:
    detector = make_detector(SlamConfig(detection=DetectionConfig(front_end=name)))
    scan, offsets_m = [frame(radar) for radar in range(n)], [0.0] * n
    benchmark.extra_info["frames"] = n
    found = benchmark(detector.detect_many, scan, offsets_m)
    assert all(len(detections) >= 2 for detections in found)


@pytest.mark.benchmark(group="trilateration of one pose")
def test_trilateration_per_pose(benchmark: BenchmarkFixture) -> None:
    detector, trilaterator = (
        PaperDetector(DetectionConfig()),
        Trilaterator(TrilaterationConfig(), paper_rig()),
    )
    detections = [d for radar in range(4) for d in detector.detect(frame(radar))]
    assert benchmark(trilaterator.locate, detections, 0)


@pytest.mark.benchmark(group="outlier filter, one window")
def test_outlier_filter_per_window(benchmark: BenchmarkFixture) -> None:
    rng = np.random.default_rng(0)
    detection = PaperDetector(DetectionConfig()).detect(frame(0))[0]
    window = [
        CollectedState(
            t_ns=k,
            odometry_pose=np.array([0.01 * k, 0.0, 0.0]),
            detections=(),
            fixes=tuple(
                Fix(pair=0, t_ns=k, x_m=x, y_m=y, detections=(detection, detection))
                for x, y in ([0.0, 1.0], [0.3, -0.8]) + 0.03 * rng.standard_normal((2, 2))
            ),
        )
        for k in range(15)
    ]
    filtered = benchmark(filter_window, window, ClusteringConfig())
    assert len(filtered.observations) == 2


@pytest.mark.parametrize("n", [100, 300, 1000])
@pytest.mark.benchmark(group="SLAM step: predict and 4 updates")
def test_slam_step(benchmark: BenchmarkFixture, n: int) -> None:
    belief = large_belief(n)
    u, R = np.array([0.01, 0.0, 0.01]), np.diag([1e-6, 1e-6, 4e-4])
    seen = [np.array([math.hypot(*xy), math.atan2(xy[1], xy[0])]) for xy in belief.landmarks[:4]]

    def step() -> Belief:
        after = predict(belief, u, R)
        for row, observed in enumerate(seen):
            after = update(after, row, observed, Q)
        return after

    with threadpool_limits(1):
        assert np.isfinite(benchmark(step).mean).all()


@pytest.mark.parametrize("n", [14, 100, 1000])
@pytest.mark.benchmark(group="association and update of one observation")
def test_association(benchmark: BenchmarkFixture, n: int) -> None:
    belief = large_belief(n)
    config = AssociationConfig()
    x, y = belief.landmarks[0]
    seen = [np.array([math.hypot(x, y), math.atan2(y, x)])]
    with threadpool_limits(1):
        _, (association,) = benchmark(update_map, belief, seen, Q, config)
    assert not association.is_new

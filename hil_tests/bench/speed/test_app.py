"""Speed of a whole run in process, and of what logs and viewer cost per frame.

Bars (design, quality bars): whole pipeline in process, four radars at 5 Hz, at least 100 times
real time with synthesis and 200 times without. `extra_info` carries the factor.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from hil_tests.system.short_scene import write_short_scene
from hil_tests.unit.slam.app.sessions import scan, session_info, snapshot, source_of_scans
from slam.app.rig.emulated import (
    FRAME_RATE_HZ,
    RAW_CONFIG,
    end_tick,
    open_loopback,
    rig_of,
    scene_and_config,
)
from slam.app.run.radar_image import RollingImage
from slam.app.run.runner import execute
from slam.app.session.writer import SessionLog
from slam.app.sweep.run import make_case, source_of
from slam.app.view.session_view import RerunView
from slam.live.odometry_track import OdometryTrack, TumSample
from slam.live.session_records import SessionObserver
from slam.paper.pipeline import UwbRadarSlam
from xethru_protocol.operating_system import StopFlag

N_SCANS = 512
Result = TypeVar("Result")


def repeat(benchmark: BenchmarkFixture, run: Callable[[], Result]) -> Result:
    """Time three rounds after one that warms up; return the last result."""
    result: Result = benchmark.pedantic(  # type: ignore[no-untyped-call]  # unannotated there
        run, rounds=3, warmup_rounds=1
    )
    return result


def test_whole_pipeline_with_synthesis(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    scene = str(write_short_scene(tmp_path))
    record = repeat(benchmark, lambda: execute(source_of(make_case(scene, "paper", 0))))
    benchmark.extra_info["times_real_time"] = record.duration_ns / 1e9 / record.wall_s


def test_whole_pipeline_without_synthesis(benchmark: BenchmarkFixture, tmp_path: Path) -> None:
    scene, config = scene_and_config(str(write_short_scene(tmp_path)), "paper")
    trajectory = scene.trajectory()
    with open_loopback(scene, 0) as source:
        source.start(RAW_CONFIG, FRAME_RATE_HZ)
        scans = list(source.scans(end_tick(trajectory.duration_ns), StopFlag()))
    poses = trajectory.poses
    # perfect odometry: only its length matters here
    track = OdometryTrack(
        TumSample(t_ns=s.t_ns, x_m=0.002 * 5 * s.counter, y_m=0.0, qz=0.0, qw=1.0) for s in scans
    )

    def run() -> float:
        slam = UwbRadarSlam(config, rig_of(scene))
        record = execute(source_of_scans(scans, track, slam, poses, source.radars))
        return record.duration_ns / 1e9 / record.wall_s

    benchmark.extra_info["times_real_time"] = repeat(benchmark, run)


@pytest.mark.parametrize("kind", ["mcap", "rerun"])
def test_logging_1024_frames(benchmark: BenchmarkFixture, tmp_path: Path, kind: str) -> None:
    scans = [scan(counter) for counter in range(N_SCANS)]

    def log() -> None:
        observer = (
            SessionLog(
                tmp_path / "s.mcap",
                session_info(),
                OdometryTrack((TumSample(t_ns=0, x_m=0.0, y_m=0.0, qz=0.0, qw=1.0),)),
            )
            if kind == "mcap"
            else RerunView(tmp_path / "s.rrd", session_info())
        )
        for one in scans:
            observer.on_scan(one)
        observer.close()

    repeat(benchmark, log)


@pytest.mark.benchmark(
    group="the radar image while driving, 200 scans of four radars (bar: 160 ms)",
    timer=time.process_time,
)
def test_rolling_image(benchmark: BenchmarkFixture) -> None:
    """1 cm from frame to frame along a straight leg of 2 m, the image given out every 5 s."""
    info = session_info(4)
    poses = [replace(snapshot(0), t_ns=scan(k).t_ns, counter=k) for k in range(200)]
    scans = [scan(k, 4) for k in range(200)]
    track = OdometryTrack(
        TumSample(t_ns=one.t_ns, x_m=0.01 * one.counter, y_m=0.0, qz=0.0, qw=1.0) for one in scans
    )

    def image() -> int:
        rolling = RollingImage(info, track, [SessionObserver()])
        for one, pose in zip(scans, poses, strict=True):
            rolling.on_scan(one)
            rolling.on_snapshot(pose)
        rolling.close()
        return rolling.n_patches

    assert repeat(benchmark, image) >= 4 * 6

"""Four radars that are not synchronised, on a robot that turns: real echoes, real driver.

Between rods a robot drives a small square and turns on the spot. Odometry is the truth and the
front end's ranges are at the Cramer-Rao bound of quiet receivers, so what is left in the fixes is
the error of the sample times and below a millimetre of noise.
"""

import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.scene.scene import LeakageSpec, NoiseSpec, PathSpec, RadarSpec, Scene, TargetSpec
from emulator.scene.wheels import odometry_times_ns, tum_line
from hil_tests.unit.slam.app.sessions import source_of_scans
from slam.app.rig.emulated import (
    FRAME_RATE_HZ,
    RAW_CONFIG,
    EmulatorProcess,
    end_tick,
    open_loopback,
    open_ports,
    rig_of,
)
from slam.app.run.runner import execute
from slam.app.sweep.run import StepKeeper
from slam.config import FrontEnd, SampleTime, load_preset, override
from slam.live.odometry_track import OdometryTrack
from slam.live.session_records import Scan
from slam.paper.pipeline import UwbRadarSlam
from slam.results import StepResult
from xethru_protocol.operating_system import StopFlag

NO_SKEW_MS = (0.0, 0.0, 0.0, 0.0)
RECIPE_MS = (0.0, 190.0, 100.0, 150.0)
PERIODS_MS = (0.0, 390.0, 1100.0, 550.0)
"""More than a frame period of 199 ms apart."""
RF_SIGMA = 5e-5
"""A tenth of the default: the bearing of a pair magnifies the noise of its ranges."""
NOISE_M = 0.002
"""Of a fix at least half of the time."""


def scene_of(skews_ms: Sequence[float]) -> Scene:
    """Return four turns of 90 degrees, a rod 1.1 m away in the middle of each radar's sweep."""
    mounts = ((-0.1, 0.2, 90.0), (0.1, 0.2, 90.0), (-0.1, -0.2, -90.0), (0.1, -0.2, -90.0))
    radars = tuple(
        RadarSpec(
            name=f"radar_{index}",
            serial=f"00000000020{index}",
            x_m=x_m,
            y_m=y_m,
            yaw_deg=yaw_deg,
            start_skew_ms=skew_ms,
        )
        for index, ((x_m, y_m, yaw_deg), skew_ms) in enumerate(zip(mounts, skews_ms, strict=True))
    )
    rods = ((1.38, -0.78), (1.38, 1.38), (-0.78, 1.38))
    return Scene(
        name="turning",
        environment="lab",
        description="A small square, a rod beside its corners.",
        radars=radars,
        targets=tuple(
            TargetSpec(name=f"rod_{index}", kind="rod", x_m=x_m, y_m=y_m)
            for index, (x_m, y_m) in enumerate(rods)
        ),
        path=PathSpec(
            waypoints_m=((0.0, 0.0), (0.6, 0.0), (0.6, 0.6), (0.0, 0.6)),
            laps=("forward",),
            speed_mps=0.2,
        ),
        leakage=LeakageSpec(),
        noise=NoiseSpec(rf_sigma=RF_SIGMA),
    )


def results_of(
    skews_ms: Sequence[float], sample_time: SampleTime, *, lose: bool = False
) -> tuple[StepResult, ...]:
    """Run the scene in process; `lose` every third frame of one radar."""
    scene = scene_of(skews_ms)
    trajectory = scene.trajectory()
    config = override(
        load_preset("paper"),
        {
            "trilateration.sample_time": sample_time.value,
            "detection.front_end": FrontEnd.MATCHED_FILTER.value,
            "window.size": 1,
            "window.min_turn_rad": 0.05,
        },
    )
    times = odometry_times_ns(trajectory.duration_ns, scene.odometry.rate_hz)
    track = OdometryTrack.from_lines(map(tum_line, times.tolist(), trajectory.poses(times)))
    with open_loopback(scene, 0) as source:
        source.start(RAW_CONFIG, FRAME_RATE_HZ)
        scans: Iterable[Scan] = source.scans(end_tick(trajectory.duration_ns), StopFlag())
        scans = without_some(scans) if lose else scans
        kept = StepKeeper()
        slam = UwbRadarSlam(config, rig_of(scene))
        execute(source_of_scans(scans, track, slam, trajectory.poses, source.radars), [kept])
        return tuple(kept.steps)


def without_some(scans: Iterable[Scan]) -> Iterator[Scan]:
    for scan in scans:
        kept = tuple(f for f in scan.frames if f.radar != 3 or f.counter % 3)
        yield replace(scan, frames=kept)


def median_error_m(results: Iterable[StepResult]) -> float:
    """Return the median distance of fixes to the rod they mean, truth by complex numbers."""
    scene = scene_of(NO_SKEW_MS)
    rods = np.array([complex(rod.x_m, rod.y_m) for rod in scene.targets])
    errors = []
    for result in results:
        ((x_m, y_m, heading_rad),) = scene.trajectory().poses(np.array([result.t_ns]))
        for fix in result.fixes:
            there = complex(x_m, y_m) + np.exp(1j * heading_rad) * complex(fix.x_m, fix.y_m)
            errors.append(np.abs(rods - there).min())
    assert len(errors) > 20
    return float(np.median(errors))


def test_own_times_undo_the_skew() -> None:
    """Medians measured: 0.3 mm in step, 72 mm when skew is ignored, 0.6 mm at their own times."""
    assert median_error_m(results_of(NO_SKEW_MS, SampleTime.NOMINAL)) < NOISE_M
    assert median_error_m(results_of(RECIPE_MS, SampleTime.NOMINAL)) > 20 * NOISE_M
    assert median_error_m(results_of(RECIPE_MS, SampleTime.OWN)) < NOISE_M


def test_so_they_do_beyond_a_frame_period_and_with_frames_lost() -> None:
    results = results_of(PERIODS_MS, SampleTime.OWN, lose=True)
    assert median_error_m(results) < NOISE_M
    # A state without one radar has no fix of its pair, and the others keep theirs.
    without = [r for r in results if 3 not in {d.radar for d in r.detections} and r.fixes == ()]
    assert without


def test_in_step_the_rule_changes_no_bit() -> None:
    nominal, own = (results_of(NO_SKEW_MS, rule) for rule in SampleTime)
    assert [r.belief.mean.tobytes() for r in own] == [r.belief.mean.tobytes() for r in nominal]
    assert [[(f.x_m, f.y_m) for f in r.fixes] for r in own] == [
        [(f.x_m, f.y_m) for f in r.fixes] for r in nominal
    ]


@pytest.mark.slow
def test_through_ports_stamps_and_samples_are_those_in_process(tmp_path: Path) -> None:
    """The ready line tells each radar's skew; nothing else could, before frames are timed."""
    scene = scene_of(RECIPE_MS)
    (path := tmp_path / "turning.toml").write_text(toml_of(scene))
    n_ticks = 12

    def content(scans: Iterable[Scan]) -> list[tuple[int, int, int, bytes]]:
        return [
            (scan.t_ns, frame.counter, frame.t_ns, frame.samples.tobytes())
            for scan in scans
            for frame in scan.frames
        ]

    with EmulatorProcess(str(path), 0) as emulator:
        emulator.wait_until_ready(StopFlag())
        assert [device.start_skew_ns for device in emulator.devices] == [
            round(skew_ms * 1e6) for skew_ms in RECIPE_MS
        ]
        with open_ports(emulator.devices, rig_of(scene), lambda name, record: None) as source:
            source.start(RAW_CONFIG, FRAME_RATE_HZ)
            through_ports = content(source.scans(n_ticks, StopFlag()))
    with open_loopback(scene, 0) as source:
        source.start(RAW_CONFIG, FRAME_RATE_HZ)
        assert through_ports == content(source.scans(n_ticks, StopFlag()))
    stamps_ns: NDArray[np.int64] = np.array([row[2] - row[0] for row in through_ports])
    assert set(stamps_ns.tolist()) == {round(skew_ms * 1e6) for skew_ms in RECIPE_MS}


def toml_of(scene: Scene) -> str:
    path = scene.path.model_dump()
    lines = [f"{key} = {json.dumps(getattr(scene, key))}" for key in ("name", "environment")]
    lines += [f"description = {json.dumps(scene.description)}", "[path]"]
    lines += [f"{key} = {json.dumps(path[key])}" for key in ("waypoints_m", "laps", "speed_mps")]
    lines += ["[noise]", f"rf_sigma = {scene.noise.rf_sigma}"]
    for name, rows in (("radars", scene.radars), ("targets", scene.targets)):
        for row in rows:
            lines.append(f"[[{name}]]")
            set_by_us = row.model_dump(include=row.model_fields_set)
            lines += [f"{key} = {json.dumps(value)}" for key, value in set_by_us.items()]
    return "\n".join(lines) + "\n"

"""SLAM estimates the same, to the last bit, in another world that sends the same frames."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.scene.scene import (
    BurstSpec,
    ClutterSpec,
    JitterSpec,
    MultipathSpec,
    NoiseSpec,
    PulseSpec,
    Scene,
    TargetSpec,
    WallSpec,
    WanderSpec,
    load_scene,
)
from slam.app.rig.emulated import outlines_m, rig_of, true_landmarks_m, wheels_of
from slam.app.run.runner import RunRecord, RunSource, execute
from slam.app.sweep.run import make_case, source_of
from slam.library.slam import make_slam

N_SCANS = 200


def planted(scene: Scene) -> Scene:
    """Return a world with other values of every key that SLAM does not get."""
    radars = tuple(
        radar.model_copy(
            update={
                "range_offset_m": 0.013 * (index - 1.5),
                "gain_db": 3.0,
                "mount_error_m": (0.02, -0.01),
                "mount_error_deg": 3.0,
                "stamp_sigma_ms": 50.0,
                "clock_ppm": 20.0,
                "pulse": PulseSpec(width=1.3, skew=0.2, ringing=0.3),
                "bursts": BurstSpec(echo_share=0.5),
            }
        )
        for index, radar in enumerate(scene.radars)
    )
    targets = tuple(
        TargetSpec(
            name=f"other_{index}",
            kind="cylinder",
            x_m=target.y_m + 0.4,
            y_m=-target.x_m,
            amplitude_1m=0.1,
            radius_m=0.12,
            wander=WanderSpec(range_m=0.01, fading=0.4),
        )
        for index, target in enumerate(scene.targets[::-1])
    )
    wall = WallSpec(name="wall", from_m=(-1.0, -1.0), to_m=(3.0, -1.0))
    slippery = {"slips_per_s": 0.1, "slip_sigma_m": 0.1, "walk_per_sqrt_s": 0.1}
    other = scene.model_copy(
        update={
            "name": "elsewhere",
            "radars": radars,
            "targets": targets,
            "walls": (wall,),
            "multipath": MultipathSpec(target_pairs=0.5),
            "odometry": scene.odometry.model_copy(update=slippery),
            "noise": NoiseSpec(rf_sigma=2e-3),
            "clutter": ClutterSpec(sigma=1e-3),
            "jitter": JitterSpec(white_rad=0.1),
        }
    )
    return Scene.model_validate(other.model_dump())


def another_truth(t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    return np.column_stack([1e-9 * t_ns, np.full(len(t_ns), 7.0), np.ones(len(t_ns))])


def elsewhere(source: RunSource, scene: Scene, preset: str) -> RunSource:
    """Return a run of the same frames and odometry in a planted world, with a SLAM of its own."""
    world = planted(scene)
    case = make_case("lab", preset, 0)
    radars = tuple(
        replace(radar, serial=f"{index:012d}", port="elsewhere")
        for index, radar in enumerate(source.info.radars)
    )
    info = replace(
        source.info,
        scene=world.name,
        seed=99,
        radars=radars,
        true_landmarks_m=true_landmarks_m(world),
        outlines_m=outlines_m(world),
    )
    return replace(
        source,
        info=info,
        rig=rig_of(world),
        slam=make_slam(case.config, rig_of(world), wheels_of(world)),
        truth_at=another_truth,
    )


def bits_of(record: RunRecord) -> list[bytes]:
    assert record.last is not None
    states, last = record.states, record.last
    arrays = [states.t_ns, states.estimate, states.pose_covariances, last.landmark_ids]
    arrays += [last.landmarks_m, last.landmark_covariances_m2, last.wall_spans_m]
    if record.smoothed is not None:
        arrays += [record.smoothed.poses, record.smoothed.landmarks_m]
    return [array.tobytes() for array in arrays]


@pytest.mark.parametrize("preset", ["robust", pytest.param("paper", marks=pytest.mark.rare)])
def test_a_planted_truth_changes_no_bit_of_the_estimate(preset: str) -> None:
    scene = load_scene("lab")
    source = source_of(make_case("lab", preset, 3))
    scans = list(islice(source.scans, N_SCANS))
    other = elsewhere(replace(source, scans=scans), scene, preset)
    assert rig_of(planted(scene)) == rig_of(scene)
    assert wheels_of(planted(scene)) == wheels_of(scene)
    here, there = execute(replace(source, scans=scans)), execute(other)
    assert here.last is not None
    assert len(here.last.landmark_ids) > 0
    assert not np.array_equal(here.states.truth, there.states.truth)
    assert bits_of(here) == bits_of(there)

"""Runs in clear air and in smoke, and their observations on odometry poses.

What smoke does to a radar: its particles, at most micrometres, are far smaller than the 41 mm
wavelength, so they absorb by volume and scatter next to nothing (Rayleigh regime; Bohren and
Huffman 1983, section 5.1). Of spheres that fill the share f of space the power is lost at

    alpha = (6 pi / wavelength) f Im((eps - 1) / (eps + 2))  <=  3 pi f / wavelength   per metre,

because the last factor cannot exceed 1/2 for a permittivity whose real part is 1 or more. The runs
in smoke weaken every echo by this bound at the largest range SLAM uses. Chains of soot can absorb
more than spheres; ten times more would change nothing here. What it does to light: 8.7 m2 of
extinction per gram of smoke from flames (Mulholland and Croarkin 2000, Fire and Materials 24).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from emulator.odometry import scene_odometry
from emulator.scene import Scene
from slam.app.emulated_rig import (
    FRAME_RATE_HZ,
    RAW_CONFIG,
    end_counter,
    open_loopback,
    rig_of,
    scene_and_config,
    true_landmarks_m,
)
from slam.app.odometry import OdometryTrack
from slam.app.runner import RunRecord, run_slam
from slam.clustering import Observation
from slam.config import SlamConfig
from slam.geometry import transform
from slam.pipeline import StepResult, UwbRadarSlam
from slam.trilateration import Fix

Array = NDArray[np.float64]

SMOKE_G_PER_M3 = 5.0
"""Assumed: dense, a lit exit sign is lost within half a metre."""
_PARTICLE_G_PER_M3 = 1.8e6
"""Soot; droplets of fog fluid are lighter, and fill more: 1.1e6."""
_WAVELENGTH_M = 299_792_458.0 / 7.29e9
_LIGHT_EXTINCTION_M2_PER_G = 8.7
_LARGEST_RANGE_M = 1.5
_LAB_LAPS = 2
_DB_PER_NEPER_OF_POWER = 10 / math.log(10)


def smoke_attenuation_db(range_m: float, g_per_m3: float = SMOKE_G_PER_M3) -> float:
    """Return the most that smoke can take from an echo there and back [dB]."""
    per_metre = 3 * math.pi / _WAVELENGTH_M * g_per_m3 / _PARTICLE_G_PER_M3
    return _DB_PER_NEPER_OF_POWER * per_metre * 2 * range_m


def light_attenuation_db(range_m: float, g_per_m3: float = SMOKE_G_PER_M3) -> float:
    """Return what smoke takes from a lidar's pulse there and back [dB]."""
    return _DB_PER_NEPER_OF_POWER * _LIGHT_EXTINCTION_M2_PER_G * g_per_m3 * 2 * range_m


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObservedRun:
    """What one run observed, on the poses that odometry gives.

    Attributes
    ----------
    name
        What the run is called.
    n_detections
        Ranges, over all radars and states.
    same_detections
        Share of the states at which all ranges are equal to those in clear air, to the last bit;
        None in another scene.
    raw_m, filtered_m
        Shape (n, 2) each, world frame: every fix, and what the outlier filter made of them.
    raw_rms_m, filtered_rms_m
        Root mean square distance to the nearest true landmark on *true* poses: of the observation
        alone, without the drift of odometry. None where nothing was seen.
    odometry_m, truth_m
        Shape (n, 2) each, world frame: the path.
    landmarks_m
        Shape (m, 2), world frame.
    """

    name: str
    n_detections: int
    same_detections: float | None
    raw_m: Array
    filtered_m: Array
    raw_rms_m: float | None
    filtered_rms_m: float | None
    odometry_m: Array
    truth_m: Array
    landmarks_m: Array

    def numbers(self) -> dict[str, object]:
        """Return what goes into the JSON file."""
        return {
            "name": self.name,
            "detections": self.n_detections,
            "states_with_the_detections_of_clear_air": self.same_detections,
            "raw_fixes": len(self.raw_m),
            "filtered_observations": len(self.filtered_m),
            "raw_rms_m": self.raw_rms_m,
            "filtered_rms_m": self.filtered_rms_m,
        }


def drive_in_clear_air_and_smoke(
    *,
    seed: int,
    laps: int | None = None,
    check: Callable[[], None] = lambda: None,
) -> tuple[ObservedRun, ...]:
    """Return the runs: clear air, smoke, smoke under other receiver noise, and the lab.

    The first two share receiver noise and odometry, so what differs is the smoke's doing; the
    third tells how much another noise of the receivers does. The lab, in clear air, is there for
    its ghosts: with one landmark there are none.

    Parameters
    ----------
    seed
        Of the odometry's drift and the receivers' noise.
    laps
        How many laps to drive; in the smoke scene all, in the lab two if not given.
    check
        Asked at every scan; may raise to stop.
    """
    clear, config = scene_and_config("smoke", "paper")
    lab, lab_config = scene_and_config("lab", "paper")
    clear, lab = _laps(clear, laps), _laps(lab, _LAB_LAPS if laps is None else laps)
    smoke = in_smoke(clear)
    cells = (
        ("clear air", clear, config, seed),
        ("smoke", smoke, config, seed),
        ("smoke, other noise", smoke, config, seed + 1),
        ("lab, clear air", lab, lab_config, seed),
    )
    runs: list[ObservedRun] = []
    for name, scene, settings, noise_seed in cells:
        record = _drive(scene, settings, seed=seed, noise_seed=noise_seed, check=check)
        if not runs:
            reference = record
        runs.append(_observed(name, scene, record, reference if scene is not lab else None))
    return tuple(runs)


def in_smoke(scene: Scene) -> Scene:
    """Return a scene whose targets echo as weakly as smoke can make them."""
    factor = 10 ** (-smoke_attenuation_db(_LARGEST_RANGE_M) / 20)
    return scene.model_copy(
        update={
            "targets": tuple(
                target.model_copy(update={"amplitude_1m": factor * target.amplitude_1m})
                for target in scene.targets
            )
        }
    )


def _laps(scene: Scene, laps: int | None) -> Scene:
    path = scene.path.model_copy(update={"laps": scene.path.laps[:laps]})
    return scene.model_copy(update={"path": path})


def _drive(
    scene: Scene, config: SlamConfig, *, seed: int, noise_seed: int, check: Callable[[], None]
) -> RunRecord:
    trajectory = scene.trajectory()
    odometry = OdometryTrack.from_lines(scene_odometry(scene, seed))
    with open_loopback(scene, noise_seed) as source:
        source.start(RAW_CONFIG, FRAME_RATE_HZ)
        scans = source.scans(end_counter(trajectory.duration_ns), check)
        slam = UwbRadarSlam(config, rig_of(scene))
        return run_slam(scans, odometry, slam, trajectory.poses)


def _observed(
    name: str, scene: Scene, record: RunRecord, reference: RunRecord | None
) -> ObservedRun:
    landmarks_m = true_landmarks_m(scene)
    results = record.results
    start = record.world_from_map
    raw = [result.fixes for result in results]
    filtered = [result.observations for result in results]
    on_odometry = np.array([result.odometry_pose for result in results])
    return ObservedRun(
        name=name,
        n_detections=sum(len(result.detections) for result in results),
        same_detections=None if reference is None else _same(results, reference.results),
        raw_m=transform(start, _placed(on_odometry, raw)),
        filtered_m=transform(start, _placed(on_odometry, filtered)),
        raw_rms_m=_rms_m(_placed(record.truth, raw), landmarks_m),
        filtered_rms_m=_rms_m(_placed(record.truth, filtered), landmarks_m),
        odometry_m=transform(start, on_odometry[:, :2]),
        truth_m=record.truth[:, :2],
        landmarks_m=landmarks_m,
    )


def _same(results: Sequence[StepResult], reference: Sequence[StepResult]) -> float:
    ranges = {
        result.t_ns: [(each.radar, each.range_m) for each in result.detections]
        for result in reference
    }
    same = [
        ranges.get(result.t_ns) == [(each.radar, each.range_m) for each in result.detections]
        for result in results
    ]
    return float(np.mean(same))


def _placed(poses: Array, points: Sequence[Sequence[Fix | Observation]]) -> Array:
    """Return the points of all poses in the frame of the poses, shape (n, 2)."""
    placed = [
        transform(pose, np.array([(each.x_m, each.y_m) for each in of_pose]))
        for pose, of_pose in zip(poses, points, strict=True)
        if of_pose
    ]
    return np.concatenate(placed) if placed else np.empty((0, 2))


def _rms_m(points: Array, landmarks_m: Array) -> float | None:
    if not len(points):
        return None
    gaps = np.linalg.norm(points[:, np.newaxis] - landmarks_m[np.newaxis], axis=2).min(axis=1)
    return float(np.sqrt(np.mean(gaps**2)))

"""The paper's smoke experiment, and its figure of the outlier filter on odometry poses.

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

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from emulator.scene.scene import Scene
from slam.app.experiments import Result, table
from slam.app.rig.emulated import rig_of, scene_and_config, true_landmarks_m
from slam.app.run.output import mm_text
from slam.app.run.pictures import ESTIMATE, INK, LANDMARK, ODOMETRY, TRUTH, label
from slam.app.run.runner import RunRecord, execute
from slam.app.sweep.run import Steps, first_laps, loopback_source
from slam.geometry import transform
from slam.paper.pipeline import UwbRadarSlam
from slam.results import Fix, Observation, StepResult
from xethru_protocol.system import StopFlag

Array = NDArray[np.float64]

SMOKE_G_PER_M3 = 5.0
"""Assumed: dense, a lit exit sign is lost within half a metre."""
_PARTICLE_G_PER_M3 = 1.8e6
"""Soot; droplets of fog fluid are lighter, and fill more: 1.1e6."""
_WAVELENGTH_M = 299_792_458.0 / 7.29e9
_LIGHT_EXTINCTION_M2_PER_G = 8.7
_LARGEST_RANGE_M = 1.5
_DB_PER_NEPER_OF_POWER = 10 / math.log(10)
_SHOWN = ("clear air", "smoke", "lab, clear air")


def smoke_attenuation_db(range_m: float, g_per_m3: float = SMOKE_G_PER_M3) -> float:
    """Return the most that smoke can take from an echo there and back [dB]."""
    per_metre = 3 * math.pi / _WAVELENGTH_M * g_per_m3 / _PARTICLE_G_PER_M3
    return _DB_PER_NEPER_OF_POWER * per_metre * 2 * range_m


def light_attenuation_db(range_m: float, g_per_m3: float = SMOKE_G_PER_M3) -> float:
    """Return what smoke takes from a lidar's pulse there and back [dB]."""
    return _DB_PER_NEPER_OF_POWER * _LIGHT_EXTINCTION_M2_PER_G * g_per_m3 * 2 * range_m


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObservedRun:
    """What one run observed, on the poses that odometry gives; places in the world frame."""

    name: str
    n_detections: int  # over all radars and states
    # states with the ranges of clear air to the last bit; None elsewhere
    same_detections: float | None
    raw_m: Array  # (n, 2): every fix
    filtered_m: Array  # (n, 2): what the outlier filter made of them
    # distance to the nearest landmark, seen from the true pose; None without a fix
    raw_rms_m: float | None
    filtered_rms_m: float | None  # the same of the observations
    odometry_m: Array  # (n, 2): the path
    truth_m: Array  # (n, 2): the path
    landmarks_m: Array  # (m, 2)


def drive_in_clear_air_and_smoke(seed: int, stop: StopFlag) -> list[ObservedRun]:
    """Return the runs: clear air, smoke, smoke under other receiver noise, and the lab.

    The first two share receiver noise and odometry, so what differs is the smoke's doing; the
    third shows the effect of other receiver noise. The lab, two laps in clear air, is there for
    its ghosts: with one landmark there are none.
    """
    clear, config = scene_and_config("smoke", "paper")
    lab, lab_config = scene_and_config("lab", "paper")
    lab, smoke = first_laps(lab, 2), in_smoke(clear)
    runs: list[ObservedRun] = []
    for name, scene, settings, noise_seed in (
        ("clear air", clear, config, seed),
        ("smoke", smoke, config, seed),
        ("smoke, other noise", smoke, config, seed + 1),
        ("lab, clear air", lab, lab_config, seed),
    ):
        slam = UwbRadarSlam(settings, rig_of(scene))
        kept = Steps()
        record = execute(
            loopback_source(scene, "paper", slam, seed, noise_seed=noise_seed, stop=stop), [kept]
        )
        if not runs:
            reference = kept.steps
        same_as = reference if scene is not lab else None
        runs.append(_observed(name, scene, record, kept.steps, same_as))
    return runs


def in_smoke(scene: Scene) -> Scene:
    """Return a scene whose targets echo as weakly as smoke can make them."""
    factor = 10 ** (-smoke_attenuation_db(_LARGEST_RANGE_M) / 20)
    targets = tuple(
        target.model_copy(update={"amplitude_1m": factor * target.amplitude_1m})
        for target in scene.targets
    )
    return scene.model_copy(update={"targets": targets})


def _observed(
    name: str,
    scene: Scene,
    record: RunRecord,
    results: Sequence[StepResult],
    reference: Sequence[StepResult] | None,
) -> ObservedRun:
    landmarks_m = true_landmarks_m(scene)
    states = record.states
    start = record.world_from_map
    raw = [result.fixes for result in results]
    filtered = [result.observations for result in results]
    on_odometry = states.odometry
    return ObservedRun(
        name=name,
        n_detections=sum(len(result.detections) for result in results),
        same_detections=None if reference is None else _same(results, reference),
        raw_m=transform(start, _placed(on_odometry, raw)),
        filtered_m=transform(start, _placed(on_odometry, filtered)),
        raw_rms_m=_rms_m(_placed(states.truth, raw), landmarks_m),
        filtered_rms_m=_rms_m(_placed(states.truth, filtered), landmarks_m),
        odometry_m=transform(start, on_odometry[:, :2]),
        truth_m=states.truth[:, :2],
        landmarks_m=landmarks_m,
    )


def _same(results: Sequence[StepResult], reference: Sequence[StepResult]) -> float:
    theirs = {result.t_ns: _ranges(result) for result in reference}
    return float(np.mean([theirs.get(result.t_ns) == _ranges(result) for result in results]))


def _ranges(result: StepResult) -> list[tuple[int, float]]:
    return [(each.radar, each.range_m) for each in result.detections]


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


def _draw_runs(figure: Figure, runs: Sequence[ObservedRun]) -> None:
    shown = [run for run in runs if run.name in _SHOWN]
    panels = figure.subplots(2, len(shown), sharex="col", sharey="col")
    for column, run in zip(panels.T, shown, strict=True):
        for axes, points, colour, what, error_m in (
            (column[0], run.raw_m, ESTIMATE, "raw", run.raw_rms_m),
            (column[1], run.filtered_m, LANDMARK, "filtered", run.filtered_rms_m),
        ):
            _draw(axes, run, points, colour)
            label(
                axes,
                f"{run.name}: {len(points)} {what}, {mm_text(error_m)} off",
                "x [m]" if axes is column[1] else "",
                "y [m]" if run is shown[0] else "",
            )
    raw, _ = panels[0, 0].get_legend_handles_labels()
    figure.legend(
        [*raw, panels[1, 0].get_lines()[-1]],
        ["wheel odometry", "true path", "true landmark", "raw fix", "filtered observation"],
        loc="outside lower center",
        ncols=5,
        frameon=False,
        title="off: root mean square distance to the nearest landmark, seen from the true pose",
        title_fontsize=9,
    )


def _draw(axes: Axes, run: ObservedRun, points: Array, colour: str) -> None:
    axes.set_aspect("equal", adjustable="box")
    axes.plot(*run.odometry_m.T, color=ODOMETRY, linewidth=0.8, label="odometry")
    axes.plot(*run.truth_m.T, color=TRUTH, linewidth=2.4, alpha=0.5, label="truth")
    x, y = run.landmarks_m.T
    axes.plot(x, y, "+", markersize=12, markeredgewidth=1.4, color=INK, zorder=4, label="landmark")
    x, y = points.T
    axes.plot(x, y, ".", markersize=3.0, alpha=0.5, color=colour, label="seen")


def run(arguments: argparse.Namespace, stop: StopFlag) -> Result:
    seed: int = arguments.seed
    runs = drive_in_clear_air_and_smoke(seed, stop)
    radar_db = smoke_attenuation_db(_LARGEST_RANGE_M)
    light_db = light_attenuation_db(_LARGEST_RANGE_M)
    columns = {
        "run": [row.name for row in runs],
        "detections": [str(row.n_detections) for row in runs],
        "states as in clear air": [
            "-" if row.same_detections is None else f"{row.same_detections:.4f}" for row in runs
        ],
        "raw fixes": [str(len(row.raw_m)) for row in runs],
        "filtered": [str(len(row.filtered_m)) for row in runs],
        "raw error": [mm_text(row.raw_rms_m) for row in runs],
        "filtered error": [mm_text(row.filtered_rms_m) for row in runs],
    }
    return Result(
        numbers={
            "simulated": True,
            "seed": seed,
            "smoke_g_per_m3": SMOKE_G_PER_M3,
            "attenuation_to_1_5_m_and_back_db": {"radar_at_most": radar_db, "light": light_db},
            "runs": [
                {
                    "name": row.name,
                    "detections": row.n_detections,
                    "states_with_the_detections_of_clear_air": row.same_detections,
                    "raw_fixes": len(row.raw_m),
                    "filtered_observations": len(row.filtered_m),
                    "raw_rms_m": row.raw_rms_m,
                    "filtered_rms_m": row.filtered_rms_m,
                }
                for row in runs
            ],
        },
        title="Observations on wheel-odometry poses, before and after the paper's DBSCAN filter "
        f"(simulated, seed {seed})",
        size_in=(10.4, 7.4),
        draw=lambda figure: _draw_runs(figure, runs),
        tables=[
            table(
                f"seed {seed}: simulated numbers. Smoke of {SMOKE_G_PER_M3:g} g/m3 takes at most "
                f"{radar_db:.4f} dB from a radar's echo 1.5 m away, and {light_db:.0f} dB from a "
                "lidar's",
                columns,
            )
        ],
    )

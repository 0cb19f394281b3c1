"""Draw the paper's smoke experiment: observations in clear air and in smoke, raw and filtered.

`smoke.png` shows fixes and filtered observations on the poses of wheel odometry. All runs are
simulated: the scene `smoke` in clear air, in smoke, and in smoke with other receiver noise (printed
only), and two laps of `lab`, whose several landmarks make ghosts.

What smoke does to a radar: its particles, at most micrometres, are far smaller than the 41 mm
wavelength, so they absorb by volume and scatter next to nothing (Rayleigh regime; Bohren and
Huffman 1983, section 5.1). Of spheres that fill the share f of space the power is lost at

    alpha = (6 pi / wavelength) f Im((eps - 1) / (eps + 2))  <=  3 pi f / wavelength   per metre,

because the last factor cannot exceed 1/2 for a permittivity whose real part is 1 or more. The runs
in smoke weaken every echo by this bound at the largest range SLAM uses. Chains of soot can absorb
more than spheres; ten times more would change nothing here.
"""

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from emulator.scene.scene import Scene, load_scene
from slam.app.rig.emulated import rig_of, true_landmarks_m
from slam.app.run.pictures import ESTIMATE, INK, LANDMARK, ODOMETRY, TRUTH, label, picture
from slam.app.run.runner import States, execute
from slam.app.sweep.run import StepKeeper, first_laps, loopback_source
from slam.config import load_preset
from slam.geometry import transform
from slam.paper.pipeline import UwbRadarSlam
from slam.results import Fix, Observation, StepResult

Array = NDArray[np.float64]

SMOKE_G_PER_M3 = 5.0  # assumed: dense, a lit exit sign is lost within half a metre
PARTICLE_G_PER_M3 = 1.8e6  # soot; droplets of fog fluid are lighter, and fill more: 1.1e6
WAVELENGTH_M = 299_792_458.0 / 7.29e9
LARGEST_RANGE_M = 1.5


def smoke_attenuation_db(range_m: float, g_per_m3: float = SMOKE_G_PER_M3) -> float:
    """Return the most that smoke can take from an echo there and back [dB]."""
    per_metre = 3 * math.pi / WAVELENGTH_M * g_per_m3 / PARTICLE_G_PER_M3
    return 10 / math.log(10) * per_metre * 2 * range_m


def in_smoke(scene: Scene) -> Scene:
    """Return a scene whose targets echo as weakly as smoke can make them."""
    factor = 10 ** (-smoke_attenuation_db(LARGEST_RANGE_M) / 20)
    targets = tuple(
        target.model_copy(update={"amplitude_1m": factor * target.amplitude_1m})
        for target in scene.targets
    )
    return scene.model_copy(update={"targets": targets})


class Run(NamedTuple):
    """What one run observed, in the frame in which it began."""

    states: States
    steps: Sequence[StepResult]
    start: Array  # (3,): that frame in the world
    landmarks_m: Array  # (n, 2), world frame

    def placed_m(self, points: Sequence[Sequence[Fix | Observation]]) -> tuple[Array, float]:
        """Return the points of all states on the poses of odometry, world frame, shape (n, 2).

        Beside them the RMS of their distances to the nearest landmark on the true poses.
        """
        local = [np.array([(each.x_m, each.y_m) for each in of]).reshape(-1, 2) for of in points]
        on_odometry, on_truth = (
            np.concatenate([transform(*pair) for pair in zip(poses, local, strict=True)])
            for poses in (self.states.odometry, self.states.truth)
        )
        gaps_m = np.linalg.norm(on_truth[:, np.newaxis] - self.landmarks_m, axis=2).min(axis=1)
        return transform(self.start, on_odometry), float(np.sqrt(np.mean(gaps_m**2)))

    def same_detections(self, other: "Run") -> float:
        """Return the share of states with the other's ranges to the last bit."""
        ours, theirs = (
            {step.t_ns: [(each.radar, each.range_m) for each in step.detections] for step in steps}
            for steps in (self.steps, other.steps)
        )
        return sum(ranges == theirs.get(t_ns) for t_ns, ranges in ours.items()) / len(ours)


def drive(scene: Scene, *, seed: int, noise_seed: int) -> Run:
    """Drive through a scene; `seed` is that of odometry, `noise_seed` that of the receivers."""
    slam = UwbRadarSlam(load_preset("paper", scene.environment), rig_of(scene))
    source, kept = loopback_source(scene, "paper", slam, seed, noise_seed=noise_seed), StepKeeper()
    record = execute(source, [kept])
    return Run(record.states, kept.steps, record.world_from_map, true_landmarks_m(scene))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/studies"), help="folder to write to")
    parser.add_argument("--seed", type=int, default=0, help="seed of receiver noise and odometry")
    given = parser.parse_args()
    seed, clear, lab = given.seed, load_scene("smoke"), first_laps(load_scene("lab"), 2)
    # The first two differ by the smoke only, the third shows the effect of other receiver noise.
    air = drive(clear, seed=seed, noise_seed=seed)
    smoke = drive(in_smoke(clear), seed=seed, noise_seed=seed)
    other = drive(in_smoke(clear), seed=seed, noise_seed=seed + 1)
    ghosts = drive(lab, seed=seed, noise_seed=seed)
    print(f"{SMOKE_G_PER_M3:g} g/m3: at most {smoke_attenuation_db(LARGEST_RANGE_M):.4f} dB")
    same, chance = smoke.same_detections(air), other.same_detections(air)
    print(f"states with the detections of clear air: {same:.4f}, with other noise {chance:.4f}")
    title = "Observations on wheel-odometry poses, before and after the paper's DBSCAN filter "
    title += f"(simulated, seed {seed})"
    with picture(given.out / "smoke.png", width_in=10.4, height_in=7.4, title=title) as figure:
        panels = figure.subplots(2, 3, sharex="col", sharey="col")
        shown = {"clear air": air, "smoke": smoke, "lab, clear air": ghosts}
        for column, (name, run) in zip(panels.T, shown.items(), strict=True):
            odometry_m = transform(run.start, run.states.odometry[:, :2])
            raw, filtered = zip(*((s.fixes, s.observations) for s in run.steps), strict=True)
            seen = (("raw", raw, ESTIMATE), ("filtered", filtered, LANDMARK))
            for axes, (what, points, colour) in zip(column, seen, strict=True):
                places_m, rms_m = run.placed_m(points)
                axes.plot(*odometry_m.T, color=ODOMETRY, linewidth=0.8)
                axes.plot(*run.states.truth[:, :2].T, color=TRUTH, linewidth=2.4, alpha=0.5)
                axes.plot(*run.landmarks_m.T, "+", markersize=12, color=INK, zorder=4)
                axes.plot(*places_m.T, ".", markersize=3.0, alpha=0.5, color=colour)
                axes.set_aspect("equal", adjustable="box")
                text = f"{name}: {len(places_m)} {what}, {1e3 * rms_m:.1f} mm off"
                label(axes, text, "x [m]" if what == "filtered" else "", "y [m]")
        names = ["wheel odometry", "true path", "true landmark", "raw fix", "filtered observation"]
        lines = [*panels[0, 0].get_lines(), panels[1, 0].get_lines()[-1]]
        note = "off: root mean square distance to the nearest landmark, seen from the true pose"
        figure.legend(lines, names, loc="outside lower center", ncols=5, frameon=False, title=note)


if __name__ == "__main__":
    main()

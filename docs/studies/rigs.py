"""Print which rig, speed and frame rate SLAM needs, as rows of two tables in Markdown.

All runs are simulated: scene `lab`, preset `robust`, two laps; each row is the median of several
seeds. The first rows leave out modules of the paper's rig, the others vary speed and frame rate.
Errors are RMS position errors of the aligned path; recall counts the landmarks that these modules
could see.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from statistics import median

from emulator.scene.scene import Scene
from slam.app.run.output import mm_text, share_text
from slam.app.sweep.run import make_case, run_case

LEFT, RIGHT = ("left_front", "left_rear"), ("right_front", "right_rear")
RIGS = {
    "one, to the left": LEFT[:1],
    "two, both to the left": LEFT,
    "two, one to each side": (LEFT[0], RIGHT[0]),
    "three, two of them to the left": (*LEFT, RIGHT[0]),
    "four, two to each side": (*LEFT, *RIGHT),
}
# Metres per second, and frames per second of each module.
DRIVES = ((0.05, 5), (0.1, 5), (0.1, 10), (0.2, 5), (0.2, 20), (0.3, 5), (0.3, 20))


def with_radars(scene: Scene, names: tuple[str, ...]) -> Scene:
    radars = tuple(radar for radar in scene.radars if radar.name in names)
    return scene.model_copy(update={"radars": radars})


def at_speed(scene: Scene, speed_mps: float) -> Scene:
    """Return a scene whose robot drives at another speed, and turns as much faster."""
    ratio = speed_mps / scene.path.speed_mps
    turning = scene.path.turn_rate_deg_per_s * ratio
    path = scene.path.model_copy(update={"speed_mps": speed_mps, "turn_rate_deg_per_s": turning})
    return scene.model_copy(update={"path": path})


def rows() -> Iterator[tuple[str, Scene, int]]:
    """Yield what a row is called, its scene, and its frame rate."""
    lab = make_case("lab", "robust", 0, laps=2).scene
    for name, radars in RIGS.items():
        yield name, with_radars(lab, radars), 5
    for speed_mps, fps in DRIVES:
        name = f"{speed_mps:g} m/s, {fps} frames/s: {1000 * speed_mps / fps:.0f} mm a frame"
        yield name, at_speed(lab, speed_mps), fps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    seeds = parser.parse_args().seeds
    for name, scene, fps in rows():
        case = replace(make_case("lab", "robust", 0, laps=2), scene=scene, fps=fps)
        runs = [run_case(each) for each in case.with_seeds(seeds)]
        lengths = (
            median(run.odometry_ate_rmse_m for run in runs),
            median(run.ate_rmse_m for run in runs),
            median(run.smoothed_ate_rmse_m or run.ate_rmse_m for run in runs),
        )
        recall = median(run.landmarks.recall or 0.0 for run in runs)
        print(
            f"| {name} | {' | '.join(map(mm_text, lengths))} | {share_text(recall)} |", flush=True
        )


if __name__ == "__main__":
    main()

"""Draw what window, minimum count and search radius of the paper's outlier filter trade off.

`filter.png` has a row per scene and a panel per parameter, varied about Table I, with the shares of
fixes that the filter keeps. The first lap of each scene is simulated, with preset `paper`.

A fix is made of two ranges. It is *true* if one landmark explains both, a *ghost* if each range is
explained, but by different landmarks, and *clutter* otherwise: noise, walls, echoes that came by
way of walls. Explained means within `EXPLAINED_M` of the true distance from the radar.
"""

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from emulator.scene.scene import Scene, load_scene
from slam.app.rig.emulated import rig_of, true_landmarks_m
from slam.app.run.output import print_table
from slam.app.run.pictures import ESTIMATE, LANDMARK, ODOMETRY, TRUTH, label, picture
from slam.app.run.runner import execute
from slam.app.sweep.run import StepKeeper, first_laps, loopback_source
from slam.config import load_preset, override
from slam.geometry import transform
from slam.live.odometry_track import NS_PER_S
from slam.paper.clustering import CollectedState, filter_window
from slam.paper.pipeline import UwbRadarSlam
from slam.results import Fix

Array = NDArray[np.float64]

EXPLAINED_M = 0.03  # four standard deviations of the paper's front end
WRONG_M = 0.15  # an observation farther from every landmark is wrong; the metric's radius


class Setting(NamedTuple):
    """One setting of the filter, in the paper's terms."""

    window_size: int = 15
    min_opc: int = 9
    search_rad_m: float = 0.2


TABLE_I = Setting()
VARIED = {
    "window_size": [TABLE_I._replace(window_size=size) for size in (9, 12, 15, 20, 30)],
    "min_opc": [TABLE_I._replace(min_opc=count) for count in (3, 6, 9, 12, 15)],
    "search_rad_m": [TABLE_I._replace(search_rad_m=rad) for rad in (0.025, 0.05, 0.1, 0.2, 0.4)],
}
SHARES = {
    "true": ("true fixes kept", ESTIMATE),
    "ghost": ("ghosts kept (ranges of two landmarks)", ODOMETRY),
    "clutter": ("other false fixes kept", TRUTH),
    "wrong": ("observations > 15 cm off", LANDMARK),
}


class Lap(NamedTuple):
    """What one lap saw: every state with all its fixes."""

    scene: str
    states: tuple[CollectedState, ...]  # in time order
    truth: Array  # (n_states, 3): true poses, world frame
    origins: tuple[tuple[str, ...], ...]  # of the fixes of each state
    landmarks_m: Array  # (m, 2), world frame


class Outcome(NamedTuple):
    """What one setting did; a share is NaN where there is nothing to divide by.

    Fixes are kept if some cluster confirmed them; those are judged whose window was complete.
    """

    shares: Mapping[str, float]  # of fixes kept by origin, and of observations that are wrong
    n_observations: int
    latency_s: float  # median time from a state to the newest one of its window


def drive(scene: str, seed: int) -> Lap:
    """Drive the first lap of a scene, by its name or file."""
    lap = first_laps(load_scene(scene), 1)
    # With a window of one state each comes out as it is collected.
    config = override(load_preset("paper", lap.environment), {"window.size": 1})
    kept, slam = StepKeeper(), UwbRadarSlam(config, rig_of(lap))
    truth = execute(loopback_source(lap, "paper", slam, seed), [kept]).states.truth
    names = ("t_ns", "odometry_pose", "detections", "fixes")
    states = tuple(CollectedState(**{n: getattr(step, n) for n in names}) for step in kept.steps)
    origins = tuple(origins_of(one.fixes, p, lap) for one, p in zip(states, truth, strict=True))
    return Lap(lap.name, states, truth, origins, true_landmarks_m(lap))


def origins_of(fixes: Sequence[Fix], pose: Array, scene: Scene) -> tuple[str, ...]:
    """Return what each fix of a state with this true pose is of, see above."""
    mounts = np.array([(mount.x_m, mount.y_m) for mount in rig_of(scene).mounts])
    offsets = transform(pose, mounts)[:, np.newaxis] - true_landmarks_m(scene)
    true_m = np.linalg.norm(offsets, axis=2) - [target.radius_m for target in scene.targets]
    origins = []
    for fix in fixes:
        one, two = (abs(true_m[d.radar] - d.range_m) <= EXPLAINED_M for d in fix.detections)
        is_ghost = one.any() and two.any()
        origins.append("true" if (one & two).any() else "ghost" if is_ghost else "clutter")
    return tuple(origins)


def outcome(lap: Lap, setting: Setting) -> Outcome:
    """Return what a setting of the filter makes of a lap."""
    clustering = load_preset("paper").clustering.model_copy(
        update={"min_observations": setting.min_opc, "search_radius_m": setting.search_rad_m}
    )
    judged: dict[str, list[bool]] = {name: [] for name in SHARES}
    latencies_ns: list[int] = []
    for first in range(len(lap.states) - setting.window_size + 1):
        window = lap.states[first : first + setting.window_size]
        filtered = filter_window(window, clustering)
        rejected = {id(fix) for fix in filtered.rejected}
        for fix, origin in zip(window[0].fixes, lap.origins[first], strict=True):
            judged[origin].append(id(fix) not in rejected)
        points = np.array([(each.x_m, each.y_m) for each in filtered.observations]).reshape(-1, 2)
        offsets = transform(lap.truth[first], points)[:, np.newaxis] - lap.landmarks_m
        judged["wrong"] += (np.linalg.norm(offsets, axis=2).min(axis=1) > WRONG_M).tolist()
        latencies_ns.append(window[-1].t_ns - window[0].t_ns)
    shares = {name: float(np.mean(of)) if of else math.nan for name, of in judged.items()}
    return Outcome(shares, len(judged["wrong"]), float(np.median(latencies_ns)) / NS_PER_S)


def draw(axes: Axes, name: str, outcomes: Mapping[Setting, Outcome]) -> None:
    x, rows = [getattr(s, name) for s in VARIED[name]], [outcomes[s] for s in VARIED[name]]
    for share, (what, colour) in SHARES.items():
        axes.plot(x, [1e2 * row.shares[share] for row in rows], "o-", color=colour, label=what)
    axes.axvline(getattr(TABLE_I, name), color=TRUTH, linewidth=0.9, linestyle="--")
    axes.set_ylim(-4, 104)
    if name == "window_size":
        latencies = [f"{row.latency_s:.1f} s" for row in rows]
        axes.set_xticks(
            x, [f"{size}\n{latency}" for size, latency in zip(x, latencies, strict=True)]
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/studies"), help="folder to write to")
    parser.add_argument("--seed", type=int, default=0, help="seed of receiver noise and odometry")
    parser.add_argument("--scene", nargs="+", default=["lab", "two_rooms"], help="names or files")
    given = parser.parse_args()
    settings = dict.fromkeys(each for varied in VARIED.values() for each in varied)
    laps = [drive(scene, given.seed) for scene in given.scene]
    outcomes = [{setting: outcome(lap, setting) for setting in settings} for lap in laps]
    title = "The paper's DBSCAN filter, one parameter varied at a time; dashed: Table I "
    title += f"(one lap, simulated, seed {given.seed})"
    path, height_in = given.out / "filter.png", 1.3 + 3.1 * len(laps)
    with picture(path, width_in=10.4, height_in=height_in, title=title) as figure:
        panels = figure.subplots(len(laps), len(VARIED), squeeze=False, sharey=True)
        names = ("window_size [states], and its latency", "min_opc [fixes]", "search_rad [m]")
        for row, lap, of_lap in zip(panels, laps, outcomes, strict=True):
            for axes, varied, name in zip(row, VARIED, names, strict=True):
                draw(axes, varied, of_lap)
                label(axes, f"{lap.scene}: {varied}", name, "share [%]")
        legend = panels[0, 0].get_legend_handles_labels()
        figure.legend(*legend, loc="outside lower center", ncols=4, frameon=False)
    for lap, of_lap in zip(laps, outcomes, strict=True):
        shares = [[f"{share:.2f}" for share in each.shares.values()] for each in of_lap.values()]
        rows = [(str(tuple(key)), *row) for key, row in zip(of_lap, shares, strict=True)]
        header, title = (str(Setting._fields), *SHARES), "fixes kept, and wrong observations"
        print_table(f"{lap.scene}: shares of {title}", header, rows)


if __name__ == "__main__":
    main()

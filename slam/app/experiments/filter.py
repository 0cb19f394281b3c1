"""What window, minimum count and search radius of the paper's outlier filter trade off.

A fix is made of two ranges. It is *true* if one landmark explains both, a *ghost* if each range is
explained, but by different landmarks, and *clutter* otherwise: noise, walls, echoes that came by
way of walls. Explained means within ``EXPLAINED_M`` of the true distance from the radar.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from enum import Enum

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from emulator.scene.scene import Scene
from slam.app.experiments import Result, table
from slam.app.odometry.track import NS_PER_S
from slam.app.rig.emulated import rig_of, scene_and_config, true_landmarks_m
from slam.app.run.output import share_text
from slam.app.run.pictures import ESTIMATE, LANDMARK, ODOMETRY, PALE_INK, TRUTH, label
from slam.app.run.runner import execute
from slam.app.sweep.run import Steps, first_laps, loopback_source
from slam.config import load_preset, override
from slam.geometry import Rig, transform
from slam.paper.clustering import CollectedState, filter_window
from slam.paper.pipeline import UwbRadarSlam
from slam.results import Fix
from xethru_protocol.system import StopFlag

Array = NDArray[np.float64]

EXPLAINED_M = 0.03
"""Four standard deviations of the paper's front end."""
WRONG_M = 0.15
"""An observation farther from every landmark is wrong; the metric's radius of a match."""


class Origin(Enum):
    """What a fix is of, see the module."""

    TRUE = "true"
    GHOST = "ghost"
    CLUTTER = "clutter"


@dataclass(frozen=True, slots=True, kw_only=True)
class Setting:
    """One setting of the filter, in the paper's terms."""

    window_size: int
    min_opc: int
    search_rad_m: float

    def __str__(self) -> str:
        return f"{self.window_size}, {self.min_opc}, {1e2 * self.search_rad_m:g} cm"


TABLE_I = Setting(window_size=15, min_opc=9, search_rad_m=0.2)
SETTINGS = tuple(
    dict.fromkeys(
        [
            *(replace(TABLE_I, window_size=size) for size in (9, 12, 15, 20, 30)),
            *(replace(TABLE_I, min_opc=count) for count in (3, 6, 9, 12, 15)),
            *(replace(TABLE_I, search_rad_m=radius) for radius in (0.025, 0.05, 0.1, 0.2, 0.4)),
        ]
    )
)
"""One parameter at a time around Table I."""


_PARAMETERS: Mapping[str, tuple[str, Callable[[Setting], float]]] = {
    "window_size": ("window_size [states], and its latency", lambda s: s.window_size),
    "min_opc": ("min_opc [fixes]", lambda s: s.min_opc),
    "search_rad": ("search_rad [cm]", lambda s: 1e2 * s.search_rad_m),
}
"""What is varied: the name of the axis, and the number on it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Seen:
    """What one lap saw."""

    scene: str
    states: tuple[CollectedState, ...]  # in time order
    truth: Array  # (n_states, 3): true poses, world frame
    origins: tuple[tuple[Origin, ...], ...]  # of the fixes of each state
    landmarks_m: Array  # (m, 2), world frame

    def count(self, origin: Origin) -> int:
        return sum(each is origin for of_state in self.origins for each in of_state)


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What one setting did; shares are None where there is nothing to divide by.

    Fixes are kept if some cluster confirmed them; those are judged whose window was complete.
    """

    setting: Setting
    true_kept: float | None
    ghosts_kept: float | None
    clutter_kept: float | None
    n_observations: int
    wrong_observations: float | None  # farther than WRONG_M from every landmark, on true poses
    latency_s: float  # median time from a state to the newest one of its window


def drive(scene: str, *, seed: int, stop: StopFlag) -> Seen:
    """Drive the first lap of a scene and return every state with all its fixes."""
    loaded, config = scene_and_config(scene, "paper")
    lap = first_laps(loaded, 1)
    rig = rig_of(lap)
    # With a window of one state each comes out as it is collected.
    alone = override(config, {"window.size": 1})
    kept = Steps()
    slam = UwbRadarSlam(alone, rig)
    record = execute(loopback_source(lap, "paper", slam, seed, stop=stop), [kept])
    truth = record.states.truth
    return Seen(
        scene=lap.name,
        states=tuple(
            CollectedState(
                t_ns=result.t_ns,
                odometry_pose=result.odometry_pose,
                detections=result.detections,
                fixes=result.fixes,
            )
            for result in kept.steps
        ),
        truth=truth,
        origins=tuple(
            _origins(result.fixes, pose, rig, lap)
            for result, pose in zip(kept.steps, truth, strict=True)
        ),
        landmarks_m=true_landmarks_m(lap),
    )


def _origins(fixes: Sequence[Fix], pose: Array, rig: Rig, scene: Scene) -> tuple[Origin, ...]:
    if not fixes or not scene.targets:
        return (Origin.CLUTTER,) * len(fixes)
    antennas = transform(pose, np.array([(mount.x_m, mount.y_m) for mount in rig.mounts]))
    targets = true_landmarks_m(scene)
    radii = np.array([target.radius_m for target in scene.targets])
    true_m = np.linalg.norm(antennas[:, np.newaxis] - targets[np.newaxis], axis=2) - radii
    origins = []
    for fix in fixes:
        first, second = (
            np.abs(true_m[each.radar] - each.range_m) <= EXPLAINED_M for each in fix.detections
        )
        if (first & second).any():
            origins.append(Origin.TRUE)
        elif first.any() and second.any():
            origins.append(Origin.GHOST)
        else:
            origins.append(Origin.CLUTTER)
    return tuple(origins)


def outcome(seen: Seen, setting: Setting, stop: StopFlag) -> Outcome:
    """Return what a setting of the filter makes of the states."""
    clustering = load_preset("paper").clustering.model_copy(
        update={"min_observations": setting.min_opc, "search_radius_m": setting.search_rad_m}
    )
    kept = dict.fromkeys(Origin, 0)
    judged = dict.fromkeys(Origin, 0)
    errors_m: list[float] = []
    latencies_ns: list[int] = []
    for first in range(len(seen.states) - setting.window_size + 1):
        stop.check()
        window = seen.states[first : first + setting.window_size]
        filtered = filter_window(window, clustering)
        rejected = {id(fix) for fix in filtered.rejected}
        for fix, origin in zip(window[0].fixes, seen.origins[first], strict=True):
            judged[origin] += 1
            kept[origin] += id(fix) not in rejected
        if filtered.observations:
            points = np.array([(each.x_m, each.y_m) for each in filtered.observations])
            errors_m += _distances_m(transform(seen.truth[first], points), seen.landmarks_m)
        latencies_ns.append(window[-1].t_ns - window[0].t_ns)
    share = {origin: kept[origin] / judged[origin] if judged[origin] else None for origin in Origin}
    wrong = float(np.mean(np.array(errors_m) > WRONG_M)) if errors_m else None
    return Outcome(
        setting=setting,
        true_kept=share[Origin.TRUE],
        ghosts_kept=share[Origin.GHOST],
        clutter_kept=share[Origin.CLUTTER],
        n_observations=len(errors_m),
        wrong_observations=wrong,
        latency_s=float(np.median(latencies_ns)) / NS_PER_S if latencies_ns else 0.0,
    )


def _distances_m(points: Array, landmarks_m: Array) -> list[float]:
    """Return how far each point is from the nearest landmark; infinite where there is none."""
    gaps = np.linalg.norm(points[:, np.newaxis] - landmarks_m[np.newaxis], axis=2)
    distances: list[float] = gaps.min(axis=1, initial=np.inf).tolist()
    return distances


def _draw(figure: Figure, studies: Sequence[tuple[Seen, Sequence[Outcome]]]) -> None:
    panels = figure.subplots(len(studies), len(_PARAMETERS), squeeze=False, sharey=True)
    for row, (seen, outcomes) in zip(panels, studies, strict=True):
        for axes, name in zip(row, _PARAMETERS, strict=True):
            _draw_varied(axes, name, outcomes)
            label(axes, f"{seen.scene}: {name}", _PARAMETERS[name][0], "share [%]")
    handles, names = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=4, frameon=False)


def _draw_varied(axes: Axes, name: str, outcomes: Sequence[Outcome]) -> None:
    _, value = _PARAMETERS[name]
    others = [other for key, (_, other) in _PARAMETERS.items() if key != name]
    varied = sorted(
        (row for row in outcomes if all(other(row.setting) == other(TABLE_I) for other in others)),
        key=lambda row: value(row.setting),
    )
    x = [value(row.setting) for row in varied]
    for field, colour, what in (
        ("true_kept", ESTIMATE, "true fixes kept"),
        ("ghosts_kept", ODOMETRY, "ghosts kept (ranges of two landmarks)"),
        ("clutter_kept", TRUTH, "other false fixes kept"),
        ("wrong_observations", LANDMARK, "observations > 15 cm off"),
    ):
        shares = [getattr(row, field) for row in varied]
        percent = [math.nan if share is None else 1e2 * share for share in shares]
        axes.plot(x, percent, marker="o", markersize=4, linewidth=1.4, color=colour, label=what)
    axes.axvline(value(TABLE_I), color=PALE_INK, linewidth=0.9, linestyle="--")
    axes.set_ylim(-4, 104)
    if name == "window_size":
        axes.set_xticks(x, [f"{row.setting.window_size}\n{row.latency_s:.1f} s" for row in varied])


def run(arguments: argparse.Namespace, stop: StopFlag) -> Result:
    for scene in arguments.scene:
        scene_and_config(scene, "paper")  # a bad one is refused before the first is driven
    studies = []
    for scene in arguments.scene:
        seen = drive(scene, seed=arguments.seed, stop=stop)
        studies.append((seen, [outcome(seen, setting, stop) for setting in SETTINGS]))
    return Result(
        numbers={
            "simulated": True,
            "seed": arguments.seed,
            "scenes": [
                {
                    "scene": seen.scene,
                    "states": len(seen.states),
                    "true_fixes": seen.count(Origin.TRUE),
                    "ghosts": seen.count(Origin.GHOST),
                    "clutter": seen.count(Origin.CLUTTER),
                    "settings": [asdict(row) for row in rows],
                }
                for seen, rows in studies
            ],
        },
        title="The paper's DBSCAN filter, one parameter varied at a time; dashed: Table I "
        f"(one lap, simulated, seed {arguments.seed})",
        size_in=(10.4, 1.3 + 3.1 * len(studies)),
        draw=lambda figure: _draw(figure, studies),
        tables=[
            table(
                f"{seen.scene}, one lap, seed {arguments.seed}: {seen.count(Origin.TRUE)} true "
                f"fixes, {seen.count(Origin.GHOST)} ghosts, {seen.count(Origin.CLUTTER)} others: "
                "simulated numbers",
                {
                    "window, min_opc, search_rad": [str(row.setting) for row in rows],
                    "true kept": [share_text(row.true_kept) for row in rows],
                    "ghosts kept": [share_text(row.ghosts_kept) for row in rows],
                    "others kept": [share_text(row.clutter_kept) for row in rows],
                    "observations": [str(row.n_observations) for row in rows],
                    "wrong": [share_text(row.wrong_observations) for row in rows],
                    "latency": [f"{row.latency_s:.1f} s" for row in rows],
                },
            )
            for seen, rows in studies
        ],
    )

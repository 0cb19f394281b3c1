"""Localise a robot in the map of an earlier day: ``python -m hil_tests.bench.second_day lab``.

On the first day an emulated robot maps a scene. On the second, two of its targets stand elsewhere,
one is new, the wheels err otherwise, and the robot begins anywhere on its course, in either
direction, without being told where. The table has the way until it knew, errors since then (of the
causal pose, map frame, not aligned), the share of states reported as lost, and whether any state
was confidently wrong: not lost, more than 15 cm off, and outside 99.9 % of its covariance.
"""

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from emulator.scene.scene import Scene, TargetSpec
from slam.app.rig.emulated import rig_of, wheels_of
from slam.app.run.maps import MapSummary, map_summary
from slam.app.run.runner import RunRecord, execute
from slam.app.sweep.outcomes import LANDMARKS_TO_FIND, confidently_wrong
from slam.app.sweep.run import loopback_source, make_case
from slam.config import SlamConfig
from slam.geometry import PAPERS_FIELD, between, transform
from slam.library.saved_map import MapFile
from slam.library.slam import make_slam
from slam.results import StartOnMap

PRESET = "robust"
SECOND = 1_000_000
"""Added to a seed, it is that of the second day."""
MOVED, NEW = 2, 1


@dataclass(frozen=True, kw_only=True)
class SecondDay:
    """What became of one robot."""

    seed: int
    found: MapSummary
    three_seen_m: float | None
    """Way until a third landmark of the map that had not moved had come into view."""
    wrong_share: float


def mapped(scene: Scene, config: SlamConfig, seed: int) -> MapFile:
    """Drive a scene and return its map."""
    slam = make_slam(config, rig_of(scene), wheels_of(scene))
    record = execute(loopback_source(scene, PRESET, slam, seed))
    saved = slam.saved_map()
    assert saved is not None
    x, y, heading = record.world_from_map.tolist()
    return MapFile(map=saved, world_from_map=(x, y, heading))


def changed(scene: Scene, rng: np.random.Generator) -> Scene:
    """Return a scene in which two targets stand elsewhere, and one more target stands."""
    targets = list(scene.targets)

    def beside(target: TargetSpec) -> TargetSpec:
        """Return a target 0.3 to 0.5 m away that is farther from all others, and off the course."""
        way = np.array([*scene.path.waypoints_m, scene.path.waypoints_m[0]])
        share = np.linspace(0.0, 1.0, 50)[:, None, None]
        course = (way[:-1] + share * np.diff(way, axis=0)).reshape(-1, 2)
        others = np.array([(one.x_m, one.y_m) for one in targets if one is not target])
        for _ in range(1000):
            angle, off_m = rng.uniform(0, math.tau), rng.uniform(0.3, 0.5)
            x, y = target.x_m + off_m * math.cos(angle), target.y_m + off_m * math.sin(angle)
            apart_m = np.hypot(*(others - (x, y)).T).min(initial=math.inf)
            if np.hypot(*(course - (x, y)).T).min() > 0.4 and apart_m > 0.3:
                break
        return target.model_copy(update={"x_m": x, "y_m": y})

    for place in rng.choice(len(targets), MOVED, replace=False).tolist():
        targets[place] = beside(targets[place])
    for place in rng.choice(len(targets), NEW, replace=False).tolist():
        targets.append(beside(targets[place]).model_copy(update={"name": f"new_{place}"}))
    return scene.model_copy(update={"targets": tuple(targets)})


def begun_at(scene: Scene, share: float, *, backward: bool) -> tuple[Scene, np.ndarray]:
    """Return one lap of a scene from a place on its course, and that place in the scene's world.

    The world of a scene begins at the robot, so all in it is moved.
    """
    corners = np.array(scene.path.waypoints_m)
    if backward:
        corners = np.vstack([corners[:1], corners[:0:-1]])
    ways = np.diff(np.vstack([corners, corners[:1]]), axis=0)
    lengths = np.hypot(*ways.T)
    ends = np.cumsum(lengths)
    at_m = share * ends[-1]
    edge = int(np.searchsorted(ends, at_m, side="right"))
    along_m = at_m - (ends[edge] - lengths[edge])
    start = corners[edge] + ways[edge] * along_m / lengths[edge]
    heading = math.atan2(ways[edge, 1], ways[edge, 0])
    pose = np.array([*start, heading])
    into = between(pose, np.zeros(3))  # the scene's world, seen from the robot
    behind = np.vstack([corners[edge + 1 :], corners[: edge + 1]])
    placed = [(x, y) for x, y in transform(into, behind).tolist()]
    placed[0] = (float(lengths[edge] - along_m), 0.0)
    targets = tuple(
        target.model_copy(update=dict(zip(("x_m", "y_m"), place, strict=True)))
        for target, place in zip(
            scene.targets,
            transform(into, np.array([(one.x_m, one.y_m) for one in scene.targets])).tolist(),
            strict=True,
        )
    )
    path = scene.path.model_copy(
        update={"waypoints_m": ((0.0, 0.0), *placed), "laps": ("forward",)}
    )
    return scene.model_copy(update={"path": path, "targets": targets}), pose


def seen_after_m(record: RunRecord, scene: Scene, still: Sequence[int]) -> float | None:
    """Return the way by the wheels until three targets, by index, have come into view."""
    rig, states = rig_of(scene), record.states
    places = np.array([(scene.targets[k].x_m, scene.targets[k].y_m) for k in still])
    seen = np.zeros(len(places), dtype=bool)
    steps_m = np.linalg.norm(np.diff(states.odometry[:, :2], axis=0), axis=1)
    for row, pose in enumerate(states.truth):
        body = transform(between(pose, np.zeros(3)), places)
        for mount in rig.mounts:
            seen |= PAPERS_FIELD.contains(mount, body)
        if seen.sum() >= LANDMARKS_TO_FIND:
            return float(steps_m[:row].sum())
    return None


def second_day(
    scene: Scene, config: SlamConfig, file: MapFile, seed: int, *, is_fixed: bool = False
) -> SecondDay:
    """Drive one lap of a scene that has changed, from anywhere, on the map of the first day."""
    rng = np.random.default_rng([seed, SECOND])
    moved = changed(scene, rng)
    world, pose = begun_at(moved, rng.uniform(), backward=bool(rng.integers(2)))
    assert file.world_from_map is not None
    x, y, heading = between(pose, np.array(file.world_from_map)).tolist()
    placed = replace(file, world_from_map=(x, y, heading))
    slam = make_slam(
        config,
        rig_of(world),
        wheels_of(world),
        on_map=StartOnMap(map=file.map, is_fixed=is_fixed),
    )
    source = replace(loopback_source(world, PRESET, slam, SECOND + seed), map_file=placed)
    record, changes = execute(source), slam.map_changes()
    assert changes is not None
    pairs = zip(scene.targets, moved.targets, strict=False)
    still = [row for row, (before, after) in enumerate(pairs) if before is after]
    return SecondDay(
        seed=seed,
        found=map_summary(placed, changes, record),
        three_seen_m=seen_after_m(record, world, still),
        wrong_share=confidently_wrong(record, None, None),
    )


def line(day: SecondDay) -> str:
    """Return the row of the table."""
    found = day.found
    numbers = [day.three_seen_m, found.found_after_m]
    where = [f"{'-' if value is None else f'{value:.2f}':>7}" for value in numbers]
    errors = [
        f"{'-' if value is None else f'{1e3 * value:.1f}':>7}"
        for value in (found.error_rmse_m, found.error_max_m)
    ]
    shares = f"{100 * found.lost_share:6.1f} {100 * day.wrong_share:6.2f}"
    changes = f"{len(found.seen):3d}/{found.landmarks} {len(found.gone):3d} {len(found.new):3d}"
    return f"{day.seed:4d} {' '.join(where)} {' '.join(errors)} {shares} {changes}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="+", help="such as lab, or rack:0-9")
    parser.add_argument("--seeds", type=int, default=1, help="of each scene")
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--laps", type=int, default=2, help="of the first day")
    parser.add_argument("--localise", action="store_true", help="leave the map as it is")
    arguments = parser.parse_args()
    head = "seed  3 seen   found    rms     max   lost%  wrong% seen gone new  (m, m, mm, mm)"
    print(head)  # noqa: T201 - the result
    days: list[SecondDay] = []
    for name in arguments.scenes:
        family, _, numbers = name.partition(":")
        low, _, high = numbers.partition("-")
        rooms = [name] if not high else [f"{family}:{k}" for k in range(int(low), int(high) + 1)]
        for room in rooms:
            case = make_case(room, PRESET, 0, laps=arguments.laps)
            for seed in range(arguments.first_seed, arguments.first_seed + arguments.seeds):
                file = mapped(case.scene, case.config, seed)
                day = second_day(case.scene, case.config, file, seed, is_fixed=arguments.localise)
                days.append(day)
                print(f"{line(day)}  {room}", flush=True)  # noqa: T201 - the result
    print(totals(days))  # noqa: T201 - the result


def totals(days: Sequence[SecondDay]) -> str:
    """Return the lines below the table."""
    rms_mm = 1e3 * np.array([day.found.error_rmse_m or math.nan for day in days])
    ways = [(day.found.found_after_m, day.three_seen_m) for day in days]
    soon = [found - seen for found, seen in ways if found is not None and seen is not None]
    lines = [f"{len(days)} runs, {np.isfinite(rms_mm).sum()} found their place"]
    if soon:
        lines += [
            f"rms of those: median {np.nanmedian(rms_mm):.1f}, most {np.nanmax(rms_mm):.1f} mm",
            f"way from three in view: median {np.median(soon):.2f}, most {max(soon):.2f} m; "
            f"{sum(way <= 1.0 for way in soon)} within 1 m",
        ]
    wrong = sum(day.wrong_share > 0.0 for day in days)
    return "\n".join([*lines, f"confidently wrong: {wrong} runs"])


if __name__ == "__main__":
    main()

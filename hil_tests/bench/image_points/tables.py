"""The rows of the tables: which scenes are driven, and what each row changes.

`dense`, `walls` and `pillars` have the rooms that the bars name, `fresh` ten rooms of `dense` that
nobody looked at; the others vary one thing in few rooms, clean but for that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from emulator.scene.scene import Scene
from hil_tests.bench.image_points.drives import Row, has_slip, is_turn
from hil_tests.bench.image_points.scoring import MATCH_M
from slam.app.sweep import CLEAN
from slam.app.sweep.run import Case, make_case
from slam.imaging.patches import PatchRule

MODEL_ERROR_M = 0.10
"""Largest distance of a point from its reflector under these stresses."""
MODEL_ERRORS = ("wander_3", "wander_10", "mismatch")
DENSE = ("dense:0", "dense:5")
"""Rooms of the tables that vary one thing."""
FRAME_STRESSES = (
    *(CLEAN, "wander_3", "wander_10", "mismatch", "pulse_wide", "pulse", "mounts", "stamps"),
    *("offsets_20", "rod_rod", "bursts", "walk"),
)
"""Those of what happens inside a patch; slips have a table of their own."""
APERTURES_M = (0.12, 0.20, 0.25, 0.40, 0.60)
# Metres per second, and frames per second.
DRIVES = ((0.05, 5), (0.1, 5), (0.15, 5), (0.25, 5), (0.3, 20))
RIGS = ((2,), (0, 2), (0, 2, 3), (0, 1, 2, 3))
"""Indices of the radars of the paper's rig: the last two look to the right, where the rods are."""


def cases(*scenes: str, stress: str = CLEAN, seeds: int = 1) -> tuple[Case, ...]:
    """Return the cases of scenes; a family followed by two numbers is a span of rooms.

    Points are looked for, and scored, up to the range that the tables of `docs/image.md` are of.
    """
    near = {"detection.max_range_m": "1.5"}
    made = [make_case(scene, "robust", 0, stress=stress, laps=1, settings=near) for scene in scenes]
    return tuple(case for one in made for case in one.with_seeds(seeds))


def rooms(family: str, span: str) -> list[str]:
    """Return the names of rooms: "3" is one, "0-9" are ten."""
    first, _, last = span.partition("-")
    return [f"{family}:{number}" for number in range(int(first), int(last or first) + 1)]


def with_scene(given: Sequence[Case], change: Callable[[Scene], Scene]) -> tuple[Case, ...]:
    return tuple(replace(case, scene=change(case.scene)) for case in given)


def at_speed(speed_mps: float) -> Callable[[Scene], Scene]:
    """Return what makes a scene's robot drive at a speed, and turn as much faster."""

    def change(scene: Scene) -> Scene:
        turning = scene.path.turn_rate_deg_per_s * speed_mps / scene.path.speed_mps
        keys = {"speed_mps": speed_mps, "turn_rate_deg_per_s": turning}
        return scene.model_copy(update={"path": scene.path.model_copy(update=keys)})

    return change


def with_heading_noise(factor: float) -> Callable[[Scene], Scene]:
    def change(scene: Scene) -> Scene:
        wheels = scene.odometry
        keys = {
            key: factor * getattr(wheels, key)
            for key in ("heading_sigma_rad_per_sqrt_m", "heading_sigma_rad_per_rad")
        }
        return scene.model_copy(update={"odometry": wheels.model_copy(update=keys)})

    return change


def with_radars(indices: tuple[int, ...]) -> Callable[[Scene], Scene]:
    def change(scene: Scene) -> Scene:
        return scene.model_copy(update={"radars": tuple(scene.radars[each] for each in indices)})

    return change


def at_rate(given: Sequence[Case], fps: int) -> tuple[Case, ...]:
    return tuple(replace(case, fps=fps) for case in given)


def stressed(scene: str, stress: str, seeds: int = 1) -> Row:
    most_m = MODEL_ERROR_M if stress in MODEL_ERRORS else MATCH_M
    label = scene if stress == CLEAN else f"{scene}, {stress}"
    return Row(label=label, cases=cases(scene, stress=stress, seeds=seeds), most_m=most_m)


def dense_rows() -> Iterator[Row]:
    for room in rooms("dense", "0-9"):
        yield Row(label=room, cases=cases(room))


def fresh_rows() -> Iterator[Row]:
    for room in rooms("dense", "20-29"):
        yield Row(label=room, cases=cases(room))


def aperture_rows() -> Iterator[Row]:
    for length_m in APERTURES_M:
        rule = PatchRule(travel_m=length_m, hop_m=length_m / 2)
        yield Row(label=f"{length_m:.2f} m", cases=cases(*DENSE), rule=rule)


def spacing_rows() -> Iterator[Row]:
    for speed_mps, fps in DRIVES:
        label = f"{100 * speed_mps / fps:.1f} cm: {speed_mps:g} m/s at {fps} frames/s"
        driven = with_scene(cases(*DENSE), at_speed(speed_mps))
        yield Row(label=label, cases=at_rate(driven, fps))


def heading_rows() -> Iterator[Row]:
    for factor in (1, 2, 5):
        driven = with_scene(cases(*DENSE), with_heading_noise(factor))
        yield Row(label=f"noise of heading x {factor}", cases=driven)


def slip_rows() -> Iterator[Row]:
    for scene in ("lab", "dense:0"):
        given = cases(scene, stress="slip", seeds=2)
        yield Row(label=f"{scene}, slip, all patches", cases=given)
        yield Row(label=f"{scene}, slip, patches with a slip", cases=given, counts=has_slip)


def stress_rows() -> Iterator[Row]:
    for stress in FRAME_STRESSES:
        yield stressed("lab", stress)
    yield stressed("classroom", "mismatch")
    yield stressed("dense:0", "pulse")


def wall_rows() -> Iterator[Row]:
    for scene in (*rooms("office", "0-9"), "store", "walls", "two_rooms"):
        yield stressed(scene, CLEAN)


def pillar_rows() -> Iterator[Row]:
    for scene in rooms("pillars", "0-4"):
        yield stressed(scene, CLEAN)


def people_rows() -> Iterator[Row]:
    given = cases(*rooms("people", "0-2"))
    yield Row(label="two people who walk", cases=given)
    alone = with_scene(given, lambda scene: scene.model_copy(update={"people": ()}))
    yield Row(label="the same rooms without them", cases=alone)


def turn_rows() -> Iterator[Row]:
    for fps in (5, 10, 20):
        given = at_rate(cases("lab", *DENSE), fps)
        yield Row(label=f"turning on the spot, {fps} frames/s", cases=given, counts=is_turn)


def radar_rows() -> Iterator[Row]:
    for indices in RIGS:
        driven = with_scene(cases(*DENSE), with_radars(indices))
        yield Row(label=f"radars: {len(indices)}", cases=driven)


TABLES: dict[str, Callable[[], Iterator[Row]]] = {
    "dense": dense_rows,
    "fresh": fresh_rows,
    "aperture": aperture_rows,
    "spacing": spacing_rows,
    "heading": heading_rows,
    "slip": slip_rows,
    "stress": stress_rows,
    "walls": wall_rows,
    "pillars": pillar_rows,
    "people": people_rows,
    "turns": turn_rows,
    "radars": radar_rows,
}

"""Random rooms are what their families promise, the same every time, and scenes like any other."""

import math
from itertools import pairwise

import numpy as np
import pytest

from emulator.scene.rooms import FAMILIES, room_tables
from emulator.scene.scene import Scene, UnknownSceneError, load_scene
from slam.app.sweep import FAMILIES as NAMED

# Third corner of the course, last target, and the sums of all numbers in the tables and of their
# squares, of room 9, from another program with the same laws
PUBLISHED = {
    "pillars": ((3.8805, 1.5176), (4.1734, -0.9614), (104.1125, 33458.8511)),
    "office": ((3.2158, 3.0066), (0.8432, -0.5907), (96.9628, 33557.9073)),
    "dense": ((2.2042, 2.2042), (-0.6944, 0.9818), (111.237, 33428.5668)),
    "loop": ((10.9331, 5.7985), (0.6814, 4.9011), (271.345, 35020.1562)),
    "sparse": ((3.0895, 2.9883), (-0.6095, -0.0249), (61.8707, 33314.6562)),
    "people": ((2.5321, 2.6141), (1.8622, 1.0772), (102.3184, 33413.2142)),
    "rig": ((1.8969, 2.3444), (1.6473, -0.9668), (-190.2691, 54132.9675)),
}
TABLES = ("path", "odometry", "radars", "targets", "walls", "objects", "people")


def numbers_in(table: object) -> list[float]:
    if isinstance(table, dict):
        return numbers_in(list(table.values()))
    if isinstance(table, (list, tuple)):
        return [number for value in table for number in numbers_in(value)]
    return [float(table)] if isinstance(table, (int, float)) else []


def off_course_m(scene: Scene, x: float, y: float) -> float:
    """Return the distance from a point to the closed course, by points 1 mm apart."""
    corners = [*scene.path.waypoints_m, scene.path.waypoints_m[0]]
    nearest = math.inf
    for (ax, ay), (bx, by) in pairwise(corners):
        parts = np.linspace(0, 1, math.ceil(math.dist((ax, ay), (bx, by)) / 1e-3) + 1)
        distances = np.hypot(ax + parts * (bx - ax) - x, ay + parts * (by - ay) - y)
        nearest = min(nearest, float(distances.min()))
    return nearest


@pytest.mark.parametrize("family", FAMILIES)
def test_a_room_is_a_scene_that_can_be_driven(family: str) -> None:
    for number in range(10):
        scene = load_scene(f"{family}:{number}")
        assert scene == load_scene(f"{family}:{number}")
        assert scene.name == f"{family}_{number}"
        assert scene.path.laps == ("forward", "forward")
        for target in scene.targets:
            # chairs stand within the gap
            assert off_course_m(scene, target.x_m, target.y_m) - target.radius_m > 0.34, number


@pytest.mark.parametrize(
    ("family", "count", "near_m", "far_m", "apart_m"),
    [
        ("pillars", 18, 0.5, 1.15, 0.45),
        ("loop", 25, 0.5, 1.15, 0.7),
        ("sparse", 6, 0.5, 1.0, 1.2),
        ("people", 12, 0.55, 1.1, 0.4),
        ("rig", 14, 0.5, 1.1, 0.38),
    ],
)
def test_targets_stand_beside_the_course_and_apart(
    family: str, count: int, near_m: float, far_m: float, apart_m: float
) -> None:
    for number in range(10):
        scene = load_scene(f"{family}:{number}")
        assert len(scene.targets) == count
        places = [(target.x_m, target.y_m) for target in scene.targets]
        for place in places:
            assert near_m - 2e-4 <= off_course_m(scene, *place) <= far_m + 2e-4
        apart = min(math.dist(a, b) for a in places for b in places if a is not b)
        assert apart >= apart_m - 2e-4


def test_families_hold_what_their_descriptions_promise() -> None:
    radii = {t.radius_m for number in range(10) for t in load_scene(f"pillars:{number}").targets}
    assert radii == {0.0, 0.02, 0.05, 0.08, 0.12, 0.15}
    lab, sparse = load_scene("lab").odometry, load_scene("sparse:4").odometry
    assert sparse.scale_sigma == pytest.approx(3 * lab.scale_sigma)
    assert load_scene("loop:4").odometry == lab
    assert len(load_scene("office:1").walls) == 4
    assert len(load_scene("dense:0").targets) == 30
    assert len(load_scene("people:0").people) == 2
    for number in range(10):
        yaws = [radar.yaw_deg for radar in load_scene(f"rig:{number}").radars]
        assert 3 <= len(yaws) <= 6
        assert 60 <= yaws[0] <= 120
        assert -120 <= yaws[1] <= -60


def test_things_of_a_rack_stand_at_one_pitch_on_both_sides_of_an_aisle() -> None:
    aisles = set()
    for number in range(20):
        scene = load_scene(f"rack:{number}")
        places = np.array(sorted((t.y_m, t.x_m) for t in scene.targets))
        rows = np.split(places, np.flatnonzero(np.diff(places[:, 0]) > 0.1) + 1)
        assert len({len(row) for row in rows}) == 1
        pitches = np.concatenate([np.diff(np.sort(row[:, 1])) for row in rows])
        assert pitches.std() < 0.01  # two errors of 3 mm
        assert 0.49 < pitches.mean() < 0.81
        aisles.add(len({y for _, y in scene.path.waypoints_m}))
    assert aisles == {1, 2, 3, 4}


def test_a_corridor_has_eight_frames_and_walls_between_them() -> None:
    for number in range(10):
        scene = load_scene(f"doors:{number}")
        assert len(scene.targets) == 16
        assert len(scene.walls) == 10
        ends = {end for wall in scene.walls for end in (wall.from_m, wall.to_m)}
        assert all((target.x_m, target.y_m) in ends for target in scene.targets)


def test_what_stands_in_rows_of_legs_is_equal() -> None:
    for number in range(10):
        x = sorted({target.x_m for target in load_scene(f"legs:{number}").targets})
        gaps = np.diff(x)
        np.testing.assert_allclose(gaps[::2], gaps[0], atol=3e-4)
        np.testing.assert_allclose(gaps[1::2], gaps[1], atol=3e-4)


def test_columns_are_wide_and_a_yard_is_empty() -> None:
    columns = [target for number in range(20) for target in load_scene(f"columns:{number}").targets]
    assert all(0.05 <= column.radius_m <= 0.4 for column in columns)
    assert max(column.radius_m for column in columns) > 0.35
    yards = [load_scene(f"yard:{number}") for number in range(40)]
    assert {len(yard.targets) for yard in yards} == {0, 1, 2, 3}
    lab = load_scene("lab").odometry.scale_sigma
    assert {round(yard.odometry.scale_sigma / lab) for yard in yards} == {1, 3}


def test_twins_are_one_room_twice() -> None:
    for number in range(10):
        scene = load_scene(f"twins:{number}")
        places = np.array([(target.x_m, target.y_m) for target in scene.targets])
        first, second = np.split(places, 2)
        apart = second - first
        np.testing.assert_allclose(apart, np.broadcast_to(apart[0], apart.shape), atol=3e-4)
        assert apart[0, 0] > 5.0
        assert abs(apart[0, 1]) < 1e-6


def test_rigs_speeds_and_courses_of_deceiving_rooms_vary() -> None:
    rooms = [load_scene(f"{family}:{n}") for family in ("legs", "columns") for n in range(20)]
    assert {len(room.radars) for room in rooms} == {2, 3, 4}
    assert {room.path.speed_mps for room in rooms} == {0.05, 0.3}
    assert {len(room.path.waypoints_m) for room in rooms} == {2, 4, 7, 24}


def test_sensors_and_rig_are_those_of_the_lab() -> None:
    lab, loop = load_scene("lab"), load_scene("loop:4")
    sensors = {"noise", "clutter", "jitter", "leakage"}
    assert loop.model_dump(include=sensors) == lab.model_dump(include=sensors)
    mounts = [
        {(radar.x_m, radar.y_m, radar.yaw_deg) for radar in scene.radars} for scene in (lab, loop)
    ]
    assert mounts[0] == mounts[1]


def test_rooms_are_those_that_results_were_published_for() -> None:
    for family, (corner, place, sums) in PUBLISHED.items():
        scene = load_scene(f"{family}:9")
        last = scene.targets[-1]
        assert (scene.path.waypoints_m[2], (last.x_m, last.y_m)) == (corner, place)
        numbers = numbers_in([room_tables(family, 9)[name] for name in TABLES])
        found = math.fsum(numbers), math.fsum(number * number for number in numbers)
        assert found == pytest.approx(sums, rel=0, abs=1e-4), family
    assert tuple(FAMILIES) == NAMED


@pytest.mark.parametrize("name", ["cellar:3", "pillars:", "pillars:-1", "pillars:10000", "lab:1"])
def test_what_is_no_room_is_refused_by_name(name: str) -> None:
    with pytest.raises(UnknownSceneError):
        load_scene(name)

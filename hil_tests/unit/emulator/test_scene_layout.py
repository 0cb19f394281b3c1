"""The shipped rooms are as described: spacing, visibility, strength, and no symmetry.

Everything here is recomputed from positions in the files, not with the emulator's echo code.
"""

import math
from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.scene.scene import Scene, load_scene
from slam.app.rig.emulated import rig_of

SCENES = ("lab", "classroom", "smoke")
OTHERS = ("corridor", "two_rooms", "symmetric", "hall", "store", "lab_six")
SIDE_M = {"lab": 2.0, "classroom": 3.0, "smoke": 1.4}
LARGEST_RANGE_M = 1.5
HALF_BEAM_RAD = math.radians(65 / 2)
# The paper's detector needs a peak of 5.5e-3 after rectifying and smoothing: 8.6e-3 before.
DETECTABLE = 8.6e-3
WINDOW_POSES = 15
WINDOW_HITS = 9


def positions(scene: Scene) -> NDArray[np.float64]:
    return np.array([(target.x_m, target.y_m) for target in scene.targets])


def distance_to_square(point: NDArray[np.float64], side_m: float) -> float:
    centre = np.abs(point - side_m / 2) - side_m / 2
    outside = float(np.hypot(*np.maximum(centre, 0)))
    return outside if outside > 0 else float(-centre.max())


@pytest.mark.parametrize(
    ("name", "count", "spacing_m"),
    [
        ("lab", 14, 0.35),
        ("classroom", 10, 1.0),
        ("smoke", 1, 0),
        ("corridor", 12, 0.25),
        ("two_rooms", 12, 0.5),
        ("symmetric", 12, 0.6),
        ("hall", 5, 2.4),
        ("store", 14, 0.3),
        ("lab_six", 14, 0.35),
        ("lab_three", 14, 0.35),
    ],
)
def test_targets_are_as_sparse_as_described(name: str, count: int, spacing_m: float) -> None:
    xy = positions(load_scene(name))
    assert len(xy) == count
    assert all(np.hypot(*(a - b)) >= spacing_m for a, b in combinations(xy, 2))


@pytest.mark.parametrize("name", SCENES)
def test_targets_keep_their_distance_from_the_path(name: str) -> None:
    for point in positions(load_scene(name)):
        assert 0.4 <= distance_to_square(point, SIDE_M[name]) <= 1.2


def test_lab_is_cluttered() -> None:
    xy = positions(load_scene("lab"))
    gaps = [np.hypot(*(a - b)) for a, b in combinations(xy, 2)]
    assert sum(gap < 0.5 for gap in gaps) >= 3


def test_the_symmetric_room_is_its_own_mirror_image() -> None:
    scene = load_scene("symmetric")
    places = {(target.x_m, target.y_m, target.amplitude_1m) for target in scene.targets}
    assert {(x, round(2 - y, 9), amplitude) for x, y, amplitude in places} == places


def test_a_room_of_bare_walls_has_no_landmark() -> None:
    scene = load_scene("walls")
    assert not scene.targets
    assert len(scene.walls) == 4


@pytest.mark.parametrize(("name", "count"), [("lab_six", 6), ("lab_three", 3)])
def test_the_lab_with_other_radars_is_the_lab(name: str, count: int) -> None:
    lab, other = load_scene("lab"), load_scene(name)
    changed = {"name", "description", "radars"}
    assert other.model_dump(exclude=changed) == lab.model_dump(exclude=changed)
    assert len(other.radars) == count


def test_three_radars_120_degrees_apart_share_no_field() -> None:
    yaws = sorted(radar.yaw_deg % 360 for radar in load_scene("lab_three").radars)
    assert np.diff([*yaws, yaws[0] + 360]).tolist() == [120.0, 120.0, 120.0]
    assert rig_of(load_scene("lab_three")).pairs() == ()


@pytest.mark.parametrize("name", ["lab", "classroom"])
@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
def test_no_rotation_of_the_square_maps_landmarks_onto_each_other(
    name: str, quarter_turns: int
) -> None:
    centred = positions(load_scene(name)) - SIDE_M[name] / 2
    rotated = centred
    for _ in range(quarter_turns):
        rotated = np.stack([-rotated[:, 1], rotated[:, 0]], axis=1)
    gaps = np.hypot(*(rotated[:, np.newaxis] - centred[np.newaxis]).transpose(2, 0, 1))
    assert (gaps.min(axis=1) < 0.15).sum() <= 1


@pytest.mark.parametrize("name", [*SCENES, "corridor", "two_rooms", "symmetric", "hall", "store"])
def test_radars_are_the_papers_rig(name: str) -> None:
    radars = load_scene(name).radars
    assert [(r.name, r.x_m, r.y_m, r.yaw_deg) for r in radars] == [
        ("left_rear", -0.10, 0.20, 90.0),
        ("left_front", 0.10, 0.20, 90.0),
        ("right_rear", -0.10, -0.20, -90.0),
        ("right_front", 0.10, -0.20, -90.0),
    ]
    assert {(r.range_offset_m, r.start_skew_ms) for r in radars} == {(0.0, 0.0)}


def seen(scene: Scene) -> list[tuple[NDArray[np.float64], NDArray[np.bool_]]]:
    """Return per radar the boresight amplitude and the in-view flag, shapes (poses, targets)."""
    trajectory = scene.trajectory()
    poses = trajectory.poses(np.arange(0, trajectory.duration_ns + 1, 200_000_000))
    body = poses[:, 0] + 1j * poses[:, 1]
    heading = np.exp(1j * poses[:, 2])
    targets = positions(scene) @ np.array([1, 1j])
    views = []
    for radar in scene.radars:
        # Complex numbers as points of the plane: an implementation unlike the emulator's.
        centre = body + heading * (radar.x_m + 1j * radar.y_m)
        seen_from = (targets - centre[:, np.newaxis]) / heading[:, np.newaxis]
        angle = np.angle(seen_from * np.exp(-1j * math.radians(radar.yaw_deg)))
        radius_m = np.array([target.radius_m for target in scene.targets])
        range_m = np.abs(seen_from) - radius_m
        # A cylinder is a mirror with a near image: R**-1 and the spread from its focal line.
        power = {"rod": 1.5, "point": 2.0, "cylinder": 1.0}
        law = np.array([power[target.kind] for target in scene.targets])
        at_1_m = np.array([target.amplitude_1m for target in scene.targets])
        at_1_m = at_1_m * np.where(
            radius_m > 0, np.sqrt((1 + radius_m) / (range_m + radius_m)), 1.0
        )
        beam = np.cos(np.clip(angle, -math.pi / 2, math.pi / 2)) ** 2.0354
        in_view = (np.abs(angle) <= HALF_BEAM_RAD) & (range_m >= 0.2) & (range_m <= LARGEST_RANGE_M)
        views.append((at_1_m * range_m**-law * beam, in_view))
    return views


@pytest.mark.parametrize("name", [*SCENES, *OTHERS])
def test_each_landmark_is_detectable_often_enough_on_both_laps(name: str) -> None:
    """Both radars of a side see it, strongly enough, in 9 of 15 successive poses.

    Of three radars the outer two, which see the least in common.
    """
    scene = load_scene(name)
    views = seen(scene)
    per_side = len(views) // 2
    for rear, front in ((0, per_side - 1), (per_side, 2 * per_side - 1)):
        both = views[rear][1] & views[front][1]
        both &= (views[rear][0] >= DETECTABLE) & (views[front][0] >= DETECTABLE)
        for index, target in enumerate(scene.targets):
            in_window = np.convolve(both[:, index], np.ones(WINDOW_POSES), mode="valid")
            assert in_window.max() >= WINDOW_HITS, (target.name, rear)


@pytest.mark.parametrize("name", [*SCENES, *OTHERS, "lab_three"])
def test_no_echo_saturates_the_dac_window(name: str) -> None:
    scene = load_scene(name)
    half_window = (1100 - 949 + 1) / 2048
    margin = 6 * scene.noise.rf_sigma
    assert max(amplitude.max() for amplitude, _ in seen(scene)) <= half_window - margin
    assert scene.leakage.amplitude <= half_window - margin


def test_smoke_does_not_attenuate() -> None:
    """Smoke has no parameter: the scene says why, and its floor and noise are the lab's."""
    lab, smoke = load_scene("lab"), load_scene("smoke")
    assert "smoke" in smoke.description
    assert (smoke.noise, smoke.leakage, smoke.odometry) == (lab.noise, lab.leakage, lab.odometry)

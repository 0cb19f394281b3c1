"""The true path against closed forms and a step-by-step walk."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.scene.motion import drive
from emulator.scene.scene import load_scene

SECOND = 1_000_000_000


def at(*seconds: float) -> NDArray[np.int64]:
    return np.array([round(s * SECOND) for s in seconds], dtype=np.int64)


@pytest.mark.parametrize(
    ("scene", "side_m", "steps"),
    [("lab", 2.0, 3456), ("classroom", 3.0, 5056), ("smoke", 1.4, 2496)],
)
def test_scene_path_is_two_laps_each_way(scene: str, side_m: float, steps: int) -> None:
    """Walk the square by hand: whole steps of 1 cm or 5.625 degrees, 0.2 s each."""
    trajectory = load_scene(scene).trajectory()
    assert trajectory.duration_ns == steps * SECOND // 5

    x = y = heading_deg = 0.0
    walked = [(x, y, heading_deg)]

    def leg() -> None:
        nonlocal x, y
        for _ in range(round(side_m / 0.01)):
            x += 0.01 * round(math.cos(math.radians(heading_deg)))
            y += 0.01 * round(math.sin(math.radians(heading_deg)))
            walked.append((x, y, heading_deg))

    def turn(degrees: float) -> None:
        nonlocal heading_deg
        for _ in range(round(abs(degrees) / 5.625)):
            heading_deg += math.copysign(5.625, degrees)
            walked.append((x, y, heading_deg))

    for side in range(8):
        if side:
            turn(90)
        leg()
    turn(180)
    for side in range(8):
        if side:
            turn(-90)
        leg()

    expected = np.array(walked)
    expected[:, 2] = np.radians(expected[:, 2])
    poses = trajectory.poses(np.arange(steps + 1) * (SECOND // 5))
    np.testing.assert_allclose(poses, expected, atol=1e-9)


def test_robot_stands_still_before_and_after() -> None:
    trajectory = drive([(0, 0), (1, 0)], speed_mps=0.1, turn_rate_rad_per_s=1.0)
    poses = trajectory.poses(at(-100, 0, 10, 1e6))
    np.testing.assert_array_equal(poses, [[0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 0, 0]])


def test_a_single_stop_is_a_parked_robot() -> None:
    trajectory = drive([(0, 0)], speed_mps=0.1, turn_rate_rad_per_s=1.0)
    assert trajectory.duration_ns == 0
    np.testing.assert_array_equal(trajectory.poses(at(0, 5)), np.zeros((2, 3)))


def test_equal_neighbours_are_one_stop() -> None:
    twice = drive([(0, 0), (0, 0), (1, 0), (1, 0)], speed_mps=1.0, turn_rate_rad_per_s=1.0)
    assert twice.duration_ns == SECOND


@pytest.mark.parametrize(
    ("corner", "turn_rad"),
    [
        ((1.0, 1.0), math.pi / 2),
        ((1.0, -1.0), -math.pi / 2),
        ((2.0, 0.0), 0.0),
        ((0.0, 0.0), math.pi),  # a U-turn goes counter-clockwise
        ((0.0, -1.0), -3 * math.pi / 4),
    ],
)
def test_turns_take_the_shorter_way(corner: tuple[float, float], turn_rad: float) -> None:
    trajectory = drive([(0, 0), (1, 0), corner], speed_mps=1.0, turn_rate_rad_per_s=0.5)
    length_m = 1 + math.hypot(corner[0] - 1, corner[1])
    assert trajectory.duration_ns == pytest.approx((length_m + abs(turn_rad) / 0.5) * SECOND, abs=2)
    assert trajectory.poses(at(1e3))[0, 2] == pytest.approx(turn_rad)
    half = trajectory.poses(at(1 + abs(turn_rad)))[0]
    np.testing.assert_allclose(half[2], turn_rad / 2 if turn_rad else 0, atol=1e-8)


def test_the_smallest_leg_still_takes_time() -> None:
    path = drive([(0, 0), (1e-310, 0), (1, 0)], speed_mps=10, turn_rate_rad_per_s=60)
    assert (np.diff(path.knot_times_ns) > 0).all()
    assert np.isfinite(path.poses(np.arange(5, dtype=np.int64))).all()


def test_a_turn_that_takes_no_time_takes_one_nanosecond() -> None:
    path = drive([(0, 0), (1, 0), (1, 1)], speed_mps=1, turn_rate_rad_per_s=1e12)
    assert np.diff(path.knot_times_ns).tolist() == [SECOND, 1, SECOND]

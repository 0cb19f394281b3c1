"""The two rules by which a motion adds uncertainty, in closed form."""

import math

import numpy as np
import pytest

from slam.config import MotionConfig, MotionNoise
from slam.paper.ekf import motion_noise


def test_as_printed_every_step_adds_the_same_in_world_axes() -> None:
    wanted = np.diag([1e-8, 1e-8, 4e-4])
    for increment in (np.zeros(3), np.array([0.01, 0.0, 0.0]), np.array([0.0, 0.0, 0.1])):
        for heading in (0.0, 1.0):
            assert np.array_equal(motion_noise(increment, heading, MotionConfig()), wanted)


@pytest.mark.parametrize("heading", [0.0, math.pi / 6, -2.0])
def test_proportional_noise_lies_along_the_robot(heading: float) -> None:
    config = MotionConfig(noise=MotionNoise.PROPORTIONAL)
    R = motion_noise(np.array([0.04, 0.0, 0.0]), heading, config)
    along = np.array([math.cos(heading), math.sin(heading)])
    across = np.array([-along[1], along[0]])
    assert along @ R[:2, :2] @ along == pytest.approx(0.04 * 2e-3**2)
    assert across @ R[:2, :2] @ across == pytest.approx(0.04 * 6e-4**2)
    assert along @ R[:2, :2] @ across == pytest.approx(0.0, abs=1e-15)
    assert R[2, 2] == pytest.approx(0.04 * 4.2e-3**2)


def test_proportional_noise_of_many_small_steps_equals_that_of_one() -> None:
    config = MotionConfig(noise=MotionNoise.PROPORTIONAL)
    many = 10 * motion_noise(np.array([0.01, 0.0, 0.0]), 0.3, config)
    assert many == pytest.approx(motion_noise(np.array([0.1, 0.0, 0.0]), 0.3, config))


def test_turn_on_the_spot_costs_heading_only() -> None:
    config = MotionConfig(noise=MotionNoise.PROPORTIONAL)
    R = motion_noise(np.array([0.0, 0.0, -0.1]), 0.3, config)
    assert pytest.approx(np.diag([0.0, 0.0, (0.01 * 0.1) ** 2])) == R

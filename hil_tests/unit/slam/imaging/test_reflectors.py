"""The parts of a patch against closed forms: echoes whose places and amplitudes are known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hil_tests.unit.slam.imaging.test_points import (
    MOUNT,
    antennas_of,
    noise,
    of_point,
    patch_of,
    rf_frames,
    straight,
)
from slam.imaging.reflectors import SeparationRule, separated


@pytest.mark.parametrize("place", [(0.2, 1.1), (0.5, 1.0)])
def test_the_level_of_each_frame_is_that_of_the_beam_where_the_radar_turns(
    place: tuple[float, float],
) -> None:
    angles = np.linspace(-0.5, 0.5, 25)
    poses = np.column_stack([np.zeros(25), np.zeros(25), angles])
    reflectors = separated(patch_of(of_point(poses, place), poses), SeparationRule())
    ways, yaws = np.array(place) - antennas_of(poses), angles + MOUNT.yaw_rad
    ranges_m = np.linalg.norm(ways, axis=1)
    cosine = np.sum(ways * np.column_stack([np.cos(yaws), np.sin(yaws)]), axis=1) / ranges_m
    assert reflectors.range_m == pytest.approx([ranges_m[12]], abs=1e-3)
    # cos(x)**2 is the echo; the beam is 3 dB down at the edge of the field of view, nearly that.
    expected = 0.01 * cosine**2 * ranges_m**-1.5
    assert reflectors.levels[0] == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_a_weak_echo_more_than_12_cm_before_a_strong_one_is_found_in_noise(seed: int) -> None:
    # 15 % of the strong one's size in the law of a rod, 23 degrees beside it, 13 cm nearer
    place = 0.1 + 0.67 * math.sin(0.4), 0.2 + 0.67 * math.cos(0.4)
    frames = of_point(straight(), (0.1, 1.0)) + of_point(straight(), place, 0.0015)
    reflectors = separated(patch_of(frames + noise(seed, 1.2e-3)), SeparationRule())
    assert reflectors.range_m == pytest.approx([0.8, 0.67], abs=0.02)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_what_comes_into_view_within_the_patch_has_an_amplitude_that_begins_at_0(
    sign: float,
) -> None:
    # Of a step the best line would cross 0; c (1 + g t) with |g| <= 1 does not change its sign.
    t = sign * np.linspace(-1.0, 1.0, 25)
    ranges_m = np.linalg.norm(np.array([0.1, 1.1]) - antennas_of(straight()), axis=1)
    frames = rf_frames(ranges_m, np.where(t > 0, 0.01, 1e-5))
    levels = separated(patch_of(frames), SeparationRule()).levels[0]
    assert levels / levels[t.argmax()] == pytest.approx((1 + t) / 2, abs=0.02)

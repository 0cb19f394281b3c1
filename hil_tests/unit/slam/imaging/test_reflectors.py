"""The parts of a patch against closed forms: echoes whose places and amplitudes are known."""

from __future__ import annotations

import numpy as np
import pytest

from hil_tests.unit.slam.imaging.test_points import MOUNT, antennas_of, of_point, patch_of
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

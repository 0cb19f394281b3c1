"""The 95 % contour against its closed form."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam.app.run.pictures import ellipse_95, rotate_covariances


@given(st.floats(0.01, 2), st.floats(0.01, 2), st.floats(-3, 3))
def test_every_point_lies_at_the_chi_square_quantile(a: float, b: float, angle: float) -> None:
    cosine, sine = math.cos(angle), math.sin(angle)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    covariance = rotation @ np.diag([a**2, b**2]) @ rotation.T
    offsets = ellipse_95(np.array([3.0, -1.0]), covariance) - [3.0, -1.0]
    squared = np.sum(offsets * np.linalg.solve(covariance, offsets.T).T, axis=1)
    # chi-square table, 2 degrees of freedom, 95 %
    np.testing.assert_allclose(squared, 5.991464547, rtol=1e-6)


def test_a_tilted_covariance_gives_a_tilted_ellipse() -> None:
    outline = ellipse_95(np.zeros(2), np.array([[1.0, 0.9], [0.9, 1.0]]), n_points=400)
    farthest = outline[np.argmax(np.linalg.norm(outline, axis=1))]
    assert math.atan2(*farthest[::-1]) % math.pi == pytest.approx(math.pi / 4, abs=0.02)


def test_a_singular_covariance_is_a_line() -> None:
    outline = ellipse_95(np.zeros(2), np.diag([1.0, 0.0]))
    np.testing.assert_allclose(outline[:, 1], 0.0, atol=1e-12)


def test_a_quarter_turn_swaps_the_axes() -> None:
    turned = rotate_covariances(math.pi / 2, np.array([np.diag([4.0, 1.0])]))
    np.testing.assert_allclose(turned[0], np.diag([1.0, 4.0]), atol=1e-12)

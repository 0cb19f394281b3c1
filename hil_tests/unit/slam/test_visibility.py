"""Which landmarks count as findable."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from slam.evaluation import observable_landmarks
from slam.geometry import paper_rig


def standing(n: int) -> NDArray[np.float64]:
    return np.zeros((n, 3))


def creeping(n: int) -> NDArray[np.float64]:
    return np.column_stack([0.01 * np.arange(n), np.zeros(n), np.zeros(n)])


@pytest.mark.parametrize(
    ("landmark", "findable"),
    [
        ((0.0, 1.0), True),
        ((0.0, -1.0), True),  # the other pair
        ((1.0, 0.0), False),  # ahead, where no radar looks
        ((0.0, 1.8), False),  # beyond L
        ((0.0, 0.3), False),  # too near: outside both fields of view
        ((0.5, 0.9), False),  # in view of the front radar only
        ((0.0, 1.69), True),  # within 1.5 m of both antennas
    ],
)
def test_joint_view_and_range_limits(landmark: tuple[float, float], findable: bool) -> None:
    poses = creeping(10) - np.array([0.05, 0.0, 0.0])
    found = observable_landmarks(paper_rig(), poses, np.array([landmark]))
    assert found.tolist() == [findable]


@pytest.mark.parametrize(("n", "findable"), [(8, False), (9, True)])
def test_nine_distinct_poses_are_needed(n: int, findable: bool) -> None:
    landmark = np.array([[0.04, 1.0]])
    found = observable_landmarks(paper_rig(), creeping(n), landmark)
    assert found.tolist() == [findable]


@pytest.mark.parametrize(
    ("step", "distinct"),
    [
        ((0.0051, 0.0, 0.0), True),
        ((0.0049, 0.0, 0.0), False),
        ((0.0, 0.0, 0.101), True),
        ((0.0, 0.0, 0.099), False),
    ],
)
def test_distinct_is_five_millimetres_or_a_tenth_of_a_radian(
    step: tuple[float, float, float], distinct: bool
) -> None:
    # Nine poses to and fro, so that the way back does not add up to more than one step.
    poses = np.array([np.array(step) * (k % 2) for k in range(9)])
    found = observable_landmarks(paper_rig(), poses, np.array([[0.0, 1.0]]))
    assert found.tolist() == [distinct]


def test_standing_still_adds_no_pose() -> None:
    found = observable_landmarks(paper_rig(), standing(100), np.array([[0.0, 1.0]]))
    assert found.tolist() == [False]


def test_poses_of_two_pairs_do_not_add_up() -> None:
    # Five looks with the left pair, then five with the right one after a half turn.
    poses = creeping(10)
    poses[5:, 2] = math.pi
    found = observable_landmarks(paper_rig(), poses, np.array([[0.04, 1.0]]))
    assert found.tolist() == [False]


def test_no_landmarks_and_no_poses() -> None:
    none = np.empty((0, 2))
    assert observable_landmarks(paper_rig(), creeping(9), none).shape == (0,)
    one = np.array([[0.0, 1.0]])
    assert observable_landmarks(paper_rig(), np.empty((0, 3)), one).tolist() == [False]

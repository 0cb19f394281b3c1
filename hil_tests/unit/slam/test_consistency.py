"""NIS of true associations: truth, not the filter, says what an observation is of."""

import numpy as np
import pytest
from numpy.typing import NDArray

from slam.evaluation import TrueAssociationNis
from slam.paper.ekf import start
from slam.results import Association, Observation, StepResult

Array = NDArray[np.float64]
TRUE = np.array([[0.0, 1.0], [0.0, -1.0]])


def result(*looks: tuple[tuple[float, float], Association]) -> StepResult:
    observations = tuple(
        Observation(x_m=x, y_m=y, n_fixes=9, n_poses=9, fixes=()) for (x, y), _ in looks
    )
    return StepResult(
        t_ns=0,
        odometry_pose=np.zeros(3),
        belief=start(),
        detections=(),
        fixes=(),
        observations=observations,
        associations=tuple(association for _, association in looks),
        rejected=(),
    )


def born(landmark_id: int, distances: tuple[float, ...] = ()) -> Association:
    return Association(
        landmark_id=landmark_id,
        is_new=True,
        mahalanobis_sq=np.array(distances),
        candidate_ids=tuple(range(len(distances))),
    )


def matched(landmark_id: int, distances: tuple[float, ...]) -> Association:
    return Association(
        landmark_id=landmark_id,
        is_new=False,
        mahalanobis_sq=np.array(distances),
        candidate_ids=tuple(range(len(distances))),
    )


def test_first_look_is_a_birth_and_later_ones_are_judged_by_their_true_landmark() -> None:
    nis = TrueAssociationNis(TRUE)
    here = np.zeros(3)
    assert nis.add(result(((0.0, 1.0), born(0))), here) == ()
    assert nis.add(result(((0.0, -1.0), born(1, (50.0,)))), here) == ()
    assert nis.add(result(((0.05, 1.0), matched(0, (1.5, 40.0)))), here) == (1.5,)
    # Associated wrongly: the distance to the true landmark counts, however large.
    assert nis.add(result(((0.05, 1.0), matched(1, (9.0, 0.1)))), here) == (9.0,)
    # Made a duplicate by a tight gate: counts as well.
    assert nis.add(result(((0.05, 1.0), born(2, (12.0, 40.0)))), here) == (12.0,)


def test_landmark_dragged_onto_another_truth_changes_its_owner() -> None:
    nis = TrueAssociationNis(TRUE)
    here = np.zeros(3)
    first, second = (0.0, 1.0), (0.0, -1.0)

    def look(xy: tuple[float, float], association: Association) -> tuple[float, ...]:
        return nis.add(result((xy, association)), here)

    assert look(first, born(0)) == ()
    assert look(first, matched(0, (0.5,))) == (0.5,)
    # The filter takes the second truth for landmark 0 and drags it there. As long as most of its
    # observations are of the first truth, the second has no landmark, so nothing is counted.
    assert look(second, matched(0, (0.3,))) == ()
    assert look(second, matched(0, (0.2,))) == ()
    # Two against two: it belongs to nobody.
    assert look(first, born(1, (90.0,))) == ()
    assert look(second, matched(0, (0.1, 70.0))) == ()
    # Three against two: it is the second truth's now, and the first has landmark 1.
    assert look(second, matched(0, (0.4, 80.0))) == (0.4,)
    assert look(first, matched(1, (95.0, 0.6))) == (0.6,)


def test_of_two_landmarks_of_one_truth_the_one_seen_more_often_counts() -> None:
    nis = TrueAssociationNis(TRUE)
    here, there = np.zeros(3), (0.0, 1.0)
    nis.add(result((there, born(0))), here)
    assert nis.add(result((there, born(1, (5.0,)))), here) == (5.0,)
    assert nis.add(result((there, matched(1, (6.0, 0.5)))), here) == (6.0,)  # the older of equals
    assert nis.add(result((there, matched(1, (7.0, 0.4)))), here) == (0.4,)


def test_birth_gives_an_owner_even_where_ids_have_gaps() -> None:
    """A birth is an observation of its own truth; a wrong match gives that truth no landmark."""
    nis = TrueAssociationNis(TRUE)
    here = np.zeros(3)
    nis.add(result(((0.0, 1.0), born(4))), here)
    assert nis.add(result(((0.0, -1.0), matched(4, ()))), here) == ()
    judged = Association(
        landmark_id=4, is_new=False, mahalanobis_sq=np.array([0.8]), candidate_ids=(4,)
    )
    assert nis.add(result(((0.0, 1.0), judged)), here) == ()  # one of two: not most
    assert nis.add(result(((0.0, 1.0), judged)), here) == (0.8,)  # two of three


def test_clutter_counts_for_nothing() -> None:
    nis = TrueAssociationNis(TRUE)
    assert nis.add(result(((0.0, 0.5), born(0))), np.zeros(3)) == ()
    assert nis.add(result(((0.0, 1.0), matched(0, (3.0,)))), np.zeros(3)) == ()
    assert (
        TrueAssociationNis(np.empty((0, 2))).add(result(((0.0, 1.0), born(0))), np.zeros(3)) == ()
    )


@pytest.mark.parametrize("pose", [(3.0, -2.0, 0.0), (3.0, -2.0, 2.0)])
def test_observations_are_placed_by_the_true_pose(pose: tuple[float, float, float]) -> None:
    true_pose = np.array(pose)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    world = TRUE @ np.array([[c, s], [-s, c]]) + true_pose[:2]
    nis = TrueAssociationNis(world)
    nis.add(result(((0.0, 1.0), born(0))), true_pose)
    assert nis.add(result(((0.0, 1.1), matched(0, (0.7,)))), true_pose) == (0.7,)

"""NEES, NIS, consistency of ranges and which landmarks can be seen, against closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from slam.frames import Detection
from slam.geometry import PAPERS_FIELD, Mount, Rig, paper_rig
from slam.library.evaluation import (
    ECHO_LENGTH_M,
    TrueAssociationNis,
    observable_landmarks,
    true_range_nis,
)
from slam.paper.ekf import start
from slam.results import Association, Observation, PredictedRange, StepResult, UpdateReport

Array = NDArray[np.float64]
TRUE = np.array([[0.0, 1.0], [0.0, -1.0]])


def observed(*looks: tuple[tuple[float, float], Association]) -> StepResult:
    observations = tuple(Observation(x_m=x, y_m=y, n_poses=9, fixes=()) for (x, y), _ in looks)
    return StepResult(
        t_ns=0,
        odometry_pose=np.zeros(3),
        belief=start(),
        detections=(),
        observations=observations,
        associations=tuple(association for _, association in looks),
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
    assert nis.add(observed(((0.0, 1.0), born(0))), here) == ()
    assert nis.add(observed(((0.0, -1.0), born(1, (50.0,)))), here) == ()
    assert nis.add(observed(((0.05, 1.0), matched(0, (1.5, 40.0)))), here) == (1.5,)
    # Associated wrongly: the distance to the true landmark counts, however large.
    assert nis.add(observed(((0.05, 1.0), matched(1, (9.0, 0.1)))), here) == (9.0,)
    # Made a duplicate by a tight gate: counts as well.
    assert nis.add(observed(((0.05, 1.0), born(2, (12.0, 40.0)))), here) == (12.0,)


def test_landmark_dragged_onto_another_truth_changes_its_owner() -> None:
    nis = TrueAssociationNis(TRUE)
    here = np.zeros(3)
    first, second = (0.0, 1.0), (0.0, -1.0)

    def look(xy: tuple[float, float], association: Association) -> tuple[float, ...]:
        return nis.add(observed((xy, association)), here)

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
    nis.add(observed((there, born(0))), here)
    assert nis.add(observed((there, born(1, (5.0,)))), here) == (5.0,)
    assert nis.add(observed((there, matched(1, (6.0, 0.5)))), here) == (6.0,)  # the older of equals
    assert nis.add(observed((there, matched(1, (7.0, 0.4)))), here) == (0.4,)


def test_birth_gives_an_owner_even_where_ids_have_gaps() -> None:
    """A birth is an observation of its own truth; a wrong match gives that truth no landmark."""
    nis = TrueAssociationNis(TRUE)
    here = np.zeros(3)
    nis.add(observed(((0.0, 1.0), born(4))), here)
    assert nis.add(observed(((0.0, -1.0), matched(4, ()))), here) == ()
    judged = Association(
        landmark_id=4, is_new=False, mahalanobis_sq=np.array([0.8]), candidate_ids=(4,)
    )
    assert nis.add(observed(((0.0, 1.0), judged)), here) == ()  # one of two: not most
    assert nis.add(observed(((0.0, 1.0), judged)), here) == (0.8,)  # two of three


def test_clutter_counts_for_nothing() -> None:
    nis = TrueAssociationNis(TRUE)
    assert nis.add(observed(((0.0, 0.5), born(0))), np.zeros(3)) == ()
    assert nis.add(observed(((0.0, 1.0), matched(0, (3.0,)))), np.zeros(3)) == ()
    assert (
        TrueAssociationNis(np.empty((0, 2))).add(observed(((0.0, 1.0), born(0))), np.zeros(3)) == ()
    )


@pytest.mark.parametrize("pose", [(3.0, -2.0, 0.0), (3.0, -2.0, 2.0)])
def test_observations_are_placed_by_the_true_pose(pose: tuple[float, float, float]) -> None:
    true_pose = np.array(pose)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    world = TRUE @ np.array([[c, s], [-s, c]]) + true_pose[:2]
    nis = TrueAssociationNis(world)
    nis.add(observed(((0.0, 1.0), born(0))), true_pose)
    assert nis.add(observed(((0.0, 1.1), matched(0, (0.7,)))), true_pose) == (0.7,)


POSE = np.array([1.0, 2.0, math.pi / 2])
"""Body x is world y."""


def expected(landmark_id: int, x_m: float, y_m: float, *, radar: int = 0) -> PredictedRange:
    """Return a landmark believed at (x, y) in the body, seen by an antenna at the body's origin."""
    return PredictedRange(
        radar=radar,
        landmark_id=landmark_id,
        range_m=math.hypot(x_m, y_m),
        variance=9e-6,
        antenna_m=(0.0, 0.0),
        point_m=(x_m, y_m),
    )


def ranged(ranges: list[tuple[int, float]], *told: PredictedRange) -> StepResult:
    report = UpdateReport(continued=(), nis=0.0, dof=0, predicted=told)
    seen = [Detection(radar=r, t_ns=0, range_m=z, amplitude=0.01) for r, z in ranges]
    return StepResult(
        t_ns=0,
        odometry_pose=POSE,
        belief=start(),
        detections=tuple(seen),
        report=report,
        range_sigmas_m=(4e-3,) * len(seen),
    )


def world(x_m: float, y_m: float) -> list[float]:
    return [1.0 - y_m, 2.0 + x_m]


def test_the_innovation_is_against_the_prediction_with_both_variances() -> None:
    # Truth at 1.000 m, believed at 1.010 m, measured at 1.004 m: nu = -6 mm, S = (5 mm)^2.
    true_xy = np.array([world(0.0, 1.0)])
    values = true_range_nis(ranged([(0, 1.004)], expected(7, 0.0, 1.01)), POSE, true_xy)
    assert values == pytest.approx([(6 / 5) ** 2])


def test_a_surprising_range_of_the_landmark_counts_however_far_outside_any_gate() -> None:
    true_xy = np.array([world(0.0, 1.0)])
    far = 1.0 + 0.9 * ECHO_LENGTH_M
    values = true_range_nis(ranged([(0, far)], expected(7, 0.0, 1.0)), POSE, true_xy)
    assert values == pytest.approx([(0.9 * ECHO_LENGTH_M / 5e-3) ** 2])


@pytest.mark.parametrize(
    ("ranges", "told"),
    [
        ([(0, 1.0 + 1.1 * ECHO_LENGTH_M)], expected(7, 0.0, 1.0)),  # no echo of it
        ([(1, 1.0)], expected(7, 0.0, 1.0)),  # another radar's
        ([(0, 1.0)], expected(7, 0.5, 1.0)),  # a false landmark: no true one within 0.15 m
        ([], expected(7, 0.0, 1.0)),
    ],
)
def test_what_is_no_true_association_is_not_counted(
    ranges: list[tuple[int, float]], told: PredictedRange
) -> None:
    assert true_range_nis(ranged(ranges, told), POSE, np.array([world(0.0, 1.0)])) == ()


def test_one_echo_between_two_targets_is_of_the_nearer_one_only() -> None:
    true_xy = np.array([world(0.0, 1.0), world(0.3, 1.0)])
    told = expected(7, 0.0, 1.0), expected(8, 0.3, 1.0)
    values = true_range_nis(ranged([(0, 1.01)], *told), POSE, true_xy)
    assert values == pytest.approx([(10 / 5) ** 2])


def test_ranges_that_the_back_end_was_not_given_are_not_judged() -> None:
    seen = ranged([(0, 1.02)], expected(7, 0.0, 1.0))
    true_xy = np.array([world(0.0, 1.0)])
    assert true_range_nis(replace(seen, range_sigmas_m=(math.inf,)), POSE, true_xy) == ()


def test_an_empty_world_or_a_result_of_the_paper_has_none() -> None:
    seen = ranged([(0, 1.0)], expected(7, 0.0, 1.0))
    assert true_range_nis(seen, POSE, np.empty((0, 2))) == ()
    assert true_range_nis(replace(seen, report=None), POSE, np.array([world(0.0, 1.0)])) == ()


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
        ((0.5, 0.9), True),  # in view of the front radar only
        ((0.0, 1.69), True),  # within 1.5 m of both antennas
        ((0.16, 1.69), True),  # within 1.5 m of the front one only
    ],
)
def test_view_and_range_limits_of_any_radar(landmark: tuple[float, float], findable: bool) -> None:
    poses = creeping(10) - np.array([0.05, 0.0, 0.0])
    found = observable_landmarks(paper_rig(), poses, np.array([landmark]), PAPERS_FIELD)
    assert found.tolist() == [findable]


@pytest.mark.parametrize(("n", "findable"), [(8, False), (9, True)])
def test_nine_distinct_poses_are_needed(n: int, findable: bool) -> None:
    landmark = np.array([[0.04, 1.0]])
    found = observable_landmarks(paper_rig(), creeping(n), landmark, PAPERS_FIELD)
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
    found = observable_landmarks(paper_rig(), poses, np.array([[0.0, 1.0]]), PAPERS_FIELD)
    assert found.tolist() == [distinct]


def test_standing_still_adds_no_pose() -> None:
    found = observable_landmarks(paper_rig(), standing(100), np.array([[0.0, 1.0]]), PAPERS_FIELD)
    assert found.tolist() == [False]


def test_looks_of_different_radars_add_up() -> None:
    # Five looks with the left pair, then five with the right one after a half turn.
    poses = creeping(10)
    poses[5:, 2] = math.pi
    found = observable_landmarks(paper_rig(), poses, np.array([[0.04, 1.0]]), PAPERS_FIELD)
    assert found.tolist() == [True]


FOUR_YAWS = Rig(
    mounts=tuple(
        Mount(name=str(yaw), x_m=0.0, y_m=0.0, yaw_rad=math.radians(yaw))
        for yaw in (0, 75, 170, 260)
    )
)


@pytest.mark.parametrize(
    ("bearing_deg", "range_m", "max_range_m", "found"),
    [
        (0.0, 1.0, 1.5, True),
        (75.0, 1.0, 1.5, True),
        (170.0, 1.4, 1.5, True),
        (260.0, 4.9, 5.2, True),
        (260.0, 4.9, 1.5, False),
        (0.0, 5.3, 5.2, False),
        (37.5, 1.0, 1.5, False),  # between two radars: 37.5 degrees off both boresights
        (215.0, 1.0, 1.5, False),
    ],
)
def test_radars_need_no_partner(
    bearing_deg: float, range_m: float, max_range_m: float, found: bool
) -> None:
    bearing_rad = math.radians(bearing_deg)
    landmark = range_m * np.array([[math.cos(bearing_rad), math.sin(bearing_rad)]])
    field = replace(PAPERS_FIELD, max_range_m=max_range_m)
    poses = creeping(9) - np.array([0.04, 0.0, 0.0])
    assert observable_landmarks(FOUR_YAWS, poses, landmark, field).tolist() == [found]


def test_no_landmarks_and_no_poses() -> None:
    none = np.empty((0, 2))
    assert observable_landmarks(paper_rig(), creeping(9), none, PAPERS_FIELD).shape == (0,)
    one = np.array([[0.0, 1.0]])
    assert observable_landmarks(paper_rig(), np.empty((0, 3)), one, PAPERS_FIELD).tolist() == [
        False
    ]

"""A robot that is carried away: noticed by what is missing, found again by what is there."""

import math

import numpy as np
import pytest

from hil_tests.property.robust_oracles import landmark_covariance
from hil_tests.unit.slam.robust.range_world import (
    LAB,
    Run,
    follow,
    parameters_for,
    reported,
    scans_of,
    step_of,
)
from slam.config import WheelNoise
from slam.evaluation import nees_pose
from slam.geometry import between, paper_rig, transform
from slam.robust.back_end import RobustBackEnd
from slam.robust.initialisation import BodyPoint, initialise_landmark
from slam.robust.kidnapping import (
    Evidence,
    Localisation,
    Surprise,
    apply_join,
    begin_submap,
    find_join,
)
from slam.robust.map import Existence
from slam.robust.parameters import BackEndParameters, MapRule, RelocationRule, SurpriseRule
from slam.robust.run_log import RunLog
from slam.robust.state import Array, State, calibrated_motion, predict

SIGMA_M = 7.4e-3
PLACES = np.array(
    [[0.1, 0.9], [0.55, 0.7], [0.95, 1.1], [1.5, 0.8], [0.3, -0.8], [0.8, -1.0], [1.25, -0.7]]
)
MISSED, SEEN = 2.5, -2.5


def mapped(places: Array) -> State:
    """Return a state that has seen some places from its start, 5 mm well."""
    state = State((0.007, 0.007, 0.0042), (0.0,) * 4)
    see(state, places)
    return state


def see(state: State, places: Array) -> None:
    for place in places:
        initialise_landmark(
            state,
            BodyPoint(point_m=place, covariance=2.5e-5 * np.eye(2), by_offsets=np.zeros((2, 4))),
        )


def on_an_island(places: Array, seen: Array, pose: Array, apart: Array) -> State:
    """Return a map of places, and a submap begun at a pose that sees some, in truth ``apart``."""
    state = mapped(places)
    begin_submap(state, pose)
    see(state, transform(between(apart, np.zeros(3)), seen))
    return state


def test_an_island_forgets_the_pose_and_nothing_else() -> None:
    state = mapped(PLACES)
    state.P.add_products(np.eye(state.P.size)[0], 0.01 * np.eye(state.P.size)[0])  # heading
    before = [landmark_covariance(state, row) for row in range(len(PLACES))]
    calibration = state.P.block(np.arange(3, 6))
    begin_submap(state, np.array([3.0, 1.0, 2.0]))
    assert np.abs(state.pose_covariance()).max() == 0.0
    assert state.pose == pytest.approx([3.0, 1.0, 2.0])
    assert np.array_equal(state.P.block(np.arange(3, 6)), calibration)
    for row, covariance in enumerate(before):
        assert landmark_covariance(state, row) == pytest.approx(covariance, abs=1e-12)


def test_a_constellation_tells_where_the_robot_is() -> None:
    truth = np.array([0.6, 0.1, 2.0])
    state = on_an_island(PLACES, PLACES[[0, 1, 2, 5]], np.array([4.0, 4.0, -1.0]), truth)
    old, new = range(7), range(7, 11)
    join = find_join(state, new, old, MapRule(), RelocationRule())
    assert join is not None
    assert set(join.pairs) == {(0, 7), (1, 8), (2, 9), (5, 10)}
    doubt = [np.trace(landmark_covariance(state, row)) for row in old]
    apply_join(state, join, new, 1e-5)
    assert state.pose == pytest.approx(truth, abs=1e-6)
    assert state.landmarks_m == pytest.approx(PLACES, abs=1e-6)
    assert len(state.landmark_ids) == 7
    # What was seen twice is known better; the pose is as sure as landmarks of 5 mm make it.
    for row in (0, 1, 2, 5):
        assert np.trace(landmark_covariance(state, row)) < 0.8 * doubt[row]
    sigmas = np.sqrt(np.diag(state.pose_covariance()))
    assert (sigmas[:2] < 0.015).all()
    assert (sigmas[:2] > 0.002).all()
    assert sigmas[2] < 0.02
    assert np.linalg.eigvalsh(state.P.full())[0] > -1e-12


def test_a_constellation_that_fits_twice_tells_nothing() -> None:
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    state = on_an_island(square, square, np.zeros(3), np.zeros(3))
    assert find_join(state, range(4, 8), range(4), MapRule(), RelocationRule()) is None


def test_two_landmarks_or_a_strange_place_tell_nothing() -> None:
    few = on_an_island(PLACES, PLACES[:2], np.zeros(3), np.zeros(3))
    assert find_join(few, (7, 8), range(7), MapRule(), RelocationRule()) is None
    strange = np.array([[0.0, 0.0], [0.61, 0.1], [0.2, 0.47], [1.3, 0.9]])
    state = on_an_island(PLACES, strange, np.zeros(3), np.zeros(3))
    assert find_join(state, range(7, 11), range(7), MapRule(), RelocationRule()) is None


def looked(frames: int, missing: tuple[int, ...], seen: tuple[int, ...]) -> Surprise:
    surprise = Surprise(SurpriseRule())
    for pose in range(frames):
        frame = [Evidence(id_, MISSED) for id_ in missing] + [Evidence(id_, SEEN) for id_ in seen]
        surprise.look(frame, pose, (*missing, *seen))
    return surprise


def test_several_must_be_missing_and_nothing_speak_for_the_map() -> None:
    assert not looked(500, (1,), ()).is_carried
    assert not looked(500, (1, 2), ()).is_carried
    assert looked(500, (1, 2, 3), ()).is_carried
    assert not looked(500, (1, 2, 3), (4, 5)).is_carried
    assert not looked(500, (1, 2, 3), (4, 5, 6, 7, 8)).is_suspicious


def test_a_robot_carried_away_from_a_map_of_which_nothing_is_left_stays_lost() -> None:
    """Else its pose, exact in a submap of its own, would pass for one on the map."""
    where, log = Localisation(BackEndParameters()), RunLog(WheelNoise())
    state, existence = mapped(PLACES[:2]), Existence(MapRule())
    log.add_motion(*step_of([0.1, 0.0, 0.0], 1e-6))
    where.look([Evidence(7, MISSED)], state, log)
    while state.landmark_ids:
        state.remove(0)
    where.begin_submap(state, existence, log)
    assert np.abs(state.pose_covariance()).max() == 0.0
    assert where.is_lost
    assert where.lost_covariance[0, 0] >= 1.0
    see(state, PLACES[:3])
    where.look([Evidence(id_, MISSED) for id_ in state.landmark_ids], state, log)
    for id_ in state.landmark_ids:
        existence.hit(id_, 20)
    assert not where.join(state, existence, log)
    where.begin_submap(state, existence, log)
    assert where.is_lost
    assert where.old_map == frozenset()


def test_what_was_mapped_after_the_robot_was_carried_is_no_witness() -> None:
    surprise = looked(100, (), (1, 2, 3, 4))
    for pose in range(100, 140):
        frame = [Evidence(id_, MISSED) for id_ in (2, 3, 4)] + [
            Evidence(id_, SEEN) for id_ in (8, 9)
        ]
        surprise.look(frame, pose, (1, 2, 3, 4) if pose < 115 else (1, 2, 3, 4, 8, 9))
    assert surprise.is_carried
    assert 100 <= surprise.best.first_pose <= 110
    assert surprise.best.known_before == {1, 2, 3, 4}


def carried_run(seed: int) -> tuple[Run, int]:
    """Return a drive past seven landmarks and back; the robot is turned by hand and goes on."""
    rng = np.random.default_rng(seed)
    x = np.arange(0.0, 1.5, 0.02)
    there = np.column_stack([x, np.zeros((len(x), 2))])
    elsewhere = np.column_stack([1.4 - x, np.full(len(x), 0.1), np.full(len(x), math.pi)])
    there = np.vstack([there, there[::-1][:60]])
    poses = np.vstack([there, elsewhere])
    increments = reported(poses, LAB, rng, 0.0, unaware=len(there))
    scans = list(scans_of(poses, PLACES, rng, SIGMA_M))
    return Run(poses=poses, landmarks=PLACES, increments=increments, scans=scans), len(there)


def test_a_carried_robot_says_so_and_finds_itself_on_the_old_map() -> None:
    run, cut = carried_run(0)
    back_end = RobustBackEnd(paper_rig(), parameters_for(LAB, SIGMA_M))
    carried, lost = [], []
    for k, report in enumerate(follow(back_end, run.increments, run.scans), start=1):
        if report.carried:
            carried.append(k)
        if report.lost:
            lost.append(k)
            assert math.sqrt(back_end.pose_covariance[0, 0]) > 1.0
    assert 0 <= carried[0] - cut <= 80
    assert len(carried) == 1
    assert carried[0] == lost[0] < lost[-1] < len(run.scans)
    assert lost == list(range(lost[0], lost[-1] + 1))
    assert np.hypot(*(back_end.pose - run.poses[-1])[:2]) < 0.03
    assert nees_pose(back_end.pose, back_end.pose_covariance, run.poses[-1]) < 16.0
    assert len(back_end.reported_rows()) == len(PLACES)


def test_a_motion_the_wheels_report_is_no_kidnapping() -> None:
    run, cut = carried_run(1)
    back_end = RobustBackEnd(paper_rig(), BackEndParameters())
    for report in follow(back_end, run.increments[: cut - 1], run.scans[: cut - 1]):
        assert not report.carried
        assert not report.lost


def test_where_the_island_was_begun_does_not_matter() -> None:
    """Pose, map and their covariances after a join are the same for any place of the submap."""
    truth, wheels = np.array([0.2, -0.1, 0.7]), WheelNoise()
    after = []
    for begun in (np.zeros(3), np.array([3.0, -2.0, 2.5])):
        state = mapped(PLACES)
        begin_submap(state, begun)
        for _ in range(5):
            step = calibrated_motion(np.array([0.1, 0.0, 0.2]), state.calibration, wheels)
            predict(state, step, wheels)
        see(state, transform(between(truth, np.zeros(3)), PLACES[:4]))
        join = find_join(state, range(7, 11), range(7), MapRule(), RelocationRule())
        assert join is not None
        apply_join(state, join, range(7, 11), 1e-5)
        after.append(state)
    one, other = after
    assert one.pose == pytest.approx(truth, abs=1e-6)
    assert other.pose == pytest.approx(truth, abs=1e-6)
    scale = np.sqrt(np.outer(one.P.full().diagonal(), one.P.full().diagonal()))
    assert (np.abs(one.P.full() - other.P.full()) <= 1e-3 * scale + 1e-12).all()

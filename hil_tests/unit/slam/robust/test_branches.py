"""A robot that slips is put right by the next solution; one that is carried away is found again."""

import math
from dataclasses import replace

import numpy as np
import pytest

from hil_tests.unit.slam.robust.range_world import (
    LAB,
    Run,
    follow,
    parameters_for,
    reported,
    scans_of,
)
from slam.evaluation import nees_pose
from slam.geometry import between, compose, paper_rig
from slam.robust.association import RangeScan
from slam.robust.back_end import RobustBackEnd
from slam.robust.branches import Branches, Step, gain, totals_of
from slam.robust.parameters import BackEndParameters, BranchRule
from slam.robust.state import Array

SIGMA_M = 7.4e-3
PLACES = np.array(
    [[0.1, 0.9], [0.55, 0.7], [0.95, 1.1], [1.5, 0.8], [0.3, -0.8], [0.8, -1.0], [1.25, -0.7]]
)
RULE = BranchRule()


def straight(n: int) -> Array:
    """Return poses there and back again past seven landmarks."""
    x = np.arange(0.0, 1.5, 0.02)
    there = np.column_stack([x, np.zeros((len(x), 2))])
    return np.vstack([there, there[::-1][:n]])


def carried_run(seed: int, n_ways: int = 1) -> tuple[Run, int]:
    """Return a drive past seven landmarks and back; the robot is turned by hand and goes on.

    It then goes to and fro, ``n_ways`` in all.
    """
    rng = np.random.default_rng(seed)
    x = np.arange(0.0, 1.5, 0.02)
    there = straight(60)
    elsewhere = np.column_stack([1.4 - x, np.full(len(x), 0.1), np.full(len(x), math.pi)])
    ways = [elsewhere, elsewhere[::-1]] * n_ways
    poses = np.vstack([there, *ways[:n_ways]])
    increments = reported(poses, LAB, rng, 0.0, unaware=len(there))
    scans = list(scans_of(poses, PLACES, rng, SIGMA_M))
    return Run(poses=poses, landmarks=PLACES, increments=increments, scans=scans), len(there)


def slipped_run(seed: int, slip: Array) -> Run:
    """Return a drive there and back; halfway back the wheels report a motion that was none."""
    rng = np.random.default_rng(seed)
    poses = straight(70)
    increments = reported(poses, LAB, rng, 0.0)
    increments[100] = compose(increments[100], slip)
    scans = list(scans_of(poses, PLACES, rng, SIGMA_M))
    return Run(poses=poses, landmarks=PLACES, increments=increments, scans=scans)


def error_m(pose: Array, truth: Array) -> float:
    return float(np.hypot(*(pose - truth)[:2]))


def test_a_carried_robot_finds_itself_on_the_map() -> None:
    run, cut = carried_run(0)
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    carried, lost = [], []
    for k, report in enumerate(follow(branches, run.increments, run.scans), start=1):
        if report.carried:
            carried.append(k)
        if report.lost:
            lost.append(k)
            assert branches.lost_pose is not None
            pose, covariance = branches.lost_pose
            assert math.sqrt(covariance[0, 0]) > 1.0
            # Odometry leads on from where the robot was about when it was carried.
            moved = between(run.poses[cut], run.poses[k])
            assert error_m(pose, compose(run.poses[cut - 1], moved)) < 0.25
    assert len(carried) == 1
    assert 0 <= carried[0] - cut <= 80
    assert lost == list(range(carried[0], carried[0] + len(lost)))
    assert not branches.is_lost
    back_end = branches.main
    assert error_m(back_end.pose, run.poses[-1]) < 0.03
    assert nees_pose(back_end.pose, back_end.pose_covariance, run.poses[-1]) < 16.0
    assert len(back_end.reported_rows()) == len(PLACES)


def test_a_motion_the_wheels_report_is_no_kidnapping() -> None:
    run, cut = carried_run(1)
    branches = Branches(paper_rig(), BackEndParameters())
    for report in follow(branches, run.increments[: cut - 1], run.scans[: cut - 1]):
        assert not report.carried
        assert not report.lost


def test_a_slip_is_taken_back() -> None:
    """40 mm and 4 degrees, more than twice the sigma of a slip, in one step."""
    slip = np.array([0.04, 0.0, math.radians(4.0)])
    run = slipped_run(2, slip)
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    rules = parameters_for(LAB, SIGMA_M)
    never = replace(rules.relinearisation, steps_per_slip=math.inf)
    plain = RobustBackEnd(paper_rig(), replace(rules, relinearisation=never))
    for report in follow(branches, run.increments, run.scans):
        assert not report.carried
        assert not report.lost
    list(follow(plain, run.increments, run.scans))
    end, back_end = run.poses[-1], branches.main
    assert error_m(back_end.pose, end) < 0.015
    assert abs(back_end.pose[2]) < math.radians(1.0)
    assert nees_pose(back_end.pose, back_end.pose_covariance, end) < 16.0
    assert error_m(back_end.pose, end) < 0.5 * error_m(plain.pose, end)


def test_without_slip_or_carry_branches_change_no_bit_of_the_back_end() -> None:
    run, cut = carried_run(3)
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    plain = RobustBackEnd(paper_rig(), parameters_for(LAB, SIGMA_M))
    for one in (branches, plain):
        list(follow(one, run.increments[: cut - 1], run.scans[: cut - 1]))
    assert np.array_equal(branches.main.pose, plain.pose)
    assert np.array_equal(branches.main.state.P.full(), plain.state.P.full())


def test_the_same_steps_give_the_same_bits() -> None:
    run, _ = carried_run(4)
    ends = []
    for _ in range(2):
        branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
        reports = list(follow(branches, run.increments, run.scans))
        ends.append((branches.main.pose.tobytes(), branches.main.state.P.full().tobytes(), reports))
    assert ends[0] == ends[1]


def test_a_copy_goes_on_by_itself() -> None:
    run, cut = carried_run(5)
    back_end = RobustBackEnd(paper_rig(), parameters_for(LAB, SIGMA_M))
    list(follow(back_end, run.increments[:100], run.scans[:100]))
    copied, before = back_end.copy(), back_end.state.P.full()
    list(follow(copied, run.increments[100:cut], run.scans[100:cut]))
    assert np.array_equal(back_end.state.P.full(), before)
    list(follow(back_end, run.increments[100:cut], run.scans[100:cut]))
    assert np.array_equal(back_end.pose, copied.pose)
    assert np.array_equal(back_end.state.P.full(), copied.state.P.full())


def test_a_robot_set_down_is_as_certain_as_the_points_it_sees() -> None:
    run, cut = carried_run(6)
    back_end = RobustBackEnd(paper_rig(), parameters_for(LAB, SIGMA_M))
    list(follow(back_end, run.increments[: cut - 1], run.scans[: cut - 1]))
    landmarks, ids = back_end.state.landmarks_m.copy(), list(back_end.state.landmark_ids)
    pose = np.array([0.7, 0.2, 2.0])
    unknown = back_end.copy()
    unknown.set_down(pose, [])
    assert unknown.pose == pytest.approx(pose)
    assert math.sqrt(unknown.pose_covariance[0, 0]) > 0.5
    assert np.array_equal(unknown.state.landmarks_m, landmarks)
    back = between(pose, np.zeros(3))
    c, s = math.cos(back[2]), math.sin(back[2])
    seen = landmarks[:4] @ np.array([[c, -s], [s, c]]).T + back[:2]
    spread = 2.5e-5 * np.eye(2)
    back_end.set_down(pose, [(id_, p, spread) for id_, p in zip(ids, seen, strict=False)])
    assert back_end.pose == pytest.approx(pose, abs=1e-6)
    sigmas = np.sqrt(np.diag(back_end.pose_covariance))
    assert (sigmas[:2] < 0.015).all()
    assert (sigmas[:2] > 0.002).all()
    assert sigmas[2] < 0.02


def totals(*evidence: tuple[int, float]) -> Array:
    table = np.array(evidence, dtype=float).reshape(-1, 2)
    return totals_of([table], known_before=1000, correlated_steps=RULE.correlated_steps)


MISSED = [(id_, -3.0) for id_ in (1, 2, 3)] * 20
PRICE = RULE.price_nats


def test_totals_are_sums_of_the_landmarks_known_then() -> None:
    first, second = np.array([[4.0, 1.0], [2.0, -3.0]]), np.array([[4.0, 2.0], [9.0, 5.0]])
    found = totals_of([first, np.empty((0, 2)), second], known_before=9, correlated_steps=2.0)
    assert found.tolist() == [[2.0, -1.5], [4.0, 1.5]]
    assert totals_of([], known_before=9, correlated_steps=2.0).shape == (0, 2)


def test_ranges_that_lie_near_by_chance_for_long_do_not_make_a_place() -> None:
    """Two landmarks that seem to be there do not outweigh three that are missing."""
    chance = totals(*MISSED, *[(id_, 3.0) for id_ in (4, 5)] * 50)
    assert gain(chance, totals(*[(id_, -3.0) for id_ in (4, 5)] * 50), RULE) < 0.0


def test_two_landmarks_do_not_make_a_place() -> None:
    """Alone they do not exceed the price; a third one must confirm them."""
    main = totals(*MISSED)
    two = totals(*[(id_, 3.0) for id_ in (1, 2)] * 50, *[(3, -3.0)] * 20)
    three = totals(*[(id_, 3.0) for id_ in (1, 2, 3)] * 50)
    assert gain(two, main, RULE) <= PRICE
    assert gain(three, main, RULE) > PRICE


def test_the_evidence_of_one_landmark_is_bounded() -> None:
    """However long one landmark is missed at the main back end's pose, it is one landmark."""
    gone, there = totals(*[(1, -3.0)] * 1000), totals(*[(1, 3.0)] * 1000)
    assert gain(there, gone, RULE) <= PRICE / 2.0
    assert gain(there, gone, RULE) <= RULE.most_for


def test_a_place_that_explains_less_is_not_likelier() -> None:
    """However much the other one misses: a pose of which little is certain misses little."""
    main = totals(*MISSED, *[(4, 3.0)] * 5)
    silent, better = totals(), totals(*[(id_, 3.0) for id_ in (1, 2, 3, 5)] * 20)
    assert gain(silent, main, RULE) < 0.0
    assert gain(better, main, RULE) > PRICE


def test_evidence_is_the_likelihood_of_the_ranges() -> None:
    """Of one range alone, so that its prediction is all there is to it."""
    rng, poses = np.random.default_rng(7), straight(70)
    increments = reported(poses, LAB, rng, 0.0)
    back_end = RobustBackEnd(paper_rig(), parameters_for(LAB, SIGMA_M))
    noise, checked = back_end.parameters.ranges, 0
    for increment, scans in zip(
        increments, scans_of(poses, PLACES[[1, 5]], rng, SIGMA_M), strict=True
    ):
        back_end.predict(increment)
        report = back_end.update(scans)
        hits, missed = report.evidence[: report.dof], report.evidence[report.dof :]
        assert [id_ for id_, _ in hits] == [id_ for _, _, id_ in report.continued]
        assert all(
            nats == pytest.approx(math.log(1 - noise.detection_probability)) for _, nats in missed
        )
        if report.dof == 1:
            [(radar, _, landmark_id)] = report.continued
            [variance] = [
                p.variance
                for p in report.predicted
                if (p.radar, p.landmark_id) == (radar, landmark_id)
            ]
            n = next(len(scan.ranges_m) for scan in scans if scan.radar == radar)
            density = max(n / (noise.max_range_m - noise.min_range_m), noise.clutter_per_m)
            likelihood = math.exp(-report.nis / 2) / math.sqrt(
                math.tau * (variance + noise.sigma_m**2)
            )
            expected = math.log(noise.detection_probability * likelihood / density)
            assert hits[0][1] == pytest.approx(expected, abs=1e-6)
            checked += 1
    assert checked > 5


def test_a_robot_carried_to_where_nothing_is_missed_recognises_the_place() -> None:
    """Set down at its start again, while it believes to drive on where it has never been."""
    rng = np.random.default_rng(8)
    x = np.arange(0.0, 1.6, 0.02)
    there = np.column_stack([x, np.zeros((len(x), 2))])
    onward = np.column_stack([1.6 + x[:60], np.zeros((60, 2))])
    poses = np.vstack([there, onward, there])
    cut = len(there) + len(onward)
    increments = reported(poses, LAB, rng, 0.0, unaware=cut)
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    carried = [
        k
        for k, report in enumerate(
            follow(branches, increments, scans_of(poses, PLACES, rng, SIGMA_M)), start=1
        )
        if report.carried
    ]
    assert len(carried) == 1
    assert carried[0] > cut
    assert error_m(branches.main.pose, poses[-1]) < 0.03


def test_two_landmarks_that_are_taken_away_do_not_make_a_robot_lost() -> None:
    """Two landmarks that were taken away say nothing of the robot."""
    rng, poses = np.random.default_rng(9), straight(70)
    increments = reported(poses, LAB, rng, 0.0)
    before = list(scans_of(poses[:76], PLACES, rng, SIGMA_M))
    after = list(scans_of(poses[75:], PLACES[[0, 1, 2, 4, 5]], rng, SIGMA_M))
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    reports = list(follow(branches, increments, [*before, *after]))
    assert not any(report.lost or report.carried for report in reports)
    assert error_m(branches.main.pose, poses[-1]) < 0.03


def test_ids_after_a_carry_are_of_no_other_landmark() -> None:
    """What the robot maps at the wrong place before it finds itself keeps its ids to itself."""
    run, _ = carried_run(0)
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    ever: set[int] = set()
    for _ in follow(branches, run.increments, run.scans):
        ever |= set(branches.main.state.landmark_ids)
    assert ever > set(branches.main.state.landmark_ids)
    assert branches.main.state.next_id > max(ever)


def test_a_carried_robot_that_hears_nothing_stays_lost_until_it_finds_itself() -> None:
    """Radars are silent for 150 scans after the robot is noticed to be lost."""
    run, cut = carried_run(0, n_ways=4)
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    k, lost_at = 0, 0
    for k, report in enumerate(follow(branches, run.increments, run.scans), start=1):
        if report.lost:
            lost_at = k
            break
    assert lost_at > cut
    still = np.zeros(3)
    for _ in range(150):
        branches.predict(still)
        silent = branches.update([RangeScan(radar=radar, ranges_m=()) for radar in range(4)])
        assert silent.lost
    reports = list(follow(branches, run.increments[k:], run.scans[k:]))
    assert not reports[-1].lost
    assert error_m(branches.main.pose, run.poses[-1]) < 0.05


def test_a_carry_is_dated_to_the_earliest_step_that_explains_as_much() -> None:
    """Ten steps that confirm the pose, ten that see nothing, ten that miss three landmarks."""
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    seen, missed = ([(id_, nats) for id_ in (0, 1, 2)] for nats in (3.0, -3.0))
    for k, evidence in enumerate([seen] * 10 + [[]] * 10 + [missed] * 10):
        branches._steps[k] = Step(
            increment=np.zeros(3),
            scans=(),
            next_id=3,
            evidence=np.array(evidence, dtype=float).reshape(-1, 2),
        )
    branches._snapshots, branches._now = {0: branches.main}, 30
    since, against = branches._evidence_of_carry()
    assert since == 10
    assert against == pytest.approx(3 * min(10 * 3.0 / RULE.correlated_steps, RULE.most_against))

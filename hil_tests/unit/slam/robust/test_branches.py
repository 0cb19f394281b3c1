"""A robot that slips is put right by ranges; one that is carried away is found again."""

import math
from collections import Counter
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
from slam.geometry import between, compose, paper_rig
from slam.library.evaluation import nees_pose
from slam.results import StartOnMap
from slam.robust.association import RangeScan
from slam.robust.back_end import RobustBackEnd
from slam.robust.branches import (
    Account,
    Branches,
    Step,
    account_of,
    advantage,
    discontinuity,
    totals_of,
)
from slam.robust.parameters import BackEndParameters, BranchRule
from slam.robust.state import Array

SIGMA_M = 7.4e-3
PRIOR_LOOKS = 20  # weight of the prior of a landmark's probability of detection, in looks
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
    for k, report in enumerate(follow(branches, run.increments, run.scans, stop=cut), start=1):
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
    """40 mm and 4 degrees in one step."""
    slip = np.array([0.04, 0.0, math.radians(4.0)])
    run = slipped_run(2, slip)
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    rules = parameters_for(LAB, SIGMA_M)
    never = replace(rules.slips, steady_m=math.inf, steady_rad=math.inf)
    plain = RobustBackEnd(paper_rig(), replace(rules, slips=never))
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


@pytest.fixture(scope="module")
def known() -> RobustBackEnd:
    """Return a back end that knows seven landmarks, each hit by dozens of frames."""
    back_end = RobustBackEnd(paper_rig(), parameters_for(LAB, SIGMA_M))
    rng, poses = np.random.default_rng(10), straight(70)
    scans = scans_of(poses, PLACES, rng, SIGMA_M)
    list(follow(back_end, reported(poses, LAB, rng, 0.0), scans))
    assert len(back_end.state.landmark_ids) == len(PLACES)
    return back_end


def test_totals_are_sums_of_the_known_landmarks(known: RobustBackEnd) -> None:
    a, b, *_ = known.state.landmark_ids
    tables = [np.array([[b, 1.0], [a, -3.0]]), np.empty((0, 2)), np.array([[b, 2.0], [999.0, 5.0]])]
    found = totals_of(tables, known, RULE)
    assert found.tolist() == [[a, -3.0 / 2.0], [b, 3.0 / 2.0]]
    assert totals_of([], known, RULE).shape == (0, 2)


def test_what_one_landmark_says_is_bounded(known: RobustBackEnd) -> None:
    """For a pose by `most_for`; against it by how often it was hit: by Laplace 1 in n + 1."""
    a, b, *_ = known.state.landmark_ids
    long = [np.array([[a, -3.0], [b, 3.0]])] * 1000
    (_, against), (_, hits) = totals_of(long, known, RULE)
    n = known._existence.hits(a)
    assert against == pytest.approx(-min(math.log(n + 1), RULE.most_against))
    assert hits == RULE.most_for


def test_births_are_paid_but_a_likeness_is_not_that_rare() -> None:
    """A place where all looks alike is no likelier than new landmarks by more than a likeness."""
    stay = Account(n_new=1)
    one = account_of(np.array([[1.0, RULE.most_for]]), 0)
    assert advantage(one, stay, RULE) == pytest.approx(
        min(RULE.new_landmark_nats, RULE.likeness_nats)
    )
    many = account_of(np.array([[k, RULE.most_for] for k in range(12)]), 0)
    assert advantage(many, Account(n_new=12), RULE) == pytest.approx(RULE.likeness_nats)
    # and new landmarks of its own cost a place as much
    assert advantage(stay, one, RULE) == pytest.approx(-RULE.new_landmark_nats)


def test_what_is_missed_counts_in_full() -> None:
    place, stay = Account(hits=27.0, n_seen=3), Account(hits=0.0, misses=-15.0, n_new=3)
    likeness = min(3 * RULE.new_landmark_nats, RULE.likeness_nats)
    assert advantage(place, stay, RULE) == pytest.approx(15.0 + likeness)
    missing = replace(place, misses=-10.0)
    assert advantage(missing, stay, RULE) == pytest.approx(5.0 + likeness)


def test_the_prior_of_a_carry_is_that_of_a_poisson_process() -> None:
    moving, standing = RULE.carries_per_hour, RULE.carries_per_hour_stood
    assert RULE.carry_nats(0.2, 0.0) == pytest.approx(-math.log(moving * 0.2 / 3600), abs=1e-6)
    chance = 1 - math.exp(-(moving * 0.2 + standing * 3.0) / 3600)
    assert RULE.carry_nats(3.2, 3.0) == pytest.approx(-math.log(chance))
    assert replace(RULE, carries_per_hour=0.0).carry_nats(0.2, 0.0) == math.inf


def test_ranges_behind_a_stop_show_whether_the_robot_was_carried() -> None:
    """Four ranges of one radar, Pd 0.9; one lies within 3 cm of another by chance in 0.2."""
    noise = replace(BackEndParameters().ranges, detection_probability=0.9)
    noise = replace(noise, min_range_m=0.2, max_range_m=1.4)

    def at(*ranges_m: float) -> list[RangeScan]:
        return [RangeScan(radar=0, ranges_m=ranges_m)]

    before, other = at(0.4, 0.6, 0.8, 1.0), at(0.5, 0.7, 0.9, 1.1)
    same = discontinuity(before, at(0.41, 0.61, 0.79, 1.01), 0.03, noise)
    assert same == pytest.approx(4 * math.log(0.2 / 0.9))
    assert discontinuity(before, other, 0.03, noise) == pytest.approx(4 * math.log(0.8 / 0.1))
    blurred = [RangeScan(radar=0, ranges_m=(), blurred_m=(0.4, 0.6, 0.8, 1.0))]
    assert discontinuity(before, blurred, 0.03, noise) == pytest.approx(same)
    # a radar without a frame says nothing
    assert discontinuity(before, [RangeScan(radar=1, ranges_m=(0.5,))], 0.03, noise) == 0.0


def test_a_long_run_is_solved_for_beside_the_scans() -> None:
    """What is adopted at a fixed scan is, to the last bit, a copy that was solved and caught up."""
    rng, poses = np.random.default_rng(3), np.vstack([straight(75)] * 3)
    increments = reported(poses, LAB, rng, 0.0)
    scans = list(scans_of(poses, PLACES, rng, SIGMA_M))
    parameters = parameters_for(LAB, SIGMA_M)
    rule = replace(parameters.relinearisation, most_at_once=100, adopted_after=13)
    branches = Branches(paper_rig(), replace(parameters, relinearisation=rule))
    copies, adopted = dict[int, RobustBackEnd](), list[int]()
    for k, (increment, seen) in enumerate(zip(increments, scans, strict=True), start=1):
        before, was_solving = branches.main, branches._solving is not None
        for copied in copies.values():
            copied.predict(increment, elapsed_s=1.0)
            copied.update(seen, solve=False)
        branches.predict(increment)
        branches.update(seen)
        if branches.main is not before:
            begun, solved = copies.popitem()
            # It has caught up ten steps at a time.
            assert k == begun + rule.adopted_after + 1
            assert branches.main.pose.tobytes() == solved.pose.tobytes()
            assert branches.main.pose_covariance.tobytes() == solved.pose_covariance.tobytes()
            adopted.append(k)
        elif was_solving and branches._solving is None:  # the main one was solved for meanwhile
            copies.clear()
        elif branches._solving is not None and not was_solving:
            assert k >= rule.most_at_once
            copies[k] = branches.main.copy()
            copies[k].relinearise()
    assert len(adopted) > 1
    assert math.dist(branches.main.pose, poses[-1]) < 0.05


def test_a_solution_is_dropped_if_the_run_was_solved_for_in_the_step_that_began_it() -> None:
    """As a merge does: what is computed beside knows nothing of it."""
    rng, poses = np.random.default_rng(3), np.vstack([straight(75)] * 2)
    parameters = parameters_for(LAB, SIGMA_M)
    rule = replace(parameters.relinearisation, most_at_once=100, adopted_after=3)
    branches = Branches(paper_rig(), replace(parameters, relinearisation=rule))
    main, n_dropped, begun = branches.main, 0, None
    for _ in follow(
        branches, reported(poses, LAB, rng, 0.0), scans_of(poses, PLACES, rng, SIGMA_M)
    ):
        if begun is not None:
            assert branches._solving is None
            n_dropped += 1
        begun = branches._solving
        if begun is not None:
            branches.main.relinearise()
    assert n_dropped > 1
    assert branches.main is main


@pytest.mark.parametrize(("stop", "n_before"), [(1, 0), (5, 0), (15, 2), (25, 4)])
def test_a_doubt_on_too_few_landmarks_ends_with_three_newer_ones(stop: int, n_before: int) -> None:
    """A stop before the first drive is no doubt; three that were mapped by then are waited for."""
    rng, poses = np.random.default_rng(3), straight(60)
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    steps = follow(
        branches, reported(poses, LAB, rng, 0.0), scans_of(poses, PLACES, rng, SIGMA_M), stop=stop
    )
    n_known, n_doubts, n_new = 0, list[int](), list[int]()
    first_id = None
    for k in range(1, len(poses)):
        if k == stop:
            n_known, first_id = branches.main.n_reported_since(0), branches.main.state.next_id
        next(steps)
        if first_id is not None:
            n_doubts.append(len(branches._doubts))
            n_new.append(branches.main.n_reported_since(first_id))
    assert n_known == n_before
    assert n_new[-1] >= RULE.least_landmarks
    if stop == 1:
        assert not any(n_doubts)
    elif n_known < RULE.least_landmarks:
        end = n_doubts.index(0)
        enough = next(k for k, n in enumerate(n_new) if n >= RULE.least_landmarks)
        assert enough <= end <= enough + branches._look_every
        assert not any(n_doubts[end:])
    else:
        assert all(n_doubts)


def test_a_doubt_on_a_given_map_is_not_ended_by_what_is_new_beside_it() -> None:
    """However few landmarks the map has: the robot's place is one on that map."""
    rng, poses = np.random.default_rng(3), straight(60)
    increments, parameters = reported(poses, LAB, rng, 0.0), parameters_for(LAB, SIGMA_M)
    scans = list(scans_of(poses, PLACES, rng, SIGMA_M))
    first = RobustBackEnd(paper_rig(), parameters)
    for _ in follow(first, increments[:15], scans[:15]):
        pass
    on_map = StartOnMap(map=first.map_now(), pose=(0.0, 0.0, 0.0))
    assert len(on_map.map.landmarks) == 2
    branches = Branches(paper_rig(), parameters, on_map)
    for _ in follow(branches, increments, scans, stop=3):
        pass
    assert branches.main.n_reported_since(on_map.map.next_id) >= RULE.least_landmarks
    assert branches._doubts


def test_evidence_is_the_likelihood_of_the_ranges() -> None:
    """Of one range alone, so that its prediction is all there is to it."""
    rng, poses = np.random.default_rng(7), straight(70)
    increments = reported(poses, LAB, rng, 0.0)
    back_end = RobustBackEnd(paper_rig(), parameters_for(LAB, SIGMA_M))
    noise, checked = back_end.parameters.ranges, 0
    heard, unheard = Counter[int](), Counter[int]()
    for increment, scans in zip(
        increments, scans_of(poses, PLACES[[1, 5]], rng, SIGMA_M), strict=True
    ):
        back_end.predict(increment)
        report = back_end.update(scans)
        hits, missed = report.evidence[: report.dof], report.evidence[report.dof :]
        assert [id_ for id_, _ in hits] == [id_ for _, _, id_ in report.continued]
        for id_, nats in missed:
            if nats > 0.0:  # of a new landmark
                continue
            n_missed = PRIOR_LOOKS * (1 - noise.detection_probability) + unheard[id_]
            looks = PRIOR_LOOKS + heard[id_] + unheard[id_]
            assert nats == pytest.approx(math.log(n_missed / looks))
            unheard[id_] += 1
        heard.update(id_ for _, _, id_ in report.continued)
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
            follow(branches, increments, scans_of(poses, PLACES, rng, SIGMA_M), stop=cut), start=1
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


@pytest.mark.rare
def test_a_carried_robot_that_hears_nothing_stays_lost_until_it_finds_itself() -> None:
    """Radars are silent for 150 scans after the robot is noticed to be lost."""
    run, cut = carried_run(7, n_ways=4)
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    k, lost_at = 0, 0
    for k, report in enumerate(follow(branches, run.increments, run.scans, stop=cut), start=1):
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


def test_a_carry_is_dated_to_the_earliest_step_that_explains_as_much(known: RobustBackEnd) -> None:
    """Ten steps that confirm the pose, ten that see nothing, ten that miss three landmarks."""
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    branches.main = known.copy()
    ids = known.state.landmark_ids[:3]
    seen, missed = ([(id_, nats) for id_ in ids] for nats in (3.0, -3.0))
    for k, evidence in enumerate([seen] * 10 + [[]] * 10 + [missed] * 10):
        branches._steps[k] = Step(
            increment=np.zeros(3),
            scans=(),
            elapsed_s=0.2,
            next_id=known.state.next_id,
            evidence=np.array(evidence, dtype=float).reshape(-1, 2),
            carry_nats=RULE.carry_nats(0.2, 0.0),
        )
    branches._snapshots, branches._now = {0: branches.main}, 30
    assert branches._most_suspicious() == 10
    # a stop is where robots are carried
    stop = RULE.carry_nats(3.2, 3.0)
    branches._steps[14] = replace(branches._steps[14], carry_nats=stop)
    assert branches._most_suspicious() == 14
    # and what is seen elsewhere is no reason to be carried
    for k in range(20, 30):
        branches._steps[k] = replace(branches._steps[k], evidence=np.empty((0, 2)))
    assert branches._most_suspicious() == 30


def test_a_row_of_equal_things_is_no_reason_to_be_carried() -> None:
    """Pairs of rods every half metre, 4 m long, there and back: each looks like the one before."""
    rng = np.random.default_rng(11)
    x = np.arange(0.0, 3.6, 0.02)
    there = np.column_stack([x, np.zeros((len(x), 2))])
    poses = np.vstack([there, there[::-1]])
    rods = np.array([[0.3 + 0.5 * k, side * 0.8] for k in range(7) for side in (-1, 1)])
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    scans = scans_of(poses, rods, rng, SIGMA_M)
    reports = list(follow(branches, reported(poses, LAB, rng, 0.0), scans))
    assert not any(report.carried or report.lost for report in reports)
    assert error_m(branches.main.pose, poses[-1]) < 0.03


def test_a_lost_pose_holds_all_motions_since_the_carry() -> None:
    """The first of them, too, though it leads from another place: a turn of 17 degrees here."""
    run, cut = carried_run(0)
    increments = list(run.increments)
    increments[cut - 1] = np.array([0.0, 0.0, 0.3])
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    for report in follow(branches, increments, run.scans, stop=cut):
        if report.lost:
            break
    assert branches.lost_pose is not None
    before = branches.map.pose
    motion = np.zeros(3)
    assert branches._carry is not None
    for increment in increments[branches._carry.since : branches._now]:
        motion = compose(motion, increment)
    assert branches.lost_pose[0] == pytest.approx(compose(before, motion))
    assert abs(branches.lost_pose[0][2] - before[2]) > 0.2


def test_a_place_that_misses_more_than_staying_is_taken_back() -> None:
    run, cut = carried_run(0)
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    for _ in follow(branches, run.increments, run.scans, stop=cut):
        if branches._carry is not None and branches._carry.stayed is not None:
            break
    carry = branches._carry
    assert carry is not None
    stayed = carry.stayed
    assert stayed is not None
    assert stayed.back_end is not branches.main
    # Let all evidence change sides: what the place has is that of the one that stayed.
    adopted = [branches._steps[k].evidence for k in range(carry.since, branches._now)]
    for k, evidence in enumerate(stayed.evidence, start=carry.since):
        branches._steps[k] = replace(branches._steps[k], evidence=evidence)
    stayed.evidence = adopted
    assert carry.adopted is not None
    carry.adopted.price_nats = 0.0
    rest = slice(branches._now, None)
    for _ in follow(branches, run.increments[rest], run.scans[rest]):
        if branches._carry is None:
            break
    assert branches.main is stayed.back_end


@pytest.mark.rare
@pytest.mark.parametrize("stops", [pytest.param(True, marks=pytest.mark.thorough), False])
def test_a_robot_that_stays_lost_needs_bounded_memory(*, stops: bool) -> None:
    """It is carried to where it has never been, and drives to and fro there for 1300 scans.

    Its wheels stood before that, or did not report a step.
    """
    rng = np.random.default_rng(13)
    x = np.arange(0.0, 1.5, 0.02)
    there = straight(60)
    ways = [np.column_stack([20.0 + x, np.zeros((len(x), 2))])]
    ways.append(ways[0][::-1])
    poses = np.vstack([there, *(ways * 9)])
    unknown = np.array([[20.2, 0.7], [20.5, -0.9], [20.9, 1.0], [21.3, -0.6], [21.4, 0.8]])
    increments = reported(poses, LAB, rng, 0.0, unaware=len(there))
    scans = scans_of(poses, np.vstack([PLACES, unknown]), rng, SIGMA_M)
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    rule = replace(RULE, carry_steps=600)
    branches._rule = rule
    most, lost = 0, list[bool]()
    for report in follow(branches, increments, scans, stop=len(there) if stops else None):
        most = max(most, len(branches._steps))
        lost.append(report.lost)
    assert all(lost[-1000:])
    # what the snapshots reach back to, and a search
    assert most <= rule.snapshots * rule.snapshot_every + rule.carry_steps + rule.snapshot_every

"""Possible slips of the wheels: what is one, what it leaves open, and that ranges then decide."""

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil_tests.unit.slam.robust.range_world import (
    LAB,
    Array,
    Run,
    follow,
    parameters_for,
    polar,
    simulate,
)
from slam.config import WheelNoise
from slam.geometry import between, compose, paper_rig
from slam.robust.branches import Branches
from slam.robust.parameters import BranchRule, LagRule, SlipRule
from slam.robust.proposals.doubts import covered_share
from slam.robust.proposals.slips import PossibleSlip, SlipDetector
from slam.robust.solver.run_log import RunLog
from slam.robust.state import calibrated_motion

SIGMA_M = 3e-3
RULE = SlipRule()
SLIP = np.array([0.03, 0.0, math.radians(8.0)])
AHEAD = np.array([0.1, 0.0, 0.0])
TURN = np.array([0.0, 0.0, 0.1])
MOTIONS = st.builds(
    lambda x, y, turn: np.array([x, y, turn]),
    st.floats(-0.3, 0.3),
    st.floats(-0.3, 0.3),
    st.floats(-0.5, 0.5),
)
CHANGES = st.builds(
    lambda away, direction, turn: np.array(
        [away * math.cos(direction), away * math.sin(direction), turn]
    ),
    st.floats(0.0, 0.45 * RULE.steady_m),
    st.floats(0.0, math.tau),
    st.floats(-0.45 * RULE.steady_rad, 0.45 * RULE.steady_rad),
)


def slips_of(
    increments: Iterable[Array], took_s: Iterable[float] | None = None
) -> list[PossibleSlip]:
    """Return the possible slips of increments that took 0.2 s each, or as long as is given.

    The wheels have next to no noise.
    """
    detector, steps = SlipDetector(RULE, 4.0), list(increments)
    found = [
        detector.take(
            calibrated_motion(step, np.zeros(3), WheelNoise(), 1e-12 * np.eye(3)), elapsed_s
        )
        for step, elapsed_s in zip(steps, took_s or [0.2] * len(steps), strict=True)
    ]
    return [one for one in found if one is not None]


def chained(increments: Iterable[Array]) -> Array:
    pose = np.zeros(3)
    for increment in increments:
        pose = compose(pose, increment)
    return pose


@pytest.mark.parametrize("parts", [(1.0,), (0.5, 0.5), (0.8, 0.2)], ids=str)
@pytest.mark.parametrize("turn_rad", [0.0, 0.3], ids=str)
@pytest.mark.parametrize("away_m", [0.0, 0.2], ids=str)
def test_a_slip_leaves_the_mean_square_of_both_ways_to_drive(
    away_m: float, turn_rad: float, parts: tuple[float, ...]
) -> None:
    """Either the robot made the motion, or it went on as around it: an error of half a chance.

    To first order, and that is tight across its direction, too.
    """
    motion, slip = np.array([away_m, 0.0, turn_rad]), np.array([-0.03, 0.02, -0.12])
    steps = [motion + part * slip for part in parts]
    (found,) = slips_of([motion] * 3 + [*steps, motion])
    # A step that is shorter may be a pause, in which the robot did less, too
    without = [share_of(step, motion) * motion for step in steps]
    error = between(chained([*steps, motion]), chained([*without, motion]))
    values, vectors = np.linalg.eigh(found.since.covariance)
    size_and_way = math.sqrt(2.0 * values[2]) * vectors[:, 2]
    assert abs(values[:2]).max() < 1e-12
    expected = error * np.sign(size_and_way @ error)
    second_order = 0.5 * 0.12**2 * 0.4  # of the way of two steps
    np.testing.assert_allclose(size_and_way, expected, atol=second_order)
    assert not found.since.step_m.any()
    assert found.since.turn_rad == 0.0


def share_of(step: Array, motion: Array) -> float:
    """Return the share of a motion nearest to a step, up to 1; 1 cm is as far as 0.02 rad."""
    scales = np.array([RULE.steady_m, RULE.steady_m, RULE.steady_rad])
    square = float(np.sum((motion / scales) ** 2))
    share = float(np.sum(step * motion / scales**2)) / square if square else 0.0
    return min(max(share, 0.0), 1.0)


def test_a_run_may_begin_with_a_slip() -> None:
    """Before it the robot is taken to have moved as after it."""
    (found,) = slips_of([AHEAD + SLIP] + [AHEAD] * 3)
    assert len(found.covariances) == 1
    assert found.since.covariance[2, 2] == pytest.approx(0.5 * SLIP[2] ** 2)


def test_a_run_may_begin_with_two_steps_of_a_motion_that_ends() -> None:
    assert slips_of([AHEAD] * 2 + [TURN] * 3) == []


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0, 1.4], ids=str)
def test_a_run_may_begin_slowly(share: float) -> None:
    """From standing, or with a step that is a little long."""
    assert slips_of([share * AHEAD] + [AHEAD] * 4) == []


def test_a_motion_that_begins_is_undecided_until_it_has_gone_on() -> None:
    """It may be a slip of two steps until a third; then it is the robot's own."""
    detector = SlipDetector(RULE, 4.0)
    undecided = []
    for step in [AHEAD] * 3 + [TURN] * 4:
        detector.take(calibrated_motion(step, np.zeros(3), WheelNoise(), 1e-12 * np.eye(3)), 0.2)
        undecided.append(detector.undecided_covariance()[2, 2])
    square = 0.5 * TURN[2] ** 2
    np.testing.assert_allclose(undecided, [0.0] * 3 + [square, 4.0 * square] + [0.0] * 2)


def test_two_slips_that_follow_on_each_other_are_one_of_three_steps() -> None:
    """Each between two samples of odometry, so that the second step has a part of both."""
    parts = [AHEAD + share * SLIP for share in (0.3, 1.1, 0.6)]
    (found,) = slips_of([AHEAD] * 3 + parts + [AHEAD] * 2)
    assert len(found.covariances) == 3
    assert found.since.covariance[2, 2] == pytest.approx(0.5 * (2.0 * SLIP[2]) ** 2, rel=1e-6)


@pytest.mark.parametrize("n", [3, 4])
def test_a_motion_that_keeps_its_rate_for_three_steps_is_no_slip(n: int) -> None:
    """As a correction of the course; of two steps it may be one slip between two samples."""
    assert slips_of([AHEAD] * 3 + [AHEAD + 0.5 * SLIP] * n + [AHEAD] * 2) == []
    parts = [AHEAD + share * SLIP for share in (0.5, 0.5, 0.1)]
    assert slips_of([AHEAD] * 3 + parts + [AHEAD] * 2) == []


def test_a_motion_that_ends_at_once_is_undecided_if_either_step_may_have_slipped() -> None:
    """The robot stopped for a step, then moved on by one and a half steps and stopped again."""
    detector = SlipDetector(RULE, 4.0)
    for step in [AHEAD] * 3 + [0.0 * AHEAD, 1.5 * AHEAD]:
        detector.take(calibrated_motion(step, np.zeros(3), WheelNoise(), 1e-12 * np.eye(3)), 0.2)
    assert detector.undecided_covariance()[0, 0] == pytest.approx(0.5 * 0.15**2)


def test_a_slip_while_the_robot_speeds_up() -> None:
    steps = [AHEAD + np.array([0.0015 * k, 0.0, 0.0]) for k in range(20)]
    steps[10] = steps[10] + np.array([0.0, 0.0, 0.1])
    (found,) = slips_of(steps)
    assert found.since.covariance[2, 2] == pytest.approx(0.5 * 0.1**2, rel=0.05)


@pytest.mark.parametrize("tick_m", [1e-3, 2e-3])
def test_wheels_that_count_coarsely_do_not_slip(tick_m: float) -> None:
    """But for the first steps, before it shows that they do. The track is 20 cm."""
    left_m, right_m = (
        tick_m * np.floor(np.arange(300.0) * way_m / tick_m) for way_m in (0.0201, 0.0207)
    )
    left, right = np.diff(left_m), np.diff(right_m)
    steps = [np.array([(a + b) / 2, 0.0, (b - a) / 0.2]) for a, b in zip(left, right, strict=True)]
    assert len(slips_of(steps)) <= 2


def test_a_heading_that_swings_is_no_slip_but_at_first() -> None:
    swing = np.array([0.0, 0.0, 0.0055])
    steps = [AHEAD + (-1) ** k * swing for k in range(300)]
    assert len(slips_of(steps)) <= 3


def test_back_and_on_again_by_as_much_leaves_nothing() -> None:
    assert slips_of([AHEAD] * 3 + [-AHEAD, 2.0 * AHEAD] + [AHEAD] * 3) == []


def test_a_slip_is_undecided_until_the_step_after_it() -> None:
    detector = SlipDetector(RULE, 4.0)
    for step in [AHEAD] * 3 + [AHEAD + SLIP]:
        detector.take(calibrated_motion(step, np.zeros(3), WheelNoise(), 1e-12 * np.eye(3)), 0.2)
    undecided = detector.undecided_covariance()
    assert undecided[2, 2] == pytest.approx(0.5 * SLIP[2] ** 2)
    after = calibrated_motion(AHEAD, np.zeros(3), WheelNoise(), 1e-12 * np.eye(3))
    assert detector.take(after, 0.2) is not None
    assert not detector.undecided_covariance().any()


@given(before=MOTIONS, after=MOTIONS, share=st.floats(0.0, 1.0))
def test_a_motion_that_begins_or_ends_is_no_slip(before: Array, after: Array, share: float) -> None:
    """Of any size, also where it begins within a step."""
    within = before + share * (after - before)
    assert slips_of([before] * 4 + [within] + [after] * 4) == []


@given(
    before=MOTIONS,
    after=MOTIONS,
    shares=st.lists(st.tuples(*[st.floats(0.0, 0.5)] * 2), max_size=2),
)
def test_a_mixture_of_the_motions_around_it_is_no_slip(
    before: Array, after: Array, shares: list[tuple[float, float]]
) -> None:
    """The robot slows down from the one and comes into the other, but keeps no third one."""
    within = [a * before + b * after for a, b in shares]
    found = slips_of([before] * 4 + within + [after] * 4)
    assert not [one for one in found if one.n_since == 2]


@given(share=st.floats(0.0, 1.0))
def test_a_mixture_may_be_half_as_much_again(share: float) -> None:
    """Times that are a little off make one step shorter and another one longer."""
    most = RULE.most_share * (share * AHEAD + (1.0 - share) * TURN)
    assert slips_of([AHEAD] * 3 + [most] + [TURN] * 3) == []
    beyond = most + np.array([0.0, 1.5 * RULE.steady_m, 0.0])
    assert [one.n_since for one in slips_of([AHEAD] * 3 + [beyond] + [TURN] * 3)] == [2]


@pytest.mark.parametrize("parts", [(1.0,), (0.5, 0.5), (0.3, 1.1, 0.6)], ids=str)
@pytest.mark.parametrize("motions", [(AHEAD, TURN), (0.0 * TURN, AHEAD), (TURN, -TURN)], ids=str)
def test_a_slip_where_the_motion_changes_is_seen_two_steps_later(
    motions: tuple[Array, Array], parts: tuple[float, ...]
) -> None:
    """It is across both motions; which of them the robot made meanwhile is not known."""
    before, after = motions
    across = np.array([0.0, 0.1, 0.0])
    steps = [before + share * across for share in parts]
    assert slips_of([before] * 3 + [*steps, after]) == []
    (found,) = slips_of([before] * 3 + [*steps, after, after])
    assert (found.n_since, len(found.covariances)) == (2, len(parts))
    errors = [step - after for step in steps]  # `steps` are like the motion before them
    whole = sum(errors)
    scales = np.array([RULE.steady_m, RULE.steady_m, RULE.steady_rad])
    share = np.sum((whole / scales) ** 2) / sum(np.sum((one / scales) ** 2) for one in errors)
    for error, covariance in zip(errors, found.covariances, strict=True):
        np.testing.assert_allclose(covariance, 0.5 * share * np.outer(error, error), atol=1e-12)
    ways = [chained([*some, after, after]) for some in (steps, [after] * len(steps))]
    # To first order, as for a slip of steps that are alike
    size = math.sqrt(float(np.trace(found.since.covariance)) * 2.0)
    assert size == pytest.approx(math.dist(between(*ways), np.zeros(3)), rel=0.05)
    assert slips_of([before] * 3 + [*steps, after, 1.2 * after]) == []  # not kept yet


@given(motion=MOTIONS, changes=st.lists(CHANGES, min_size=4, max_size=12))
def test_what_changes_as_a_steady_motion_does_is_no_slip(
    motion: Array, changes: list[Array]
) -> None:
    """Three steps differ by six changes at most from three like those around them."""
    assert slips_of([motion + 0.5 * change for change in changes]) == []


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("axis", [0, 2], ids=["along", "turn"])
def test_the_limit_grows_with_the_noise_of_more_than_two_steps(n: int, axis: int) -> None:
    """The variance of n steps against the mean of two others is n + n^2 / 2; that of two is 4."""
    limit = [RULE.steady_m, 0.0, RULE.steady_rad][axis] * math.sqrt(max(n + n**2 / 2, 4.0) / 4.0)
    for share, is_slip in ((0.99, False), (1.01, True)):
        parts = np.zeros((n, 3))
        parts[:, axis] = share * limit / n
        if n == 3:  # of which none is like another one
            parts[:, axis] += np.array([2.0 * limit, -3.0 * limit, limit])
        # Along the way half as much again of the motion would be an ordinary step
        motion = TURN if axis == 0 else AHEAD
        detector, undecided = SlipDetector(RULE, 4.0), 0.0
        found = []
        for step in [motion] * 3 + [*(motion + parts)] + [motion]:
            undecided = detector.undecided_covariance()[axis, axis]
            taken = calibrated_motion(step, np.zeros(3), WheelNoise(), 1e-12 * np.eye(3))
            found.append(detector.take(taken, 0.2))
        assert [one is not None for one in found] == [False] * (3 + n) + [is_slip]
        assert bool(undecided) == (is_slip or n == 3)  # before the step that showed it


@given(motion=MOTIONS, missing=st.integers(1, 5))
def test_missing_frames_are_no_slip(motion: Array, missing: int) -> None:
    n = missing + 1
    took_s = [0.2] * 3 + [0.2 * n] + [0.2] * 3
    assert slips_of([motion] * 3 + [n * motion] + [motion] * 3, took_s) == []


@given(motion=MOTIONS, share=st.floats(0.0, 1.0), stood_s=st.floats(0.0, 60.0))
def test_a_pause_is_no_slip(motion: Array, share: float, stood_s: float) -> None:
    took_s = [0.2] * 3 + [0.2 + stood_s] + [0.2] * 3
    assert slips_of([motion] * 3 + [share * motion] + [motion] * 3, took_s) == []


@given(
    motion=MOTIONS.map(lambda motion: motion * [1.0, 0.0, 1.0]),
    late=st.lists(st.floats(0.0, 0.12), min_size=5, max_size=12),
)
def test_odometry_that_is_late_is_no_slip(motion: Array, late: list[float]) -> None:
    """By up to an eighth of a step, each time by another part of it."""
    shares = 1.0 - np.diff(late)
    assert slips_of([share * motion for share in shares]) == []


@given(motion=MOTIONS, sign=st.sampled_from([-1.0, 1.0]))
def test_a_turn_beyond_the_limit_is_a_slip_once(motion: Array, sign: float) -> None:
    turn = np.array([0.0, 0.0, sign * 1.01 * RULE.steady_rad])
    # What turns anyway may turn less for a step: it has paused
    motion = motion * [1.0, 1.0, 0.0]
    assert len(slips_of([motion] * 4 + [motion + turn] + [motion] * 4)) == 1


def test_what_the_noise_of_the_wheels_explains_is_no_slip() -> None:
    """One step against the mean of two, of 6 mm noise along and across: four sigmas are 42 mm."""
    covariance = np.diag([6e-3, 6e-3, 1e-4]) ** 2
    for away_m, n_found in ((0.041, 0), (0.042, 1)):
        detector, steps = SlipDetector(RULE, 4.0), [AHEAD] * 3
        steps += [AHEAD + np.array([0.0, away_m, 0.0]), AHEAD, AHEAD]
        motions = [calibrated_motion(one, np.zeros(3), WheelNoise(), covariance) for one in steps]
        found = [detector.take(one, 0.2) for one in motions]
        assert sum(one is not None for one in found) == n_found


def test_two_steps_of_one_time_have_no_rate() -> None:
    steps = [AHEAD] * 3 + [AHEAD + SLIP, AHEAD, AHEAD]
    assert slips_of(steps, [0.2, 0.2, 0.2, 0.2, 0.0, 0.2]) == []
    assert slips_of(steps, [0.2, 0.2, 0.2, 0.0, 0.2, 0.2]) == []


def test_a_motion_that_the_wheels_did_not_report_is_no_neighbour() -> None:
    detector, motion = SlipDetector(RULE, 4.0), calibrated_motion(AHEAD, np.zeros(3), WheelNoise())
    slipped = calibrated_motion(AHEAD + SLIP, np.zeros(3), WheelNoise())
    assert [detector.take(one, 0.2) for one in (motion, motion, slipped)] == [None] * 3
    detector.begin_anew()
    assert detector.take(motion, 0.2) is None
    # What it was before that is not the first step of a run
    assert detector.take(slipped, 0.2) is None


# --- in the back end ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run() -> Run:
    """Return two laps; the robot turns on the spot in the corners, 5.6 degrees a step."""
    return simulate(LAB, seed=2, sigma_m=SIGMA_M, laps=2)


def slipped(run: Run, step: int) -> Array:
    """Return what the wheels report if they slip in a step."""
    increments = run.increments.copy()
    increments[step] = compose(increments[step], SLIP)
    return increments


def straight_steps(run: Run) -> list[int]:
    """Return the steps of the second lap that neither begin nor end near a corner."""
    turns = np.abs(np.diff(run.poses[:, 2]))
    half = len(turns) // 2
    return [k for k in range(half, len(turns) - 60) if not turns[k - 5 : k + 5].any()]


def n_in_view(run: Run, step: int) -> int:
    """Return how many landmarks some radar has well in view after a step."""
    found = np.zeros(len(run.landmarks), dtype=bool)
    for mount in paper_rig().mounts:
        ranges_m, off_rad = polar(run.poses[step + 1 : step + 2], mount, run.landmarks)
        found |= ((ranges_m > 0.3) & (ranges_m < 1.4) & (off_rad < 0.5))[0]
    return int(found.sum())


def test_corners_are_no_slips(run: Run) -> None:
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    for _ in follow(branches, run.increments, [[]] * len(run.increments)):
        assert branches.main.slipped is None


def test_a_slip_in_a_corner_leaves_its_own_step_uncertain(run: Run) -> None:
    turns = np.abs(np.diff(run.poses[:, 2])) > 0.05
    corner = next(k for k in range(10, len(turns)) if turns[k] and not turns[k - 3 : k].any())
    increments = run.increments.copy()
    increments[corner - 1] += [0.0, 0.0, -math.copysign(0.2, increments[corner, 2])]
    back_end = Branches(paper_rig(), parameters_for(LAB, SIGMA_M)).main
    sigmas_rad = []
    for increment in increments[: corner + 2]:
        back_end.predict(increment, elapsed_s=0.2)
        back_end.update([])
        sigmas_rad.append(math.sqrt(back_end.pose_covariance[2, 2]))
    assert back_end.slipped is not None
    assert sigmas_rad[-2] < 0.03
    # If the robot had begun to turn already, the other way, it is off by that, too
    error_rad = 0.2 + abs(run.increments[corner, 2])
    assert sigmas_rad[-1] == pytest.approx(error_rad / math.sqrt(2.0), rel=0.05)
    loosened = [k for k, noise in enumerate(back_end._log._covariances.rows) if noise[2, 2] > 0.01]
    assert loosened == [corner - 1]


def test_what_was_assigned_in_a_slip_is_left_out_of_the_whole_run() -> None:
    """From its pose on, but for landmarks with labels and those that were first seen then."""
    log = RunLog(WheelNoise(), 5)
    motion = calibrated_motion(AHEAD, np.zeros(3), WheelNoise())
    for pose in range(4):
        log.add_motion(AHEAD, motion)
        for landmark in (0, 1, 2) if pose > 1 else (0, 1):
            log.add_range(
                pose, 0, landmark, antenna=(0.0, 0.0), turn_rad=0.0, range_m=1.0, sigma_m=0.01
            )
    log.leave_out_since(2, [1])
    rows = log._ranges.rows
    kept = [(pose, id_) for pose, id_ in rows[["pose", "landmark"]].tolist() if id_ >= 0]
    assert kept == [(0, 0), (0, 1), (1, 0), (1, 1), (2, 1), (2, 2), (3, 1), (3, 2)]


def test_ranges_of_a_slip_are_left_out(run: Run) -> None:
    """Those of the step that slipped; the step after it has shown it."""
    step = max(straight_steps(run), key=lambda k: n_in_view(run, k))
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    n = step + 2
    for _ in follow(branches, slipped(run, step)[:n], run.scans[:n]):
        pass
    rows = branches.main._log._ranges.rows
    left_out = set(rows["pose"][rows["landmark"] < 0].tolist())
    assert left_out == {step + 1}
    assert step in rows["pose"][rows["landmark"] >= 0]


def test_a_slip_in_sight_of_landmarks_is_corrected_by_their_ranges(run: Run) -> None:
    step = max(straight_steps(run), key=lambda k: n_in_view(run, k))
    assert n_in_view(run, step) >= 3
    branches, end = Branches(paper_rig(), parameters_for(LAB, SIGMA_M)), step + 60
    found = []
    for k, _ in enumerate(follow(branches, slipped(run, step)[:end], run.scans[:end])):
        found += [k] if branches.main.slipped is not None else []
        if k == step:
            truth = run.poses[k + 1]
            turn = math.remainder(branches.main.pose[2] - truth[2], math.tau)
            assert abs(turn) > math.radians(6.0)  # as the wheels have it
            assert abs(turn) < 2.0 * math.sqrt(branches.doubted_covariance[2, 2])
    assert found == [step + 1]
    truth, back_end = run.poses[end], branches.main
    assert abs(math.remainder(back_end.pose[2] - truth[2], math.tau)) < math.radians(1.5)
    assert math.hypot(*(back_end.pose - truth)[:2]) < 0.02


def test_a_filter_that_is_sure_behind_a_slip_leaves_it_in_doubt(run: Run) -> None:
    """It may have taken a landmark for another one."""
    step = max(straight_steps(run), key=lambda k: n_in_view(run, k))
    branches, end = Branches(paper_rig(), parameters_for(LAB, SIGMA_M)), step + 2
    for _ in follow(branches, slipped(run, step)[:end], run.scans[:end]):
        pass
    branches.main.state.set_pose(branches.main.pose, 1e-8 * np.eye(3))
    sigma_rad = math.sqrt(branches.doubted_covariance[2, 2])
    assert sigma_rad == pytest.approx(math.sqrt(0.5) * SLIP[2], rel=0.1)


def test_a_slip_before_any_landmark_stays_in_doubt_whatever_is_mapped_since(run: Run) -> None:
    """The place where the map begins is unsure by it for good."""
    branches, end = Branches(paper_rig(), parameters_for(LAB, SIGMA_M)), 160
    for _ in follow(branches, slipped(run, 20)[:end], [[]] * 23 + run.scans[23:end]):
        pass
    assert branches.main.n_reported_since(0) >= BranchRule().least_landmarks
    branches.main.state.set_pose(branches.main.pose, 1e-8 * np.eye(3))
    sigma_rad = math.sqrt(branches.doubted_covariance[2, 2])
    assert sigma_rad == pytest.approx(math.sqrt(0.5) * SLIP[2], rel=0.1)


def test_of_a_slip_in_sight_of_nothing_the_pose_is_that_of_the_wheels(run: Run) -> None:
    """Its covariance has half of the square of the slip; what it has besides is of the wheels."""
    ends = []
    for increments in (slipped(run, 20), run.increments):
        branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
        for _ in follow(branches, increments[:23], [[]] * 23):
            pass
        np.testing.assert_allclose(branches.main.pose, chained(increments[:23]), atol=1e-9)
        ends.append(branches.main.pose_covariance)
    added = ends[0] - ends[1]
    assert added[2, 2] == pytest.approx(0.5 * SLIP[2] ** 2, rel=0.1)
    assert added[0, 0] == pytest.approx(0.5 * SLIP[0] ** 2, rel=0.1)


def test_poses_kept_in_a_slip_are_given_up_and_those_before_stay(run: Run) -> None:
    """They would be as sure as before it, while ranges correct the pose that comes after them."""
    rules = replace(parameters_for(LAB, SIGMA_M), lag=LagRule(every=1, way_m=10.0))
    rules = replace(rules, relinearisation=replace(rules.relinearisation, key_m=0.001))
    branches = Branches(paper_rig(), rules)
    for _ in follow(branches, slipped(run, 20)[:22], [[]] * 22):
        pass
    # The slip leads to pose 21; the step after it to 22
    assert branches.main.slipped is not None
    assert branches.main.state.past_numbers == list(range(1, 21))


def test_a_back_end_that_is_made_again_has_the_same_slips(run: Run) -> None:
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    for _ in follow(branches, slipped(run, 20)[:30], run.scans[:30]):
        pass
    again = branches._at(branches._now)
    np.testing.assert_array_equal(again.pose, branches.main.pose)
    np.testing.assert_array_equal(again.pose_covariance, branches.main.pose_covariance)


def test_a_stop_may_have_been_a_carry_until_landmarks_are_recognised(run: Run) -> None:
    branches, rule = Branches(paper_rig(), parameters_for(LAB, SIGMA_M)), BranchRule()
    n, stop = len(run.increments) * 5 // 8, len(run.increments) // 2
    sigmas_m = [
        math.sqrt(branches.doubted_covariance[0, 0])
        for _ in follow(branches, run.increments[:n], run.scans[:n], stop)
    ]
    carried = -math.expm1(-rule.carries_per_hour_stood * 3.0 / 3600.0)
    probability = carried / (1.0 + carried)
    covered_m = math.sqrt(covered_share(probability)) * rule.lost_position_m
    assert 0.95 * covered_m < sigmas_m[stop - 1] < 1.05 * covered_m
    assert sigmas_m[-1] < 0.1 * sigmas_m[stop - 1]


def test_what_is_undecided_lies_along_the_newest_motion_in_the_map(run: Run) -> None:
    """Half the square of the error, but for the noise of the step before; across the map."""
    step = next(k for k in straight_steps(run) if abs(math.sin(run.poses[k, 2])) > 0.9)
    back_end = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    increments = run.increments[: step + 1].copy()
    increments[step] = compose(increments[step], SLIP)
    for _ in follow(back_end, increments, [[]] * len(increments)):
        pass
    error = back_end.main.pose - chained([*increments[:step], run.increments[step]])
    np.testing.assert_allclose(
        back_end.main.undecided_covariance, 0.5 * np.outer(error, error), rtol=0.03, atol=1e-5
    )

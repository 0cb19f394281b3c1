"""Slips that the ranges show at once, and the doubt that others leave."""

import math
from collections.abc import Iterator

import numpy as np
import pytest

from hil_tests.unit.slam.robust.range_world import (
    LAB,
    Array,
    Run,
    follow,
    parameters_for,
    polar,
    simulate,
)
from slam.geometry import compose, paper_rig
from slam.robust.back_end import RobustBackEnd
from slam.robust.branches import Branches, Doubt, covered_share
from slam.robust.parameters import TAIL_PROBABILITY, BranchRule, SlipRule

SIGMA_M = 3e-3
SLIP = np.array([0.03, 0.0, math.radians(8.0)])
PRIOR = 1.0 / (1.0 + SlipRule().changes_per_slip)
N_CHANGES = 15  # two laps of four corners, each of which begins and, but for the last one, ends


@pytest.fixture(scope="module")
def run() -> Run:
    """Return two laps; the robot turns on the spot in the corners, 5.6 degrees a step."""
    return simulate(LAB, seed=2, sigma_m=SIGMA_M, laps=2)


def slipped(run: Run, step: int) -> Array:
    """Return what the wheels report until a step in which they slip."""
    increments = run.increments[: step + 1].copy()
    increments[step] = compose(increments[step], SLIP)
    return increments


def probabilities(run: Run, increments: Array) -> Iterator[tuple[RobustBackEnd, float]]:
    back_end = RobustBackEnd(paper_rig(), parameters_for(LAB, SIGMA_M))
    for _ in follow(back_end, increments, run.scans[: len(increments)]):
        yield back_end, back_end.slip_probability


def straight_steps(run: Run) -> Iterator[int]:
    """Yield the steps of the second lap that neither begin nor end near a corner."""
    turns = np.abs(np.diff(run.poses[:, 2]))
    half = len(turns) // 2
    yield from (k for k in range(half, len(turns) - 5) if not turns[k - 5 : k + 5].any())


def n_in_view(run: Run, step: int) -> int:
    """Return how many landmarks some radar has well in view after a step."""
    found = np.zeros(len(run.landmarks), dtype=bool)
    for mount in paper_rig().mounts:
        ranges_m, off_rad = polar(run.poses[step + 1 : step + 2], mount, run.landmarks)
        found |= ((ranges_m > 0.3) & (ranges_m < 1.4) & (off_rad < 0.5))[0]
    return int(found.sum())


def test_corners_are_no_slips(run: Run) -> None:
    found = [probability for _, probability in probabilities(run, run.increments)]
    assert sum(probability > 0.0 for probability in found) == N_CHANGES
    assert max(found) < 0.5


def test_a_slip_in_sight_of_landmarks_is_believed_at_once(run: Run) -> None:
    step = max(straight_steps(run), key=lambda k: n_in_view(run, k))
    assert n_in_view(run, step) >= 3
    *_, (back_end, probability) = probabilities(run, slipped(run, step))
    truth = run.poses[step + 1]
    assert probability > 0.99
    assert abs(math.remainder(back_end.pose[2] - truth[2], math.tau)) < math.radians(1.5)
    assert math.hypot(*(back_end.pose - truth)[:2]) < 0.02


def test_of_a_slip_in_sight_of_nothing_the_prior_is_left(run: Run) -> None:
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    for _ in follow(branches, slipped(run, 29), [[]] * 30):
        assert branches.main.slip_probability in (0.0, pytest.approx(PRIOR))
    assert branches.main.slip_probability == pytest.approx(PRIOR)
    rule = BranchRule()
    expected = PRIOR * np.square([rule.hidden_m, rule.hidden_m, rule.hidden_rad])
    np.testing.assert_allclose(branches.doubted_covariance, np.diag(expected), rtol=1e-9)


@pytest.mark.parametrize("probability", [2e-3, 0.05, 0.5, 1.0])
def test_a_doubt_covers_what_may_have_happened(probability: float) -> None:
    """What lies outside a region of it: exp(-r^2 / 2 V) for a variance V, in two dimensions."""
    limit = -2.0 * covered_share(probability) * math.log(TAIL_PROBABILITY)  # r^2 / V
    assert probability * math.exp(-limit / 2.0) == pytest.approx(TAIL_PROBABILITY)


def test_a_doubt_below_the_tail_adds_what_its_mixture_has() -> None:
    assert covered_share(TAIL_PROBABILITY / 2.0) == TAIL_PROBABILITY / 2.0


def test_doubts_that_are_joined_need_what_both_need() -> None:
    older, newer = doubtful_turn(0.0), doubtful_turn(1.0)
    newer.next_id = 9
    older.nats, newer.nats = {0: 9.0, 1: 9.0}, {1: 2.0, 5: 9.0}
    older.join(newer)
    assert (older.next_id, older.nats) == (3, {1: 2.0})
    np.testing.assert_allclose(older.variances, 2.0 * np.ones(3))


@pytest.mark.parametrize("n", [1, 2, 10])
def test_many_stops_are_no_more_than_one_carry(n: int) -> None:
    branches, rule = Branches(paper_rig(), parameters_for(LAB, SIGMA_M)), BranchRule()
    branches._doubts = [
        Doubt(
            next_id=0,
            position_m=np.zeros(2),
            covariance=0.6 * np.diag(rule.lost_variances),
            variances=np.array(rule.lost_variances),
            lost_share=0.6,
        )
        for _ in range(n)
    ]
    expected = min(0.6 * n, 1.0) * np.diag(rule.lost_variances)
    np.testing.assert_allclose(branches.doubted_covariance, expected)


def doubtful_turn(x_m: float) -> Doubt:
    covariance = np.diag([1e-4, 1e-4, 0.01])
    position_m, variances = np.array([x_m, 0.0]), np.ones(3)
    return Doubt(next_id=3, position_m=position_m, covariance=covariance, variances=variances)


def test_a_doubtful_turn_is_a_doubtful_position_far_from_it() -> None:
    np.testing.assert_allclose(
        doubtful_turn(1.0).at(np.array([3.0, 0.0])),
        [[1e-4, 0.0, 0.0], [0.0, 1e-4 + 4.0 * 0.01, 2.0 * 0.01], [0.0, 0.02, 0.01]],
    )


def test_doubts_of_two_places_add_up_as_independent_ones_do() -> None:
    here = np.array([3.0, 0.0])
    both = doubtful_turn(0.0)
    both.add(doubtful_turn(1.0))
    np.testing.assert_allclose(
        both.at(here), [[2e-4, 0.0, 0.0], [0.0, 2e-4 + 0.09 + 0.04, 0.05], [0.0, 0.05, 0.02]]
    )


def test_all_corners_in_sight_of_nothing_are_doubted(run: Run) -> None:
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    for _ in follow(branches, run.increments, [[]] * len(run.increments)):
        pass
    expected = N_CHANGES * PRIOR * BranchRule().hidden_rad ** 2
    assert branches.doubted_covariance[2, 2] == pytest.approx(expected)


def test_landmarks_known_before_end_a_doubt_and_new_ones_do_not() -> None:
    """Three of them, each with no more evidence than one may give."""
    rule = BranchRule()
    doubt = doubtful_turn(0.0)
    much = 2.0 * rule.correlated_steps * rule.most_for
    assert not doubt.take(np.array([[7, much], [8, much], [9, much]]), rule)
    assert not doubt.take(np.array([[0, much], [1, much]]), rule)
    assert doubt.take(np.array([[2, much]]), rule)


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

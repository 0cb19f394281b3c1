"""Slips that the ranges show at once, and the doubts that others leave (`test_doubts`)."""

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
from slam.robust.branches import Branches
from slam.robust.parameters import BranchRule, SlipRule
from slam.robust.proposals.doubts import covered_share

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


@pytest.mark.rare
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
    expected = covered_share(PRIOR) * np.square([rule.hidden_m, rule.hidden_m, rule.hidden_rad])
    np.testing.assert_allclose(branches.doubted_covariance, np.diag(expected), rtol=1e-9)


def test_all_corners_in_sight_of_nothing_are_doubted(run: Run) -> None:
    branches = Branches(paper_rig(), parameters_for(LAB, SIGMA_M))
    for _ in follow(branches, run.increments, [[]] * len(run.increments)):
        pass
    expected = covered_share(N_CHANGES * PRIOR) * BranchRule().hidden_rad ** 2
    assert branches.doubted_covariance[2, 2] == pytest.approx(expected)


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

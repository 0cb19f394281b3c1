"""Where solutions of the whole run start: from either path, or from one that is bent."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from slam.config import WheelNoise
from slam.geometry import between, compose, transform
from slam.robust.parameters import SECOND_NOISE_FACTOR, BackEndParameters
from slam.robust.solver import revision
from slam.robust.solver.revision import mistaken, with_closed_loop, with_doubled
from slam.robust.solver.run_log import Estimate, Problem, RunLog
from slam.robust.solver.smoother import Eliminated, Solution
from slam.robust.state import Layout, State

Array = NDArray[np.float64]

N_RADARS, SLIP, BEGIN = 2, 6, 8  # the wheels slip in step 6; what is new is seen from pose 8 on
MARKS = np.array([[1.0, 1.0], [2.5, -1.0], [0.5, -1.2]])
PATH = np.array([[0.25 * i, 0.1 * math.sin(0.5 * i), 0.2 * math.cos(0.5 * i)] for i in range(14)])
HIDDEN = np.array([0.1, -0.05, 0.6])  # what the wheels did not report


def bent_run(slip_sigma: float, other_sigma: float) -> tuple[Problem, Estimate, Estimate]:
    """Return a run with a slip, its solution if nothing is known twice, and the truth.

    Landmarks 0 and 1 and the first wall are seen before the slip, 2 to 4 and the second wall behind
    it: of these the first two are landmarks 0 and 1.
    """
    steps = np.array([between(*pair) for pair in pairwise(PATH)])
    steps[SLIP] = compose(steps[SLIP], between(HIDDEN, np.zeros(3)))
    wheels = [PATH[0]]
    for step in steps:
        wheels.append(compose(wheels[-1], step))
    variances = np.full(len(steps), other_sigma**2)
    variances[SLIP] = slip_sigma**2
    layout = Layout(N_RADARS, 5, 2, has_radii=True)
    seen = [(k, row) for k in range(len(PATH)) for row in ((0, 1, 5) if k < SLIP else ())]
    seen += [(k, row) for k in range(BEGIN, len(PATH)) for row in (2, 3, 4, 6)]
    poses, rows = np.array(seen).T
    values = np.zeros(len(seen))
    problem = Problem(
        layout=layout,
        prior_mean=np.zeros(layout.size),
        prior_sigmas=np.ones(layout.size),
        steps=steps,
        step_covariances=variances[:, None, None] * np.eye(3),
        walks=np.zeros((len(steps), 3)),
        keys=np.arange(len(PATH)),
        range_poses=poses,
        range_radars=np.zeros(len(seen), dtype=np.intp),
        range_landmarks=rows,
        range_antennas=np.zeros((len(seen), 2)),
        range_turns=values,
        ranges_m=values + 1.0,
        range_sigmas_m=values + 1.0,
        range_bearings_rad=values,
        range_bearing_sigmas_rad=values + 1.0,
    )
    away = compose(wheels[-1], between(PATH[-1], np.zeros(3)))
    walls = np.array([[0.3, 2.0], [1.2, 3.0]])
    n = np.array([math.cos(walls[1, 0]), math.sin(walls[1, 0])])
    turned = transform(np.array([0.0, 0.0, away[2]]), n)
    moved_wall = [walls[1, 0] + away[2], walls[1, 1] + float(turned @ away[:2])]
    offsets, radii = np.array([0.01, -0.02]), np.array([0.1, 0.2, 0.3, 0.4, 0.5])
    apart = np.vstack([MARKS[:2], transform(away, MARKS)])
    calibration = np.zeros((1, 3))
    fixed = [offsets, np.column_stack([apart, radii]).ravel(), walls[0], moved_wall]
    true = [offsets, np.column_stack([MARKS, radii[[0, 1, 4]]]).ravel(), walls.ravel()]
    return (
        problem,
        Estimate(poses=np.array(wheels), calibration=calibration, fixed=np.concatenate(fixed)),
        Estimate(poses=PATH, calibration=calibration, fixed=np.concatenate(true)),
    )


def test_a_path_that_a_slip_has_bent_is_bent_back_where_it_slipped() -> None:
    problem, apart, truth = bent_run(slip_sigma=0.3, other_sigma=0.0)
    found = with_closed_loop(problem, apart, ((0, 2), (1, 3)))
    np.testing.assert_allclose(found.poses, truth.poses, atol=1e-9)
    np.testing.assert_allclose(found.fixed, truth.fixed, atol=1e-9)


def test_motions_share_what_is_missed_as_their_variances_are() -> None:
    """Landmarks are last seen before pose 6 and found again from pose 8 on: steps 5, 6 and 7."""
    problem, apart, truth = bent_run(slip_sigma=0.3, other_sigma=0.1)
    found = with_closed_loop(problem, apart, ((0, 2), (1, 3)))
    np.testing.assert_allclose(found.poses[:SLIP], apart.poses[:SLIP])
    np.testing.assert_allclose(found.poses[BEGIN:], truth.poses[BEGIN:], atol=1e-9)
    np.testing.assert_allclose(found.fixed, truth.fixed, atol=1e-9)
    turned = found.poses[:, 2] - apart.poses[:, 2]
    whole = turned[BEGIN]
    assert turned[SLIP : BEGIN + 1] / whole == pytest.approx([1 / 11, 10 / 11, 1.0])


def test_of_one_pair_what_is_new_is_shifted() -> None:
    """One landmark says nothing of the heading."""
    problem, apart, _ = bent_run(slip_sigma=0.3, other_sigma=0.0)
    found = with_closed_loop(problem, apart, ((0, 2),))
    np.testing.assert_allclose(found.poses[:, 2], apart.poses[:, 2])
    before = apart.fixed[N_RADARS : N_RADARS + 15].reshape(-1, 3)
    behind = found.fixed[N_RADARS : N_RADARS + 12].reshape(-1, 3)
    shift = MARKS[0] - before[2, :2]
    np.testing.assert_allclose(behind[2:, :2] - before[3:, :2], [shift, shift])


def test_what_is_known_before_stays_where_it_is() -> None:
    """Of the first landmarks of the pairs one has later ranges only; another one is of a map."""
    problem, apart, truth = bent_run(slip_sigma=0.3, other_sigma=0.0)
    later = problem.range_poses + BEGIN * (problem.range_landmarks == 1)
    column = problem.layout.first_columns(np.array([4]))
    of_map = replace(
        problem,
        range_poses=later,
        known_at=np.append(column, column + 1),
        known_information=np.eye(2),
    )
    found = with_closed_loop(of_map, apart, ((0, 2), (1, 3)))
    own, before = found.fixed[N_RADARS:].reshape(-1), apart.fixed[N_RADARS:]
    np.testing.assert_allclose(own[:6], truth.fixed[N_RADARS : N_RADARS + 6], atol=1e-9)
    np.testing.assert_allclose(own[6:9], before[12:15])


def test_doubled_landmarks_are_where_the_one_is() -> None:
    problem, apart, truth = bent_run(slip_sigma=0.3, other_sigma=0.0)
    doubled = with_doubled(problem, truth, ((0, 2), (1, 3)))
    own = doubled.fixed[N_RADARS : N_RADARS + 15].reshape(-1, 3)
    np.testing.assert_array_equal(own[:, :2], MARKS[[0, 1, 0, 1, 2]])
    np.testing.assert_array_equal(doubled.fixed[-4:], truth.fixed[-4:])
    assert len(doubled.fixed) == len(apart.fixed)
    np.testing.assert_array_equal(doubled.poses, truth.poses)


def test_passages_of_one_landmark_are_more_than_the_gap_apart() -> None:
    log, state = RunLog(WheelNoise(), 3), State((0.0,) * 3, (0.0,) * N_RADARS)
    for _ in range(2):
        size = state.layout.landmark_size
        state.augment(np.zeros(2), np.zeros((state.P.size, size)), np.eye(size))
    first, second = state.landmark_ids
    gone, unknown = second + 1, second + 2
    # Pose, landmark, and the passage; of landmarks that the state has not there is none
    seen = [
        (0, first, 0),
        (0, second, 2),
        (3, first, 0),
        (4, unknown, None),
        (7, first, 1),
        (3, gone, 2),  # which is taken for the second one
        (7, second, 3),
    ]
    for pose, landmark, _ in seen:
        log.add_range(pose, 0, landmark, antenna=(0.0, 0.0), range_m=1.0, sigma_m=0.01)
    rows, passages = log.passages(state, {gone: second})
    expected = [(row, passage) for row, (*_, passage) in enumerate(seen) if passage is not None]
    assert list(zip(rows.tolist(), passages.tolist(), strict=True)) == expected
    log.leave_out_rows(rows[passages == 2])
    assert log.passages(state, {gone: second})[0].tolist() == [0, 2, 4, 6]


@pytest.mark.parametrize(
    ("n_off", "is_certain", "expected"),
    [
        # Ranges too far off of four, passage by passage; of two landmarks, each with two passages
        ((0, 3, 0, 2), (False, False), [1]),
        ((0, 4, 0, 3), (False, False), [1, 3]),
        ((0, 4, 0, 3), (True, False), [3]),
        # The first passage says what a landmark is
        ((4, 0, 4, 4), (False, False), [3]),
    ],
    ids=["most of one", "both", "one is certain", "first ones"],
)
def test_a_passage_is_mistaken_if_most_of_its_ranges_are_too_far_off(
    n_off: tuple[int, ...], is_certain: tuple[bool, bool], expected: list[int]
) -> None:
    """Ranges are taken from the origin, of landmarks at 1 m, with deviations of 1 mm."""
    passages = np.repeat([0, 1, 2, 3], 4)
    rows, values = passages // 2, np.zeros(16)
    is_far = np.concatenate([np.arange(4) < n for n in n_off])
    limit_m = 4e-3 * SECOND_NOISE_FACTOR
    off_m = limit_m * np.where(is_far, 1.1, 0.9) * np.tile([1.0, -1.0], 8)
    bent, apart, _ = bent_run(0.1, 0.1)
    problem = replace(
        bent,
        layout=Layout(N_RADARS, 2, 0, has_radii=False),
        range_poses=np.zeros(16, dtype=np.intp),
        range_radars=np.zeros(16, dtype=np.intp),
        range_landmarks=rows,
        range_antennas=np.zeros((16, 2)),
        range_turns=values,
        ranges_m=1.0 + off_m,
        range_sigmas_m=values + 1e-3,
        range_bearings_rad=np.full(16, math.nan),
        range_bearing_sigmas_rad=np.full(16, math.nan),
    )
    fixed = np.concatenate([np.zeros(N_RADARS), [1.0, 0.0], [0.0, 1.0]])
    closed = replace(apart, poses=np.zeros_like(apart.poses), fixed=fixed)
    shuffled = np.random.default_rng(0).permutation(16)
    problem = replace(problem, ranges_m=problem.ranges_m[shuffled], range_landmarks=rows[shuffled])
    found = mistaken(problem, closed, passages[shuffled], np.array(is_certain), outlier_sigmas=4.0)
    np.testing.assert_array_equal(found, np.isin(passages[shuffled], expected))


# The final pose [m, m, rad] and the cost of the solution from each start; the pose before it is
# the origin, with standard deviations of 0.1
SOLVED = {
    "near": ((0.1, -0.1, 0.1), 50.0),
    "far": ((0.9, 0.0, 0.0), 200.0),
    "far and good": ((0.9, 0.0, 0.0), 10.0),
    "failed": None,
    # An angle of -0.1 rad
    "wrapped": ((0.0, 0.0, math.tau - 0.1), 50.0),
}


@pytest.mark.parametrize(
    ("starts", "tried", "best"),
    [
        (("near", "far and good"), ["near"], 50.0),
        (("wrapped", "far and good"), ["wrapped"], 50.0),
        (("far", "near"), ["far", "near"], 50.0),
        (("far and good", "near"), ["far and good", "near"], 10.0),
        (("failed", "far"), ["failed", "far"], 200.0),
        (("failed", "failed"), ["failed", "failed"], None),
    ],
    ids=str,
)
def test_another_start_is_tried_where_a_solution_moves_the_pose_too_far(
    monkeypatch: pytest.MonkeyPatch, starts: tuple[str, str], tried: list[str], best: float | None
) -> None:
    """What counts is the cost of the solutions, and not that of the starts."""
    problem, apart, _ = bent_run(0.1, 0.1)
    log = RunLog(WheelNoise(), 10)
    state = State((0.0,) * 3, (0.0,) * N_RADARS)
    state.set_pose(np.zeros(3), 0.1**2 * np.eye(3))
    seen: list[str] = []

    class Solver:
        def __init__(self, *_: object) -> None:
            pass

        def cost(self, start: str) -> float:
            return float(starts.index(start))

        def solve(self, start: str) -> Solution | None:
            seen.append(start)
            found = SOLVED[start]
            if found is None:
                return None
            poses = np.vstack([apart.poses[:-1], found[0]])
            eliminated = Eliminated.__new__(Eliminated)
            return Solution(
                estimate=replace(apart, poses=poses), eliminated=eliminated, cost=found[1]
            )

    monkeypatch.setattr(revision, "Smoother", Solver)
    monkeypatch.setattr(RunLog, "starts", lambda *_: starts[::-1])
    solution = revision._solved(log, state, problem, BackEndParameters())
    assert (seen, solution and solution.cost) == (tried, best)

"""Laws of the metrics, and their values against evo and closed forms."""

import math
from itertools import combinations, permutations
from random import Random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from slam.geometry import between, transform
from slam.library.evaluation import (
    associate_times,
    ate_rmse_m,
    ate_rotation_rmse_rad,
    icp_align_se2,
    icp_ate_rmse_m,
    landmark_metrics,
    nees_pose,
    relative_pose_errors,
    rmse_m,
)

Array = NDArray[np.float64]

poses = st.tuples(st.floats(-5, 5), st.floats(-5, 5), st.floats(-math.pi, math.pi)).map(np.array)
seeds = st.integers(0, 2**32 - 1)


def path(seed: int, n: int = 80) -> Array:
    """Return a smooth random path, shape (n, 2)."""
    rng = np.random.default_rng(seed)
    return np.cumsum(np.cumsum(0.002 * rng.standard_normal((n, 2)), axis=0) + 0.02, axis=0)


def drifted(xy: Array, seed: int) -> Array:
    rng = np.random.default_rng(seed + 1)
    drift = np.linspace(0, 1, len(xy))[:, None] * rng.uniform(-0.1, 0.1, 2)
    return xy + drift + 0.01 * rng.standard_normal(xy.shape)


def lissajous() -> tuple[Array, Array]:
    k = np.arange(60)
    reference = np.column_stack([2 * np.cos(0.11 * k), 1.3 * np.sin(0.17 * k)])
    wiggle = np.column_stack([0.05 * np.sin(1.3 * k), 0.04 * np.cos(2.1 * k) + 0.001 * k])
    return transform(np.array([0.7, -1.9, 0.8]), reference + wiggle), reference


def test_ate_equals_evo() -> None:
    # evo 1.38.1: evo_ape tum ref.tum est.tum -a, both written with repr floats.
    assert ate_rmse_m(*lissajous()) == pytest.approx(0.04804433714655651, abs=1e-9)


def turning() -> tuple[Array, Array]:
    estimate, reference = lissajous()
    k = np.arange(60)
    heading = 0.3 * k
    off = heading + 0.8 + 0.02 * np.sin(1.7 * k) + 0.001 * k
    return np.column_stack([estimate, off]), np.column_stack([reference, heading])


def test_rotation_error_equals_evo() -> None:
    # evo 1.38.1: APE of rotation_angle_deg after align()
    degrees = math.degrees(ate_rotation_rmse_rad(*turning()))
    assert degrees == pytest.approx(2.062841932741795, abs=1e-9)


@pytest.mark.parametrize(
    ("delta_m", "pairs", "metres", "degrees"),
    [
        (0.5, 21, 0.0763782330291394, 1.1863170967963947),
        (1.0, 11, 0.06926231615918403, 1.1560003834323442),
        (2.0, 5, 0.09752193756625584, 1.0458290458083477),
    ],
)
def test_relative_errors_equal_evo(
    delta_m: float, pairs: int, metres: float, degrees: float
) -> None:
    # evo 1.38.1: RPE(delta, Unit.meters, all_pairs=False, pairs_from_reference=True)
    errors = relative_pose_errors(*turning(), delta_m)
    assert len(errors) == pairs
    assert math.sqrt(np.mean(np.sum(errors[:, :2] ** 2, axis=1))) == pytest.approx(metres, abs=1e-9)
    assert math.degrees(math.sqrt(np.mean(errors[:, 2] ** 2))) == pytest.approx(degrees, abs=1e-9)


@given(poses, st.floats(0.001, 0.1), st.floats(-0.2, 0.2))
def test_relative_errors_of_wheels_that_err_by_shares_are_closed_forms(
    moved: Array, scale: float, curvature: float
) -> None:
    """On a straight way, a scale error s and a drift c give arcs of (1 + s) d that turn by c d.

    Where the estimate lies costs nothing.
    """
    way_m = 0.25 * np.arange(41)
    reference = np.column_stack([way_m, np.zeros(41), np.zeros(41)])
    arc_m, turn = (1.0 + scale) * way_m, curvature * way_m
    x = arc_m * np.sinc(turn / np.pi)
    y = arc_m * np.sin(turn / 2) * np.sinc(turn / math.tau)
    estimate = np.column_stack([transform(moved, np.column_stack([x, y])), turn + moved[2]])
    errors = relative_pose_errors(estimate, reference, 1.0)
    half = curvature / 2.0
    chord_m = (1.0 + scale) * np.sinc(half / np.pi)
    expected = [chord_m * math.cos(half) - 1.0, chord_m * math.sin(half), curvature]
    assert errors == pytest.approx(np.tile(expected, (10, 1)), abs=1e-9)
    assert relative_pose_errors(reference, reference, 1.0) == pytest.approx(np.zeros((10, 3)))
    assert relative_pose_errors(estimate, reference, 10.5).shape == (0, 3)


@given(seeds, poses)
def test_ate_ignores_where_the_estimate_lies(seed: int, moved: Array) -> None:
    reference = path(seed)
    estimate = drifted(reference, seed)
    ate = ate_rmse_m(estimate, reference)
    assert ate_rmse_m(transform(moved, estimate), reference) == pytest.approx(ate, abs=1e-9)
    assert ate_rmse_m(transform(moved, reference), reference) <= 1e-9
    assert ate <= rmse_m(estimate, reference) + 1e-12


@given(seeds)
def test_nearest_neighbour_residual_never_exceeds_the_error_by_time(seed: int) -> None:
    reference = path(seed)
    estimate = drifted(reference, seed)
    aligned = transform(icp_align_se2(estimate, reference), estimate)
    by_time = math.sqrt(np.mean(np.sum((aligned - reference) ** 2, axis=1)))
    assert icp_ate_rmse_m(estimate, reference) <= by_time + 1e-12


@given(seeds)
def test_icp_never_ends_worse_than_it_began(seed: int) -> None:
    reference = path(seed)
    estimate = drifted(reference, seed)

    def residual(xy: Array) -> float:
        distances = np.linalg.norm(xy[:, None, :] - reference[None, :, :], axis=2).min(axis=1)
        return math.sqrt(float(np.mean(distances**2)))

    aligned = transform(icp_align_se2(estimate, reference), estimate)
    assert residual(aligned) <= residual(estimate) + 1e-12


def test_where_neighbours_are_those_by_time_icp_is_the_alignment_by_time() -> None:
    # Steps of 1 m with errors of 1 cm: nearest neighbour and time agree before and after.
    reference = np.column_stack([np.arange(30.0), (np.arange(30.0) % 3) ** 2])
    estimate = reference + 0.01 * np.random.default_rng(0).standard_normal(reference.shape)
    ate = ate_rmse_m(estimate, reference)
    assert icp_ate_rmse_m(estimate, reference) == pytest.approx(ate, rel=1e-6)


@given(seeds, st.integers(2, 80))
def test_ate_has_a_closed_form_in_complex_numbers(seed: int, n: int) -> None:
    """Centred on their means, |r - a e|^2 is least over |a| = 1 where a e and r are in phase."""
    reference = path(seed, n)
    estimate = transform(np.array([3.0, -2.0, 2.5]), drifted(reference, seed))
    e, r = (xy[:, 0] + 1j * xy[:, 1] for xy in (estimate, reference))
    e, r = e - e.mean(), r - r.mean()
    a = np.vdot(e, r) / abs(np.vdot(e, r))
    # evo 1.38.1 computes the same: `evo_ape tum ref est -a` of such paths, compared to 1e-9
    assert ate_rmse_m(estimate, reference) == pytest.approx(
        math.sqrt(np.mean(np.abs(r - a * e) ** 2)), abs=1e-9
    )


@given(seeds, poses, st.floats(-0.5, 1.0))
def test_ate_is_zero_of_rigid_motions_alone(seed: int, moved: Array, stretch: float) -> None:
    """A scale or a mirror is not aligned away: closed forms in the principal spreads."""
    reference = path(seed)
    centred = reference - reference.mean(axis=0)
    spreads = np.linalg.svd(centred, compute_uv=False) ** 2 / len(centred)
    scaled = transform(moved, (1 + stretch) * reference)
    wanted = abs(stretch) * math.sqrt(spreads.sum())
    assert ate_rmse_m(scaled, reference) == pytest.approx(wanted, abs=1e-9)
    mirrored = transform(moved, reference * np.array([1.0, -1.0]))
    assert ate_rmse_m(mirrored, reference) == pytest.approx(2 * math.sqrt(spreads[1]), abs=1e-7)


def displaced_curve() -> tuple[Array, Array, Array]:
    """Return a curve, the same curve moved rigidly, and the motion that brings it back."""
    k = np.arange(120)
    reference = np.column_stack([2 * np.cos(0.03 * k), 1.3 * np.sin(0.05 * k)])
    back = np.array([0.03, -0.02, 0.05])
    return reference, transform(between(back, np.zeros(3)), reference), back


def test_icp_goes_on_until_a_displaced_curve_lies_on_itself() -> None:
    reference, estimate, back = displaced_curve()
    assert icp_align_se2(estimate, reference) == pytest.approx(back, abs=1e-9)
    assert icp_ate_rmse_m(estimate, reference) <= 1e-9


@pytest.mark.parametrize(("off_m", "pulls"), [(0.52, False), (0.48, True)])
def test_points_beyond_half_a_metre_do_not_pull(off_m: float, pulls: bool) -> None:
    reference = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 3.0], [0.0, 3.0]])
    stray = np.array([[3.0, 3.0 + off_m]])
    aligned = icp_align_se2(np.vstack([reference, stray]), reference)
    assert (np.abs(aligned).max() > 0.01) == pulls


def test_mismatched_trajectories_are_refused_with_the_remedy() -> None:
    with pytest.raises(ValueError, match="associate them by time first"):
        ate_rmse_m(np.zeros((3, 2)), np.zeros((4, 2)))
    with pytest.raises(ValueError, match="no common stamps"):
        ate_rmse_m(np.zeros((0, 2)), np.zeros((0, 2)))


@given(st.sets(st.integers(0, 1000), max_size=40), st.sets(st.integers(0, 1000), max_size=40))
def test_associated_stamps_are_close_distinct_and_in_order(a: set[int], b: set[int]) -> None:
    estimate, reference = (np.array(sorted(s), dtype=np.int64) for s in (a, b))
    left, right = associate_times(estimate, reference, tolerance_ns=10)
    assert len(left) == len(right)
    assert np.all(np.diff(left) > 0)
    assert np.all(np.diff(right) > 0)
    assert np.all(np.abs(estimate[left] - reference[right]) <= 10)
    assert {k for k in a if k in b} <= set(estimate[left].tolist())
    for k in set(a) - set(estimate[left].tolist()):
        # A stamp is left out only if nothing is near or a closer one took its partner.
        near = [r for r in b if abs(r - k) <= 10]
        assert not near or set(near) & set(reference[right].tolist())


# --- landmarks ----------------------------------------------------------------------------------

TRUE = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 1.0]])
ALL = np.ones(len(TRUE), dtype=bool)
HERE = np.zeros(3)


def test_map_is_scored_after_the_trajectory_alignment() -> None:
    moved = np.array([0.5, -0.25, 1.0])
    score = landmark_metrics(
        transform(moved, TRUE + np.array([0.03, 0.04])), TRUE, between(moved, np.zeros(3)), ALL
    )
    assert (score.true, score.estimated, score.duplicates) == (3, 3, 0)
    assert (score.precision, score.recall) == (1.0, 1.0)
    assert score.rmse_m == pytest.approx(0.05, abs=1e-12)


def test_second_estimate_beside_a_match_is_a_duplicate_and_a_far_one_is_false() -> None:
    estimated = np.array([[0.01, 0.0], [0.1, 0.0], [1.0, 0.02], [5.0, 5.0]])
    score = landmark_metrics(estimated, TRUE, HERE, ALL)
    assert score.duplicates == 1
    assert score.precision == 0.5
    assert score.recall == pytest.approx(2 / 3)
    assert score.rmse_m == pytest.approx(math.sqrt((0.01**2 + 0.02**2) / 2))


def test_matching_is_joint_not_greedy() -> None:
    # The nearest estimate of the second truth is the only one in reach of the first.
    true = np.array([[0.0, 0.0], [0.2, 0.0]])
    estimated = np.array([[0.12, 0.0], [0.32, 0.0]])
    assert landmark_metrics(estimated, true, HERE, np.ones(2, dtype=bool)).recall == 1.0


@pytest.mark.parametrize(("off_m", "matched"), [(0.149, 1), (0.151, 0)])
def test_fifteen_centimetres_are_a_match(off_m: float, matched: int) -> None:
    estimated = TRUE[:1] + np.array([0.6, 0.8]) * off_m
    assert landmark_metrics(estimated, TRUE, HERE, ALL).precision == matched
    # A second estimate at that distance from a matched truth is a duplicate, or false.
    both = np.vstack([TRUE[:1], estimated])
    assert landmark_metrics(both, TRUE, HERE, ALL).duplicates == matched


@pytest.mark.parametrize(("n", "m"), [(0, 3), (2, 0), (0, 0)])
def test_empty_maps_have_no_ratio(n: int, m: int) -> None:
    score = landmark_metrics(np.zeros((n, 2)), np.zeros((m, 2)) + 9, HERE, np.ones(m, dtype=bool))
    assert (score.duplicates, score.rmse_m) == (0, None)
    assert score.precision == (0.0 if n else None)
    assert score.recall == (0.0 if m else None)


def test_a_true_landmark_that_need_not_be_found_is_no_false_one_and_not_in_recall() -> None:
    observable = np.array([True, False, True])
    score = landmark_metrics(TRUE[1:], TRUE, HERE, observable)
    assert (score.true, score.observable, score.estimated) == (3, 2, 2)
    assert (score.precision, score.recall) == (1.0, 0.5)


def test_a_corner_may_be_a_landmark_once_and_need_not_be_one() -> None:
    corners = np.array([[4.0, 4.0], [4.0, 5.0]])
    estimated = np.array([[0.0, 0.0], [4.0, 4.05], [4.0, 4.1], [6.0, 6.0]])
    score = landmark_metrics(estimated, TRUE, HERE, ALL, corners)
    assert (score.true, score.observable, score.duplicates) == (3, 3, 1)
    assert score.precision == 0.5
    assert score.recall == pytest.approx(1 / 3)
    assert score.rmse_m == pytest.approx(0.05 / math.sqrt(2))
    # Where there are no corners, nothing is other than without them.
    assert landmark_metrics(estimated, TRUE, HERE, ALL, np.zeros((0, 2))) == landmark_metrics(
        estimated, TRUE, HERE, ALL
    )
    # A corner within 15 cm of a landmark changes no score.
    beside = np.array([[0.1, 0.0], [1.14, 0.0], [2.0, 1.0]])
    twice = np.vstack([TRUE, TRUE + np.array([0.01, 0.0])])
    assert landmark_metrics(twice, TRUE, HERE, ALL, beside) == landmark_metrics(
        twice, TRUE, HERE, ALL
    )
    further = np.array([[0.3, 0.0]])
    between = landmark_metrics(np.array([[0.14, 0.0], [0.16, 0.0]]), TRUE, HERE, ALL, further)
    assert (between.precision, between.duplicates) == (1.0, 0)
    assert between.recall == pytest.approx(1 / 3)
    only = landmark_metrics(corners, np.zeros((0, 2)), HERE, np.zeros(0, dtype=bool), corners)
    assert (only.true, only.precision, only.recall) == (0, 1.0, None)


apart = st.sets(st.tuples(st.integers(0, 4), st.integers(0, 4)), max_size=6).map(
    lambda cells: np.array(sorted(cells), dtype=np.float64).reshape(-1, 2)
)


@given(apart, st.lists(st.booleans(), min_size=6, max_size=6))
def test_the_whole_truth_is_precise_whatever_is_observable(
    true: NDArray[np.float64], flags: list[bool]
) -> None:
    observable = np.array(flags[: len(true)], dtype=bool)
    score = landmark_metrics(true, true, HERE, observable)
    assert score.precision == (1.0 if len(true) else None)
    assert score.recall == (1.0 if observable.any() else None)
    assert score.duplicates == 0
    # Recall does not depend on the estimates of what is not observable.
    assert landmark_metrics(true[observable], true, HERE, observable).recall == score.recall


grids = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 3)), max_size=4)


@given(grids, st.lists(st.tuples(st.integers(0, 6), st.integers(0, 3)), max_size=4), st.randoms())
def test_scores_are_those_of_the_best_of_all_one_to_one_matches(
    estimated: list[tuple[int, int]], true: list[tuple[int, int]], random: Random
) -> None:
    # Points 7 cm apart, moved a little so that no two matches tie.
    est, tru = (
        np.array(
            [
                (0.07 * x + random.uniform(0, 0.02), 0.07 * y + random.uniform(0, 0.02))
                for x, y in points
            ]
        ).reshape(-1, 2)
        for points in (estimated, true)
    )
    observable = np.array([random.random() < 0.5 for _ in true], dtype=bool)
    possible: list[tuple[int, float, list[tuple[int, int]]]] = []
    for k in range(min(len(est), len(tru)) + 1):
        for rows in combinations(range(len(est)), k):
            for columns in permutations(range(len(tru)), k):
                match = list(zip(rows, columns, strict=True))
                distances = [math.dist(est[row], tru[column]) for row, column in match]
                if all(distance <= 0.15 for distance in distances):
                    possible.append((k, -sum(distances), match))
    _, _, best = max(possible, key=lambda found: found[:2])
    score = landmark_metrics(est, tru, HERE, observable)
    found = [j for _, j in best]
    used = [i for i, _ in best]
    assert score.precision == (len(best) / len(est) if len(est) else None)
    expected = int(observable.sum())
    assert score.recall == (int(observable[found].sum()) / expected if expected else None)
    assert score.duplicates == sum(
        any(math.dist(est[i], tru[j]) <= 0.15 for j in found)
        for i in range(len(est))
        if i not in used
    )


# --- consistency --------------------------------------------------------------------------------


def test_nees_of_a_diagonal_covariance() -> None:
    truth = np.array([1.0, 2.0, math.pi - 0.01])
    estimate = np.array([1.1, 1.8, -math.pi + 0.01])  # 0.02 rad off, through pi
    covariance = np.diag([0.01, 0.04, 0.0004])
    assert nees_pose(estimate, covariance, truth) == pytest.approx(1.0 + 1.0 + 1.0)


TURNED = np.diag([0.0, 0.0, 1e-6])  # a turn on the spot from a perfect start


@pytest.mark.parametrize(
    ("error", "covariance", "nees"),
    [
        ((0.0, 0.0, 2e-3), TURNED, 4.0),
        ((1e-15, 0.0, 2e-3), TURNED, 4.0),
        ((1e-4, 0.0, 2e-3), TURNED, math.inf),
        ((0.0, 0.0, 0.0), np.zeros((3, 3)), 0.0),
        ((0.0, 0.0, 1e-6), np.zeros((3, 3)), math.inf),
        # x and y fully correlated: an error along the line x = y, and one across it.
        ((0.01, 0.01, 0.0), np.array([[1e-4, 1e-4, 0], [1e-4, 1e-4, 0], [0, 0, 1e-6]]), 1.0),
        ((0.01, -0.01, 0.0), np.array([[1e-4, 1e-4, 0], [1e-4, 1e-4, 0], [0, 0, 1e-6]]), math.inf),
    ],
)
def test_nees_where_a_direction_has_no_variance(
    error: tuple[float, float, float], covariance: Array, nees: float
) -> None:
    assert nees_pose(np.array(error), covariance, np.zeros(3)) == pytest.approx(nees)


@given(seeds, st.floats(1e-6, 1e3))
def test_nees_equals_the_quadratic_form_and_ignores_units(seed: int, metres: float) -> None:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((3, 3))
    covariance, error = root @ root.T + 0.1 * np.eye(3), 0.1 * rng.standard_normal(3)
    wanted = float(error @ np.linalg.inv(covariance) @ error)
    scale = np.array([metres, metres, 1.0])
    scaled = covariance * np.outer(scale, scale)
    assert nees_pose(error * scale, scaled, np.zeros(3)) == pytest.approx(wanted, rel=1e-9)

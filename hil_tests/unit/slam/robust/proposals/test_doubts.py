"""What the doubt whether a robot was carried adds to a covariance, and when it ends."""

import math

import numpy as np
import pytest

from hil_tests.unit.slam.robust.range_world import Array
from slam.geometry import compose
from slam.results import PredictedRange, UpdateReport
from slam.robust.parameters import TAIL_PROBABILITY, BranchRule
from slam.robust.proposals.doubts import (
    Doubt,
    SeenRanges,
    covered_share,
    covering,
    doubted_covariance,
    seen_ranges,
)

RULE = BranchRule()
MUCH = 2.0 * RULE.correlated_steps * RULE.most_for
CARRY = np.diag([1e-4, 1e-4, 0.01])
LEVER_M = 0.1


def doubtful(x_m: float, probability: float = 1.0, *, is_carry: bool = True) -> Doubt:
    """Return a doubt at a place on the x axis: of a motion of covariance CARRY."""
    return Doubt(
        next_id=9,
        knew_few=False,
        is_carry=is_carry,
        position_m=np.array([x_m, 0.0]),
        probability=probability,
        covariance=probability * CARRY,
        motion_covariance=np.diag(RULE.hidden_variances),
    )


def at(doubt: Doubt, x_m: float) -> Array:
    return doubted_covariance([doubt], np.array([x_m, 0.0]))


def seen_from(pose: Array, points_m: list[tuple[float, float]], variance: float) -> SeenRanges:
    """Return ranges of landmarks 0, 1, ... by an antenna LEVER_M ahead of the pose."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    predicted = []
    for number, (x, y) in enumerate(points_m):
        dx, dy = x - pose[0], y - pose[1]
        point_m = (c * dx + s * dy, -s * dx + c * dy)
        predicted.append(
            PredictedRange(
                radar=0,
                landmark_id=number,
                range_m=math.hypot(point_m[0] - LEVER_M, point_m[1]),
                variance=variance,
                antenna_m=(LEVER_M, 0.0),
                point_m=point_m,
            )
        )
    continued = tuple((0, number, number) for number in range(len(points_m)))
    report = UpdateReport(continued=continued, nis=0.0, dof=0, predicted=tuple(predicted))
    found = seen_ranges(report, pose, RULE)
    assert found is not None
    return found


@pytest.mark.parametrize("probability", [2e-3, 0.05, 0.5, 1.0])
def test_a_doubt_covers_what_may_have_happened(probability: float) -> None:
    """What lies outside a region of it: exp(-r^2 / 2 V) for a variance V, in two dimensions."""
    limit = -2.0 * covered_share(probability) * math.log(TAIL_PROBABILITY)  # r^2 / V
    assert probability * math.exp(-limit / 2.0) == pytest.approx(TAIL_PROBABILITY)


def test_a_doubt_below_the_tail_adds_what_its_mixture_has() -> None:
    assert covered_share(TAIL_PROBABILITY / 2.0) == TAIL_PROBABILITY / 2.0


@pytest.mark.parametrize("probability", [5e-4, 0.02, 0.3, 1.0])
def test_what_a_possible_carry_adds(probability: float) -> None:
    expected = covered_share(probability) * CARRY
    np.testing.assert_allclose(at(doubtful(0.0, probability), 0.0), expected)


@pytest.mark.parametrize(("n", "each"), [(1, 0.04), (3, 0.04), (3, 0.6), (10, 1.0)])
def test_many_stops_are_no_more_than_one_carry(n: int, each: float) -> None:
    share = n * covered_share(each)
    carries = doubted_covariance([doubtful(0.0, each) for _ in range(n)], np.zeros(2))
    np.testing.assert_allclose(carries, min(share, 1.0) * CARRY)


@pytest.mark.parametrize(("n", "each"), [(3, 0.04), (3, 0.6)])
def test_the_probabilities_of_carries_that_one_doubt_holds_add_up(n: int, each: float) -> None:
    carries = doubtful(0.0, each)
    for _ in range(n - 1):
        carries.add(doubtful(0.0, each))
    np.testing.assert_allclose(at(carries, 0.0), covered_share(min(n * each, 1.0)) * CARRY)


def along_the_way(variance: float) -> float:
    """Return the mean square of cos(angle) - 1 of a normal angle, by Gauss and Hermite's rule."""
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    return float(weights @ (np.cos(math.sqrt(variance) * nodes) - 1.0) ** 2 / weights.sum())


@pytest.mark.parametrize("variance", [1e-4, 0.01, 0.2, 1.0])
def test_a_doubtful_turn_is_a_doubtful_position_far_from_it(variance: float) -> None:
    """2 m from it a place is off across the way by twice the angle, and along it by its cosine."""
    doubt = doubtful(1.0)
    doubt.covariance = np.diag([1e-4, 1e-4, variance])
    along = 1e-4 + 4.0 * along_the_way(variance)
    np.testing.assert_allclose(
        at(doubt, 3.0),
        [
            [along, 0.0, 0.0],
            [0.0, 1e-4 + 4.0 * variance, 2.0 * variance],
            [0.0, 2.0 * variance, variance],
        ],
    )


def test_a_carry_from_one_of_two_places_has_the_mean_of_both() -> None:
    both = doubtful(0.0)
    both.add(doubtful(1.0))
    sums = np.array([[2e-4, 0.0, 0.0], [0.0, 2e-4 + 0.09 + 0.04, 0.05], [0.0, 0.05, 0.02]])
    along = np.diag([along_the_way(0.01) + 2.0 * 4.0 * along_the_way(0.01), 0.0, 0.0])
    np.testing.assert_allclose(at(both, 3.0), (sums + along) / 2.0)
    apart = doubted_covariance([doubtful(0.0), doubtful(1.0)], np.array([3.0, 0.0]))
    along = np.diag([(9.0 + 4.0) * along_the_way(0.01), 0.0, 0.0])
    np.testing.assert_allclose(apart, (sums + along) / 2.0)


@pytest.mark.parametrize("probability", [0.01, 0.1, 1.0])
def test_what_a_carry_adds_along_the_way_is_in_proportion_to_its_probability(
    probability: float,
) -> None:
    found = doubtful(0.0, probability).at(np.array([2.0, 0.0]))
    assert found[0, 0] == pytest.approx(probability * (1e-4 + 4.0 * along_the_way(0.01)))


def test_slips_add_up() -> None:
    """The turn of two slips has the sum of their variances."""
    both = doubtful(0.0, is_carry=False)
    both.add(doubtful(0.0, is_carry=False))
    found = both.at(np.array([2.0, 0.0]))
    assert found[0, 0] == pytest.approx(2e-4 + 4.0 * along_the_way(0.02))


def test_doubts_that_are_joined_need_what_both_need() -> None:
    older, newer = doubtful(0.0), doubtful(1.0)
    older.next_id, newer.next_id = 3, 9
    older.nats, newer.nats = {0: 9.0, 1: 9.0}, {1: 2.0, 5: 9.0}
    older.information, newer.information = 2.0 * np.eye(3), np.eye(3)
    older.join(newer)
    assert (older.next_id, older.nats) == (3, {1: 2.0})
    np.testing.assert_array_equal(older.information, np.zeros((3, 3)))
    np.testing.assert_allclose(older.motion_covariance, 2.0 * np.diag(RULE.hidden_variances))


def test_one_that_knew_too_few_is_confirmed_with_the_one_that_it_is_joined_to() -> None:
    older, newer = doubtful(0.0), doubtful(1.0)
    older.knew_few, older.next_id, newer.next_id = True, 2, 9
    older.nats, newer.nats = {0: 9.0}, {1: 2.0, 5: 9.0}
    older.join(newer)
    assert (older.next_id, older.knew_few, older.nats) == (9, False, {1: 2.0, 5: 9.0})


def test_what_ranges_tell_of_a_motion_is_as_ranges_change_with_it() -> None:
    """Against differences of ranges after a motion at the doubt's place, and the way since."""
    doubt, way = doubtful(1.0), np.array([0.4, 0.1, 0.3])
    pose = compose(np.array([1.0, 0.0, 0.0]), way)
    points_m = [(1.5, 1.0), (2.0, -0.4), (0.3, 0.5)]
    doubt.measure(seen_from(pose, points_m, 4e-4))

    def ranges_m(motion: Array) -> Array:
        moved = compose(compose(np.array([1.0, 0.0, 0.0]), motion), way)
        antenna = compose(moved, np.array([LEVER_M, 0.0, 0.0]))[:2]
        away = np.array(points_m) - antenna
        return np.hypot(away[:, 0], away[:, 1])

    step = 1e-6
    J = np.column_stack(
        [(ranges_m(step * e) - ranges_m(-step * e)) / (2 * step) for e in np.eye(3)]
    )
    variance = RULE.correlated_steps * (RULE.model_sigma_m**2 + 4e-4)
    np.testing.assert_allclose(doubt.information, J.T @ J / variance, rtol=1e-6)


ABEAM = [(0.0, 0.9), (0.0, -0.8), (0.02, 0.7)]
AROUND = [(0.0, 0.9), (0.8, -0.3), (-0.6, 0.5)]


@pytest.mark.parametrize(
    ("points_m", "step_m", "ends"),
    [(ABEAM, 1e-3, False), (AROUND, 0.0, False), (AROUND, 0.01, True)],
    ids=["abeam", "at one place", "around"],
)
def test_a_doubt_ends_where_ranges_leave_no_motion_open(
    points_m: list[tuple[float, float]], step_m: float, ends: bool
) -> None:
    """Landmarks abeam leave the way along the course open; from one place, all leave the turn."""
    doubt = doubtful(0.0, 0.02)
    for step in range(20):
        pose = np.array([step_m * step, 0.0, 0.0])
        doubt.take(np.array([[0, MUCH], [1, MUCH], [2, MUCH]]), RULE)
        doubt.measure(seen_from(pose, points_m, 0.0))
    assert doubt.is_confirmed(RULE) is ends


@pytest.mark.parametrize(
    ("way", "ends"), [((0.0, 0.1, 0.0), True), ((0.1, 0.0, 0.0), False)], ids=["across", "along"]
)
def test_a_doubt_ends_where_the_one_motion_that_may_have_been_is_measured(
    way: tuple[float, float, float], ends: bool
) -> None:
    """Landmarks abeam tell of a slip across the course, whatever they leave open besides."""
    doubt = doubtful(0.0)
    doubt.motion_covariance = np.outer(way, way)
    for _ in range(20):
        doubt.take(np.array([[0, MUCH], [1, MUCH], [2, MUCH]]), RULE)
        doubt.measure(seen_from(np.zeros(3), [(LEVER_M, 0.9), (LEVER_M, -0.8)], 0.0))
    assert doubt.is_confirmed(RULE) is ends


@pytest.mark.parametrize(
    ("motion", "is_allowed"),
    [
        ((0.2, 0.0, 0.0), True),
        ((0.5, 0.0, 0.0), False),  # five standard deviations
        ((0.0, 0.2, 0.0), False),  # across what may have been
        # The position stays, but the heading turns
        ((1.0 - math.cos(0.2), -math.sin(0.2), 0.2), False),
    ],
    ids=str,
)
def test_a_doubt_allows_motions_that_may_have_been(
    motion: tuple[float, float, float], is_allowed: bool
) -> None:
    doubt = doubtful(1.0)
    doubt.motion_covariance = np.diag([0.1**2, 0.0, 0.0])
    assert doubt.allows(np.array(motion), 0.01) is is_allowed


def test_a_covariance_is_made_to_cover_another_one() -> None:
    """In the axes of both, by closed form; the sum is nowhere less than either of the two."""
    added = covering(np.diag([4.0, 1.0, 0.0]), np.diag([1.0, 9.0, 2.0]))
    np.testing.assert_allclose(added, np.diag([0.0, 8.0, 2.0]), atol=1e-9)
    rng = np.random.default_rng(5)
    of_filter, of_slip = (root @ root.T for root in rng.standard_normal((2, 3, 3)))
    added = covering(of_filter, of_slip)
    np.testing.assert_allclose(added, added.T, atol=1e-12)
    assert np.linalg.eigvalsh(added).min() > -1e-9
    missing = np.linalg.eigvalsh(of_filter + added - of_slip)
    assert missing.min() == pytest.approx(0.0, abs=1e-9)


def test_landmarks_known_before_end_a_doubt_and_new_ones_do_not() -> None:
    """Three of them, each with no more evidence than one may give."""
    doubt = doubtful(0.0)
    doubt.information = 1e9 * np.eye(3)
    for ids, ends in (((10, 11, 12), False), ((0, 1), False), ((2,), True)):
        doubt.take(np.array([[id_, MUCH] for id_ in ids]), RULE)
        assert doubt.is_confirmed(RULE) is ends


def test_ranges_of_new_landmarks_tell_nothing_of_a_motion_before_them() -> None:
    doubt = doubtful(0.0)
    doubt.next_id = 0
    doubt.measure(seen_from(np.zeros(3), AROUND, 0.0))
    assert not doubt.information.any()


def test_a_scan_without_ranges_of_landmarks_has_no_sightings() -> None:
    report = UpdateReport(continued=(), nis=0.0, dof=0)
    assert seen_ranges(report, np.zeros(3), RULE) is None

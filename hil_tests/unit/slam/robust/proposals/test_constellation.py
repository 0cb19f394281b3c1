"""Where one map lies on another, from the constellation of their landmarks."""

import math
from itertools import combinations, permutations

import numpy as np
import pytest

from slam.geometry import between, transform
from slam.robust.association import Pairs, density_per_m2
from slam.robust.initialisation import BodyPoint, initialise_landmark
from slam.robust.parameters import BranchRule
from slam.robust.proposals.constellation import (
    Constellation,
    Placement,
    _guesses,
    constellation_of,
    find_placement,
    stands_out,
)
from slam.robust.state import Array, State

PLACES = np.array(
    [[0.1, 0.9], [0.55, 0.7], [0.95, 1.1], [1.5, 0.8], [0.3, -0.8], [0.8, -1.0], [1.25, -0.7]]
)
RULE = BranchRule()


def known(places: Array, sigma_m: float = 5e-3) -> Constellation:
    n = len(places)
    return Constellation(
        ids=tuple(range(n)), points_m=places, covariance_m2=sigma_m**2 * np.eye(2 * n)
    )


def seen_from(pose: Array, places: Array) -> Constellation:
    return known(transform(between(pose, np.zeros(3)), places))


def test_a_constellation_gives_the_pose_of_the_robot() -> None:
    truth = np.array([0.6, 0.1, 2.0])
    found = find_placement(seen_from(truth, PLACES[[0, 1, 2, 5]]), known(PLACES), RULE)
    assert found is not None
    assert set(found.pairs) == {(0, 0), (1, 1), (2, 2), (5, 3)}
    assert found.motion == pytest.approx(truth, abs=1e-9)


def test_a_landmark_that_moved_is_left_out() -> None:
    truth = np.array([-0.4, 0.3, -1.0])
    places = PLACES[[0, 1, 2, 5, 6]].copy()
    places[1] += [0.1, -0.08]
    found = find_placement(seen_from(truth, places), known(PLACES), RULE)
    assert found is not None
    assert set(found.pairs) == {(0, 0), (2, 2), (5, 3), (6, 4)}
    assert found.motion == pytest.approx(truth, abs=1e-9)


def test_a_constellation_that_fits_twice_gives_no_placement() -> None:
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    assert find_placement(known(square), known(square), RULE) is None
    lopsided = np.vstack([square, [0.3, 0.55]])
    assert find_placement(known(lopsided), known(lopsided), RULE) is not None


def test_two_landmarks_or_an_unknown_place_give_no_placement() -> None:
    assert find_placement(known(PLACES[:2]), known(PLACES), RULE) is None
    assert find_placement(known(PLACES), known(PLACES[:2]), RULE) is None
    strange = np.array([[0.0, 0.0], [0.61, 0.1], [0.2, 0.47], [1.3, 0.9]])
    assert find_placement(known(strange), known(PLACES), RULE) is None


def test_where_a_map_has_its_origin_does_not_matter() -> None:
    truth = np.array([0.2, -0.1, 0.7])
    moved = np.array([3.0, -2.0, 2.5])
    here = seen_from(truth, PLACES[:4])
    one = find_placement(here, known(PLACES), RULE)
    other = find_placement(known(transform(moved, here.points_m)), known(PLACES), RULE)
    assert one is not None
    assert other is not None
    assert other.evidence == pytest.approx(one.evidence)
    assert other.motion == pytest.approx(
        [*transform(truth, between(moved, np.zeros(3))[:2]), 0.7 - 2.5], abs=1e-9
    )


def test_evidence_is_the_likelihood_with_the_motion_integrated_out() -> None:
    """Against the sum over a grid of motions, three landmarks of known places."""
    sigma_m = 0.002
    places = np.array([[0.0, 0.0], [1.0, 0.0], [0.2, 0.8]])
    noisy = places + np.array([[1e-3, -5e-4], [0.0, 1.2e-3], [-8e-4, 4e-4]])
    found = find_placement(known(noisy, sigma_m), known(places, sigma_m), RULE)
    assert found is not None
    steps = np.linspace(-0.01, 0.01, 61)
    total, variance = 0.0, 2 * sigma_m**2
    for turn in np.linspace(-0.02, 0.02, 61):
        c, s = math.cos(turn), math.sin(turn)
        residual = noisy @ np.array([[c, -s], [s, c]]).T - places
        x = residual[:, 0, None, None] + steps[:, None]
        y = residual[:, 1, None, None] + steps[None, :]
        squares = (x**2 + y**2).sum(axis=0)
        total += float(np.exp(-squares / (2 * variance)).sum()) / (math.tau * variance) ** 3
    total *= (0.02 / 60) ** 2 * (0.04 / 60)
    area_m2 = (1.0 + 3.0) * (0.8 + 3.0)
    expected = math.log(total / (math.tau * area_m2)) - 3 * math.log(density_per_m2(places, 1.5))
    assert found.evidence == pytest.approx(expected, abs=0.05)


def test_a_constellation_has_the_errors_of_its_landmarks() -> None:
    state = State((0.007, 0.007, 0.0042), (0.0,) * 4)
    for place in PLACES[:3]:
        point = BodyPoint(point_m=place, covariance=2.5e-5 * np.eye(2), by_offsets=np.zeros((2, 4)))
        initialise_landmark(state, point)
    # A heading that is uncertain by 0.1 rad turns robot and map: additive errors, all alike.
    turned = np.eye(state.P.size)[0]
    state.P.add_products(turned, 0.005 * turned)
    found = constellation_of(state, [0, 2], sigma_m=0.01)
    assert found.ids == (0, 2)
    swept = np.array([-PLACES[0, 1], PLACES[0, 0], -PLACES[2, 1], PLACES[2, 0]])
    expected = 0.01 * np.outer(swept, swept) + (2.5e-5 + 1e-4) * np.eye(4)
    assert found.covariance_m2 == pytest.approx(expected, abs=1e-12)


def guesses_one_by_one(points: Array, targets: Array, seeds: int) -> list[Pairs]:
    """Return what `_guesses` returns, by plain loops over complex numbers."""
    here, there = ([complex(x, y) for x, y in places.tolist()] for places in (points, targets))
    found: list[Pairs] = []
    for a, b in combinations(here[:seeds], 2):
        for i, j in permutations(there, 2):
            one, other = abs(b - a), abs(j - i)
            if min(one, other) < RULE.base_m or abs(one - other) > RULE.reach_m:
                continue
            turn = (j - i) / (b - a) * one / other
            laid = [(i + j) / 2 + turn * (point - (a + b) / 2) for point in here]
            pairs = []
            for row, target in enumerate(there):
                away = [abs(target - point) for point in laid]
                at = int(np.argmin(away))
                rivals = [abs(rival - laid[at]) for rival in there]
                if away[at] <= RULE.reach_m and np.argmin(rivals) == row:
                    pairs.append((row, at))
            if len(pairs) >= RULE.least_landmarks:
                found.append(tuple(pairs))
    return sorted(found, key=len, reverse=True)[: RULE.most_tried]


@pytest.mark.parametrize(
    ("n", "n_others", "seeds", "count"), [(3, 9, 3, 6), (7, 8, 2, 9), (7, 12, 7, 200)]
)
def test_guesses_are_those_of_plain_loops(n: int, n_others: int, seeds: int, count: int) -> None:
    """Half the landmarks are seen again, with errors, among others; of many guesses 200 stay."""
    rng = np.random.default_rng(0)
    points = rng.uniform([0.0, 0.0], [2.5, 1.5], (n, 2))
    again = points[::2] + rng.normal(0.0, 0.05, points[::2].shape)
    others = rng.uniform([-2.0, -1.0], [2.0, 2.0], (n_others, 2))
    targets = np.vstack([others, transform(np.array([0.6, 0.1, 2.0]), again)])
    found = _guesses(points, targets, RULE, seeds)
    assert len(found) == count
    assert found == guesses_one_by_one(points, targets, seeds)


FRAMES = np.array([[pitch, y] for pitch in range(5) for y in (0.0, 0.8)])
"""A row of equal frames, which repeats itself."""


def fits(*rows: int, n: int = 10) -> Array:
    """Return the evidence of some landmarks that lie where they should."""
    return np.where(np.isin(np.arange(n), rows), RULE.most_for, 0.0)


def anywhere(placement: Placement) -> bool:
    return len(placement.pairs) >= RULE.least_landmarks


def test_landmarks_that_lie_as_others_do_say_nothing_of_the_place() -> None:
    assert not stands_out(fits(2, 3, 4, 5), known(FRAMES), RULE, anywhere)
    more = known(np.vstack([FRAMES, [[1.4, 0.3], [1.7, 0.5], [2.2, 0.6]]]))
    assert not stands_out(fits(2, 3, 4, 5, 10, 11, n=13), more, RULE, anywhere)
    assert stands_out(fits(2, 3, 4, 5, 10, 11, 12, n=13), more, RULE, anywhere)
    assert stands_out(fits(0, 1, 2, 6), known(PLACES), RULE, anywhere)


def test_what_is_missed_counts_against_the_place() -> None:
    nats = np.array([9.0, 9.0, 9.0, 0.0, 0.0, 0.0, -7.5])
    assert stands_out(nats.clip(0.0), known(PLACES), RULE, anywhere)
    assert not stands_out(nats, known(PLACES), RULE, anywhere)


def test_only_possible_motions_make_landmarks_doubtful() -> None:
    def is_near(placement: Placement) -> bool:
        return float(np.hypot(*placement.motion[:2])) < 0.5

    assert not stands_out(fits(2, 3, 4), known(FRAMES), RULE, anywhere)
    assert stands_out(fits(2, 3, 4), known(FRAMES), RULE, is_near)


def test_two_landmarks_fit_too_many_places() -> None:
    assert not stands_out(np.array([15.0, 15.0, *np.zeros(5)]), known(PLACES), RULE, anywhere)


def test_two_landmarks_of_one_thing_are_alike_with_one() -> None:
    twice = known(np.vstack([FRAMES, FRAMES[[2, 3, 4]] + [0.004, 0.0]]))
    assert not stands_out(fits(2, 3, 4, 10, 11, 12, n=13), twice, RULE, anywhere)


def test_the_double_of_a_landmark_is_no_other_place() -> None:
    doubled = known(np.vstack([PLACES, PLACES[1] + [0.01, 0.0]]))
    assert stands_out(fits(0, 1, 2, 6, n=8), doubled, RULE, anywhere)
    assert stands_out(fits(0, 1, 2, 6, 7, n=8), doubled, RULE, anywhere)


def test_what_is_alike_is_found_among_landmarks_that_say_little() -> None:
    """Five landmarks say 16 nats, three that are alike elsewhere 9."""
    trio = np.array([[4.0, 0.0], [4.7, 0.2], [4.3, 0.9]])
    both = known(np.vstack([PLACES[:5], trio, trio + np.array([5.0, 0.0])]))
    nats = np.array([3.2] * 5 + [3.0] * 3 + [0.0] * 3)
    assert not stands_out(nats, both, RULE, anywhere)
    assert stands_out(np.where(nats == 3.2, 4.2, nats), both, RULE, anywhere)

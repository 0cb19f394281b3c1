"""Which range is of which landmark, by the robust back end: against brute force and chi-square."""

import math
from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from itertools import product
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import chi2, multivariate_normal

from hil_tests.property.robust_oracles import N_RADARS, random_state, rows_of, seeds, values
from hil_tests.property.trilateration_oracles import NO_RANGES
from slam.app.sweep.bound import fix_of_pair
from slam.geometry import paper_rig
from slam.robust.association import (
    Known,
    RangeScan,
    View,
    antennas_of,
    correspondence,
    find_known,
    find_points,
    point_view,
    view,
    weigh_known,
)
from slam.robust.back_end import RobustBackEnd
from slam.robust.initialisation import (
    BodyPoint,
    match,
    point_rows,
)
from slam.robust.parameters import (
    MARGIN_NATS,
    NEIGHBOURHOOD_M,
    TAIL_PROBABILITY,
    BackEndParameters,
    RangeNoise,
)
from slam.robust.state import State, SymmetricMatrix, rotation

Array = NDArray[np.float64]

NOISE = RangeNoise(sigma_m=0.02, clutter_per_m=0.5)
LEFT = (0, 1)
SIDE_OF = np.array([0, 0, 1, 1])
few = settings(max_examples=settings().max_examples // 3)
fewer = settings(max_examples=settings().max_examples // 6)  # brute force takes its time


def ahead_of_the_left_radars(seed: int, n: int) -> State:
    """Return a rather sure state and n landmarks close together in the left radars' view."""
    rng = np.random.default_rng(seed)
    state = random_state(seed, n, float(rng.uniform(-math.pi, math.pi)))
    body = np.array([0.0, 1.0]) + rng.uniform(-0.15, 0.15, (n, 2))
    state.landmarks_m = state.position_m + body @ rotation(state.heading_rad).T
    state.P = SymmetricMatrix(0.02 * state.P.full())
    return state


def known_of(state: State, scans: Sequence[RangeScan], noise: RangeNoise = NOISE) -> Known:
    seen = view(state, antennas_of(paper_rig(), (), np.zeros(3)))
    parameters = BackEndParameters(ranges=noise)
    return find_known(state, seen, scans, SIDE_OF, parameters)


def choice_of(known: Known) -> dict[tuple[int, int], int]:
    return {(radar, k): int(known.rows[at]) for radar, k, at in known.assigned.tolist()}


@dataclass(frozen=True)
class Sure:
    """Landmarks that take part, their ranges (n, 2) and the covariances of these (n, 2, 2)."""

    landmarks: list[int]
    predicted_m: Array
    prior: Array


def sure_ones(state: State) -> Sure:
    known = known_of(state, [RangeScan(radar=radar, ranges_m=()) for radar in LEFT])
    seen = view(state, antennas_of(paper_rig(), (), np.zeros(3)))
    part = known.of_side[0, :, 0]
    return Sure(
        landmarks=known.rows[part].tolist(),
        predicted_m=seen.ranges_m[:2, known.rows[part]].T,
        prior=known.prior[part][:, :2, :2],
    )


def scans_of(sure: Sure, rng: np.random.Generator) -> list[RangeScan]:
    """Return up to five ranges per radar: some of the landmarks', some of nothing."""
    scans = []
    for radar in LEFT:
        own = sure.predicted_m[:, radar]
        own = own[rng.random(len(own)) < 0.8]
        ranges = np.concatenate(
            [own + 0.04 * rng.standard_normal(len(own)), rng.uniform(0.6, 1.2, 2)]
        )[:5]
        scans.append(RangeScan(radar=radar, ranges_m=tuple(rng.permutation(ranges).tolist())))
    return scans


Choice = dict[tuple[int, int], int]
"""Which landmark each (radar, index of the range) is of."""


def options_by_hand(sure: Sure, scans: Sequence[RangeScan]) -> list[list[tuple[float, Choice]]]:
    """Return the options inside the gates of each landmark, and their costs by the formula."""
    per_landmark: list[list[tuple[float, Choice]]] = []
    for landmark, predicted, prior in zip(
        sure.landmarks, sure.predicted_m, sure.prior, strict=True
    ):
        found: list[tuple[float, Choice]] = [(0.0, {})]
        for picks in product(*([None, *range(len(scan.ranges_m))] for scan in scans)):
            used = [(k, pick) for k, pick in enumerate(picks) if pick is not None]
            m = len(used)
            if m == 0:
                continue
            rows = [k for k, _ in used]
            nu = np.array([scans[k].ranges_m[pick] for k, pick in used]) - predicted[rows]
            S = prior[np.ix_(rows, rows)] + NOISE.sigma_m**2 * np.eye(m)
            squared = float(nu @ np.linalg.inv(S) @ nu)
            if squared > chi2.isf(TAIL_PROBABILITY, m):
                continue
            odds = NOISE.detection_probability / (1 - NOISE.detection_probability)
            cost = squared + math.log(np.linalg.det(math.tau * S))
            cost += 2 * m * math.log(NOISE.clutter_per_m) - 2 * m * math.log(odds)
            found.append((cost, {(scans[k].radar, pick): landmark for k, pick in used}))
        per_landmark.append(found)
    return per_landmark


def _disjoint(per_landmark: list[list[tuple[float, Choice]]]) -> Iterator[tuple[float, Choice]]:
    if not per_landmark:
        yield 0.0, {}
        return
    for cost, rest in _disjoint(per_landmark[1:]):
        for own_cost, own in per_landmark[0]:
            if own.keys().isdisjoint(rest):
                yield cost + own_cost, {**rest, **own}


@fewer
@given(seeds, st.integers(1, 5), st.randoms(use_true_random=False))
def test_tracks_are_continued_as_the_best_of_all_assignments(
    seed: int, n: int, shuffler: Random
) -> None:
    state = ahead_of_the_left_radars(seed, n)
    sure = sure_ones(state)
    scans = scans_of(sure, np.random.default_rng(seed))
    known = known_of(state, scans)
    choice = choice_of(known)
    assert len(choice) == len(known.assigned)  # no range twice
    ordered = sorted(_disjoint(options_by_hand(sure, scans)), key=lambda entry: entry[0])
    costs = [cost for cost, _ in ordered]
    if len(costs) == 1 or costs[1] - costs[0] > 1e-9:  # no tie
        assert choice == ordered[0][1]
    # In whatever order the ranges come, the same ones are of the same landmarks.
    orders = [shuffler.sample(range(len(scan.ranges_m)), len(scan.ranges_m)) for scan in scans]
    shuffled = [
        replace(scan, ranges_m=tuple(scan.ranges_m[i] for i in order))
        for scan, order in zip(scans, orders, strict=True)
    ]
    again = choice_of(known_of(state, shuffled))
    of_radar = dict(zip(LEFT, orders, strict=True))
    assert {(radar, of_radar[radar][k]): row for (radar, k), row in again.items()} == choice


def test_the_brute_force_has_work_to_do() -> None:
    """Most of the examples above have several landmarks and contested ranges."""
    contested = 0
    for seed in range(20):
        sure = sure_ones(ahead_of_the_left_radars(seed, 4))
        options = options_by_hand(sure, scans_of(sure, np.random.default_rng(seed)))
        cost = min(cost for cost, _ in _disjoint(options))
        contested += cost > sum(min(one)[0] for one in options if one) + 1e-9
    assert contested >= 5


# --- gates ----------------------------------------------------------------------------------------


def one_landmark(prior: Array) -> State:
    """Return a landmark 1 m ahead whose ranges of the left radars have a covariance (2, 2)."""
    state = random_state(0, 1, 0.3)
    state.landmarks_m = state.position_m + np.array([[0.0, 1.0]]) @ rotation(state.heading_rad).T
    u = view(state, antennas_of(paper_rig(), (), np.zeros(3))).directions[:2, 0]
    P = 1e-18 * np.eye(state.P.size)
    P[-2:, -2:] += np.linalg.inv(u) @ prior @ np.linalg.inv(u).T
    state.P = SymmetricMatrix(P)
    return state


TRIALS = 10_000


@pytest.mark.parametrize("n_radars", [pytest.param(1, marks=pytest.mark.rare), 2])
def test_true_ranges_pass_their_gates_as_often_as_they_say(n_radars: int) -> None:
    rng = np.random.default_rng(11)
    prior = 1e-4 * np.array([[1.0, 0.6], [0.6, 2.0]])
    # So little clutter that the gate alone decides.
    noise = replace(NOISE, clutter_per_m=1e-12)
    state = one_landmark(prior)
    seen = view(state, antennas_of(paper_rig(), (), np.zeros(3)))
    parameters = BackEndParameters(ranges=noise)
    root = np.linalg.cholesky((prior + noise.sigma_m**2 * np.eye(2))[:n_radars, :n_radars])
    whole = 0
    for z in seen.ranges_m[:n_radars, 0] + rng.standard_normal((TRIALS, n_radars)) @ root.T:
        scans = [RangeScan(radar=k, ranges_m=(range_m,)) for k, range_m in enumerate(z.tolist())]
        whole += len(find_known(state, seen, scans, SIDE_OF, parameters).assigned) == n_radars
    assert whole / TRIALS == pytest.approx(1.0 - TAIL_PROBABILITY, abs=0.002)


@pytest.mark.parametrize(("sigmas", "n_used"), [(2.62, 2), (2.64, 1), (3.28, 1), (3.30, 0)])
def test_a_gate_ends_where_it_says(sigmas: float, n_used: int) -> None:
    """Two ranges so far off: 2 * 2.63^2 = 13.8 for both together, 3.29^2 = 10.8 for one alone."""
    noise = replace(NOISE, clutter_per_m=1e-12)
    state = one_landmark(1e-4 * np.eye(2))
    predicted = view(state, antennas_of(paper_rig(), (), np.zeros(3))).ranges_m[:, 0]
    ranges_m = predicted + sigmas * math.hypot(0.01, noise.sigma_m)
    scans = [RangeScan(radar=radar, ranges_m=(float(ranges_m[radar]),)) for radar in LEFT]
    assert len(known_of(state, scans, noise).assigned) == n_used


def camera_sees(
    state: State, seen: View, points: Sequence[tuple[float, float]], noise: RangeNoise
) -> list[tuple[int, int]]:
    """Return index and row of what a scan of radar 0 sees, by range and bearing."""
    scan = RangeScan(
        radar=0,
        ranges_m=tuple(range_m for range_m, _ in points),
        bearings_rad=tuple(bearing for _, bearing in points),
    )
    parameters = BackEndParameters(ranges=noise)
    found = find_points(state, seen, scan, (range(len(points)), (), {}), parameters)
    return sorted(found.pairs)


def test_true_points_pass_their_gate_as_often_as_it_says() -> None:
    """Drawn from the distribution of the state's own errors, by its own formulas."""
    rng = np.random.default_rng(12)
    noise = replace(NOISE, clutter_per_m=1e-12, bearing_sigma_rad=0.02)
    state = one_landmark(1e-6 * np.array([[2.0, 1.0], [1.0, 3.0]]))
    seen = view(state, antennas_of(paper_rig(), (), np.zeros(3)))
    of = point_view(state, seen, 0, np.array([0]))
    S = of.H[0] @ state.P.block(of.at) @ of.H[0].T
    S += np.diag([noise.sigma_m**2, noise.bearing_sigma_rad**2])
    noisy = of.predicted[0] + rng.standard_normal((TRIALS // 4, 2)) @ np.linalg.cholesky(S).T
    passed = sum(
        camera_sees(state, seen, [(z[0], z[1])], noise) == [(0, 0)] for z in noisy.tolist()
    )
    assert passed / len(noisy) == pytest.approx(1.0 - TAIL_PROBABILITY, abs=0.002)


@few
@given(seeds, st.integers(1, 4), st.integers(1, 4))
def test_sure_points_are_assigned_as_the_best_of_all_assignments(
    seed: int, n: int, n_points: int
) -> None:
    """By the likelihood with its determinant, written out, against clutter."""
    rng = np.random.default_rng(seed)
    state = ahead_of_the_left_radars(seed, n)
    state.P = SymmetricMatrix(1e-4 * state.P.full())  # far surer than the sensor
    noise = replace(NOISE, sigma_m=0.05, bearing_sigma_rad=0.05)
    seen = view(state, antennas_of(paper_rig(), (), np.zeros(3)))
    of = point_view(state, seen, 0, np.arange(n))
    points = of.predicted[rng.integers(0, n, n_points)] + rng.normal(0.0, 0.05, (n_points, 2))
    R = np.diag([noise.sigma_m**2, noise.bearing_sigma_rad**2])
    Pd, clutter = noise.detection_probability, noise.clutter_per_m / noise.field_of_view_rad
    gain = np.full((n_points, n), -math.inf)
    for k in range(n):
        S = of.H[k] @ state.P.block(of.at) @ of.H[k].T + R
        for i, z in enumerate(points):
            if (z - of.predicted[k]) @ np.linalg.solve(S, z - of.predicted[k]) <= chi2.isf(1e-3, 2):
                density = multivariate_normal.pdf(z, of.predicted[k], S)
                gain[i, k] = math.log(Pd / (1.0 - Pd) * density / clutter)

    def total(choice: Sequence[int | None]) -> float:
        return sum(0.0 if k is None else gain[i, k] for i, k in enumerate(choice))

    best = max(
        total(choice)
        for choice in product([None, *range(n)], repeat=n_points)
        if len(used := [k for k in choice if k is not None]) == len(set(used))
    )
    found = dict(camera_sees(state, seen, [(z[0], z[1]) for z in points.tolist()], noise))
    assert total([found.get(i) for i in range(n_points)]) == pytest.approx(best, abs=1e-9)


def test_a_point_of_an_unsure_landmark_is_taken_only_where_it_is_certain() -> None:
    """The wider the prediction, the likelier is another landmark at the same place."""
    noise = replace(NOISE, sigma_m=0.01, bearing_sigma_rad=0.01)
    for sigma_m, is_taken in ((0.005, True), (0.05, True), (0.5, False)):
        state = one_landmark(sigma_m**2 * np.eye(2))
        seen = view(state, antennas_of(paper_rig(), (), np.zeros(3)))
        z = float(seen.ranges_m[0, 0]), float(seen.off_boresight_rad[0, 0])
        assert (camera_sees(state, seen, [z], noise) == [(0, 0)]) == is_taken


def test_an_unsure_landmark_is_neither_of_two_points() -> None:
    noise = replace(NOISE, sigma_m=0.01, bearing_sigma_rad=0.01)
    state = one_landmark(0.05**2 * np.eye(2))
    seen = view(state, antennas_of(paper_rig(), (), np.zeros(3)))
    range_m, bearing = float(seen.ranges_m[0, 0]), float(seen.off_boresight_rad[0, 0])
    one, other = (range_m - 0.02, bearing), (range_m + 0.02, bearing)
    assert camera_sees(state, seen, [one], noise) == [(0, 0)]
    assert camera_sees(state, seen, [one, other], noise) == []


@few
@given(seeds, st.integers(1, 5))
def test_a_point_is_matched_by_the_rule_written_out(seed: int, n: int) -> None:
    """Gate, density of what is not yet mapped, and a lead over the next."""
    rng = np.random.default_rng(seed)
    state = ahead_of_the_left_radars(seed, n)
    point = BodyPoint(
        point_m=np.array([0.0, 1.0]) + rng.uniform(-0.15, 0.15, 2),
        covariance=1e-4 * np.eye(2),
        by_offsets=0.1 * rng.standard_normal((2, N_RADARS)),
    )
    scores = []
    for row in range(n):
        rows = point_rows(state, row, point)
        squared = float(rows.residual @ np.linalg.inv(rows.S) @ rows.residual)
        density = math.exp(-squared / 2) / math.sqrt(np.linalg.det(math.tau * rows.S))
        scores.append((squared + math.log(np.linalg.det(rows.S)), squared, density, row))
    scores.sort()
    _, squared, density, best = scores[0]
    clear = len(scores) == 1 or scores[1][0] - scores[0][0] > 2.0 * MARGIN_NATS
    apart = state.landmarks_m[:, None] - state.landmarks_m[None, :]
    others = int((np.hypot(apart[..., 0], apart[..., 1]) <= NEIGHBOURHOOD_M).sum()) - n
    per_m2 = max(others / n, 1.0) / (math.pi * NEIGHBOURHOOD_M**2)
    is_known = density > math.exp(MARGIN_NATS) * per_m2
    wanted = squared <= chi2.isf(TAIL_PROBABILITY, 2) and is_known and clear
    assert match(state, point) == (best if wanted else None)


def sure_point(sigma_m: float, *landmarks_m: tuple[float, float]) -> tuple[State, BodyPoint]:
    """Return a state that is sure of everything, and a point 1 m ahead that is not."""
    state = random_state(0, len(landmarks_m), 0.3)
    state.P = SymmetricMatrix(1e-18 * np.eye(state.P.size))
    state.landmarks_m = state.position_m + np.array(landmarks_m) @ rotation(state.heading_rad).T
    point = BodyPoint(
        point_m=np.array([1.0, 0.0]),
        covariance=sigma_m**2 * np.eye(2),
        by_offsets=np.zeros((2, N_RADARS)),
    )
    return state, point


@pytest.mark.parametrize(("sigma_m", "row"), [(0.236, 0), (0.237, None)])
def test_a_point_that_is_likelier_new_is_no_match(sigma_m: float, row: int | None) -> None:
    """1 / (2 pi sigma^2) exceeds one landmark on a disc of 1.5 m by 3 nats below 0.2367 m."""
    state, point = sure_point(sigma_m, (1.0, 0.0))
    assert match(state, point) == row


@pytest.mark.parametrize(("apart_m", "row"), [(0.244, None), (0.246, 1)])
def test_a_point_between_two_landmarks_is_neither(apart_m: float, row: int | None) -> None:
    """(0.245 m / 0.1 m)^2 = 6 is the likelihood margin."""
    state, point = sure_point(0.1, (1.0, apart_m), (1.0, 0.0))
    assert match(state, point) == row


# --- evidence, in nats, with nothing left out ---------------------------------------------------


@few
@given(seeds, st.integers(1, 4))
def test_ranges_are_worth_their_density_over_that_of_false_ones(seed: int, n: int) -> None:
    """In logarithms: N(nu; 0, S) of all ranges together, and Pd / lambda of each."""
    noise = replace(NOISE, huber_sigmas=math.inf)
    state = ahead_of_the_left_radars(seed, n)
    scans = scans_of(sure_ones(state), np.random.default_rng(seed))
    known = known_of(state, scans, noise)
    if not len(known.assigned):
        return
    seen = view(state, antennas_of(paper_rig(), (), np.zeros(3)))
    radars, indices, places = known.assigned.T
    rows = rows_of(state, seen, radars, known.rows[places])
    S = rows.H @ state.P.block(rows.at) @ rows.H.T + noise.sigma_m**2 * np.eye(len(radars))
    z = np.array([scans[radar].ranges_m[k] for radar, k in zip(radars, indices, strict=True)])
    expected = float(multivariate_normal.logpdf(z, rows.predicted_m, S))
    for radar in radars:
        per_m = len(scans[radar].ranges_m) / (noise.max_range_m - noise.min_range_m)
        density = max(per_m, noise.clutter_per_m)
        expected += math.log(noise.detection_probability / density)
    found = weigh_known(state, known, seen, scans, noise).evidence
    assert float(found.sum()) == pytest.approx(expected, abs=1e-6)


@few
@given(seeds, st.floats(0.01, 10.0))
def test_an_identity_is_worth_its_density_over_that_of_chance_neighbours(
    seed: int, per_m2: float
) -> None:
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((2, 2))
    S = root @ root.T + 0.1 * np.eye(2)
    residual = rng.standard_normal(2)
    judged = correspondence((0, 0), residual, S, per_m2)
    log_density = float(multivariate_normal.logpdf(residual, np.zeros(2), S))
    assert judged.evidence == pytest.approx(log_density - math.log(per_m2), abs=1e-9)
    squared = float(residual @ np.linalg.inv(S) @ residual)
    assert judged.mahalanobis_sq == pytest.approx(squared, rel=1e-9)


@pytest.mark.parametrize("sigmas_off", [0.0, 1.0, 2.5])
def test_a_point_is_worth_its_density_over_that_of_what_is_not_mapped(sigmas_off: float) -> None:
    """Per metre and radian, as the sensor measures: a square metre is 1 / r of these."""
    noise = replace(NOISE, sigma_m=0.05, bearing_sigma_rad=0.04, unmapped_per_m2=0.3)
    state = one_landmark(1e-5 * np.array([[2.0, 1.0], [1.0, 3.0]]))
    seen = view(state, antennas_of(paper_rig(), (), np.zeros(3)))
    of = point_view(state, seen, 0, np.array([0]))
    S = of.H[0] @ state.P.block(of.at) @ of.H[0].T
    S += np.diag([noise.sigma_m**2, noise.bearing_sigma_rad**2])
    range_m, bearing = (of.predicted[0] + sigmas_off * np.linalg.cholesky(S)[:, 0]).tolist()
    scan = RangeScan(radar=0, ranges_m=(range_m,), bearings_rad=(bearing,))
    found = find_points(state, seen, scan, ([0], (), {}), BackEndParameters(ranges=noise))
    assert found.pairs == ((0, 0),)
    log_density = float(multivariate_normal.logpdf((range_m, bearing), of.predicted[0], S))
    new = noise.unmapped_per_m2 * range_m
    assert found.evidence == pytest.approx((log_density - math.log(new),), abs=1e-9)


# --- what is left alone ---------------------------------------------------------------------------


def lone_landmark() -> RobustBackEnd:
    back_end = RobustBackEnd(paper_rig(), BackEndParameters())
    point = BodyPoint(
        point_m=np.array([0.0, 1.0]), covariance=1e-6 * np.eye(2), by_offsets=np.zeros((2, 4))
    )
    for k in range(12):
        back_end.predict(np.array([1e-2, 0.0, 0.0]))
        at = np.array([1e-2 * (k + 1), 0.0])
        scans = []
        for radar in LEFT:
            mount = paper_rig().mounts[radar]
            away = point.point_m - at - [mount.x_m, mount.y_m]
            scans.append(RangeScan(radar=radar, ranges_m=(float(np.hypot(*away)),)))
        back_end.update(scans)
    assert len(back_end.state.landmark_ids) == 1
    return back_end


LONE = lone_landmark()


@few
@given(st.lists(st.one_of(st.floats(0.2, 0.6), st.floats(1.1, 1.5)), max_size=4), st.booleans())
def test_ranges_of_nothing_known_alter_no_landmark(ranges: list[float], left: bool) -> None:
    back_end = deepcopy(LONE)
    report = back_end.update([RangeScan(radar=0 if left else 2, ranges_m=tuple(ranges))])
    assert report.continued == ()
    assert np.array_equal(values(back_end.state), values(LONE.state))
    assert np.array_equal(back_end.state.P.full(), LONE.state.P.full())


# --- the fix of two ranges ------------------------------------------------------------------------

HERE, THERE, AHEAD = np.array([-0.1, 0.2]), np.array([0.1, 0.2]), np.array([0.0, 1.0])


@given(st.floats(-1.5, 1.5), st.floats(0.21, 1.7), st.floats(-math.pi, math.pi))
def test_fix_of_two_ranges_is_where_they_were_measured_to(x: float, y: float, turn: float) -> None:
    R = rotation(turn)
    target = np.array([x, y])
    first_m, second_m = (float(np.hypot(*(target - antenna))) for antenna in (HERE, THERE))
    found = fix_of_pair(R @ HERE, R @ THERE, first_m, second_m, R @ AHEAD)
    # Beside the antennas, where the circles almost touch, digits are lost.
    square = (y - 0.2) ** 2
    if found is None:
        assert square < 1e-12
    else:
        assert math.dist(found, R @ target) <= 1e-12 / max(y - 0.2, 1e-3)


NONSENSE = st.one_of(NO_RANGES, st.floats(max_value=0.0), st.floats(min_value=1e150))


@given(st.one_of(NONSENSE, st.floats()), st.one_of(NONSENSE, st.floats(0.2, 1.5)))
def test_impossible_ranges_have_no_fix(first_m: float, second_m: float) -> None:
    possible = 0 < first_m < 1e150 and 0 < second_m < 1e150
    if possible and abs(first_m - second_m) <= 0.2 <= first_m + second_m:
        return
    assert fix_of_pair(HERE, THERE, first_m, second_m, AHEAD) is None
    assert fix_of_pair(HERE, THERE, second_m, first_m, AHEAD) is None


@few
@given(
    # a scan has no others
    st.lists(NONSENSE.filter(lambda x: abs(x) <= 1e150), min_size=1, max_size=4),
    st.integers(0, 3),
)
def test_impossible_ranges_change_nothing(nonsense: list[float], radar: int) -> None:
    """No landmark comes of them, and good ranges beside them count."""
    back_end = deepcopy(LONE)
    good = [
        float(np.hypot(0.0 - mount.x_m - back_end.state.position_m[0], 1.0 - mount.y_m))
        for mount in paper_rig().mounts[:2]
    ]
    clean, spoilt = deepcopy(back_end), deepcopy(back_end)
    scans = [RangeScan(radar=k, ranges_m=(good[k],) if k < 2 else ()) for k in range(4)]
    clean.update(scans)
    bad = replace(scans[radar], ranges_m=(*scans[radar].ranges_m, *nonsense))
    report = spoilt.update([bad if k == radar else scans[k] for k in range(4)])
    assert len(report.continued) == 2
    assert np.array_equal(values(spoilt.state), values(clean.state))
    assert np.array_equal(spoilt.state.P.full(), clean.state.P.full())

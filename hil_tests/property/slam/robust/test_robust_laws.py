"""Laws of the robust filter and smoother, against dense algebra and scipy as oracles."""

import itertools
import math
from copy import deepcopy

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil_tests.property.robust_oracles import (
    N_RADARS,
    Array,
    random_state,
    seeds,
)
from slam.config import WheelNoise
from slam.robust.association import NOTHING, Antennas, Option, cheapest, rows_of, view
from slam.robust.initialisation import BodyPoint, initialise_landmark, update_with_point
from slam.robust.map import apply_merge, merge_rows
from slam.robust.state import Indices, State, SymmetricMatrix, calibrated_motion, predict

WHEELS = WheelNoise(walk_per_sqrt_m=0.1)
ANTENNAS = Antennas(
    position_m=np.array([[-0.1, 0.2], [0.1, 0.2], [0.1, -0.2], [-0.1, -0.2]]),
    yaw_rad=np.array([1.0, 1.0, -1.0, -1.0]) * math.pi / 2,
    has_frame=np.ones(4, dtype=bool),
)
few = settings(max_examples=30, deadline=None)


def go(state: State, increment: Array) -> None:
    predict(state, calibrated_motion(increment, state.calibration, WHEELS), WHEELS)


def measure(
    state: State, radars: Indices, landmarks: Indices, residual: Array, sigma: float
) -> float:
    rows = rows_of(state, view(state, ANTENNAS), radars, landmarks)
    nis, _ = state.update(rows.at, rows.H, residual, np.full(len(residual), sigma**2))
    return nis


def test_covariance_stays_symmetric_and_positive_over_ten_thousand_operations() -> None:
    rng = np.random.default_rng(5)
    state = random_state(5, 4, 0.3)
    for _ in range(10_000):
        n, choice = len(state.landmark_ids), rng.random()
        if choice < 0.55 or n < 2:
            go(state, np.array([0.01, 0.0, 0.02 * rng.standard_normal()]))
        elif choice < 0.95:
            landmarks = rng.integers(0, n, 2)
            measure(state, rng.integers(0, 4, 2), landmarks, 1e-3 * rng.standard_normal(2), 1e-3)
        elif choice < 0.97 and n < 10:
            place = BodyPoint(
                point_m=rng.uniform(-1, 1, 2),
                covariance=1e-4 * np.eye(2),
                by_offsets=rng.standard_normal((2, N_RADARS)),
            )
            initialise_landmark(state, place)
        elif choice < 0.98:
            state.remove(int(rng.integers(0, n)))
        elif choice < 0.985 and n > 3:
            apply_merge(state, ((0, 1),), 1e-5)
    P = state.P.full()
    assert np.array_equal(P, P.T)
    assert np.linalg.eigvalsh(P)[0] >= -1e-12 * np.trace(P)


def test_three_directions_stay_unobservable_whatever_the_filter_believes() -> None:
    """Doubt about the frame itself passes through motions, updates and corrections untouched."""
    certain, doubtful = random_state(3, 3, 3.1), random_state(3, 3, 3.1)
    N = np.zeros((certain.P.size, 3))
    N[0, 0] = 1.0
    N[1:3, 1:] = np.eye(2)
    N[certain.offsets.stop :, 1:] = np.tile(np.eye(2), (3, 1))
    added = N @ np.diag([4.0, 9.0, 16.0]) @ N.T
    doubtful.P = SymmetricMatrix(certain.P.full() + added)
    rng = np.random.default_rng(3)
    for _ in range(30):
        increment = np.array([0.05, 0.0, 0.2 * rng.standard_normal()])
        residual = 0.05 * rng.standard_normal(2)
        pair = rng.integers(0, 4, 2), rng.integers(0, 3, 2)
        for state in (certain, doubtful):
            go(state, increment)
        assert measure(certain, *pair, residual, 0.01) == pytest.approx(
            measure(doubtful, *pair, residual, 0.01), rel=1e-6
        )
    difference = doubtful.P.full() - certain.P.full()
    # Predictions rotate the heading's doubt about the origin of the map: N is constant.
    assert np.abs(difference - added).max() <= 1e-9 * np.abs(added).max()
    assert int(np.sum(np.linalg.svd(difference)[1] > 1e-9)) == 3


@few
@given(seeds)
def test_a_merge_is_the_statement_that_the_difference_is_zero(seed: int) -> None:
    state = random_state(seed, 4, 0.5)
    state.landmarks_m[2] = state.landmarks_m[0] + 0.01
    at, H, residual, R = merge_rows(state, ((0, 2),), 1e-3)
    P = state.P.full()
    dense = np.zeros((2, len(P)))
    dense[:, at] = H
    K = P @ dense.T @ np.linalg.inv(dense @ P @ dense.T + R)
    rest = np.eye(len(P)) - K @ dense
    wanted = rest @ P @ rest.T + K @ R @ K.T
    moved = deepcopy(state)
    moved.correct(K @ residual)
    merged = deepcopy(state)
    apply_merge(merged, ((0, 2),), 1e-3)
    gone = [state.offsets.stop + 4, state.offsets.stop + 5]
    keep = np.delete(np.arange(len(P)), gone)
    assert np.abs(merged.P.full() - wanted[np.ix_(keep, keep)]).max() <= 1e-9
    assert merged.landmarks_m == pytest.approx(np.delete(moved.landmarks_m, 2, 0), abs=1e-9)
    assert merged.landmark_ids == [0, 1, 3]


@few
@given(seeds, st.integers(0, 3))
def test_deleting_is_marginalising_bit_for_bit(seed: int, row: int) -> None:
    state = random_state(seed, 4, 0.0)
    first = state.offsets.stop + 2 * row
    keep = np.delete(np.arange(state.P.size), [first, first + 1])
    wanted = state.P.full()[np.ix_(keep, keep)]
    state.remove(row)
    assert np.array_equal(state.P.full(), wanted)


def test_with_a_known_heading_the_filter_is_weighted_least_squares() -> None:
    """No turn, no calibration errors: everything is linear, and batch WLS has the answer."""
    rng = np.random.default_rng(0)
    wheels = WheelNoise(scale_sigma=0.0, turn_scale_sigma=0.0, curvature_sigma_rad_per_m=0.0)
    state = State((0.0, 0.0, 0.0), (0.0,) * N_RADARS)
    Q, C = np.diag([1e-4, 2e-4, 0.0]), 1e-4 * np.array([[2.0, 0.5], [0.5, 1.0]])
    nothing = np.zeros((2, N_RADARS))
    n_steps, n_marks = 6, 2
    size = 2 * (n_steps + n_marks)
    rows: list[Array] = []
    right: list[Array] = []

    def observe(columns: Array, value: Array, covariance: Array) -> None:
        root = np.linalg.inv(np.linalg.cholesky(covariance))
        rows.append(root @ columns)
        right.append(root @ value)

    def pick(place: int) -> Array:
        columns = np.zeros((2, size))
        columns[:, 2 * place : 2 * place + 2] = np.eye(2)
        return columns

    for k in range(n_steps):
        u = np.array([0.1, 0.05, 0.0]) + np.append(0.01 * rng.standard_normal(2), 0.0)
        predict(state, calibrated_motion(u, state.calibration, wheels, Q), wheels)
        before = pick(k - 1) if k else np.zeros((2, size))
        observe(pick(k) - before, u[:2], Q[:2, :2])
        for mark in range(n_marks):
            y = np.array([1.0, mark]) + 0.01 * rng.standard_normal(2)
            point = BodyPoint(point_m=y, covariance=C, by_offsets=nothing)
            if k == 0:
                initialise_landmark(state, point)
            else:
                update_with_point(state, mark, point)
            observe(pick(n_steps + mark) - pick(k), y, C)
    A, b = np.vstack(rows), np.concatenate(right)
    covariance = np.linalg.inv(A.T @ A)
    solution = covariance @ A.T @ b
    keep = np.arange(2 * (n_steps - 1), size)
    at = np.concatenate([[1, 2], np.arange(state.offsets.stop, state.P.size)])
    found = np.concatenate([state.position_m, state.landmarks_m.ravel()])
    assert np.abs(found - solution[keep]).max() <= 1e-8
    assert np.abs(state.P.block(at) - covariance[np.ix_(keep, keep)]).max() <= 1e-8


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_continuation_is_the_best_of_all_assignments(data: st.DataObject) -> None:
    n = data.draw(st.integers(1, 5))
    rng = np.random.default_rng(data.draw(seeds))
    options: list[list[Option]] = []
    for _ in range(n):
        own = [
            Option(((int(radar), int(index)),), -float(cost))
            for radar, index, cost in zip(
                rng.integers(0, 2, 4), rng.integers(0, 5, 4), rng.random(4), strict=True
            )
        ]
        own.append(Option(((0, int(rng.integers(5))), (1, int(rng.integers(5)))), -rng.random()))
        options.append([*sorted(own, key=lambda option: option.cost), NOTHING])

    def cost_of(choice: tuple[Option, ...]) -> float:
        used = [range_ for option in choice for range_ in option.used]
        return math.inf if len(used) > len(set(used)) else sum(option.cost for option in choice)

    best = min(cost_of(choice) for choice in itertools.product(*options))
    found = cheapest(options)
    assert cost_of(tuple(found)) == pytest.approx(best, abs=1e-12)
    order = rng.permutation(n)
    again = cheapest([options[i] for i in order])
    assert [again[int(np.flatnonzero(order == i)[0])] for i in range(n)] == found

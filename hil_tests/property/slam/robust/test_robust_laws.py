"""Laws of the robust filter and smoother, against dense algebra and scipy as oracles."""

import math
from copy import deepcopy

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil_tests.property.examples import examples
from hil_tests.property.robust_oracles import (
    N_RADARS,
    Array,
    random_state,
    rows_of,
    seeds,
)
from slam.config import WheelNoise
from slam.robust.association import Antennas, view
from slam.robust.initialisation import BodyPoint, initialise_landmark
from slam.robust.map import apply_merge
from slam.robust.state import Indices, State, calibrated_motion, predict

WHEELS = WheelNoise(walk_per_sqrt_m=0.1)
PLACES = np.array([[-0.1, 0.2], [0.1, 0.2], [0.1, -0.2], [-0.1, -0.2]])
ANTENNAS = Antennas(
    position_m=PLACES,
    yaw_rad=np.array([1.0, 1.0, -1.0, -1.0]) * math.pi / 2,
    has_frame=np.ones(4, dtype=bool),
    nominal_m=PLACES,
    turns_rad=np.zeros(4),
)
few = settings(max_examples=examples(30), deadline=None)


def go(state: State, increment: Array) -> None:
    predict(state, calibrated_motion(increment, state.calibration, WHEELS), WHEELS)


def measure(
    state: State, radars: Indices, landmarks: Indices, residual: Array, sigma: float
) -> float:
    rows = rows_of(state, view(state, ANTENNAS), radars, landmarks)
    return state.update(rows.at, rows.H, residual, np.full(len(residual), sigma**2))


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


@few
@given(seeds)
def test_a_merge_is_the_statement_that_the_difference_is_zero(seed: int) -> None:
    state = random_state(seed, 4, 0.5)
    state.landmarks_m[2] = state.landmarks_m[0] + 0.01
    P, first, R = state.P.full(), state.layout.offsets.stop, 1e-6 * np.eye(2)
    dense = np.zeros((2, len(P)))
    dense[:, first : first + 2], dense[:, first + 4 : first + 6] = np.eye(2), -np.eye(2)
    residual = state.landmarks_m[2] - state.landmarks_m[0]
    K = P @ dense.T @ np.linalg.inv(dense @ P @ dense.T + R)
    rest = np.eye(len(P)) - K @ dense
    wanted = rest @ P @ rest.T + K @ R @ K.T
    moved = deepcopy(state)
    moved.correct(K @ residual)
    merged = deepcopy(state)
    apply_merge(merged, ((0, 2),), 1e-3)
    gone = [first + 4, first + 5]
    keep = np.delete(np.arange(len(P)), gone)
    assert np.abs(merged.P.full() - wanted[np.ix_(keep, keep)]).max() <= 1e-9
    assert merged.landmarks_m == pytest.approx(np.delete(moved.landmarks_m, 2, 0), abs=1e-9)
    assert merged.landmark_ids == [0, 1, 3]


@few
@given(seeds, st.integers(0, 3))
def test_deleting_is_marginalising_bit_for_bit(seed: int, row: int) -> None:
    state = random_state(seed, 4, 0.0)
    first = state.layout.offsets.stop + 2 * row
    keep = np.delete(np.arange(state.P.size), [first, first + 1])
    wanted = state.P.full()[np.ix_(keep, keep)]
    state.remove(row)
    assert np.array_equal(state.P.full(), wanted)

"""Laws of single steps of the robust filter: updates, births, predictions, frames and names."""

import math
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hil_tests.property.ekf_oracles import relative_error, turn_between
from hil_tests.property.robust_oracles import (
    N_RADARS,
    Array,
    Rows,
    increments,
    landmark_covariance,
    random_state,
    rows_of,
    seeds,
    turn,
    values,
)
from slam.config import WheelNoise
from slam.geometry import compose, paper_rig
from slam.robust.association import antennas_of, view
from slam.robust.initialisation import BodyPoint, initialise_landmark
from slam.robust.map import apply_merge
from slam.robust.state import (
    PastPose,
    State,
    SymmetricMatrix,
    calibrated_motion,
    predict,
    quarter_turn,
)

WHEELS = WheelNoise()
ANTENNAS = antennas_of(paper_rig(), (), np.zeros(3))
SIGMA_M = 0.01
few = settings(max_examples=settings().max_examples // 3)


def surrounded(seed: int, n: int) -> State:
    """Return a state with everything unknown, and landmarks 0.5 to 2 m off the robot."""
    rng = np.random.default_rng(seed)
    state = random_state(seed, n, float(rng.uniform(-math.pi, math.pi)))
    direction, away = rng.uniform(-math.pi, math.pi, n), rng.uniform(0.5, 2.0, n)
    spread = np.column_stack([np.cos(direction), np.sin(direction)])
    state.landmarks_m = state.position_m + away[:, None] * spread
    return state


def rows_for(state: State, radars: list[int], landmarks: list[int]) -> Rows:
    return rows_of(state, view(state, ANTENNAS), np.array(radars), np.array(landmarks))


def dense(rows: Rows, size: int) -> Array:
    H = np.zeros((len(rows.H), size))
    H[:, rows.at] = rows.H
    return H


def see(state: State, radar: int, landmark: int, range_m: float, sigma_m: float = SIGMA_M) -> float:
    rows = rows_for(state, [radar], [landmark])
    residual = np.array([range_m]) - rows.predicted_m
    return state.update(rows.at, rows.H, residual, np.array([sigma_m**2]))


def foreseen(state: State, radar: int, landmark: int) -> float:
    return float(rows_for(state, [radar], [landmark]).predicted_m[0])


def go(state: State, increment: Array) -> None:
    predict(state, calibrated_motion(increment, state.calibration, WHEELS), WHEELS)


def apart(one: State, other: State) -> float:
    """Return the largest difference of two means, headings modulo one turn."""
    a, b = values(one), values(other)
    return max(turn_between(a[0], b[0]), float(np.abs(a[1:] - b[1:]).max()))


# --- updates --------------------------------------------------------------------------------------


@few
@given(seeds)
def test_update_is_joseph_s_and_the_information_form(seed: int) -> None:
    state = surrounded(seed, 4)
    rows = rows_for(state, [0, 1, 2, 3], [0, 0, 1, 3])
    rng = np.random.default_rng(seed)
    residual, variances = 0.02 * rng.standard_normal(4), rng.uniform(1e-5, 1e-3, 4)
    P, H, R = state.P.full(), dense(rows, state.P.size), np.diag(variances)
    S = H @ P @ H.T + R
    K = P @ H.T @ np.linalg.inv(S)
    rest = np.eye(len(P)) - K @ H
    wanted = deepcopy(state)
    wanted.correct(K @ residual)
    nis = state.update(rows.at, rows.H, residual, variances)
    after = state.P.full()
    assert relative_error(after, rest @ P @ rest.T + K @ R @ K.T) <= 1e-9
    assert (
        relative_error(after, np.linalg.inv(np.linalg.inv(P) + H.T @ (H.T / variances).T)) <= 1e-8
    )
    # One triangle in place, or two full matrices multiplied.
    assert relative_error(after, P - K @ S @ K.T) <= 1e-10
    assert apart(state, wanted) <= 1e-10
    assert nis == pytest.approx(residual @ np.linalg.solve(S, residual), rel=1e-9)


@settings(max_examples=settings().max_examples // 10)
@given(seeds, st.integers(20, 40))
def test_no_landmark_becomes_surer_than_the_start(seed: int, n_steps: int) -> None:
    """Dissanayake 2001: what is doubtful about the frame at the start stays in every landmark."""
    rng = np.random.default_rng(seed)
    state = State((0.02, 0.02, 0.01), (0.0,) * N_RADARS)
    start = np.diag([0.05**2, 0.02**2, 0.03**2])
    P = state.P.full()
    P[:3, :3] = start
    state.P = SymmetricMatrix(P)
    truth = np.array([1.0, 0.5])
    point = BodyPoint(point_m=truth, covariance=1e-4 * np.eye(2), by_offsets=np.zeros((2, 4)))
    initialise_landmark(state, point)
    for _ in range(n_steps):
        radar = int(rng.integers(N_RADARS))
        see(state, radar, 0, foreseen(state, radar, 0) + 0.01 * rng.normal())
        if rng.random() < 0.5:
            go(state, np.array([0.01, 0.0, 0.05 * rng.normal()]))
        G = np.column_stack([quarter_turn(state.landmarks_m[0]), np.eye(2)])
        surer = np.linalg.eigvalsh(landmark_covariance(state, 0) - G @ start @ G.T)[0]
        assert surer >= -1e-12


@few
@given(seeds)
def test_observation_without_information_changes_nothing(seed: int) -> None:
    state = surrounded(seed, 2)
    before = deepcopy(state)
    see(state, 1, 0, foreseen(state, 1, 0) + 0.1, sigma_m=1e8)
    assert apart(state, before) <= 1e-9
    assert relative_error(state.P.full(), before.P.full()) <= 1e-9


@few
@given(seeds, st.integers(1, 15))
def test_repeating_an_exact_range_equals_one_of_smaller_noise(seed: int, k: int) -> None:
    once, many = surrounded(seed, 2), surrounded(seed, 2)
    range_m = foreseen(once, 2, 1)
    see(once, 2, 1, range_m, SIGMA_M / math.sqrt(k))
    for _ in range(k):
        see(many, 2, 1, range_m)
    assert apart(once, many) <= 1e-9
    assert relative_error(many.P.full(), once.P.full()) <= 1e-9


@few
@given(seeds)
def test_order_of_independent_ranges_does_not_matter_to_first_order(seed: int) -> None:
    state = surrounded(seed, 2)
    surprise = np.random.default_rng(seed).uniform(-1, 1, 2)
    expected = [foreseen(state, 0, 0), foreseen(state, 3, 1)]

    def difference(size_m: float) -> float:
        one, two = deepcopy(state), deepcopy(state)
        z = np.array(expected) + size_m * surprise
        see(one, 0, 0, z[0])
        see(one, 3, 1, z[1])
        see(two, 3, 1, z[1])
        see(two, 0, 0, z[0])
        if size_m == 0.0:
            assert relative_error(one.P.full(), two.P.full()) <= 1e-9
        return apart(one, two)

    assert difference(0.0) <= 1e-12  # the linear case
    # The difference is of second order: a tenth of the surprise leaves a hundredth of it.
    assert difference(1e-4) <= 0.02 * difference(1e-3) + 1e-13


@few
@given(seeds)
def test_landmark_without_correlation_is_not_touched(seed: int) -> None:
    state = surrounded(seed, 3)
    P, far = state.P.full(), state.landmark_columns(np.array([2]))
    # The heading is sure too: its correction turns the whole map.
    for sure in (np.array([0]), far):
        P[sure, :] = 0.0
        P[:, sure] = 0.0
    P[far, far] = 1.0
    state.P = SymmetricMatrix(P)
    place, others = state.landmarks_m[2].copy(), state.landmarks_m[:2].copy()
    see(state, 0, 0, foreseen(state, 0, 0) + 0.05)
    see(state, 1, 1, foreseen(state, 1, 1) - 0.05)
    assert np.array_equal(state.landmarks_m[2], place)
    assert np.array_equal(state.P.full()[far], P[far])
    assert (state.landmarks_m[:2] != others).all()


# --- past poses -----------------------------------------------------------------------------------


def held(state: State, before: PastPose) -> None:
    """Assert that the oldest past pose is what it was."""
    after = state.past_pose(0)
    assert after.number == before.number
    assert np.abs(after.pose[:2] - before.pose[:2]).max() <= 1e-12
    assert turn_between(after.pose[2], before.pose[2]) <= 1e-12
    assert relative_error(after.covariance, before.covariance) <= 1e-9


@few
@given(seeds, increments)
def test_where_the_robot_was_stays_until_something_is_measured(seed: int, increment: Array) -> None:
    """Its additive error is that of the pose at that time, whatever the robot and the map do."""
    state = surrounded(seed, 2)
    state.keep_pose(7)
    was = PastPose(number=7, pose=state.pose, covariance=state.pose_covariance())
    held(state, was)
    for _ in range(3):
        go(state, increment)
    state.keep_pose(10)
    point = BodyPoint(
        point_m=np.array([0.4, 0.9]), covariance=1e-4 * np.eye(2), by_offsets=np.zeros((2, 4))
    )
    initialise_landmark(state, point)
    state.augment_wall(np.array([0.2, 1.4]), np.zeros((state.P.size, 2)), 0.01 * np.eye(2))
    initialise_landmark(state, point)
    held(state, was)
    state.remove(1)
    held(state, was)
    state.marginalise_past(slice(1))
    newer = state.past_pose(0)
    assert newer.number == 10
    assert np.abs(newer.pose - state.pose)[:2].max() <= 1e-12
    assert relative_error(newer.covariance, state.pose_covariance()) <= 1e-9


@few
@given(seeds, increments)
def test_past_poses_change_nothing_else(seed: int, increment: Array) -> None:
    with_past, without = surrounded(seed, 3), surrounded(seed, 3)
    point = BodyPoint(
        point_m=np.array([0.4, 0.9]), covariance=1e-4 * np.eye(2), by_offsets=np.zeros((2, 4))
    )
    for number, state in enumerate([with_past, without]):
        for step in range(4):
            if number == 0:
                state.keep_pose(step)
            go(state, increment)
            see(state, step, step % 3, foreseen(state, step, step % 3) + 0.01)
        initialise_landmark(state, point)
        state.augment_wall(np.array([0.2, 1.4]), np.zeros((state.P.size, 2)), 0.01 * np.eye(2))
        see(state, 2, 1, foreseen(state, 2, 1) - 0.01)
    m = without.P.size
    assert with_past.P.size == m + 12
    assert apart(with_past, without) <= 1e-10
    assert relative_error(with_past.P.full()[:m, :m], without.P.full()) <= 1e-9


@few
@given(seeds, increments)
def test_a_motion_that_is_known_exactly_leads_from_the_past_pose_to_the_present_one(
    seed: int, increment: Array
) -> None:
    """Whatever is measured then, to first order: both are corrected as one rigid body."""
    state = surrounded(seed, 3)
    P, calibration = state.P.full(), np.arange(3, 6)
    P[calibration], P[:, calibration] = 0.0, 0.0
    state.P = SymmetricMatrix(P)
    state.keep_pose(0)
    motion = calibrated_motion(increment, state.calibration, WHEELS, np.zeros((3, 3)))
    predict(state, motion, replace(WHEELS, walk_per_sqrt_m=0.0))
    for radar, landmark in [(0, 0), (3, 1), (1, 2)]:
        see(state, radar, landmark, foreseen(state, radar, landmark) + 1e-4)
    step = np.append(motion.step_m, motion.turn_rad)
    expected = compose(state.past_pose(0).pose, step)
    assert np.abs(expected - state.pose)[:2].max() <= 1e-7
    assert turn_between(expected[2], state.heading_rad) <= 1e-7


# --- frames and names -----------------------------------------------------------------------------


@few
@given(seeds, st.floats(-4, 4), st.floats(-4, 4), st.floats(-math.pi, math.pi))
def test_moving_the_world_moves_the_estimate_and_keeps_the_innovations(
    seed: int, x: float, y: float, angle: float
) -> None:
    """A world turned by R and moved by t has errors e_p' = R e_p - J t e_th, exactly."""
    R, t = turn(angle).real, np.array([x, y])

    def moved(state: State) -> State:
        A = np.eye(state.P.size)
        for first in (1, *range(state.layout.offsets.stop, state.P.size, 2)):
            A[first : first + 2, first : first + 2] = R
            A[first : first + 2, 0] = -quarter_turn(t)
        there = deepcopy(state)
        there.heading_rad = math.remainder(state.heading_rad + angle, math.tau)
        there.position_m = R @ state.position_m + t
        there.landmarks_m = state.landmarks_m @ R.T + t
        there.P = SymmetricMatrix(A @ state.P.full() @ A.T)
        return there

    rng = np.random.default_rng(seed)
    here = surrounded(seed, 3)
    there = moved(here)
    for _ in range(5):
        increment = rng.uniform(-0.1, 0.1, 3)
        go(here, increment)
        go(there, increment)
        radar, landmark = int(rng.integers(N_RADARS)), int(rng.integers(3))
        z = foreseen(here, radar, landmark) + 0.02 * rng.normal()
        ours, theirs = see(here, radar, landmark, z), see(there, radar, landmark, z)
        assert theirs == pytest.approx(ours, rel=1e-9, abs=1e-9)
    assert apart(there, moved(here)) <= 1e-9
    assert relative_error(there.P.full(), moved(here).P.full()) <= 1e-9


@few
@given(seeds, st.permutations(range(4)))
def test_other_names_permute_the_state_and_nothing_else(seed: int, order: list[int]) -> None:
    def renamed(state: State) -> State:
        other = deepcopy(state)
        other.landmarks_m = state.landmarks_m[order]
        at = np.concatenate(
            [np.arange(state.layout.offsets.stop), state.landmark_columns(np.array(order))]
        )
        other.P = SymmetricMatrix(state.P.full()[np.ix_(at, at)])
        return other

    rng = np.random.default_rng(seed)
    here = surrounded(seed, 4)
    there = renamed(here)
    for _ in range(3):
        increment = rng.uniform(-0.1, 0.1, 3)
        go(here, increment)
        go(there, increment)
        radar, landmark = int(rng.integers(N_RADARS)), int(rng.integers(4))
        z = foreseen(here, radar, landmark) + 0.02 * rng.normal()
        ours = see(here, radar, landmark, z)
        assert see(there, radar, order.index(landmark), z) == pytest.approx(ours, rel=1e-9)
    assert apart(there, renamed(here)) <= 1e-12
    assert relative_error(there.P.full(), renamed(here).P.full()) <= 1e-12


# --- merging --------------------------------------------------------------------------------------


@few
@given(seeds, st.integers(1, 3))
def test_merging_exact_copies_changes_nothing(seed: int, n_copies: int) -> None:
    """What is one already is not made surer by saying so again."""
    state = surrounded(seed, 3)
    state.landmarks_m[2] = state.landmarks_m[0] + 0.01
    apply_merge(state, ((0, 2),), 1e-5)
    before = deepcopy(state)
    for _ in range(n_copies):
        own = state.landmark_columns(np.array([0]))
        state.augment(state.landmarks_m[0], state.P.columns(own), state.P.block(own))
        apply_merge(state, ((0, len(state.landmark_ids) - 1),), 1e-5)
    assert apart(state, before) <= 1e-9
    assert relative_error(state.P.full(), before.P.full()) <= 1e-9
    assert state.landmark_ids == before.landmark_ids

"""Every derivative of the robust back end against complex steps on formulas written again."""

import math
from copy import deepcopy

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hil_tests.property.ekf_oracles import complex_step
from hil_tests.property.examples import examples
from hil_tests.property.robust_oracles import (
    N_RADARS,
    Array,
    Complex,
    body_point,
    increments,
    minus,
    moved,
    near_a_half_turn,
    plus,
    random_state,
    range_to,
    rows_of,
    seeds,
    turn,
    values,
)
from slam.config import WheelNoise
from slam.geometry import paper_rig
from slam.robust.association import RangeScan, antennas_of, point_view, view
from slam.robust.initialisation import (
    BodyPoint,
    initialise_landmark,
    point_rows,
    update_with_point,
)
from slam.robust.solver.run_log import Estimate, Problem
from slam.robust.solver.smoother import measurement_residuals, motion_residuals
from slam.robust.state import Layout, calibrated_motion, left_jacobian, predict, rotation

WHEELS = WheelNoise(walk_per_sqrt_m=0.0)
few = settings(max_examples=examples(40), deadline=None)


@few
@given(seeds, near_a_half_turn(), increments)
@example(0, math.pi, np.array([0.01, 0.0, 0.0]))
@example(1, -math.pi, np.array([-0.05, 0.02, 0.3]))
def test_prediction_is_the_derivative_of_the_motion(
    seed: int, heading: float, increment: Array
) -> None:
    state = random_state(seed, 3, heading)
    before = deepcopy(state)
    rng = np.random.default_rng(seed)
    root = 0.01 * rng.standard_normal((3, 3))
    motion = calibrated_motion(increment, state.calibration, WHEELS, root @ root.T)
    predict(state, motion, WHEELS)

    mean = values(before).astype(np.complex128)
    nothing: Complex = np.zeros(3, dtype=np.complex128)
    ahead = moved(mean, increment, nothing)
    size = len(mean)
    F = complex_step(
        lambda e: minus(moved(plus(mean, e), increment, nothing), ahead), np.zeros(size)
    )
    G = complex_step(lambda n: minus(moved(mean, increment, n), ahead), np.zeros(3))
    wanted = F @ before.P.full() @ F.T + G @ root @ root.T @ G.T
    assert np.abs(state.P.full() - wanted).max() <= 1e-10 * max(1.0, np.abs(wanted).max())
    assert np.abs(values(state)[1:] - ahead.real[1:]).max() <= 1e-12
    assert abs(math.remainder(state.heading_rad - float(ahead[0].real), math.tau)) <= 1e-12


@few
@given(seeds, near_a_half_turn(), st.floats(-1.0, 1.0))
def test_range_rows_are_derivatives_by_the_invariant_error(
    seed: int, heading: float, share: float
) -> None:
    state = random_state(seed, 3, heading)
    moved_on = (0.05 * share, 0.01 * share, 0.3 * share)
    scans = [RangeScan(radar=radar, ranges_m=(), moved=moved_on) for radar in range(N_RADARS)]
    antennas = antennas_of(paper_rig(), scans, state.calibration)
    radars = np.repeat(np.arange(N_RADARS), 3)
    landmarks = np.tile(np.arange(3), N_RADARS)
    rows = rows_of(state, view(state, antennas), radars, landmarks)
    mean = values(state).astype(np.complex128)
    for i, (radar, landmark) in enumerate(zip(radars.tolist(), landmarks.tolist(), strict=True)):
        antenna = antennas.position_m[radar]

        def predicted(e: Complex, k: int = landmark, r: int = radar, m: Array = antenna) -> Complex:
            return np.array([range_to(plus(mean, e), k, r, m)])

        wanted = complex_step(predicted, np.zeros(len(mean)))[0]
        full = np.zeros(len(mean))
        full[rows.at] = rows.H[i]
        assert np.abs(full - wanted).max() <= 1e-10
        assert full[0] == 0.0
        assert rows.predicted_m[i] == pytest.approx(
            range_to(mean, landmark, radar, antenna).real, abs=1e-12
        )


@few
@given(seeds, near_a_half_turn())
def test_point_rows_are_derivatives(seed: int, heading: float) -> None:
    state = random_state(seed, 2, heading)
    rng = np.random.default_rng(seed)
    point = BodyPoint(
        point_m=rng.uniform(-1, 1, 2),
        covariance=1e-4 * np.eye(2),
        by_offsets=rng.standard_normal((2, N_RADARS)),
    )
    rows = point_rows(state, 1, point)
    mean = values(state).astype(np.complex128)
    wanted = complex_step(lambda e: body_point(plus(mean, e), 1), np.zeros(len(mean)))
    full = np.zeros((2, len(mean)))
    full[:, rows.at] = rows.H
    full[:, state.layout.offsets] += point.by_offsets
    assert np.abs(full - wanted).max() <= 1e-10
    assert rows.residual == pytest.approx(point.point_m - body_point(mean, 1).real, abs=1e-12)


@few
@given(seeds, near_a_half_turn(), st.integers(0, N_RADARS - 1))
def test_range_and_bearing_rows_are_derivatives(seed: int, heading: float, radar: int) -> None:
    state = random_state(seed, 2, heading)
    antennas = antennas_of(paper_rig(), (), np.zeros(3))
    found = point_view(state, view(state, antennas), radar, np.array([1, 0]))
    mean, mount = values(state).astype(np.complex128), paper_rig().mounts[radar]
    for place, landmark in enumerate((1, 0)):

        def measured(e: Complex, landmark: int = landmark) -> Complex:
            b = body_point(plus(mean, e), landmark) - antennas.position_m[radar]
            # arctan2 of complex numbers, up to a half turn
            angle = np.arctan(b[1] / b[0]) - mount.yaw_rad
            offset = plus(mean, e)[state.layout.offsets][radar]
            return np.array([np.sqrt(b @ b) + offset, angle])

        wanted = complex_step(measured, np.zeros(len(mean)))
        full = np.zeros((2, len(mean)))
        full[:, found.at] = found.H[place]
        assert np.abs(full - wanted).max() <= 1e-10 * max(1.0, np.abs(wanted).max())
        range_m, angle = measured(np.zeros(len(mean), dtype=np.complex128)).real.tolist()
        assert found.predicted[place, 0] == pytest.approx(range_m, abs=1e-12)
        apart = math.remainder(float(found.predicted[place, 1]) - angle, math.pi)
        assert apart == pytest.approx(0.0, abs=1e-9)
        assert -math.pi <= found.predicted[place, 1] < math.pi


@few
@given(seeds, near_a_half_turn())
def test_a_new_landmark_is_correlated_as_its_formula_says(seed: int, heading: float) -> None:
    state = random_state(seed, 1, heading)
    before = deepcopy(state)
    rng = np.random.default_rng(seed)
    b, D = rng.uniform(-1, 1, 2), rng.standard_normal((2, N_RADARS))
    C = 1e-4 * np.diag([1.0, 2.0])
    point = BodyPoint(point_m=b, covariance=C, by_offsets=D)
    initialise_landmark(state, point)
    mean = values(before).astype(np.complex128)
    born = mean[1:3] + turn(mean[0]) @ b

    def error(inputs: Complex) -> Complex:
        e, n = inputs[: len(mean)], inputs[len(mean) :]
        x = plus(mean, e)
        point = b + D @ e[6 : 6 + N_RADARS] + n
        place = x[1:3] + turn(x[0]) @ point
        away = place - turn(e[0]) @ born
        return np.concatenate([e, np.linalg.solve(np.eye(2) + 0 * turn(e[0]), away)])

    # V(e_th) is the identity to first order, and the error it acts on is zero here.
    G = complex_step(error, np.zeros(len(mean) + 2))
    inputs = np.zeros((len(mean) + 2, len(mean) + 2))
    inputs[: len(mean), : len(mean)] = before.P.full()
    inputs[len(mean) :, len(mean) :] = C
    assert np.abs(state.P.full() - G @ inputs @ G.T).max() <= 1e-10
    assert state.landmarks_m[-1] == pytest.approx(born.real, abs=1e-12)
    # Seen again without noise, it has no innovation.
    assert update_with_point(state, 1, point) <= 1e-20


@few
@given(seeds, st.floats(-3.0, 3.0))
@example(0, 2.64e-8)  # 1 - cos a has lost half its digits
def test_corrections_are_the_exact_formulas(seed: int, angle: float) -> None:
    state = random_state(seed, 3, 2.0)
    error = 0.1 * np.random.default_rng(seed).standard_normal(state.P.size)
    error[0] = angle
    wanted = plus(values(state).astype(np.complex128), error.astype(np.complex128)).real
    state.correct(error)
    assert np.abs(values(state)[1:] - wanted[1:]).max() <= 1e-12
    assert abs(math.remainder(state.heading_rad - wanted[0], math.tau)) <= 1e-12


@pytest.mark.parametrize("angle", [0.0, 1e-9, 9.99e-5, 1.01e-4, -0.5, 3.1])
def test_left_jacobian_is_the_mean_of_rotations(angle: float) -> None:
    # V(a) = integral of Rot(t a) over t in [0, 1], here by Gauss-Legendre of 20 nodes.
    nodes, weights = np.polynomial.legendre.leggauss(20)
    mean = sum(
        0.5 * weight * rotation(0.5 * (node + 1.0) * angle)
        for node, weight in zip(nodes.tolist(), weights.tolist(), strict=True)
    )
    assert np.abs(left_jacobian(angle) - mean).max() <= 1e-14


def small_problem(seed: int) -> tuple[Problem, Estimate]:
    rng = np.random.default_rng(seed)
    problem = Problem(
        layout=Layout(N_RADARS, 2),
        prior_mean=np.zeros(6 + N_RADARS + 4),
        prior_sigmas=np.ones(6 + N_RADARS + 4),
        steps=0.3 * rng.standard_normal((4, 3)),
        step_covariances=np.tile(np.diag([1e-4, 2e-4, 3e-4]), (4, 1, 1)),
        walks=np.zeros((4, 3)),
        keys=np.arange(5),
        range_poses=np.array([1, 2, 4, 4]),
        range_radars=np.array([0, 3, 1, 2]),
        range_landmarks=np.array([0, 1, 0, 1]),
        range_antennas=rng.uniform(-0.2, 0.2, (4, 2)),
        range_turns=0.3 * rng.standard_normal(4),
        ranges_m=rng.uniform(0.5, 1.5, 4),
        range_sigmas_m=np.full(4, 0.01),
        range_bearings_rad=np.array([np.nan, 0.2, np.nan, -0.4]),
        range_bearing_sigmas_rad=np.array([np.nan, 0.03, np.nan, 0.05]),
    )
    estimate = Estimate(
        poses=rng.uniform(-2, 2, (5, 3)),
        calibration=0.02 * rng.standard_normal((1, 3)),
        fixed=np.concatenate([0.01 * rng.standard_normal(N_RADARS), rng.uniform(2, 4, 4)]),
    )
    return problem, estimate


@few
@given(seeds)
def test_derivatives_of_the_smoother_are_those_of_its_residuals(seed: int) -> None:
    problem, estimate = small_problem(seed)
    roots = np.linalg.inv(np.linalg.cholesky(problem.step_covariances))
    steps = motion_residuals(problem, estimate).whitened(roots)
    landmarks_m = estimate.fixed[N_RADARS:].reshape(-1, 2)
    for k in range(4):

        def step(x: Complex, k: int = k) -> Complex:
            before, after, (s, w, kappa) = x[:3], x[3:6], x[6:]
            d = problem.steps[k, :2] / (1 + s)
            a = (problem.steps[k, 2] - kappa * np.sqrt(d @ d)) / (1 + w)
            gone = turn(before[2]).T @ (after[:2] - before[:2])
            result: Complex = roots[k] @ np.concatenate([gone - d, [after[2] - before[2] - a]])
            return result

        x = np.concatenate([estimate.poses[k], estimate.poses[k + 1], estimate.calibration[0]])
        wanted = complex_step(step, x)
        found = np.hstack([steps.by_before[k], steps.by_after[k], steps.by_calibration[k]])
        assert np.abs(found - wanted).max() <= 1e-10 * np.abs(wanted).max()

    rows = measurement_residuals(problem, estimate)
    for i in range(4):

        def white_range(x: Complex, i: int = i) -> Complex:
            away = x[3:5] - x[:2] - turn(x[2]) @ problem.range_antennas[i]
            return np.array([(np.sqrt(away @ away) + x[5] - problem.ranges_m[i]) / 0.01])

        x = np.concatenate(
            [
                estimate.poses[problem.range_poses[i]],
                landmarks_m[problem.range_landmarks[i]],
                [estimate.fixed[problem.range_radars[i]]],
            ]
        )
        wanted = complex_step(white_range, x)[0]
        own = rows.by_border[i]
        found = np.concatenate([rows.by_pose[i], own[1:3], own[:1]])
        assert np.abs(found - wanted).max() <= 1e-10 * np.abs(wanted).max()
        assert rows.residual[i] == pytest.approx(white_range(x.astype(complex))[0].real, abs=1e-9)
    for number, i in enumerate((1, 3)):

        def white_bearing(x: Complex, i: int = i) -> Complex:
            away = x[3:5] - x[:2] - turn(x[2]) @ problem.range_antennas[i]
            angle = np.arctan(away[1] / away[0]) - x[2]
            return np.array([angle / problem.range_bearing_sigmas_rad[i]])

        x = np.concatenate(
            [
                estimate.poses[problem.range_poses[i]],
                landmarks_m[problem.range_landmarks[i]],
            ]
        )
        wanted = complex_step(white_bearing, x)[0]
        own = rows.by_border[4 + number]
        found = np.concatenate([rows.by_pose[4 + number], own[1:3]])
        assert own[0] == 0.0
        assert np.abs(found - wanted).max() <= 1e-9 * np.abs(wanted).max()

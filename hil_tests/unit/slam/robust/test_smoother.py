"""The smoother's prior: poses that are forgotten leave behind what they told, once."""

import math
import pickle
import tracemalloc
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import fields, replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import chdtri

from hil_tests.property.ekf_oracles import complex_step
from hil_tests.unit.slam.robust.range_world import LAB, parameters_for, simulate, step_of
from hil_tests.unit.slam.robust.test_roundness import RODS, SIGMA_M, drive
from slam.config import WheelNoise
from slam.geometry import paper_rig
from slam.robust.association import RangeScan
from slam.robust.back_end import RobustBackEnd
from slam.robust.initialisation import BodyPoint, RangeBearing, initialise_landmark
from slam.robust.parameters import RelinearisationRule
from slam.robust.run_log import Condensed, Estimate, Prior, Problem, RunLog, start_prior
from slam.robust.smoother import (
    Smoother,
    is_determined,
    prior_cost,
    prior_terms,
    relinearise,
)
from slam.robust.state import State, calibrated_motion, predict

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

N_RADARS, N_MARKS, N_STEPS, N_GONE = 4, 3, 12, 7
ANTENNAS = np.array([[-0.1, 0.2], [0.1, 0.2], [0.1, -0.2], [-0.1, -0.2]])
RULE = RelinearisationRule(iterations=40, outliers_from=2, outlier_sigmas=50.0)


def short_run(seed: int, walk: float) -> tuple[Problem, Estimate]:
    """Return a short run past three landmarks, and values near the truth."""
    rng = np.random.default_rng(seed)
    k = N_STEPS
    marks = np.array([[0.3, 1.0], [0.9, -0.9], [1.4, 1.2]])
    poses = np.array([[0.12 * i, 0.02 * i, 0.05 * i] for i in range(k + 1)])
    at = np.repeat(np.arange(k + 1), 6)
    radars, seen = np.tile([0, 1, 2, 3, 0, 1], k + 1), np.tile([0, 0, 1, 1, 2, 2], k + 1)
    c, s = np.cos(poses[at, 2]), np.sin(poses[at, 2])
    m = ANTENNAS[radars]
    arm = np.column_stack([c * m[:, 0] - s * m[:, 1], s * m[:, 0] + c * m[:, 1]])
    z = np.linalg.norm(marks[seen] - poses[at, :2] - arm, axis=1)
    problem = Problem(
        increments=np.tile([0.121, 0.0, 0.05], (k, 1)) + 1e-3 * rng.standard_normal((k, 3)),
        covariances=np.tile(np.diag([1e-4, 1e-5, 1e-4]), (k, 1, 1)),
        walks=np.full((k, 3), walk),
        prior=start_prior((0.02, 0.02, 0.01), (0.005,) * N_RADARS, N_MARKS, pose_sigma=1e-2),
        range_poses=at,
        range_radars=radars,
        range_landmarks=seen,
        range_antennas=m,
        ranges_m=z + 2e-3 * rng.standard_normal(len(z)),
        range_sigmas_m=np.full(len(z), 5e-3),
        point_poses=np.array([2, 9], dtype=np.intp),
        point_landmarks=np.array([0, 2], dtype=np.intp),
        points=np.array([[0.95, 1.2], [1.1, 0.7]]),
        point_roots=np.tile(np.diag([50.0, 20.0]), (2, 1, 1)),
    )
    start = Estimate(
        poses=poses + 0.02 * rng.standard_normal(poses.shape),
        calibration=0.01 * rng.standard_normal((k + 1 if walk else 1, 3)),
        offsets_m=0.005 * rng.standard_normal(N_RADARS),
        landmarks_m=marks + 0.05 * rng.standard_normal((N_MARKS, 2)),
    )
    return problem, start


def rest_of(problem: Problem, prior: Prior, gone: int) -> Problem:
    """Return what is left of a problem once the poses before ``gone`` are a prior."""
    ranges, points = problem.range_poses >= gone, problem.point_poses >= gone
    return replace(
        problem,
        increments=problem.increments[gone:],
        covariances=problem.covariances[gone:],
        walks=problem.walks[gone:],
        prior=prior,
        range_poses=problem.range_poses[ranges] - gone,
        range_radars=problem.range_radars[ranges],
        range_landmarks=problem.range_landmarks[ranges],
        range_antennas=problem.range_antennas[ranges],
        ranges_m=problem.ranges_m[ranges],
        range_sigmas_m=problem.range_sigmas_m[ranges],
        point_poses=problem.point_poses[points] - gone,
        point_landmarks=problem.point_landmarks[points],
        points=problem.points[points],
        point_roots=problem.point_roots[points],
    )


def rest_of_values(estimate: Estimate, gone: int) -> Estimate:
    calibration = estimate.calibration
    return replace(
        estimate,
        poses=estimate.poses[gone:],
        calibration=calibration[gone:] if len(calibration) > 1 else calibration,
    )


def packed(estimate: Estimate) -> Array:
    parts = (
        estimate.poses,
        estimate.calibration,
        estimate.offsets_m,
        estimate.landmarks_m,
    )
    return np.concatenate([part.ravel() for part in parts])


def white_residuals(problem: Problem, n_steps: int, end: int, n_cal: int, x: Complex) -> Complex:
    """Return the white residuals of prior, steps, and measurements of the poses before ``end``."""
    n_poses = n_steps + 1
    poses, rest = x[: 3 * n_poses].reshape(-1, 3), x[3 * n_poses :]
    calibration, rest = rest[: 3 * n_cal].reshape(-1, 3), rest[3 * n_cal :]
    offsets, marks = rest[:N_RADARS], rest[N_RADARS:].reshape(-1, 2)
    first = invariant_errors(
        problem.prior.mean[: 6 + N_RADARS], np.concatenate([poses[0], calibration[0], offsets])
    )
    result: list[Complex] = [first * np.sqrt(np.diag(problem.prior.information)[: len(first)])]
    for k in range(n_steps):
        s, w, kappa = calibration[k if n_cal > 1 else 0]
        d = problem.increments[k, :2] / (1 + s)
        a = (problem.increments[k, 2] - kappa * np.sqrt(d @ d)) / (1 + w)
        c, sn = np.cos(poses[k, 2]), np.sin(poses[k, 2])
        way = np.array([[c, sn], [-sn, c]]) @ (poses[k + 1, :2] - poses[k, :2]) - d
        turned = poses[k + 1, 2] - poses[k, 2] - a
        step = np.append(way, turned).astype(np.complex128)
        result.append(step / np.sqrt(np.diag(problem.covariances[k])))
        if n_cal > 1:
            result.append((calibration[k + 1] - calibration[k]) / np.sqrt(problem.walks[k]))
    for k, radar, mark, m, z, sigma in zip(
        problem.range_poses,
        problem.range_radars,
        problem.range_landmarks,
        problem.range_antennas,
        problem.ranges_m,
        problem.range_sigmas_m,
        strict=True,
    ):
        if k < end:
            c, sn = np.cos(poses[k, 2]), np.sin(poses[k, 2])
            away = marks[mark] - poses[k, :2] - np.array([[c, -sn], [sn, c]]) @ m
            miss = np.sqrt(away @ away) + offsets[radar] - z
            result.append(np.atleast_1d(miss / sigma))
    for k, mark, point, root in zip(
        problem.point_poses,
        problem.point_landmarks,
        problem.points,
        problem.point_roots,
        strict=True,
    ):
        if k < end:
            away = marks[mark] - poses[k, :2]
            c, sn = np.cos(poses[k, 2]), np.sin(poses[k, 2])
            along, across = c * away[0] + sn * away[1], -sn * away[0] + c * away[1]
            # atan of a ratio: complex steps do not pass arctan2; the point lies ahead and left.
            bearing = math.pi / 2 - np.arctan(along / across)
            result.append(root @ (np.array([np.sqrt(away @ away), bearing]) - point))
    return np.concatenate(result)


def invariant_errors(mean: Array, x: Complex) -> Complex:
    """Return the errors a prior is quadratic in: heading turned back, everything with it."""
    a = x[2] - mean[2]
    back = np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]])
    e = x - mean
    e[:2] = back @ x[:2] - mean[:2]
    for first in range(6 + N_RADARS, len(x), 2):
        e[first : first + 2] = back @ x[first : first + 2] - mean[first : first + 2]
    return e


def newest(n_poses: int, n_cal: int, size: int) -> NDArray[np.intp]:
    """Return the rows of the last pose and calibration, the offsets and the landmarks."""
    return np.concatenate(
        [
            np.arange(3 * n_poses - 3, 3 * n_poses),
            3 * n_poses + np.arange(3 * n_cal - 3, 3 * n_cal),
            np.arange(3 * n_poses + 3 * n_cal, size),
        ]
    )


@pytest.mark.parametrize("walk", [0.0, 1e-5])
def test_the_smoother_is_least_squares_and_its_complement_the_marginal(walk: float) -> None:
    problem, start = short_run(1, walk)
    solution = Smoother(problem, RULE).solve(start, tolerance=1e-14)
    assert solution is not None
    n_cal = len(start.calibration)

    def residuals(y: Complex) -> Complex:
        return white_residuals(problem, N_STEPS, N_STEPS + 1, n_cal, y)

    def real(x: Array) -> Array:
        return residuals(x.astype(np.complex128)).real

    oracle = least_squares(real, packed(start), xtol=1e-15, ftol=1e-15, gtol=1e-12, x_scale="jac")
    assert np.abs(packed(solution.estimate) - oracle.x).max() <= 1e-6
    J = complex_step(residuals, oracle.x)
    keep = newest(N_STEPS + 1, n_cal, len(oracle.x))
    wanted = np.linalg.inv(J.T @ J)[np.ix_(keep, keep)]
    marginal = np.linalg.inv(solution.information)
    assert np.abs(marginal - wanted).max() <= 1e-4 * np.abs(wanted).max()


@pytest.mark.parametrize("walk", [0.0, 1e-5])
def test_covariances_of_all_poses_are_blocks_of_the_dense_inverse(walk: float) -> None:
    problem, start = short_run(3, walk)
    solution = Smoother(problem, RULE).solve(start, tolerance=1e-14)
    assert solution is not None
    n_cal, n_poses = len(start.calibration), N_STEPS + 1
    J = complex_step(
        lambda y: white_residuals(problem, N_STEPS, n_poses, n_cal, y), packed(solution.estimate)
    )
    dense = np.linalg.inv(J.T @ J)
    of_poses, of_border = Smoother(problem, RULE).covariances(solution.estimate)
    wanted = [dense[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(n_poses)]
    assert of_poses.shape == (n_poses, 3, 3)
    assert np.abs(of_poses - wanted).max() <= 1e-8 * np.abs(wanted).max()
    keep = newest(n_poses, n_cal, len(dense))
    assert np.abs(of_border - dense[np.ix_(keep, keep)]).max() <= 1e-8 * np.abs(dense).max()


def test_the_smoothed_run_is_asked_for_without_a_trace_and_nearer_to_the_truth() -> None:
    run = simulate(LAB, 5, 4e-3, laps=2, labelled=True)
    asked, silent = (RobustBackEnd(paper_rig(), parameters_for(LAB, 4e-3)) for _ in range(2))
    n_states = 500
    stamps_ns = 200_000_000 * np.arange(1, n_states + 1)
    for back_end in (asked, silent):
        for k, (increment, scans) in enumerate(
            zip(run.increments[:n_states], run.scans[:n_states], strict=True)
        ):
            back_end.predict(increment)
            back_end.update(scans)
            if back_end is asked and k in {200, 400}:
                back_end.smoothed(stamps_ns[: k + 1])
    assert np.array_equal(asked.pose, silent.pose)
    assert np.array_equal(asked.pose_covariance, silent.pose_covariance)
    smoothed = asked.smoothed(stamps_ns)
    assert smoothed is not None
    assert len(smoothed.t_ns) == len(smoothed.poses) == len(smoothed.pose_covariances) == n_states
    rows = asked.reported_rows()
    assert smoothed.landmark_ids == tuple(asked.state.landmark_ids[row] for row in rows)
    assert len(rows) > 5
    # The newest pose has seen no more than the filter's; half a lap back, a loop has been closed.
    assert np.abs(smoothed.poses[-1] - asked.pose).max() < 3e-3
    errors = smoothed.poses[:, :2] - run.poses[1 : n_states + 1, :2]
    assert np.linalg.norm(errors, axis=1).max() < 0.01
    nees = [
        float(e @ np.linalg.solve(P, e))
        for e, P in zip(errors, smoothed.pose_covariances[:, :2, :2], strict=True)
    ]
    assert np.mean(nees[20:]) < chdtri(2, 1e-3)


@pytest.mark.parametrize("walk", [0.0, 1e-5])
def test_the_prior_is_the_dense_schur_complement_of_the_poses_gone(walk: float) -> None:
    problem, start = short_run(0, walk)
    prior = Smoother(problem, RULE).condensed(start, N_GONE, math.inf)
    n_cal = N_GONE + 1 if walk else 1
    beginning = replace(
        start, poses=start.poses[: N_GONE + 1], calibration=start.calibration[:n_cal]
    )
    x = packed(beginning)
    J = complex_step(lambda y: white_residuals(problem, N_GONE, N_GONE, n_cal, y), x)
    r = white_residuals(problem, N_GONE, N_GONE, n_cal, x.astype(np.complex128)).real
    H, g = J.T @ J, J.T @ r
    keep = newest(N_GONE + 1, n_cal, len(x))
    gone = np.delete(np.arange(len(x)), keep)
    gain = np.linalg.solve(H[np.ix_(gone, gone)], H[np.ix_(gone, keep)]).T
    wanted = H[np.ix_(keep, keep)] - gain @ H[np.ix_(gone, keep)]
    pull = g[keep] - gain @ g[gone]
    values = x[keep]
    assert np.array_equal(prior.mean, values)
    K = complex_step(lambda y: invariant_errors(values, y), values)
    assert np.abs(K.T @ prior.information @ K - wanted).max() <= 1e-8 * np.abs(wanted).max()
    assert np.abs(K.T @ prior.gradient - pull).max() <= 1e-8 * np.abs(pull).max()


@pytest.mark.parametrize("walk", [0.0, 1e-5])
def test_prior_and_rest_are_the_full_batch_and_nothing_counts_twice(walk: float) -> None:
    problem, start = short_run(1, walk)
    smoother = Smoother(problem, RULE)
    full = smoother.solve(start, tolerance=1e-14)
    assert full is not None
    prior = smoother.condensed(full.estimate, N_GONE, RULE.outlier_sigmas)
    again = Smoother(rest_of(problem, prior, N_GONE), RULE)
    part = again.solve(rest_of_values(full.estimate, N_GONE), tolerance=1e-14)
    assert part is not None
    wanted = packed(rest_of_values(full.estimate, N_GONE))
    assert np.abs(packed(part.estimate) - wanted).max() <= 1e-8
    most = np.abs(full.information).max()
    assert np.abs(part.information - full.information).max() <= 1e-8 * most


def test_forgetting_in_three_parts_is_forgetting_at_once() -> None:
    problem, start = short_run(2, 0.0)
    full = Smoother(problem, RULE).solve(start, tolerance=1e-14)
    assert full is not None
    at_once = Smoother(problem, RULE).condensed(full.estimate, 9, math.inf)
    left, values = problem, full.estimate
    for gone in (4, 3, 2):
        prior = Smoother(left, RULE).condensed(values, gone, math.inf)
        left, values = rest_of(left, prior, gone), rest_of_values(values, gone)
    most = np.abs(at_once.information).max()
    assert np.abs(prior.information - at_once.information).max() <= 1e-8 * most
    assert np.abs(prior.gradient - at_once.gradient).max() <= 1e-8 * most


@pytest.mark.parametrize("angle", [0.05, -1.0, 3.0])
def test_ranges_never_tell_where_the_map_lies(angle: float) -> None:
    """Without the anchor, turning and shifting all there is costs nothing, however far."""
    problem, start = short_run(3, 0.0)
    sigmas = np.diag(problem.prior.information).copy()
    sigmas[:3] = 0.0
    free = replace(problem, prior=replace(problem.prior, information=np.diag(sigmas)))
    prior = Smoother(free, RULE).condensed(start, N_GONE, math.inf)
    rng = np.random.default_rng(4)
    values = prior.mean + 0.02 * rng.standard_normal(len(prior.mean))
    R = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    moved = values.copy()
    moved[:2] = R @ values[:2] + [2.0, -1.0]
    moved[2] += angle
    points = values[6 + N_RADARS :].reshape(-1, 2)
    moved[6 + N_RADARS :] = (points @ R.T + [2.0, -1.0]).ravel()
    here, there = prior_cost(prior, values, N_RADARS), prior_cost(prior, moved, N_RADARS)
    assert abs(here) > 1.0
    assert there == pytest.approx(here, rel=1e-8)


def test_a_merge_states_that_two_points_are_one_and_a_drop_marginalises() -> None:
    rng = np.random.default_rng(5)
    head, size = 6 + N_RADARS, 6 + N_RADARS + 6
    root = rng.standard_normal((size, size))
    prior = Prior(
        information=root @ root.T, gradient=rng.standard_normal(size), mean=rng.random(size)
    )

    def known() -> Condensed:
        return Condensed(prior, [7, 3, 9])

    def cost(e: Array) -> float:
        return float(e @ (prior.information @ e + 2.0 * prior.gradient))

    merged = known()
    merged.rename(9, 7)
    few = merged.of([3, 7])
    values = rng.random(size - 2)
    both = np.concatenate([values[:head], values[-2:], values[head:-2], values[-2:]])

    def merged_cost(x: Array) -> float:
        e = x - few.mean
        return float(e @ (few.information @ e + 2.0 * few.gradient))

    # The same up to a constant, which no estimate depends on.
    other = rng.random(size - 2)
    both_other = np.concatenate([other[:head], other[-2:], other[head:-2], other[-2:]])
    wanted = cost(both - prior.mean) - cost(both_other - prior.mean)
    assert merged_cost(values) - merged_cost(other) == pytest.approx(wanted, rel=1e-9)

    dropped = known()
    dropped.drop(3)
    left = dropped.of([7, 9, 11])
    covariance = np.linalg.inv(prior.information)
    keep = np.r_[0 : head + 2, head + 4 : size]
    inner = left.information[: size - 2, : size - 2]
    assert np.abs(np.linalg.inv(inner) - covariance[np.ix_(keep, keep)]).max() <= 1e-9
    lowest = (-covariance @ prior.gradient)[keep]
    assert np.abs(-np.linalg.solve(inner, left.gradient[: size - 2]) - lowest).max() <= 1e-9
    assert not left.information[size - 2 :].any(), "nothing is known of the landmark it lacks"
    with pytest.raises(ValueError, match=r"lacks: \[3, 9\]"):
        known().of([7, 11])


def test_a_prior_pulls_as_its_cost_falls() -> None:
    """Far from where it was taken too: the gradient is half the derivative of the cost."""
    problem, start = short_run(7, 0.0)
    prior = Smoother(problem, RULE).condensed(start, N_GONE, math.inf)
    rng = np.random.default_rng(8)
    values = prior.mean + 0.1 * rng.standard_normal(len(prior.mean))
    information, gradient = prior_terms(prior, values, N_RADARS)

    def cost(x: Complex) -> Complex:
        e = invariant_errors(prior.mean, x)
        return np.atleast_1d(e @ (prior.information @ e + 2.0 * prior.gradient))

    slope = complex_step(cost, values)[0]
    here = prior_cost(prior, values, N_RADARS)
    assert here == pytest.approx(float(cost(values.astype(np.complex128))[0].real), rel=1e-9)
    assert np.abs(2.0 * gradient - slope).max() <= 1e-9 * np.abs(slope).max()
    K = complex_step(lambda y: invariant_errors(prior.mean, y), values)
    wanted = K.T @ prior.information @ K
    assert np.abs(information - wanted).max() <= 1e-9 * np.abs(wanted).max()


def test_both_starts_of_a_solution_begin_at_the_first_pose_kept() -> None:
    wheels = WheelNoise()
    log, state = RunLog(wheels), State(wheels.calibration_sigmas, (0.0,) * N_RADARS)
    step = np.array([0.1, 0.0, 0.1])
    for _ in range(30):
        predict(state, calibrated_motion(step, np.zeros(3), wheels), wheels)
        log.add_motion(*step_of(step, 1e-4))
        log.set_causal(state.pose)
    before = log.problem(state, start_prior((0.01,) * 3, (0.0,) * N_RADARS, 0))
    prior = Smoother(before, RULE).condensed(log.starts(state, before)[0], 20, math.inf)
    log.condense(prior, [], 20)
    assert (log.n_poses, log.n_kept) == (31, 11)
    with pytest.raises(ValueError, match="pose 19 is kept no longer"):
        log.add_range(19, 0, 5, antenna=(0.1, 0.2), range_m=1.0, sigma_m=0.01)
    causal, chained = log.starts(state, log.problem(state, prior))
    assert causal.poses[0] == pytest.approx(prior.mean[:3], abs=1e-12)
    assert chained.poses == pytest.approx(causal.poses, abs=1e-9)


def test_each_calibration_error_walks_in_proportion_to_its_own_deviation() -> None:
    """Each variance gains a quarter of the first one over a quarter of a metre."""
    sigmas = (0.01, 0.02, 0.03)
    s, w, kappa = sigmas
    wheels = WheelNoise(
        scale_sigma=s, turn_scale_sigma=w, curvature_sigma_rad_per_m=kappa, walk_per_sqrt_m=1.0
    )
    log, state = RunLog(wheels), State(sigmas, (0.0,) * N_RADARS)
    step = np.array([0.25, 0.0, 0.0])
    motion = calibrated_motion(step, np.zeros(3), wheels)
    log.add_motion(step, motion)
    problem = log.problem(state, start_prior(sigmas, (0.0,) * N_RADARS, 0))
    assert problem.walks[0] == pytest.approx(0.25 * np.square(sigmas))
    predict(state, motion, wheels)
    assert state.P.full().diagonal()[3:6] == pytest.approx(1.25 * np.square(sigmas))


def test_labels_of_landmarks_that_are_gone_are_forgotten() -> None:
    """A target that comes back is a new landmark, not one that the map lacks."""
    parameters = parameters_for(LAB, 7.4e-3)
    back_end = RobustBackEnd(paper_rig(), parameters)
    seen = RangeBearing(range_m=1.0, bearing_rad=1.5, covariance=1e-6 * np.eye(2), label=3)
    far = RangeBearing(range_m=5.0, bearing_rad=0.0, covariance=1e-6 * np.eye(2), label=4)
    first, _ = back_end.update_points([seen, far])
    silent = [RangeScan(radar=radar, ranges_m=(), labels=()) for radar in range(N_RADARS)]
    for _ in range(40):
        back_end.update(silent)
    assert first not in back_end.state.landmark_ids
    heard = replace(silent[0], ranges_m=(1.0,), labels=(3,))
    assert back_end.update([heard, *silent[1:]]).continued == ()
    assert back_end.update_points([seen]) != (first,)
    assert len(back_end.state.landmark_ids) == 2


def test_a_long_run_keeps_its_belief_and_what_it_solves_for_stays_small() -> None:
    """Condensing at 80 poses changes the belief of 330 by little."""
    rig, parameters = paper_rig(), parameters_for(LAB, 7.4e-3)
    run = simulate(LAB, 1, 7.4e-3, labelled=True)
    rule = replace(parameters.relinearisation, most_poses=80, kept_share=0.7)
    short = replace(parameters, relinearisation=rule)
    whole, bounded = RobustBackEnd(rig, parameters), RobustBackEnd(rig, short)
    sizes = []
    for k in range(330):
        for back_end in (whole, bounded):
            back_end.predict(run.increments[k])
            back_end.update(run.scans[k])
        if k in (200, 329):
            sizes.append((size_of_problem(bounded), size_of_problem(whole)))
    whole.relinearise()
    bounded.relinearise()
    sigmas = np.sqrt(np.diag(whole.pose_covariance))
    assert (np.abs(bounded.pose - whole.pose) <= 0.1 * sigmas).all()
    assert np.sqrt(np.diag(bounded.pose_covariance)) == pytest.approx(sigmas, rel=0.01)
    (early, early_whole), (late, late_whole) = sizes
    assert late - early < 0.25 * (late_whole - early_whole)
    assert late < 0.5 * late_whole


def size_of_problem(back_end: RobustBackEnd) -> int:
    """Return how many bytes a solution starts from."""
    state = back_end.state
    unused = start_prior((1.0,) * 3, (1.0,) * N_RADARS, len(state.feature_ids))
    return len(pickle.dumps(back_end._log.problem(state, unused)))


def drive_along(
    log: RunLog, n_poses: int, landmarks: Sequence[int], rng: np.random.Generator
) -> None:
    """Log a drive along x with a range of each landmark at every pose."""
    for _ in range(n_poses):
        log.add_motion(*step_of(np.array([0.02, 0.0, 0.0]), 1e-4))
        for landmark in landmarks:
            log.add_range(
                log.n_poses - 1,
                landmark % N_RADARS,
                landmark,
                antenna=(0.1, 0.2),
                range_m=float(rng.uniform(0.3, 1.5)),
                sigma_m=0.01,
            )


def test_what_is_condensed_is_there_for_a_solution_of_the_whole_run() -> None:
    wheels, n_landmarks = WheelNoise(), 4
    state = State(wheels.calibration_sigmas, (0.0,) * N_RADARS)
    for row in range(n_landmarks):
        point = BodyPoint(
            point_m=np.array([1.0, float(row)]),
            covariance=1e-4 * np.eye(2),
            by_offsets=np.zeros((2, N_RADARS)),
        )
        initialise_landmark(state, point)
    prior = start_prior((0.01,) * 3, (0.0,) * N_RADARS, n_landmarks - 1)
    logs = RunLog(wheels), RunLog(wheels)
    for is_condensed, log in zip((True, False), logs, strict=True):
        rng = np.random.default_rng(4)
        for names in ([0, 1, 2, 3], [0, 1, 2, 3], [0, 1, 3]):
            drive_along(log, 50, names, rng)
            if is_condensed:
                unused = start_prior((0.01,) * 3, (0.0,) * N_RADARS, len(names))
                log.condense(unused, names, 40)
            if len(names) == 4:
                log.rename(2, 0)
    state.remove(2)
    wanted = logs[1].problem(state, prior)
    assert len(wanted.ranges_m) == 50 * (4 + 4 + 3)
    assert len(logs[0].problem(state, prior).increments) == 30
    found = logs[0].problem(state, prior, whole=True)
    for column in fields(Problem):
        if column.name not in {"prior", "n_walls"}:
            values = getattr(found, column.name), getattr(wanted, column.name)
            np.testing.assert_array_equal(*values, err_msg=column.name)
    assert found.prior is prior
    assert len(logs[0].starts(state, found)[0].poses) == 151


@pytest.mark.parametrize("n_ranges", [14, 60])
def test_a_range_costs_a_row_of_numbers_and_no_object(n_ranges: int) -> None:
    """A range is 45 bytes and a pose 128, in buffers that may be half empty."""
    log, n_poses = RunLog(WheelNoise()), 1000
    tracemalloc.start()
    try:
        drive_along(log, n_poses, range(n_ranges), np.random.default_rng(6))
        grown, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert log.n_poses == n_poses + 1
    assert grown < 2.1 * n_poses * (45 * n_ranges + 128)


def test_a_range_beyond_the_limit_is_left_out_and_costs_the_limit() -> None:
    """Of 78 ranges the eleventh is off by 40 standard deviations; by default the limit is four."""
    problem, start = short_run(3, 0.0)
    rule = RelinearisationRule(iterations=40)
    ranges_m = problem.ranges_m.copy()
    ranges_m[10] += 0.2
    spoilt = Smoother(replace(problem, ranges_m=ranges_m), rule)
    names = ("range_poses", "range_radars", "range_landmarks", "range_antennas", "range_sigmas_m")
    rows = {name: np.delete(getattr(problem, name), 10, axis=0) for name in (*names, "ranges_m")}
    without = Smoother(replace(problem, **rows), rule)
    solution, wanted = (each.solve(start, tolerance=1e-14) for each in (spoilt, without))
    assert solution is not None
    assert wanted is not None
    assert packed(solution.estimate) == pytest.approx(packed(wanted.estimate), abs=1e-9)
    assert solution.information == pytest.approx(wanted.information, rel=1e-6)
    assert solution.cost == pytest.approx(wanted.cost + 4.0**2, abs=1e-6)
    prior, expected = (
        each.condensed(wanted.estimate, N_GONE, rule.outlier_sigmas) for each in (spoilt, without)
    )
    assert prior.information == pytest.approx(expected.information, rel=1e-9)
    assert prior.gradient == pytest.approx(expected.gradient, abs=1e-9)


def test_a_solution_that_knows_nothing_of_a_landmark_is_refused() -> None:
    """The ranges of one landmark weigh next to nothing, as if all were left out."""
    back_end, _ = drive(RODS, 0, WheelNoise())
    state, log = back_end.state, back_end._log
    assert relinearise(log, state, back_end.parameters)
    ranges = log._ranges.all()
    ranges["sigma_m"][ranges["landmark"] == state.landmark_ids[-1]] = 1e6
    assert _is_sane(state)
    assert not relinearise(log, state, back_end.parameters)
    assert _is_sane(state)


def test_a_range_beyond_the_limit_is_no_part_of_what_is_condensed() -> None:
    """One range of the first poses is 50 standard deviations off, or was never measured."""
    back_end, _ = drive(RODS, 0, WheelNoise())
    rule = RelinearisationRule(most_poses=60)
    parameters = replace(back_end.parameters, relinearisation=rule)
    priors = []
    for is_measured in (True, False):
        state, log = deepcopy((back_end.state, back_end._log))
        ranges = log._ranges.all()
        assert ranges["pose"][5] < 100
        if is_measured:
            ranges["range_m"][5] += 50 * SIGMA_M
        else:
            log._ranges.keep(np.arange(len(ranges)) != 5, first_pose=0)
        assert relinearise(log, state, parameters)
        assert log.n_kept < 60
        unused = start_prior((1.0,) * 3, (1.0,) * 4, len(state.feature_ids))
        priors.append(log.problem(state, unused).prior)
    largest = np.abs(priors[1].gradient).max()
    assert priors[0].gradient / largest == pytest.approx(priors[1].gradient / largest, abs=1e-5)


def test_information_of_rounding_alone_is_none() -> None:
    information = np.diag([1e4, 1e6, 4e2, 1e3])
    assert is_determined(information)
    information[3, 3] = 1e-9
    assert not is_determined(information)
    information[2:, 2:] = [[1.0, 1.0], [1.0, 1.0 - 1e-9]]
    assert not is_determined(information)


def _is_sane(state: State) -> bool:
    P = state.P.full()
    return bool(P.diagonal().max() < 1e4 and np.linalg.eigvalsh(P)[0] > -1e-9)

"""The smoother against dense least squares, and what it does with what cannot be right."""

import math
import tracemalloc
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import chdtri

from hil_tests.property.ekf_oracles import complex_step
from hil_tests.unit.slam.robust.range_world import LAB, follow, parameters_for, simulate, step_of
from slam.config import WheelNoise
from slam.geometry import between, compose, paper_rig
from slam.results import SmoothedRun
from slam.robust import kernels
from slam.robust.association import RangeScan
from slam.robust.back_end import RobustBackEnd
from slam.robust.parameters import BackEndParameters, MapRule, RelinearisationRule
from slam.robust.solver.revision import is_determined, relinearise
from slam.robust.solver.run_log import (
    Estimate,
    Problem,
    RunLog,
    all_poses,
    chain_of,
    motion_covariances,
    motions_by_calibration,
)
from slam.robust.solver.smoother import (
    NormalEquations,
    Rows,
    Smoother,
    Steps,
    eliminate,
    joint_covariance,
    measurement_residuals,
)
from slam.robust.state import Layout, State, calibrated_motion, predict

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

N_RADARS, N_MARKS, N_STEPS = 4, 3, 12
ANTENNAS = np.array([[-0.1, 0.2], [0.1, 0.2], [0.1, -0.2], [-0.1, -0.2]])
PARAMETERS = BackEndParameters(
    relinearisation=RelinearisationRule(iterations=40, outlier_sigmas=50.0)
)


def short_run(seed: int, walk: float, *, has_radii: bool = True) -> tuple[Problem, Estimate]:
    """Return a short run past three landmarks and a wall, and values near the truth.

    Of 13 poses, six are keyframes.
    """
    rng = np.random.default_rng(seed)
    layout = Layout(N_RADARS, N_MARKS, 1, has_mounts=has_radii, has_radii=has_radii)
    marks = np.array([[0.3, 1.0], [0.9, -0.9], [1.4, 1.2]])
    keys = np.array([0, 3, 4, 7, 10, 12])
    k = len(keys)
    poses = np.array([[0.12 * i, 0.02 * i, 0.05 * i] for i in range(N_STEPS + 1)])
    at = np.repeat(np.arange(k), 10)
    radars = np.tile([0, 1, 2, 3, 0, 1, 2, 3, 0, 1], k)
    seen = np.tile([0, 0, 1, 1, 2, 2, 0, 2, 3, 3], k)
    c, s = np.cos(poses[keys][at, 2]), np.sin(poses[keys][at, 2])
    m = ANTENNAS[radars] + 0.03 * rng.standard_normal((len(at), 2))
    arm = np.column_stack([c * m[:, 0] - s * m[:, 1], s * m[:, 0] + c * m[:, 1]])
    places = poses[keys][at, :2] + arm
    z = np.linalg.norm(marks[np.minimum(seen, 2)] - places, axis=1)
    z[seen == 3] = 2.0 - places[seen == 3, 1]
    sigmas = np.full(layout.size, 0.5)
    sigmas[:3], sigmas[3:6], sigmas[layout.offsets] = 1e-2, (0.02, 0.02, 0.01), 0.005
    sigmas[layout.mounts] = 0.004
    if has_radii:
        sigmas[layout.landmarks.start + 2 : layout.landmarks.stop : 3] = 0.02
    start = 1e-2 * rng.standard_normal(layout.size)
    start[layout.landmarks].reshape(-1, layout.landmark_size)[:, :2] += marks
    start[layout.walls] += (math.pi / 2, 2.0)
    mean = np.concatenate([np.zeros(6), start[6:] + 1e-3])
    if has_radii:
        mean[layout.radii] = start[layout.radii] = 0.0
    problem = Problem(
        layout=layout,
        prior_mean=mean,
        prior_sigmas=sigmas,
        steps=np.array([between(*pair) for pair in pairwise(poses)])
        + 1e-3 * rng.standard_normal((N_STEPS, 3)),
        step_covariances=np.tile(np.diag([1e-4, 1e-5, 1e-4]), (N_STEPS, 1, 1)),
        walks=np.full((N_STEPS, 3), walk),
        keys=keys,
        range_poses=at,
        range_radars=radars,
        range_landmarks=seen,
        range_antennas=m,
        range_turns=0.1 * rng.standard_normal(len(at)),
        ranges_m=z + 2e-3 * rng.standard_normal(len(z)),
        range_sigmas_m=np.full(len(z), 5e-3),
        range_bearings_rad=np.full(len(at), np.nan),
        range_bearing_sigmas_rad=np.full(len(at), np.nan),
    )
    # The first radar measures bearings, too.
    away = marks[np.minimum(seen, 2)] - places
    angles = np.where(seen == 3, math.pi / 2, np.arctan2(away[:, 1], away[:, 0]))
    bearings = angles - poses[keys][at, 2] - problem.range_turns
    bearings += 2e-3 * rng.standard_normal(len(at))
    bearings[radars > 0] = np.nan
    problem = replace(
        problem,
        range_bearings_rad=bearings,
        range_bearing_sigmas_rad=np.where(np.isnan(bearings), np.nan, 0.05),
    )
    return problem, Estimate(
        poses=poses[keys] + 0.02 * rng.standard_normal((k, 3)),
        calibration=0.01 * rng.standard_normal((k if walk else 1, 3)),
        fixed=start[6:],
    )


def packed(estimate: Estimate) -> Array:
    parts = (estimate.poses, estimate.calibration, estimate.fixed)
    return np.concatenate([part.ravel() for part in parts])


def turn(angle: complex) -> Complex:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def along(steps: Array, calibration: Complex, noise: Complex | None = None) -> Complex:
    """Return where steps lead, step by step; ``noise`` (n, 3) is added to d and a of each."""
    s, w, kappa = calibration
    place, heading = np.zeros(2, dtype=np.complex128), 0.0j
    for i, step in enumerate(steps):
        d = step[:2] / (1 + s)
        a = (step[2] - kappa * np.sqrt(d @ d)) / (1 + w)
        if noise is not None:
            d, a = d + noise[i, :2], a + noise[i, 2]
        place = place + turn(heading) @ d
        heading = heading + a
    return np.append(place, heading)


def white_radius(rho: complex, *, is_exact: bool) -> complex:
    """Return the root of 2 ln(tau + rho), quadratic below 1 mm; or of what touches it."""
    thin, tau = 1e-3, 1e-3
    if rho.real < 0.0:
        return rho / thin
    if rho.real < thin:
        return rho / math.sqrt(thin * (tau + thin))
    if is_exact:
        at_thin = thin / (tau + thin)
        return complex(np.sqrt(2.0 * np.log((tau + rho) / (tau + thin)) + at_thin))
    return rho / math.sqrt(rho.real * (tau + rho.real))


def motion_whitenings(problem: Problem) -> list[Array]:
    """Return what makes the error of each motion between keyframes white."""
    whitenings = []
    for first, last in pairwise(problem.keys):
        steps = problem.steps[first:last]

        def noisy(e: Complex, steps: Array = steps) -> Complex:
            return along(steps, np.zeros(3, dtype=np.complex128), e.reshape(-1, 3))

        A = complex_step(noisy, np.zeros(3 * len(steps)))
        blocks = problem.step_covariances[first:last]
        C = sum(
            A[:, 3 * i : 3 * i + 3] @ block @ A[:, 3 * i : 3 * i + 3].T
            for i, block in enumerate(blocks)
        )
        whitenings.append(np.linalg.inv(np.linalg.cholesky(C)))
    return whitenings


def white_residuals(
    problem: Problem, whitenings: list[Array], n_cal: int, x: Complex, *, is_exact: bool = False
) -> Complex:
    """Return the white residuals of the prior, all motions and all measurements.

    Of the radii's prior they are those of the quadratic that touches it, unless ``is_exact``.
    """
    layout, keys = problem.layout, problem.keys
    n_poses = len(keys)
    poses, rest = x[: 3 * n_poses].reshape(-1, 3), x[3 * n_poses :]
    calibration, fixed = rest[: 3 * n_cal].reshape(-1, 3), rest[3 * n_cal :]
    v = np.concatenate([poses[0], calibration[0], fixed])
    result = [np.asarray((v - problem.prior_mean) / problem.prior_sigmas, dtype=np.complex128)]
    if layout.has_radii:
        at = np.arange(layout.size)[layout.radii]
        result[0][at] = [white_radius(v[i], is_exact=is_exact) for i in at]
        if len(problem.radii_m):
            off = (v[at] - problem.radii_m) / problem.radius_sigmas_m
            result.append(off.astype(np.complex128))
            if v[at[0]].real > 0.0:  # of what is thick, no more than that it is not negative
                result[0][at[0]] = 0.0
    for k in range(n_poses - 1):
        own = slice(keys[k], keys[k + 1])
        c = calibration[k if n_cal > 1 else 0]
        way = turn(poses[k, 2]).T @ (poses[k + 1, :2] - poses[k, :2])
        step = np.append(way, poses[k + 1, 2] - poses[k, 2]) - along(problem.steps[own], c)
        result.append(whitenings[k] @ step)
        if n_cal > 1:
            walks = problem.walks[own].sum(axis=0)
            result.append((calibration[k + 1] - calibration[k]) / np.sqrt(walks))
    bearings = []
    for i, (k, radar, row) in enumerate(
        zip(problem.range_poses, problem.range_radars, problem.range_landmarks, strict=True)
    ):
        m = problem.range_antennas[i].astype(np.complex128)
        if layout.has_mounts:
            own = slice(layout.mounts.start + 2 * radar, layout.mounts.start + 2 * radar + 2)
            m = m + turn(problem.range_turns[i]) @ v[own]
        place = poses[k, :2] + turn(poses[k, 2]) @ m
        if row < N_MARKS:
            first = layout.landmarks.start + layout.landmark_size * row
            away = v[first : first + 2] - place
            expected = np.sqrt(away @ away) - (v[first + 2] if layout.has_radii else 0)
        else:
            phi, d = v[layout.walls]
            expected = d - np.cos(phi) * place[0] - np.sin(phi) * place[1]
        miss = expected + v[layout.offsets.start + radar] - problem.ranges_m[i]
        result.append(np.atleast_1d(miss / problem.range_sigmas_m[i]))
        if not np.isnan(problem.range_bearings_rad[i]):
            measured = problem.range_turns[i] + problem.range_bearings_rad[i]
            if row < N_MARKS:
                # Turned by what was measured, the landmark lies ahead: complex steps do not pass
                # arctan2.
                b = turn(poses[k, 2] + measured).T @ away
                off = np.arctan(b[1] / b[0])
            else:
                off = v[layout.walls.start] - poses[k, 2] - measured
            bearings.append(off / problem.range_bearing_sigmas_rad[i])
    return np.concatenate([*result, np.array(bearings)])


def newest(n_poses: int, n_cal: int, size: int) -> NDArray[np.intp]:
    """Return the rows of the last pose and calibration, and of what is fixed."""
    return np.concatenate(
        [
            np.arange(3 * n_poses - 3, 3 * n_poses),
            3 * n_poses + np.arange(3 * n_cal - 3, 3 * n_cal),
            np.arange(3 * n_poses + 3 * n_cal, size),
        ]
    )


def test_odometry_over_a_segment_is_its_steps_one_by_one() -> None:
    problem, start = short_run(4, 0.0)
    calibration = np.array([0.02, -0.01, 0.3])
    chain = chain_of(problem.steps, problem.keys, calibration[None, :])
    by = motions_by_calibration(chain, calibration[None, :])
    for k, (begin, end) in enumerate(zip(problem.keys[:-1], problem.keys[1:], strict=True)):
        steps = problem.steps[begin:end]
        wanted = along(steps, calibration.astype(np.complex128)).real
        assert np.abs(chain.ends[k] - wanted).max() <= 1e-14
        slope = complex_step(partial(along, steps), calibration)
        assert np.abs(by[k] - slope).max() <= 1e-12
    covariances = motion_covariances(chain, problem.step_covariances)
    assert np.array_equal(covariances[1], problem.step_covariances[3]), "a segment of one step"
    # What odometry misses is spread along the way; without any, poses follow the steps.
    poses = [np.zeros(3)]
    for begin, end in zip(problem.keys[:-1], problem.keys[1:], strict=True):
        moved = along(problem.steps[begin:end], calibration.astype(np.complex128)).real
        poses.append(compose(poses[-1], moved))
    exact = replace(start, poses=np.array(poses), calibration=calibration[None, :])
    every = all_poses(problem, exact)[0]
    place = along(problem.steps[:2], calibration.astype(np.complex128)).real
    assert np.abs(every[2] - place).max() <= 1e-12
    assert np.abs(every[problem.keys] - exact.poses).max() <= 1e-12


@pytest.mark.parametrize(
    ("has_radii", "walk"),
    [
        (False, 0.0),
        (True, 1e-5),
        pytest.param(True, 0.0, marks=pytest.mark.rare),
        pytest.param(False, 1e-5, marks=pytest.mark.rare),
    ],
)
def test_the_smoother_is_least_squares_and_its_complement_the_marginal(
    walk: float, *, has_radii: bool
) -> None:
    problem, start = short_run(1, walk, has_radii=has_radii)
    if has_radii:
        # Of three landmarks one is shown to be thick, one is thin, and one was not seen
        problem = replace(
            problem,
            radii_m=np.array([0.08, 0.01, 0.0]),
            radius_sigmas_m=np.array([0.01, 0.02, math.inf]),
        )
    smoother = Smoother(problem, PARAMETERS)
    solution = smoother.solve(start, tolerance=1e-14)
    assert solution is not None
    n_cal, whitenings = len(start.calibration), motion_whitenings(problem)

    def residuals(y: Complex) -> Complex:
        return white_residuals(problem, whitenings, n_cal, y)

    def real(x: Array) -> Array:
        y = x.astype(np.complex128)
        return white_residuals(problem, whitenings, n_cal, y, is_exact=True).real

    oracle = least_squares(real, packed(start), xtol=1e-15, ftol=1e-15, gtol=1e-12, x_scale="jac")
    assert solution.cost == pytest.approx(2.0 * oracle.cost, rel=1e-6)
    assert np.abs(packed(solution.estimate) - oracle.x).max() <= 1e-5
    J = complex_step(residuals, packed(solution.estimate))
    dense = np.linalg.inv(J.T @ J)
    keep = newest(len(start.poses), n_cal, len(oracle.x))
    wanted = dense[np.ix_(keep, keep)]
    marginal = np.linalg.inv(solution.information)
    assert np.abs(marginal - wanted).max() <= 1e-4 * np.abs(wanted).max()
    of_keys, of_border = smoother.covariances(solution.estimate)
    blocks = [dense[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] for k in range(len(start.poses))]
    assert np.abs(of_keys - blocks).max() <= 1e-4 * np.abs(blocks).max()
    assert np.abs(of_border - wanted).max() <= 1e-4 * np.abs(wanted).max()
    for some in ([1, 2, 4], [3], [], [0, 4]):
        keys = np.array(some, dtype=np.intp)
        at = np.concatenate([keep, (3 * keys[:, None] + np.arange(3)).ravel()])
        joint = joint_covariance(solution.eliminated, keys)
        assert np.abs(joint - dense[np.ix_(at, at)]).max() <= 1e-4 * np.abs(wanted).max()


def test_huber_weights_are_those_of_the_solution_itself() -> None:
    """Scipy's own Huber loss has the same least; nothing is frozen at first sight."""
    problem, start = short_run(2, 0.0)
    ranges_m = problem.ranges_m.copy()
    ranges_m[[4, 17, 33]] += [0.03, -0.04, 0.05]
    problem = replace(problem, ranges_m=ranges_m, huber_sigmas=2.0)
    solution = Smoother(problem, PARAMETERS).solve(start, tolerance=1e-13)
    assert solution is not None
    n_rows, whitenings = len(ranges_m) + len(problem.with_bearing), motion_whitenings(problem)

    def real(x: Array) -> Array:
        y = x.astype(np.complex128)
        white = white_residuals(problem, whitenings, 1, y, is_exact=True).real
        tail = white[-n_rows:]
        huber = np.where(np.abs(tail) <= 2.0, tail, np.sqrt(np.abs(4.0 * np.abs(tail) - 4.0)))
        return np.concatenate([white[:-n_rows], huber])

    oracle = least_squares(real, packed(start), xtol=1e-15, ftol=1e-15, gtol=1e-12, x_scale="jac")
    assert solution.cost == pytest.approx(2.0 * oracle.cost, rel=1e-5)
    assert np.abs(packed(solution.estimate) - oracle.x).max() <= 1e-3


def test_a_range_beyond_the_limit_is_left_out_and_costs_the_limit() -> None:
    """Of 60 ranges the twelfth is off by 40 standard deviations; by default the limit is four."""
    problem, start = short_run(3, 0.0)
    parameters = BackEndParameters(relinearisation=RelinearisationRule(iterations=40))
    ranges_m = problem.ranges_m.copy()
    ranges_m[11] += 0.2
    spoilt = Smoother(replace(problem, ranges_m=ranges_m), parameters)
    names = [name for name in Problem.__dataclass_fields__ if name.startswith("range")]
    rows = {name: np.delete(getattr(problem, name), 11, axis=0) for name in names}
    without = Smoother(replace(problem, **rows), parameters)
    wanted = without.solve(start, tolerance=1e-14)
    assert wanted is not None
    solution = spoilt.solve(wanted.estimate, tolerance=1e-14)
    assert solution is not None
    assert packed(solution.estimate) == pytest.approx(packed(wanted.estimate), abs=1e-8)
    assert solution.information == pytest.approx(wanted.information, rel=1e-5, abs=1e-2)
    assert solution.cost == pytest.approx(wanted.cost + 4.0**2, abs=1e-6)
    # However few steps there are, the last ones are without it.
    for iterations in (1, 2, 3):
        few = BackEndParameters(relinearisation=RelinearisationRule(iterations=iterations))
        quick = Smoother(replace(problem, ranges_m=ranges_m), few).solve(wanted.estimate)
        assert quick is not None
        assert quick.cost < solution.cost + 1.0


def test_far_from_the_solution_no_range_is_left_out() -> None:
    """Landmarks start 0.3 m off, so that all their ranges lie beyond the limit."""
    problem, start = short_run(3, 0.0)
    smoother = Smoother(
        problem, BackEndParameters(relinearisation=RelinearisationRule(iterations=40))
    )
    near = smoother.solve(start, tolerance=1e-14)
    away = start.fixed.copy()
    marks = slice(problem.layout.landmarks.start - 6, problem.layout.landmarks.stop - 6)
    away[marks].reshape(-1, problem.layout.landmark_size)[:, :2] += 0.3
    far = smoother.solve(replace(start, fixed=away), tolerance=1e-14)
    assert near is not None
    assert far is not None
    assert packed(far.estimate) == pytest.approx(packed(near.estimate), abs=1e-6)
    assert far.cost == pytest.approx(near.cost, abs=1e-6)


@pytest.mark.parametrize("segment", [0, 2, 4])
def test_a_motion_of_more_noise_takes_up_what_the_wheels_report_wrongly(segment: int) -> None:
    problem, start = short_run(5, 0.0)
    parameters = BackEndParameters(
        relinearisation=RelinearisationRule(iterations=40, outlier_sigmas=math.inf)
    )
    # Known wheels: over so short a way their errors would do what a slip does.
    sigmas = problem.prior_sigmas.copy()
    sigmas[3:6] = 1e-3
    sure = replace(
        problem,
        step_covariances=np.tile(1e-6 * np.eye(3), (N_STEPS, 1, 1)),
        prior_sigmas=sigmas,
        range_sigmas_m=np.full(len(problem.ranges_m), 2e-3),
    )
    steps, covariances = sure.steps.copy(), sure.step_covariances.copy()
    slip, at = np.array([0.02, 0.0, math.radians(3.0)]), sure.keys[segment]
    steps[at] += slip
    covariances[at] += np.outer(slip, slip)
    slipped = replace(sure, steps=steps)
    told = replace(slipped, step_covariances=covariances)
    right, wrong, loose = (
        Smoother(each, parameters).solve(start, tolerance=1e-13) for each in (sure, slipped, told)
    )
    assert right is not None
    assert wrong is not None
    assert loose is not None
    true = right.estimate.poses
    off = [np.abs(each.estimate.poses - true).max() for each in (loose, wrong)]
    assert off[0] < 0.2 * off[1]


def test_the_smoothed_run_leaves_the_filter_unchanged_and_is_within_a_centimetre() -> None:
    run = simulate(LAB, 5, 4e-3, laps=2, clutter=False)
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


def test_past_poses_are_those_of_the_solution_over_the_whole_run() -> None:
    """After a solution they are its poses; before it, what it had before the last ranges, nearly.

    The filter linearises each range once, where it was then, and weighs it once.
    """
    back_end = driven(330, 2e-3)
    state = back_end.state
    numbers = state.past_numbers.copy()
    assert len(numbers) == len(state.past) >= 15

    def solved() -> SmoothedRun:
        smoothed = back_end.smoothed(np.arange(back_end._log.n_poses - 1))
        assert smoothed is not None
        return smoothed

    def away() -> tuple[Array, Array]:
        """Return how far past poses are from the solution's, in its standard deviations."""
        poses, covariances = solved().poses, solved().pose_covariances
        pasts = [state.past_pose(k) for k in range(len(state.past))]
        off = np.array([one.pose - poses[one.number - 1] for one in pasts])
        sigmas = np.array([np.sqrt(covariances[one.number - 1].diagonal()) for one in pasts])
        own = np.array([np.sqrt(one.covariance.diagonal()) for one in pasts])
        return np.abs(off) / sigmas, own / sigmas

    off, ratio = away()
    assert off.max() < 0.5
    assert 0.9 < ratio.min() <= ratio.max() < 1.1
    for _ in range(5):  # each lets the noise of ranges be learned anew
        assert relinearise(back_end._log, state, back_end.parameters)
    assert state.past_numbers == numbers
    off, ratio = away()
    assert off.max() < 1e-3
    np.testing.assert_allclose(ratio, 1.0, atol=1e-3)


def test_keyframes_remain_as_the_run_goes_on_and_a_loose_step_is_between_two() -> None:
    rng = np.random.default_rng(2)
    log, state = RunLog(WheelNoise(), MapRule().gap_poses), State((0.01,) * 3, (0.0,) * N_RADARS)
    parameters = BackEndParameters()
    before: set[int] = set()
    for k in range(1, 120):
        step, motion = step_of([rng.uniform(0.0, 0.02), 0.0, rng.uniform(-0.03, 0.03)], 1e-6)
        log.add_motion(step, motion, is_loose=k == 70)
        keys = log.problem(state, parameters).keys.tolist()
        assert keys[0] == 0
        assert keys[-1] == k
        assert before <= set(keys[:-1]) | {k}
        before = set(keys[:-1])
    assert {69, 70} <= before
    assert 15 < len(before) < 80


def test_a_range_is_the_same_from_its_keyframe_as_from_its_own_pose() -> None:
    """With perfect odometry both predict the same, its mount off or not."""
    state = State((0.01,) * 3, (0.01,) * N_RADARS, mount_sigma_m=0.01, radius_sigma_m=0.01)
    state.calibration = np.array([0.02, -0.01, 0.05])
    state.mounts_m = 0.01 * np.random.default_rng(1).standard_normal((N_RADARS, 2))
    state.augment(np.array([0.3, 1.0]), np.zeros((state.P.size, 3)), np.eye(3))
    state.radii_m[0] = 0.04
    log, wheels = RunLog(WheelNoise(), MapRule().gap_poses), WheelNoise()
    poses = [np.zeros(3)]
    for k in range(1, 41):
        step = np.array([0.01, 0.001, 0.02])
        motion = calibrated_motion(step, state.calibration, wheels)
        log.add_motion(step, motion)
        poses.append(compose(poses[-1], np.append(motion.step_m, motion.turn_rad)))
        x, y, heading = poses[-1]
        radar, sample_turn = k % N_RADARS, 0.004
        m = ANTENNAS[radar] + turn(sample_turn).real @ state.mounts_m[radar]
        away = state.landmarks_m[0] - [x, y] - turn(heading).real @ m
        log.add_range(
            k, radar, 0, antenna=(ANTENNAS[radar, 0], ANTENNAS[radar, 1]), turn_rad=sample_turn,
            range_m=float(np.hypot(*away)) - 0.04, sigma_m=1e-3,
        )  # fmt: skip
    state.position_m, state.heading_rad = poses[-1][:2], float(poses[-1][2])
    parameters = BackEndParameters()
    problem = log.problem(state, parameters)
    assert len(problem.keys) < 20
    chained = log.starts(state, problem)[1]
    assert np.abs(chained.poses - np.array(poses)[problem.keys]).max() <= 1e-12
    residual = measurement_residuals(problem, chained).residual
    assert np.abs(residual).max() <= 1e-4, "of a millimetre; turns of samples are single floats"


def test_each_calibration_error_walks_in_proportion_to_its_own_deviation() -> None:
    """Each variance gains a quarter of the first one over a quarter of a metre."""
    sigmas = (0.01, 0.02, 0.03)
    s, w, kappa = sigmas
    wheels = WheelNoise(
        scale_sigma=s, turn_scale_sigma=w, curvature_sigma_rad_per_m=kappa, walk_per_sqrt_m=1.0
    )
    log, state = RunLog(wheels, MapRule().gap_poses), State(sigmas, (0.0,) * N_RADARS)
    step = np.array([0.25, 0.0, 0.0])
    motion = calibrated_motion(step, np.zeros(3), wheels)
    log.add_motion(step, motion)
    problem = log.problem(state, BackEndParameters(wheels=wheels))
    assert problem.walks[0] == pytest.approx(0.25 * np.square(sigmas))
    predict(state, motion, wheels)
    assert state.P.full().diagonal()[3:6] == pytest.approx(1.25 * np.square(sigmas))


def test_the_label_of_a_target_that_was_moved_is_where_it_is_now() -> None:
    """That nothing is seen of it is no evidence; that it is seen elsewhere, is."""
    back_end = RobustBackEnd(paper_rig(), parameters_for(LAB, 7.4e-3))
    seen = RangeScan(
        radar=0,
        ranges_m=(1.0,),
        sigmas_m=(1e-3,),
        bearings_rad=(0.1,),
        bearing_sigmas_rad=(1e-3,),
        labels=(3,),
    )
    for _ in range(5):
        back_end.update([seen])
    for _ in range(40):
        back_end.update([RangeScan(radar=0, ranges_m=(), bearings_rad=())])
    (first,) = back_end.state.landmark_ids
    assert back_end.landmark_of_label == {3: first}
    for _ in range(40):
        back_end.update([replace(seen, bearings_rad=(-0.4,))])
    row = back_end.state.landmark_ids.index(back_end.landmark_of_label[3])
    mount = paper_rig().mounts[0]
    angle = mount.yaw_rad - 0.4
    place = np.array([mount.x_m + math.cos(angle), mount.y_m + math.sin(angle)])
    assert back_end.state.landmarks_m[row] == pytest.approx(place, abs=5e-3)


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


@pytest.mark.parametrize("n_ranges", [14, pytest.param(60, marks=pytest.mark.rare)])
def test_a_range_costs_a_row_of_numbers_and_no_object(n_ranges: int) -> None:
    """A range is 46 bytes at most and a pose 129, in buffers that may be half empty."""
    log, n_poses = RunLog(WheelNoise(), MapRule().gap_poses), 1000
    tracemalloc.start()
    try:
        drive_along(log, n_poses, range(n_ranges), np.random.default_rng(6))
        grown, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert log.n_poses == n_poses + 1
    assert grown < 2.1 * n_poses * (46 * n_ranges + 129)


def driven(n_steps: int, sigma_m: float) -> RobustBackEnd:
    """Return a back end after the first steps of a lap without clutter."""
    run = simulate(LAB, 2, sigma_m, laps=1, clutter=False)
    back_end = RobustBackEnd(paper_rig(), parameters_for(LAB, sigma_m))
    list(follow(back_end, run.increments[:n_steps], run.scans[:n_steps]))
    return back_end


def test_a_landmark_whose_ranges_weigh_nothing_is_unknown_and_the_rest_is_solved() -> None:
    back_end = driven(200, 2e-3)
    state, log = back_end.state, back_end._log
    assert relinearise(log, state, back_end.parameters)
    ranges = log._ranges.rows_to_write()
    ranges["sigma_m"][ranges["landmark"] == state.landmark_ids[-1]] = 1e6
    assert _is_sane(state)
    assert relinearise(log, state, back_end.parameters)
    assert _is_sane(state)


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


@given(n=st.integers(1, 12), width=st.integers(1, 4), m=st.integers(1, 9), seed=st.integers(0, 99))
def test_substitution_solves_a_banded_triangle(n: int, width: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    columns, L = np.zeros((n, width)), np.zeros((n, n))
    for j in range(n):
        for below in range(min(width, n - j)):
            columns[j, below] = L[j + below, j] = rng.normal() + (4.0 if below == 0 else 0.0)
    right = rng.normal(size=(n, m))
    np.testing.assert_allclose(kernels.substitute(columns, right), np.linalg.solve(L, right))


def test_what_fades_along_the_chain_ends_as_zero() -> None:
    # W_k = 0.5^k: its squares would be denormal from k = 511 on
    columns = np.tile([1.0, -0.5], (1200, 1))
    right = np.zeros((1200, 1))
    right[0] = 1.0
    faded = kernels.substitute(columns, right)[:, 0]
    expected = 0.5 ** np.arange(1200)
    np.testing.assert_array_equal(faded, np.where(expected > 1e-60, expected, 0.0))
    right[0] = np.nan
    assert np.isnan(kernels.substitute(columns, right)).all()


def test_elimination_is_the_schur_complement() -> None:
    rng = np.random.default_rng(5)
    n_chain, size, n_border = 30, 3, 21
    n = n_chain * size
    equations = NormalEquations(n_chain, size, n_border)
    # A column of the border begins at a later pose than those before it; the first are of all poses
    pose = np.repeat(np.arange(n_chain + 1), 8)
    newest = 6 + 3 * ((n_border - 9) * pose // (3 * n_chain))
    columns = np.column_stack([np.full(len(pose), 3), np.minimum(newest, n_border - 1)])
    rows = Rows(
        poses=pose,
        residual=rng.normal(size=len(pose)),
        by_pose=rng.normal(size=(len(pose), 3)),
        columns=columns,
        by_border=rng.normal(size=(len(pose), 2)),
    )
    steps = Steps(
        residual=rng.normal(size=(n_chain, 3)),
        by_before=rng.normal(size=(n_chain, 3, 3)),
        by_after=rng.normal(size=(n_chain, 3, 3)),
        by_calibration=rng.normal(size=(n_chain, 3, 3)),
    )
    equations.add_steps(steps)
    equations.add_rows(rows, np.ones(len(pose)))
    equations.add_prior(np.zeros(n_border), np.ones(n_border))
    J = np.zeros((len(pose) + 3 * n_chain, n + n_border))
    for k, at in enumerate(pose.tolist()):
        # the last pose is the first in the border
        J[k, size * at : size * at + 3] += rows.by_pose[k]
        np.add.at(J[k], n + columns[k], rows.by_border[k])
    for k in range(n_chain):
        mine = slice(len(pose) + 3 * k, len(pose) + 3 * k + 3)
        J[mine, size * k : size * k + 3] = steps.by_before[k]
        J[mine, size * k + 3 : size * k + 6] = steps.by_after[k]
        J[mine, n + 3 : n + 6] = steps.by_calibration[k]
    prior = np.concatenate([np.ones(3), np.zeros(n - 3), np.zeros(3), np.ones(n_border - 3)])
    A = J.T @ J + np.diag(prior)
    g = J.T @ np.concatenate([rows.residual, steps.residual.ravel()])
    gained = A[n:, :n] @ np.linalg.inv(A[:n, :n])
    left = eliminate(equations)
    np.testing.assert_allclose(left.information, A[n:, n:] - gained @ A[:n, n:], atol=1e-8)
    np.testing.assert_allclose(left.gradient, g[n:] - gained @ g[:n], atol=1e-8)

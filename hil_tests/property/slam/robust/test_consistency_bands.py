"""A filter told the truth about its noise errs as much as it says: N = 100 runs, 95 % bands.

Seeds are fixed, and so are the verdicts. The bands are the chi-square quantiles of paper and
design: the mean NEES of a pose (3 dof) over 100 runs lies in [2.54, 3.50], the mean NIS of an
observation (2 dof) in [1.63, 2.41]. Ten times share their runs, so two of them may be outside.
"""

from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from hil_tests.property.ekf_oracles import complex_step, observe, relative_error
from hil_tests.unit.slam.robust.range_world import (
    LAB,
    follow,
    parameters_for,
    reported,
    scans_of,
    true_path,
)
from slam.geometry import compose, paper_rig
from slam.library.evaluation import nees_pose
from slam.paper import ekf as ekf_slam
from slam.paper.association import mahalanobis_sq
from slam.results import Belief
from slam.robust.back_end import RobustBackEnd

Array = NDArray[np.float64]

N_RUNS = 100
TIMES = range(2, 12)
NEES_BAND, NIS_BAND = (2.54, 3.50), (1.63, 2.41)


def inside(values: Array, band: tuple[float, float]) -> int:
    return int(np.sum((values >= band[0]) & (values <= band[1])))


def test_bands_are_the_quantiles_of_chi_square() -> None:
    for dof, band in ((3, NEES_BAND), (2, NIS_BAND)):
        low, high = (float(chi2.ppf(p, dof * N_RUNS)) / N_RUNS for p in (0.025, 0.975))
        assert (round(low, 2), round(high, 2)) == band


LANDMARKS = np.array([[0.6, 1.0], [0.3, -1.1]])
R = np.diag([1e-3, 1e-3, 3e-3]) ** 2
Q = np.diag([5e-3, 8e-3]) ** 2


def ekf_run(seed: int, told: float) -> tuple[list[float], list[float]]:
    """Return NEES and NIS at the ten times; ``told`` is what the filter takes sigmas times."""
    rng = np.random.default_rng(seed)
    truth, belief = np.zeros(3), ekf_slam.start()
    nees, nis = [], []
    for k in range(1, TIMES.stop):
        u = np.array([0.03, 0.0, 0.05])
        truth = compose(truth, u) + rng.standard_normal(3) * np.sqrt(np.diag(R))
        belief = ekf_slam.predict(belief, u, told**2 * R)
        seen = ekf_slam.expected_observations(truth, LANDMARKS)
        seen = seen + rng.standard_normal(seen.shape) * np.sqrt(np.diag(Q))
        for row, z in enumerate(seen):
            if row == len(belief.landmark_ids):
                belief = ekf_slam.augment(belief, z, told**2 * Q)
                continue
            if k in TIMES and row == 0:
                nis.append(float(mahalanobis_sq(belief, z, told**2 * Q)[0]))
            belief = ekf_slam.update(belief, row, z, told**2 * Q)
        if k in TIMES:
            nees.append(nees_pose(belief.pose, belief.pose_covariance, truth))
    return nees, nis


@pytest.mark.parametrize(("told", "consistent"), [(1.0, True), (0.7, False), (1.4, False)])
def test_ekf_is_as_sure_as_it_may_be(told: float, consistent: bool) -> None:
    """And the test is sharp: sigmas told 0.7 or 1.4 times fail at all times, of fewer runs even."""
    runs = [ekf_run(seed, told) for seed in range(N_RUNS if consistent else 30)]
    anees, anis = (np.mean([run[which] for run in runs], axis=0) for which in (0, 1))
    assert len(anees) == len(anis) == len(TIMES)
    if consistent:
        assert inside(anees, NEES_BAND) >= 8
        assert inside(anis, NIS_BAND) >= 8
    else:
        assert inside(anees, NEES_BAND) == inside(anis, NIS_BAND) == 0


def test_robust_filter_is_as_sure_as_it_may_be() -> None:
    """Drive past two landmarks without clutter: ranges, wheels with their errors of the run."""
    rig = paper_rig()
    poses = true_path(LAB)[:24]  # a landmark is initialised from nine frames
    nees, nis, dof = [], [], []
    for seed in range(N_RUNS):
        rng = np.random.default_rng(seed)
        landmarks = np.array([[0.15, 1.0], [0.1, -0.9]]) + rng.uniform(-0.1, 0.1, (2, 2))
        increments = reported(poses, LAB, rng, 0.0)
        scans = scans_of(poses, landmarks, rng, 7.4e-3, clutter=False)
        back_end = RobustBackEnd(rig, parameters_for(LAB, 7.4e-3))
        reports, errors = [], []
        reports_of = follow(back_end, increments, scans)
        for report, truth in zip(reports_of, poses[1:], strict=True):
            reports.append(report)
            if len(reports) > len(increments) - 10:
                errors.append(nees_pose(back_end.pose, back_end.pose_covariance, truth))
        nees.append(errors)
        nis.append([report.nis for report in reports])
        dof.append([report.dof for report in reports])
    assert inside(np.mean(nees, axis=0), NEES_BAND) >= 8
    # Ranges of known landmarks come from the tenth step on, as many as were detected.
    totals, freedom = np.sum(nis, axis=0), np.sum(dof, axis=0)
    told = freedom > 0
    assert told.sum() >= 10
    low, high = (np.asarray(chi2.ppf(p, freedom[told])) for p in (0.025, 0.975))
    assert np.mean((totals[told] >= low) & (totals[told] <= high)) >= 0.8


# --- the linear case ------------------------------------------------------------------------------


def known_heading_run(noise: float) -> tuple[Belief, Array, Array, Array]:
    """Return the filter's belief, and mean, covariance and order of batch least squares.

    The heading is known, so the only curvature left is that of range and bearing themselves.
    Unknowns of the batch: n positions, then the landmarks; Jacobians by complex step at the truth.
    """
    rng = np.random.default_rng(3)
    n_steps, n = 8, len(LANDMARKS)
    size = 2 * (n_steps + n)
    step_sigma = noise * np.array([1.0, 2.0, 0.0])
    root_Q = noise * np.array([1.5, 1.0])
    truth, belief = np.zeros(3), ekf_slam.start()
    rows, right, weights = [], [], []
    for k in range(n_steps):
        u = np.array([0.05, 0.01, 0.0])
        jump = step_sigma * rng.standard_normal(3)
        truth = truth + u + jump
        belief = ekf_slam.predict(belief, u, np.diag(step_sigma**2))
        for axis in range(2):
            row = np.zeros(size)
            row[2 * k + axis] = 1.0
            if k:
                row[2 * k - 2 + axis] = -1.0
            rows.append(row)
            right.append(-jump[axis])
            weights.append(1 / step_sigma[axis])
        for mark, place_m in enumerate(LANDMARKS):
            error = root_Q * rng.standard_normal(2)
            z = observe(truth.astype(complex), place_m.astype(complex)).real + error
            add = len(belief.landmark_ids) == mark
            noise_of = np.diag(root_Q**2)
            belief = (
                ekf_slam.augment(belief, z, noise_of)
                if add
                else ekf_slam.update(belief, mark, z, noise_of)
            )
            fixed = partial(observe, landmark=place_m.astype(complex))
            H = complex_step(fixed, truth)[:, :2]
            for axis in range(2):
                row = np.zeros(size)
                row[2 * k : 2 * k + 2] = H[axis]
                row[2 * (n_steps + mark) : 2 * (n_steps + mark) + 2] = -H[axis]
                rows.append(row)
                right.append(error[axis])
                weights.append(1 / root_Q[axis])
    A = np.array(rows) * np.array(weights)[:, None]
    b = np.array(right) * np.array(weights)
    covariance = np.linalg.inv(A.T @ A)
    kept = np.arange(2 * (n_steps - 1), size)
    at_truth = np.concatenate([truth[:2], LANDMARKS.ravel()])
    mean = at_truth + (covariance @ A.T @ b)[kept]
    return belief, mean, covariance[np.ix_(kept, kept)], at_truth


def test_with_a_known_heading_the_filter_is_batch_least_squares() -> None:
    """Mean to 1e-8 m at noise of 1e-5, covariance to 1e-8 of itself in the limit of no noise."""
    free = np.r_[0:2, 3 : 3 + 2 * len(LANDMARKS)]
    belief, mean, _, truth = known_heading_run(1e-5)
    assert np.abs(mean - truth).max() > 3e-6  # noise matters
    assert np.abs(belief.mean[free] - mean).max() <= 1e-8
    belief, _, covariance, _ = known_heading_run(1e-10)
    assert relative_error(belief.covariance[np.ix_(free, free)], covariance) <= 1e-8
    assert belief.covariance[2, 2] == 0.0

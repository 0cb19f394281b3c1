"""The known-association bound: against truth, against our own smoother, and its inputs."""

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import eigh

from hil_tests.unit.slam.app.sessions import record_of_steps
from hil_tests.unit.slam.robust.range_world import (
    LAB,
    echoes_of,
    parameters_for,
    place_landmarks,
    reported,
    true_path,
)
from slam.app.cli import main
from slam.app.sweep.bound import (
    ALONE_RANGES,
    KnownAssociation,
    KnownRange,
    KnownRun,
    Pose,
    SeenFrom,
    StateRanges,
    first_position,
    known_run,
    solve_known,
    true_ids,
    wheel_derivatives,
    wheel_residual,
)
from slam.config import WheelNoise
from slam.frames import Detection
from slam.geometry import Mount, Rig, between, compose, mount_at, paper_rig
from slam.paper.ekf import start
from slam.results import StepResult
from slam.robust.parameters import BackEndParameters, RangeNoise, RelinearisationRule
from slam.robust.solver.run_log import Estimate, Problem, prior_sigmas
from slam.robust.solver.smoother import Smoother, Solution
from slam.robust.state import Layout

Array = NDArray[np.float64]

SIGMA_M = 7.4e-3
N_STEPS = 160


def known_range(radar: int, landmark: int, range_m: float) -> KnownRange:
    return KnownRange(
        radar=radar, landmark=landmark, range_m=range_m, sigma_m=SIGMA_M, motion=np.zeros(3)
    )


@cache
def simulated(offset_m: float) -> tuple[KnownRun, Array]:
    """Return a run with all ranges of its landmarks, and these, (n, 2)."""
    rng, poses = np.random.default_rng(3), true_path(LAB)
    landmarks = place_landmarks(LAB, rng)
    increments = reported(poses, LAB, rng, 0.0)
    ranges, seen = echoes_of(poses, landmarks, rng, SIGMA_M, offset_m)
    known = tuple(
        tuple(
            known_range(radar, landmark, float(ranges[radar, k, landmark]))
            for radar, landmark in np.argwhere(seen[:, k]).tolist()
        )
        for k in range(1, len(poses))
    )
    return KnownRun(increments=increments, ranges=known), landmarks


def begin_of(run: KnownRun, n_steps: int) -> KnownRun:
    return KnownRun(increments=run.increments[:n_steps], ranges=run.ranges[:n_steps])


def exact_run(n_steps: int) -> tuple[KnownRun, Array, Array]:
    """Return a run without any noise, its true poses and landmarks."""
    poses = true_path(LAB)[: n_steps + 1]
    landmarks = np.array([[0.4, 0.9], [1.1, 0.8], [0.7, -0.7], [1.6, -0.9], [2.8, 0.5], [1.2, 1.6]])
    increments, ranges = [], []
    for before, pose in pairwise(poses):
        increments.append(between(before, pose))
        seen = []
        for radar, mount in enumerate(paper_rig().mounts):
            antenna = mount_at(mount, pose)
            for landmark, point in enumerate(landmarks):
                dx, dy = point - (antenna.x_m, antenna.y_m)
                off = math.remainder(math.atan2(dy, dx) - antenna.yaw_rad, math.tau)
                if abs(off) < 0.56 and math.hypot(dx, dy) < 1.5:
                    seen.append(known_range(radar, landmark, math.hypot(dx, dy)))
        ranges.append(tuple(seen))
    return KnownRun(increments=np.array(increments), ranges=tuple(ranges)), poses[1:], landmarks


def test_a_run_without_noise_gives_the_truth() -> None:
    pytest.importorskip("gtsam")
    run, poses, landmarks = exact_run(150)
    bound = solve_known(run, paper_rig(), WheelNoise())
    for path in (bound.filtered, bound.smoothed):
        np.testing.assert_allclose(path[:, :2], poses[:, :2], atol=1e-7)
        np.testing.assert_allclose(np.sin(path[:, 2] - poses[:, 2]), 0.0, atol=1e-7)
    assert len(bound.landmark_ids) >= 4
    np.testing.assert_allclose(bound.landmarks_m, landmarks[list(bound.landmark_ids)], atol=1e-7)
    np.testing.assert_allclose(bound.calibration, 0.0, atol=1e-7)


def batch_of(run: KnownRun, bound: KnownAssociation, offset_sigma_m: float) -> Solution:
    """Solve the same least-squares problem with ``slam.robust``'s smoother."""
    wheels = parameters_for(LAB, SIGMA_M).wheels
    row = {landmark: i for i, landmark in enumerate(bound.landmark_ids)}
    used = [
        (step, known)
        for step, ranges in enumerate(run.ranges, start=1)
        for known in ranges
        if known.landmark in row
    ]
    mounts = paper_rig().mounts
    # The calibrated step and turn of a smoother differ from the reported ones by less than a
    # hundredth, and so does the noise model; both are told the same.
    covariances = np.array(
        [
            np.diag(wheels.step_variances(math.hypot(dx, dy), turn))
            for dx, dy, turn in run.increments
        ]
    )
    layout = Layout(4, len(row))
    noise = RangeNoise(offset_sigma_m=offset_sigma_m)
    problem = Problem(
        layout=layout,
        prior_mean=np.zeros(layout.size),
        prior_sigmas=prior_sigmas(layout, BackEndParameters(wheels=wheels, ranges=noise)),
        steps=run.increments,
        step_covariances=covariances,
        walks=np.zeros((len(run.increments), 3)),
        keys=np.arange(len(run.increments) + 1),
        range_poses=np.array([step for step, _ in used]),
        range_radars=np.array([known.radar for _, known in used]),
        range_landmarks=np.array([row[known.landmark] for _, known in used]),
        range_antennas=np.array(
            [(mounts[known.radar].x_m, mounts[known.radar].y_m) for _, known in used]
        ),
        range_turns=np.zeros(len(used)),
        ranges_m=np.array([known.range_m for _, known in used]),
        range_sigmas_m=np.full(len(used), SIGMA_M),
        range_bearings_rad=np.full(len(used), np.nan),
        range_bearing_sigmas_rad=np.full(len(used), np.nan),
    )
    parameters = BackEndParameters(
        relinearisation=RelinearisationRule(iterations=20, outlier_sigmas=math.inf)
    )
    begin = Estimate(
        poses=np.vstack([np.zeros(3), bound.filtered]),
        calibration=np.zeros((1, 3)),
        fixed=np.concatenate([np.zeros(4), bound.landmarks_m.ravel() + 0.01]),
    )
    solution = Smoother(problem, parameters).solve(begin, tolerance=1e-12)
    assert solution is not None
    return solution


@pytest.mark.parametrize("offset_sigma_m", [0.0, 0.02])
def test_the_smoother_is_ours_and_the_filtered_pose_ends_there(offset_sigma_m: float) -> None:
    pytest.importorskip("gtsam")
    run = begin_of(simulated(offset_sigma_m)[0], N_STEPS)
    bound = solve_known(
        run, paper_rig(), parameters_for(LAB, SIGMA_M).wheels, offset_sigma_m=offset_sigma_m
    )
    ours = batch_of(run, bound, offset_sigma_m)
    # Two solvers of one problem; what is left is the noise model's own linearisation, see above.
    np.testing.assert_allclose(bound.smoothed[:, :2], ours.estimate.poses[1:, :2], atol=2e-4)
    np.testing.assert_allclose(bound.landmarks_m, ours.estimate.fixed[4:].reshape(-1, 2), atol=5e-4)
    np.testing.assert_allclose(bound.calibration, ours.estimate.calibration[0], atol=2e-4)
    covariance = np.linalg.inv(ours.information)[:3, :3]
    sigmas = np.sqrt(np.diag(covariance))
    assert np.all(np.abs(bound.filtered[-1] - bound.smoothed[-1]) < 0.1 * sigmas)
    ratios = eigh(bound.filtered_covariance[-1], covariance, eigvals_only=True)
    np.testing.assert_allclose(ratios, 1.0, atol=0.03)  # in every direction


def test_the_filtered_path_knows_nothing_of_what_comes_later() -> None:
    pytest.importorskip("gtsam")
    run = begin_of(simulated(0.0)[0], 90)
    short = begin_of(run, 70)
    wheels = parameters_for(LAB, SIGMA_M).wheels
    whole, part = (solve_known(data, paper_rig(), wheels) for data in (run, short))
    np.testing.assert_array_equal(whole.filtered[:70], part.filtered)
    np.testing.assert_array_equal(whole.filtered_covariance[:70], part.filtered_covariance)
    assert np.abs(whole.smoothed[:70] - part.smoothed).max() > 1e-6


def test_a_radar_without_partner_finds_landmarks_too() -> None:
    pytest.importorskip("gtsam")
    whole, landmarks = simulated(0.0)
    both = begin_of(whole, 130)
    alive = tuple(tuple(k for k in ranges if k.radar in (0, 2)) for ranges in both.ranges)
    run = KnownRun(increments=both.increments, ranges=alive)
    bound = solve_known(run, paper_rig(), parameters_for(LAB, SIGMA_M).wheels)
    assert bound.landmark_ids
    away = bound.landmarks_m - landmarks[list(bound.landmark_ids)]
    assert np.hypot(*away.T).max() < 0.1


def test_wandering_calibration_errors_get_sets_of_their_own() -> None:
    pytest.importorskip("gtsam")
    run = begin_of(simulated(0.0)[0], 60)
    sigma = WheelNoise().scale_sigma
    wander = solve_known(run, paper_rig(), WheelNoise(walk_per_sqrt_m=0.5))
    still = solve_known(run, paper_rig(), WheelNoise())
    assert 0.0 < np.abs(wander.calibration - still.calibration).max() < 3 * sigma


def test_without_gtsam_the_bound_is_refused_before_any_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "gtsam", None)
    assert main(["sweep", "--seeds", "1", "--bound", "--json", str(tmp_path / "out.json")]) == 2
    assert "[gtsam]" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("calibration", [(0.0, 0.0, 0.0), (0.02, -0.03, 0.01)])
def test_derivatives_of_a_step_of_the_wheels(calibration: Pose) -> None:
    before, after, increment = (1.0, -2.0, 3.1), (1.01, -1.98, -3.12), (0.02, 0.003, 0.05)

    def moved(pose: Pose, change: Array) -> Pose:
        return _three(compose(np.array(pose), change))

    found = wheel_derivatives(before, after, calibration, increment)
    h = 1e-6
    for column in range(3):
        unit = h * np.eye(3)[column]
        ways: tuple[Callable[[Array], tuple[Pose, Pose, Pose]], ...] = (
            lambda change: (moved(before, change), after, calibration),
            lambda change: (before, moved(after, change), calibration),
            lambda change: (before, after, _three(np.array(calibration) + change)),
        )
        for derivative, way in zip(found, ways, strict=True):
            plus, minus = (wheel_residual(*way(sign * unit), increment) for sign in (1.0, -1.0))
            np.testing.assert_allclose(derivative[:, column], (plus - minus) / (2 * h), atol=1e-8)


def _three(values: Array) -> Pose:
    x, y, z = (float(value) for value in values)
    return (x, y, z)


MOUNT = Mount(name="left", x_m=0.0, y_m=0.2, yaw_rad=math.pi / 2)
POSE = np.array([1.0, 2.0, math.pi / 2])  # so the antenna is at (0.8, 2.0) and looks along -x


def test_true_ids_go_to_the_nearest_in_range_one_each_within_the_gate() -> None:
    landmarks = np.array([[0.1, 2.0], [0.0, 2.0], [1.5, 2.0], [0.8, 2.7]])  # two ahead, at 0.7, 0.8
    ranges = np.array([0.81, 0.705, 0.76, 0.69, 1.3])
    # 0.69 is 0.01 off, 0.705 nearer; 0.76 is off everything; the third is behind, the last aside
    gate_m = np.full(5, 0.03)
    assert true_ids(ranges, gate_m, MOUNT, POSE, landmarks) == [1, 0, None, None, None]
    assert true_ids(ranges[3:4], gate_m[:1], MOUNT, POSE, landmarks) == [0]
    assert true_ids(ranges[3:4], 0.3 * gate_m[:1], MOUNT, POSE, landmarks) == [None]
    assert true_ids(ranges, gate_m, MOUNT, POSE, np.zeros((0, 2))) == [None] * 5


def test_a_record_becomes_increments_and_ranges_at_their_own_times() -> None:
    odometry = np.array([[0.1, 0.0, 0.0], [0.3, 0.0, 0.0], [0.4, 0.1, math.pi / 2]])
    truth = np.array([[1.0, 2.0, 0.0], [1.2, 2.0, 0.0], [1.4, 2.0, 0.0]])
    landmark = np.array([[1.25, 2.9]])
    # half way between the first two states the antenna is at (1.1, 2.2)
    range_m = math.hypot(0.15, 0.7) + 0.004
    late = Detection(radar=0, t_ns=50, range_m=range_m, amplitude=0.1)
    clutter = Detection(radar=0, t_ns=50, range_m=1.2, amplitude=0.1)
    results = tuple(
        StepResult(t_ns=100 * k, odometry_pose=pose, belief=start(), detections=found)
        for k, (pose, found) in enumerate(zip(odometry, [(late, clutter), (), ()], strict=True))
    )

    def known(results: Sequence[StepResult], **sigmas: float) -> KnownRun:
        ranges = StateRanges()
        record = record_of_steps(results, truth, np.zeros(3), landmark, ranges)
        return known_run(record.states, ranges, Rig(mounts=(MOUNT,)), landmark, **sigmas)

    run = known(results, range_sigma_m=2e-3)
    np.testing.assert_allclose(
        run.increments, [[0.1, 0, 0], [0.2, 0, 0], [0.1, 0.1, math.pi / 2]], atol=1e-15
    )
    assert [len(ranges) for ranges in run.ranges] == [1, 0, 0]
    (only,) = run.ranges[0]
    assert (only.radar, only.landmark, only.range_m, only.sigma_m) == (0, 0, range_m, 2e-3)
    np.testing.assert_allclose(only.motion, [0.1, 0.0, 0.0], atol=1e-15)
    # the range is 4 mm off, and the gate four standard deviations
    assert known(results, range_sigma_m=0.95e-3).ranges[0] == ()
    assert len(known(results, range_sigma_m=5e-4, offset_sigma_m=2e-2).ranges[0]) == 1
    told = tuple(replace(r, range_sigmas_m=(3e-3, math.inf)[: len(r.detections)]) for r in results)
    by_detection = known(told, range_sigma_m=2e-3)
    assert [item.sigma_m for item in by_detection.ranges[0]] == [3e-3]
    left_out = (replace(results[0], range_sigmas_m=(math.inf, 3e-3)), *results[1:])
    assert known(left_out, range_sigma_m=2e-3).ranges == ((), (), ())


def test_ranges_of_one_radar_place_a_landmark_once_they_tell_it() -> None:
    landmark = np.array([0.35, 0.9])
    poses = [np.array([0.02 * k, 0.0, 0.0]) for k in range(41)]
    seen = [
        SeenFrom(
            step=step,
            known=known_range(0, 0, float(np.hypot(*(landmark - pose[:2] - (0.0, 0.2))))),
            antenna=MOUNT,
        )
        for step, pose in enumerate(poses)
    ]
    rig = Rig(mounts=(MOUNT,))
    assert first_position(rig, seen[: ALONE_RANGES - 1], poses) is None
    found = first_position(rig, seen[: 2 * ALONE_RANGES], poses)
    assert found is not None
    np.testing.assert_allclose(found, landmark, atol=1e-6)
    at_rest = [SeenFrom(step=0, known=item.known, antenna=MOUNT) for item in seen[:1] * 20]
    assert first_position(rig, at_rest, poses) is None  # the range gives a circle, not a point

"""The robust back end in a world of ranges: it finds the map, and is as sure as it may be.

Seeds are fixed. Bands are 95 % intervals of the chi-square distribution, not fitted to results.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from hil_tests.unit.slam.robust.range_world import (
    LAB,
    Run,
    Stress,
    drive,
    parameters_for,
    reported,
    scans_of,
    simulate,
    true_path,
)
from slam.geometry import Mount, Rig, paper_rig
from slam.metrics import nees_pose
from slam.robust.back_end import RobustBackEnd
from slam.robust.parameters import BackEndParameters
from slam.robust.points import RangeBearing
from slam.robust.ranges import RangeScan, sides_of

SIGMA_M = 7.4e-3


def cut(run: Run, n_poses: int) -> Run:
    """Return the beginning of a run."""
    return replace(
        run,
        poses=run.poses[:n_poses],
        increments=run.increments[: n_poses - 1],
        scans=run.scans[: n_poses - 1],
    )


def test_a_lap_of_the_lab_gives_a_clean_map() -> None:
    rig = paper_rig()
    run = cut(simulate(LAB, 0, SIGMA_M), 880)
    verdict, _ = drive(run, RobustBackEnd(rig, parameters_for(LAB, SIGMA_M)), rig)
    assert verdict.duplicates == 0
    assert verdict.false == 0
    assert verdict.matched >= verdict.true - 1
    assert verdict.ate_m < verdict.odometry_ate_m


def test_true_associations_give_a_consistent_pose() -> None:
    """ANEES of 40 short runs with labels lies in its band, and the NIS of their ranges in its."""
    rig, nees, nis, dof = paper_rig(), [], 0.0, 0
    for seed in range(40):
        run = short_labelled_run(seed)
        back_end = RobustBackEnd(rig, parameters_for(LAB, SIGMA_M))
        for increment, scans in zip(run.increments, run.scans, strict=True):
            back_end.predict(increment)
            report = back_end.update(scans)
            nis, dof = nis + report.nis, dof + report.dof
        nees.append(nees_pose(back_end.pose, back_end.pose_covariance, run.poses[-1]))
    total = 3 * len(nees)
    assert chi2.ppf(0.025, total) <= sum(nees) <= chi2.ppf(0.975, total)
    assert chi2.ppf(0.025, dof) <= nis <= chi2.ppf(0.975, dof)


def short_labelled_run(seed: int) -> Run:
    """Return 40 steps past four landmarks, labels told."""
    rng = np.random.default_rng(seed)
    poses = true_path(LAB)[:41]
    landmarks = np.array([[0.2, 1.0], [0.4, 0.8], [0.3, -0.9], [0.5, -1.1]])
    landmarks = landmarks + rng.uniform(-0.1, 0.1, landmarks.shape)
    increments = reported(poses, LAB, rng, 0.0)
    scans = scans_of(poses, landmarks, rng, SIGMA_M, Stress(), labelled=True)
    return Run(poses=poses, landmarks=landmarks, increments=increments, scans=list(scans))


def test_the_same_run_gives_the_same_bits() -> None:
    rig = paper_rig()
    run = cut(simulate(LAB, 3, SIGMA_M), 200)
    paths = [drive(run, RobustBackEnd(rig, parameters_for(LAB, SIGMA_M)), rig)[1] for _ in range(2)]
    assert np.array_equal(paths[0], paths[1])


def test_a_relinearised_belief_stays_where_the_filter_was_in_a_linear_regime() -> None:
    rig = paper_rig()
    run = cut(simulate(LAB, 1, SIGMA_M, labelled=True), 150)
    back_end = RobustBackEnd(rig, parameters_for(LAB, SIGMA_M))
    for increment, scans in zip(run.increments, run.scans, strict=True):
        back_end.predict(increment)
        back_end.update(scans)
    before, sigmas = back_end.pose, np.sqrt(np.diag(back_end.pose_covariance))
    assert back_end.relinearise()
    assert (np.abs(back_end.pose - before) <= sigmas).all()
    again = np.sqrt(np.diag(back_end.pose_covariance))
    assert again == pytest.approx(sigmas, rel=0.2)


def test_points_with_names_make_a_map() -> None:
    back_end = RobustBackEnd(paper_rig(), BackEndParameters())
    C = np.diag([1e-4, 1e-4])
    for k in range(5):
        back_end.predict(np.array([0.1, 0.0, 0.0]))
        seen = np.array([2.0, 1.0]) - np.array([0.1 * (k + 1), 0.0])
        range_m, bearing = float(np.hypot(*seen)), float(np.arctan2(seen[1], seen[0]))
        point = RangeBearing(range_m=range_m, bearing_rad=bearing, covariance=C, label=7)
        assert back_end.update_points([point]) == (0,)
    assert back_end.state.landmarks_m[0] == pytest.approx([2.0, 1.0], abs=1e-3)
    unnamed = replace(point, label=None)
    assert back_end.update_points([unnamed]) == (0,)
    assert back_end.update_points([replace(unnamed, bearing_rad=bearing + 1.0)]) == (1,)


def test_an_empty_scan_and_no_scan_change_nothing() -> None:
    back_end = RobustBackEnd(paper_rig(), BackEndParameters())
    back_end.predict(np.array([0.01, 0.0, 0.0]))
    pose = back_end.pose
    report = back_end.update([RangeScan(radar=0, ranges_m=())])
    assert back_end.update([]).continued == report.continued == ()
    assert np.array_equal(back_end.pose, pose)


def test_radars_that_look_the_same_way_are_one_side() -> None:
    assert sides_of(paper_rig()) == ((0, 1), (2, 3))
    assert sides_of(Rig(mounts=(Mount(name="one", x_m=0.0, y_m=0.0, yaw_rad=0.0),))) == ((0,),)

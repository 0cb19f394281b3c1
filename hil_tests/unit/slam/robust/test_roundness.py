"""Drums among rods: which get a radius, and that odometry's errors give none."""

import math
from collections.abc import Sequence

import numpy as np
import pytest

from hil_tests.unit.slam.robust.range_world import step_of
from hil_tests.unit.slam.robust.test_walls import antennas, state_with_map
from slam.config import WheelNoise
from slam.evaluation import nees_pose
from slam.geometry import paper_rig
from slam.robust.association import RangeScan, antennas_of, landmarks_in_view, view
from slam.robust.back_end import RobustBackEnd
from slam.robust.initialisation import UnassignedRanges
from slam.robust.map import radius_of
from slam.robust.parameters import (
    BackEndParameters,
    ContinuationRule,
    RangeNoise,
    RoundnessRule,
)
from slam.robust.run_log import RunLog, start_prior
from slam.robust.smoother import give_radius
from slam.robust.state import State

SIGMA_M, STEP_M = 2e-3, 0.01
WIDE = RangeNoise(min_range_m=0.0, max_range_m=10.0)
DRUM = (0.7, 0.85, 0.1)
RODS = ((0.1, 0.9, 0.0), (0.4, -0.9, 0.0), (1.0, -0.7, 0.0), (1.25, 1.1, 0.0))
CLASSROOM = WheelNoise(
    scale_sigma=0.023, turn_scale_sigma=0.023, curvature_sigma_rad_per_m=0.0139,
    heading_rad_per_sqrt_m=0.0042,
)  # fmt: skip


def drive(
    targets: Sequence[tuple[float, float, float]],
    seed: int,
    wheels: WheelNoise,
    errors: tuple[float, float] = (0.0, 0.0),
) -> tuple[RobustBackEnd, float]:
    """Drive 1.4 m along x past (x, y, radius); return the back end and the last NEES.

    ``errors`` are the wheels' scale and curvature errors, in their standard deviations.
    """
    rng = np.random.default_rng(seed)
    noise = RangeNoise(sigma_m=SIGMA_M, detection_probability=0.98, clutter_per_m=0.02)
    back_end = RobustBackEnd(paper_rig(), BackEndParameters(wheels=wheels, ranges=noise))
    scale = 1.0 + errors[0] * wheels.scale_sigma
    curvature = errors[1] * wheels.curvature_sigma_rad_per_m
    for k in range(1, 141):
        scans = []
        for radar, mount in enumerate(paper_rig().mounts):
            heard = []
            for x, y, radius_m in targets:
                dx, dy = x - k * STEP_M - mount.x_m, y - mount.y_m
                off = math.remainder(math.atan2(dy, dx) - mount.yaw_rad, math.tau)
                range_m = math.hypot(dx, dy) - radius_m
                if abs(off) < math.radians(32.5) and range_m < 1.5:
                    heard.append(range_m + SIGMA_M * float(rng.standard_normal()))
            scans.append(RangeScan(radar=radar, ranges_m=tuple(heard)))
        back_end.predict(np.array([scale * STEP_M, 0.0, curvature * STEP_M]))
        back_end.update(scans)
    truth = np.array([k * STEP_M, 0.0, 0.0])
    return back_end, nees_pose(back_end.pose, back_end.pose_covariance, truth)


@pytest.mark.parametrize("seed", range(3))
def test_a_drum_gets_its_radius_and_is_mapped_at_its_axis(seed: int) -> None:
    back_end, nees = drive([DRUM, *RODS], seed, WheelNoise())
    ((id_, radius_m),) = back_end.state.radii_m.items()
    assert radius_m == pytest.approx(DRUM[2], abs=0.02)
    row = back_end.state.landmark_ids.index(id_)
    assert back_end.state.landmarks_m[row] == pytest.approx(DRUM[:2], abs=0.03)
    assert nees < 16.3  # 99.9 %, 3 dof


@pytest.mark.parametrize("seed", range(6))
def test_wheels_that_err_make_no_rod_round(seed: int) -> None:
    """A scale error bends ranges as a radius does: 2 s r, here up to 6 cm."""
    errors = np.random.default_rng(100 + seed).standard_normal(2).tolist()
    back_end, nees = drive(RODS, seed, CLASSROOM, (errors[0], errors[1]))
    assert len(back_end.reported_rows()) >= 3
    assert back_end.state.radii_m == {}
    assert nees < 16.3


def test_a_radius_is_found_as_surely_as_it_says() -> None:
    """(estimate - truth) / sigma over 60 draws of noise, wheels and offsets has variance 1."""
    rng = np.random.default_rng(3)
    wheels = WheelNoise(along_m_per_sqrt_m=0.0, across_m_per_sqrt_m=0.0, heading_rad_per_sqrt_m=0.0)
    rule, ratios = RoundnessRule(), []
    for _ in range(60):
        state = State(wheels.calibration_sigmas, (0.01, 0.01))
        s, _, kappa = rng.standard_normal(3) * wheels.calibration_sigmas
        offsets = 0.01 * rng.standard_normal(2)
        state.augment(np.array([0.6 - 1.2, 0.85]), np.zeros((state.P.size, 2)), np.eye(2))
        log = RunLog(wheels)
        for k in range(121):
            if k:
                step = np.array([(1.0 + s) * STEP_M, 0.0, kappa * STEP_M])
                log.add_motion(*step_of(step, 1e-6))
            for radar, mount in enumerate(paper_rig().mounts[:2]):
                dx, dy = 0.6 - k * STEP_M - mount.x_m, 0.85 - mount.y_m
                if abs(math.atan2(dx, dy)) < math.radians(32.5):
                    noise_m = offsets[radar] + SIGMA_M * float(rng.standard_normal())
                    log.add_range(
                        k, radar, 0, antenna=(mount.x_m, mount.y_m),
                        range_m=math.hypot(dx, dy) - 0.1 + noise_m, sigma_m=SIGMA_M,
                    )  # fmt: skip
        found = radius_of(log, state, 0, wheels, rule)
        assert found is not None
        ratios.append((found.radius_m - 0.1) / found.sigma_m)
    assert np.mean(np.square(ratios)) == pytest.approx(1.0, abs=0.5)  # 2.7 sigma of 60 draws
    assert abs(float(np.mean(ratios))) < 0.5


def test_a_radius_shortens_ranges_and_lengthens_them_back_for_the_smoother() -> None:
    state = state_with_map()
    points = view(state, antennas()).ranges_m
    state.radii_m[2] = 0.07
    shorter = points - view(state, antennas()).ranges_m
    assert shorter == pytest.approx(np.tile([0.0, 0.07, 0.0, 0.0], (4, 1)))
    log = RunLog(WheelNoise())
    for landmark_id in (0, 2):
        log.add_range(0, 0, landmark_id, antenna=(0.1, -0.2), range_m=1.0, sigma_m=SIGMA_M)
    problem = log.problem(state, start_prior((0.1, 0.1, 0.1), (0.01,) * 4, 4))
    assert problem.ranges_m == pytest.approx([1.0, 1.07])
    assert problem.range_sigmas_m == pytest.approx([SIGMA_M, SIGMA_M])
    state.shape_sigmas_m[2] = 3e-3
    problem = log.problem(state, start_prior((0.1, 0.1, 0.1), (0.01,) * 4, 4))
    assert problem.range_sigmas_m == pytest.approx([SIGMA_M, math.hypot(SIGMA_M, 3e-3)])
    near = landmarks_in_view(
        state, view(state, antennas()), [0, 1], WIDE, ContinuationRule(view_margin_rad=math.pi)
    )
    assert near is not None
    added = near.with_added_sigma(state.feature_shape_sigmas_m).prior - near.prior
    assert added == pytest.approx(np.diag(np.where(near.rows.landmarks == 1, 9e-6, 0.0)))
    state.remove(1)
    assert state.radii_m == {}
    assert state.shape_sigmas_m == {}


def test_a_radius_that_the_whole_run_contradicts_is_not_given() -> None:
    """Rods, one of them taken for a drum: the solution over all poses is dearer."""
    back_end, _ = drive(RODS, 0, WheelNoise())
    state, log = back_end.state, back_end._log
    before = state.landmarks_m.copy()
    assert not give_radius(log, state, back_end.parameters, (0, 0.1), 0.0)
    assert state.radii_m == {}
    assert np.array_equal(state.landmarks_m, before)


def test_echoes_that_overlap_tell_no_radius() -> None:
    scan = RangeScan(radar=0, ranges_m=(0.5, 0.58, 0.9, 1.2), blurred_m=(1.25,))
    assert [scan.is_alone(i) for i in range(4)] == [False, False, True, False]
    unassigned = UnassignedRanges(3, 4, SIGMA_M, 0.0, 0.0)
    unassigned.keep(0, antennas_of(paper_rig(), [scan], np.zeros(3)), [scan], {(0, 1)})
    left = unassigned.sightings(np.array([(0, 0, 0), (0, 0, 2), (0, 0, 3)]), np.zeros(4))
    assert left.alone.tolist() == [False, True, False]
    assert len(unassigned.newest(0)) == 3

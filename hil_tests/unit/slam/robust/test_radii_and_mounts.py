"""Radii of landmarks and places of antennas are unknowns like others."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import chdtri

from hil_tests.property.robust_oracles import rows_of
from slam.config import WheelNoise
from slam.geometry import paper_rig, transform
from slam.library.evaluation import nees_pose
from slam.robust.association import RangeScan, antennas_of, find_known, view
from slam.robust.back_end import RobustBackEnd
from slam.robust.initialisation import (
    BodyPoint,
    PointDetection,
    TentativePoint,
    initialise_landmark,
    median_radius,
    point_rows,
)
from slam.robust.map import apply_merge
from slam.robust.parameters import BackEndParameters, RangeNoise
from slam.robust.state import HEAD_SIZE, State, SymmetricMatrix, rotation

Array = NDArray[np.float64]

SIGMA_M, STEP_M, RADIUS_SIGMA_M, MOUNT_SIGMA_M = 2e-3, 0.01, 0.03, 5e-3
DRUM = (0.7, 0.85, 0.1)
FAR_PILLAR = (0.7, 2.2, 0.12)
RODS = ((0.1, 0.9, 0.0), (0.4, -0.9, 0.0), (1.0, -0.7, 0.0), (1.25, 1.1, 0.0))
CLASSROOM = WheelNoise(
    scale_sigma=0.023, turn_scale_sigma=0.023, curvature_sigma_rad_per_m=0.0139,
    heading_rad_per_sqrt_m=0.0042,
)  # fmt: skip
WIDE = RangeNoise(
    sigma_m=SIGMA_M, detection_probability=0.98, clutter_per_m=0.02,
    mount_sigma_m=MOUNT_SIGMA_M, radius_sigma_m=RADIUS_SIGMA_M, max_range_m=3.0,
)  # fmt: skip


def drive(
    targets: Sequence[tuple[float, float, float]],
    seed: int,
    wheels: WheelNoise,
    *,
    mounts_m: float = 0.0,
) -> tuple[RobustBackEnd, Array, float]:
    """Drive 1.4 m along x past (x, y, radius); return back end, true mounts, and the last NEES.

    Wheels err by their standard deviations, and antennas are ``mounts_m`` from where they should.
    """
    rng = np.random.default_rng(seed)
    back_end = RobustBackEnd(paper_rig(), BackEndParameters(wheels=wheels, ranges=WIDE))
    scale = 1.0 + wheels.scale_sigma * rng.standard_normal()
    curvature = wheels.curvature_sigma_rad_per_m * rng.standard_normal()
    moved = mounts_m * rng.standard_normal((len(paper_rig().mounts), 2))
    for k in range(1, 141):
        scans = []
        for radar, mount in enumerate(paper_rig().mounts):
            heard = []
            for x, y, radius_m in targets:
                dx = x - k * STEP_M - mount.x_m - moved[radar, 0]
                dy = y - mount.y_m - moved[radar, 1]
                off = math.remainder(math.atan2(dy, dx) - mount.yaw_rad, math.tau)
                range_m = math.hypot(dx, dy) - radius_m
                if abs(off) < math.radians(32.5) and range_m < WIDE.max_range_m:
                    heard.append(range_m + SIGMA_M * float(rng.standard_normal()))
            scans.append(RangeScan(radar=radar, ranges_m=tuple(heard)))
        back_end.predict(np.array([scale * STEP_M, 0.0, curvature * STEP_M]))
        back_end.update(scans)
    truth = np.array([k * STEP_M, 0.0, 0.0])
    return back_end, moved, nees_pose(back_end.pose, back_end.pose_covariance, truth)


def test_a_drum_is_mapped_at_its_axis_as_surely_as_it_says() -> None:
    """Normalised squared errors of (axis, radius), 3 dof, and of the pose, over 6 runs."""
    squares, poses = [], []
    for seed in range(6):
        back_end, _, nees = drive([DRUM, *RODS], seed, WheelNoise())
        state = back_end.state
        away = np.hypot(*(state.landmarks_m - DRUM[:2]).T)
        row = int(away.argmin())
        at = state.layout.columns(np.array([row]))
        T = state.additive_transform()
        P = (T @ state.P.full() @ T.T)[np.ix_(at, at)]
        error = np.append(state.landmarks_m[row], state.radii_m[row]) - DRUM
        squares.append(float(error @ np.linalg.solve(P, error)))
        poses.append(nees)
        assert abs(error[2]) < 0.05
    # The prior of the radius is three times too narrow for this drum.
    assert np.mean(squares) < chdtri(3 * 6, 1e-3) / 6 + (DRUM[2] / RADIUS_SIGMA_M) ** 2
    assert np.mean(poses) < chdtri(3 * 6, 1e-3) / 6


def test_of_a_far_pillar_the_radius_is_known_to_no_millimetre() -> None:
    """Wheels that are off by one deviation explain the ranges of a thin one nearly as well."""
    squares, sigmas = [], []
    for seed in range(6):
        back_end, _, _ = drive([FAR_PILLAR], seed, WheelNoise())
        state = back_end.state
        (row,) = range(len(state.landmark_ids))
        (at,) = state.layout.columns(np.array([row]))[2:]
        sigmas.append(math.sqrt(state.P.block(np.array([at]))[0, 0]))
        squares.append(((state.radii_m[row] - FAR_PILLAR[2]) / sigmas[-1]) ** 2)
    assert np.mean(squares) < chdtri(6, 1e-3) / 6
    assert min(sigmas) > 0.02
    assert max(sigmas) < 0.15


@pytest.mark.parametrize("mounts_m", [pytest.param(0.0, marks=pytest.mark.rare), MOUNT_SIGMA_M])
def test_wheels_and_mounts_that_err_leave_the_pose_consistent(mounts_m: float) -> None:
    poses, mounts = [], []
    for seed in range(6):
        back_end, moved, nees = drive(RODS, 10 + seed, CLASSROOM, mounts_m=mounts_m)
        state = back_end.state
        at = np.arange(state.layout.mounts.start, state.layout.mounts.stop)
        error = (state.mounts_m - moved).ravel()
        mounts.append(float(error @ np.linalg.solve(state.P.block(at), error)) / len(error))
        poses.append(nees)
        assert len(back_end.reported_rows()) >= 3
    assert np.mean(poses) < chdtri(3 * 6, 1e-3) / 6
    assert np.mean(mounts) < chdtri(8 * 6, 1e-3) / 48


def state_with_map() -> State:
    """Return a state of two landmarks and a wall, everything correlated."""
    rng = np.random.default_rng(2)
    state = State((0.01,) * 3, (0.01,) * 4, MOUNT_SIGMA_M, RADIUS_SIGMA_M)
    for point in ([0.8, 1.0], [1.2, -0.7]):
        state.augment(np.array(point), np.zeros((state.P.size, 3)), 0.01 * np.eye(3))
    state.augment_wall(np.array([0.2, 1.4]), np.zeros((state.P.size, 2)), 0.01 * np.eye(2))
    state.P.subtract_gram(1e-3 * rng.standard_normal((state.P.size, 5)))
    state.radii_m[:] = 0.03, 0.08
    state.mounts_m = 0.01 * rng.standard_normal((4, 2))
    state.heading_rad = 0.3
    state.position_m = np.array([0.1, -0.2])
    return state


def test_rows_of_ranges_are_derivatives_by_mounts_and_radii() -> None:
    state = state_with_map()
    scans = [RangeScan(radar=0, ranges_m=(), moved=(0.01, 0.0, 0.3))]
    radars, landmarks = np.array([0, 1, 2, 3, 0]), np.array([0, 1, 1, 2, 2])

    def predicted() -> Array:
        antennas = antennas_of(paper_rig(), scans, state.calibration, state.mounts_m)
        return rows_of(state, view(state, antennas), radars, landmarks).predicted_m

    antennas = antennas_of(paper_rig(), scans, state.calibration, state.mounts_m)
    rows = rows_of(state, view(state, antennas), radars, landmarks)
    H = np.zeros((5, state.P.size))
    H[:, rows.at] = rows.H
    layout = state.layout
    for column in (*range(layout.mounts.start, layout.mounts.stop), 20, 23):
        sides = []
        for sign in (1.0, -1.0):
            error = np.zeros(state.P.size)
            error[column] = sign * 1e-6
            state.correct(error)
            sides.append(predicted())
            state.correct(-error)
        assert H[:, column] == pytest.approx((sides[0] - sides[1]) / 2e-6, abs=1e-6)
    assert H[:3, 20] == pytest.approx(np.array([-1.0, 0.0, 0.0]))
    assert H[:3, 23] == pytest.approx(np.array([0.0, -1.0, -1.0]))


def test_the_rows_of_known_ranges_are_these() -> None:
    """A landmark on either side and a wall on the left, each heard by both radars there."""
    state, rig = state_with_map(), paper_rig()
    state.landmarks_m = state.position_m + [[0.0, 0.8], [0.0, -0.9]] @ rotation(0.3).T
    phi = 0.3 + math.pi / 2
    normal = np.array([math.cos(phi), math.sin(phi)])
    state.walls = np.array([[phi, float(normal @ state.position_m) + 1.2]])
    state.P = SymmetricMatrix(1e-4 * state.P.full())
    features = {0: (0, 2), 1: (0, 2), 2: (1,), 3: (1,)}
    moved = [
        RangeScan(radar=radar, ranges_m=(), moved=(0.01, 0.0, 0.1 * radar)) for radar in features
    ]
    antennas = antennas_of(rig, moved, state.calibration, state.mounts_m)
    seen = view(state, antennas)
    scans = [
        replace(scan, ranges_m=tuple(seen.ranges_m[scan.radar, list(features[scan.radar])]))
        for scan in moved
    ]
    known = find_known(state, seen, scans, np.array([0, 0, 1, 1]), BackEndParameters())
    assert len(known.assigned) == 6
    rows = rows_of(state, seen, known.assigned[:, 0], known.rows[known.assigned[:, 2]])
    H, expected = np.zeros((2, 6, state.P.size))
    H[:, known.at], expected[:, rows.at] = known.H, rows.H
    assert np.array_equal(H, expected)


def test_a_new_landmark_stands_behind_its_surface_by_a_radius_unknown() -> None:
    state = state_with_map()
    outward = np.array([0.6, 0.8])
    point = BodyPoint(
        point_m=np.array([0.5, 0.9]),
        covariance=1e-6 * np.eye(2),
        by_offsets=np.random.default_rng(1).standard_normal((2, 12)),
        outward=outward,
    )
    id_ = initialise_landmark(state, point)
    row = state.landmark_ids.index(id_)
    rows = point_rows(state, row, point)
    assert rows.residual == pytest.approx(np.zeros(2), abs=1e-12)
    # The point again has its own noise twice; all else, known or not, it has in common.
    assert pytest.approx(2e-6 * np.eye(2), abs=1e-9) == rows.S
    at = state.layout.columns(np.array([row]))
    assert math.sqrt(state.P.block(at)[2, 2]) == pytest.approx(RADIUS_SIGMA_M)
    assert state.walls.tolist() == [[0.2, 1.4]]


def test_of_a_new_landmark_whose_radius_is_shown_the_axis_is_known() -> None:
    state, outward = state_with_map(), np.array([0.6, 0.8])
    point = BodyPoint(
        point_m=np.array([0.5, 0.9]),
        covariance=1e-6 * np.eye(2),
        by_offsets=np.zeros((2, 12)),
        outward=outward,
    )
    row = state.landmark_ids.index(initialise_landmark(state, point, (0.3, 0.02)))
    axis_m = transform(state.pose, point.point_m + 0.3 * outward)
    assert state.landmarks_m[row] == pytest.approx(axis_m)
    assert state.radii_m[row] == pytest.approx(0.3)
    at = state.layout.columns(np.array([row]))
    assert math.sqrt(state.P.block(at)[2, 2]) == pytest.approx(0.02)
    rows = point_rows(state, row, point)
    assert rows.residual == pytest.approx(np.zeros(2), abs=1e-12)
    assert pytest.approx(2e-6 * np.eye(2), abs=1e-9) == rows.S


def seen_with(radii_m: list[float], sigma_m: float) -> TentativePoint:
    point = BodyPoint(point_m=np.zeros(2), covariance=np.eye(2), by_offsets=np.zeros((2, 4)))
    one = PointDetection(
        radar=0,
        label=None,
        pose=0,
        nominal_m=(0.0, 0.0),
        turn_rad=0.0,
        range_m=1.0,
        sigma_m=0.01,
        bearing_rad=0.0,
        bearing_sigma_rad=0.1,
    )
    seen = [replace(one, radius_m=radius_m, radius_sigma_m=sigma_m) for radius_m in radii_m]
    return TentativePoint(point=point, seen=seen)


def test_a_thin_radius_is_weighed_against_the_prior_and_a_thick_one_is_not() -> None:
    # One detection counts for as much as a tenth less than one.
    sigma_m = 0.03 * math.sqrt(1.1)
    weight = 0.03**2 / (0.03**2 + sigma_m**2)
    thin = seen_with([0.04], 0.03).radius(0.03)
    assert thin == pytest.approx((0.04 * weight, sigma_m * math.sqrt(weight)))
    behind = seen_with([-0.04], 0.03).radius(0.03)
    assert behind == pytest.approx((0.0, sigma_m * math.sqrt(weight)))
    assert seen_with([0.2], 0.03).radius(0.03) == pytest.approx((0.2, sigma_m))
    # Where none is shown there is the prior.
    assert seen_with([0.0], math.inf).radius(0.03) == pytest.approx((0.0, 0.03))


@pytest.mark.parametrize(("stated", "sigma"), [(0.04, 0.04), (0.01, 0.014826)])
def test_the_radius_of_many_detections_is_their_median(stated: float, sigma: float) -> None:
    """One of five is of something else; half of the others are within 0.01 of the median."""
    values = np.array([0.28, 0.29, 0.3, 0.31, 0.9])
    middle, found = median_radius(values, np.full(5, stated))
    assert middle == 0.3
    # Detections that know nothing do not count.
    vague = np.append(values, [0.0] * 6), np.append(np.full(5, stated), [1e3] * 6)
    assert median_radius(*vague) == (middle, found)
    assert found == pytest.approx(sigma * math.sqrt(1.0 / 5.0 + 1.0 / 10.0))


def test_a_merge_makes_one_axis_and_one_radius() -> None:
    state = state_with_map()
    full, layout = state.P.full(), state.layout
    at = layout.columns(np.array([0, 1]))
    e = np.concatenate([state.landmarks_m, state.radii_m[:, None]], axis=1).ravel()
    mean = e.copy()
    C = full[np.ix_(at, at)]
    D = np.hstack([np.eye(3), -np.eye(3)])
    mean -= C @ D.T @ np.linalg.solve(D @ C @ D.T, D @ mean)
    heading_rad = state.heading_rad
    apply_merge(state, ((0, 1),), 1e-6)
    assert state.heading_rad == pytest.approx(heading_rad, abs=0.1)
    assert len(state.landmark_ids) == len(state.radii_m) == 1
    assert state.radii_m[0] == pytest.approx(mean[2], abs=1e-3)
    assert state.P.size == layout.size - 3
    assert state.layout.walls.stop == state.P.size
    assert state.n_fixed == HEAD_SIZE + 12

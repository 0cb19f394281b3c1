"""Ranges of nothing known, where they cross, and what new landmarks are fitted to; weights."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil_tests.unit.slam.robust.range_world import (
    LAB,
    follow,
    parameters_for,
    reported,
    scans_of,
    true_path,
)
from slam.config import WheelNoise
from slam.geometry import Rig, compose, paper_rig
from slam.robust import kernels
from slam.robust.association import RangeScan, antennas_of
from slam.robust.back_end import RobustBackEnd
from slam.robust.initialisation import BodyPoint, UnassignedRanges, crossing
from slam.robust.parameters import BackEndParameters, InitialisationRule, RangeNoise
from slam.robust.state import Array, State, calibrated_motion

SIGMA_M = 5e-3
NOISE, RULE = RangeNoise(sigma_m=SIGMA_M), InitialisationRule()
PARAMETERS = BackEndParameters(ranges=NOISE, initialisation=RULE)
LEFT = (0, 1)
STEP_M, N_FRAMES = 0.02, 15
MOUNTS_M = np.array([(mount.x_m, mount.y_m) for mount in paper_rig().mounts])


def state_of(offset_sigma_m: float = 0.0, mount_sigma_m: float = 0.0) -> State:
    return State((0.0, 0.0, 0.0), (offset_sigma_m,) * 4, mount_sigma_m, 0.0)


def driven(targets: Array, offsets_m: Array, *, moving: bool = False) -> UnassignedRanges:
    """Return 15 frames of 2 cm past targets on the left; moving ones go with the robot."""
    rng = np.random.default_rng(1)
    unassigned = UnassignedRanges(PARAMETERS)
    step = calibrated_motion(np.array([STEP_M, 0.0, 0.0]), np.zeros(3), WheelNoise())
    for k in range(N_FRAMES):
        unassigned.move(step)
        body = targets - [0.0 if moving else STEP_M * k, 0.0]
        scans = [
            RangeScan(
                radar=radar,
                ranges_m=tuple(
                    float(np.hypot(*(target - MOUNTS_M[radar])))
                    + float(offsets_m[radar])
                    + SIGMA_M * rng.standard_normal()
                    for target in body
                ),
            )
            for radar in LEFT
        ]
        unassigned.keep(k, antennas_of(paper_rig(), scans, np.zeros(3)), scans, set())
    return unassigned


WAY = np.array([STEP_M * (N_FRAMES - 1), 0.0])
"""What targets move by in the body frame, while `driven`."""


def near(point_m: Array, sigma_m: float = 0.03, by_offsets: Array | None = None) -> BodyPoint:
    """Return a point that is known to so much only."""
    return BodyPoint(
        point_m=np.asarray(point_m),
        covariance=sigma_m**2 * np.eye(2),
        by_offsets=np.zeros((2, 4)) if by_offsets is None else by_offsets,
    )


def test_ranges_of_a_point_put_it_where_it_is_and_are_used_up() -> None:
    target = np.array([[0.15, 0.9]])
    unassigned = driven(target, np.zeros(4))
    true = target[0] - WAY
    found = unassigned.fit(near(np.add(true, [0.02, -0.02])), LEFT, state_of())
    assert found is not None
    point, rows = found.point, found.rows
    assert not found.is_flat
    miss = point.point_m - true
    assert miss @ np.linalg.solve(point.covariance, miss) < 13.8
    assert np.all(np.linalg.eigvalsh(point.covariance) < 0.01**2)
    assert sorted(rows["pose"].tolist()) == sorted([*range(N_FRAMES)] * 2)
    assert found.n_frames == N_FRAMES
    unassigned.use_up(found)
    assert unassigned.newest(0) == unassigned.newest(1) == []
    assert unassigned.fit(near(true), LEFT, state_of()) is None


def test_ranges_of_what_goes_with_the_robot_are_of_no_point_at_rest() -> None:
    fixed = np.array([[0.0, 0.9]])
    for offset_sigma_m in (0.0, 0.02):
        unassigned = driven(fixed, np.zeros(4), moving=True)
        assert unassigned.fit(near(fixed[0]), LEFT, state_of(offset_sigma_m)) is None


def test_of_two_points_each_has_its_own_ranges() -> None:
    targets = np.array([[0.1, 0.8], [0.25, 0.9]])
    unassigned = driven(targets, np.zeros(4))
    for target in targets:
        true = target - WAY
        found = unassigned.fit(near(np.add(true, 0.01), 0.02), LEFT, state_of())
        assert found is not None
        assert len(found.rows) == 2 * N_FRAMES
        assert found.point.point_m == pytest.approx(true, abs=0.01)


def test_unknown_offsets_are_fitted_with_the_point() -> None:
    """Both radars 30 mm off in opposite directions: no point at rest, unless that may be."""
    target, offsets = np.array([[0.15, 0.6]]), np.array([0.03, -0.03, 0.0, 0.0])
    true = target[0] - WAY
    assert driven(target, offsets).fit(near(true), LEFT, state_of()) is None
    found = driven(target, offsets).fit(near(true, 0.3), LEFT, state_of(0.02))
    assert found is not None
    point = found.point
    corrected = point.point_m + point.by_offsets @ offsets
    assert np.hypot(*(corrected - true)) < 0.2 * np.hypot(*(point.point_m - true))


FEW = 10
"""Frames of a wall that are of a point as well, for all that ranges tell."""


def ranged(ranges_of: Callable[[Array], float]) -> tuple[UnassignedRanges, Array, Array]:
    """Return a few frames of exact ranges on a straight way, where they were taken, and them."""
    parameters = replace(PARAMETERS, wheels=WheelNoise(scale_sigma=0.0))
    unassigned, places, ranges = UnassignedRanges(parameters), list[Array](), list[float]()
    step = calibrated_motion(np.array([STEP_M, 0.0, 0.0]), np.zeros(3), WheelNoise())
    for k in range(FEW):
        unassigned.move(step)
        at = np.add(MOUNTS_M, [STEP_M * k, 0.0])
        scans = [RangeScan(radar=radar, ranges_m=(ranges_of(at[radar]),)) for radar in LEFT]
        unassigned.keep(k, antennas_of(paper_rig(), scans, np.zeros(3)), scans, set())
        places += [at[radar] for radar in LEFT]
        ranges += [scan.ranges_m[0] for scan in scans]
    return unassigned, np.array(places), np.array(ranges)


def test_what_a_straight_line_fits_as_well_is_a_wall() -> None:
    """Of a point the line leaves what `numpy.polyfit` leaves of its ranges over the way."""
    depth_m, way_m = 0.6, STEP_M * (FEW - 1)
    point = np.array([0.1, depth_m])
    unassigned, places, ranges_m = ranged(lambda at: float(np.hypot(*(point - at))))
    found = unassigned.fit(near(point - [way_m, 0.0]), LEFT, state_of())
    assert found is not None
    line = np.polyval(np.polyfit(places[:, 0], ranges_m, 1), places[:, 0])
    left = float(np.sum(np.square(ranges_m - line))) / SIGMA_M**2
    assert found.chi_square == pytest.approx(0.0, abs=1e-6)
    assert found.chi_square_of_wall == pytest.approx(left, rel=1e-6)
    assert left > 1.0
    assert not found.is_flat

    unassigned, places, _ = ranged(lambda at: float(3.0 * depth_m - at[1]))
    foot = np.array([places[:, 0].mean() - way_m, 3.0 * depth_m])
    found = unassigned.fit(near(foot, 0.3), LEFT, state_of(0.02))
    assert found is not None
    assert found.chi_square_of_wall == pytest.approx(0.0, abs=1e-6)
    assert found.is_flat


@pytest.mark.parametrize(("n_frames", "is_point"), [(20, True), (11, False)])
def test_a_point_hits_most_frames_that_have_it_in_view(n_frames: int, is_point: bool) -> None:
    """Of twenty frames; six in ten are asked for."""
    unassigned, target = UnassignedRanges(PARAMETERS), np.array([0.0, 0.9])
    for k in range(20):
        ranges = [(range_after(0.0, radar, target),) if k < n_frames else () for radar in LEFT]
        scans = [RangeScan(radar=radar, ranges_m=ranges[radar]) for radar in LEFT]
        unassigned.keep(k, antennas_of(paper_rig(), scans, np.zeros(3)), scans, set())
    assert (unassigned.fit(near(target), LEFT, state_of()) is not None) == is_point


def test_ranges_of_what_is_round_end_at_its_surface() -> None:
    """Exact ones of a cylinder: the point is where a line from the antennas to its axis enters."""
    radius_m, axis = 0.1, np.array([0.1, 0.8])
    unassigned, places, _ = ranged(lambda at: float(np.hypot(*(axis - at))) - radius_m)
    back = np.array([STEP_M * (FEW - 1), 0.0])
    outward = axis - places.mean(axis=0)
    outward /= np.hypot(*outward)
    surface = axis - radius_m * outward - back
    guess = replace(near(np.add(surface, [0.005, -0.005])), outward=outward)
    found = unassigned.fit(guess, LEFT, state_of(), radius_m=radius_m)
    assert found is not None
    assert found.point.point_m == pytest.approx(surface, abs=1e-3)
    assert found.point.outward == pytest.approx(outward, abs=1e-3)
    as_thin = unassigned.fit(guess, LEFT, state_of())
    assert as_thin is None or as_thin.chi_square > 10.0 * found.chi_square


def test_unknown_places_of_antennas_move_the_point_as_they_do() -> None:
    """By differences of points, from ranges that antennas elsewhere took while the robot turned."""
    target, turn_rad, step_m = np.array([0.1, 0.8]), 0.3, 1e-5
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    turned = np.array([[c, -s], [s, c]])

    def fitted(error_m: Array) -> BodyPoint:
        """Return the point if the second antenna is mounted so far from its place."""
        mounts = MOUNTS_M.copy()
        mounts[1] += error_m
        unassigned = UnassignedRanges(replace(PARAMETERS, wheels=WheelNoise(scale_sigma=0.0)))
        step = calibrated_motion(np.array([STEP_M, 0.0, 0.0]), np.zeros(3), WheelNoise())
        for k in range(N_FRAMES):
            if k:
                unassigned.move(step)
            scans = [
                RangeScan(
                    radar=radar,
                    ranges_m=(
                        float(np.hypot(*(target - turned @ mounts[radar] - [STEP_M * k, 0.0]))),
                    ),
                    moved=(0.0, 0.0, turn_rad),
                )
                for radar in LEFT
            ]
            unassigned.keep(k, antennas_of(paper_rig(), scans, np.zeros(3)), scans, set())
        found = unassigned.fit(
            near(target - WAY, 0.03, np.zeros((2, 12))),
            LEFT,
            state_of(1e-5, 1e-3),
            is_of_ranges=True,
        )
        assert found is not None
        return found.point

    exact = fitted(np.zeros(2))
    for axis, error_m in enumerate(step_m * np.eye(2)):
        moved = (fitted(error_m).point_m - exact.point_m) / step_m
        assert -moved == pytest.approx(exact.by_offsets[:, 6 + axis], rel=0.05, abs=0.01)


TURNS_RAD = 0.05 * np.arange(12)
"""Of a robot that turns on the spot, frame by frame."""


def range_after(turn_rad: float, radar: int, target: Array) -> float:
    mount = paper_rig().mounts[radar]
    antenna = compose(np.array([0.0, 0.0, turn_rad]), np.array([mount.x_m, mount.y_m, 0.0]))
    return float(np.hypot(*(target - antenna[:2])))


def test_ranges_from_before_a_turn_are_less_sure_by_the_drift_per_radian() -> None:
    """Closed form: of exact ranges, the information of all, each with its own variance."""
    wheels, prior_m = WheelNoise(scale_sigma=0.05, walk_lever_m=0.5), 0.05
    drift_per_rad_m = RULE.drift_share * wheels.scale_sigma * wheels.walk_lever_m
    target = np.array([-0.2, 1.0])
    unassigned = UnassignedRanges(replace(PARAMETERS, wheels=wheels))
    step = calibrated_motion(np.array([0.0, 0.0, TURNS_RAD[1]]), np.zeros(3), wheels)
    for k, turn_rad in enumerate(TURNS_RAD):
        if k:
            unassigned.move(step)
        scans = [
            RangeScan(radar=radar, ranges_m=(range_after(turn_rad, radar, target),))
            for radar in LEFT
        ]
        unassigned.keep(k, antennas_of(paper_rig(), scans, np.zeros(3)), scans, set())
    c, s = np.cos(TURNS_RAD[-1]), np.sin(TURNS_RAD[-1])
    body = np.array([[c, s], [-s, c]]) @ target
    found = unassigned.fit(near(body, prior_m), LEFT, state_of())
    assert found is not None
    point, rows = found.point, found.rows
    assert len(rows) == 2 * len(TURNS_RAD)
    turns_rad = TURNS_RAD[rows["pose"]]
    mounts = MOUNTS_M[rows["radar"]]
    back = turns_rad - TURNS_RAD[-1]
    turned = np.array([[np.cos(back), -np.sin(back)], [np.sin(back), np.cos(back)]])
    away = body - np.einsum("ijk,kj->ki", turned, mounts)
    u = away / np.hypot(*away.T)[:, np.newaxis]
    variances = SIGMA_M**2 + (drift_per_rad_m * back) ** 2
    information = np.eye(2) / prior_m**2 + (u / variances[:, np.newaxis]).T @ u
    assert point.point_m == pytest.approx(body, abs=1e-9)
    assert point.covariance == pytest.approx(np.linalg.inv(information), rel=1e-6)


@pytest.mark.parametrize("mount_sigma_m", [0.0, 5e-3])
def test_two_ranges_cross_where_their_target_is(mount_sigma_m: float) -> None:
    """Covariance and derivatives by differences of crossings; one radar was turned meanwhile."""
    target, sigmas = np.array([0.15, 0.9]), (4e-3, 6e-3)
    state = state_of(0.01, mount_sigma_m)
    turn_rad = 0.1

    def cross(errors: Array) -> BodyPoint:
        """Return the crossing of two ranges, with errors of them and of the second's mount."""
        scans = [
            RangeScan(radar=0, ranges_m=()),
            RangeScan(radar=1, ranges_m=(), moved=(0.0, 0.0, turn_rad)),
        ]
        c, s = math.cos(turn_rad), math.sin(turn_rad)
        places = [MOUNTS_M[0], np.array([[c, -s], [s, c]]) @ MOUNTS_M[1]]
        antennas = antennas_of(paper_rig(), scans, np.zeros(3), mounts_moved(errors[2:]))
        ranges = [
            (radar, float(np.hypot(*(target - places[radar]))) + errors[radar], sigmas[radar])
            for radar in LEFT
        ]
        ((_, point),) = crossing(state, antennas, ranges, PARAMETERS, 0)
        return point

    def mounts_moved(second: Array) -> Array:
        return np.array([(0.0, 0.0), second, (0.0, 0.0), (0.0, 0.0)])

    exact = cross(np.zeros(4))
    assert exact.point_m == pytest.approx(target, abs=1e-9)
    step = 1e-6
    by_errors = np.column_stack(
        [(cross(step * one).point_m - cross(-step * one).point_m) / (2 * step) for one in np.eye(4)]
    )
    # What is measured too long by an offset is put right by subtracting it.
    assert exact.by_offsets[:, :2] == pytest.approx(-by_errors[:, :2], rel=1e-5)
    unknown = 0.01**2 * by_errors[:, :2] @ by_errors[:, :2].T
    if mount_sigma_m:
        assert exact.by_offsets[:, 6:8] == pytest.approx(by_errors[:, 2:], rel=1e-5)
        of_mounts = exact.by_offsets[:, 4:]
        unknown = unknown + mount_sigma_m**2 * of_mounts @ of_mounts.T
    noise = (by_errors[:, :2] * np.square(sigmas)) @ by_errors[:, :2].T
    assert exact.covariance == pytest.approx(noise + unknown, rel=1e-4)


def test_ranges_that_do_not_cross_in_view_have_no_point() -> None:
    antennas = antennas_of(
        paper_rig(), [RangeScan(radar=radar, ranges_m=()) for radar in range(4)], np.zeros(3)
    )
    state, reach_m = state_of(), 1.0
    apart_m = 2.0  # the radars of a side are less far apart
    for radars, ranges_m in (((0, 1), (reach_m, reach_m + apart_m)), ((0, 2), (0.2, 0.2))):
        ranges = [(radar, m, SIGMA_M) for radar, m in zip(radars, ranges_m, strict=True)]
        assert crossing(state, antennas, ranges, PARAMETERS, 0) == []


def test_where_ranges_cross_scan_after_scan_there_is_a_landmark() -> None:
    """It has all ranges of before, once: those that led to it are not in the map twice."""
    back_end = RobustBackEnd(paper_rig(), PARAMETERS)
    target = np.array([0.15, 0.9])
    for k in range(N_FRAMES):
        back_end.predict(np.array([STEP_M if k else 0.0, 0.0, 0.0]))
        scans = [
            RangeScan(
                radar=radar,
                ranges_m=(range_after(0.0, radar, target - [STEP_M * k, 0.0]),),
            )
            for radar in LEFT
        ]
        back_end.update(scans)
        if k == RULE.min_frames - 2:
            assert not back_end.state.landmark_ids
        if back_end.state.landmark_ids:
            assert not any(waiting.unclear() for waiting in back_end._crossings)
    assert back_end._unassigned.fit(near(target - WAY), LEFT, back_end.state) is None
    (landmark_id,) = back_end.state.landmark_ids
    assert back_end.state.landmarks_m[0] == pytest.approx(target, abs=1e-3)
    assert back_end.n_reported_since(landmark_id) == 1
    assert len(back_end._log._ranges) == len(LEFT) * N_FRAMES  # each of them once
    poses = back_end.smoothed(np.arange(N_FRAMES - 1))
    assert poses is not None
    assert poses.landmarks_m[0] == pytest.approx(target, abs=1e-3)


def test_a_new_landmark_is_worth_the_densities_of_its_ranges_over_those_of_false_ones() -> None:
    """On the spot and with exact ranges: the logarithms of N(0; 0, S) and Pd / lambda of each."""
    wheels = WheelNoise(scale_sigma=0.05, walk_lever_m=0.5)
    back_end = RobustBackEnd(paper_rig(), replace(PARAMETERS, wheels=wheels))
    per_rad_m = RULE.drift_share * wheels.scale_sigma * wheels.walk_lever_m
    per_m = max(NOISE.clutter_per_m, 1.0 / (NOISE.max_range_m - NOISE.min_range_m))
    target = np.array([-0.2, 1.0])
    for k, turn_rad in enumerate(TURNS_RAD):
        back_end.predict(np.array([0.0, 0.0, TURNS_RAD[1] if k else 0.0]))
        report = back_end.update(
            [
                RangeScan(radar=radar, ranges_m=(range_after(turn_rad, radar, target),))
                for radar in LEFT
            ]
        )
        if report.evidence:
            break
    ((landmark_id, nats),) = report.evidence
    assert back_end.state.landmark_ids == [landmark_id]
    since = turn_rad - TURNS_RAD[: k + 1]
    variances = np.repeat(SIGMA_M**2 + (per_rad_m * since) ** 2, len(LEFT))
    expected = -0.5 * np.log(2.0 * math.pi * variances)
    expected += math.log(NOISE.detection_probability / per_m)
    assert nats == pytest.approx(float(expected.sum()), abs=1e-3)


@pytest.mark.parametrize("step_m", [0.0, 0.02])
def test_ranges_of_a_wall_make_no_landmark(step_m: float) -> None:
    """From where it stands, and on its way, as its echo comes from where the wall is nearest."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        back_end = RobustBackEnd(paper_rig(), PARAMETERS)
        for _ in range(40):
            back_end.predict(np.array([step_m, 0.0, 0.0]))
            depths_m = [0.9 - paper_rig().mounts[radar].y_m for radar in LEFT]
            scans = [
                RangeScan(radar=radar, ranges_m=(m + SIGMA_M * rng.standard_normal(),))
                for radar, m in zip(LEFT, depths_m, strict=True)
            ]
            back_end.update(scans)
        assert not back_end.state.landmark_ids


def test_radars_that_get_images_begin_no_landmark_of_ranges_any_more() -> None:
    target = np.array([0.0, 0.9])
    for imaged in ((0, 1), (1,)):
        back_end = RobustBackEnd(paper_rig(), PARAMETERS)
        for k in range(2 * N_FRAMES):
            back_end.predict(np.array([STEP_M if k else 0.0, 0.0, 0.0]))
            late = k >= RULE.min_frames - 1
            back_end.update(
                [
                    RangeScan(
                        radar=radar,
                        ranges_m=(range_after(0.0, radar, target - [STEP_M * k, 0.0]),),
                        is_imaged=late and radar in imaged,
                    )
                    for radar in LEFT
                ]
            )
        assert not back_end.state.landmark_ids


def test_exact_ranges_without_a_standard_deviation_are_taken() -> None:
    back_end, target = RobustBackEnd(paper_rig(), PARAMETERS), np.array([0.15, 0.9])
    for k in range(N_FRAMES):
        back_end.predict(np.array([STEP_M if k else 0.0, 0.0, 0.0]))
        at = target - [STEP_M * k, 0.0]
        back_end.update(
            [
                RangeScan(radar=radar, ranges_m=(range_after(0.0, radar, at),), sigmas_m=(0.0,))
                for radar in LEFT
            ]
        )
    assert back_end.state.landmarks_m[0] == pytest.approx(target, abs=1e-3)


def test_of_three_radars_two_that_see_a_target_suffice() -> None:
    one, two, *others = paper_rig().mounts
    rig = Rig(mounts=(one, two, replace(one, name="middle", x_m=(one.x_m + two.x_m) / 2), *others))
    target = np.array([0.0, 0.9])
    for silent in range(3):
        back_end = RobustBackEnd(rig, PARAMETERS)
        for k in range(N_FRAMES):
            back_end.predict(np.array([STEP_M if k else 0.0, 0.0, 0.0]))
            places = [(mount.x_m + STEP_M * k, mount.y_m) for mount in rig.mounts[:3]]
            ranges_m = [
                () if radar == silent else (float(np.hypot(*(target - place))),)
                for radar, place in enumerate(places)
            ]
            back_end.update(
                [RangeScan(radar=radar, ranges_m=seen) for radar, seen in enumerate(ranges_m)]
            )
        assert len(back_end.state.landmark_ids) == 1


def test_walking_biases_are_as_uncertain_to_the_filter_as_to_the_smoother() -> None:
    rng = np.random.default_rng(2)
    poses = true_path(LAB)[:121]
    landmarks = np.array([[0.2, 1.0], [0.7, 0.8], [1.1, 0.9], [0.3, -0.9], [0.9, -1.1]])
    parameters = parameters_for(LAB, SIGMA_M, walk_per_sqrt_m=1.0)
    back_end = RobustBackEnd(paper_rig(), parameters)
    scans = scans_of(poses, landmarks, rng, SIGMA_M, clutter=False)
    list(follow(back_end, reported(poses, LAB, rng, 1.0), scans))
    at = np.arange(6)
    mean, sigmas = back_end.state.calibration, np.sqrt(np.diag(back_end.state.P.block(at)))
    assert back_end.relinearise()
    again = np.sqrt(np.diag(back_end.state.P.block(at)))
    assert again == pytest.approx(sigmas, rel=0.1)
    assert (np.abs(back_end.state.calibration - mean) < 0.5 * sigmas[3:]).all()


positive = st.floats(1e-4, 1e-1)


def moved_by(nu: float, prior: float, sigma: float, huber: float) -> float:
    """Return how far a scalar state of a standard deviation is moved by an innovation."""
    one, variance = np.ones((1, 1)), np.array([sigma**2])
    P, at = np.full((1, 1), prior**2), np.zeros(1, dtype=np.intp)
    gain, weighted, _, _ = kernels.weigh(P, at, one, np.array([nu]), variance, huber, 1.0)
    return float(gain[0, 0] * weighted[0])


@given(prior=positive, sigma=positive, sigmas_off=st.floats(0.0, 2.0))
def test_near_its_prediction_or_without_a_bound_a_range_counts_in_full(
    prior: float, sigma: float, sigmas_off: float
) -> None:
    S = prior**2 + sigma**2
    nu = sigmas_off * math.sqrt(S) * (1 - 1e-9)
    for factor, bound in ((1.0, 2.0), (1e3, math.inf)):
        whole = factor * nu * prior**2 / S
        assert moved_by(factor * nu, prior, sigma, bound) == pytest.approx(whole, rel=1e-12)


@given(prior=positive, sigma=positive, sigmas_off=st.floats(2.0, 1e3))
def test_far_from_it_a_range_moves_the_state_no_further_than_at_the_bound(
    prior: float, sigma: float, sigmas_off: float
) -> None:
    """Closed form: a scalar state of variance p moves by nu p / S', which is 2 p / sqrt(S)."""
    S = prior**2 + sigma**2
    moved = moved_by(sigmas_off * math.sqrt(S), prior, sigma, 2.0)
    assert moved == pytest.approx(2.0 * prior**2 / math.sqrt(S), rel=1e-9)


def test_an_association_sigma_is_added_to_predicted_sigmas_only() -> None:
    scan = RangeScan(radar=0, ranges_m=(1.0, 2.0), sigmas_m=(3e-3, 4e-3))
    assert scan.with_added_sigma(4e-3).sigmas_m == pytest.approx((5e-3, np.sqrt(32) * 1e-3))
    assert scan.with_added_sigma(0.0) is scan
    untold = RangeScan(radar=0, ranges_m=(1.0,))
    assert untold.with_added_sigma(4e-3) is untold

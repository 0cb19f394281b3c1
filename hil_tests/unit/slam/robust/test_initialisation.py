"""Tracklets, initialisation from one radar, weights of ranges."""

import math
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
from slam.geometry import compose, paper_rig
from slam.robust import kernels
from slam.robust.association import RangeScan, antennas_of
from slam.robust.back_end import RobustBackEnd
from slam.robust.initialisation import (
    Guess,
    Search,
    Tracker,
    Tracklet,
    UnassignedRanges,
    point_guesses,
)
from slam.robust.parameters import BackEndParameters, RangeNoise, TrackletRule
from slam.robust.state import Array, calibrated_motion

SIGMA_M = 5e-3
NOISE, RULE = RangeNoise(sigma_m=SIGMA_M), TrackletRule()
PARAMETERS = BackEndParameters(ranges=NOISE, tracklets=RULE)
LEFT = (0, 1)
SEARCH = Search(radars=LEFT, window=15, min_frames=RULE.min_frames)


def driven(targets: Array, offsets_m: Array, *, moving: bool = False) -> UnassignedRanges:
    """Return 15 frames of 2 cm past targets on the left; moving ones go with the robot."""
    rng = np.random.default_rng(1)
    unassigned = UnassignedRanges(15, 4, SIGMA_M, 0.005, 0.0015)
    step = calibrated_motion(np.array([0.02, 0.0, 0.0]), np.zeros(3), WheelNoise())
    mounts = np.array([(mount.x_m, mount.y_m) for mount in paper_rig().mounts])
    for k in range(15):
        unassigned.move(step)
        body = targets - [0.0 if moving else 0.02 * k, 0.0]
        scans = [
            RangeScan(
                radar=radar,
                ranges_m=tuple(
                    float(np.hypot(*(target - mounts[radar])))
                    + float(offsets_m[radar])
                    + SIGMA_M * rng.standard_normal()
                    for target in body
                ),
            )
            for radar in LEFT
        ]
        unassigned.keep(k, antennas_of(paper_rig(), scans, np.zeros(3)), scans, set())
    return unassigned


def tracklets(unassigned: UnassignedRanges, offset_sigma_m: float = 0.0) -> list[Tracklet]:
    tracker = Tracker(PARAMETERS, np.zeros(4), offset_sigma_m**2 * np.eye(4))
    guesses = point_guesses(unassigned, LEFT, NOISE, RULE)
    return tracker.find(guesses, unassigned, SEARCH)


def test_a_tracklet_is_a_point_at_rest_and_uses_its_ranges_up() -> None:
    target = np.array([[0.15, 0.9]])
    unassigned = driven(target, np.zeros(4))
    (found,) = tracklets(unassigned)
    miss = found.target - (target[0] - [0.28, 0.0])
    assert miss @ np.linalg.solve(found.covariance, miss) < 13.8
    assert len(found.members) == 30
    assert all(unassigned.n_frames_with_ranges(radar, 15) == 0 for radar in LEFT)
    assert tracklets(unassigned) == []


def test_what_goes_with_the_robot_is_no_tracklet() -> None:
    fixed = np.array([[0.0, 0.9]])
    assert tracklets(driven(fixed, np.zeros(4), moving=True)) == []
    assert tracklets(driven(fixed, np.zeros(4), moving=True), 0.02) == []


def test_of_two_points_four_fixes_and_two_tracklets() -> None:
    targets = np.array([[0.1, 0.8], [0.25, 0.9]])
    unassigned = driven(targets, np.zeros(4))
    assert len(point_guesses(unassigned, LEFT, NOISE, RULE)) > 2
    found = sorted(tracklets(unassigned), key=lambda tracklet: float(tracklet.target[1]))
    assert len(found) == 2
    for tracklet, target in zip(found, targets, strict=True):
        assert tracklet.target == pytest.approx(target - [0.28, 0.0], abs=0.03)


def test_uncertain_offsets_cost_no_tracklet() -> None:
    """Both radars 30 mm off in opposite directions: no point at rest, unless that may be."""
    target, offsets = np.array([[0.15, 0.6]]), np.array([0.03, -0.03, 0.0, 0.0])
    assert tracklets(driven(target, offsets)) == []
    (found,) = tracklets(driven(target, offsets), 0.02)
    true = target[0] - [0.28, 0.0]
    corrected = found.target + found.by_offsets @ offsets
    assert np.hypot(*(corrected - true)) < 0.5 * np.hypot(*(found.target - true))


TURNS_RAD = 0.05 * np.arange(12)
"""Of a robot that turns on the spot, frame by frame."""


def range_after(turn_rad: float, radar: int, target: Array) -> float:
    mount = paper_rig().mounts[radar]
    antenna = compose(np.array([0.0, 0.0, turn_rad]), np.array([mount.x_m, mount.y_m, 0.0]))
    return float(np.hypot(*(target - antenna[:2])))


def test_ranges_from_before_a_turn_are_less_sure_by_the_drift_per_radian() -> None:
    """Closed form: of exact ranges, the information of all, each with its own variance."""
    drift_per_rad_m, prior_m = 0.02, 0.05
    target = np.array([-0.2, 1.0])
    unassigned = UnassignedRanges(15, 4, SIGMA_M, 0.0, drift_per_rad_m)
    step = calibrated_motion(np.array([0.0, 0.0, TURNS_RAD[1]]), np.zeros(3), WheelNoise())
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
    limits = [1.0, 1.0, 0.1, 9.0, 9.0]
    found, _, members, _ = unassigned.follow(
        Guess(target=body, covariance=prior_m**2 * np.eye(2)),
        SEARCH,
        np.zeros(4),
        np.zeros((4, 4)),
        limits,
    )
    assert len(members) == 2 * len(TURNS_RAD)
    seen = unassigned.sightings(members, np.zeros(4))
    since = TURNS_RAD[-1] - TURNS_RAD[seen.poses]
    variances = SIGMA_M**2 + (drift_per_rad_m * since) ** 2
    assert seen.variances == pytest.approx(variances, rel=1e-9)
    away = body - seen.antennas_m
    u = away / np.hypot(*away.T)[:, np.newaxis]
    information = np.eye(2) / prior_m**2 + (u / variances[:, np.newaxis]).T @ u
    (xx, xy), (_, yy) = np.linalg.inv(information)
    assert found[:2] == pytest.approx(body, abs=1e-9)
    assert found[2:5] == pytest.approx([xx, xy, yy], rel=1e-6)


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

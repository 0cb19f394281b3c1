"""Offsets, mounts and gains from made-up drives whose truth is known exactly."""

import math
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from hil_tests.unit.slam.robust.range_world import LAB, odometry_path, reported
from slam.calibration.calibration import (
    UNKNOWN_WHEELS,
    Calibration,
    CalibrationPriors,
    Drive,
    calibrate,
    make_drive,
)
from slam.calibration.observability import (
    estimate_gains,
    poor_drive,
    unseen_reflectors,
    weak_directions,
)
from slam.calibration.tracks import RangeSet, place
from slam.geometry import paper_rig

Array = NDArray[np.float64]

OFFSETS_M = np.array([0.020, -0.020, 0.012, -0.007])
GAINS_DB = np.array([1.5, -1.5, 0.5, -0.5])
RODS = np.array([[1.55, 0.6], [0.6, 1.7], [-0.8, 1.4], [-1.0, 0.2], [-0.1, -1.1], [1.2, -0.75]])
STEP_NS = 200_000_000
SQUARE = ((0.0, 0.0), (0.8, 0.0), (0.8, 0.8), (0.0, 0.8), (0.0, 0.0))
# two-way cosine power whose -3 dB width is 65 degrees (closed form)
BEAM = math.log(math.sqrt(0.5)) / math.log(math.cos(math.radians(32.5)))


def course(stops: tuple[tuple[float, float], ...], step_m: float = 0.02) -> Array:
    """Return poses along straight legs, turning on the spot by 8 degrees at most per pose."""
    poses = [np.array([*stops[0], 0.0])]
    for x, y in stops[1:]:
        here = poses[-1]
        away = math.atan2(y - here[1], x - here[0])
        turn = math.remainder(away - here[2], math.tau)
        n = math.ceil(abs(turn) / math.radians(8) - 1e-9)
        poses += [here + np.array([0.0, 0.0, turn * (k + 1) / n]) for k in range(n)]
        here = poses[-1]
        n = round(math.hypot(x - here[0], y - here[1]) / step_m)
        poses += [
            np.array([*(here[:2] + (np.array([x, y]) - here[:2]) * (k + 1) / n), here[2]])
            for k in range(n)
        ]
    return np.array(poses)


@dataclass(frozen=True, slots=True, kw_only=True)
class World:
    stops: tuple[tuple[float, float], ...] = SQUARE
    rods: Array = field(default_factory=RODS.copy)
    sigma_m: float = 0.0
    errs: bool = False  # whether the wheels have the lab's errors
    mount_errors_m: Array | None = None


def drive(world: World, seed: int = 0) -> Drive:
    random = np.random.default_rng(seed)
    true = course(world.stops)
    rig = paper_rig()
    t_ns = STEP_NS * np.arange(len(true))
    errors = np.zeros((4, 2)) if world.mount_errors_m is None else world.mount_errors_m
    rows = []
    for radar, mount in enumerate(rig.mounts):
        x, y, heading = true.T
        cosine, sine = np.cos(heading), np.sin(heading)
        mx, my = np.array([mount.x_m, mount.y_m]) + errors[radar]
        at = np.column_stack([x + cosine * mx - sine * my, y + sine * mx + cosine * my])
        away = world.rods[np.newaxis] - at[:, np.newaxis]
        distance = np.linalg.norm(away, axis=2)
        angle = np.arctan2(away[..., 1], away[..., 0]) - (heading + mount.yaw_rad)[:, np.newaxis]
        angle = np.remainder(angle + np.pi, 2 * np.pi) - np.pi
        gain = 10 ** (GAINS_DB[radar] / 20)
        for pose, rod in zip(*np.nonzero(np.abs(angle) < math.radians(50)), strict=True):
            r = distance[pose, rod]
            loud = 0.02 * gain * r**-1.5 * math.cos(angle[pose, rod]) ** BEAM
            rows.append((radar, t_ns[pose], r + OFFSETS_M[radar], loud))
    columns = np.array(sorted(rows, key=lambda row: (row[1], row[0], row[2])))
    noise = world.sigma_m * random.normal(size=len(columns))
    ranges = RangeSet(
        radar=columns[:, 0].astype(np.intp),
        t_ns=columns[:, 1].astype(np.int64),
        range_m=columns[:, 2] + noise,
        amplitude=columns[:, 3],
        sigma_m=np.full(len(columns), world.sigma_m or 1e-4),
    )
    odometry = odometry_path(reported(true, LAB, random, 0.0)) if world.errs else true
    return make_drive(rig, t_ns, odometry, ranges)


def words(of: Drive, found: Calibration) -> str:
    names = [mount.name for mount in of.rig.mounts]
    return "\n".join(weak.description for weak in weak_directions(found, names))


def test_exact_ranges_and_odometry_give_the_exact_offsets() -> None:
    exact = drive(World())
    # almost nothing known beforehand: a prior pulls, however little
    found = calibrate(exact, CalibrationPriors(offset_m=1.0, mount_m=0.1))
    np.testing.assert_allclose(found.offsets_m, OFFSETS_M, atol=1e-6)
    np.testing.assert_allclose(found.mount_shifts_m, 0.0, atol=1e-6)
    assert len(found.landmarks_m) == len(RODS)
    nearest = np.linalg.norm(found.landmarks_m[:, np.newaxis] - RODS, axis=2).min(axis=1)
    assert nearest.max() < 5e-6
    assert poor_drive(exact, found) == ()


def test_a_scale_that_is_known_stays_and_a_turn_scale_that_is_not_is_found() -> None:
    priors = CalibrationPriors(wheels=replace(UNKNOWN_WHEELS, scale_sigma=1e-9))
    found = calibrate(drive(World(errs=True)), priors)
    assert abs(found.wheels[0]) < 1e-7
    assert abs(found.wheels[1]) > 1e-4


def test_mounts_that_are_off_are_found_too() -> None:
    errors = np.array([[3.0, -2.0], [-1.0, 2.0], [0.0, 4.0], [2.0, 0.0]]) * 1e-3
    exact = drive(World(mount_errors_m=errors))
    found = calibrate(exact, CalibrationPriors(offset_m=1.0, mount_m=0.1))
    np.testing.assert_allclose(found.offsets_m, OFFSETS_M, atol=1e-6)
    np.testing.assert_allclose(found.mount_shifts_m, errors, atol=1e-6)


@pytest.mark.rare
def test_errors_are_as_large_as_the_stated_deviations() -> None:
    """Twelve drives: the mean square of error by deviation, four offsets each."""
    priors = CalibrationPriors(mount_m=1e-5)  # the mounts are exact here
    squares = []
    for seed in range(12):
        found = calibrate(drive(World(sigma_m=1.5e-3, errs=True), seed), priors)
        squares.append(((found.offsets_m - OFFSETS_M) / found.offset_sigmas_m) ** 2)
    # the four share most of their error: between 12 and 48 degrees of freedom; 0.1 % tails of 12
    assert 0.18 < float(np.mean(squares)) < 2.75


def test_known_reflectors_fix_the_map_and_tell_more() -> None:
    noisy = drive(World(sigma_m=1.5e-3, errs=True), 3)
    jointly, known = calibrate(noisy), calibrate(noisy, known_m=RODS)
    assert np.all(known.offset_sigmas_m < jointly.offset_sigmas_m)
    np.testing.assert_allclose(known.landmarks_m[: len(RODS)], RODS, atol=4e-3)
    assert np.abs(known.offsets_m - OFFSETS_M).max() < 4 * known.offset_sigmas_m.max()


def test_reflectors_of_another_room_are_told() -> None:
    noisy = drive(World(sigma_m=1.5e-3, errs=True), 3)
    elsewhere = RODS + 500.0
    found = calibrate(noisy, known_m=elsewhere)
    assert f"only 0 of {len(RODS)} known" in unseen_reflectors(found, len(elsewhere))[0]
    assert unseen_reflectors(calibrate(noisy, known_m=RODS), len(RODS)) == ()


def test_a_few_wrong_ranges_do_no_harm() -> None:
    noisy = drive(World(sigma_m=1e-3, errs=True), 1)
    random = np.random.default_rng(5)
    spoilt = noisy.ranges.range_m.copy()
    wrong = random.random(len(spoilt)) < 0.05
    spoilt[wrong] = random.uniform(0.3, 2.2, wrong.sum())
    ranges = replace(noisy.ranges, range_m=spoilt)
    found = calibrate(replace(noisy, ranges=ranges))
    assert np.abs(found.offsets_m - OFFSETS_M).max() < 4 * found.offset_sigmas_m.max()


def test_standing_still_is_said_and_tells_nothing() -> None:
    still = drive(World(sigma_m=1e-3))
    n = 200
    path = replace(still.path, t_ns=STEP_NS * np.arange(n), poses=np.zeros((n, 3)))
    rows = np.flatnonzero(still.ranges.t_ns == 0)
    again = replace(
        still.ranges,
        **{
            name: np.tile(getattr(still.ranges, name)[rows], n)
            for name in ("radar", "range_m", "amplitude", "sigma_m")
        },
        t_ns=np.repeat(STEP_NS * np.arange(n), len(rows)),
    )
    standing = replace(still, path=path, ranges=again, step_sigmas=np.full((n - 1, 3), 1e-5))
    found = calibrate(standing)
    assert np.all(found.offset_sigmas_m > 0.01)
    assert any("stood still" in line for line in poor_drive(standing, found))


def test_no_reflector_at_all_leaves_the_priors() -> None:
    empty = drive(World())
    nothing = RangeSet.of([])
    found = calibrate(replace(empty, ranges=nothing))
    np.testing.assert_allclose(found.offset_sigmas_m, 0.03, rtol=1e-6)
    np.testing.assert_allclose(found.offsets_m, 0.0, atol=1e-12)
    assert any("no reflector" in line for line in poor_drive(replace(empty, ranges=nothing), found))


def test_a_straight_drive_past_one_reflector_names_what_it_cannot_tell() -> None:
    straight = drive(
        World(stops=((0.0, 0.0), (1.5, 0.0)), rods=np.array([[0.8, 1.0]]), sigma_m=1e-3)
    )
    found = calibrate(straight)
    assert np.all(found.offset_sigmas_m > 1e-3)
    said = words(straight, found)
    assert "cannot tell the offset of left_rear and left_front from the mount y" in said
    poor = "\n".join(poor_drive(straight, found))
    assert "only one reflector" in poor
    assert "right_rear followed no reflector" in poor


def test_gains_relative_to_their_mean_and_yaw_come_from_amplitudes() -> None:
    exact = drive(World())
    gains = estimate_gains(exact, calibrate(exact))
    np.testing.assert_allclose(gains.gains_db, GAINS_DB, atol=0.01)
    np.testing.assert_allclose(gains.yaws_rad, 0.0, atol=1e-3)
    louder = replace(exact, ranges=replace(exact.ranges, amplitude=2 * exact.ranges.amplitude))
    same = estimate_gains(louder, calibrate(louder))
    np.testing.assert_allclose(same.gains_db, gains.gains_db, atol=1e-3)


def test_gains_of_sides_without_a_common_reflector_are_not_told() -> None:
    apart = drive(World(stops=((0.0, 0.0), (1.5, 0.0)), rods=np.array([[0.5, 1.0], [0.9, -0.9]])))
    gains = estimate_gains(apart, calibrate(apart))
    assert np.all(gains.gain_sigmas_db > 1.0)


def test_a_radar_places_an_echo_it_followed() -> None:
    sights = np.column_stack([np.linspace(0, 0.6, 30), np.zeros(30), np.full(30, math.pi / 2)])
    point = np.array([0.4, 0.9])
    ranges = np.linalg.norm(point - sights[:, :2], axis=1)
    placed = place(sights, ranges)
    assert placed is not None
    np.testing.assert_allclose(placed[0], point, atol=1e-3)
    assert place(sights, ranges + np.linspace(0, 0.4, 30) ** 2 * 4) is None  # no still point

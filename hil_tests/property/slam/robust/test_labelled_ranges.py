"""Ranges with the ids of beacons: one antenna, all around, against closed forms and scipy."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from hil_tests.unit.slam.robust.range_world import LAB, odometry_path, parameters_for, simulate
from slam.config import WheelNoise
from slam.geometry import Mount, Rig, mirrored, paper_rig
from slam.library.evaluation import ate_rmse_m
from slam.results import UpdateReport
from slam.robust.association import RangeScan
from slam.robust.back_end import RobustBackEnd
from slam.robust.branches import Branches
from slam.robust.parameters import (
    BackEndParameters,
    RangeNoise,
    RelinearisationRule,
)
from slam.robust.solver.beacons import find_places
from slam.robust.state import Array

SIGMA_M, STEP_M = 0.1, 0.2
MOUNT = Mount(name="antenna", x_m=0.3, y_m=-0.1, yaw_rad=0.5)
RIG = Rig(mounts=(MOUNT,))
# White noise alone, so that the oracle has no other unknowns
WHEELS = WheelNoise(
    along_m_per_sqrt_m=0.02,
    across_m_per_sqrt_m=0.02,
    heading_rad_per_sqrt_m=0.01,
    scale_sigma=0.0,
    turn_scale_sigma=0.0,
    curvature_sigma_rad_per_m=0.0,
)
PARAMETERS = BackEndParameters(
    wheels=WHEELS,
    ranges=RangeNoise(
        sigma_m=SIGMA_M, field_of_view_rad=math.tau, min_range_m=0.0, max_range_m=50.0
    ),
    relinearisation=RelinearisationRule(shift_m=0.1),
)
BEACONS = {7: np.array([6.0, 4.0]), 1: np.array([-3.0, 6.0]), 42: np.array([2.0, -5.0])}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drive:
    """True poses (k + 1, 3), reported increments (k, 3), and the ranges heard at their ends."""

    poses: Array
    increments: Array
    heard: list[list[tuple[int, float]]]  # label and range

    def scans(self, number: int) -> list[RangeScan]:
        labels, ranges_m = zip(*self.heard[number], strict=True) if self.heard[number] else ((), ())
        return [RangeScan(radar=0, ranges_m=ranges_m, labels=labels)]


def ell(n_straight: int, n_turn: int, n_after: int) -> Array:
    """Return the true increments of a straight way, a curve of 90 degrees, and another way."""
    straight, after = np.zeros((n_straight, 3)), np.zeros((n_after, 3))
    turn = np.full((n_turn, 3), [0.0, 0.0, math.pi / 2 / max(n_turn, 1)])
    increments = np.concatenate([straight, turn, after])
    increments[:, 0] = STEP_M
    return increments


def drive_along(
    true_increments: Array, seed: int, *, outliers: float = 0.0, offset_m: float = 0.0
) -> Drive:
    """Return a drive on which one beacon after the other is asked for its range."""
    rng = np.random.default_rng(seed)
    poses = odometry_path(true_increments)
    sigmas = WHEELS.step_sigmas(true_increments)
    antennas = np.array([antenna_of(pose) for pose in poses])
    heard: list[list[tuple[int, float]]] = []
    for k in range(1, len(poses)):
        label = list(BEACONS)[k % len(BEACONS)]
        range_m = float(np.hypot(*(BEACONS[label] - antennas[k])))
        range_m += offset_m + SIGMA_M * rng.standard_normal()
        if rng.random() < outliers:
            range_m = float(rng.uniform(0.0, 20.0))
        heard.append([(label, range_m)])
    noisy = true_increments + sigmas * rng.standard_normal(true_increments.shape)
    return Drive(poses=poses, increments=noisy, heard=heard)


def antenna_of(pose: Array) -> Array:
    """Return where the antenna of a robot is, (2,)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    x, y = MOUNT.x_m, MOUNT.y_m
    return np.array([pose[0] + c * x - s * y, pose[1] + s * x + c * y])


def run(
    drive: Drive, parameters: BackEndParameters = PARAMETERS
) -> tuple[RobustBackEnd, Array, list[UpdateReport]]:
    back_end = RobustBackEnd(RIG, parameters)
    path, reports = [back_end.pose], []
    for number, increment in enumerate(drive.increments):
        back_end.predict(increment)
        reports.append(back_end.update(drive.scans(number)))
        path.append(back_end.pose)
    return back_end, np.array(path), reports


def place_of(back_end: RobustBackEnd, label: int) -> Array:
    row = back_end.state.landmark_ids.index(back_end.landmark_of_label[label])
    place: Array = back_end.state.landmarks_m[row]
    return place


def test_exact_ranges_from_a_bent_way_have_the_place_of_the_beacon_first() -> None:
    antennas = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0], [3.0, 1.0], [3.0, 2.0]])
    for point in ([1.0, 4.0], [-2.0, -3.0], [5.0, 0.5], [1.4, 0.3]):
        ranges = np.hypot(*(antennas - point).T)
        places = find_places(ranges, np.full(6, 0.01), antennas, PARAMETERS)
        assert places[0] == pytest.approx(point, abs=1e-5)


def test_exact_ranges_from_a_straight_way_have_both_mirror_images() -> None:
    """The line y = x: the mirror image of (a, b) is (b, a)."""
    antennas = np.linspace(0.0, 3.0, 12)[:, None] * np.ones(2)
    ranges = np.hypot(*(antennas - [4.0, 1.0]).T)
    places = find_places(ranges, np.full(12, 0.01), antennas, PARAMETERS)
    for image in ([4.0, 1.0], [1.0, 4.0]):
        assert min(np.hypot(*(places - image).T)) <= 1e-5
    assert mirrored(np.array([4.0, 1.0]), antennas) == pytest.approx([1.0, 4.0])


SEEDS = [pytest.param(seed, marks=pytest.mark.rare if seed else ()) for seed in range(4)]


@pytest.mark.parametrize("seed", SEEDS[:3])
def test_on_a_straight_way_no_beacon_is_placed_and_after_a_curve_all_are(seed: int) -> None:
    drive = drive_along(ell(60, 15, 60), seed)
    back_end = RobustBackEnd(RIG, PARAMETERS)
    for number, increment in enumerate(drive.increments):
        back_end.predict(increment)
        back_end.update(drive.scans(number))
        if number < 60:
            assert not back_end.landmark_of_label
    assert sorted(back_end.landmark_of_label) == sorted(BEACONS)
    for label, point in BEACONS.items():
        row = back_end.state.landmark_ids.index(back_end.landmark_of_label[label])
        at = back_end.state.landmark_columns(np.array([row]))
        assert np.hypot(*(place_of(back_end, label) - point)) <= 0.5
        assert math.sqrt(np.linalg.eigvalsh(back_end.state.P.block(at))[-1]) <= 0.5


def solved_by_scipy(drive: Drive, labels: Sequence[int]) -> tuple[Array, Array]:
    """Return all poses (k, 3) and the beacons (m, 2) of least squares over the whole run."""
    n = len(drive.increments)
    sigmas = np.sqrt(
        [
            WHEELS.step_variances(math.hypot(*step[:2].tolist()), float(step[2]))
            for step in drive.increments
        ]
    )

    def residuals(unknowns: Array) -> Array:
        poses = np.vstack([np.zeros(3), unknowns[: 3 * n].reshape(n, 3)])
        points = dict(zip(labels, unknowns[3 * n :].reshape(-1, 2), strict=True))
        c, s = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
        gone = np.diff(poses, axis=0)
        steps = np.column_stack(
            [c * gone[:, 0] + s * gone[:, 1], c * gone[:, 1] - s * gone[:, 0], gone[:, 2]]
        )
        white = [((steps - drive.increments) / sigmas).ravel()]
        white += [
            np.atleast_1d((np.hypot(*(points[label] - antenna_of(pose))) - range_m) / SIGMA_M)
            for pose, heard in zip(poses[1:], drive.heard, strict=True)
            for label, range_m in heard
        ]
        return np.concatenate(white)

    start = np.concatenate([drive.poses[1:].ravel(), *[BEACONS[label] for label in labels]])
    found = least_squares(residuals, start, x_scale="jac").x
    return found[: 3 * n].reshape(n, 3), found[3 * n :].reshape(-1, 2)


def test_the_smoothed_run_is_the_least_squares_solution_of_all_ranges() -> None:
    """Those from before the beacons had a place included, and none twice."""
    drive = drive_along(ell(20, 8, 20), 4)
    rule = replace(PARAMETERS.relinearisation, key_m=1e-3, outlier_sigmas=math.inf)
    back_end, _, _ = run(drive, replace(PARAMETERS, relinearisation=rule))
    smoothed = back_end.smoothed(np.arange(1, 49, dtype=np.int64))
    assert smoothed is not None
    labels = [label for label in BEACONS if label in back_end.landmark_of_label]
    assert labels == list(BEACONS)
    poses, points = solved_by_scipy(drive, labels)
    assert np.abs(smoothed.poses - poses)[:, :2].max() <= 0.02 * SIGMA_M
    for label, point in zip(labels, points, strict=True):
        row = smoothed.landmark_ids.index(back_end.landmark_of_label[label])
        assert smoothed.landmarks_m[row] == pytest.approx(point, abs=0.05 * SIGMA_M)


def circles(n: int) -> Array:
    """Return true increments of a circle of 2 m radius."""
    return np.tile([STEP_M, 0.0, 0.1], (n, 1))


@pytest.mark.parametrize("seed", SEEDS)
def test_ranges_far_off_do_not_count(seed: int) -> None:
    """A run without them, for they are known here, has the same map to less than its uncertainty.

    A fifth of all ranges could be any number.
    """
    drive = drive_along(circles(250), seed, outliers=0.2)
    antennas = [antenna_of(pose) for pose in drive.poses[1:]]
    good = [
        [(label, r) for label, r in heard if abs(r - np.hypot(*(BEACONS[label] - at))) < 0.6]
        for heard, at in zip(drive.heard, antennas, strict=True)
    ]
    assert sum(map(len, good)) < 0.9 * len(drive.heard)
    parameters = replace(PARAMETERS, ranges=replace(PARAMETERS.ranges, huber_sigmas=2.0))
    back_end, path, _ = run(drive, parameters)
    without, other_path, _ = run(replace(drive, heard=good), parameters)
    for label in BEACONS:
        row = back_end.state.landmark_ids.index(back_end.landmark_of_label[label])
        P = back_end.state.P.block(back_end.state.landmark_columns(np.array([row])))
        away = place_of(back_end, label) - place_of(without, label)
        assert np.hypot(*away) <= math.sqrt(np.linalg.eigvalsh(P)[-1])
    truth, odometry = drive.poses[:, :2], odometry_path(drive.increments)[:, :2]
    ate_m = ate_rmse_m(path[:, :2], truth)
    assert ate_m <= 1.2 * ate_rmse_m(other_path[:, :2], truth)
    assert ate_m < ate_rmse_m(odometry, truth)


@pytest.mark.rare
def test_ranges_of_two_beacons_with_each_others_labels_correct_nothing() -> None:
    drive = drive_along(circles(150), 3)
    back_end, _, _ = run(drive)
    pose, antenna = back_end.pose, antenna_of(drive.poses[-1])
    true = [float(np.hypot(*(BEACONS[label] - antenna))) for label in (7, 42)]
    assert abs(true[0] - true[1]) > 1.0
    back_end.predict(np.zeros(3))
    right = RangeScan(radar=0, ranges_m=tuple(true), labels=(7, 42))
    swapped = replace(right, labels=(42, 7))
    report = back_end.copy().update([right])
    assert [index for _, index, _ in report.continued] == [0, 1]
    assert [id_ for _, _, id_ in report.continued] == [
        back_end.landmark_of_label[label] for label in (7, 42)
    ]
    report = back_end.update([swapped], solve=False)
    assert report.continued == ()
    assert np.abs(back_end.pose - pose).max() <= 1e-12


@cache
def a_circle() -> tuple[Drive, RobustBackEnd, Array]:
    drive = drive_along(circles(60), 5)
    back_end, path, _ = run(drive)
    return drive, back_end, path


@settings(max_examples=5, deadline=None)
@given(st.lists(st.integers(-(10**12), 10**12), min_size=3, max_size=3, unique=True))
def test_labels_are_names_only(names: list[int]) -> None:
    """Other labels give the same run, bit for bit."""
    drive, one, path = a_circle()
    new = dict(zip(BEACONS, names, strict=True))
    renamed = [[(new[label], range_m) for label, range_m in heard] for heard in drive.heard]
    other, other_path, _ = run(replace(drive, heard=renamed))
    assert np.array_equal(path, other_path)
    assert len(one.landmark_of_label) == len(BEACONS)
    assert {new[label]: id_ for label, id_ in one.landmark_of_label.items()} == dict(
        other.landmark_of_label
    )
    assert np.array_equal(one.state.P.full(), other.state.P.full())


@pytest.mark.rare
def test_without_labels_nothing_changes_bit_for_bit() -> None:
    world = simulate(LAB, 0, 7.4e-3, laps=1)
    paths = []
    for is_named in (False, True):
        back_end = RobustBackEnd(paper_rig(), parameters_for(LAB, 7.4e-3))
        path = []
        for increment, scans in zip(world.increments[:150], world.scans[:150], strict=True):
            back_end.predict(increment)
            given_scans = [
                replace(scan, labels=(None,) * len(scan.ranges_m)) if is_named else scan
                for scan in scans
            ]
            back_end.update(given_scans)
            path.append(back_end.pose)
        assert len(back_end.state.landmark_ids) > 1
        paths.append(np.array(path))
    assert np.array_equal(paths[0], paths[1])


@pytest.mark.rare
def test_a_beacon_beside_radars_changes_none_of_their_landmarks() -> None:
    """The first radar hears a beacon far outside its field of view as well."""
    world = simulate(LAB, 0, 7.4e-3, laps=1)
    point = np.array([6.0, -4.0])
    mount = paper_rig().mounts[0]
    rng = np.random.default_rng(1)
    back_end = RobustBackEnd(paper_rig(), parameters_for(LAB, 7.4e-3))
    for k, (increment, scans) in enumerate(zip(world.increments, world.scans, strict=True)):
        x, y, heading = world.poses[k + 1].tolist()
        c, s = math.cos(heading), math.sin(heading)
        antenna = np.array([x + c * mount.x_m - s * mount.y_m, y + s * mount.x_m + c * mount.y_m])
        range_m = float(np.hypot(*(point - antenna))) + 0.02 * rng.standard_normal()
        first = scans[0]
        n = len(first.ranges_m)
        heard = RangeScan(
            radar=0,
            ranges_m=(*first.ranges_m, range_m),
            sigmas_m=(*(7.4e-3,) * n, 0.02),
            labels=(*(None,) * n, 5),
        )
        back_end.predict(increment)
        back_end.update([heard, *scans[1:]])
    assert np.hypot(*(place_of(back_end, 5) - point)) <= 0.1
    gaps = [
        np.hypot(*(world.landmarks - other).T).min()
        for other in back_end.state.landmarks_m[back_end.reported_rows()]
        if np.hypot(*(other - point)) > 1.0
    ]
    assert len(gaps) >= 8
    assert max(gaps) <= 0.1


@pytest.mark.rare
def test_a_beacon_that_was_moved_is_found_where_it_is_now() -> None:
    drive = drive_along(circles(500), 6)
    moved = BEACONS | {7: np.array([-4.0, -3.0])}
    heard = list(drive.heard)
    rng = np.random.default_rng(1)
    for number in range(200, 500):
        label = heard[number][0][0]
        range_m = float(np.hypot(*(moved[label] - antenna_of(drive.poses[number + 1]))))
        heard[number] = [(label, range_m + SIGMA_M * rng.standard_normal())]
    back_end, path, _ = run(replace(drive, heard=heard))
    for label, point in moved.items():
        assert np.hypot(*(place_of(back_end, label) - point)) <= 0.3
    odometry = odometry_path(drive.increments)[:, :2]
    assert ate_rmse_m(path[:, :2], drive.poses[:, :2]) < ate_rmse_m(odometry, drive.poses[:, :2])


@pytest.mark.rare
def test_an_offset_that_all_ranges_have_in_common_is_found() -> None:
    drive = drive_along(circles(250), 7, offset_m=0.5)
    noise = replace(PARAMETERS.ranges, offset_sigma_m=0.5)
    back_end, _, _ = run(drive, replace(PARAMETERS, ranges=noise))
    sigma_m = math.sqrt(back_end.state.P.block(back_end.state.radar_columns)[0, 0])
    assert sigma_m <= 0.25
    assert abs(float(back_end.state.offsets_m[0]) - 0.5) <= 3.0 * sigma_m


@pytest.mark.rare
def test_the_question_of_a_carry_takes_ranges_with_labels() -> None:
    drive = drive_along(circles(120), 8)
    _, path, _ = run(drive)
    branches = Branches(RIG, PARAMETERS)
    for number, increment in enumerate(drive.increments):
        branches.predict(increment)
        branches.update(drive.scans(number))
    assert not branches.is_lost
    assert np.array_equal(branches.main.pose, path[-1])


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_numbers_that_cannot_be_are_refused(wrong: float) -> None:
    with pytest.raises(ValueError, match="RangeScan"):
        RangeScan(radar=0, ranges_m=(1.0, wrong), labels=(1, 1))


@pytest.mark.rare
@pytest.mark.parametrize("wrong", [-1.0, 0.0])
def test_numbers_that_are_no_ranges_are_left_out(wrong: float) -> None:
    drive = drive_along(circles(60), 5)
    one, path, _ = run(drive)
    other = RobustBackEnd(RIG, PARAMETERS)
    for number, increment in enumerate(drive.increments):
        other.predict(increment)
        (scan,) = drive.scans(number)
        assert scan.labels is not None
        both = replace(scan, ranges_m=(*scan.ranges_m, wrong), labels=scan.labels * 2)
        other.update([both])
    assert len(one.landmark_of_label) == len(BEACONS)
    assert np.array_equal(other.pose, path[-1])


@pytest.mark.rare
def test_an_antenna_that_asks_beacons_misses_no_landmark_of_the_radars() -> None:
    """It stands where a radar does, and its scans hold nothing but a beacon's range."""
    world = simulate(LAB, 0, 7.4e-3, laps=1)
    rig = paper_rig()
    both = Rig(mounts=(*rig.mounts, replace(rig.mounts[0], name="antenna")))
    ends = []
    for mounted in (rig, both):
        back_end = RobustBackEnd(mounted, parameters_for(LAB, 7.4e-3))
        for increment, scans in zip(world.increments[:200], world.scans[:200], strict=True):
            back_end.predict(increment)
            asked = RangeScan(radar=4, ranges_m=(100.0,), labels=(5,))
            back_end.update([*scans, asked] if mounted is both else scans)
        assert not back_end.landmark_of_label
        assert len(back_end.reported_rows()) >= 2
        ends.append(back_end)
    assert np.abs(ends[0].state.landmarks_m - ends[1].state.landmarks_m).max() <= 1e-3


def test_two_ranges_with_one_label_are_an_error() -> None:
    with pytest.raises(ValueError, match="1 labels of 2 ranges"):
        RangeScan(radar=0, ranges_m=(1.0, 2.0), labels=(3,))

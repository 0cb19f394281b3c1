"""The robust back end in a world of ranges: it finds the map. Seeds are fixed."""

import copy
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from hil_tests.unit.slam.robust.range_world import (
    LAB,
    Array,
    Run,
    follow,
    odometry_path,
    parameters_for,
    simulate,
)
from slam.geometry import PAPERS_FIELD, Mount, Rig, align_se2, paper_rig, transform
from slam.library.evaluation import ate_rmse_m, landmark_metrics, observable_landmarks
from slam.robust.association import RangeScan
from slam.robust.back_end import RobustBackEnd
from slam.robust.initialisation import BodyPoint, initialise_landmark
from slam.robust.parameters import BackEndParameters, RangeNoise
from slam.robust.pipeline import belief_of
from slam.robust.state import quarter_turn

SIGMA_M = 7.4e-3


def drive(run: Run, rig: Rig) -> tuple[RobustBackEnd, Array]:
    """Run a back end over a run; return it and the causal path (k, 3)."""
    back_end = RobustBackEnd(rig, parameters_for(LAB, SIGMA_M))
    path = [back_end.pose for _ in follow(back_end, run.increments, run.scans)]
    return back_end, np.array([np.zeros(3), *path])


def test_few_past_poses_are_kept_where_the_robot_turns_or_only_odometry_goes_on() -> None:
    parameters = BackEndParameters()
    rule = parameters.lag
    turning, blind = (RobustBackEnd(paper_rig(), parameters) for _ in range(2))
    lagged: list[int] = []
    for _ in range(12 * rule.most):
        turning.predict(np.array([0.0, 0.0, 0.1]))
        turning.update([])
        lagged += [one.number for one in turning.lagged]
        blind.predict(np.array([0.01, 0.0, 0.0]))
        assert len(turning.state.past) <= rule.most
        # 2 m, one every 10 cm
        assert len(blind.state.past) <= 21
    # One every two keyframes of 0.1 rad, those left out that are not final yet
    assert len(lagged) == 12 * rule.most // 2 - rule.most - 1
    assert lagged == sorted(set(lagged))


def test_no_past_pose_is_from_before_a_robot_was_set_down() -> None:
    back_end = RobustBackEnd(paper_rig(), BackEndParameters())
    numbers: list[int] = []
    for step in range(500):
        if step == 250:
            back_end.set_down(np.array([3.0, 4.0, 1.0]), [])
            assert len(back_end.state.past) == 0
        back_end.predict(np.array([0.01, 0.0, 0.0]))
        back_end.update([])
        numbers += [one.number for one in back_end.lagged]
    before = [number for number in numbers if number < 250]
    assert before == sorted(before)
    # 2.5 m were driven before that and after it; the last 2 m of the former are given up.
    assert max(before) <= 50
    assert min(number for number in numbers if number > 50) > 250


def cut(run: Run, n_poses: int) -> Run:
    return replace(
        run,
        poses=run.poses[:n_poses],
        increments=run.increments[: n_poses - 1],
        scans=run.scans[: n_poses - 1],
    )


def test_a_lap_of_the_lab_gives_a_clean_map() -> None:
    rig = paper_rig()
    run = cut(simulate(LAB, 0, SIGMA_M), 880)
    back_end, path = drive(run, rig)
    alignment = align_se2(path[:, :2], run.poses[:, :2])
    landmarks = belief_of(back_end).landmarks
    observable = observable_landmarks(rig, run.poses, run.landmarks, PAPERS_FIELD)
    score = landmark_metrics(landmarks, run.landmarks, alignment, observable)
    assert (score.precision, score.duplicates) == (1.0, 0)
    assert score.recall is not None
    assert score.recall >= 1 - 1.001 / observable.sum()  # one may be missing
    for point in transform(alignment, landmarks):
        assert np.hypot(*(run.landmarks - point).T).min() <= 0.15
    odometry = odometry_path(run.increments)
    assert ate_rmse_m(path[:, :2], run.poses[:, :2]) < ate_rmse_m(odometry[:, :2], run.poses[:, :2])


def turned(rig: Rig, off_deg: float) -> Rig:
    """Return the rig with its first radar, one of the left pair, mounted at another yaw."""
    first = rig.mounts[0]
    yaw_rad = first.yaw_rad + math.radians(off_deg)
    return Rig(mounts=(replace(first, yaw_rad=yaw_rad), *rig.mounts[1:]))


@pytest.mark.parametrize(
    ("off_deg", "apart_m"),
    [
        (1e-4, 1e-6),
        pytest.param(1.0, 2e-3, marks=pytest.mark.rare),
    ],
)
def test_a_radar_mounted_a_little_aslant_gives_nearly_the_same_run(
    off_deg: float, apart_m: float
) -> None:
    run = cut(simulate(LAB, 0, SIGMA_M), 250)
    straight, path = drive(run, paper_rig())
    aslant, other = drive(run, turned(paper_rig(), off_deg))
    assert np.abs(other - path)[:, :2].max() <= apart_m
    assert_same_map(straight, aslant, 3 * apart_m)


def test_a_radar_mounted_aslant_moves_the_path_by_less_than_it_is_uncertain_by() -> None:
    """With 5 degrees, what is at the edge of the field of view is expected a scan later."""
    run = cut(simulate(LAB, 0, SIGMA_M), 250)
    back_ends = [
        RobustBackEnd(rig, parameters_for(LAB, SIGMA_M))
        for rig in (paper_rig(), turned(paper_rig(), 5.0))
    ]
    straight, aslant = back_ends
    apart = []
    for increment, scans in zip(run.increments, run.scans, strict=True):
        for back_end in back_ends:
            back_end.predict(increment)
            back_end.update(scans)
        miss = aslant.pose[:2] - straight.pose[:2]
        apart.append(float(miss @ np.linalg.solve(straight.pose_covariance[:2, :2], miss)))
    assert 0.0 < math.sqrt(max(apart)) < 1.0
    assert_same_map(straight, aslant, 15e-3)


def assert_same_map(straight: RobustBackEnd, aslant: RobustBackEnd, apart_m: float) -> None:
    here, there = belief_of(straight).landmarks, belief_of(aslant).landmarks
    assert len(here) == len(there) >= 4
    assert np.hypot(*(here[:, None] - there).T).min(axis=0).max() <= apart_m


def test_a_relinearised_belief_stays_where_the_filter_was_in_a_linear_regime() -> None:
    back_end, _ = drive(cut(simulate(LAB, 1, SIGMA_M, clutter=False), 150), paper_rig())
    before, sigmas = back_end.pose, np.sqrt(np.diag(back_end.pose_covariance))
    assert back_end.relinearise()
    assert (np.abs(back_end.pose - before) <= sigmas).all()
    again = np.sqrt(np.diag(back_end.pose_covariance))
    assert again == pytest.approx(sigmas, rel=0.2)


def with_sigmas(scans: list[RangeScan], sigma_m: float) -> list[RangeScan]:
    """Return scans whose ranges have standard deviations from a front end."""
    return [replace(scan, sigmas_m=(sigma_m,) * len(scan.ranges_m)) for scan in scans]


def test_a_range_of_uncertain_association_is_used_and_weighs_less() -> None:
    """One range 5 mm off, predicted to 1 mm: inside the gate only with 2 mm for association."""
    rig, sigma_m = paper_rig(), 1e-3
    run = cut(simulate(LAB, 1, sigma_m), 150)
    parameters = parameters_for(LAB, sigma_m)
    parameters = replace(
        parameters, ranges=replace(parameters.ranges, association_sigma_m=2e-3, huber_sigmas=2.0)
    )
    back_end = RobustBackEnd(rig, parameters)
    for increment, scans in zip(run.increments, run.scans, strict=True):
        back_end.predict(increment)
        before = copy.deepcopy(back_end)
        report = back_end.update(with_sigmas(scans, sigma_m))
    radar, index, landmark_id = report.continued[0]
    scan = next(scan for scan in scans if scan.radar == radar)
    ranges_m = list(scan.ranges_m)
    ranges_m[index] += 5e-3
    off = [replace(each, ranges_m=tuple(ranges_m)) if each is scan else each for each in scans]

    def after(**changes: float) -> tuple[bool, float, float]:
        """Return whether the range was used, how far it moved its landmark, and the NIS."""
        twin = copy.deepcopy(before)
        ranges = replace(parameters.ranges, **changes)
        twin.parameters = replace(parameters, ranges=ranges)
        report = twin.update(with_sigmas(off, sigma_m))
        row = twin.state.landmark_ids.index(landmark_id)
        moved = twin.state.landmarks_m[row] - before.state.landmarks_m[row]
        return (radar, index, landmark_id) in report.continued, math.hypot(*moved), report.nis

    used, moved_m, nis = after()
    in_full = after(huber_sigmas=math.inf)
    assert used
    assert in_full[0]
    assert moved_m < 0.7 * in_full[1]
    assert nis == pytest.approx(in_full[2])  # what is reported is before Huber's weight
    assert not after(association_sigma_m=0.0)[0]


def camera_scan(
    points: Sequence[tuple[float, float]], labels: tuple[int | None, ...] | None = None
) -> RangeScan:
    """Return what radar 0 sees, with range and bearing, each known to a centimetre."""
    return RangeScan(
        radar=0,
        ranges_m=tuple(range_m for range_m, _ in points),
        sigmas_m=(0.01,) * len(points),
        bearings_rad=tuple(bearing for _, bearing in points),
        bearing_sigmas_rad=(0.01,) * len(points),
        labels=labels,
    )


@pytest.mark.parametrize("label", [None, 7])
def test_a_point_is_a_landmark_when_enough_scans_hold_it(label: int | None) -> None:
    rig = Rig(mounts=(Mount(name="camera", x_m=0.1, y_m=0.05, yaw_rad=0.3),))
    parameters = BackEndParameters(ranges=RangeNoise(max_range_m=5.0))
    back_end = RobustBackEnd(rig, parameters)
    target, min_hits = (
        np.array([2.0, 0.5]),
        (
            parameters.initialisation.min_frames
            if label is None
            else parameters.initialisation.min_hits_per_radar
        ),
    )
    for k in range(min_hits + 3):
        back_end.predict(np.array([0.1, 0.0, 0.0]))
        x, y = target - np.array([0.1 * (k + 1) + 0.1, 0.05])
        seen = math.hypot(x, y), math.atan2(y, x) - 0.3
        report = back_end.update([camera_scan([seen], (label,))])
        assert len(back_end.state.landmark_ids) == (k + 1 >= min_hits)
        assert report.continued == (((0, 0, 0),) if k >= min_hits else ())
        assert report.dof == 2 * len(report.continued)
    assert back_end.state.landmarks_m[0] == pytest.approx(target, abs=1e-3)
    assert back_end.landmark_of_label == ({} if label is None else {7: 0})


def test_clutter_with_bearings_is_no_landmark() -> None:
    rng = np.random.default_rng(3)
    back_end = RobustBackEnd(paper_rig(), BackEndParameters(ranges=RangeNoise(max_range_m=5.0)))
    for _ in range(60):
        back_end.predict(np.array([0.05, 0.0, 0.01]))
        back_end.update([camera_scan([(rng.uniform(0.5, 5.0), rng.uniform(-0.5, 0.5))])])
    assert not back_end.state.landmark_ids


def test_a_scan_with_bearings_needs_one_for_each_range() -> None:
    with pytest.raises(ValueError, match="1 bearings_rad of 2 ranges"):
        RangeScan(radar=0, ranges_m=(1.0, 2.0), bearings_rad=(0.1,))


def test_an_empty_scan_and_no_scan_change_nothing() -> None:
    back_end = RobustBackEnd(paper_rig(), BackEndParameters())
    back_end.predict(np.array([0.01, 0.0, 0.0]))
    pose = back_end.pose
    report = back_end.update([RangeScan(radar=0, ranges_m=())])
    assert back_end.update([]).continued == report.continued == ()
    assert np.array_equal(back_end.pose, pose)


def test_radars_that_look_the_same_way_are_one_side() -> None:
    assert paper_rig().sides() == ((0, 1), (2, 3))
    assert Rig(mounts=(Mount(name="one", x_m=0.0, y_m=0.0, yaw_rad=0.0),)).sides() == ((0,),)


@pytest.mark.parametrize(
    ("heard_m", "blurred_m", "stays"),
    [((), (), False), ((0.7,), (), False), ((0.42,), (), True), ((), (0.5,), True)],
    ids=["silence", "another echo", "an echo near it", "a blurred echo"],
)
def test_a_landmark_known_to_two_centimetres_is_given_up_where_nothing_answers(
    heard_m: tuple[float, ...], blurred_m: tuple[float, ...], stays: bool
) -> None:
    back_end = RobustBackEnd(paper_rig(), BackEndParameters())
    # 0.4 m straight in front of both left radars' middle; too unsure for single ranges
    # others answer on the right, so the pose of the robot is certain
    for bearing, sigma_m in ((np.pi / 2, 0.02), (-1.5, 1e-3), (-1.7, 1e-3)):
        u = np.array([math.cos(bearing), math.sin(bearing)])
        turn = np.column_stack([u, quarter_turn(u)])
        point = BodyPoint(
            point_m=0.6 * u,
            covariance=turn @ np.diag([sigma_m**2, (0.6 * sigma_m) ** 2]) @ turn.T,
            by_offsets=np.zeros((2, 4)),
        )
        back_end._existence.hit(initialise_landmark(back_end.state, point))
    ranges_m = [
        tuple(math.hypot(0.6 * math.cos(b) - x_m, 0.6 * math.sin(b) + 0.2) for b in (-1.5, -1.7))
        for x_m in (0.1, -0.1)
    ]
    for _ in range(40):
        back_end.predict(np.zeros(3))
        left = [RangeScan(radar=r, ranges_m=heard_m, blurred_m=blurred_m) for r in range(2)]
        right = [RangeScan(radar=2 + r, ranges_m=ranges_m[r]) for r in range(2)]
        back_end.update(left + right)
    assert (0 in back_end.state.landmark_ids) == stays

"""The robust pipeline around its back end: which ranges it takes, from where, and what it says."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import chdtri

from hil_tests.unit.slam.simulation import frame_of
from slam.app.rig.emulated import scene_and_config, wheels_of
from slam.config import UNUSED_PARTS, RobustConfig, SlamConfig, WheelNoise, load_preset, override
from slam.frames import Detection, RadarFrame
from slam.geometry import between, compose, paper_rig, transform
from slam.library.evaluation import nees_pose
from slam.library.slam import make_slam
from slam.paper.pipeline import UwbRadarSlam
from slam.results import Belief, LaggedPose, PoseAt
from slam.robust.association import RangeScan
from slam.robust.pipeline import PatchScans, RobustSlam, back_end_parameters, belief_of
from slam.robust.state import rotation

Array = NDArray[np.float64]

NS = 1_000_000_000
TICK_NS = NS // 5
RIG = paper_rig()
RODS = np.array([[0.3, 0.9], [0.9, 1.1], [1.2, 0.7], [0.4, -0.8], [1.0, -1.0]])
ROBUST = load_preset("robust")


def straight(t_ns: int) -> Array:
    """5 cm/s along x."""
    return np.array([0.05 * t_ns / NS, 0.0, 0.0])


def echoes(pose: Array, radar: int, t_ns: int, *, misfit: float = 0.5) -> list[Detection]:
    """Return what one radar detects of the rods, exactly, from a true pose."""
    mount = RIG.mounts[radar]
    antenna = transform(pose, np.array([mount.x_m, mount.y_m]))
    found = []
    for rod in RODS:
        away = rod - antenna
        off = math.atan2(away[1], away[0]) - pose[2] - mount.yaw_rad
        if abs(math.remainder(off, math.tau)) < math.radians(32.5) and np.hypot(*away) < 1.5:
            found.append(
                Detection(
                    radar=radar,
                    t_ns=t_ns,
                    range_m=float(np.hypot(*away)),
                    amplitude=0.015,
                    sigma_m=1e-3,
                    misfit=misfit,
                )
            )
    return found


def drive(slam: RobustSlam, n: int, odometry: PoseAt, *, misfit: float = 0.5) -> list[Belief]:
    """Drive n ticks straight ahead, truth as `straight` has it."""
    beliefs = []
    for tick in range(n):
        t_ns = tick * TICK_NS
        seen = [
            detection
            for radar in range(len(RIG.mounts))
            for detection in echoes(straight(t_ns), radar, t_ns, misfit=misfit)
        ]
        beliefs += [row.belief for row in slam.step_detections(seen, odometry, t_ns)]
    return beliefs


def test_a_pose_of_two_metres_ago_is_reported_with_what_was_measured_since() -> None:
    """The wheels report 2 % too much; what is corrected later is nearer to the truth."""

    def wheels(t_ns: int) -> Array:
        return 1.02 * straight(t_ns)

    slam, lagged, causal = robust(), list[LaggedPose](), dict[int, Belief]()
    for tick in range(270):
        t_ns = tick * TICK_NS
        seen = [
            detection
            for radar in range(len(RIG.mounts))
            for detection in echoes(straight(t_ns), radar, t_ns)
        ]
        for row in slam.step_detections(seen, wheels, t_ns):
            causal[row.t_ns] = row.belief
            lagged += row.lagged
            for one in row.lagged:
                behind_m = wheels(t_ns)[0] - wheels(one.t_ns)[0]
                assert 2.0 <= behind_m < 2.0 + 0.0102 + 1e-9
    stamps_ns = [one.t_ns for one in lagged]
    assert stamps_ns == sorted(set(stamps_ns))
    assert set(stamps_ns) <= set(causal)
    # 2.7 m were driven; a pose every two keyframes of 5 cm
    assert len(lagged) == 7
    for one in lagged:
        before, truth = causal[one.t_ns], straight(one.t_ns)
        assert one.covariance[0, 0] < before.pose_covariance[0, 0]
        assert abs(one.pose[0] - truth[0]) < abs(before.pose[0] - truth[0])
        assert nees_pose(one.pose, one.covariance, truth) < chdtri(3, 1e-3)


def robust(config: SlamConfig = ROBUST) -> RobustSlam:
    return RobustSlam(config, RIG, WheelNoise())


def test_the_configuration_says_which_pipeline_runs() -> None:
    assert isinstance(make_slam(ROBUST, RIG, WheelNoise()), RobustSlam)
    assert isinstance(make_slam(load_preset("paper"), RIG, WheelNoise()), UwbRadarSlam)


@pytest.mark.parametrize("environment", ["lab", "classroom", "cellar"])
def test_the_preset_is_one_for_all_environments(environment: str) -> None:
    assert load_preset("robust", environment) == ROBUST


def test_a_setting_without_a_table_can_be_overridden() -> None:
    config = override(SlamConfig(), {"back_end": "robust", "robust.range_sigma_m": "0.004"})
    assert isinstance(make_slam(config, RIG, WheelNoise()), RobustSlam)
    assert config.robust.range_sigma_m == 0.004


def test_wheels_are_those_of_the_scenes_specification() -> None:
    scene, _ = scene_and_config("classroom", "robust")
    odometry = scene.odometry.model_copy(update={"turn_scale_sigma": 0.031})
    wheels = wheels_of(scene.model_copy(update={"odometry": odometry}))
    assert wheels.calibration_sigmas == (0.023, 0.031, 0.0139)
    assert wheels.heading_rad_per_rad == 0.01
    start = RobustSlam(ROBUST, RIG, wheels).back_end.state.P.full().diagonal()[3:6]
    np.testing.assert_allclose(np.sqrt(start), [0.023, 0.031, 0.0139])


def test_ranges_correct_wheels_that_report_too_much() -> None:
    def odometry(t_ns: int) -> Array:
        return straight(t_ns) * 1.02

    # Or offsets, mounts, radii and errors common to the ranges of a passage may explain it. These
    # ranges err by less than stated, and the share of the variance is never below this one.
    names = ("offset_sigma_m", "mount_sigma_m", "radius_sigma_m")
    known = {f"robust.{name}": "0" for name in names} | {"robust.range_variance_share": "0.5"}
    calibrated = override(ROBUST, known)
    beliefs = drive(robust(calibrated), 130, odometry)
    assert len(beliefs) == 129
    end = straight(129 * TICK_NS)
    assert abs(beliefs[-1].pose[0] - end[0]) < 0.1 * abs(odometry(129 * TICK_NS)[0] - end[0])
    gaps = np.linalg.norm(beliefs[-1].landmarks[:, None] - RODS[None], axis=2)
    assert len(gaps) == len(RODS)
    assert gaps.min(axis=0).max() < 0.01
    assert nees_pose(beliefs[-1].pose, beliefs[-1].pose_covariance, end) < 11.3


def test_the_belief_is_the_back_ends_with_additive_errors() -> None:
    slam = robust()
    belief = drive(slam, 40, straight)[-1]
    state = slam.back_end.state
    T, P = state.additive_transform(), state.P.full()
    additive = T @ P @ T.T
    rows = slam.back_end.reported_rows()
    columns = state.landmark_columns(np.array(rows, dtype=np.intp))
    at = np.concatenate([[1, 2, 0], columns])
    expected = additive[np.ix_(at, at)]
    expected[:2, :2] += state.curved_covariance()
    np.testing.assert_allclose(belief.covariance, expected, rtol=1e-12, atol=1e-18)
    np.testing.assert_array_equal(belief.covariance, belief.covariance.T)
    np.testing.assert_array_equal(belief.landmarks, state.landmarks_m[rows])
    assert belief.landmark_ids == tuple(state.landmark_ids[row] for row in rows)
    assert belief_of(slam.back_end).mean.tobytes() == belief.mean.tobytes()


def test_echoes_of_several_targets_are_left_out_and_told() -> None:
    slam = robust()
    beliefs = drive(slam, 40, straight, misfit=ROBUST.robust.max_misfit * 1.01)
    assert beliefs[-1].landmark_ids == ()
    assert drive(robust(), 40, straight, misfit=ROBUST.robust.max_misfit)[-1].landmark_ids
    t_ns = 40 * TICK_NS
    good, bad = echoes(straight(t_ns), 0, t_ns), echoes(straight(t_ns), 1, t_ns, misfit=9.0)
    (result,) = slam.step_detections([*good, *bad], straight, t_ns)
    assert result.range_sigmas_m[len(good) :] == (math.inf,) * len(bad)


def test_the_floor_is_added_in_squares_to_what_the_front_end_predicts() -> None:
    """Of 1 mm and 2.4 mm, by hand."""
    slam = robust(override(ROBUST, {"robust.range_floor_m": 2.4e-3}))
    slam.step_detections((), straight, 0)
    seen = echoes(straight(TICK_NS), 0, TICK_NS)
    (result,) = slam.step_detections(seen, straight, TICK_NS)
    assert result.range_sigmas_m == pytest.approx([2.6e-3] * len(seen))


def test_a_blurred_echo_is_no_miss_of_what_it_may_hide_and_an_empty_frame_is() -> None:
    """Echoes of all rods run together for 6 s, or nothing is heard: only the latter is strange.

    It is no kidnapping, for no other place explains it better.
    """
    hidden, gone = robust(), robust()
    for slam in (hidden, gone):
        drive(slam, 60, straight)
    assert hidden.back_end.reported_rows()
    known, against, unheard_against = len(hidden.back_end.reported_rows()), 0.0, 0.0
    for tick in range(60, 90):
        t_ns = tick * TICK_NS
        blurred = [
            found for radar in range(4) for found in echoes(straight(t_ns), radar, t_ns, misfit=9.0)
        ]
        (result,) = hidden.step_detections(blurred, straight, t_ns)
        (unheard,) = gone.step_detections((), straight, t_ns)
        assert result.report is not None
        assert unheard.report is not None
        for report in (result.report, unheard.report):
            assert not report.carried
            assert not report.lost
        against += sum(nats for _, nats in result.report.evidence)
        unheard_against += sum(nats for _, nats in unheard.report.evidence)
    assert len(hidden.back_end.reported_rows()) == known
    assert against == 0.0
    assert unheard_against < 30 * math.log(1 - ROBUST.robust.detection_probability)


def test_a_front_end_that_predicts_nothing_is_taken_as_the_table_says() -> None:
    slam = robust(override(ROBUST, {"robust.range_sigma_m": 5e-3}))
    seen = [Detection(radar=0, t_ns=0, range_m=1.0, amplitude=0.01)]
    slam.step_detections(seen, straight, 0)
    (result,) = slam.step_detections(seen, straight, TICK_NS)
    assert result.range_sigmas_m == (5e-3,)


def test_ranges_are_taken_from_where_each_radar_was_at_its_own_time() -> None:
    """Radars 0 to 190 ms late on a turn: taken at face value they would be 5 cm off."""
    late_ns = (0, 190_000_000, 100_000_000, 150_000_000)

    def turning(t_ns: int) -> Array:
        return compose(np.array([0.3, 0.0, 0.0]), np.array([0.0, 0.0, 0.4 * t_ns / NS]))

    def path(t_ns: int) -> Array:
        ahead = straight(min(t_ns, 6 * NS))
        return ahead if t_ns <= 6 * NS else turning(t_ns - 6 * NS)

    slam = robust()
    beliefs = []
    for tick in range(46):
        t_ns = tick * TICK_NS
        seen = []
        for radar, late in enumerate(late_ns):
            seen += echoes(path(t_ns + late), radar, t_ns + late)
        beliefs += [(t_ns, row.belief) for row in slam.step_detections(seen, path, t_ns)]
    for t_ns, belief in beliefs:
        assert np.hypot(*between(path(t_ns), belief.pose)[:2]) < 1e-3


def test_standing_still_makes_no_states_and_no_evidence() -> None:
    def odometry(t_ns: int) -> Array:
        return straight(min(t_ns, 20 * TICK_NS))

    slam = robust()
    assert len(drive(slam, 20, odometry)) == 19
    before = slam.back_end.state.P.full()
    here = straight(20 * TICK_NS)
    seen = [found for radar in range(4) for found in echoes(here, radar, 20 * TICK_NS)]
    (moved,) = slam.step_detections(seen, odometry, 20 * TICK_NS)
    after = slam.back_end.state.P.full()
    assert not np.array_equal(before, after)
    for tick in range(21, 30):
        assert slam.step_detections(seen, odometry, tick * TICK_NS) == ()
    np.testing.assert_array_equal(slam.back_end.state.P.full(), after)
    assert moved.report is not None


def test_a_tick_without_frames_goes_on_by_odometry() -> None:
    slam = robust()
    slam.step((), straight, 0)
    (result,) = slam.step((), straight, TICK_NS)
    np.testing.assert_allclose(result.belief.pose, straight(TICK_NS), atol=1e-15)
    assert result.nis_per_dof == ()
    assert slam.flush() == ()


@pytest.mark.parametrize("preset", ["paper", "robust"])
def test_a_front_end_of_ones_own_gets_the_range_offset_of_each_radar(preset: str) -> None:
    class Fixed:
        def detect(self, frame: RadarFrame, range_offset_m: float = 0.0) -> tuple[Detection, ...]:
            range_m = 0.7 - range_offset_m
            return (Detection(radar=frame.radar, t_ns=frame.t_ns, range_m=range_m, amplitude=0.01),)

        def detect_many(
            self, frames: Sequence[RadarFrame], offsets_m: Sequence[float]
        ) -> list[tuple[Detection, ...]]:
            return [self.detect(*row) for row in zip(frames, offsets_m, strict=True)]

    def frame(t_ns: int, radar: int) -> RadarFrame:
        return frame_of(np.zeros(8, dtype=np.float32), radar=radar, t_ns=t_ns)

    mounts = [replace(mount, range_offset_m=0.01 * k) for k, mount in enumerate(RIG.mounts)]
    config = override(load_preset(preset), {"window.size": 1})
    slam = make_slam(config, replace(RIG, mounts=tuple(mounts)), WheelNoise(), Fixed())
    slam.step([frame(0, 2)], straight, 0)
    (result,) = slam.step([frame(TICK_NS, 2), frame(TICK_NS, 1)], straight, TICK_NS)
    assert [found.radar for found in result.detections] == [2, 1]
    assert [found.range_m for found in result.detections] == pytest.approx([0.68, 0.69])


@pytest.mark.parametrize("preset", ["paper", "robust"])
def test_parts_that_a_back_end_does_not_use_may_be_missing(preset: str) -> None:
    config, rng = load_preset(preset), np.random.default_rng(38)
    without = config.model_copy(update=dict.fromkeys(UNUSED_PARTS[config.back_end]))
    poses = []
    for each in (config, without):
        slam = make_slam(each, RIG, WheelNoise())
        for t_ns in range(0, 40 * TICK_NS, TICK_NS):
            radars = range(len(RIG.mounts))
            seen = [found for radar in radars for found in echoes(straight(t_ns), radar, t_ns)]
            rows = slam.step_detections(seen, straight, t_ns)
            poses += [row.belief.pose for row in rows[-1:]]
        samples = rng.normal(0.0, 5e-4, 200).astype(np.float32)
        slam.step([frame_of(samples, radar=0, t_ns=t_ns + TICK_NS)], straight, t_ns + TICK_NS)
    n = len(poses) // 2
    assert n > 0
    assert np.array_equal(poses[:n], poses[n:])


def test_a_map_without_walls_has_none() -> None:
    assert robust().wall_spans_m().shape == (0, 2, 2)
    assert UwbRadarSlam(load_preset("paper"), RIG).wall_spans_m().shape == (0, 2, 2)


def test_every_key_of_the_table_reaches_the_back_end() -> None:
    settings = {
        "robust.field_of_view_deg": 50.0,
        "robust.range_sigma_m": 4e-3,
        "robust.offset_sigma_m": 0.02,
        "robust.detection_probability": 0.7,
        "robust.false_ranges_per_frame": 0.26,
        "robust.wheel_walk_per_sqrt_m": 0.15,
        "robust.association_doubt_m": 3e-3,
        "robust.huber_sigmas": 2.5,
        "detection.min_range_m": 0.2,
        "detection.max_range_m": 1.5,
    }
    found = back_end_parameters(override(ROBUST, settings), WheelNoise(scale_sigma=0.01))
    ranges = found.ranges
    assert ranges.field_of_view_rad == math.radians(50.0)
    assert (ranges.sigma_m, ranges.offset_sigma_m) == (4e-3, 0.02)
    assert ranges.detection_probability == 0.7
    assert (ranges.association_sigma_m, ranges.huber_sigmas) == (3e-3, 2.5)
    assert ranges.clutter_per_m == pytest.approx(0.2)
    assert (ranges.min_range_m, ranges.max_range_m) == (0.2, 1.5)
    assert (found.wheels.scale_sigma, found.wheels.walk_per_sqrt_m) == (0.01, 0.15)


def test_the_table_refuses_what_makes_no_sense() -> None:
    with pytest.raises(ValueError, match="detection_probability"):
        RobustConfig(detection_probability=1.0)


def test_an_empty_room_gives_the_wheels() -> None:
    """To a nanometre over 20 m of a curved way, whatever the wheels report."""
    rng = np.random.default_rng(12)
    poses = [np.zeros(3)]
    for turn in rng.normal(0.0, 0.03, 1000):
        poses.append(compose(poses[-1], np.array([0.02, 0.001, turn])))
    slam = robust()
    beliefs = []
    for tick, pose in enumerate(poses):
        stamps = {tick * TICK_NS: pose}
        beliefs += [
            row.belief for row in slam.step_detections([], stamps.__getitem__, tick * TICK_NS)
        ]
    assert len(beliefs) == 1000
    path = np.array([belief.pose for belief in beliefs])
    away = path[:, :2] - np.array(poses[1:])[:, :2]
    assert np.abs(away).max() < 1e-9
    assert all(len(belief.landmark_ids) == 0 for belief in beliefs)


@pytest.mark.parametrize(("pause_s", "stood_s"), [(0.0, 0.0), (0.6, 0.0), (2.0, 2.0)])
def test_a_stop_of_a_second_is_told_from_slow_driving(
    pause_s: float, stood_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The wheels stand at 10 cm for a while; a state follows every 5 mm at 2.5 cm/s."""
    slam, asked = robust(), list[tuple[float, float]]()
    rule = slam.back_end.parameters.branches
    predict = slam._branches.predict

    def watched(increment: Array, elapsed_s: float, stood: float, covariance: None) -> None:
        asked.append((elapsed_s, stood if stood >= rule.stop_s else 0.0))
        predict(increment, elapsed_s, stood, covariance)

    monkeypatch.setattr(slam._branches, "predict", watched)
    pause_ns = round(pause_s * 1e9)

    def odometry(t_ns: int) -> Array:
        moving_ns = min(t_ns, 4_000_000_000) + max(t_ns - 4_000_000_000 - pause_ns, 0)
        return np.array([2.5e-11 * moving_ns, 0.0, 0.0])

    for t_ns in range(0, 8_000_000_000, TICK_NS):
        slam.step_detections([], odometry, t_ns)
    longest = max(asked, key=lambda pair: pair[1])
    assert longest[1] == pytest.approx(stood_s, abs=0.05)
    assert sum(stood > 0.0 for _, stood in asked) == (1 if stood_s else 0)
    assert all(elapsed > stood for elapsed, stood in asked)


def test_noise_that_comes_with_odometry_replaces_the_wheels_white_noise() -> None:
    """Straight on through an empty room: the closed form of a random walk.

    Positions err by the sum of all steps' noise, and by each heading's error times what is left.
    """
    wheels = WheelNoise(scale_sigma=0.0, turn_scale_sigma=0.0, curvature_sigma_rad_per_m=0.0)
    along, across, turn = 4e-4, 1e-4, 9e-4  # variances per second

    def noise_at(t_ns: int) -> Array:
        return np.diag([along, across, turn]) * t_ns * 1e-9

    slam = RobustSlam(ROBUST, RIG, wheels, noise_at=noise_at)
    (*_, belief) = [
        row.belief
        for tick in range(21)
        for row in slam.step_detections([], straight, tick * TICK_NS)
    ]
    n, step_s = 20, TICK_NS * 1e-9
    step_m = straight(TICK_NS)[0] - straight(0)[0]
    left = np.arange(n)  # steps behind each turn: a turn comes at the end of its step
    expected = np.diag([n * along, n * across, n * turn]) * step_s
    expected[1, 1] += turn * step_s * np.sum((left * step_m) ** 2)
    expected[1, 2] = expected[2, 1] = turn * step_s * np.sum(left * step_m)
    curved = slam.back_end.state.curved_covariance()
    linear = belief.pose_covariance - np.pad(curved, ((0, 1), (0, 1)))
    np.testing.assert_allclose(linear, expected, rtol=1e-6, atol=1e-9)


def test_noise_of_the_wheels_own_model_changes_nothing_but_roundings() -> None:
    """In a frame of odometry that is turned against the map; the floors count once."""
    wheels, start = WheelNoise(), np.array([1.0, -2.0, 0.7])

    def odometry(t_ns: int) -> Array:
        return compose(start, straight(t_ns))

    floors = np.square([wheels.floor_m, wheels.floor_m, wheels.floor_rad])
    of_step = np.diag(wheels.step_variances(straight(TICK_NS)[0], 0.0) - floors)
    turned = np.eye(3)
    turned[:2, :2] = rotation(start[2])

    def noise_at(t_ns: int) -> Array:
        return np.asarray(turned @ of_step @ turned.T * (t_ns / TICK_NS))

    by_odometry = RobustSlam(ROBUST, RIG, wheels, noise_at=noise_at)
    for expected, belief in zip(
        drive(robust(), 60, odometry), drive(by_odometry, 60, odometry), strict=True
    ):
        np.testing.assert_allclose(belief.mean, expected.mean, rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(belief.covariance, expected.covariance, rtol=1e-6, atol=1e-12)


def test_images_begin_anew_where_the_wheels_may_have_slipped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One step after the slip. In both steps no patch is taken."""
    anew, taken = list[int](), list[int]()
    tick = 0

    def scans(_: PatchScans, __: Array) -> list[RangeScan]:
        taken.append(tick)
        return []

    monkeypatch.setattr(PatchScans, "begin_anew", lambda _: anew.append(tick))
    monkeypatch.setattr(PatchScans, "scans", scans)
    slam, pose = robust(), np.zeros(3)
    for tick in range(20):
        pose = compose(pose, np.array([0.02, 0.0, 0.1 if tick == 10 else 0.0]))
        slam.step_detections([], {tick * TICK_NS: pose}.__getitem__, tick * TICK_NS)
    assert anew == [11]
    assert sorted({*range(1, 20)} - {*taken}) == [10, 11]


@pytest.mark.parametrize("every", [1, 2, 4])
def test_steps_without_a_look_cost_no_landmark(every: int) -> None:
    """A program may step more often than its radars measure."""
    slam = robust(override(ROBUST, {"robust.patches": False}))
    for tick in range(90 * every):
        t_ns = tick * TICK_NS // every
        seen = [
            RangeScan(
                radar=radar,
                ranges_m=tuple(one.range_m for one in echoes(straight(t_ns), radar, t_ns)),
            )
            for radar in range(len(RIG.mounts))
        ]
        slam.step_scans([], seen if tick % every == 0 else [], straight, t_ns)
    away_m = np.linalg.norm(slam.belief().landmarks[:, np.newaxis] - RODS, axis=2)
    # The radars behind come abreast of the third rod after the drive only: it is seen from one.
    assert sorted(away_m.argmin(axis=1).tolist()) == [0, 1, 3, 4]
    assert away_m.min(axis=1).max() < 0.02

"""The paper's pipeline: one step of it, its motion noise, and whole runs."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from hil_tests.property.ekf_oracles import complex_step, move, observe, place
from hil_tests.unit.slam.robust.range_world import CLASSROOM, LAB, Room
from hil_tests.unit.slam.simulation import FRAME_NS, World, at_rest, simulate
from slam.config import (
    AssociationConfig,
    ClusteringConfig,
    EndOfRun,
    MotionConfig,
    MotionNoise,
    ObservationConfig,
    SampleTime,
    SlamConfig,
    WindowConfig,
    load_preset,
    override,
)
from slam.frames import Detection
from slam.geometry import paper_rig
from slam.library.evaluation import ate_rmse_m
from slam.paper.ekf import motion_noise
from slam.paper.pipeline import UwbRadarSlam
from slam.results import StepResult

Array = NDArray[np.float64]


def run(world: World, config: SlamConfig) -> list[StepResult]:
    slam = UwbRadarSlam(config, paper_rig())
    results: list[StepResult] = []
    for t_ns, detections, pose in zip(
        world.stamps(), world.detections, world.odometry, strict=True
    ):
        results += slam.step_detections(detections, at_rest(pose), t_ns)
    return results + list(slam.flush())


def trajectories(results: list[StepResult], world: World) -> tuple[Array, Array]:
    rows = [result.t_ns // FRAME_NS for result in results]
    return np.array([r.belief.pose[:2] for r in results]), world.truth[rows, :2]


def drive(slam: UwbRadarSlam, poses: list[Array]) -> list[int]:
    """Return the stamps that come out, one list entry per pose that went in."""
    return [
        result.t_ns
        for k, pose in enumerate(poses)
        for result in slam.step_detections((), at_rest(pose), k)
    ]


def straight(n: int, step_m: float = 0.01) -> list[Array]:
    return [np.array([step_m * k, 0.0, 0.0]) for k in range(n)]


def test_estimates_lag_window_minus_one_states() -> None:
    slam = UwbRadarSlam(SlamConfig(), paper_rig())
    assert drive(slam, straight(15)) == []  # the first pose is the origin, not a state
    (result,) = slam.step_detections((), at_rest(np.array([0.15, 0.0, 0.0])), 15)
    assert result.t_ns == 1
    assert result.belief.pose == pytest.approx([0.01, 0.0, 0.0], abs=1e-12)
    (result,) = slam.step_detections((), at_rest(np.array([0.16, 0.0, 0.0])), 16)
    assert result.t_ns == 2


@pytest.mark.parametrize(("end_of_run", "last"), [(EndOfRun.DROP, 6), (EndOfRun.FLUSH, 20)])
def test_end_of_run(end_of_run: EndOfRun, last: int) -> None:
    slam = UwbRadarSlam(SlamConfig(window=WindowConfig(end_of_run=end_of_run)), paper_rig())
    stamps = drive(slam, straight(21)) + [result.t_ns for result in slam.flush()]
    assert stamps == list(range(1, last + 1))
    assert slam.flush() == ()


def test_standing_still_or_creeping_collects_nothing_until_five_millimetres_add_up() -> None:
    config = SlamConfig(window=WindowConfig(size=1))
    slam = UwbRadarSlam(config, paper_rig())
    creeping = [np.zeros(3)] * 50 + straight(13, step_m=0.0026)
    assert drive(slam, creeping) == [52, 54, 56, 58, 60, 62]


def test_turn_through_pi_is_measured_wrapped() -> None:
    config = SlamConfig(window=WindowConfig(size=1))
    slam = UwbRadarSlam(config, paper_rig())
    headings = [math.pi - 0.02, -math.pi + 0.02, -math.pi + 0.2]
    assert drive(slam, [np.array([0.0, 0.0, heading]) for heading in headings]) == [2]


def test_map_frame_is_the_first_odometry_pose() -> None:
    config = SlamConfig(window=WindowConfig(size=1))
    slam = UwbRadarSlam(config, paper_rig())
    poses = [np.array([3.0, 4.0, math.pi / 2]), np.array([3.0, 4.5, math.pi])]
    drive(slam, poses)
    assert slam.belief.pose == pytest.approx([0.5, 0.0, math.pi / 2], abs=1e-12)


def test_lost_frame_of_one_radar_costs_only_the_fixes_of_its_pair() -> None:
    rig = paper_rig()
    slam = UwbRadarSlam(SlamConfig(window=WindowConfig(size=1)), rig)
    seen = [Detection(radar=k, t_ns=1, range_m=0.8, amplitude=0.01) for k in (0, 2, 3)]
    slam.step_detections((), at_rest(np.zeros(3)), 0)
    (result,) = slam.step_detections(seen, at_rest(np.array([0.01, 0.0, 0.0])), 1)
    assert [fix.pair for fix in result.fixes] == [1]
    assert result.fixes[0].y_m < 0


def test_stride_updates_only_every_nth_state_and_predicts_the_others() -> None:
    config = SlamConfig(window=WindowConfig(size=10, stride=5))
    slam = UwbRadarSlam(config, paper_rig())
    seen = [Detection(radar=k, t_ns=0, range_m=0.8, amplitude=0.01) for k in (0, 1)]
    results = [
        result
        for k, pose in enumerate(straight(30, step_m=0.006))
        for result in slam.step_detections(seen, at_rest(pose), k)
    ]
    assert [k for k, result in enumerate(results) if result.observations] == [0, 5, 10, 15]
    assert all(result.belief.pose[0] > 0 for result in results)


def bytes_of(results: list[StepResult]) -> list[bytes]:
    return [
        r.belief.mean.tobytes()
        + r.belief.covariance.tobytes()
        + repr([(fix.x_m, fix.y_m) for fix in r.fixes]).encode()
        for r in results
    ]


@pytest.mark.parametrize("sample_time", list(SampleTime))
def test_the_rule_of_sample_times_changes_no_bit_where_it_must_not(sample_time: SampleTime) -> None:
    """Take all samples at once under "own"; under "nominal", at any time within the frame."""
    world = simulate(LAB, 5, laps=1).cut(300)  # with a corner
    paper = load_preset("paper")
    changed = override(paper, {"trilateration.sample_time": sample_time.value})
    if sample_time is SampleTime.NOMINAL:
        skewed = [
            tuple(replace(d, t_ns=d.t_ns + d.radar * 50_000_000) for d in frame)
            for frame in world.detections
        ]
        other = replace(world, detections=skewed)
    else:
        other = world
    results = run(other, changed)
    assert sum(len(r.fixes) for r in results) > 100
    assert bytes_of(results) == bytes_of(run(world, paper))


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize(("room", "environment"), [(LAB, "lab"), (CLASSROOM, "classroom")])
def test_slam_beats_the_odometry_it_is_given(room: Room, environment: str) -> None:
    """Drive four laps on three seeds; `uwb-slam sweep` has the statistics."""
    errors = []
    for seed in range(3):
        world = simulate(room, seed)
        results = run(world, load_preset("paper", environment))
        odometry_ate = ate_rmse_m(world.odometry[:, :2], world.truth[:, :2])
        errors.append((ate_rmse_m(*trajectories(results, world)), odometry_ate))
    slam_ate, odometry_ate = np.median(errors, axis=0)
    assert slam_ate < 0.8 * odometry_ate


EVERY_STATE = WindowConfig(size=1)
EVERY_FIX = ClusteringConfig(min_observations=1)


def step(slam: UwbRadarSlam, pose: Array, *ranges_m: float) -> StepResult:
    seen = [Detection(radar=k, t_ns=0, range_m=r, amplitude=0.01) for k, r in enumerate(ranges_m)]
    (result,) = slam.step_detections(seen, at_rest(pose), 0)
    return result


def ranges_of(u_m: float, v_m: float) -> tuple[float, float]:
    """Ranges from the left pair of a point u along the robot and v left of it, body frame."""
    return math.hypot(u_m + 0.1, v_m - 0.2), math.hypot(u_m - 0.1, v_m - 0.2)


def test_belief_after_motion_birth_and_second_look_is_the_textbooks() -> None:
    config = SlamConfig(
        window=EVERY_STATE,
        clustering=EVERY_FIX,
        motion=MotionConfig(sigma_xy_m=0.01, sigma_heading_rad=0.03),
        observation=ObservationConfig(sigma_range_m=0.02, sigma_bearing_rad=0.3),
        association=AssociationConfig(gate=100.0),
    )
    slam = UwbRadarSlam(config, paper_rig())
    slam.step_detections((), at_rest(np.array([4.0, 5.0, 0.3])), 0)
    R, Q = np.diag([0.01**2, 0.01**2, 0.03**2]), np.diag([0.02**2, 0.3**2])

    # First step: 5 cm ahead and a turn of 0.2 rad; a landmark at (0.05, 1.0) in the body.
    u = np.array([0.05, 0.0, 0.2])
    c, s = math.cos(0.3), math.sin(0.3)
    odometry = np.array([4.0 + 0.05 * c, 5.0 + 0.05 * s, 0.5])
    born = step(slam, odometry, *ranges_of(0.05, 1.0)).belief
    z = np.array([math.hypot(0.05, 1.0), math.atan2(1.0, 0.05)])
    mean = np.concatenate([u, place(u.astype(complex), z.astype(complex)).real])
    G_pose = complex_step(lambda p: place(p, z.astype(complex)), u)
    G_obs = complex_step(lambda o: place(u.astype(complex), o), z)
    P = np.block([[R, R @ G_pose.T], [G_pose @ R, G_pose @ R @ G_pose.T + G_obs @ Q @ G_obs.T]])
    assert born.mean == pytest.approx(mean, abs=1e-12)
    assert born.covariance == pytest.approx(P, abs=1e-12)

    # Second step: 2 cm ahead; the same landmark, now at (0.0, 1.1) in the body.
    u = np.array([0.02, 0.0, 0.0])
    odometry = odometry + 0.02 * np.array([math.cos(0.5), math.sin(0.5), 0.0])
    result = step(slam, odometry, *ranges_of(0.0, 1.1))
    F = np.eye(5)
    F[:3, :3] = complex_step(lambda p: move(p, u.astype(complex)), mean[:3])
    mean[:3] = move(mean[:3].astype(complex), u.astype(complex)).real
    P = F @ P @ F.T
    P[:3, :3] += R
    H = complex_step(lambda x: observe(x[:3], x[3:]), mean)
    nu = np.array([1.1, math.pi / 2]) - observe(mean[:3].astype(complex), mean[3:] + 0j).real
    S = H @ P @ H.T + Q
    K = P @ H.T @ np.linalg.inv(S)
    rest = np.eye(5) - K @ H
    assert result.belief.mean == pytest.approx(mean + K @ nu, abs=1e-12)
    assert result.belief.covariance == pytest.approx(rest @ P @ rest.T + K @ Q @ K.T, abs=1e-12)
    (nis,) = result.nis
    assert nis == pytest.approx(float(nu @ np.linalg.solve(S, nu)), rel=1e-9)


def test_proportional_noise_lies_along_the_robots_heading_in_the_map() -> None:
    motion = MotionConfig(noise=MotionNoise.PROPORTIONAL)
    slam = UwbRadarSlam(SlamConfig(window=EVERY_STATE, motion=motion), paper_rig())
    slam.step_detections((), at_rest(np.zeros(3)), 0)
    step(slam, np.array([0.0, 0.0, math.pi / 2]))  # a turn on the spot: heading alone is unsure
    P = step(slam, np.array([0.0, 0.04, math.pi / 2])).belief.pose_covariance
    turned = (0.01 * math.pi / 2) ** 2
    wanted = np.zeros((3, 3))
    wanted[0, 0] = 0.04 * 6e-4**2 + 0.04**2 * turned
    wanted[1, 1] = 0.04 * 2e-3**2
    wanted[2, 2] = 0.04 * 4.2e-3**2 + turned
    wanted[0, 2] = wanted[2, 0] = -0.04 * turned
    assert pytest.approx(wanted, rel=1e-9, abs=1e-18) == P


def test_as_printed_every_step_adds_the_same_in_world_axes() -> None:
    wanted = np.diag([1e-8, 1e-8, 4e-4])
    for increment in (np.zeros(3), np.array([0.01, 0.0, 0.0]), np.array([0.0, 0.0, 0.1])):
        for heading in (0.0, 1.0):
            assert np.array_equal(motion_noise(increment, heading, MotionConfig()), wanted)


@pytest.mark.parametrize("heading", [0.0, math.pi / 6, -2.0])
def test_proportional_noise_lies_along_the_robot(heading: float) -> None:
    config = MotionConfig(noise=MotionNoise.PROPORTIONAL)
    R = motion_noise(np.array([0.04, 0.0, 0.0]), heading, config)
    along = np.array([math.cos(heading), math.sin(heading)])
    across = np.array([-along[1], along[0]])
    assert along @ R[:2, :2] @ along == pytest.approx(0.04 * 2e-3**2)
    assert across @ R[:2, :2] @ across == pytest.approx(0.04 * 6e-4**2)
    assert along @ R[:2, :2] @ across == pytest.approx(0.0, abs=1e-15)
    assert R[2, 2] == pytest.approx(0.04 * 4.2e-3**2)


def test_proportional_noise_of_many_small_steps_equals_that_of_one() -> None:
    config = MotionConfig(noise=MotionNoise.PROPORTIONAL)
    many = 10 * motion_noise(np.array([0.01, 0.0, 0.0]), 0.3, config)
    assert many == pytest.approx(motion_noise(np.array([0.1, 0.0, 0.0]), 0.3, config))


def test_turn_on_the_spot_costs_heading_only() -> None:
    config = MotionConfig(noise=MotionNoise.PROPORTIONAL)
    R = motion_noise(np.array([0.0, 0.0, -0.1]), 0.3, config)
    assert pytest.approx(np.diag([0.0, 0.0, (0.01 * 0.1) ** 2])) == R

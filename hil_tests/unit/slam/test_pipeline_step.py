"""One step of Algorithm 1, every matrix written out by hand."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from hil_tests.property.ekf_oracles import complex_step, move, observe, place
from hil_tests.unit.slam.pose_tracks import at_rest
from slam.config import (
    AssociationConfig,
    ClusteringConfig,
    MotionConfig,
    MotionNoise,
    ObservationConfig,
    SlamConfig,
    WindowConfig,
)
from slam.frames import Detection, RadarFrame
from slam.geometry import Mount, Rig, paper_rig
from slam.paper.pipeline import UwbRadarSlam
from slam.results import StepResult

Array = NDArray[np.float64]

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


def test_range_offset_of_each_mount_is_subtracted() -> None:
    mounts = tuple(
        Mount(name=m.name, x_m=m.x_m, y_m=m.y_m, yaw_rad=m.yaw_rad, range_offset_m=0.05 * k)
        for k, m in enumerate(paper_rig().mounts)
    )
    slam = UwbRadarSlam(SlamConfig(window=EVERY_STATE), Rig(mounts=mounts))
    labels = 0.2 + 0.01 * np.arange(200)
    # Every module labels its echo 0.9 m.
    echo = 0.02 * np.exp(-0.5 * ((labels - 0.9) / 0.05) ** 2)
    frames = [
        RadarFrame(
            radar=radar,
            t_ns=1,
            counter=1,
            samples=echo.astype(np.float32),
            range_start_m=0.2,
            bin_length_m=0.01,
        )
        for radar in range(4)
    ]
    slam.step((), at_rest(np.zeros(3)), 0)
    (result,) = slam.step(frames, at_rest(np.array([0.01, 0.0, 0.0])), 1)
    found = {detection.radar: detection.range_m for detection in result.detections}
    assert found == {k: pytest.approx(0.9 - 0.05 * k, abs=1e-9) for k in range(4)}

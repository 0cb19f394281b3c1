"""Wheel odometry follows its model, and its drift is the one that SLAM is judged against."""

import math
from decimal import Decimal
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.scene.motion import drive
from emulator.scene.scene import CarriedSpec, OdometrySpec, load_scene
from emulator.scene.wheels import drift, odometry_times_ns, scene_odometry, tum_line
from slam.library.evaluation import ate_rmse_m


def straight(length_m: float, steps: int) -> NDArray[np.float64]:
    poses = np.zeros((steps + 1, 3))
    poses[:, 0] = np.linspace(0, length_m, steps + 1)
    return poses


@pytest.mark.parametrize(
    ("scene", "median_m", "margin_m"),
    [("lab", 0.053, 0.010), pytest.param("classroom", 0.330, 0.070, marks=pytest.mark.thorough)],
)
def test_ate_over_seeds_0_to_99_is_that_of_the_robot_class(
    scene: str, median_m: float, margin_m: float
) -> None:
    loaded = load_scene(scene)
    trajectory = loaded.trajectory()
    truth = trajectory.poses(odometry_times_ns(trajectory.duration_ns, loaded.odometry.rate_hz))
    runs = [drift(truth, loaded.odometry, seed=seed)[:, :2] for seed in range(100)]
    ates = [ate_rmse_m(run, truth[:, :2]) for run in runs]
    assert np.median(ates) == pytest.approx(median_m, abs=margin_m)


@pytest.mark.parametrize(
    ("scene", "tau", "curvature"), [("lab", 0.007, 0.0042), ("classroom", 0.023, 0.0139)]
)
def test_scenes_state_the_wheel_models_values(scene: str, tau: float, curvature: float) -> None:
    assert load_scene(scene).odometry == OdometrySpec(
        rate_hz=5.0,
        scale_sigma=tau,
        turn_scale_sigma=tau,
        curvature_sigma_rad_per_m=curvature,
        along_sigma_m_per_sqrt_m=0.002,
        across_sigma_m_per_sqrt_m=0.0006,
        heading_sigma_rad_per_sqrt_m=curvature,
        heading_sigma_rad_per_rad=0.01,
    )


def test_perfect_wheels_report_the_truth() -> None:
    scene = load_scene("lab")
    truth = scene.trajectory().poses(odometry_times_ns(scene.trajectory().duration_ns, 5.0))
    reported = drift(truth, OdometrySpec(), seed=1)
    np.testing.assert_allclose(reported, truth, atol=1e-12)


def test_increments_invert_to_the_true_ones_with_the_runs_constants() -> None:
    """The filter's prediction model, given s, w and kappa, undoes the drift exactly."""
    model = OdometrySpec(scale_sigma=0.03, turn_scale_sigma=0.04, curvature_sigma_rad_per_m=0.02)
    truth = drive([(0, 0), (1, 0), (1, 1), (0, 0)], speed_mps=0.1, turn_rate_rad_per_s=0.5).poses(
        np.arange(0, 50_000_000_000, 200_000_000)
    )
    reported = drift(truth, model, seed=8)
    s = drift(straight(1.0, 1), OdometrySpec(scale_sigma=0.03), seed=8)[-1, 0] - 1
    turn = np.array([[0, 0, 0], [0, 0, 1.0]])
    w = drift(turn, OdometrySpec(turn_scale_sigma=0.04), seed=8)[-1, 2] - 1
    kappa = drift(straight(1.0, 1), OdometrySpec(curvature_sigma_rad_per_m=0.02), seed=8)[-1, 2]
    assert 0 not in (s, w, kappa)

    pose = np.zeros(3)
    for previous, current in pairwise(reported):
        cosine, sine = math.cos(previous[2]), math.sin(previous[2])
        step = current[:2] - previous[:2]
        d = np.array([cosine * step[0] + sine * step[1], cosine * step[1] - sine * step[0]]) / (
            1 + s
        )
        a = (current[2] - previous[2] - kappa * np.hypot(*d)) / (1 + w)
        cosine, sine = math.cos(pose[2]), math.sin(pose[2])
        pose += np.array([cosine * d[0] - sine * d[1], sine * d[0] + cosine * d[1], a])
    np.testing.assert_allclose(pose, truth[-1], atol=1e-10)


def test_constants_of_runs_are_normal_with_the_stated_sigmas() -> None:
    n = 2000
    scales = [
        drift(straight(1.0, 1), OdometrySpec(scale_sigma=1.0), seed=seed)[-1, 0] - 1
        for seed in range(n)
    ]
    assert abs(np.mean(scales)) < 4 / math.sqrt(n)
    assert abs(np.std(scales) - 1) < 4 / math.sqrt(2 * n)


@pytest.mark.parametrize("steps", [500, pytest.param(2000, marks=pytest.mark.thorough)])
def test_white_noise_of_a_leg_does_not_depend_on_the_step(steps: int) -> None:
    """Over 10 m: heading h sqrt(10); along 2 mm sqrt(10) when the heading is exact."""
    n = 150
    along = OdometrySpec(along_sigma_m_per_sqrt_m=0.002)
    across = OdometrySpec(across_sigma_m_per_sqrt_m=0.0006)
    heading = OdometrySpec(heading_sigma_rad_per_sqrt_m=0.0042)
    truth = straight(10.0, steps)
    errors = {
        "along": [drift(truth, along, seed=seed)[-1, 0] - 10 for seed in range(n)],
        "across": [drift(truth, across, seed=seed)[-1, 1] for seed in range(n)],
        "heading": [drift(truth, heading, seed=seed)[-1, 2] for seed in range(n)],
    }
    for key, sigma in (("along", 0.002), ("across", 0.0006), ("heading", 0.0042)):
        expected = sigma * math.sqrt(10)
        assert np.sqrt(np.mean(np.square(errors[key]))) == pytest.approx(
            expected, rel=4 / math.sqrt(2 * n)
        )


def test_white_noise_of_a_turn_is_a_hundredth_of_each_step() -> None:
    truth = np.zeros((4001, 3))
    truth[:, 2] = np.arange(4001) * math.radians(5.625)
    reported = drift(truth, OdometrySpec(heading_sigma_rad_per_rad=0.01), seed=2)
    noise = np.diff(reported[:, 2]) - math.radians(5.625)
    assert noise.std() == pytest.approx(0.01 * math.radians(5.625), rel=4 / math.sqrt(8000))


def test_lines_are_tum_and_reproduce_every_float() -> None:
    scene = load_scene("lab")
    times = odometry_times_ns(scene.trajectory().duration_ns, 5.0)
    poses = drift(scene.trajectory().poses(times), scene.odometry, seed=4)
    lines = scene_odometry(scene, 4)
    assert lines != scene_odometry(scene, 5)
    assert lines[0] == "0.000000000 0.0 0.0 0 0 0 0.0 1.0"
    for t_ns, (x, y, heading), line in zip(times, poses, lines, strict=True):
        stamp, *numbers = line.split(" ")
        assert Decimal(stamp) * 10**9 == int(t_ns)
        values = [float(number) for number in numbers]
        assert values[:5] == [x, y, 0, 0, 0]
        assert 2 * math.atan2(values[5], values[6]) - heading == pytest.approx(
            math.tau * round((2 * math.atan2(values[5], values[6]) - heading) / math.tau), abs=1e-12
        )


@pytest.mark.parametrize(
    ("duration_ns", "rate_hz", "last_ns", "count"),
    [
        (691_200_000_000, 5.0, 691_200_000_000, 3457),
        (1_000_000_000, 3.0, 1_000_000_000, 4),
        (1_000_000_001, 3.0, 1_333_333_333, 5),
        (0, 5.0, 0, 1),
    ],
)
def test_times_cover_the_drive(duration_ns: int, rate_hz: float, last_ns: int, count: int) -> None:
    times = odometry_times_ns(duration_ns, rate_hz)
    assert (times[-1], len(times)) == (last_ns, count)


def test_tum_line_of_a_quarter_turn() -> None:
    stamp, x, y, *_zeros, qz, qw = tum_line(1_000_000_005, (1.5, -0.1, math.pi / 2)).split(" ")
    assert (stamp, x, y) == ("1.000000005", "1.5", "-0.1")
    assert float(qz) == pytest.approx(math.sqrt(0.5), abs=1e-15)
    assert float(qw) == pytest.approx(math.sqrt(0.5), abs=1e-15)


def test_walking_errors_spread_like_a_random_walk_and_leave_the_rest_alone() -> None:
    """The scale's spread about its start grows by 0.1 of its sigma per root second, to 1."""
    still = OdometrySpec(rate_hz=4.0, scale_sigma=0.02, along_sigma_m_per_sqrt_m=1e-3)
    walking = still.model_copy(update={"walk_per_sqrt_s": 0.1})
    truth = straight(4.0, 400)  # 100 s
    strayed = []
    for seed in range(200):
        steps = [np.diff(drift(truth, model, seed=seed)[:, 0]) for model in (still, walking)]
        strayed.append((steps[1] - steps[0]) / 0.01 / 0.02)  # in standard deviations
    walk = np.array(strayed)
    np.testing.assert_allclose(walk[:, 0], 0.0, atol=1e-9)
    # 200 seeds know a standard deviation to 5 %
    np.testing.assert_allclose(walk[:, [100, 200, 399]].std(axis=0), [0.5, 0.707, 1.0], rtol=0.15)
    increments = np.diff(walk, axis=1)
    assert increments.std() == pytest.approx(0.05, rel=0.01)
    assert abs(np.corrcoef(increments[:, 10], increments[:, 11])[0, 1]) < 0.2


def test_wheels_do_not_see_that_the_robot_is_carried() -> None:
    lab = load_scene("lab")
    there = lab.model_copy(
        update={
            "odometry": OdometrySpec(),
            "path": lab.path.model_copy(
                update={"carried": CarriedSpec(at_s=60.0, skips_s=100.0, takes_s=3.0)}
            ),
        }
    )
    driven = lab.trajectory().poses(np.array([60, 160, 170]) * 10**9)
    true = there.trajectory().poses(np.array([60, 63, 73]) * 10**9)
    np.testing.assert_allclose(true, driven, atol=1e-12)
    assert there.trajectory().duration_ns == lab.trajectory().duration_ns - 97 * 10**9
    lines = scene_odometry(there, 0)
    wheels = np.array([[float(word) for word in line.split()] for line in lines])
    at_60, at_63, at_73 = (wheels[np.searchsorted(wheels[:, 0], t)] for t in (60, 63, 73))
    np.testing.assert_array_equal(at_60[1:], at_63[1:])
    driven_m = np.hypot(*(driven[2, :2] - driven[1, :2]))
    assert np.hypot(*(at_73[1:3] - at_63[1:3])) == pytest.approx(driven_m, abs=1e-9)


SLIPPERY = OdometrySpec(slips_per_s=0.05, slip_sigma_m=0.015, slip_sigma_deg=2.0)


def test_wheels_slip_every_20_s_forwards_and_by_a_turn() -> None:
    n = 100_000
    reported = drift(straight(5000.0, n), SLIPPERY, seed=5)
    turns = np.diff(reported[:, 2])
    steps = np.hypot(*np.diff(reported[:, :2], axis=0).T) - 0.05
    slipped = abs(turns) > 1e-12
    # binomial: 5 samples/s, so a slip in a hundredth of them; 1000 slips
    assert slipped.sum() == pytest.approx(1000, abs=4 * math.sqrt(1000))
    assert abs(steps[~slipped]).max() < 1e-9
    assert (steps[slipped] >= 0).all()
    assert np.sqrt(np.mean(steps[slipped] ** 2)) == pytest.approx(0.015, rel=4 / math.sqrt(2000))
    assert turns[slipped].std() == pytest.approx(math.radians(2), rel=4 / math.sqrt(2000))
    assert abs(turns[slipped].mean()) < 4 * math.radians(2) / math.sqrt(1000)


def test_slip_changes_no_other_error_of_the_wheels_and_not_in_the_air() -> None:
    lab = load_scene("lab").odometry
    truth = straight(10.0, 500)
    in_the_air = np.zeros(500, dtype=bool)
    in_the_air[100:400] = True
    sizes = SLIPPERY.model_dump(include={"slips_per_s", "slip_sigma_m", "slip_sigma_deg"})
    both = lab.model_copy(update=sizes)
    increments = [
        np.diff(drift(truth, model, seed=6, unseen=in_the_air)[:, 2]) for model in (lab, both)
    ]
    apart = np.flatnonzero(abs(increments[0] - increments[1]) > 1e-12)
    assert 0 < len(apart) < 20
    assert not in_the_air[apart].any()

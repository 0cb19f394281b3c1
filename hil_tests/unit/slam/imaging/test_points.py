"""Points and walls of patches against closed forms: echoes whose places are known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from slam.config import SlamConfig, WheelNoise
from slam.frames import RadarFrame
from slam.front_end.pulse import ModulePulse, PulseModel
from slam.front_end.pulse_estimation import PulseEstimator
from slam.geometry import FieldOfView, Mount, ReceivedPulse, Rig, compose, transform
from slam.imaging.imager import ImagedPatch, Imager
from slam.imaging.kernels import remove_bursts
from slam.imaging.patches import Patch, seen_from
from slam.imaging.points import (
    PatchLine,
    PatchPoint,
    PointRule,
    lines_of,
    points_of,
)
from slam.imaging.range_profiles import ProfileFilter, RangeProfiles
from slam.imaging.reflectors import SeparationRule, separated

Array = NDArray[np.float64]

PULSE = ModulePulse(model=PulseModel(), error=0.08)
BIN_M = 299_792_458.0 / (2 * 23.328e9)
START_M, N_BINS = 0.2, 260
K = 4 * math.pi * PULSE.model.carrier_hz / 299_792_458.0
MOUNT = Mount(x_m=0.1, y_m=0.2, yaw_rad=math.pi / 2)
VIEW = FieldOfView()
MIDDLE = 12
NO_WHEELS = WheelNoise(
    along_m_per_sqrt_m=0.0,
    across_m_per_sqrt_m=0.0,
    heading_rad_per_sqrt_m=0.0,
    heading_rad_per_rad=0.0,
    scale_sigma=0.0,
    turn_scale_sigma=0.0,
    curvature_sigma_rad_per_m=0.0,
    floor_m=0.0,
    floor_rad=0.0,
)
SIGMA = 2e-4  # of white noise per RF sample
RULE = PointRule()


def straight(n: int = 25, step_m: float = 0.01) -> Array:
    """Return body poses (n, 3) along x, the one in the middle at the origin."""
    x = step_m * (np.arange(n) - n // 2)
    return np.column_stack([x, np.zeros(n), np.zeros(n)])


def rf_frames(ranges_m: Array, amplitudes: Array, phase_rad: float = 0.3) -> Array:
    """Return frames (n, N_BINS) with one echo each."""
    x = START_M + BIN_M * np.arange(N_BINS) - ranges_m[:, np.newaxis]
    envelope = np.exp(-0.5 * (x / PULSE.model.sigma_m) ** 2)
    return np.asarray(amplitudes[:, np.newaxis] * envelope * np.cos(K * x + phase_rad))


def antennas_of(poses: Array) -> Array:
    return np.array([transform(pose, np.array([MOUNT.x_m, MOUNT.y_m])) for pose in poses])


def of_point(poses: Array, place: Sequence[float], amplitude: float = 0.01) -> Array:
    ways = np.array(place) - antennas_of(poses)
    ranges_m = np.linalg.norm(ways, axis=1)
    yaw = poses[:, 2] + MOUNT.yaw_rad
    cosine = np.sum(ways * np.column_stack([np.cos(yaw), np.sin(yaw)]), axis=1) / ranges_m
    return rf_frames(ranges_m, amplitude * cosine**2 * ranges_m**-1.5)


def of_wall(poses: Array, y_m: float, amplitude: float = 0.04) -> Array:
    ranges_m = y_m - antennas_of(poses)[:, 1]
    return rf_frames(ranges_m, amplitude / ranges_m)


def patch_of(frames: Array, poses: Array | None = None, middle: int = MIDDLE) -> Patch:
    return Patch(
        radar=0,
        mount=MOUNT,
        view=VIEW,
        t_ns=np.arange(len(frames), dtype=np.int64) * 200_000_000,
        poses=straight() if poses is None else poses,
        middle=middle,
        origin=np.zeros(3),
        profiles=ProfileFilter(PULSE, frames.shape[1], BIN_M).apply(frames, START_M),
    )


def patch_points(patch: Patch, rule: PointRule = RULE) -> tuple[PatchPoint, ...]:
    return points_of(patch, separated(patch, rule.separation), rule)


def patch_lines(patch: Patch) -> tuple[PatchLine, ...]:
    return lines_of(patch, separated(patch, RULE.separation), RULE)


def noise(seed: int, sigma: float = SIGMA) -> Array:
    return np.random.default_rng(seed).normal(0.0, sigma, (25, N_BINS))


def places(points: Sequence[PatchPoint]) -> Array:
    return np.array([(point.x_m, point.y_m) for point in points]).reshape(-1, 2)


def test_what_was_in_the_beam_from_one_place_only_has_no_bearing() -> None:
    """Two frames, a second apart and 0.3 m, of which one looks at the rod: no point, no warning."""
    poses = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]])
    patch = patch_of(of_point(poses, (0.1, 1.0)) + noise(1)[:2], poses, middle=0)
    reflectors = separated(patch, RULE.separation)
    assert len(reflectors.levels)
    alone = replace(reflectors, levels=reflectors.levels * np.array([1.0, 0.0]))
    with np.errstate(all="raise"):
        assert points_of(patch, alone, RULE) == ()


@pytest.mark.parametrize("place", [(0.1, 1.1), (0.45, 1.0), (-0.3, 1.3), (0.2, 0.6)])
def test_without_noise_a_point_is_where_it_is(place: tuple[float, float]) -> None:
    (point,) = patch_points(patch_of(of_point(straight(), place)))
    assert math.dist((point.x_m, point.y_m), place) < 5e-4
    assert point.range_m == pytest.approx(math.dist(place, (0.1, 0.2)), abs=3e-4)
    assert point.amplitude == pytest.approx(0.01, rel=0.1)


def test_points_25_cm_apart_are_two() -> None:
    true = np.array([(0.0, 1.0), (0.25, 1.0)])
    frames = sum(of_point(straight(), place) for place in true)
    found = places(patch_points(patch_of(frames + noise(1))))
    assert len(found) == 2
    assert np.linalg.norm(found[np.argsort(found[:, 0])] - true, axis=1).max() < 3e-3


def test_a_weak_point_in_range_of_a_strong_one_is_found_beyond_its_pulse() -> None:
    frames = of_point(straight(), (0.1, 0.8)) + of_point(straight(), (0.0, 1.3), 0.004)
    found = places(patch_points(patch_of(frames + noise(2))))
    assert np.linalg.norm(found - [(0.1, 0.8), (0.0, 1.3)], axis=1).max() < 4e-3


@pytest.mark.parametrize("amplitude", [0.12, 0.18, 0.25])
def test_an_echo_that_the_sampler_cuts_off_is_one_and_not_sure(amplitude: float) -> None:
    """Less than half a metre away it is 5 to 12 times the limit; what is left looks like two."""
    limit = 0.074
    frames = of_point(straight(), (0.2, 0.6), amplitude) + of_point(straight(), (0.0, 1.3))
    frames += noise(3)
    patch = replace(patch_of(np.clip(frames, -limit, limit)), cut=np.abs(frames) > limit)
    near, far = patch_points(patch)
    assert abs(near.range_m - math.dist((0.2, 0.6), (0.1, 0.2))) < 2 * near.sigma_m
    assert near.sigma_m > 10 * far.sigma_m
    assert math.dist((far.x_m, far.y_m), (0.0, 1.3)) < 4e-3
    few = np.zeros_like(frames, dtype=np.bool_)
    few[:3] = np.abs(frames[:3]) > limit
    as_whole, unknown = (patch_points(replace(patch, cut=cut)) for cut in (few, None))
    np.testing.assert_array_equal(places(as_whole), places(unknown))


def test_noise_alone_has_no_points_and_no_walls() -> None:
    # 60 patches of some 250 resolution cells: one false alarm would be 7e-5 per cell.
    for seed in range(60):
        patch = patch_of(noise(seed))
        assert not patch_points(patch)
        assert not patch_lines(patch)


def test_a_wall_is_a_line_and_no_point() -> None:
    patch = patch_of(of_wall(straight(), 1.15) + noise(3))
    assert not patch_points(patch)
    (line,) = patch_lines(patch)
    assert line.normal == pytest.approx([0.0, 1.0], abs=2e-3)
    assert line.distance_m == pytest.approx(1.15, abs=5e-4)
    assert line.ends_m == pytest.approx(np.array([(-0.02, 1.15), (0.22, 1.15)]), abs=3e-3)


def test_a_near_wall_is_one_line() -> None:
    patch = patch_of(of_wall(straight(), 0.55) + noise(4))
    assert not patch_points(patch)
    assert [line.distance_m for line in patch_lines(patch)] == pytest.approx([0.55], abs=1e-3)


def looking_ahead() -> Array:
    """Return body poses (n, 3) along x, on which the antenna looks along x, too."""
    return straight() - [0.0, 0.0, MOUNT.yaw_rad]


def turning(lever_m: float = math.hypot(MOUNT.x_m, MOUNT.y_m)) -> Array:
    """Return body poses (n, 3) of a turn on the spot, on which the antenna makes as much way."""
    turns = (np.arange(25) - MIDDLE) * 0.01 / lever_m - MOUNT.yaw_rad
    return np.column_stack([np.zeros(25), np.zeros(25), turns])


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_what_is_beside_a_way_looks_like_its_mirror_image_to_an_antenna_ahead(side: float) -> None:
    """The antenna is 0.1 m right of the body; the rod 0.4 m beside its way, 1 m ahead."""
    poses = looking_ahead()
    (point,) = patch_points(patch_of(of_point(poses, (1.2, -0.1 + side * 0.4)) + noise(6), poses))
    assert point.mirrored_rad is not None
    bearings_rad = sorted([point.bearing_rad, point.mirrored_rad])
    assert bearings_rad == pytest.approx([-math.atan(0.4), math.atan(0.4)], abs=0.02)
    turns = turning()
    (point,) = patch_points(patch_of(of_point(turns, (1.2, -0.1 + side * 0.4)) + noise(6), turns))
    assert point.mirrored_rad is None
    assert point.bearing_rad == pytest.approx(side * math.atan(0.4), abs=0.02)


def test_an_antenna_that_looks_aside_has_no_mirror_images_in_its_beam() -> None:
    for place in ((0.1, 1.1), (0.45, 1.0), (-0.3, 1.3)):
        (point,) = patch_points(patch_of(of_point(straight(), place) + noise(7)))
        assert point.mirrored_rad is None


@pytest.mark.parametrize("seed", range(8))
def test_near_the_way_a_point_and_its_mirror_image_are_one(seed: int) -> None:
    """It is on the way, and its bearing as uncertain as both are away from that."""
    poses = looking_ahead()
    (point,) = patch_points(patch_of(of_point(poses, (1.3, -0.04)) + noise(seed), poses))
    assert point.mirrored_rad == point.bearing_rad == pytest.approx(0.0, abs=1e-9)
    assert math.atan2(0.06, 1.1) < 2.0 * point.bearing_sigma_rad
    assert (point.x_m, point.y_m) == pytest.approx((0.2 + point.range_m, -0.1))


def test_along_the_way_no_radius_is_known() -> None:
    poses = looking_ahead()
    (point,) = patch_points(patch_of(of_point(poses, (1.3, 0.0), 0.04) + noise(8), poses))
    assert point.radius_sigma_m > 0.5


def test_ahead_nothing_is_a_wall() -> None:
    """There a point and a plane have one wavefront."""
    poses = looking_ahead()
    ranges_m = 1.4 - antennas_of(poses)[:, 0]
    assert not patch_lines(patch_of(rf_frames(ranges_m, 0.04 / ranges_m) + noise(8), poses))
    assert not patch_lines(patch_of(of_point(poses, (1.3, 0.0), 0.04) + noise(8), poses))


def test_a_point_has_no_line() -> None:
    assert not patch_lines(patch_of(of_point(straight(), (0.1, 1.1))))


# In the second case one echo is 13 cm behind the wall, the other beyond the field of view.
@pytest.mark.parametrize(
    ("place", "wall_m", "n_without"), [((0.15, 0.75), 1.15, 2), ((0.68, 1.15), 1.55, 1)]
)
def test_what_comes_by_way_of_a_wall_is_no_point(
    place: tuple[float, float], wall_m: float, n_without: int
) -> None:
    poses, rod = straight(), np.array(place)
    image = np.array([rod[0], 2 * wall_m - rod[1]])
    near, far = (np.linalg.norm(q - antennas_of(poses), axis=1) for q in (rod, image))
    once = rf_frames((near + far) / 2, 0.01 * np.ones(25), 1.0)
    twice = rf_frames(far, 0.004 * np.ones(25), 2.0)
    frames = of_point(poses, rod.tolist()) + of_wall(poses, wall_m) + once + twice + noise(5)
    patch = patch_of(frames)
    assert places(patch_points(patch)) == pytest.approx(rod[np.newaxis], abs=3e-3)
    assert len(patch_lines(patch)) == 1
    # Without the wall they stand where they seem to be.
    assert len(patch_points(patch_of(once + twice + noise(5)))) == n_without


def test_a_pulse_in_one_frame_changes_nothing() -> None:
    frames = of_point(straight(), (0.0, 1.0)) + noise(6)
    clean = places(patch_points(patch_of(frames)))
    burst = frames.copy()
    burst[7] += rf_frames(np.array([1.25]), np.array([0.05]))[0]
    assert places(patch_points(patch_of(burst))) == pytest.approx(clean, abs=2e-4)


def test_an_echo_that_begins_or_ends_within_the_patch_is_no_burst() -> None:
    values = np.zeros((20, 4), dtype=np.complex64)
    values[:10, 0], values[10:, 1], values[6, 2] = 1.0, 1j, 1.0
    values[[15, 19], 3] = 1.0  # the last frame is compared with the four before it
    expected = values.copy()
    expected[[6, 15], [2, 3]] = 0.0
    remove_bursts(values)
    np.testing.assert_array_equal(values, expected)


@pytest.mark.parametrize("slope", [-0.6, 0.4])
def test_the_amplitude_of_an_echo_may_change_evenly_along_the_patch(slope: float) -> None:
    level = 0.01 * (1.0 + slope * np.linspace(-1.0, 1.0, 25))
    ranges_m = np.linalg.norm(np.array([0.1, 1.1]) - antennas_of(straight()), axis=1)
    found = separated(patch_of(rf_frames(ranges_m, level)), RULE.separation)
    # The beam falls by 2 % to either end.
    assert found.levels[0] == pytest.approx(level, rel=0.05)
    assert found.energy[0] == pytest.approx(np.sum(level**2), rel=0.02)


def test_a_wide_cylinder_is_a_point_at_its_surface() -> None:
    centre, radius_m = np.array([0.1, 0.95]), 0.3
    ranges_m = np.linalg.norm(centre - antennas_of(straight()), axis=1) - radius_m
    (point,) = patch_points(patch_of(rf_frames(ranges_m, 0.01 / ranges_m)))
    assert (point.x_m, point.y_m) == pytest.approx((0.1, 0.65), abs=1e-3)
    assert point.radius_m == pytest.approx(radius_m, abs=0.01)


@pytest.mark.parametrize(("radius_m", "most"), [(0.0, 2.5), (0.05, 3.0), (0.15, 5.0), (0.4, 6.0)])
def test_the_radius_of_a_cylinder_scatters_no_more_than_stated(
    radius_m: float, most: float
) -> None:
    """What the model of a point leaves of a thick one counts as noise, too."""
    rule = PointRule(wheels=NO_WHEELS, flatness_floor=0.0)
    centre = np.array([0.15, 1.0 + radius_m])
    ranges_m = np.linalg.norm(centre - antennas_of(straight()), axis=1) - radius_m
    frames = rf_frames(ranges_m, 0.01 / ranges_m)
    found = [patch_points(patch_of(frames + noise(seed, 1e-3)), rule)[0] for seed in range(40)]
    seen = np.array([one.radius_m for one in found])
    middle = float(np.median(seen))
    scatter = 1.48 * float(np.median(np.abs(seen - middle)))
    stated = float(np.median([one.radius_sigma_m for one in found]))
    assert middle == pytest.approx(radius_m, abs=0.5 * scatter)
    assert scatter < stated < most * scatter


def test_only_what_is_in_view_for_half_of_the_frames_is_a_point() -> None:
    edge_rad = VIEW.opening_rad / 2
    for off_rad, count in ((-0.12, 1), (0.12, 0)):
        angle = math.pi / 2 - edge_rad - off_rad
        place = 0.1 + 0.9 * math.cos(angle), 0.2 + 0.9 * math.sin(angle)
        assert len(patch_points(patch_of(of_point(straight(), place)))) == count


def test_the_amplitude_of_an_echo_does_not_change_its_sign() -> None:
    ranges_m = np.linalg.norm(np.array([0.1, 1.1]) - antennas_of(straight()), axis=1)
    level = 0.01 * (1.0 + 1.6 * np.linspace(-1.0, 1.0, 25))
    found = separated(patch_of(rf_frames(ranges_m, level)), RULE.separation)
    assert np.all(np.diff(found.levels[0]) > 0.0)


def test_frames_whose_bins_end_before_a_point_add_nothing_to_it() -> None:
    frames = of_point(straight(), (0.5, 1.62))[:, :200]
    found = separated(patch_of(frames), RULE.separation)
    ahead_m, left_m = found.places_m[0]  # of an antenna that looks along y
    place = antennas_of(straight())[MIDDLE] + [-left_m, ahead_m]
    beyond_m = np.linalg.norm(place - antennas_of(straight()), axis=1) - START_M - 199 * BIN_M
    assert beyond_m[0] > 1e-3
    assert np.all(found.levels[0, beyond_m > 1e-3] == 0.0)
    assert np.all(found.levels[0, beyond_m < -1e-3] > 0.0)


@pytest.mark.parametrize(("share", "count"), [(0.14, 1), (0.35, 2)])
def test_beside_a_strong_echo_a_weak_one_is_what_its_model_leaves(share: float, count: int) -> None:
    # Both are at 0.8 m; elsewhere something as weak is found.
    strong, beside = of_point(straight(), (0.1, 1.0)), of_point(straight(), (0.45, 0.92))
    patch = patch_of(strong + share * beside + noise(12))
    assert len(separated(patch, RULE.separation).range_m) == count
    apart = patch_of(strong + share * of_point(straight(), (0.2, 0.65)) + noise(12))
    assert len(separated(apart, RULE.separation).range_m) == 2


def test_a_rigid_motion_of_path_and_scene_moves_nothing_in_the_patch() -> None:
    motion = np.array([3.0, -2.0, 2.2])
    patch = patch_of(of_point(straight(), (0.2, 1.0)) + noise(7))
    moved = patch.with_poses(np.array([compose(motion, pose) for pose in patch.poses]))
    before, after = patch_points(patch), patch_points(moved)
    assert places(after) == pytest.approx(places(before), abs=1e-9)
    sigmas = [(one.sigma_m, one.bearing_sigma_rad) for one in (before[0], after[0])]
    assert sigmas[1] == pytest.approx(sigmas[0], rel=1e-6)


def test_turning_on_the_spot_gives_points_too() -> None:
    angles = np.linspace(-0.5, 0.5, 25)
    poses = np.column_stack([np.zeros(25), np.zeros(25), angles])
    (point,) = patch_points(patch_of(of_point(poses, (0.2, 1.1)) + noise(8), poses))
    assert math.dist((point.x_m, point.y_m), (0.2, 1.1)) < 4e-3
    # While it faces the point its amplitude is largest, and falls by the beam to either side.
    assert point.amplitude == pytest.approx(0.01, rel=0.05)


def test_covariance_is_that_of_noise_over_seeds() -> None:
    rule = PointRule(wheels=NO_WHEELS, range_floor_m=0.0, bearing_floor_rad=0.0)
    frames, sigma = of_point(straight(), (0.3, 1.2), 0.008), 2e-3
    found = [patch_points(patch_of(frames + noise(seed, sigma)), rule)[0] for seed in range(60)]
    seen = np.array([(one.range_m, one.bearing_rad) for one in found])
    stated = np.array([(one.sigma_m, one.bearing_sigma_rad) for one in found]).mean(axis=0)
    assert stated == pytest.approx(seen.std(axis=0), rel=0.5)
    assert abs(np.corrcoef(seen.T)[0, 1]) < 0.5


@pytest.mark.parametrize("place", [(0.6, 1.1), (0.3, 0.6)])
@pytest.mark.parametrize("constant", range(3))
def test_covariance_of_a_wrong_constant_of_the_wheels_is_what_it_does(
    constant: int, place: tuple[float, float]
) -> None:
    scale, turn, curvature = (0.02 * (constant == k) for k in range(3))
    wheels = replace(
        NO_WHEELS,
        scale_sigma=scale,
        turn_scale_sigma=turn,
        curvature_sigma_rad_per_m=5.0 * curvature,
    )
    rule = PointRule(wheels=wheels, range_floor_m=0.0, bearing_floor_rad=0.0, flatness_floor=0.0)

    def path(scale: float, turn: float, curvature: float) -> Array:
        """Return a curve of 24 steps of 1 cm and 0.02 rad as the wheels report it."""
        step = np.array([0.01 * (1 + scale), 0.0, 0.02 * (1 + turn) + 0.01 * 5.0 * curvature])
        poses = [np.zeros(3)]
        for _ in range(24):
            poses.append(compose(poses[-1], step))
        return seen_from(poses[MIDDLE], np.array(poses))

    true = path(0.0, 0.0, 0.0)
    frames = of_point(true, place)
    (point,) = patch_points(patch_of(frames, true), rule)
    (wrong,) = patch_points(patch_of(frames, path(scale, turn, curvature)), rule)
    assert abs(wrong.bearing_rad - point.bearing_rad) == pytest.approx(
        point.bearing_sigma_rad, rel=0.1, abs=1.5e-4
    )
    off_m = abs(wrong.radius_m - point.radius_m)
    if scale:  # stretches the curve and its curvature, which cancel here
        assert off_m < point.radius_sigma_m
    else:
        assert off_m == pytest.approx(point.radius_sigma_m, rel=0.15, abs=3e-3)


def noise_gain() -> float:
    """Return the standard deviation of a profile of noise of 1."""
    profiles = ProfileFilter(PULSE, N_BINS, BIN_M).apply(noise(0, 1.0), START_M)
    return float(np.std(profiles.values[:, 60:-60]))


def test_snr_is_that_of_the_noise_at_its_own_range() -> None:
    # Four times as much noise beyond 1.05 m as up to there
    level = np.where(START_M + BIN_M * np.arange(N_BINS) < 1.05, SIGMA, 4 * SIGMA)
    gain = noise_gain()
    for place, sigma in (((0.1, 0.9), SIGMA), ((0.1, 1.6), 4 * SIGMA)):
        range_m = place[1] - 0.2
        (point,) = patch_points(patch_of(of_point(straight(), place) + noise(11, 1.0) * level))
        expected = math.sqrt(25) * 0.01 * range_m**-1.5 / (gain * sigma)
        assert point.snr == pytest.approx(expected, rel=0.3)


def test_covariance_of_wheels_is_that_of_drawn_paths() -> None:
    wheels = replace(
        NO_WHEELS, along_m_per_sqrt_m=4e-3, across_m_per_sqrt_m=2e-3, heading_rad_per_sqrt_m=0.02
    )
    rule = PointRule(wheels=wheels, range_floor_m=0.0, bearing_floor_rad=0.0)
    frames, rng, found = of_point(straight(), (0.45, 1.0)), np.random.default_rng(9), []
    for _ in range(80):
        steps = np.column_stack([np.full(24, 0.01), np.zeros(24), np.zeros(24)])
        steps += rng.normal(0, 1, (24, 3)) * [4e-4, 2e-4, 2e-3]  # root of 0.01 m is 0.1
        poses = [np.zeros(3)]
        for step in steps:
            poses.append(compose(poses[-1], step))
        patch = patch_of(frames, np.array(poses)).with_poses(np.array(poses))
        found.append(patch_points(patch, rule)[0])
    bearings = np.array([point.bearing_rad for point in found])
    stated = [point.bearing_sigma_rad for point in found]
    assert float(bearings.std()) == pytest.approx(float(np.mean(stated)), rel=0.3)


@pytest.mark.parametrize(("sigma", "count"), [(6e-3, 1), (1e-2, 0)])
def test_a_faint_face_is_no_wall(sigma: float, count: int) -> None:
    """Of SNR 26 and 16: clutter that goes along with the robot for a while is as faint as that."""
    frames = rf_frames(1.0 - antennas_of(straight())[:, 1], np.full(25, 0.02))
    patch = patch_of(frames + noise(3, sigma))
    expected = math.sqrt(25) * 0.02 / (noise_gain() * sigma)
    assert separated(patch, RULE.separation).snr.max() == pytest.approx(expected, rel=0.1)
    assert len(patch_lines(patch)) == count


def test_noise_of_a_wall_is_that_of_drawn_frames() -> None:
    rule = replace(RULE, wheels=NO_WHEELS, range_floor_m=0.0, bearing_floor_rad=0.0)
    frames = rf_frames(1.0 - antennas_of(straight())[:, 1], np.full(25, 0.02))
    found = []
    for seed in range(60):
        patch = patch_of(frames + noise(seed, 2e-3))
        (line,) = lines_of(patch, separated(patch, rule.separation), rule)
        found.append(line)
    bearings, ranges_m = np.array([(one.bearing_rad, one.range_m) for one in found]).T
    assert ranges_m.mean() == pytest.approx(0.8, abs=1e-3)
    for scatter, stated in (
        (bearings.std(), [one.bearing_sigma_rad for one in found]),
        (ranges_m.std(), [one.sigma_m for one in found]),
    ):
        assert float(np.mean(stated)) == pytest.approx(float(scatter), rel=0.6)


def test_profiles_whose_echo_is_not_known_are_refused() -> None:
    patch = patch_of(of_point(straight(), (0.1, 1.1)))
    unknown = RangeProfiles(
        values=patch.profiles.values,
        range_start_m=START_M,
        bin_length_m=BIN_M,
        wave_number_rad_per_m=K,
    )
    with pytest.raises(ValueError, match="echo"):
        patch_points(replace(patch, profiles=unknown))


def drive(imager: Imager, frames: Array, poses: Array) -> list[ImagedPatch]:
    """Return the patches that an imager makes of frames (n, N_BINS), five a second."""
    imaged: list[ImagedPatch] = []
    for number, row in enumerate(frames):
        frame = RadarFrame(
            radar=0,
            t_ns=200_000_000 * number,
            counter=number + 1,
            samples=row.astype(np.float32),
            range_start_m=START_M,
            bin_length_m=BIN_M,
        )
        imaged += imager.step([frame], lambda t_ns: poses[t_ns // 200_000_000])
    assert len(imaged) >= 3
    return imaged


def test_an_imager_gives_the_points_of_its_patches() -> None:
    poses = straight(60)
    frames = of_point(poses, (0.1, 1.0)) + np.random.default_rng(10).normal(0, SIGMA, (60, N_BINS))
    for each in drive(Imager(SlamConfig(), Rig((MOUNT,))), frames, poses):
        (point,) = each.points
        there = transform(each.patch.origin, places([point])[0])
        assert math.dist(there, (0.1, 1.0)) < 4e-3
        assert places(patch_points(each.patch)) == pytest.approx(places(each.points))


class LearntNominal(PulseEstimator):
    """An estimator to which echoes have shown that the pulse is the nominal one."""

    def estimate(self, radar: int | None) -> ReceivedPulse | None:
        return ReceivedPulse(step_m=0.04, real=(1.0,), imaginary=(0.0,), relative_error=0.01)


def test_until_the_pulse_is_learnt_a_weak_echo_behind_a_strong_one_may_be_part_of_its_pulse() -> (
    None
):
    poses = straight(60)
    frames = of_point(poses, (0.1, 1.0)) + 0.35 * of_point(poses, (0.1, 1.15))
    frames += np.random.default_rng(11).normal(0, SIGMA, (60, N_BINS))

    def points(pulses: PulseEstimator | None) -> list[PatchPoint]:
        imager = Imager(SlamConfig(), Rig((MOUNT,)), pulses=pulses)
        return [one for each in drive(imager, frames, poses)[:3] for one in each.points]

    assert len(points(PulseEstimator(PULSE.model))) == 3
    assert len(points(LearntNominal(PULSE.model))) == len(points(None)) == 6


def test_a_pulse_that_rings_is_one_reflector_where_nothing_beside_it_is_searched_for() -> None:
    """It lies nearer to the peak of the nominal filter, where the learnt pulse has its zero."""
    plain = of_point(straight(), (0.1, 1.0))
    ringing = plain + 0.45 * np.roll(plain, 9, axis=1)
    matched = PULSE.model.samples(np.zeros(1), BIN_M)[0].conj()[::-1]

    def peak_bins(frame: Array) -> float:
        level = np.log(np.abs(np.convolve(frame, matched, mode="same")))
        at = int(level.argmax())
        before, here, behind = level[at - 1 : at + 2].tolist()
        return float(at + 0.5 * (before - behind) / (before - 2.0 * here + behind))

    patch = patch_of(ringing)
    antenna = patch.aperture.antennas_m[patch.middle]
    moved = [
        peak_bins(after) - peak_bins(before) for before, after in zip(plain, ringing, strict=True)
    ]
    peak_m = math.dist(antenna, (0.1, 1.0)) + BIN_M * float(np.median(moved))
    alone, several = (
        separated(patch, rule)
        for rule in (SeparationRule(beside_m=0.18, beside_share=0.4), SeparationRule())
    )
    assert alone.range_m.size == 1 < several.range_m.size
    assert abs(alone.range_m[0] - peak_m) < 2e-3 < abs(several.range_m[0] - peak_m)

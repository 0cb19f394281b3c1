"""Autofocus against paths that are spoilt in a known way."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from hil_tests.unit.slam.imaging.test_back_projection import profiles_of, straight
from slam.geometry import FieldOfView, Mount, align_se2, transform
from slam.imaging.autofocus import FocusRule, autofocus
from slam.imaging.back_projection import Aperture, Grid, back_project
from slam.imaging.patches import Patch
from slam.imaging.range_profiles import RangeProfiles

Array = NDArray[np.float64]

PLACES = (np.array([-0.7, 1.2]), np.array([0.1, 0.9]), np.array([0.8, 1.4]))
CELLS_M = Grid.over((-1.2, 1.2), (0.5, 1.8), 0.02).centres_m
"""Of apertures of half a metre: echoes are 2 cm wide across at 1 m."""


def scene(antennas_m: Array) -> RangeProfiles:
    return profiles_of(antennas_m, [(place, 0.02 * (i + 1)) for i, place in enumerate(PLACES)])


def peaks(profiles: RangeProfiles, aperture: Aperture) -> Array:
    """Return the brightest amplitude within 8 cm of each reflector: a path may turn the image."""
    side = 0.004 * np.arange(-20, 21)
    around = np.array(PLACES)[:, None, None] + np.stack(np.meshgrid(side, side), axis=-1)
    return np.asarray(back_project(profiles, aperture, around).amplitude.max(axis=(1, 2)))


def spoilt(antennas_m: Array, walk_m: float, seed: int) -> Array:
    steps_m = np.linalg.norm(np.diff(antennas_m, axis=0), axis=1)
    noise = np.random.default_rng(seed).normal(size=(len(steps_m), 2))
    walk = np.vstack([np.zeros(2), np.cumsum(walk_m * np.sqrt(steps_m)[:, None] * noise, axis=0)])
    return np.asarray(antennas_m + walk - walk[len(walk) // 2])


@pytest.mark.parametrize("seed", range(3))
def test_an_error_that_is_linear_between_knots_is_found(seed: int) -> None:
    true_m = straight(0.6, 121)
    at_knots = np.random.default_rng(seed).normal(scale=2.5e-3, size=(8, 2))
    knots_m = np.linspace(-0.3, 0.3, 8)
    error = np.column_stack([np.interp(true_m[:, 0], knots_m, each) for each in at_knots.T])
    profiles, path = scene(true_m), Aperture(antennas_m=true_m + error)
    found = autofocus(profiles, path, CELLS_M, FocusRule(walk_m_per_sqrt_m=0.02))
    best = peaks(profiles, Aperture(antennas_m=true_m))
    assert np.all(peaks(profiles, path) < 0.97 * best)
    assert np.all(peaks(profiles, found) > 0.99 * best)
    # A shift and a turn of all cannot be found. All reflectors lie to the left: y is what counts.
    left_m = transform(align_se2(found.antennas_m, true_m), found.antennas_m) - true_m
    assert np.sqrt(np.mean(left_m[:, 1] ** 2)) < 0.5e-3 < np.std(error[:, 1])


def test_the_unit_of_the_frames_is_of_no_matter() -> None:
    true_m = straight(0.6, 121)
    profiles, path = scene(true_m), Aperture(antennas_m=spoilt(true_m, 0.01, seed=2))
    found, fainter = (
        autofocus(each, path, CELLS_M) for each in (profiles, profiles.times(np.full(121, 1e-3)))
    )
    assert np.abs(found.antennas_m - path.antennas_m).max() > 1e-3
    np.testing.assert_allclose(fainter.antennas_m, found.antennas_m, atol=1e-6)


def test_a_right_path_stays() -> None:
    true_m = straight(0.6, 121)
    found = autofocus(scene(true_m), Aperture(antennas_m=true_m), CELLS_M)
    # Other echoes at the range of one leave a tenth of a millimetre; half a wavelength is 20.
    assert np.abs(found.antennas_m - true_m).max() < 0.3e-3


def test_an_image_is_never_made_less_sharp() -> None:
    true_m = straight(0.6, 121)
    profiles = scene(true_m)
    for walk_m in (0.0, 0.03, 0.1):
        path = Aperture(antennas_m=spoilt(true_m, walk_m, seed=1))
        found = autofocus(profiles, path, CELLS_M, FocusRule(points=1))
        before, after = (
            np.abs(back_project(profiles.times(path.metres), each, CELLS_M).total).max()
            for each in (path, found)
        )
        assert after >= 0.98 * before  # cells of 2 cm may miss a peak by that


def test_noise_moves_no_antenna() -> None:
    path = straight(0.6, 121)
    for seed in range(3):
        noise = np.random.default_rng(seed).normal(size=(2, 121, 400))
        profiles = RangeProfiles(
            values=(noise[0] + 1j * noise[1]).astype(np.complex64),
            range_start_m=0.1,
            bin_length_m=0.0064,
            wave_number_rad_per_m=math.tau / 0.02056,
        )
        found = autofocus(profiles, Aperture(antennas_m=path), CELLS_M)
        np.testing.assert_array_equal(found.antennas_m, path)


def test_what_not_all_profiles_see_moves_no_antenna() -> None:
    path = spoilt(straight(0.6, 121), 0.01, seed=0)
    narrow = Aperture(
        antennas_m=path, boresights=np.tile([0.0, 1.0], (121, 1)), half_beam_rad=math.radians(10.0)
    )
    np.testing.assert_array_equal(autofocus(scene(path), narrow, CELLS_M).antennas_m, path)


def test_an_antenna_that_stands_is_left_alone() -> None:
    path = np.zeros((30, 2))
    np.testing.assert_array_equal(
        autofocus(scene(path), Aperture(antennas_m=path), CELLS_M).antennas_m, path
    )


def test_knots_without_a_profile_follow_their_neighbours() -> None:
    """Nine profiles, 3 cm apart, and knots every 1.6 cm."""
    true_m = straight(0.24, 9)
    error_m = 4e-3 * np.array([0.0, 0.5, 1.0, 0.5, 0.0, -0.5, -1.0, -0.5, 0.0])
    path = Aperture(antennas_m=true_m + np.column_stack([np.zeros(9), error_m]))
    # Few cells: of thousands, noise alone would have one as coherent as nine profiles can be.
    cells_m = PLACES[1] + 0.01 * np.stack(np.meshgrid([-1.0, 0.0, 1.0], [0.0]), axis=-1)
    profiles = profiles_of(true_m, [(PLACES[1], 0.02)])
    rule = FocusRule(knots=16, walk_m_per_sqrt_m=0.05)
    found = autofocus(profiles, path, cells_m, rule)
    best = peaks(profiles, Aperture(antennas_m=true_m))[1]
    assert peaks(profiles, path)[1] < 0.85 * best
    assert peaks(profiles, found)[1] > 0.97 * best
    left_m = transform(align_se2(found.antennas_m, true_m), found.antennas_m) - true_m
    assert np.sqrt(np.mean(left_m[:, 1] ** 2)) < 0.2e-3


def test_knots_are_at_equal_distances_however_far_profiles_are_apart() -> None:
    """One reflector, profiles every 4 mm and then every 4 cm, an error with a bend at each knot."""
    x_m = np.concatenate([np.arange(-0.3, 0.0, 0.004), np.arange(0.0, 0.3, 0.04)])
    true_m = np.column_stack([x_m, np.zeros(x_m.size)])
    at_knots_m = 1.5e-3 * np.array([1, -1, -1, 1, 1, -1, 1, -1])
    error_m = np.interp(x_m, np.linspace(x_m[0], x_m[-1], 8), at_knots_m)
    path = Aperture(antennas_m=true_m + np.column_stack([np.zeros(x_m.size), error_m]))
    cells_m = PLACES[1] + 0.01 * np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1)
    rule = FocusRule(points=1, walk_m_per_sqrt_m=0.05)
    found = autofocus(profiles_of(true_m, [(PLACES[1], 0.02)]), path, cells_m, rule)
    left_m = transform(align_se2(found.antennas_m, true_m), found.antennas_m) - true_m
    assert np.std(error_m) > 1e-3
    assert math.sqrt(np.average(left_m[:, 1] ** 2, weights=path.metres)) < 0.25e-3


def test_in_space_heights_stay_and_the_plane_is_corrected_alike() -> None:
    true_m = straight(0.6, 121)
    path_m = spoilt(true_m, 0.01, seed=3)
    profiles = scene(true_m)
    flat = autofocus(profiles, Aperture(antennas_m=path_m), CELLS_M)
    lifted = Aperture(antennas_m=np.insert(path_m, 2, 0.4, axis=1))
    found = autofocus(profiles, lifted, np.insert(CELLS_M, 2, 0.4, axis=-1))
    np.testing.assert_array_equal(found.antennas_m[:, 2], 0.4)
    np.testing.assert_allclose(found.antennas_m[:, :2], flat.antennas_m, atol=1e-12)


def test_a_patch_of_a_driving_robot_gets_back_half_of_what_its_path_has_lost() -> None:
    poses = np.column_stack([straight(0.25, 51), np.zeros(51)])
    profiles = scene(poses[:, :2] + [0.0, 0.2])
    patch = Patch(
        radar=0,
        mount=Mount(name="left", x_m=0.0, y_m=0.2, yaw_rad=math.pi / 2),
        view=FieldOfView(),
        t_ns=np.arange(51),
        poses=poses,
        middle=25,
        origin=np.zeros(3),
        profiles=profiles,
    )
    best = peaks(profiles, patch.aperture)[1]  # all profiles see the middle one alone
    lost_db = []
    for seed in range(8):
        path = np.column_stack([spoilt(poses[:, :2], 0.02, seed), poses[:, 2]])
        aperture = patch.with_poses(path).aperture
        found = autofocus(profiles, aperture, CELLS_M, FocusRule(walk_m_per_sqrt_m=0.02))
        both = [peaks(profiles, each)[1] for each in (aperture, found)]
        lost_db.append(-20.0 * np.log10(np.array(both) / best))
    before_db, after_db = np.mean(lost_db, axis=0)
    assert before_db > 1.0
    assert after_db < 0.5 * before_db


def test_without_points_no_antenna_is_moved() -> None:
    aperture = Aperture(antennas_m=np.column_stack([np.linspace(0.0, 0.3, 20), np.zeros(20)]))
    profiles = RangeProfiles(
        values=np.ones((20, 50), np.complex64),
        range_start_m=0.2,
        bin_length_m=0.0064,
        wave_number_rad_per_m=305.0,
    )
    assert autofocus(profiles, aperture, np.zeros((0, 2))) is aperture

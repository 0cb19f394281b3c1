"""Back-projection against closed forms of the point response and sums written out by hand."""

import cmath
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from slam.imaging.back_projection import Aperture, BackProjection, Grid, back_project, echoes_at
from slam.imaging.range_profiles import RangeProfiles

Array = NDArray[np.float64]

HALF_WAVE_M = 0.02056
WAVE_NUMBER = math.tau / HALF_WAVE_M
SIGMA_M = 0.0517
BIN_M = 0.0064


def profiles_of(
    antennas_m: Array, echoes: list[tuple[Array, complex]], n_bins: int = 400
) -> RangeProfiles:
    """Return the profiles that reflectors at places give, by the definition of a profile."""
    r = 0.1 + BIN_M * np.arange(n_bins)
    values = np.zeros((len(antennas_m), n_bins), dtype=np.complex128)
    for place_m, reflectivity in echoes:
        ranges_m = np.linalg.norm(place_m - antennas_m, axis=1)[:, None]
        envelopes = np.exp(-0.5 * ((r - ranges_m) / SIGMA_M) ** 2)
        values += reflectivity * envelopes * np.exp(-1j * WAVE_NUMBER * ranges_m)
    return RangeProfiles(
        values=values.astype(np.complex64),
        range_start_m=0.1,
        bin_length_m=BIN_M,
        wave_number_rad_per_m=WAVE_NUMBER,
    )


def straight(length_m: float, n: int) -> Array:
    return np.column_stack([np.linspace(-length_m / 2, length_m / 2, n), np.zeros(n)])


def test_at_a_reflector_all_frames_agree_with_its_reflectivity() -> None:
    antennas, place = straight(0.3, 31), np.array([0.08, 1.1])
    profiles = profiles_of(antennas, [(place, 0.02 * cmath.exp(0.9j))])
    image = back_project(profiles, Aperture(antennas_m=antennas), place)
    # Linear interpolation between bins takes at most (b / s)**2 / 8 of the peak, 0.2 %.
    assert complex(image.total / image.count) == pytest.approx(0.02 * cmath.exp(0.9j), rel=2e-3)
    assert float(image.coherence_factor) == pytest.approx(1, abs=1e-4)
    assert float(image.incoherent) == pytest.approx(0.02, rel=2e-3)
    np.testing.assert_allclose(
        echoes_at(profiles, antennas, place), 0.02 * cmath.exp(0.9j), rtol=5e-3
    )


@pytest.mark.parametrize("length_m", [0.2, 0.4, 0.6])
def test_across_the_line_of_sight_the_response_is_a_sinc_of_the_aperture(length_m: float) -> None:
    antennas, range_m = straight(length_m, 121), 2.0
    profiles = profiles_of(antennas, [(np.array([0.0, range_m]), 1.0)])
    x = np.linspace(-0.25, 0.25, 101)
    # On the circle around the middle of the aperture; sin(bearing) = x / R
    points = np.column_stack([x, np.sqrt(range_m**2 - x**2)])
    image = back_project(profiles, Aperture(antennas_m=antennas), points)
    expected = np.abs(np.sinc(length_m * x / (HALF_WAVE_M * range_m)))
    # The far field's formula: wavefronts that curve by k (L / 2)**2 x**2 / (2 R**3) change it.
    np.testing.assert_allclose(image.amplitude, expected, atol=0.06)
    half = x[image.amplitude >= math.sqrt(0.5)]
    assert np.ptp(half) == pytest.approx(0.886 * HALF_WAVE_M * range_m / length_m, abs=0.011)


def test_along_the_line_of_sight_the_response_is_the_profile() -> None:
    antennas = straight(0.2, 21)
    profiles = profiles_of(antennas, [(np.array([0.0, 1.5]), 1.0)])
    y = np.linspace(1.35, 1.65, 61)
    image = back_project(
        profiles, Aperture(antennas_m=antennas), np.column_stack([np.zeros(61), y])
    )
    expected = np.exp(-0.5 * ((y - 1.5) / SIGMA_M) ** 2)
    # Away from the focus the curvature k L**2 / 8 (1 / y - 1 / 1.5) of the wavefront, 0.1 rad
    np.testing.assert_allclose(image.amplitude, expected, atol=5e-3)


def test_noise_has_a_coherence_factor_of_one_over_n_on_average() -> None:
    rng = np.random.default_rng(0)
    antennas = straight(0.3, 25)
    noise = rng.normal(size=(25, 400)) + 1j * rng.normal(size=(25, 400))
    profiles = replace(profiles_of(antennas, []), values=noise.astype(np.complex64))
    grid = Grid.over((-1.0, 1.0), (0.5, 2.0), 0.05)
    image = back_project(profiles, Aperture(antennas_m=antennas), grid.centres_m)
    assert np.all(image.count == 25)
    # 1200 cells, a few hundred of them independent: 0.04 +- 0.04 / sqrt(200)
    assert image.coherence_factor.mean() == pytest.approx(1 / 25, abs=4 * 0.04 / math.sqrt(200))


def naive(
    profiles: RangeProfiles,
    antennas: Array,
    boresights: Array,
    limits: tuple[float, float, float],
    q: Array,
) -> tuple[complex, float, int]:
    """Return S1, S2 and n at one point, written out frame by frame."""
    half_beam, low_m, high_m = limits
    total, power, count = 0j, 0.0, 0
    for values, a, b in zip(profiles.values, antennas, boresights, strict=True):
        range_m = math.dist(q, a)
        off = math.acos(max(-1.0, min(1.0, float(np.dot(q - a, b)) / range_m)))
        place = (range_m - profiles.range_start_m) / profiles.bin_length_m
        if off > half_beam or not low_m <= range_m <= high_m:
            continue
        if not 0 <= place < len(values) - 1:
            continue
        value = complex(np.interp(place, np.arange(len(values)), values.real)) + 1j * complex(
            np.interp(place, np.arange(len(values)), values.imag)
        )
        value *= cmath.exp(1j * profiles.wave_number_rad_per_m * range_m)
        total, power, count = total + value, power + abs(value) ** 2, count + 1
    return total, power, count


@given(st.integers(0, 2**32 - 1), st.sampled_from([2, 3]))
def test_sums_are_those_of_the_definition(seed: int, dimensions: int) -> None:
    rng = np.random.default_rng(seed)
    n = 12
    antennas = rng.normal(scale=0.2, size=(n, dimensions))
    boresights = rng.normal(size=(n, dimensions))
    boresights /= np.linalg.norm(boresights, axis=1, keepdims=True)
    noise = rng.normal(size=(n, 250)) + 1j * rng.normal(size=(n, 250))
    profiles = replace(profiles_of(antennas, []), values=noise.astype(np.complex64))
    points = rng.normal(scale=1.0, size=(9, dimensions))
    limits = (rng.uniform(0.3, 3.0), rng.uniform(0.0, 0.6), rng.uniform(0.8, 3.0))
    aperture = Aperture(
        antennas_m=antennas,
        boresights=boresights,
        half_beam_rad=limits[0],
        min_range_m=limits[1],
        max_range_m=limits[2],
    )
    image = back_project(profiles, aperture, points)
    for i, q in enumerate(points):
        total, power, count = naive(profiles, antennas, boresights, limits, q)
        assert image.count[i] == count
        # The table of phases is exact to pi / 4096 in each of the frames.
        scale = math.sqrt(count * power) + 1e-12
        assert abs(image.total[i] - total) <= (math.pi / 4096 + 1e-5) * scale
        assert image.power[i] == pytest.approx(power, rel=1e-5, abs=1e-12)


@given(st.floats(-math.pi, math.pi), st.floats(-5, 5), st.floats(-5, 5), st.integers(0, 2**32 - 1))
def test_a_rigid_motion_of_path_and_points_changes_nothing(
    angle: float, x: float, y: float, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    antennas, boresights = straight(0.3, 16), np.tile([0.0, 1.0], (16, 1))
    profiles = profiles_of(antennas, [(np.array([0.1, 1.0]), 1.0), (np.array([-0.3, 1.4]), 0.5j)])
    points = np.column_stack([rng.uniform(-0.5, 0.5, 20), rng.uniform(0.6, 1.9, 20)])
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    moved = back_project(
        profiles,
        Aperture(antennas_m=antennas @ turn.T + [x, y], boresights=boresights @ turn.T),
        points @ turn.T + [x, y],
    )
    still = back_project(profiles, Aperture(antennas_m=antennas, boresights=boresights), points)
    assert np.array_equal(moved.count, still.count)
    np.testing.assert_allclose(moved.total, still.total, atol=2 * 16 * math.pi / 4096)


def test_images_of_two_reflectors_add_up() -> None:
    antennas = straight(0.25, 26)
    one, other = (np.array([0.1, 1.0]), 1.0 + 0j), (np.array([-0.15, 1.05]), 0.4j)
    points = Grid.over((-0.4, 0.4), (0.8, 1.3), 0.05).centres_m
    images = [
        back_project(profiles_of(antennas, echoes), Aperture(antennas_m=antennas), points).total
        for echoes in ([one], [other], [one, other])
    ]
    np.testing.assert_allclose(images[2], images[0] + images[1], atol=1e-5)


@given(st.integers(0, 2**32 - 1))
def test_the_coherent_amplitude_is_at_most_the_incoherent_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values = (rng.normal(size=(8, 300)) + 1j * rng.normal(size=(8, 300))).astype(np.complex64)
    antennas = rng.normal(scale=0.1, size=(8, 2))
    profiles = replace(profiles_of(antennas, []), values=values)
    points = Grid.over((-0.4, 0.4), (0.8, 1.3), 0.1).centres_m
    image = back_project(profiles, Aperture(antennas_m=antennas), points)
    assert np.all(image.amplitude <= image.incoherent * (1 + 1e-9))
    assert np.all(image.weighted <= image.amplitude * (1 + 1e-9))
    factor = np.square(image.amplitude / image.incoherent)
    np.testing.assert_allclose(image.coherence_factor, factor, rtol=1e-9)


def test_conjugated_phase_has_no_focus() -> None:
    antennas, place = straight(0.4, 41), np.array([0.0, 1.2])
    profiles = profiles_of(antennas, [(place, 1.0)])
    wrong = replace(profiles, values=profiles.values.conj())
    image = back_project(wrong, Aperture(antennas_m=antennas), place)
    assert float(image.coherence_factor) < 0.2


def test_frames_more_than_half_a_wave_apart_make_grating_lobes() -> None:
    range_m, bearing = 1.5, math.radians(30)
    place = range_m * np.array([math.sin(bearing), math.cos(bearing)])
    # Phases of neighbours differ by k d sin b: the same where sin b is 20.56 mm / d smaller.
    d = 0.04
    lobe = math.asin(math.sin(bearing) - HALF_WAVE_M / d)
    at_lobe = range_m * np.array([math.sin(lobe), math.cos(lobe)])
    coherence = []
    for spacing_m in (d, d / 4):
        antennas = straight(0.2, round(0.2 / spacing_m) + 1)
        image = back_project(
            profiles_of(antennas, [(place, 1.0)]), Aperture(antennas_m=antennas), at_lobe
        )
        coherence.append(float(image.coherence_factor))
    assert coherence[0] > 0.8
    assert coherence[1] < 0.1


def test_a_point_that_no_frame_sees_is_zero() -> None:
    antennas = straight(0.2, 5)
    aperture = Aperture(antennas_m=antennas, boresights=np.tile([0.0, 1.0], (5, 1)))
    image = back_project(profiles_of(antennas, []), aperture, np.array([[0.0, -1.0]]))
    assert isinstance(image, BackProjection)
    for field in (image.count, image.amplitude, image.coherence_factor, image.incoherent):
        assert float(field[0]) == 0


def test_too_few_antennas_are_an_error() -> None:
    profiles = profiles_of(straight(0.2, 5), [])
    with pytest.raises(ValueError, match="5 profiles"):
        back_project(profiles, Aperture(antennas_m=straight(0.2, 4)), np.zeros((1, 2)))


def test_a_grid_covers_its_bounds_and_has_its_cells_in_rows_along_y() -> None:
    grid = Grid.over((-0.5, 1.0), (0.2, 0.61), 0.1)
    assert (grid.rows, grid.columns) == (5, 15)
    centres = grid.centres_m
    assert centres.shape == (5, 15, 2)
    np.testing.assert_allclose(centres[0, 0], [-0.45, 0.25])
    np.testing.assert_allclose(centres[4, 14], [0.95, 0.65])
    np.testing.assert_allclose(centres[1, 0] - centres[0, 0], [0, 0.1])


def test_the_way_of_an_aperture_is_that_of_its_antenna() -> None:
    corner = np.array([[0.0, 0.0], [0.3, 0.0], [0.3, 0.4]])
    assert Aperture(antennas_m=corner).length_m == pytest.approx(0.7)

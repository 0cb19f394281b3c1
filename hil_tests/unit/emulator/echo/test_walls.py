"""Walls, boxes and shadows against closed forms, Kirchhoff's integral and ITU-R P.526."""

import math

import numpy as np
import pytest

from emulator.echo.paths import BEAM_EXPONENT
from emulator.echo.walls import edge_wave, faces_of, passing, past_edge
from emulator.scene.scene import MIRROR_AMPLITUDE_1M
from hil_tests.unit.emulator.rooms import (
    WAVELENGTH_M,
    WAVENUMBER,
    box,
    heard,
    radar_at,
    target,
    wall,
)

UP = radar_at(0.0, 0.0, 90.0)
FAR = 500.0


def window_v(beside_m: float, range_m: float) -> float:
    """Return h sqrt(2 (d1 + d2) / (lambda d1 d2)) with both distances the range."""
    return beside_m * math.sqrt(4 / (WAVELENGTH_M * range_m))


@pytest.mark.parametrize(
    ("x_m", "y_m", "tilt_deg"), [(0, 0, 0), (2.0, 1.0, 0), (0, -3, 30), (1, 2, -50)]
)
def test_a_wall_is_heard_at_the_distance_to_its_line(
    x_m: float, y_m: float, tilt_deg: float
) -> None:
    """The line through (0, 4) at an angle; Hesse's normal form gives the distance."""
    tilt = math.radians(tilt_deg)
    t = np.array([math.cos(tilt), math.sin(tilt)])
    ends = [tuple(np.array([0.0, 4.0]) + s * FAR * t) for s in (-1, 1)]
    distance = abs(-math.sin(tilt) * x_m + math.cos(tilt) * (y_m - 4.0))
    radar = radar_at(x_m, y_m, math.degrees(tilt) + 90.0)
    got = heard(radar, walls=(wall(*ends, reflection=0.4),))
    first = got.range_m.argmin()
    assert got.range_m[first] == pytest.approx(distance, abs=1e-12)
    assert got.amplitude[first] == pytest.approx(0.4 * MIRROR_AMPLITUDE_1M / distance)
    assert math.cos(got.phase_rad[first]) == pytest.approx(-1)


def test_a_perfect_mirror_is_as_strong_as_pi_r_squared_of_cross_section() -> None:
    """Radar equation: sigma / R**4 of a point against 1 / (2 R)**2 of an image, sigma = pi R**2."""
    points = heard(UP, targets=(target(0, 3.0, amplitude_1m=0.06 * math.sqrt(math.pi * 9)),))
    mirror = heard(UP, walls=(wall((-FAR, 3), (FAR, 3), reflection=1.0),))
    assert points.at(3.0) == pytest.approx(mirror.at(3.0))


@pytest.mark.parametrize("side", [-1, 1])
def test_the_beam_points_at_the_foot(side: int) -> None:
    got = heard(radar_at(0, 0, 90.0 + side * 32.5), walls=(wall((-FAR, 2), (FAR, 2)),))
    assert got.at(2.0) == pytest.approx(0.5 * MIRROR_AMPLITUDE_1M / 2 * math.sqrt(0.5))


def test_a_wall_behind_the_radar_is_silent() -> None:
    assert not heard(radar_at(0, 0, -90.0), walls=(wall((-3, 2), (3, 2)),)).amplitude.any()


@pytest.mark.parametrize("x_m", [-1.2, -0.8, -0.55, -0.5, -0.45, 0.0, 0.3, 1.0])
@pytest.mark.parametrize("half_m", [0.1, 0.5])
def test_a_finite_wall_is_kirchhoffs_integral(x_m: float, half_m: float) -> None:
    """Huygens' sources along the wall, summed at the carrier: mirror, both edges, their phases."""
    step = 1e-4
    u = np.arange(-half_m + step / 2, half_m, step)
    r = np.sqrt((u - x_m) ** 2 + 2.0**2)
    cosine = 2.0 / r
    # An endless wall gives R**-1.5 sqrt(pi R / (j k)) by stationary phase: that is the mirror.
    waves = np.exp(-2j * WAVENUMBER * r) * r**-1.5 * cosine * cosine**BEAM_EXPONENT
    expected = -0.7 * MIRROR_AMPLITUDE_1M * waves.sum() * step / np.sqrt(np.pi / (1j * WAVENUMBER))
    radar = radar_at(x_m, 0.0, 90.0)
    got = heard(radar, walls=(wall((half_m, 2), (-half_m, 2), reflection=0.7),)).field()
    assert got == pytest.approx(expected, rel=0.04)


def test_the_echo_is_half_at_the_edge_and_never_jumps() -> None:
    """On a path past the end of a long wall, in steps of 2 mm."""
    x = np.arange(-0.2, 0.2, 0.002)
    long_wall = (wall((-FAR, 1.0), (0.0, 1.0), reflection=1.0),)
    fields = np.array([heard(radar_at(float(at), 0, 90), walls=long_wall).field() for at in x])
    full = MIRROR_AMPLITUDE_1M
    at_the_edge = heard(radar_at(0, 0, 90), walls=long_wall).field()
    assert abs(at_the_edge) == pytest.approx(full / 2, rel=2e-3)
    # Fresnel: the field's slope is that of E, at most 1 / sqrt(2) per unit of v.
    step_v = window_v(0.002, 1.0)
    assert np.abs(np.diff(fields)).max() < 1.1 * full * step_v / math.sqrt(2)
    assert abs(fields[0]) > 0.85 * full
    assert abs(fields[-1]) < 0.15 * full


def test_a_corner_seen_from_outside_ends_like_any_wall() -> None:
    """Behind an L the other wall is not heard: it closes the end on the inner side alone."""
    long_wall = wall((0.0, 0.0), (FAR, 0.0), reflection=1.0)
    silent = wall((0.0, 0.0), (0.0, FAR), reflection=0.0, name="upright")
    for x in (-0.05, -1e-6, 1e-6, 0.05, 0.3):
        radar = radar_at(x, -1.0, 90.0)
        alone = heard(radar, walls=(long_wall,)).field()
        behind = heard(radar, walls=(long_wall, silent)).field()
        assert behind == pytest.approx(alone, abs=1e-4)


def test_what_passes_an_edge_is_fresnels() -> None:
    """Half at the boundary; Babinet; far in the dark 1 / (sqrt(2) pi v) at minus 45 degrees."""
    zero = np.zeros(1)
    assert past_edge(zero, np.array([False]), 1.0) == pytest.approx(0.5)
    detour = np.array([0.01, 0.3, 7.0])
    dark = past_edge(detour, np.zeros(3, dtype=bool), 1.0)
    assert dark + past_edge(detour, np.ones(3, dtype=bool), 1.0) == pytest.approx(1)
    size, phase_rad = edge_wave(detour, 1.0)
    waves = size * np.exp(1j * phase_rad) * np.exp(-2j * np.pi * detour)
    assert waves == pytest.approx(dark)
    size, phase_rad = edge_wave(np.array([2500.0]), 1.0)
    assert size == pytest.approx(1 / (math.sqrt(2) * math.pi * 100), rel=1e-6)
    assert phase_rad == pytest.approx(-math.pi / 4, abs=1e-4)


def through(
    walls: tuple[object, ...], start: tuple[float, float], end: tuple[float, float]
) -> float:
    x0, y0, x1, y1 = (np.array([value]) for value in (*start, *end))
    faces = faces_of(walls, ())  # type: ignore[arg-type] # a tuple of walls
    return float(passing(faces, x0, y0, x1, y1, wavelength_m=WAVELENGTH_M)[0])


@pytest.mark.parametrize("height_m", [-0.05, 0.0, 0.05, 0.1, 0.3, 0.8])
def test_a_shadow_fades_as_itu_r_p_526_says(height_m: float) -> None:
    """Knife edge: J(v) = 6.9 + 20 log10(sqrt((v - 0.1)**2 + 1) + v - 0.1) dB, v > -0.78."""
    v = height_m * math.sqrt(2 * 5.0 / (WAVELENGTH_M * 2.0 * 3.0))
    assert v > -0.78
    loss_db = 6.9 + 20 * math.log10(math.hypot(v - 0.1, 1) + v - 0.1)
    screen = wall((2.0, -FAR), (2.0, height_m))
    assert -20 * math.log10(through((screen,), (0, 0), (5, 0))) == pytest.approx(loss_db, abs=0.35)


@pytest.mark.parametrize("transmission", [0.0, 0.25, 0.5, 1.0])
def test_a_wall_in_between_lets_its_transmission_pass_each_way(transmission: float) -> None:
    screen = wall((-FAR, 1), (FAR, 1), reflection=0.0, transmission=transmission)
    open_air = heard(UP, targets=(target(0.2, 2.0),))
    behind = heard(UP, targets=(target(0.2, 2.0),), walls=(screen,))
    at = math.hypot(0.2, 2.0)
    # Round the ends of a wall of a kilometre comes less than 1e-3.
    expected = transmission**2 * open_air.at(at)[0]
    assert behind.at(at).sum() == pytest.approx(expected, abs=4e-3 * open_air.at(at)[0])


def test_two_walls_in_between_multiply() -> None:
    screens = tuple(
        wall((-FAR, y), (FAR, y), reflection=0.0, transmission=t, name=f"wall_{y}")
        for y, t in ((1, 0.5), (2, 0.8))
    )
    assert through(screens, (0, 0), (0.3, 3)) == pytest.approx(0.4, abs=2e-3)
    assert through(screens, (0, 0), (0.3, 1.5)) == pytest.approx(0.5, abs=2e-3)
    assert through(screens, (0, 0), (0.3, 0.9)) == 1


def test_through_a_door_the_next_room_is_heard() -> None:
    """A gap of 1 m is five Fresnel zones wide here: inside it all but the ripple arrives."""
    door = (wall((-FAR, 2), (-0.5, 2), name="left"), wall((0.5, 2), (FAR, 2), name="right"))
    assert through(door, (0, 0), (0, 4)) == pytest.approx(1, abs=0.2)
    assert through(door, (0, 0), (4, 4)) < 0.1


def test_a_leg_that_ends_on_a_wall_does_not_cross_it() -> None:
    screen = (wall((-3, 2), (3, 2)),)
    assert through(screen, (0, 0), (0.7, 2.0)) == 1
    assert through(screen, (0.7, 2.0), (0, 0)) == 1


def test_an_opaque_wall_hides_the_wall_behind_it() -> None:
    near = wall((-FAR, 2), (FAR, 2), name="near")
    far = wall((-FAR, 3), (FAR, 3), name="far")
    assert heard(UP, walls=(near, far)).at(3.0).sum() < 1e-4
    glass = near.model_copy(update={"transmission": 0.8})
    got = heard(UP, walls=(glass, far))
    assert got.at(3.0) == pytest.approx(0.64 * 0.5 * MIRROR_AMPLITUDE_1M / 3, rel=0.01)


def test_a_box_shows_its_near_face_and_its_edges() -> None:
    """Two near edges take from the mirror; the far faces and the sides behind are not heard."""
    got = heard(radar_at(0, 0, 0), objects=(box(2.0, 0.0, 1.0, 0.6),))
    edge_m = math.hypot(1.5, 0.3)
    v = math.sqrt(8 * (edge_m - 1.5) / WAVELENGTH_M)
    assert got.range_m == pytest.approx([1.5, edge_m, edge_m])
    assert got.amplitude[0] == pytest.approx(0.5 * MIRROR_AMPLITUDE_1M / 1.5)
    # Born and Wolf: an edge gives 1 / (sqrt(2) pi v) of the wave, here to second order.
    assert got.amplitude[1] / got.amplitude[0] == pytest.approx(
        (1.5 / edge_m) ** (2 + BEAM_EXPONENT) / (math.sqrt(2) * math.pi * v), rel=0.1
    )


@pytest.mark.parametrize("yaw_deg", [0.0, 45.0, 90.0, 200.0])
def test_a_box_is_turned_by_its_yaw(yaw_deg: float) -> None:
    """Its face across x is at half a width from its centre, wherever it looks."""
    yaw = math.radians(yaw_deg)
    here = radar_at(1 + 2.0 * math.cos(yaw), 1 + 2.0 * math.sin(yaw), yaw_deg - 180.0)
    got = heard(here, objects=(box(1.0, 1.0, 0.8, 0.4, yaw_deg=yaw_deg),))
    assert got.range_m[0] == pytest.approx(2.0 - 0.4)


def test_inside_a_box_nothing_is_heard() -> None:
    cage = (box(0.0, 0.0, 1.0, 1.0),)
    assert not heard(UP, objects=cage).amplitude.any()
    assert heard(UP, objects=cage, targets=(target(0, 3),)).at(3.0).sum() < 0.01 * 0.01 / 9


def test_a_box_is_crossed_by_two_faces() -> None:
    glass = box(0.0, 2.0, 100.0, 0.5, amplitude_1m=0.0, transmission=0.7)
    got = heard(UP, objects=(glass,), targets=(target(0, 4.0),))
    assert got.at(4.0) == pytest.approx(0.01 / 16 * 0.7**4, rel=0.01)


@pytest.mark.parametrize(("radius_m", "range_m"), [(0.1, 1.0), (0.5, 2.0), (2.0, 3.0)])
def test_a_cylinder_is_heard_at_its_surface(radius_m: float, range_m: float) -> None:
    """Geometric optics of a convex mirror: (1 / s) sqrt(a / (s + a)), here 1 at s = 1 m."""
    round_one = target(0, range_m, kind="cylinder", radius_m=radius_m)
    got = heard(UP, targets=(round_one,))
    s = range_m - radius_m
    law = math.sqrt((1 + radius_m) / (s + radius_m)) / s
    assert got.range_m == pytest.approx([s])
    assert got.amplitude == pytest.approx([0.01 * law])
    assert not heard(radar_at(0, range_m, 90), targets=(round_one,)).amplitude.any()


def test_a_thin_cylinder_is_a_rod_and_a_thick_one_a_wall() -> None:
    for s in (0.5, 1.0, 3.0):
        thin = target(0, s + 1e-6, kind="cylinder", radius_m=1e-6)
        assert heard(UP, targets=(thin,)).amplitude == pytest.approx([0.01 * s**-1.5], rel=1e-5)
        thick = target(0, s + 10.0, kind="cylinder", radius_m=10.0)
        ratio = heard(UP, targets=(thick,)).amplitude[0] * s / 0.01
        assert ratio == pytest.approx(1, abs=0.11)

"""Corners of two walls: where their echo is, how strong, and what the image method says."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from emulator.echo.paths import beam_gain
from emulator.scene.scene import MIRROR_AMPLITUDE_1M, MultipathSpec, WallSpec
from hil_tests.unit.emulator.rooms import WAVENUMBER, Heard, box, heard, radar_at, target, wall

LONG = 200.0


def corner(angle_deg: float, apex: tuple[float, float] = (0.0, 0.0)) -> tuple[WallSpec, WallSpec]:
    """Return a wall along x from the apex and one turned from it by the angle."""
    angle = math.radians(angle_deg)
    far = (apex[0] + LONG * math.cos(angle), apex[1] + LONG * math.sin(angle))
    return (
        wall(apex, (apex[0] + LONG, apex[1]), name="floor", reflection=0.6),
        wall(apex, far, name="side", reflection=0.5),
    )


def looking_at(
    x_m: float, y_m: float, walls: tuple[WallSpec, ...], to: tuple[float, float] = (0.0, 0.0)
) -> Heard:
    yaw_deg = math.degrees(math.atan2(to[1] - y_m, to[0] - x_m))
    return heard(radar_at(x_m, y_m, yaw_deg), walls=walls)


@pytest.mark.parametrize(("x_m", "y_m"), [(1.0, 1.0), (3.0, 4.0), (0.4, 2.5)])
def test_a_right_angle_is_heard_at_its_apex_as_one_image(x_m: float, y_m: float) -> None:
    """Two ways round, each through half of the aperture: one image behind the apex."""
    got = looking_at(x_m, y_m, corner(90.0))
    apex_m = math.hypot(x_m, y_m)
    echoes = got.at(apex_m)
    assert len(echoes) == 2
    assert echoes.sum() == pytest.approx(0.6 * 0.5 * MIRROR_AMPLITUDE_1M / apex_m, rel=0.01)
    assert np.cos(got.phase_rad[np.isclose(got.range_m, apex_m)]) == pytest.approx(1)


@pytest.mark.parametrize(("x_m", "y_m"), [(1.0, 1.0), (3.0, 4.0), (0.4, 2.5), (0.05, 2.0)])
@pytest.mark.parametrize("turned", [False, True])
def test_the_field_in_a_right_angle_is_that_of_three_images(
    x_m: float, y_m: float, *, turned: bool
) -> None:
    """Exact for endless mirrors: no edge is heard at the apex, whichever way walls are drawn."""
    floor, side = corner(90.0)
    if turned:
        floor = floor.model_copy(update={"from_m": floor.to_m, "to_m": floor.from_m})
    here = np.array([x_m, y_m])
    boresight = -here / np.hypot(*here)
    expected = 0j
    for gain, towards, range_m in (
        (-0.6, (0, -1), y_m),
        (-0.5, (-1, 0), x_m),
        (0.6 * 0.5, tuple(boresight), float(np.hypot(*here))),
    ):
        beam = float(beam_gain(np.array(boresight @ towards)))
        expected += gain * beam * np.exp(-2j * WAVENUMBER * range_m) / range_m
    got = looking_at(x_m, y_m, (side, floor)).field()
    assert got == pytest.approx(expected * MIRROR_AMPLITUDE_1M, rel=0.015)


@pytest.mark.parametrize("angle_deg", [50.0, 60.0, 75.0])
def test_an_acute_corner_is_the_shortest_way_round(angle_deg: float) -> None:
    """Fermat: the way over a point of either wall and back, minimised numerically."""
    angle = math.radians(angle_deg)
    here = 2.0 * np.array([math.cos(0.45 * angle), math.sin(0.45 * angle)])
    along = np.array([math.cos(angle), math.sin(angle)])

    def way(points: np.ndarray) -> float:
        one, other = points[0] * np.array([1.0, 0.0]), points[1] * along
        legs = (one - here, other - one, here - other)
        return float(sum(np.hypot(*leg) for leg in legs))

    shortest = minimize(way, [1.5, 1.5], method="Nelder-Mead", options={"xatol": 1e-9})
    got = looking_at(float(here[0]), float(here[1]), corner(angle_deg))
    echoes = got.at(shortest.fun / 2, within_m=1e-6)
    assert len(echoes) == 2
    one, other = shortest.x[0] * np.array([1.0, 0.0]), shortest.x[1] * along
    cosines = [-here @ (p - here) / np.hypot(*here) / np.hypot(*(p - here)) for p in (one, other)]
    beam = math.prod(math.sqrt(float(beam_gain(np.array(cosine)))) for cosine in cosines)
    # Both directions of travel are heard in full but for Fresnel's ripple at the apex.
    expected = 2 * 0.6 * 0.5 * MIRROR_AMPLITUDE_1M / (shortest.fun / 2) * beam
    assert echoes.sum() == pytest.approx(expected, rel=0.12)
    assert echoes[0] == pytest.approx(echoes[1], rel=1e-6)


def test_an_obtuse_corner_sends_hardly_anything_back() -> None:
    got = looking_at(1.0, 1.5, corner(120.0))
    at_the_apex = 0.6 * 0.5 * MIRROR_AMPLITUDE_1M / math.hypot(1.0, 1.5)
    by_two_mirrors = got.amplitude[np.cos(got.phase_rad) > 0.99]
    assert by_two_mirrors.max(initial=0.0) < 0.05 * at_the_apex


def test_a_corner_seen_from_outside_is_none() -> None:
    for x_m, y_m in ((-2.0, -1.0), (2.0, -1.0), (-1.0, 2.0)):
        here = radar_at(x_m, y_m, math.degrees(math.atan2(-y_m, -x_m)))
        with_corners = heard(here, walls=corner(90.0))
        without = heard(here, walls=corner(90.0), multipath=MultipathSpec(corners=False))
        np.testing.assert_array_equal(with_corners.amplitude, without.amplitude)


def test_a_hole_in_the_corner_takes_its_echo() -> None:
    floor, side = corner(90.0)

    def echo(walls: tuple[WallSpec, ...]) -> float:
        """Return what turns by two mirrors' 2 pi; edges do not."""
        got = looking_at(2.0, 2.0, walls)
        return float(got.amplitude[np.cos(got.phase_rad) > 0.999].sum())

    for hole_m, most in ((0.3, 0.3), (1.0, 0.06)):
        cut = floor.model_copy(update={"from_m": (hole_m, 0.0)})
        assert echo((cut, side)) <= most * echo((floor, side))


def test_a_third_wall_hides_the_corner() -> None:
    screen = wall((-1.0, 2.5), (2.5, -1.0), reflection=0.0, name="screen")
    open_air = looking_at(2.0, 2.0, corner(90.0)).at(math.sqrt(8)).sum()
    hidden = looking_at(2.0, 2.0, (*corner(90.0), screen)).at(math.sqrt(8)).sum()
    assert hidden < 0.05 * open_air


def test_a_box_on_a_wall_makes_two_corners() -> None:
    """A box of 1 m x 0.5 m stands on the floor's middle: one inner corner at either side."""
    floor = wall((-LONG, 0.0), (LONG, 0.0), reflection=0.6, name="floor")
    block = (box(0.0, 0.25, 1.0, 0.5),)
    for sign in (-1, 1):
        here = radar_at(sign * 1.5, 1.0, -90 - sign * 45.0)
        got = heard(here, walls=(floor,), objects=block)
        echoes = got.at(math.hypot(1.0, 1.0), within_m=1e-6)
        single = 0.6 * 0.5 * MIRROR_AMPLITUDE_1M / math.sqrt(2)
        # The block ends half a metre up, where a zone is 0.17 m wide.
        assert echoes.sum() == pytest.approx(single, rel=0.2)


def test_corners_can_be_left_out() -> None:
    here = radar_at(1.0, 1.0, -135.0)
    got = heard(here, walls=corner(90.0), multipath=MultipathSpec(corners=False))
    assert not len(got.at(math.sqrt(2)))
    assert len(heard(here, walls=corner(90.0), targets=(target(0.5, 0.6),)).at(math.sqrt(2))) == 2

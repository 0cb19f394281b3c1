"""Points, walls and corners are told apart by how their ranges change, as closed forms say."""

import math

import numpy as np
import pytest

from slam.robust.map import Law, Sightings, compare
from slam.robust.state import Array

SIGMA_M = 1e-3
REACH_M = 0.15
DISTANCE_M = 1.0


def places(n: int = 301, reach_m: float = REACH_M) -> Array:
    """Return places along x, the reflector's side being +y."""
    return np.column_stack([np.linspace(-reach_m, reach_m, n), np.zeros(n)])


def sightings(antennas: Array, ranges: Array, radars: Array | None = None) -> Sightings:
    return Sightings(
        antennas_m=antennas,
        ranges_m=ranges,
        variances=np.full(len(ranges), SIGMA_M**2),
        radars=np.zeros(len(ranges), dtype=np.intp) if radars is None else radars,
        offset_covariance=None if radars is None else 0.02**2 * np.eye(2),
    )


def bulge() -> float:
    """Return the chi-square that x^2 / 2 D leaves when a straight line is fitted to it.

    A point at D is at D + x^2 / 2 D, to second order; a straight line takes up the mean. With x
    uniform in +-a the rest has the variance (a^4 / 5 - a^4 / 9) / 4 D^2.
    """
    a = REACH_M
    return len(places()) * (a**4 / 5 - a**4 / 9) / (4 * DISTANCE_M**2 * SIGMA_M**2)


def test_ranges_of_a_point_leave_the_bulge_of_a_hyperbola_under_the_law_of_a_wall() -> None:
    antennas = places()
    ranges = np.hypot(antennas[:, 0], DISTANCE_M)
    verdict = compare(sightings(antennas, ranges), math.pi / 2)
    assert verdict.point == pytest.approx(0.0, abs=1e-6)
    assert verdict.wall == pytest.approx(bulge(), rel=0.03)


def test_ranges_of_a_wall_leave_the_same_bulge_under_the_law_of_a_point() -> None:
    antennas = places()
    verdict = compare(sightings(antennas, np.full(len(antennas), DISTANCE_M)), math.pi / 2)
    assert verdict.wall == pytest.approx(0.0, abs=1e-6)
    assert verdict.point == pytest.approx(bulge(), rel=0.03)


def test_a_wall_aslant_is_a_wall() -> None:
    antennas = places()
    antennas[:, 1] = 0.3 + 2.0 * antennas[:, 0] ** 2
    n = np.array([math.cos(1.9), math.sin(1.9)])
    verdict = compare(sightings(antennas, 1.1 - antennas @ n), 1.7)
    assert verdict.wall == pytest.approx(0.0, abs=1e-6)
    assert verdict.law(30.0) is Law.WALL


def test_little_displacement_decides_nothing() -> None:
    """The bulge goes with the fourth power of the displacement."""
    antennas = places(reach_m=REACH_M / 10)
    verdict = compare(sightings(antennas, np.hypot(antennas[:, 0], DISTANCE_M)), math.pi / 2)
    assert verdict.law(1.0) is Law.UNDECIDED
    assert verdict.wall == pytest.approx(bulge() / 1e4, rel=0.03)


def test_unknown_offsets_of_two_radars_turn_a_wall_but_make_no_point_of_it() -> None:
    along = places()
    antennas = np.vstack([np.subtract(along, [0.1, 0.0]), np.add(along, [0.1, 0.0])])
    radars = np.repeat([0, 1], len(along))
    offsets = np.array([0.015, -0.02])[radars]
    verdict = compare(
        sightings(antennas, np.full(len(antennas), DISTANCE_M) + offsets, radars), math.pi / 2
    )
    assert verdict.wall < 2.0  # what the prior of the offsets asks for 15 and 20 of 20 mm
    assert verdict.law(30.0) is Law.WALL


def test_a_corner_is_a_point_at_its_apex() -> None:
    """By way of both walls the antenna's image is the antenna turned about the apex."""
    apex = np.array([0.3, 0.9])
    antennas = places()
    first = np.column_stack([antennas[:, 0], 2 * apex[1] - antennas[:, 1]])
    image = np.column_stack([2 * apex[0] - first[:, 0], first[:, 1]])
    ranges = np.hypot(*(image - antennas).T) / 2
    toward = math.atan2(apex[1], apex[0])
    verdict = compare(sightings(antennas, ranges), toward)
    assert verdict.point == pytest.approx(0.0, abs=1e-6)
    assert verdict.law(30.0) is Law.POINT

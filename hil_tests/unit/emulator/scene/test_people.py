"""People: where they are, how their chest moves, what a radar hears of it, and bad files."""

import math
from typing import Any

import numpy as np
import pytest

from emulator.echo.paths import direct_reflections, viewpoint
from emulator.echo.people import person_scatterer
from emulator.scene.people import PersonSpec, chest_displacement_m, moves, positions_m
from emulator.scene.scene import load_scene
from hil_tests.unit.emulator.rooms import radar_at

SECOND = 1_000_000_000
FORWARD = radar_at(0, 0, 0)
L_SHAPE = ((0.0, 0.0), (3.0, 0.0), (3.0, 4.0))


def person(**changes: Any) -> PersonSpec:  # noqa: ANN401 - any field
    return PersonSpec.model_validate({"name": "somebody", "waypoints_m": L_SHAPE} | changes)


def times(*seconds: float) -> np.ndarray[Any, np.dtype[np.int64]]:
    return np.array([round(s * SECOND) for s in seconds], dtype=np.int64)


@pytest.mark.parametrize(
    ("walk", "at_s", "expected"),
    [
        ("once", [0, 1, 5, 7, 100], [(0, 0), (1, 0), (3, 2), (3, 4), (3, 4)]),
        ("to_and_fro", [7, 8, 13, 14, 15], [(3, 4), (3, 3), (1, 0), (0, 0), (1, 0)]),
        ("round", [7, 9.5, 12, 13], [(3, 4), (1.5, 2), (0, 0), (1, 0)]),
    ],
)
def test_walks(walk: str, at_s: list[float], expected: list[tuple[float, float]]) -> None:
    """7 m at 1 m/s; the way round closes with 5 m."""
    assert positions_m(person(walk=walk), times(*at_s)) == pytest.approx(np.array(expected))
    stands = person(waypoints_m=((1.0, 2.0),), walk=walk)
    assert positions_m(stands, times(0, 50)).tolist() == [[1.0, 2.0]] * 2


def test_a_walk_begins_when_the_person_enters() -> None:
    late = positions_m(person(enters_s=10.0, speed_mps=0.5), times(5, 10, 14))
    assert late == pytest.approx(np.array([(0, 0), (0, 0), (2, 0)]))


def test_the_chest_moves_as_a_sine() -> None:
    breath = chest_displacement_m(
        person(breaths_per_min=15.0, breath_amplitude_m=0.005), times(0, 1, 2, 3, 4, 3601)
    )
    assert breath == pytest.approx([0, 0.005, 0, -0.005, 0, 0.005], abs=1e-12)


def test_the_echo_of_a_person() -> None:
    """Radar equation for a point: root of the cross section, R**-2; the chest shortens the way."""
    stands = person(
        waypoints_m=((2.0, 0.0),), rcs_m2=0.25, enters_s=1.0, leaves_s=10.0, breaths_per_min=15.0
    )
    t_ns = times(0.5, 1, 2, 10)
    view = viewpoint(FORWARD, np.zeros((4, 3)))
    echo = direct_reflections(person_scatterer(stands, t_ns, view), view)
    assert echo.amplitude[:, 0] == pytest.approx([0, *([0.06 * 0.5 / 4] * 2), 0])
    chest_m = 0.004 * np.sin(math.tau * 0.25 * np.array([0.5, 1, 2, 10]))
    assert echo.range_m[:, 0] == pytest.approx(2.0 - chest_m)


def test_the_visitor_is_somebody_who_comes_when_the_noise_map_is_made() -> None:
    scene = load_scene("visitor")
    (visitor,) = scene.people
    assert visitor.enters_s > 120
    assert len(scene.radars) == 2


@pytest.mark.parametrize(
    ("walk", "walking"), [("once", [True, True, False]), ("to_and_fro", [True] * 3)]
)
def test_one_who_walks_once_moves_until_the_end_of_the_way(walk: str, walking: list[bool]) -> None:
    """The way of 7 m takes 14 s, from 2 s on."""
    walker = person(walk=walk, speed_mps=0.5, enters_s=2.0)
    assert moves(walker, times(2.1, 15.9, 16.1)).tolist() == walking

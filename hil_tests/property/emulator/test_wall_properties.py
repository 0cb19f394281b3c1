"""Laws of paths in rooms: rigid motions, reversal of walls, reciprocity, energy, shadows."""

import math
from collections.abc import Sequence
from contextlib import nullcontext

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from emulator.echo.paths import Scatterers
from emulator.echo.walls import faces_of, passing, spread
from emulator.scene.people import PersonSpec
from emulator.scene.scene import MIRROR_AMPLITUDE_1M, ObjectSpec, TargetSpec, WallSpec
from hil_tests.property.examples import examples
from hil_tests.unit.emulator.rooms import WAVELENGTH_M, heard, radar_at

Point = tuple[float, float]

coordinate = st.floats(-4, 4)
point = st.tuples(coordinate, coordinate)
angle_deg = st.floats(-180, 180)
share = st.floats(0, 1)


def wall(number: int, ends: tuple[Point, Point]) -> WallSpec:
    return WallSpec(
        name=f"wall_{number}", from_m=ends[0], to_m=ends[1], amplitude_1m=0.05, transmission=0.6
    )


walls_st = st.lists(
    st.tuples(point, point).filter(lambda ends: math.dist(*ends) > 0.1), min_size=1, max_size=4
).map(lambda pairs: tuple(wall(number, ends) for number, ends in enumerate(pairs)))
box_st = st.builds(
    lambda at, size, yaw_deg: ObjectSpec(
        name="box",
        x_m=at[0],
        y_m=at[1],
        width_m=size[0],
        depth_m=size[1],
        yaw_deg=yaw_deg,
        amplitude_1m=0.08,
        transmission=0.3,
    ),
    point,
    st.tuples(st.floats(0.1, 2), st.floats(0.1, 2)),
    angle_deg,
)
target_st = st.builds(
    lambda at, kind: TargetSpec(
        name="target", kind=kind, x_m=at[0], y_m=at[1], radius_m=0.1 if kind == "cylinder" else 0.0
    ),
    point,
    st.sampled_from(["rod", "point", "cylinder"]),
)


def field(
    mount: tuple[float, float, float],
    walls: tuple[WallSpec, ...],
    boxes: tuple[ObjectSpec, ...],
    targets: tuple[TargetSpec, ...],
    people: tuple[PersonSpec, ...],
) -> complex:
    """Return the sum of all paths at the carrier: it is continuous where a foot meets an edge."""
    parts = {"walls": walls, "objects": boxes, "targets": targets, "people": people}
    return heard(radar_at(*mount), t_ns=700_000_000, **parts).field()


def clear_of(walls: tuple[WallSpec, ...], boxes: tuple[ObjectSpec, ...], *at: Point) -> bool:
    """Return whether points are off the line of every face: there, sides change."""
    faces = faces_of(walls, boxes)
    x, y = np.array(at).T[:, :, np.newaxis]
    return bool((np.abs(faces.height(x, y)) > 0.01).all())


def moved(at: Point, turn: float, by: Sequence[float]) -> Point:
    cosine, sine = math.cos(turn), math.sin(turn)
    return cosine * at[0] - sine * at[1] + by[0], sine * at[0] + cosine * at[1] + by[1]


@settings(max_examples=examples(50))
@given(
    mount=st.tuples(coordinate, coordinate, angle_deg),
    walls=walls_st,
    box=box_st,
    target=target_st,
    at=point,
    motion=st.tuples(st.floats(-170, 170), st.floats(-100, 100), st.floats(-100, 100)),
)
def test_a_rigid_motion_of_everything_changes_nothing(
    *,
    mount: tuple[float, float, float],
    walls: tuple[WallSpec, ...],
    box: ObjectSpec,
    target: TargetSpec,
    at: Point,
    motion: tuple[float, float, float],
) -> None:
    turn_deg, *by = motion
    assume(clear_of(walls, (box,), mount[:2], (target.x_m, target.y_m), at))
    turn = math.radians(turn_deg)
    person = PersonSpec(name="somebody", waypoints_m=(at,))
    before = field(mount, walls, (box,), (target,), (person,))

    def carried(x_m: float, y_m: float) -> dict[str, float]:
        x, y = moved((x_m, y_m), turn, by)
        return {"x_m": x, "y_m": y}

    after = field(
        (*moved(mount[:2], turn, by), math.remainder(mount[2] + turn_deg, 360)),
        tuple(
            each.model_copy(
                update={
                    "from_m": moved(each.from_m, turn, by),
                    "to_m": moved(each.to_m, turn, by),
                }
            )
            for each in walls
        ),
        (
            box.model_copy(
                update={
                    **carried(box.x_m, box.y_m),
                    "yaw_deg": math.remainder(box.yaw_deg + turn_deg, 360),
                }
            ),
        ),
        (target.model_copy(update=carried(target.x_m, target.y_m)),),
        (person.model_copy(update={"waypoints_m": (moved(at, turn, by),)}),),
    )
    assert after == pytest.approx(before, rel=1e-6, abs=1e-7)


@settings(max_examples=examples(50))
@given(mount=st.tuples(coordinate, coordinate, angle_deg), walls=walls_st, target=target_st)
@example(  # the second wall lies behind the first: nothing of it is left but a rounding error
    (0.0, 0.0, 0.0),
    (wall(0, ((0.0, 1.0), (1.0, -2.0))), wall(1, ((1.0, 0.0), (1.0, -2.0)))),
    TargetSpec(name="target", kind="rod", x_m=0.0, y_m=0.0),
)
def test_it_does_not_matter_which_end_of_a_wall_is_written_first(
    mount: tuple[float, float, float], walls: tuple[WallSpec, ...], target: TargetSpec
) -> None:
    assume(clear_of(walls, (), mount[:2], (target.x_m, target.y_m)))
    turned = tuple(
        each.model_copy(update={"from_m": each.to_m, "to_m": each.from_m}) for each in walls[::-1]
    )
    one = field(mount, walls, (), (target,), ())
    other = field(mount, turned, (), (target,), ())
    assert other == pytest.approx(one, rel=1e-6, abs=1e-7)


@given(walls=walls_st, start=point, end=point)
def test_a_leg_passes_the_same_both_ways(
    walls: tuple[WallSpec, ...], start: Point, end: Point
) -> None:
    faces = faces_of(walls, ())
    x0, y0, x1, y1 = (np.array([value]) for value in (*start, *end))
    there = passing(faces, x0, y0, x1, y1, wavelength_m=WAVELENGTH_M)
    back = passing(faces, x1, y1, x0, y0, wavelength_m=WAVELENGTH_M)
    np.testing.assert_allclose(there, back, rtol=1e-9)
    # One face lets at most Fresnel's first ripple more than everything pass, 1.17.
    assert 0 <= there[0] <= 1.4 ** len(walls)


@given(
    one=st.floats(0.3, 10),
    other=st.floats(0.3, 10),
    half_angle=st.floats(0, 1.5),
    radius_m=st.floats(0.01, 0.2),
    exponent=st.sampled_from([1.0, 1.5, 2.0]),
)
def test_legs_may_be_swapped_and_equal_ones_are_the_direct_law(
    one: float, other: float, half_angle: float, radius_m: float, exponent: float
) -> None:
    radius = np.array([radius_m if exponent == 1.0 else 0.0])
    scatterers = Scatterers(
        x_m=np.zeros(1),
        y_m=np.zeros(1),
        strength=np.ones(1),
        exponent=np.array([exponent]),
        radius_m=radius,
        swell_m=radius,
        phase_rad=np.zeros(1),
    )
    cosine = np.full((1, 1), math.cos(half_angle))
    a, b = np.full((1, 1), one), np.full((1, 1), other)
    np.testing.assert_allclose(
        spread(scatterers, a, b, cosine), spread(scatterers, b, a, cosine), rtol=1e-12
    )
    s = one - float(radius[0])
    law = math.sqrt((1 + radius_m) / (s + radius_m)) / s if exponent == 1.0 else one**-exponent
    got = spread(scatterers, a, a, np.ones((1, 1)))
    np.testing.assert_allclose(got, law, rtol=1e-12)


@given(transmission=share, amplitude=st.floats(0, 0.2))
def test_no_wall_gives_more_than_it_takes(transmission: float, amplitude: float) -> None:
    energy = (amplitude / MIRROR_AMPLITUDE_1M) ** 2 + transmission**2
    table = {"name": "wall", "from_m": (0.0, 0.0), "to_m": (1.0, 0.0), "transmission": transmission}
    refused = pytest.raises(ValueError, match="amplitude_1m: at most")
    with refused if energy > 1 + 1e-6 else nullcontext():
        WallSpec.model_validate(table | {"amplitude_1m": amplitude})

"""Laws of the plane: angles, poses, pairs of mounts."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hil_tests.property.examples import examples
from hil_tests.property.trilateration_oracles import distance, off_boresight
from slam.geometry import (
    PAPERS_FIELD,
    FieldOfView,
    Mount,
    Rig,
    between,
    common_share,
    compose,
    paper_rig,
    transform,
    wrap_angle,
    wrap_angles,
)

Array = NDArray[np.float64]
poses = st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-math.pi, math.pi)).map(np.array)


@given(st.floats(-1e4, 1e4))
@example(math.pi)
@example(-math.pi)
@example(np.nextafter(-math.pi, -4.0))
@example(3 * math.pi)
@example(-1e-300)
def test_wrapped_angle_lies_in_its_interval_and_means_the_same(angle: float) -> None:
    for wrapped in (wrap_angle(angle), float(wrap_angles(angle))):
        assert -math.pi <= wrapped < math.pi
        assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
        assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


@given(st.floats(-math.pi, math.pi, exclude_max=True))
def test_wrapping_leaves_a_wrapped_angle_bit_for_bit(angle: float) -> None:
    assert wrap_angle(angle) == angle
    assert float(wrap_angles(angle)) == angle


@given(poses, poses)
def test_between_undoes_compose(origin: Array, motion: Array) -> None:
    back = between(origin, compose(origin, motion))
    assert back[:2] == pytest.approx(motion[:2], abs=1e-12)
    assert abs(math.remainder(back[2] - motion[2], math.tau)) <= 1e-12


@given(poses, poses, st.tuples(st.floats(-9, 9), st.floats(-9, 9)).map(np.array))
def test_composed_poses_transform_like_one_after_the_other(a: Array, b: Array, p: Array) -> None:
    assert transform(compose(a, b), p) == pytest.approx(transform(a, transform(b, p)), abs=1e-11)


def test_turning_left_in_place_sees_forward_on_the_right() -> None:
    quarter = np.array([1.0, 2.0, math.pi / 2])
    assert transform(quarter, np.array([1.0, 0.0])) == pytest.approx([1.0, 3.0])
    assert between(quarter, np.array([2.0, 2.0, 0.0])) == pytest.approx([0.0, -1.0, -math.pi / 2])


def test_paper_rig_has_one_pair_per_side_turned_by_pi() -> None:
    rig = paper_rig()
    left, right = rig.pairs()
    assert [rig.mounts[k].name for k in (left.first, left.second)] == ["left_rear", "left_front"]
    assert [rig.mounts[k].name for k in (right.first, right.second)] == [
        "right_front",
        "right_rear",
    ]
    for pair, sign in ((left, 1.0), (right, -1.0)):
        assert pair.baseline_m == pytest.approx(0.2)
        assert pair.boresights_rad == pytest.approx((math.pi / 2, math.pi / 2))
        assert pair.midpoint == pytest.approx([0.0, 0.2 * sign])
        assert pair.along == pytest.approx([sign, 0.0])
        assert pair.ahead == pytest.approx([0.0, sign])


@given(poses, st.permutations(range(4)))
def test_pairs_follow_the_mounts_whatever_their_order_and_the_rig_s_place(
    place: Array, order: list[int]
) -> None:
    mounts = []
    for index in order:
        mount = paper_rig().mounts[index]
        x, y, yaw = compose(place, np.array([mount.x_m, mount.y_m, mount.yaw_rad]))
        mounts.append(Mount(name=mount.name, x_m=x, y_m=y, yaw_rad=yaw))
    rig = Rig(mounts=tuple(mounts))
    names = {(mounts[pair.first].name, mounts[pair.second].name) for pair in rig.pairs()}
    assert names == {("left_rear", "left_front"), ("right_front", "right_rear")}
    for pair in rig.pairs():
        yaw = mounts[pair.first].yaw_rad
        assert pair.ahead == pytest.approx([math.cos(yaw), math.sin(yaw)], abs=1e-9)


def test_third_radar_of_a_side_makes_three_pairs() -> None:
    mounts = [Mount(name=str(k), x_m=0.1 * k, y_m=0.2, yaw_rad=math.pi / 2) for k in range(3)]
    assert [(p.first, p.second) for p in Rig(mounts=tuple(mounts)).pairs()] == [
        (0, 1),
        (0, 2),
        (1, 2),
    ]


@pytest.mark.parametrize(
    "second",
    [
        Mount(name="other way", x_m=0.1, y_m=0.2, yaw_rad=0.0),
        Mount(name="same place", x_m=-0.1, y_m=0.2, yaw_rad=math.pi / 2),
        Mount(name="behind", x_m=-0.1, y_m=0.0, yaw_rad=math.pi / 2),
    ],
)
def test_mounts_without_a_base_across_the_view_make_no_pair(second: Mount) -> None:
    first = Mount(name="first", x_m=-0.1, y_m=0.2, yaw_rad=math.pi / 2)
    assert Rig(mounts=(first, second)).pairs() == ()


@pytest.mark.parametrize("off_deg", [1e-4, -1e-4, 1.0, -5.0, 5.0])
@pytest.mark.parametrize("radar", range(4))
def test_mounting_tolerances_keep_the_pairs_of_the_paper_rig(radar: int, off_deg: float) -> None:
    mounts = list(paper_rig().mounts)
    yaw_rad = mounts[radar].yaw_rad + math.radians(off_deg)
    mounts[radar] = replace(mounts[radar], yaw_rad=yaw_rad)
    rig = Rig(mounts=tuple(mounts))
    assert [(pair.first, pair.second) for pair in rig.pairs()] == [(0, 1), (3, 2)]
    assert rig.sides() == ((0, 1), (2, 3))


mounts_of_any_yaw = st.builds(
    Mount,
    name=st.just("any"),
    x_m=st.floats(-0.5, 0.5),
    y_m=st.floats(-0.5, 0.5),
    yaw_rad=st.floats(-math.pi, math.pi),
)


def placeable(point: Array, mounts: tuple[Mount, Mount], field: FieldOfView) -> bool:
    """Judge one point by angles alone: law of sines for the crossing, bearings for the image."""
    a, b = mounts
    base_rad = math.atan2(b.y_m - a.y_m, b.x_m - a.x_m)
    half_rad = field.opening_rad / 2
    bearings = [math.atan2(point[1] - m.y_m, point[0] - m.x_m) for m in mounts]
    in_range = all(field.min_range_m <= distance(m, point) <= field.max_range_m for m in mounts)
    seen = all(abs(off_boresight(m, point)) <= half_rad for m in mounts)
    image_seen = all(
        abs(math.remainder(2 * base_rad - bearing - m.yaw_rad, math.tau)) <= half_rad
        for m, bearing in zip(mounts, bearings, strict=True)
    )
    crosses = abs(math.sin(bearings[0] - bearings[1])) >= math.sin(math.radians(1.0))
    return in_range and seen and not image_seen and crosses


@settings(max_examples=examples(30))
@given(
    mounts_of_any_yaw,
    mounts_of_any_yaw,
    st.builds(FieldOfView, opening_rad=st.floats(0.5, 2.0), max_range_m=st.floats(1.0, 5.0)),
)
def test_the_common_share_is_that_of_random_points(a: Mount, b: Mount, field: FieldOfView) -> None:
    rng = np.random.default_rng(5)
    n = 1500
    ranges_m = np.sqrt(rng.uniform(field.min_range_m**2, field.max_range_m**2, n))
    angles = a.yaw_rad + rng.uniform(-0.5, 0.5, n) * field.opening_rad
    points = np.column_stack([a.x_m + ranges_m * np.cos(angles), a.y_m + ranges_m * np.sin(angles)])
    share = np.mean([placeable(point, (a, b), field) for point in points])
    # Five standard deviations of the drawn share, and what a rim of cells may hold.
    assert common_share((a, b), field) == pytest.approx(share, abs=5 * 0.5 / math.sqrt(n) + 0.03)


@given(poses, mounts_of_any_yaw, mounts_of_any_yaw)
def test_the_common_share_depends_on_how_two_radars_lie_to_each_other(
    place: Array, a: Mount, b: Mount
) -> None:
    share = common_share((a, b), PAPERS_FIELD)
    moved = [compose(place, np.array([m.x_m, m.y_m, m.yaw_rad])) for m in (b, a)]
    mounts = [replace(b, x_m=x, y_m=y, yaw_rad=yaw) for x, y, yaw in moved]
    # A cell's middle may lie on an edge of a view.
    assert common_share((mounts[0], mounts[1]), PAPERS_FIELD) == pytest.approx(share, abs=0.02)


@pytest.mark.parametrize("apart_deg", [60.0, 90.0, 120.0, 180.0])
def test_radars_that_look_different_ways_are_no_pair(apart_deg: float) -> None:
    yaws_rad = np.arange(0.0, math.tau - 0.01, math.radians(apart_deg))
    mounts = [
        Mount(name=str(k), x_m=0.2 * math.cos(yaw), y_m=0.2 * math.sin(yaw), yaw_rad=float(yaw))
        for k, yaw in enumerate(yaws_rad)
    ]
    rig = Rig(mounts=tuple(mounts))
    assert rig.pairs() == ()
    assert rig.sides() == tuple((k,) for k in range(len(mounts)))


def test_radars_half_turned_from_each_other_make_pairs_but_not_one_side() -> None:
    """Eight radars all around see each target with two at most; none needs both for all it sees."""
    mounts = [
        Mount(name=str(k), x_m=0.2 * math.cos(yaw), y_m=0.2 * math.sin(yaw), yaw_rad=yaw)
        for k, yaw in enumerate(math.radians(45.0) * np.arange(8))
    ]
    rig = Rig(mounts=tuple(mounts))
    pairs = {frozenset((pair.first, pair.second)) for pair in rig.pairs()}
    assert pairs == {frozenset((k, (k + 1) % 8)) for k in range(8)}
    assert rig.sides() == tuple((k,) for k in range(8))


@pytest.mark.parametrize(("baseline_m", "n_pairs"), [(0.005, 0), (0.05, 1), (1.0, 1), (2.0, 0)])
def test_a_base_is_neither_too_short_to_place_a_point_nor_too_long_for_a_common_view(
    baseline_m: float, n_pairs: int
) -> None:
    mounts = [Mount(name="", x_m=0.5 * k * baseline_m, y_m=0.0, yaw_rad=1.5) for k in (-1, 1)]
    assert len(Rig(mounts=tuple(mounts)).pairs()) == n_pairs


def test_pairs_are_of_the_range_that_the_front_end_has() -> None:
    mounts = [Mount(name="", x_m=k, y_m=0.0, yaw_rad=math.pi / 2) for k in (-1.0, 1.0)]
    assert Rig(mounts=tuple(mounts)).pairs() == ()
    assert len(Rig(mounts=tuple(mounts)).pairs(FieldOfView(max_range_m=5.0))) == 1

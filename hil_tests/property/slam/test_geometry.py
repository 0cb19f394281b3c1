"""Laws of the plane: angles, poses, pairs of mounts."""

import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from slam.geometry import (
    Mount,
    Rig,
    between,
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

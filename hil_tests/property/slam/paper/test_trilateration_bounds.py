"""The gate and the bounds of trilateration over hundreds of thousands of pairs of ranges."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil_tests.property.trilateration_oracles import HALF_VIEW_RAD, Array
from slam.geometry import Mount, Rig, paper_rig
from slam.paper.trilateration import bilaterate

FIELD_OF_VIEW_RAD = math.radians(65.0)
D_M = S_M = 0.2


def many_ranges(n: int) -> tuple[Array, Array]:
    """Return ranges at random, and as many within 1e-7 rad of an edge of the first radar's view."""
    rng = np.random.default_rng(8)
    anywhere = rng.uniform(0.02, 1.7, (n, 2))
    first = rng.uniform(0.02, 1.7, n)
    near = 10 ** rng.uniform(-8.9, -7, n) * rng.choice([-1, 1], n)
    off = rng.choice([-1, 1], n) * (HALF_VIEW_RAD + near)
    second = np.hypot(first * np.sin(off) - D_M, first * np.cos(off))
    ranges = np.vstack(
        [anywhere, np.column_stack([first, second]), np.column_stack([second, first])]
    )
    return ranges[:, 0], ranges[:, 1]


@pytest.mark.parametrize("side", [0, 1])
def test_gate_is_a_triangle_whose_point_both_radars_see(side: int) -> None:
    """Zero disagreements farther than 1e-9 rad from an edge of view, among 300 000 pairs."""
    l1, l2 = many_ranges(100_000)
    _, accepted = bilaterate(l1, l2, paper_rig().pairs()[side], FIELD_OF_VIEW_RAD)
    triangle = (np.abs(l1 - l2) <= D_M) & (l1 + l2 >= D_M)
    # The apex by Heron's formula, and the angles off the boresights from where it lies.
    with np.errstate(invalid="ignore"):
        half = (l1 + l2 + D_M) / 2
        height = 2 / D_M * np.sqrt(half * (half - l1) * (half - l2) * (half - D_M))
        along = (l1 - l2) * (l1 + l2) / (2 * D_M)  # from the middle of the base
        off = np.maximum(
            np.abs(np.arctan2(along + D_M / 2, height)), np.abs(np.arctan2(along - D_M / 2, height))
        )
    margin = np.where(triangle, HALF_VIEW_RAD - off, -1.0)
    clear = np.abs(margin) > 1e-9
    assert clear.mean() > 0.95
    assert np.array_equal(accepted[clear], margin[clear] > 0)
    assert 10_000 < accepted.sum() < 250_000


def test_nothing_lies_nearer_than_the_radars_themselves() -> None:
    """Whatever the field of view, an accepted point is beyond s, where the radars are."""
    l1, l2 = many_ranges(50_000)
    for pair in paper_rig().pairs():
        for view_deg in (1.0, 65.0, 120.0, 179.0):
            xy, accepted = bilaterate(l1, l2, pair, math.radians(view_deg))
            r = np.hypot(xy[accepted, 0], xy[accepted, 1])
            assert np.isfinite(r).all()
            assert r.min(initial=math.inf) >= S_M
            assert (np.abs(xy[accepted, 1]) > S_M).all()


@given(st.floats(0.2, 1.5), st.floats(0.2, 1.5), st.floats(0.1, 10.0))
def test_scaling_all_lengths_scales_the_range_and_keeps_the_bearing(
    l1: float, l2: float, k: float
) -> None:
    big = Rig(
        mounts=tuple(
            Mount(name=m.name, x_m=k * m.x_m, y_m=k * m.y_m, yaw_rad=m.yaw_rad)
            for m in paper_rig().mounts
        )
    )
    for pair, pair_k in zip(paper_rig().pairs(), big.pairs(), strict=True):
        ((x, y),), kept = bilaterate(np.array([l1]), np.array([l2]), pair, FIELD_OF_VIEW_RAD)
        scaled = k * np.array([l1]), k * np.array([l2])
        ((x_k, y_k),), kept_k = bilaterate(*scaled, pair_k, FIELD_OF_VIEW_RAD)
        if not kept[0]:
            continue
        assert math.hypot(x_k, y_k) == pytest.approx(k * math.hypot(x, y), rel=1e-12)
        assert math.atan2(y_k, x_k) == pytest.approx(math.atan2(y, x), abs=1e-12)
        assert kept_k[0] or _at_an_edge(x, y)


def _at_an_edge(x: float, y: float) -> bool:
    ahead = abs(y) - S_M
    offs = [abs(math.atan2(x - at, ahead)) for at in (-D_M / 2, D_M / 2)]
    return abs(max(offs) - HALF_VIEW_RAD) < 1e-9

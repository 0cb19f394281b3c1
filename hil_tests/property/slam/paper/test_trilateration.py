"""Laws of trilateration and of the choice of pairs."""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from random import Random

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

from hil_tests.property.trilateration_oracles import (
    HALF_VIEW_RAD,
    NO_RANGES,
    Array,
    distance,
    off_boresight,
)
from slam.config import Pairing, TrilaterationConfig
from slam.frames import Detection
from slam.geometry import FieldOfView, Mount, RadarPair, Rig, pair_of, paper_rig
from slam.paper.trilateration import Trilaterator, bilaterate
from slam.results import Fix

FIELD_OF_VIEW_RAD = math.radians(65.0)
GAMMA_RAD = (math.pi - FIELD_OF_VIEW_RAD) / 2
MIN_RANGE_M, MAX_RANGE_M = 0.2, 1.5
# Most drawn ranges belong to no triangle, or to none in view.
sifted = settings(suppress_health_check=[HealthCheck.filter_too_much, HealthCheck.too_slow])


@st.composite
def pairs(draw: st.DrawFn) -> tuple[Rig, RadarPair]:
    """Draw two mounts side by side on a robot, looking the same way square to their base."""
    baseline_m = draw(st.floats(0.1, 0.3))
    yaw_rad = draw(st.floats(-math.pi, math.pi))
    x_m, y_m = draw(st.floats(-0.3, 0.3)), draw(st.floats(-0.3, 0.3))
    half = np.array([math.sin(yaw_rad), -math.cos(yaw_rad)]) * baseline_m / 2
    mounts = [
        Mount(name="a", x_m=x_m + half[0], y_m=y_m + half[1], yaw_rad=yaw_rad),
        Mount(name="b", x_m=x_m - half[0], y_m=y_m - half[1], yaw_rad=yaw_rad),
    ]
    rig = Rig(mounts=tuple(mounts if draw(st.booleans()) else mounts[::-1]))
    (pair,) = rig.pairs()
    return rig, pair


@st.composite
def views(draw: st.DrawFn) -> tuple[Rig, RadarPair, Array]:
    """Draw a pair and a target both of its radars see, straight from forward geometry."""
    rig, pair = draw(pairs())
    first, second = rig.mounts[pair.first], rig.mounts[pair.second]
    off = draw(st.floats(-HALF_VIEW_RAD + 1e-6, HALF_VIEW_RAD - 1e-6))
    range_m = draw(st.floats(MIN_RANGE_M, MAX_RANGE_M))
    target = np.array([first.x_m, first.y_m]) + range_m * np.array(
        [math.cos(first.yaw_rad + off), math.sin(first.yaw_rad + off)]
    )
    assume(MIN_RANGE_M <= distance(second, target) <= MAX_RANGE_M)
    assume(abs(off_boresight(second, target)) < HALF_VIEW_RAD - 1e-6)
    return rig, pair, target


def ranges_to(rig: Rig, pair: RadarPair, target: Array) -> tuple[Array, Array]:
    return (
        np.array([distance(rig.mounts[pair.first], target)]),
        np.array([distance(rig.mounts[pair.second], target)]),
    )


def random_joint_targets(n: int) -> tuple[RadarPair, Array, Array]:
    """Ranges of uniform targets in the joint view of the paper's left pair."""
    rig = paper_rig()
    pair = rig.pairs()[0]
    rng = np.random.default_rng(1)
    xy = rng.uniform([-1.2, 0.2], [1.2, 1.8], (8 * n, 2))
    offsets = xy[:, None, :] - np.array(
        [(rig.mounts[k].x_m, rig.mounts[k].y_m) for k in (pair.first, pair.second)]
    )
    ranges = np.hypot(offsets[..., 0], offsets[..., 1])
    off = np.abs(np.arctan2(offsets[..., 0], offsets[..., 1]))
    seen = np.all((ranges > MIN_RANGE_M) & (ranges < MAX_RANGE_M) & (off < HALF_VIEW_RAD), axis=1)
    kept = ranges[seen][:n]
    assert len(kept) == n
    return pair, kept[:, 0], kept[:, 1]


# --- the laws -----------------------------------------------------------------------------------


@sifted
@given(views())
def test_round_trip(view: tuple[Rig, RadarPair, Array]) -> None:
    rig, pair, target = view
    xy, accepted = bilaterate(*ranges_to(rig, pair, target), pair, FIELD_OF_VIEW_RAD)
    assert accepted.tolist() == [True]
    assert math.dist(xy[0], target) <= 1e-12


@st.composite
def looks(draw: st.DrawFn) -> tuple[Rig, RadarPair, Array]:
    """Draw a pair and a target ahead of it: anywhere, or 1e-9 to 1e-6 rad beside an edge of view.

    The edge is that of one radar; the other one may see the target or not.
    """
    rig, pair = draw(pairs())
    near = rig.mounts[draw(st.sampled_from([pair.first, pair.second]))]
    beside = 10 ** draw(st.floats(-8.99, -6.0)) * draw(st.sampled_from([-1, 1]))
    edge = draw(st.sampled_from([-1, 1])) * (HALF_VIEW_RAD + beside)
    off = edge if draw(st.booleans()) else draw(st.floats(-1.57, 1.57))
    range_m = draw(st.floats(0.05, 1.6))
    direction = near.yaw_rad + off
    antenna = np.array([near.x_m, near.y_m])
    return rig, pair, antenna + range_m * np.array([math.cos(direction), math.sin(direction)])


@sifted
@given(looks())
def test_gate(look: tuple[Rig, RadarPair, Array]) -> None:
    """Judge from where the target is: ranges follow from it, never it from ranges."""
    rig, pair, target = look
    margins = [
        HALF_VIEW_RAD - abs(off_boresight(rig.mounts[k], target)) for k in (pair.first, pair.second)
    ]
    assume(all(abs(margin) > 1e-9 for margin in margins))
    _, accepted = bilaterate(*ranges_to(rig, pair, target), pair, FIELD_OF_VIEW_RAD)
    assert accepted.tolist() == [min(margins) > 0]


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


def test_gate_by_heron() -> None:
    """Zero disagreements farther than 1e-9 rad from an edge of view, among 300 000 pairs."""
    l1, l2 = many_ranges(100_000)
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
    for pair in paper_rig().pairs():
        _, accepted = bilaterate(l1, l2, pair, FIELD_OF_VIEW_RAD)
        assert np.array_equal(accepted[clear], margin[clear] > 0)
        assert 10_000 < accepted.sum() < 250_000


@sifted
@given(pairs(), st.floats(0.05, 1.6), st.floats(1e-9, 1.0), st.booleans())
def test_triangle(built: tuple[Rig, RadarPair], l1: float, gap_m: float, inside: bool) -> None:
    """Circles that do not meet, by 1e-9 m or by more."""
    _, pair = built
    d = pair.baseline_m
    l2 = l1 + d + gap_m if inside else d - l1 - gap_m
    assume(l2 > 0)
    for a, b in ((l1, l2), (l2, l1)):
        _, accepted = bilaterate(np.array([a]), np.array([b]), pair, FIELD_OF_VIEW_RAD)
        assert accepted.tolist() == [False]


@sifted
@given(st.one_of(NO_RANGES, st.floats()), st.one_of(NO_RANGES, st.floats(0.2, 1.5)))
def test_impossible_ranges(l1: float, l2: float) -> None:
    """No output, no exception and no warning, also of ranges that overflow when squared."""
    pair = paper_rig().pairs()[0]
    d = pair.baseline_m
    possible = 0 < l1 < 1e150 and 0 < l2 < 1e150
    assume(not possible or abs(l1 - l2) > d or l1 + l2 < d)
    for a, b in ((l1, l2), (l2, l1)):
        _, accepted = bilaterate(np.array([a]), np.array([b]), pair, FIELD_OF_VIEW_RAD)
        assert accepted.tolist() == [False]


@sifted
@given(st.floats(0.2, 1.5), st.floats(0.2, 1.5))
def test_paper_equations(l1: float, l2: float) -> None:
    left, right = paper_rig().pairs()
    d = s = 0.2
    assume(abs(l1 - l2) < d - 1e-9)
    alpha = math.acos((l1**2 + d**2 - l2**2) / (2 * l1 * d))
    beta = math.acos((l2**2 + d**2 - l1**2) / (2 * l2 * d))
    assume(alpha > GAMMA_RAD + 1e-9 and beta > GAMMA_RAD + 1e-9)
    x, y = l1 * math.cos(alpha) - d / 2, l1 * math.sin(alpha) + s
    ranges = np.array([l1]), np.array([l2])
    xy, accepted = bilaterate(*ranges, left, FIELD_OF_VIEW_RAD)
    assert accepted.tolist() == [True]
    assert xy[0] == pytest.approx([x, y], abs=1e-12)
    xy, accepted = bilaterate(*ranges, right, FIELD_OF_VIEW_RAD)
    assert accepted.tolist() == [True]
    assert xy[0] == pytest.approx([-x, -y], abs=1e-12)  # bearing pi + phi


@st.composite
def odd_looks(draw: st.DrawFn) -> tuple[tuple[Mount, Mount], RadarPair, float, Array]:
    """Draw two mounts with any yaws, an opening angle and a target that may be anywhere near."""
    yaws = st.floats(-math.pi, math.pi)
    first_rad = draw(yaws)
    second_rad = first_rad + draw(st.one_of(st.floats(-1.0, 1.0), yaws))
    # A base along the view has points that are seen on the side that the boresights look from.
    base_rad = first_rad + draw(st.one_of(st.floats(-0.5, 0.5), yaws))
    half_m = draw(st.floats(0.05, 0.5))
    x_m, y_m = half_m * math.cos(base_rad), half_m * math.sin(base_rad)
    mounts = (
        Mount(name="a", x_m=-x_m, y_m=-y_m, yaw_rad=first_rad),
        Mount(name="b", x_m=x_m, y_m=y_m, yaw_rad=second_rad),
    )
    pair = pair_of(0, 1, mounts)
    assert pair is not None
    direction = first_rad + draw(st.floats(-1.2, 1.2))
    range_m = draw(st.floats(0.2, 5.0))
    target = range_m * np.array([math.cos(direction), math.sin(direction)]) - [x_m, y_m]
    return mounts, pair, draw(st.floats(0.3, 2.8)), target


def look_from_behind() -> tuple[tuple[Mount, Mount], RadarPair, float, Array]:
    """Return a target that both see on the side of the base that their boresights point from.

    It lies 10 and 30 degrees off the base, whose two boresights are 20 degrees off it on the other
    side and 10 on this: the second radar does not have the mirror image in view.
    """
    mounts = (
        Mount(name="a", x_m=-0.1, y_m=0.0, yaw_rad=math.radians(20.0)),
        Mount(name="b", x_m=0.1, y_m=0.0, yaw_rad=math.radians(-10.0)),
    )
    pair = pair_of(0, 1, mounts)
    assert pair is not None
    range_m = 0.2 * math.sin(math.radians(30.0)) / math.sin(math.radians(20.0))
    away_rad = math.radians(-10.0)
    target = range_m * np.array([math.cos(away_rad), math.sin(away_rad)]) - [0.1, 0.0]
    return mounts, pair, FIELD_OF_VIEW_RAD, target


@sifted
@given(odd_looks())
@example(look_from_behind())
def test_any_yaws(look: tuple[tuple[Mount, Mount], RadarPair, float, Array]) -> None:
    """Of the two points that the law of cosines gives, the one that both radars see, if one."""
    (a, b), pair, opening_rad, target = look
    l1, l2 = distance(a, target), distance(b, target)
    d, base_rad = math.hypot(b.x_m - a.x_m, b.y_m - a.y_m), math.atan2(b.y_m, b.x_m)
    cosine = (l1**2 + d**2 - l2**2) / (2 * l1 * d)
    assume(l2 > 1e-3 and abs(cosine) < 1 - 1e-6)
    seen = []
    for side in (1, -1):
        away_rad = base_rad + side * math.acos(cosine)
        point = np.array([a.x_m, a.y_m]) + l1 * np.array([math.cos(away_rad), math.sin(away_rad)])
        margins = [opening_rad / 2 - abs(off_boresight(mount, point)) for mount in (a, b)]
        assume(all(abs(margin) > 1e-6 for margin in margins))
        if min(margins) > 0:
            seen.append(point)
    xy, accepted = bilaterate(np.array([l1]), np.array([l2]), pair, opening_rad)
    assert accepted.tolist() == [len(seen) == 1]
    if len(seen) == 1:
        assert math.dist(xy[0], seen[0]) <= 1e-6


# --- symmetries and bounds ----------------------------------------------------------------------


@given(st.floats(0.2, 1.5), st.floats(0.2, 1.5))
def test_swapping_ranges_reverses_the_base_exactly(l1: float, l2: float) -> None:
    pair = paper_rig().pairs()[0]
    a, b = np.array([l1]), np.array([l2])
    (one,), kept_one = bilaterate(a, b, pair, FIELD_OF_VIEW_RAD)
    (two,), kept_two = bilaterate(b, a, pair, FIELD_OF_VIEW_RAD)
    assert kept_one.tolist() == kept_two.tolist()
    if kept_one[0]:
        assert (one[0], one[1]) == (-two[0], two[1])


@given(st.floats(0.2, 1.5), st.floats(0.2, 1.5))
def test_mirrored_sides_flip_only_the_sign_of_the_bearing(l1: float, l2: float) -> None:
    left, right = paper_rig().pairs()
    a, b = np.array([l1]), np.array([l2])
    ((x, y),), kept = bilaterate(a, b, left, FIELD_OF_VIEW_RAD)
    # On the right the first radar is the front one: the mirror image swaps the ranges too.
    ((x_mirror, y_mirror),), kept_mirror = bilaterate(b, a, right, FIELD_OF_VIEW_RAD)
    assert kept.tolist() == kept_mirror.tolist()
    if kept[0]:
        assert math.hypot(x, y) == math.hypot(x_mirror, y_mirror)
        assert math.atan2(y, x) == pytest.approx(-math.atan2(y_mirror, x_mirror), abs=1e-15)


@given(views(), st.floats(0.1, 10.0))
def test_scaling_all_lengths_scales_range_and_keeps_bearing(
    view: tuple[Rig, RadarPair, Array], k: float
) -> None:
    rig, pair, target = view
    scaled = Rig(
        mounts=tuple(
            Mount(name=m.name, x_m=k * m.x_m, y_m=k * m.y_m, yaw_rad=m.yaw_rad) for m in rig.mounts
        )
    )
    (scaled_pair,) = scaled.pairs(
        FieldOfView(min_range_m=k * MIN_RANGE_M, max_range_m=k * MAX_RANGE_M)
    )
    l1, l2 = ranges_to(rig, pair, target)
    (xy,), _ = bilaterate(l1, l2, pair, FIELD_OF_VIEW_RAD)
    (xy_scaled,), accepted = bilaterate(k * l1, k * l2, scaled_pair, FIELD_OF_VIEW_RAD)
    assert accepted[0]
    assert math.dist(xy_scaled, k * xy) <= 1e-12 * k


def test_accepted_points_lie_where_the_paper_rig_can_see() -> None:
    grid = np.linspace(0.2, 1.5, 1301)
    l1, l2 = (axis.ravel() for axis in np.meshgrid(grid, grid))
    for pair in paper_rig().pairs():
        xy, accepted = bilaterate(l1, l2, pair, FIELD_OF_VIEW_RAD)
        seen = xy[accepted]
        r = np.hypot(seen[:, 0], seen[:, 1])
        from_forward = np.abs(np.degrees(np.arctan2(seen[:, 1], seen[:, 0])))
        # Both extremes lie straight ahead: equal ranges of 0.2 m and of 1.5 m.
        assert r.min() == pytest.approx(math.sqrt(0.2**2 - 0.1**2) + 0.2, abs=1e-12)
        assert r.max() == pytest.approx(math.sqrt(1.5**2 - 0.1**2) + 0.2, abs=1e-12)
        # Farthest forward: on the edge of the rear radar's view at its full range.
        edge = math.atan2(0.2 + 1.5 * math.sin(GAMMA_RAD), 1.5 * math.cos(GAMMA_RAD) - 0.1)
        assert math.degrees(edge) <= from_forward.min() <= math.degrees(edge) + 0.2
        assert from_forward.max() == pytest.approx(180.0 - from_forward.min(), abs=1e-9)
    # The nearest equal ranges that both see: d / (2 cos gamma).
    nearest = 0.2 / (2 * math.cos(GAMMA_RAD))
    assert nearest == pytest.approx(0.186, abs=5e-4)
    around = np.array([nearest - 1e-6, nearest + 1e-6])
    assert bilaterate(around, around, pair, FIELD_OF_VIEW_RAD)[1].tolist() == [False, True]


# --- sensitivity --------------------------------------------------------------------------------


@pytest.mark.parametrize(("offset_m", "bearing_deg"), [(0.02, 0.21), (0.1, 0.9), (0.2, 1.6)])
def test_common_range_offset_moves_range_not_bearing(offset_m: float, bearing_deg: float) -> None:
    pair, l1, l2 = random_joint_targets(100_000)
    true_xy, accepted = bilaterate(l1, l2, pair, FIELD_OF_VIEW_RAD)
    assert accepted.all()
    shifted_xy, _ = bilaterate(l1 + offset_m, l2 + offset_m, pair, math.pi)
    shift = np.linalg.norm(shifted_xy, axis=1) - np.linalg.norm(true_xy, axis=1)
    assert (shift / offset_m).min() >= 1.0
    assert (shift / offset_m).max() <= 1.14
    turn = np.arctan2(shifted_xy[:, 1], shifted_xy[:, 0]) - np.arctan2(true_xy[:, 1], true_xy[:, 0])
    assert np.degrees(np.abs(turn)).max() <= bearing_deg


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


def echoes(rig: Rig, targets: Sequence[Array]) -> list[Detection]:
    return [
        Detection(radar=k, t_ns=0, range_m=distance(mount, target), amplitude=0.01)
        for k, mount in enumerate(rig.mounts)
        for target in targets
        if abs(off_boresight(mount, target)) < HALF_VIEW_RAD
    ]


@st.composite
def crowds(draw: st.DrawFn) -> list[Array]:
    """Draw up to five targets in the joint view of the left pair, inside its range limits."""
    side = st.tuples(st.floats(-0.09, 0.09), st.floats(0.55, 1.6))
    return [np.array(point) for point in draw(st.lists(side, min_size=1, max_size=5))]


@given(crowds(), st.randoms(use_true_random=False))
def test_every_true_pair_is_found_among_at_most_k_squared(
    targets: list[Array], shuffler: Random
) -> None:
    rig = paper_rig()
    trilaterator = Trilaterator(TrilaterationConfig(), rig)
    detections = echoes(rig, targets)
    fixes = trilaterator.locate(detections, 0)
    assert len(fixes) <= len(targets) ** 2
    for target in targets:
        assert min(math.dist((fix.x_m, fix.y_m), target) for fix in fixes) <= 1e-12
    shuffled = list(detections)
    shuffler.shuffle(shuffled)
    assert set(trilaterator.locate(shuffled, 0)) == set(fixes)


@given(crowds(), st.sampled_from([1e-4, 1.0, 5.0]), st.sampled_from([-1, 1]))
def test_a_rig_with_yaws_as_measured_finds_every_target_that_both_radars_see(
    targets: list[Array], off_deg: float, way: int
) -> None:
    mounts = list(paper_rig().mounts)
    for radar, turn in ((0, way), (1, -way)):
        yaw_rad = mounts[radar].yaw_rad + turn * math.radians(off_deg)
        mounts[radar] = replace(mounts[radar], yaw_rad=yaw_rad)
    rig = Rig(mounts=tuple(mounts))
    fixes = Trilaterator(TrilaterationConfig(), rig).locate(echoes(rig, targets), 0)
    for target in targets:
        if all(abs(off_boresight(mount, target)) < HALF_VIEW_RAD for mount in rig.mounts[:2]):
            assert min(math.dist((fix.x_m, fix.y_m), target) for fix in fixes) <= 1e-12


@given(
    # detections have no others
    st.lists(st.tuples(st.sampled_from([0, 1]), NO_RANGES.filter(math.isfinite)), max_size=6),
    st.sampled_from(list(Pairing)),
)
def test_impossible_ranges_give_no_fix_and_leave_the_others_alone(
    impossible: list[tuple[int, float]], pairing: Pairing
) -> None:
    trilaterator = Trilaterator(TrilaterationConfig(pairing=pairing), paper_rig())
    bad = [Detection(radar=k, t_ns=0, range_m=r, amplitude=0.01) for k, r in impossible]
    assert trilaterator.locate(bad, 0) == ()
    good = echoes(paper_rig(), [np.array([0.0, 1.0])])
    assert trilaterator.locate([*bad, *good], 0) == trilaterator.locate(good, 0) != ()


# --- each detection used once -------------------------------------------------------------------


loudness = st.one_of(
    st.sampled_from([0.01, 0.02]), st.floats(1e-3, 1.0), st.sampled_from([0.0, math.inf])
)
peaks = st.lists(
    st.tuples(st.one_of(st.sampled_from([0.8, 0.85]), st.floats(0.2, 1.5)), loudness), max_size=4
)


@given(peaks, peaks, st.randoms(use_true_random=False))
def test_one_to_one_is_the_best_choice_among_all_pairs_in_any_order(
    first: list[tuple[float, float]], second: list[tuple[float, float]], shuffler: Random
) -> None:
    detections = [
        Detection(radar=radar, t_ns=0, range_m=range_m, amplitude=amplitude)
        for radar, found in ((0, first), (1, second))
        for range_m, amplitude in dict(found).items()
    ]
    rig = paper_rig()
    pairs_of_all = Trilaterator(TrilaterationConfig(), rig).locate(detections, 0)
    one_each = Trilaterator(TrilaterationConfig(pairing=Pairing.ONE_TO_ONE), rig)
    fixes = one_each.locate(detections, 0)
    assert len(fixes) <= min(len(first), len(second))
    assert set(fixes) <= set(pairs_of_all)
    used = [detection for fix in fixes for detection in fix.detections]
    assert len(used) == len(set(used))
    # Every choice of pairs that share no detection, by brute force.
    most = max(
        (len(choice), -mismatch(choice))
        for n in range(5)
        for choice in combinations(pairs_of_all, n)
        if len({d for fix in choice for d in fix.detections}) == 2 * n
    )
    assert len(fixes) == most[0]
    assert -mismatch(fixes) == pytest.approx(most[1], abs=1e-9)
    shuffler.shuffle(detections)
    assert set(one_each.locate(detections, 0)) == set(fixes)


def mismatch(fixes: Sequence[Fix]) -> float:
    loud = [[min(max(d.amplitude, 1e-12), 1e12) for d in fix.detections] for fix in fixes]
    return sum(abs(math.log(a) - math.log(b)) for a, b in loud)


def test_one_to_one_tells_two_targets_apart_by_their_loudness() -> None:
    """All four pairs are possible: two targets, two ghosts."""
    targets = [np.array([-0.05, 0.9]), np.array([0.06, 0.93])]
    rig = paper_rig()
    detections = [
        Detection(radar=radar, t_ns=0, range_m=distance(rig.mounts[radar], t), amplitude=loud)
        for radar in (0, 1)
        for t, loud in zip(targets, ((0.02, 0.021)[radar], (0.008, 0.0077)[radar]), strict=True)
    ]
    assert len(Trilaterator(TrilaterationConfig(), rig).locate(detections, 0)) == 4
    config = TrilaterationConfig(pairing=Pairing.ONE_TO_ONE)
    found = sorted((f.x_m, f.y_m) for f in Trilaterator(config, rig).locate(detections, 0))
    assert found == [pytest.approx(tuple(t), abs=1e-12) for t in targets]


def test_stamps_too_far_apart_make_no_fix() -> None:
    rig = paper_rig()
    detections = [
        Detection(radar=0, t_ns=0, range_m=0.8, amplitude=0.01),
        Detection(radar=1, t_ns=100_000_000, range_m=0.8, amplitude=0.01),
    ]

    def locate(limit_s: float) -> tuple[Fix, ...]:
        config = TrilaterationConfig(max_stamp_difference_s=limit_s)
        return Trilaterator(config, rig).locate(detections, 0)

    assert len(locate(math.inf)) == len(locate(0.1)) == 1
    assert locate(0.099) == ()

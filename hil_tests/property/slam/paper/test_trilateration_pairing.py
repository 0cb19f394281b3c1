"""Which detections are combined: every one with every one, or each used once."""

import math
from collections.abc import Sequence
from itertools import combinations
from random import Random

import numpy as np
import pytest
from hypothesis import given
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
from slam.geometry import Rig, paper_rig
from slam.paper.trilateration import Trilaterator
from slam.results import Fix


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


@given(
    st.lists(st.tuples(st.sampled_from([0, 1]), NO_RANGES), max_size=6),
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


@given(crowds(), st.randoms(use_true_random=False))
def test_one_to_one_gives_at_most_k_fixes(targets: list[Array], shuffler: Random) -> None:
    one_each = Trilaterator(TrilaterationConfig(pairing=Pairing.ONE_TO_ONE), paper_rig())
    detections = echoes(paper_rig(), targets)
    fixes = one_each.locate(detections, 0)
    assert 1 <= len(fixes) <= len(targets)
    shuffler.shuffle(detections)
    assert set(one_each.locate(detections, 0)) == set(fixes)


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

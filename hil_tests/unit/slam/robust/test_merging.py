"""Landmarks are merged where the whole run allows it, and the noise of ranges that is assumed."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from hil_tests.unit.slam.robust.range_world import (
    LAB,
    echoes_of,
    follow,
    parameters_for,
    place_landmarks,
    reported,
    scans_of,
    true_path,
)
from slam.config import WheelNoise, load_preset, override
from slam.geometry import between, compose, paper_rig, transform
from slam.robust.association import RangeScan
from slam.robust.back_end import RobustBackEnd
from slam.robust.initialisation import BodyPoint, initialise_landmark
from slam.robust.map import Existence, find_merge, named_pairs
from slam.robust.parameters import BackEndParameters, MapRule
from slam.robust.pipeline import RobustSlam
from slam.robust.state import Array, State

SIGMA_M = 4e-3
PLACES = np.array([[0.1, 0.9], [0.55, 0.7], [0.95, 1.1], [0.3, -0.8], [0.8, -1.0]])


def mapped(places: Array, sigma_m: float = 0.02) -> State:
    state = State((0.0, 0.0, 0.0), (0.0,) * 4)
    for place in places:
        point = BodyPoint(
            point_m=place, covariance=sigma_m**2 * np.eye(2), by_offsets=np.zeros((2, 4))
        )
        initialise_landmark(state, point)
    return state


def test_a_merge_must_stand_out_from_its_rivals() -> None:
    rule = MapRule()
    state = mapped(np.array([[0.0, 1.0], [0.03, 1.0], [2.0, 1.0]]))
    merge = find_merge(state, rule)
    assert merge is not None
    assert merge.pair == (0, 1)
    # A third one as near as the second: which two are one is not certain.
    state = mapped(np.array([[0.0, 1.0], [0.03, 1.0], [-0.03, 1.0]]))
    assert find_merge(state, rule) is None


@pytest.mark.parametrize(
    ("third_m", "sigma_m", "merges"),
    [
        (0.069, 0.02, False),
        (0.070, 0.02, True),  # 12^0.5 sigma: 3 nats less likely, as each is unsure by sigma
        # Below 0.1673 m, 1 / (4 pi sigma^2) exceeds one on a disc of 1.5 m by 3 nats.
        (9.0, 0.168, False),
        (9.0, 0.167, True),
    ],
)
def test_a_merge_is_made_from_the_likelihood_margin_and_the_density_on(
    third_m: float, sigma_m: float, merges: bool
) -> None:
    state = mapped(np.array([[0.0, 1.0], [0.0, 1.0], [third_m, 1.0]]), sigma_m)
    merge = find_merge(state, MapRule())
    assert (merge is not None and merge.pair == (0, 1)) == merges


def after_a_drive(seed: int, places: Array) -> RobustBackEnd:
    """Return a back end that has driven past some landmarks and half the way back."""
    rng = np.random.default_rng(seed)
    x = np.arange(0.0, 1.3, 0.02)
    there = np.column_stack([x, np.zeros((len(x), 2))])
    poses = np.vstack([there, there[::-1][:40]])
    back_end = RobustBackEnd(paper_rig(), parameters_for(LAB, SIGMA_M))
    increments = reported(poses, LAB, rng, 0.0)
    list(follow(back_end, increments, scans_of(poses, places, rng, SIGMA_M)))
    return back_end


def with_doubled_landmark(back_end: RobustBackEnd) -> int:
    """Give the later ranges of the first landmark to a new one at its place; return its row."""
    state, log = back_end.state, back_end._log
    landmark_id = state.landmark_ids[0]
    ranges = log._ranges.rows_to_write()
    rows = np.flatnonzero(ranges["landmark"] == landmark_id)
    later = rows[len(rows) // 2 :]
    size = state.layout.landmark_size
    new_id = state.augment(
        state.landmarks_m[0] + [0.002, -0.001], np.zeros((state.P.size, size)), np.eye(size)
    )
    assert new_id != landmark_id
    ranges["landmark"][later] = new_id
    back_end._existence.hit(new_id, len(np.unique(ranges["pose"][later])))
    assert back_end.relinearise()
    return state.landmark_ids.index(new_id)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_landmark_mapped_twice_becomes_one(seed: int) -> None:
    back_end = after_a_drive(seed, PLACES)
    single = back_end.state.landmarks_m[0].copy()
    twice = with_doubled_landmark(back_end)
    n, kept = len(back_end.state.landmark_ids), back_end.state.landmark_ids[0]
    assert back_end.merge_if_possible([(0, twice)])
    assert len(back_end.state.landmark_ids) == n - 1
    row = back_end.state.landmark_ids.index(kept)
    assert back_end.state.landmarks_m[row] == pytest.approx(single, abs=2e-3)


def met_again(
    hidden: Array, twin: int | None = None
) -> tuple[RobustBackEnd, Array, list[tuple[int, int]], tuple[int, int]]:
    """Drive a lap and a half; in the last turn of the first lap the wheels slip.

    So the second lap is mapped anew. Returned are the back end, the true pose (3,), the rows of
    what is mapped twice, and, of landmark ``twin`` and of another one that lies where the slip
    carries that, the row that is known from before and the row mapped anew.
    """
    rng = np.random.default_rng(1)
    poses, landmarks = true_path(LAB, 2), place_landmarks(LAB, rng)
    lap = len(poses) // 2
    slip, end = lap - 8, lap + 500
    carried = compose(poses[slip], compose(between(poses[slip], poses[slip + 1]), hidden))
    to_truth = compose(poses[slip + 1], between(carried, np.zeros(3)))
    if twin is not None:
        landmarks = np.vstack([landmarks, transform(to_truth, landmarks[twin])])
    increments = reported(poses, LAB, rng, 0.0)
    increments[slip] = compose(increments[slip], hidden)
    scans = list(scans_of(poses[: end + 1], landmarks, rng, SIGMA_M, clutter=False))
    back_end = RobustBackEnd(paper_rig(), parameters_for(LAB, SIGMA_M))
    state, first_new = back_end.state, 0
    for k, (increment, of_pose) in enumerate(zip(increments[:end], scans, strict=True)):
        first_new = state.next_id if k == slip else first_new
        back_end.predict(increment, np.diag([0.01, 0.01, 0.16]) if k == slip else None)
        back_end.update(of_pose)
    to_truth = compose(poses[end], between(back_end.pose, np.zeros(3)))
    assert abs(to_truth[2]) > 0.9 * hidden[2]
    true = state.landmarks_m.copy()
    is_new = np.array(state.landmark_ids) >= first_new
    true[is_new] = transform(to_truth, true[is_new])
    which = np.hypot(*(true[:, None] - landmarks).T).argmin(axis=0)
    rows = back_end.reported_rows()
    old = {which[row]: row for row in rows if not is_new[row]}
    new = {which[row]: row for row in rows if is_new[row]}
    alike = (twin, len(landmarks) - 1) if twin is not None else ()
    pairs = [(old[n], row) for n, row in new.items() if n in old and n not in alike]
    assert len(pairs) >= 5
    return back_end, poses[end], pairs, (old[alike[0]], new[alike[1]]) if alike else (0, 0)


def assert_is_at(back_end: RobustBackEnd, pose: Array) -> None:
    error = between(pose, back_end.pose)
    assert np.all(np.abs(error) < 3.5 * np.sqrt(back_end.pose_covariance.diagonal()))
    assert np.hypot(*error[:2]) < 0.03


@pytest.mark.parametrize("hidden_rad", [0.6, 1.0])
def test_a_map_that_is_met_again_behind_a_large_slip_is_one(hidden_rad: float) -> None:
    """From where the landmarks lie the run is not solved for: the path must be bent first."""
    back_end, pose, pairs, _ = met_again(np.array([0.05, -0.03, hidden_rad]))
    assert back_end.merge_if_possible(pairs)
    assert_is_at(back_end, pose)


def mistaken_behind_a_slip(
    hidden_rad: float, twin: int
) -> tuple[RobustBackEnd, Array, list[tuple[int, int]], NDArray[np.intp]]:
    """Return what `met_again` returns, and the rows of ranges of a thing taken for another one."""
    back_end, pose, pairs, (known, other) = met_again(np.array([0.05, -0.03, hidden_rad]), twin)
    state, ranges = back_end.state, back_end._log._ranges.rows_to_write()
    names = [state.landmark_ids[row] for row in (known, other)]
    wrong = np.flatnonzero(ranges["landmark"] == names[1])
    ranges["landmark"][wrong] = names[0]
    state.remove(other)
    return back_end, pose, [(kept, gone - (gone > other)) for kept, gone in pairs], wrong


@pytest.mark.parametrize(("hidden_rad", "twin"), [(0.6, 2), (1.0, 0)])
def test_a_thing_that_was_taken_for_another_one_behind_a_slip_does_not_keep_a_loop_open(
    hidden_rad: float, twin: int
) -> None:
    """It lies where the slip carries the other one; its ranges are of nothing then."""
    back_end, pose, pairs, wrong = mistaken_behind_a_slip(hidden_rad, twin)
    assert back_end.merge_if_possible(pairs)
    assert_is_at(back_end, pose)
    left_out = back_end._log._ranges.rows["landmark"] < 0
    assert np.all(left_out[wrong])
    assert np.count_nonzero(left_out) == len(wrong)


@pytest.mark.parametrize("why", ["two pairs", "the price", "a label", "other pairs"])
def test_a_loop_stays_open_if_a_mistake_explains_it_no_better(why: str) -> None:
    back_end, _, pairs, wrong = mistaken_behind_a_slip(0.6, 2)
    log, rules = back_end._log, back_end.parameters
    id_ = int(log._ranges.rows["landmark"][wrong[0]])
    if why == "two pairs":
        pairs = pairs[:2]
    elif why == "the price":
        dear = replace(rules.branches, most_against=100.0)
        back_end.parameters = replace(rules, branches=dear)
    elif why == "a label":
        back_end._landmark_of_label[7] = id_
    else:
        pairs = [
            (kept, gone) for (kept, _), (_, gone) in zip(pairs, pairs[1:] + pairs[:1], strict=True)
        ]
    before = back_end.state.landmarks_m.copy()
    assert not back_end.merge_if_possible(pairs)
    assert np.array_equal(back_end.state.landmarks_m, before)
    assert not np.any(log._ranges.rows["landmark"] < 0)


@pytest.mark.parametrize("apart_m", [0.1, 0.15, 0.3])
def test_two_landmarks_stay_two_where_the_run_says_so(apart_m: float) -> None:
    """Both are known to about two millimetres."""
    places = np.vstack([PLACES[1:], PLACES[1] + [apart_m, 0.0]])
    back_end = after_a_drive(3, places)
    state = back_end.state
    found = [int(np.argmin(np.hypot(*(state.landmarks_m - place).T))) for place in places[[0, -1]]]
    assert found[0] != found[1]
    pair = (min(found), max(found))
    before, covariance = state.landmarks_m.copy(), state.P.full()
    assert not back_end.merge_if_possible([pair])
    assert np.array_equal(state.landmarks_m, before)
    assert np.array_equal(state.P.full(), covariance)
    assert named_pairs(state, (pair,)) in back_end._refused


def test_a_merge_that_was_refused_is_not_tried_again_at_once() -> None:
    state = mapped(np.array([[0.0, 1.0], [0.03, 1.0], [2.0, 1.0]]))
    merge = find_merge(state, MapRule())
    assert merge is not None
    refused = {named_pairs(state, (merge.pair,))}
    assert find_merge(state, MapRule(), refused) is None
    assert find_merge(state, MapRule(), {((7, 8),)}) is not None


def test_a_refused_merge_hides_no_other_one() -> None:
    places = np.array([[0.0, 1.0], [0.01, 1.0], [2.0, 1.0], [2.03, 1.0]])
    state = mapped(places)
    first = find_merge(state, MapRule())
    assert first is not None
    assert first.pair == (0, 1)
    second = find_merge(state, MapRule(), {named_pairs(state, (first.pair,))})
    assert second is not None
    assert second.pair == (2, 3)


def test_the_share_of_the_preset_is_where_the_back_end_begins() -> None:
    config = override(load_preset("robust"), {"robust.range_variance_share": "2.5"})
    slam = RobustSlam(config, paper_rig(), WheelNoise())
    assert slam.back_end.state.range_errors.variance_share == 2.5
    plain = RobustBackEnd(paper_rig(), BackEndParameters())
    assert plain.state.range_errors.variance_share == 1.0


def test_ranges_that_err_alike_move_the_pose_less() -> None:
    """With four times the variance of averages, the filter is less sure by up to twice."""
    sigmas = []
    for share in (1.0, 4.0):
        rng = np.random.default_rng(5)
        x = np.arange(0.0, 0.5, 0.02)
        poses = np.column_stack([x, np.zeros((len(x), 2))])
        config = override(load_preset("robust"), {"robust.range_variance_share": str(share)})
        back_end = RobustSlam(config, paper_rig(), WheelNoise()).back_end
        increments = reported(poses, LAB, rng, 0.0)
        list(follow(back_end, increments, scans_of(poses, PLACES, rng, SIGMA_M)))
        sigmas.append(math.sqrt(back_end.pose_covariance[0, 0]))
    assert 1.0 < sigmas[1] / sigmas[0] <= 2.0


def learned_share(laps: int, white_m: float, by_aspect_m: float, configured: float = 1.0) -> float:
    """Return the share of the variance that ranges with two errors show on laps of one course.

    One is of its own in each range, one is that of the side from which a body is seen: the same
    sine on each lap. The latter's standard deviation is ``by_aspect_m``. What is configured
    is the share before.
    """
    rng = np.random.default_rng(38)
    poses, landmarks = true_path(LAB, laps), place_landmarks(LAB, rng)
    increments, phases = reported(poses, LAB, rng, 0.0), rng.uniform(0.0, math.tau, len(landmarks))
    ranges, seen = echoes_of(poses, landmarks, rng, white_m, 0.0)
    for radar, mount in enumerate(paper_rig().mounts):
        antennas = np.array(
            [compose(pose, np.array([mount.x_m, mount.y_m, 0.0])) for pose in poses]
        )
        away = antennas[:, None, :2] - landmarks
        aspects = np.arctan2(away[..., 1], away[..., 0])
        ranges[radar] += math.sqrt(2.0) * by_aspect_m * np.sin(6.0 * aspects + phases)
    parameters = parameters_for(LAB, math.hypot(white_m, by_aspect_m))
    parameters = replace(parameters, ranges=replace(parameters.ranges, variance_share=configured))
    back_end = RobustBackEnd(paper_rig(), parameters)
    scans = [
        [
            RangeScan(radar=radar, ranges_m=tuple(ranges[radar, k, seen[radar, k]]))
            for radar in range(4)
        ]
        for k in range(1, len(poses))
    ]
    list(follow(back_end, increments, scans))
    back_end.relinearise()
    return back_end.state.range_errors.variance_share


@pytest.mark.rare
def test_errors_that_come_again_on_a_second_lap_weigh_twice_as_much() -> None:
    """Two laps say of a body what one says; white ranges have the variance that they state."""
    assert 0.6 < learned_share(1, 4e-3, 0.0) < 1.4
    once, twice = (learned_share(laps, 1e-3, 4e-3) for laps in (1, 2))
    assert 1.6 < twice / once < 2.4


@pytest.mark.rare
def test_what_the_solution_took_up_of_the_errors_makes_no_range_weigh_more() -> None:
    """White ranges show a share of about 1; what is configured is the least."""
    assert 0.6 < learned_share(1, 4e-3, 0.0, configured=0.5) < 1.4
    assert learned_share(1, 4e-3, 0.0, configured=2.5) == 2.5


def test_a_landmark_is_lost_after_misses_of_one_and_a_half_hits_or_less() -> None:
    rule = MapRule()
    existence = Existence(rule, 9, 0.85)
    assert (rule.least, rule.miss) == (-8.0, 1.5)
    existence.hit(1)
    for _ in range(6):
        existence.miss(1)
    assert existence.lost() == []
    existence.miss(1, 0.25)
    assert existence.lost() == [1]


def test_a_miss_says_the_less_the_oftener_a_landmark_was_missed() -> None:
    """The mean of a beta distribution: a prior of 0.85 with the weight of 20 looks."""
    rule = MapRule()
    existence = Existence(rule, 9, 0.85)
    existence.hit(1)
    assert rule.prior_looks == 20.0
    assert existence.unheard(1) == pytest.approx(math.log(0.15))
    for _ in range(3):
        existence.heard(1)
    # 3 of 20 and 1 more of 1 + 3
    assert existence.unheard(1) == pytest.approx(math.log((3 + 1) / (20 + 4)))
    for _ in range(1000):
        existence.unheard(1)
    assert existence.unheard(1) == pytest.approx(0.0, abs=0.03)

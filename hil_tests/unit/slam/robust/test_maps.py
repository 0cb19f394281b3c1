"""A run on the map of another: what it knows at first, where it finds itself, what it reports."""

import gc
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hil_tests.unit.slam.robust.range_world import (
    LAB,
    Array,
    follow,
    parameters_for,
    polar,
    reported,
    scans_of,
)
from slam.config import load_preset
from slam.geometry import between, compose, paper_rig, transform
from slam.library.evaluation import nees_pose
from slam.library.joining import find_place, join
from slam.results import SavedMap, StartOnMap
from slam.robust.association import RangeScan
from slam.robust.back_end import RobustBackEnd
from slam.robust.branches import Branches, Step
from slam.robust.parameters import BranchRule
from slam.robust.pipeline import RobustSlam

SIGMA_M = 4e-3
PARAMETERS = parameters_for(LAB, SIGMA_M)
PLACES = np.array(
    [
        [0.1, 0.9],
        [0.55, 0.7],
        [0.95, 1.1],
        [1.5, 0.8],
        [0.3, -0.8],
        [0.8, -1.0],
        [1.25, -0.7],
        [1.9, -0.9],
    ]
)
RULE = BranchRule()


def course(first: float, last: float) -> Array:
    """Return poses along x, a centimetre apart."""
    x = np.arange(first, last, math.copysign(0.01, last - first))
    return np.column_stack([x, np.zeros((len(x), 2))])


def there_and_back() -> Array:
    way = course(0.0, 1.6)
    return np.vstack([way, way[::-1]])


def driven(
    poses: Array,
    places: Array,
    seed: int,
    saved: SavedMap | None = None,
    start: tuple[float, float, float] | None = None,
) -> tuple[Branches, list[bool], Array]:
    """Return the back end, whether it was lost, and its error, after each step; map frame."""
    rng = np.random.default_rng(seed)
    on_map = None if saved is None else StartOnMap(map=saved, pose=start)
    branches = Branches(paper_rig(), PARAMETERS, on_map)
    lost, errors = list[bool](), []
    scans = scans_of(poses, places, rng, SIGMA_M)
    for report, pose in zip(
        follow(branches, reported(poses, LAB, rng, 0.0), scans), poses[1:], strict=True
    ):
        lost.append(report.lost)
        errors.append(math.hypot(*(branches.main.pose - pose)[:2]))
    return branches, lost, np.array(errors)


@cache
def day_one() -> SavedMap:
    branches, _, _ = driven(there_and_back(), PLACES, 0)
    return branches.main.saved_map()


def test_a_map_has_the_joint_covariance_of_what_was_solved_for() -> None:
    """Of the landmarks against their truth: chi-square of 2 n degrees, here 16; 99.9 % below 39."""
    saved = day_one()
    away = saved.landmarks_m[:, None] - PLACES
    nearest = np.hypot(*np.moveaxis(away, -1, 0)).argmin(axis=1)
    assert sorted(nearest) == list(range(len(PLACES)))
    error = (saved.landmarks_m - PLACES[nearest]).ravel()
    assert error @ np.linalg.solve(saved.landmarks_covariance(), error) < 39.3
    assert np.abs(error).max() < 0.03


def test_a_back_end_begins_with_the_covariance_of_its_map_and_an_independent_pose() -> None:
    saved, pose = day_one(), np.array([0.4, -0.2, 0.3])
    sigmas = np.array([0.1, 0.2, 0.05])
    back_end = RobustBackEnd(paper_rig(), PARAMETERS, saved, (pose, sigmas))
    state = back_end.state
    np.testing.assert_allclose(back_end.pose_covariance, np.diag(sigmas**2), atol=1e-15)
    T = state.additive_transform()
    P = T @ state.P.full() @ T.T
    of_landmarks = np.arange(P.shape[0])[state.layout.landmarks]
    np.testing.assert_allclose(
        P[np.ix_(of_landmarks, of_landmarks)], saved.landmarks_covariance(), atol=1e-15
    )
    np.testing.assert_allclose(P[:3, of_landmarks], 0.0, atol=1e-15)
    assert back_end.map_now() == replace(
        saved, start=(0.4, -0.2, 0.3), covariance=back_end.map_now().covariance
    )


def test_a_solution_fuses_a_map_with_ranges_by_information() -> None:
    """Ranges from a known pose: the information of both is added, in closed form."""
    saved = day_one()
    pose = np.array([0.7, 0.0, 0.0])
    back_end = RobustBackEnd(paper_rig(), PARAMETERS, saved, (pose, np.full(3, 1e-6)))
    rows, mount = range(len(saved.landmarks)), paper_rig().mounts[0]
    ranges, off = polar(pose[None], mount, saved.landmarks_m)
    row = min(rows, key=lambda row: off[0, row])
    information = np.linalg.inv(saved.landmarks_covariance() + 1e-14 * np.eye(2 * len(rows)))
    away = saved.landmarks_m[row] - pose[:2] - (mount.x_m, mount.y_m)
    direction = away / np.hypot(*away)
    n_scans = 3
    at = slice(2 * row, 2 * row + 2)
    information[at, at] += n_scans * np.outer(direction, direction) / SIGMA_M**2
    for _ in range(n_scans):
        back_end.predict(np.zeros(3), 1e-14 * np.eye(3))
        back_end.update([RangeScan(radar=0, ranges_m=(float(ranges[0, row]),))], solve=False)
    before = back_end.state.range_errors
    assert back_end.relinearise()
    assert back_end.state.range_errors == before  # too few ranges to learn from
    np.testing.assert_allclose(
        back_end.map_now().landmarks_covariance(), np.linalg.inv(information), rtol=1e-3, atol=1e-9
    )


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.rare)])
def test_a_robot_that_is_set_down_by_eye_joins_the_map(seed: int) -> None:
    poses = there_and_back()
    start = (0.07, -0.06, 0.08)
    branches, lost, errors = driven(poses, PLACES, 10 + seed, day_one(), start)
    assert not any(lost)
    assert np.sqrt(np.mean(errors[100:] ** 2)) < 0.01
    assert len(branches.map.map_changes(day_one()).seen) >= 7
    assert nees_pose(branches.main.pose, branches.main.pose_covariance, poses[-1]) < 16.3


@pytest.mark.parametrize("first", [pytest.param(0.0, marks=pytest.mark.rare), 0.5])
def test_a_robot_finds_its_place_and_what_has_changed(first: float) -> None:
    """One landmark stands elsewhere, one is new; until the place is known, it says so."""
    saved, places = day_one(), np.vstack([PLACES, [[0.6, -0.55]]])
    places[2] += (0.3, -0.35)
    poses = np.vstack([course(first, 1.9), course(1.9, -0.1)])
    branches, lost, errors = driven(poses, places, 20, saved)
    found = lost.index(False)
    assert not any(lost[found:])
    seen = np.zeros(len(places), dtype=bool)
    for mount in paper_rig().mounts:
        ranges, off = polar(poses[: found + 2], mount, places)
        seen |= np.any((ranges < 1.5) & (off < math.radians(32.5)), axis=0)
    assert seen.sum() >= 3
    assert errors[found:].max() < 0.03
    assert np.sqrt(np.mean(errors[found:] ** 2)) < 0.01
    changes = branches.map.map_changes(saved)
    (gone,) = [one.id for one in saved.landmarks if math.hypot(one.x_m - 0.95, one.y_m - 1.1) < 0.1]
    assert changes.gone == (gone,)
    assert len(changes.seen) >= 6
    new = [branches.main.state.landmark_ids.index(id_) for id_ in changes.new]
    away = branches.main.state.landmarks_m[new][:, None] - places[[2, 8]]
    assert np.hypot(*np.moveaxis(away, -1, 0)).min(axis=0).max() < 0.05
    # the map of the second day goes on with the ids of the first
    again = branches.main.saved_map()
    assert {one.id for one in saved.landmarks} - {one.id for one in again.landmarks} == {gone}


def test_a_robot_in_another_room_never_says_that_it_knows() -> None:
    rng = np.random.default_rng(5)
    others = np.column_stack([rng.uniform(-0.2, 2.0, 8), np.tile([0.85, -0.75], 4)])
    branches, lost, _ = driven(course(0.0, 1.6), others, 30, day_one())
    assert all(lost)
    assert branches.is_unplaced
    assert branches.map.map_changes(day_one()).seen == ()
    assert branches.lost_pose is not None
    covariance = branches.lost_pose[1]
    assert covariance[0, 0] >= np.ptp(PLACES[:, 0]) ** 2


def n_steps() -> int:
    """Return how many steps are in memory."""
    gc.collect()
    return sum(isinstance(one, Step) for one in gc.get_objects())


def test_a_robot_that_is_lost_for_long_forgets_what_it_did_long_ago() -> None:
    """A search that takes all steps since the beginning once more gets slower with every one."""
    rule = replace(PARAMETERS.branches, carry_steps=30, snapshot_every=10)
    branches = Branches(
        paper_rig(), replace(PARAMETERS, branches=rule), StartOnMap(map=day_one(), pose=None)
    )
    rng, poses = np.random.default_rng(5), there_and_back()
    others = np.column_stack([rng.uniform(-0.2, 2.0, 8), np.tile([0.85, -0.75], 4)])
    scans, n_before = scans_of(poses, others, rng, SIGMA_M), n_steps()
    for _ in follow(branches, reported(poses, LAB, rng, 0.0), scans):
        pass
    assert branches.is_unplaced
    most = rule.carry_steps + (rule.snapshots + 2) * rule.snapshot_every
    assert n_steps() - n_before <= most < len(poses) // 2


def test_two_equal_rooms_on_one_map_are_not_told_apart() -> None:
    """The map holds the room twice, four metres apart: whichever it is, it may be the other."""
    saved = day_one()
    twin = tuple(
        replace(one, id=one.id + saved.next_id, y_m=one.y_m + 4.0) for one in saved.landmarks
    )
    n, names = len(saved.landmarks), [f"{axis} {one.id}" for one in twin for axis in "xy"]
    P = saved.full_covariance()
    at = [saved.unknowns.index(f"{axis} {one.id}") for one in saved.landmarks for axis in "xy"]
    cross = P[:, at]
    both = np.block([[P, cross], [cross.T, P[np.ix_(at, at)] + 1e-6 * np.eye(2 * n)]])
    twice = replace(
        saved,
        landmarks=saved.landmarks + twin,
        unknowns=saved.unknowns + tuple(names),
        covariance=tuple(tuple(both[row, : row + 1].tolist()) for row in range(len(both))),
        next_id=2 * saved.next_id,
    )
    _, lost, _ = driven(course(0.0, 1.6), PLACES, 40, twice)
    assert all(lost)


def test_a_fixed_map_is_reported_as_it_was() -> None:
    saved, rng = day_one(), np.random.default_rng(50)
    slam = RobustSlam(
        load_preset("robust"),
        paper_rig(),
        PARAMETERS.wheels,
        on_map=StartOnMap(map=saved, pose=(0.0, 0.0, 0.0), is_fixed=True),
    )
    back_end, poses = slam.back_end, there_and_back()
    places = np.vstack([PLACES, [[0.6, -0.55]]])
    for _ in follow(
        back_end, reported(poses, LAB, rng, 0.0), scans_of(poses, places, rng, SIGMA_M)
    ):
        pass
    assert len(back_end.reported_rows()) > len(saved.landmarks)
    belief = slam.belief()
    assert belief.landmark_ids == tuple(one.id for one in saved.landmarks)
    np.testing.assert_array_equal(belief.landmarks, saved.landmarks_m)
    np.testing.assert_allclose(belief.covariance[3:, 3:], saved.landmarks_covariance(), atol=1e-15)
    np.testing.assert_array_equal(belief.pose, back_end.pose)
    assert slam.saved_map() == saved


def test_two_maps_of_one_room_join_by_information() -> None:
    """Frames differ by a known motion; the joint map is nearer to the truth than its parts."""
    saved, place = day_one(), np.array([0.5, 0.2, 0.4])
    moved = transform(between(place, np.zeros(3)), np.vstack([PLACES[1:], [[2.0, 0.8]]]))
    poses = np.array([compose(between(place, np.zeros(3)), pose) for pose in there_and_back()])
    first = poses[0]
    poses = np.array([between(first, pose) for pose in poses])
    branches, _, _ = driven(poses, transform(between(first, np.zeros(3)), moved), 60)
    other = branches.main.saved_map()
    found = find_place(saved, other, RULE)
    true = compose(place, first)
    np.testing.assert_allclose(found.motion[:2], true[:2], atol=0.03)
    assert abs(math.remainder(found.motion[2] - true[2], math.tau)) < 0.03
    assert len(found.pairs) >= 6
    both = join(saved, other, found)
    truth = np.vstack([PLACES, [[2.0, 0.8]]])
    away = both.landmarks_m[:, None] - truth
    nearest = np.hypot(*np.moveaxis(away, -1, 0)).argmin(axis=1)
    assert len(set(nearest)) == len(both.landmarks) >= len(saved.landmarks)
    error = (both.landmarks_m - truth[nearest]).ravel()
    P = both.landmarks_covariance()
    assert error @ np.linalg.solve(P, error) < 43.0  # 99.9 % of chi-square of 18 degrees
    shared = [one.id for one in saved.landmarks if one.id in {own for own, _ in found.pairs}]
    rows = {one.id: row for row, one in enumerate(saved.landmarks)}
    mine = {one.id: row for row, one in enumerate(both.landmarks)}
    before, after = saved.landmarks_covariance().diagonal(), P.diagonal()
    for id_ in shared:
        assert np.all(after[2 * mine[id_] :][:2] <= before[2 * rows[id_] :][:2])


def test_maps_that_lie_on_each_other_in_no_way_or_in_two_are_refused() -> None:
    saved = day_one()
    few = replace(saved, landmarks=saved.landmarks[:2])
    with pytest.raises(ValueError, match="3"):
        find_place(saved, few, RULE)
    turned = tuple(replace(one, x_m=one.x_m + 10.0, y_m=-one.y_m * 1.7) for one in saved.landmarks)
    with pytest.raises(ValueError, match="3"):
        find_place(saved, replace(saved, landmarks=turned), RULE)

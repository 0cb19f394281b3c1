"""Walls, corners and round objects in the robust filter: derivatives, birth, ends."""

import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from hil_tests.property.robust_oracles import rows_of
from hil_tests.unit.slam.robust.range_world import (
    LAB,
    follow,
    odometry_path,
    reported,
    true_path,
)
from slam.config import WheelNoise
from slam.geometry import between, compose, paper_rig, transform
from slam.library.evaluation import nees_pose
from slam.robust.association import Antennas, RangeScan, antennas_of, view
from slam.robust.back_end import RobustBackEnd
from slam.robust.initialisation import (
    PointDetection,
    detections_of,
)
from slam.robust.parameters import BackEndParameters, RangeNoise, WallRule
from slam.robust.state import Array, State, SymmetricMatrix, calibrated_motion, predict
from slam.robust.walls import (
    BodyWall,
    TentativeWalls,
    WallCells,
    WallKeeper,
    body_wall,
    initialise_wall,
    is_unresolved,
    match_wall,
    update_with_wall,
)

OFFSETS = (0.01, 0.01, 0.01, 0.01)
SIGMA_M = 2e-3


def state_with_map(seed: int = 0) -> State:
    """Return a state with two landmarks and two walls, everything correlated."""
    rng = np.random.default_rng(seed)
    state = State((0.01, 0.01, 0.005), OFFSETS)
    state.heading_rad, state.position_m = 0.7, np.array([0.4, -0.3])
    state.calibration = np.array([0.01, -0.02, 0.004])
    state.landmarks_m = np.array([[1.0, 0.5], [-0.4, 0.6]])
    state.walls = np.array([[1.9, 1.1], [-2.6, 1.4]])
    state.landmark_ids, state.wall_ids, state.next_id = [0, 2], [1, 3], 4
    root = 1e-2 * rng.standard_normal((6 + 4 + 8, 30))
    state.P = SymmetricMatrix(root @ root.T)
    return state


def antennas() -> Antennas:
    scans = [RangeScan(radar=r, ranges_m=()) for r in range(4)]
    return antennas_of(paper_rig(), scans, np.zeros(3))


def test_range_rows_of_walls_are_derivatives_of_the_range() -> None:
    state = state_with_map()
    radars, features = np.repeat(np.arange(4), 4), np.tile(np.arange(4), 4)
    rows = rows_of(state, view(state, antennas()), radars, features)
    H = np.zeros((16, state.P.size))
    H[:, rows.at] = rows.H
    for column in range(state.P.size):
        step = np.zeros(state.P.size)
        step[column] = 1e-6
        ahead, behind = deepcopy(state), deepcopy(state)
        ahead.correct(step)
        behind.correct(-step)
        difference = (
            view(ahead, antennas()).ranges_m - view(behind, antennas()).ranges_m
        ).T.reshape(4, 4)
        expected = difference.T.ravel() / 2e-6
        assert H[:, column] == pytest.approx(expected, abs=1e-8)


def test_turning_robot_and_map_together_changes_no_range() -> None:
    state = state_with_map()
    before = view(state, antennas()).ranges_m
    step = np.zeros(state.P.size)
    step[0] = 0.9
    state.correct(step)
    assert view(state, antennas()).ranges_m == pytest.approx(before, abs=1e-12)


def test_prediction_carries_errors_of_walls_as_two_motions_do() -> None:
    """With P = e e^T and wheels without noise, P afterwards is that of the moved difference."""
    wheels = WheelNoise(
        along_m_per_sqrt_m=0, across_m_per_sqrt_m=0, heading_rad_per_sqrt_m=0,
        heading_rad_per_rad=0, floor_m=0, floor_rad=0,
    )  # fmt: skip
    state = state_with_map()
    error = 1e-6 * np.random.default_rng(1).standard_normal(state.P.size)
    state.P = SymmetricMatrix(np.outer(error, error))
    truth = deepcopy(state)
    truth.correct(error)
    for increment in np.array([[0.1, 0.02, 0.3], [0.2, -0.01, -0.5], [0.0, 0.0, 0.4]]):
        for each in (state, truth):
            predict(each, calibrated_motion(increment, each.calibration, wheels), wheels)
    e_th = truth.heading_rad - state.heading_rad
    walls = np.column_stack(
        [truth.walls[:, 0] - state.walls[:, 0] - e_th, truth.walls[:, 1] - state.walls[:, 1]]
    ).ravel()
    first = state.P.size - 4
    heading = state.P.columns(np.array([0]))[first:, 0]
    assert heading == pytest.approx(walls * e_th, rel=1e-4, abs=1e-18)
    assert state.P.block(np.arange(first, first + 4)) == pytest.approx(
        np.outer(walls, walls), rel=1e-4, abs=1e-18
    )


def seen_wall() -> BodyWall:
    return BodyWall(
        wall=np.array([1.2, 1.5]),
        covariance=np.array([[4e-4, 1e-5], [1e-5, 9e-6]]),
        by_offsets=np.random.default_rng(2).standard_normal((2, 4)),
        feet_m=np.array([[0.5, 1.4], [0.6, 1.35]]),
    )


def test_birth_of_a_wall_is_the_limit_of_an_unknown_wall_seen() -> None:
    born, seen = state_with_map(), seen_wall()
    born.remove(3)
    other = deepcopy(born)
    wall_id = initialise_wall(born, seen)
    assert born.feature_ids[-1] == wall_id
    other.augment_wall(born.walls[-1], np.zeros((other.P.size, 2)), 1e6 * np.eye(2))
    update_with_wall(other, 1, seen)
    assert other.walls == pytest.approx(born.walls, abs=1e-9)
    assert other.P.full() == pytest.approx(born.P.full(), rel=1e-5, abs=1e-9)


def test_a_landmark_born_later_goes_before_the_walls() -> None:
    state = state_with_map()
    P, cross = state.P.full(), np.random.default_rng(3).standard_normal((18, 2)) * 1e-3
    new = state.augment(np.array([9.0, 9.0]), cross, np.eye(2))
    assert state.feature_ids == [0, 2, new, 1, 3]
    old = np.r_[0:14, 16:20]
    full = state.P.full()
    assert full[np.ix_(old, old)] == pytest.approx(P)
    assert full[np.ix_(old, [14, 15])] == pytest.approx(cross)
    state.remove(2)
    assert state.P.full() == pytest.approx(P)
    state.remove(3)
    assert state.wall_ids == [1]
    assert state.P.size == 16


def test_walls_match_only_where_they_were_seen() -> None:
    state, seen, cells, rule = state_with_map(), seen_wall(), WallCells(0.1), WallRule()
    wall_id = initialise_wall(state, seen)
    row = state.wall_ids.index(wall_id)
    along = seen.in_map(state) @ np.array([-math.sin(1.9), math.cos(1.9)])
    cells.add(wall_id, along)
    assert match_wall(state, seen, cells, BackEndParameters()) == row
    elsewhere = WallCells(0.1)
    elsewhere.add(wall_id, along + 5.0)
    assert match_wall(state, seen, elsewhere, BackEndParameters()) is None
    beside = replace(seen, wall=np.add(seen.wall, [0.02, 0.03]), feet_m=1.02 * seen.feet_m)
    sure = replace(beside, covariance=1e-8 * np.eye(2))
    assert is_unresolved(state, sure, cells, rule)
    assert not is_unresolved(state, sure, elsewhere, rule)
    other = replace(seen, wall=np.add(seen.wall, [0.02, 0.3]), feet_m=1.3 * seen.feet_m)
    assert not is_unresolved(state, other, cells, rule)


@pytest.mark.parametrize(
    ("others_m", "sigmas", "row"),
    [
        # 1 / (2 pi 1.5) is one wall in all directions and up to 1.5 m; 1.5 / e^3 = 0.07468
        ((), (0.0746, 1.0), 0),
        ((), (0.0748, 1.0), None),
        ((1.244,), (0.01, 0.1), None),
        ((1.246,), (0.01, 0.1), 0),  # (0.245 m / 0.1 m)^2 is the likelihood margin, 6
    ],
)
def test_a_wall_that_is_likelier_new_or_another_is_no_match(
    others_m: tuple[float, ...], sigmas: tuple[float, float], row: int | None
) -> None:
    """The state is sure of everything; the wall is seen where the first one of the map is."""
    state, cells = State((0.0,) * 3, (0.0,) * 4), WallCells(0.1)
    state.walls = np.array([[math.pi / 2, d_m] for d_m in (1.0, *others_m)])
    state.wall_ids = list(range(len(state.walls)))
    state.P = SymmetricMatrix(1e-18 * np.eye(10 + 2 * len(state.walls)))
    for wall_id in state.wall_ids:
        cells.add(wall_id, np.zeros(1))
    seen = BodyWall(
        wall=state.walls[0],
        covariance=np.diag(np.square(sigmas)),
        by_offsets=np.zeros((2, 4)),
        feet_m=np.array([[0.0, 1.0]]),
    )
    assert match_wall(state, seen, cells, BackEndParameters()) == row


def test_cells_tell_where_a_wall_answered() -> None:
    cells = WallCells(0.1)
    cells.add(7, np.array([-0.05, 0.05, 0.15, 0.95]))
    assert cells.surrounds(7, 0.02)
    assert not cells.surrounds(7, 0.12)
    assert cells.distance_m(7, 0.52) == pytest.approx(0.4)
    assert cells.distance_m(8, 0.0) == math.inf
    assert np.array(cells.spans_m(7)) == pytest.approx(np.array([[-0.1, 0.2], [0.9, 1.0]]))
    cells.forget(7)
    assert cells.spans_m(7) == []


def faces_from(pose: Array, wall: tuple[float, float], radar: int = 0) -> RangeScan:
    """Return the scan of a patch of a radar that shows a wall (phi, d) of the map from a pose.

    Its echo came from 5 cm to either side of the perpendicular.
    """
    mount, (phi, d) = paper_rig().mounts[radar], wall
    x, y = transform(pose, np.array([mount.x_m, mount.y_m])).tolist()
    off = math.remainder(phi - pose[2] - mount.yaw_rad, math.tau)
    return RangeScan(
        radar=radar,
        is_patch=True,
        ranges_m=(d - math.cos(phi) * x - math.sin(phi) * y,),
        sigmas_m=(2e-3,),
        bearings_rad=(off,),
        bearing_sigmas_rad=(8e-3,),
        faces_m=((-0.05, 0.05),),
    )


def faces_of(state: State, scans: Sequence[RangeScan]) -> list[tuple[PointDetection, BodyWall]]:
    """Return the faces of scans of patches, and where they lie in the newest body frame."""
    noise, found = RangeNoise(), []
    for scan in scans:
        at = antennas_of(paper_rig(), [scan], np.zeros(3))
        (seen,) = detections_of(scan, [0], 0, at, noise)
        assert scan.faces_m is not None
        found.append((seen, body_wall(state, at, (seen, scan.faces_m[0]), WallRule())))
    return found


def test_a_face_lies_where_the_wall_is_from_the_newest_pose() -> None:
    """Its patch was 0.12 m and 0.1 rad ago; the wall leans, and its offset is known."""
    state, wall = State((0.0,) * 3, OFFSETS), (1.4, 1.3)
    state.offsets_m = np.array([0.02, 0.0, 0.0, 0.0])
    patch, pose = np.array([0.3, -0.1, 0.2]), np.array([0.42, -0.09, 0.3])
    scan = faces_from(patch, wall)
    dx, dy, turn = between(pose, patch).tolist()
    scan = replace(scan, ranges_m=(scan.ranges_m[0] + 0.02,), moved=(dx, dy, turn))
    ((_, seen),) = faces_of(state, [scan])
    n = np.array([math.cos(wall[0]), math.sin(wall[0])])
    assert seen.wall == pytest.approx((wall[0] - pose[2], wall[1] - n @ pose[:2]))
    feet = np.array([transform(pose, foot) for foot in seen.feet_m])
    assert feet @ n == pytest.approx(np.full(len(feet), wall[1]))
    assert math.dist(feet[0], feet[-1]) == pytest.approx(0.1)


def test_noise_of_a_face_is_that_of_its_range_and_bearing() -> None:
    state, scan = State((0.0,) * 3, OFFSETS, 0.004), faces_from(np.zeros(3), (1.4, 1.3))
    ((_, seen),) = faces_of(state, [scan])

    def measured(range_m: float, bearing_rad: float) -> Array:
        one = replace(scan, ranges_m=(range_m,), bearings_rad=(bearing_rad,))
        return faces_of(state, [one])[0][1].wall

    assert scan.bearings_rad is not None
    (r,), (b,), h = scan.ranges_m, scan.bearings_rad, 1e-6
    by_range = (measured(r + h, b) - measured(r - h, b)) / (2 * h)
    by_bearing = (measured(r, b + h) - measured(r, b - h)) / (2 * h)
    # 2 mm of the range and 3 mm of roughness
    wanted = 13e-6 * np.outer(by_range, by_range) + 64e-6 * np.outer(by_bearing, by_bearing)
    assert seen.covariance == pytest.approx(wanted, rel=1e-6, abs=1e-15)
    # A range that is longer by the offset is that of a wall which is nearer by it; a mount that
    # is farther along the normal sees one that is farther.
    phi = float(seen.wall[0])
    assert seen.by_offsets[:, 0] == pytest.approx((0.0, -1.0))
    assert seen.by_offsets[:, 4:6] == pytest.approx(
        np.array([[0.0, 0.0], [math.cos(phi), math.sin(phi)]])
    )


TURNING = np.array([0.12, 0.01, 0.15])


def shown_along(poses: Sequence[Array], walls: Sequence[tuple[float, float]]) -> list[int]:
    """Return how many patches made each wall, when one from each pose shows a wall."""
    state, tentative, before = State((0.0,) * 3, OFFSETS), TentativeWalls(BackEndParameters()), None
    counts = []
    for pose, wall in zip(poses, walls, strict=True):
        if before is not None:
            tentative.move(calibrated_motion(between(before, pose), np.zeros(3), WheelNoise()))
        found = tentative.take(faces_of(state, [faces_from(pose, wall)]))
        counts += [len(one.seen) for one in found]
        before = pose
    return counts


def test_two_patches_that_agree_make_a_wall() -> None:
    poses = [np.zeros(3)]
    for _ in range(6):
        poses.append(compose(poses[-1], TURNING))
    assert shown_along(poses, [(1.4, 1.5)] * 7) == [2, 2, 2]


def test_the_tangents_of_a_cylinder_make_none() -> None:
    """It has a radius of 0.4 m, and is passed at 0.5 m: its normal turns by 0.13 rad a patch."""
    poses = [np.array([0.12 * k - 0.36, 0.0, 0.0]) for k in range(7)]
    mount, tangents = paper_rig().mounts[0], []
    for pose in poses:
        away = np.array([0.0, 1.1]) - pose[:2] - (mount.x_m, mount.y_m)
        phi = math.atan2(away[1], away[0])
        tangents.append((phi, 1.1 * math.sin(phi) - 0.4))
    assert shown_along(poses, tangents) == []


def test_a_wall_that_patches_no_longer_show_is_forgotten() -> None:
    state, parameters = State((0.0,) * 3, OFFSETS), BackEndParameters()
    one = faces_of(state, [faces_from(np.zeros(3), (1.4, 1.5))])
    counts = []
    for n_others in (0, parameters.initialisation.window, parameters.initialisation.window + 1):
        tentative = TentativeWalls(parameters)
        for faces in (one, *[[]] * n_others):
            assert tentative.take(faces) == []
        counts.append(len(tentative.take(one)))
    assert counts == [1, 1, 0]


def test_a_face_of_a_known_wall_tells_the_heading() -> None:
    """The robot is sure of all but its heading, which is 0.1 rad off."""
    state = State((0.0,) * 3, (0.0,) * 4)
    state.walls, state.wall_ids = np.array([[math.pi / 2, 1.3]]), [0]
    state.P = SymmetricMatrix(1e-12 * np.eye(12))
    state.set_pose(np.zeros(3), np.diag([1e-12, 1e-12, 0.1**2]))
    keeper = WallKeeper(state, BackEndParameters())
    keeper.cells.add(0, np.array([0.0]))
    scan = faces_from(np.array([0.0, 0.0, 0.1]), (math.pi / 2, 1.3))
    at = antennas_of(paper_rig(), [scan], np.zeros(3))
    (seen,) = detections_of(scan, [0], 0, at, RangeNoise())
    # What is of the same wall a second time is not used.
    assert keeper.take([(seen, (-0.15, 0.16)), (seen, (0.0, 0.0))], at) == [(0, [seen])]
    assert len(keeper.spans_m(0)) == 1
    assert state.heading_rad == pytest.approx(0.1, abs=2e-3)
    # Of the bearing, of what the range says where the antenna is beside the body's origin, and of
    # what was known before
    mount = paper_rig().mounts[0]
    lever_m = -mount.x_m * math.cos(0.1) + mount.y_m * math.sin(0.1)
    information = 1 / 8e-3**2 + lever_m**2 / 13e-6 + 1 / 0.1**2
    assert state.pose_covariance()[2, 2] == pytest.approx(1 / information, rel=1e-3)


def test_a_robot_that_patches_show_a_wall_keeps_its_heading() -> None:
    """The robot turns by 2 mrad a step that its wheels do not report, 80 mrad in all."""
    back_end, pose = RobustBackEnd(paper_rig(), BackEndParameters()), np.zeros(3)
    counts = []
    for number in range(40):
        pose = compose(pose, np.array([0.05, 0.0, 2e-3]))
        back_end.predict(np.array([0.05, 0.0, 0.0]))
        scans = [RangeScan(radar=0, ranges_m=(), is_imaged=True)]
        if number % 2:
            scans.append(faces_from(pose, (1.4, 1.5)))
        back_end.update(scans)
        counts.append(len(back_end.state.wall_ids))
    assert counts[:3] == [0] * 3
    assert counts[3:] == [1] * 37
    assert abs(back_end.pose[2] - pose[2]) < 0.03
    assert back_end.state.walls[0] == pytest.approx((1.4, 1.5), abs=0.03)
    assert back_end.relinearise()
    assert abs(back_end.pose[2] - pose[2]) < 0.03


PATCH_EVERY = 8  # frames
IN_BARE_ROOM = BackEndParameters(
    ranges=RangeNoise(sigma_m=SIGMA_M, detection_probability=0.98, clutter_per_m=0.02)
)


def bare_room(path: Array, rng: np.random.Generator, *, is_imaged: bool) -> list[list[RangeScan]]:
    """Return what four radars hear of four walls 1 m beyond the path's square, and nothing else."""
    walls = np.array([[0.0, 3.0], [math.pi / 2, 3.0], [math.pi, 1.0], [-math.pi / 2, 1.0]])
    n = np.column_stack([np.cos(walls[:, 0]), np.sin(walls[:, 0])])
    frames = []
    for number, (x, y, heading) in enumerate(path[1:]):
        c, s = math.cos(heading), math.sin(heading)
        scans, patches = list[RangeScan](), list[RangeScan]()
        for radar, mount in enumerate(paper_rig().mounts):
            q = np.array([x + c * mount.x_m - s * mount.y_m, y + s * mount.x_m + c * mount.y_m])
            ranges = walls[:, 1] - n @ q
            off = np.abs((walls[:, 0] - heading - mount.yaw_rad + math.pi) % math.tau - math.pi)
            is_heard = (off < math.radians(32.5)) & (ranges < 1.5) & (ranges > 0.2)
            noisy = ranges[is_heard] + SIGMA_M * rng.standard_normal(np.count_nonzero(is_heard))
            ranges_m = tuple(noisy.tolist())
            scans.append(RangeScan(radar=radar, ranges_m=ranges_m, is_imaged=is_imaged))
            if is_imaged and number % PATCH_EVERY == 0:
                pose = np.array([x, y, heading])
                patches += [
                    faces_from(pose, (phi, d), radar) for phi, d in walls[is_heard].tolist()
                ]
        frames.append([*scans, *patches])
    return frames


def test_ranges_of_bare_walls_become_no_points() -> None:
    rng = np.random.default_rng(5)
    path = true_path(LAB)[:1064:3]
    increments = reported(path, LAB, rng, walk=0.0)
    back_end = RobustBackEnd(paper_rig(), IN_BARE_ROOM)
    list(follow(back_end, increments, bare_room(path, rng, is_imaged=False)))
    assert back_end.state.feature_ids == []
    wheels = odometry_path(increments)[-1]
    assert between(wheels, back_end.pose) == pytest.approx(np.zeros(3), abs=1e-9)


def test_four_bare_walls_hold_the_robot() -> None:
    rng = np.random.default_rng(5)
    path = true_path(LAB)[:1064:3]  # a lap and the first wall again
    increments = reported(path, LAB, rng, walk=0.0)
    back_end = RobustBackEnd(paper_rig(), IN_BARE_ROOM)
    list(follow(back_end, increments, bare_room(path, rng, is_imaged=True)))
    assert back_end.reported_rows() == []
    rough = dict.fromkeys(back_end.state.wall_ids, WallRule().roughness_m)
    assert back_end.state.added_sigmas_m == rough
    true_d_m = {0: 3.0, 1: 3.0, 2: 1.0, 3: 1.0}
    state = back_end.state
    T = state.additive_transform()
    P = T @ state.P.full() @ T.T
    for row, (phi_rad, d_m) in enumerate(state.walls.tolist()):
        quarter = round(phi_rad / (math.pi / 2))
        away = np.array([phi_rad - quarter * math.pi / 2, d_m - true_d_m[quarter % 4]])
        at = state.landmark_columns(np.array([row]))
        assert away @ np.linalg.solve(P[np.ix_(at, at)], away) < 18.4  # 99.99 %, 2 dof
        del true_d_m[quarter % 4]
    assert not true_d_m
    blind_m = odometry_path(increments)[-1, :2] - path[-1, :2]
    # The first wall, seen again, holds the way across it; along it, only wheels count by then.
    assert abs(back_end.pose[1] - path[-1, 1]) < 0.1 * abs(blind_m[1])
    assert nees_pose(back_end.pose, back_end.pose_covariance, path[-1]) < 16.3  # 99.9 %, 3 dof
    before = back_end.pose
    assert back_end.relinearise()
    assert back_end.pose == pytest.approx(before, abs=0.01)
    assert nees_pose(back_end.pose, back_end.pose_covariance, path[-1]) < 16.3


STEP_M = 0.01
WALL_Y_M, WALL_END_M = 1.1, 0.8


def past_the_end_of_a_wall(n: int, rng: np.random.Generator) -> list[list[RangeScan]]:
    """Return what the radars hear along y = 0: a wall on the left, then its edge.

    Patches show the wall.
    """
    frames = []
    for k in range(1, n + 1):
        scans = []
        for radar, mount in enumerate(paper_rig().mounts):
            x, y = k * STEP_M + mount.x_m, mount.y_m
            beyond = max(x - WALL_END_M, 0.0)
            range_m = math.hypot(beyond, WALL_Y_M - y)
            left = mount.yaw_rad > 0.0
            heard = left and math.atan2(beyond, WALL_Y_M - y) < math.radians(32.5)
            noisy = (range_m + SIGMA_M * float(rng.standard_normal()),) if heard else ()
            scans.append(RangeScan(radar=radar, ranges_m=noisy, is_imaged=True))
        if k % PATCH_EVERY == 0 and k * STEP_M + paper_rig().mounts[0].x_m < WALL_END_M:
            scans.append(faces_from(np.array([k * STEP_M, 0.0, 0.0]), (math.pi / 2, WALL_Y_M)))
        frames.append(scans)
    return frames


@pytest.mark.parametrize("seed", range(3))
def test_the_edge_of_a_wall_turns_neither_wall_nor_robot(seed: int) -> None:
    back_end = RobustBackEnd(paper_rig(), IN_BARE_ROOM)
    n = 140
    for k, scans in enumerate(past_the_end_of_a_wall(n, np.random.default_rng(seed)), start=1):
        back_end.predict(np.array([STEP_M, 0.0, 0.0]))
        back_end.update(scans)
        truth = np.array([k * STEP_M, 0.0, 0.0])
        # Wheels without error are sigma 0 of their model: what is left is the radars' doing.
        assert nees_pose(back_end.pose, back_end.pose_covariance, truth) < 3.0
    ((phi_rad, _),) = back_end.state.walls
    assert phi_rad == pytest.approx(math.pi / 2, abs=0.01)
    assert back_end.wall_spans_m()[:, :, 0].max() < WALL_END_M + 0.2

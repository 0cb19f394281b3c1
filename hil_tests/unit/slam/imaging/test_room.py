"""The room's image: the brightest of its patches, wherever they lie, on a grid that grows."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from slam.front_end.pulse import PulseModel
from slam.geometry import FieldOfView, Mount, compose
from slam.imaging.back_projection import Grid, back_project
from slam.imaging.patches import Patch, aperture_of
from slam.imaging.range_profiles import RangeProfiles
from slam.imaging.room import RoomImage

Array = NDArray[np.float64]

MODEL = PulseModel()
WAVE_NUMBER = math.tau / MODEL.wavelength_m
BIN_M, START_M, N_BINS = 0.0064, 0.1, 300
VIEW = FieldOfView(opening_rad=math.radians(76.0), max_range_m=1.8)
LEFT = Mount(name="left", x_m=0.1, y_m=0.2, yaw_rad=math.pi / 2)
RIGHT = Mount(name="right", x_m=-0.1, y_m=-0.2, yaw_rad=-math.pi / 2)
RODS = np.array([[0.2, 1.1], [1.3, 0.9], [0.9, -1.0]])


def patch_at(poses: Array, mount: Mount = LEFT, rods: Array = RODS) -> Patch:
    """Return what a radar that moves along poses gets of rods, by the definition of a profile."""
    antennas = aperture_of(mount, VIEW, poses).antennas_m
    ranges_m = START_M + BIN_M * np.arange(N_BINS)
    values = np.zeros((len(poses), N_BINS), dtype=np.complex128)
    for rod in rods:
        r = np.linalg.norm(rod - antennas, axis=1)[:, None]
        envelope = np.exp(-0.5 * ((ranges_m - r) / MODEL.sigma_m) ** 2)
        values += 0.01 * r**-1.5 * envelope * np.exp(-1j * WAVE_NUMBER * r)
    profiles = RangeProfiles(
        values=values.astype(np.complex64),
        range_start_m=START_M,
        bin_length_m=BIN_M,
        wave_number_rad_per_m=WAVE_NUMBER,
    )
    patch = Patch(
        radar=0,
        mount=mount,
        view=VIEW,
        t_ns=np.arange(len(poses), dtype=np.int64),
        poses=poses,
        middle=len(poses) // 2,
        origin=np.zeros(3),
        profiles=profiles,
    )
    return patch.with_poses(poses)


def leg(start: Array, length_m: float = 0.25, step_m: float = 0.01) -> Array:
    steps = np.arange(0.0, length_m + step_m / 2, step_m)
    return np.array([compose(start, np.array([step, 0.0, 0.0])) for step in steps])


def room_of(legs: list[tuple[Mount, Array]], rods: Array = RODS, **options: object) -> RoomImage:
    room = RoomImage(**options)  # type: ignore[arg-type]  # tests give what it takes
    for mount, poses in legs:
        patch = patch_at(poses, mount, rods)
        room.add(patch, patch.origin)
    return room


def brightest_m(room: RoomImage, near: Array, within_m: float = 0.2) -> Array:
    centres = room.grid.centres_m
    is_near = np.linalg.norm(centres - near, axis=-1) < within_m
    place = np.argmax(np.where(is_near, np.nan_to_num(room.values), -1.0))
    return np.asarray(centres.reshape(-1, 2)[place])


LEGS = [
    (mount, leg(np.array([x, 0.0, 0.1]))) for x in (0.0, 0.3, 0.6, 0.9) for mount in (LEFT, RIGHT)
]


def test_cells_have_the_largest_value_of_all_patches_that_saw_them_in_most_of_their_frames() -> (
    None
):
    room = room_of(LEGS, cell_m=0.02)
    points = room.grid.centres_m[::7, ::5]
    values = []
    for mount, poses in LEGS:
        patch = patch_at(poses, mount)
        sums = back_project(
            patch.profiles.times_range(1.5), aperture_of(mount, VIEW, poses), points
        )
        values.append(np.where(2 * sums.count > len(poses), sums.weighted, -np.inf))
    expected = np.max(values, axis=0)
    found = room.values[::7, ::5]
    np.testing.assert_array_equal(np.isnan(found), expected == -np.inf)
    seen = ~np.isnan(found)
    np.testing.assert_allclose(found[seen], expected[seen], rtol=1e-5, atol=1e-9)
    assert np.all(room.coherence[~np.isnan(room.values)] <= 1 + 1e-6)


def test_a_rod_has_the_amplitude_that_it_would_have_at_1_m_where_it_stands() -> None:
    room = room_of(LEGS, cell_m=0.01)
    for rod in RODS:
        place = brightest_m(room, rod)
        assert np.linalg.norm(place - rod) < 0.01
        column, row = np.round((place - [room.grid.x_m, room.grid.y_m]) / 0.01 - 0.5).astype(int)
        assert room.values[row, column] == pytest.approx(0.01, rel=0.1)
        assert room.coherence[row, column] > 0.95


def test_a_rigid_motion_of_path_and_scene_moves_the_image() -> None:
    motion = np.array([0.64, -1.28, math.pi / 2])  # whole cells, a quarter turn
    still = room_of(LEGS, cell_m=0.02)
    turned = [(mount, np.array([compose(motion, p) for p in poses])) for mount, poses in LEGS]
    rods = np.array([compose(motion, np.array([*rod, 0.0]))[:2] for rod in RODS])
    moved = room_of(turned, rods, cell_m=0.02)
    centres = np.argwhere(~np.isnan(still.values))[::97]
    for row, column in centres:
        point = still.grid.centres_m[row, column]
        x, y = compose(motion, np.array([*point, 0.0]))[:2]
        there = (
            round((y - moved.grid.y_m) / 0.02 - 0.5),
            round((x - moved.grid.x_m) / 0.02 - 0.5),
        )
        assert moved.values[there] == pytest.approx(still.values[row, column], rel=1e-3, abs=1e-7)


def test_the_order_of_patches_and_how_the_grid_grows_change_nothing() -> None:
    forwards, backwards = room_of(LEGS), room_of(LEGS[::-1])
    assert forwards.grid == backwards.grid
    np.testing.assert_array_equal(forwards.values, backwards.values)
    whole = Grid.over((-2.0, 3.0), (-2.0, 2.5), 0.02)
    fixed = room_of(LEGS, area=whole)
    assert fixed.grid == whole
    grid = forwards.grid
    row, column = round((whole.y_m - grid.y_m) / 0.02), round((whole.x_m - grid.x_m) / 0.02)
    overlap = forwards.values[max(row, 0) :, max(column, 0) :]
    own = fixed.values[max(-row, 0) :, max(-column, 0) :]
    rows, columns = np.minimum(overlap.shape, own.shape)
    np.testing.assert_allclose(overlap[:rows, :columns], own[:rows, :columns], rtol=1e-4, atol=1e-8)
    assert np.isfinite(own).sum() > 5000


def test_an_area_cuts_the_image_off_and_one_elsewhere_stays_empty() -> None:
    whole, area = room_of(LEGS), Grid(x_m=0.0, y_m=0.64, cell_m=0.02, rows=30, columns=40)
    part = room_of(LEGS, area=area)
    row, column = round((0.64 - whole.grid.y_m) / 0.02), round(-whole.grid.x_m / 0.02)
    inside = whole.values[row : row + 30, column : column + 40]
    np.testing.assert_allclose(part.values, inside, rtol=1e-4, atol=1e-8)
    elsewhere = room_of(LEGS, area=replace(area, x_m=50.0))
    assert np.isnan(elsewhere.values).all()


def test_large_cells_have_the_brightest_of_what_is_in_them() -> None:
    # A rod of 2 to 4 cm falls between the middles of cells of 10 cm.
    room = room_of(LEGS, cell_m=0.1)
    for rod in RODS:
        place = brightest_m(room, rod)
        assert np.all(np.abs(place - rod) <= 0.06)
        assert (
            np.nanmax(
                np.where(np.linalg.norm(room.grid.centres_m - rod, axis=-1) < 0.1, room.values, -1)
            )
            > 0.008
        )


def test_patches_with_grating_lobes_show_only_what_no_other_does() -> None:
    pose = np.array([0.0, 0.0, 0.0])
    fine, coarse = leg(pose), leg(pose, 0.5, 0.05)
    alone = room_of([(LEFT, fine)])
    both = room_of([(LEFT, coarse), (LEFT, fine), (LEFT, coarse)])
    corner = np.array([both.grid.x_m, both.grid.y_m])
    offset = np.round((corner - [alone.grid.x_m, alone.grid.y_m]) / 0.02).astype(int)
    assert np.all(offset <= 0)
    shown = both.values[-offset[1] :, -offset[0] :][: alone.grid.rows, : alone.grid.columns]
    seen = ~np.isnan(alone.values)
    np.testing.assert_array_equal(shown[seen], alone.values[seen])
    assert np.isfinite(both.values).sum() > seen.sum()


def test_an_image_that_is_full_grows_no_further_and_keeps_what_it_has() -> None:
    room = RoomImage(cell_m=0.02, most_cells=100_000)
    near, far = LEGS[0][1], leg(np.array([40.0, 0.0, 0.0]))
    room.add(patch_at(near), near[len(near) // 2])
    before, grid = room.values.copy(), room.grid
    room.add(patch_at(far, rods=RODS + np.array([40.0, 0.0])), far[len(far) // 2])
    assert room.grid == grid
    np.testing.assert_array_equal(room.values, before)

"""What looks like a wall for a while: the edge where it ends, and ranges of unknown offset."""

import math

import numpy as np
import pytest

from slam.evaluation import nees_pose
from slam.geometry import paper_rig
from slam.robust.back_end import RobustBackEnd
from slam.robust.initialisation import Slot, UnassignedRange
from slam.robust.parameters import BackEndParameters, RangeNoise, WallRule
from slam.robust.ranges import RangeScan
from slam.robust.state import Array
from slam.robust.walls import WallTracker, WallTracklet

SIGMA_M = 2e-3
STEP_M = 0.01
WALL_Y_M, WALL_END_M = 1.1, 0.8
OFFSET_M = 0.02


def past_the_end_of_a_wall(n: int, rng: np.random.Generator) -> list[list[RangeScan]]:
    """Return what the radars hear along y = 0: a wall on the left, then its edge."""
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
            scans.append(RangeScan(radar=radar, ranges_m=noisy))
        frames.append(scans)
    return frames


@pytest.mark.parametrize("seed", range(3))
def test_the_edge_of_a_wall_turns_neither_wall_nor_robot(seed: int) -> None:
    noise = RangeNoise(sigma_m=SIGMA_M, detection_probability=0.98, clutter_per_m=0.02)
    back_end = RobustBackEnd(paper_rig(), BackEndParameters(ranges=noise))
    n = 140
    for k, scans in enumerate(past_the_end_of_a_wall(n, np.random.default_rng(seed)), start=1):
        back_end.predict(np.array([STEP_M, 0.0, 0.0]))
        back_end.update(scans)
        truth = np.array([k * STEP_M, 0.0, 0.0])
        # Wheels without error are sigma 0 of their model: what is left is the radars' doing.
        assert nees_pose(back_end.pose, back_end.pose_covariance, truth) < 3.0
    (wall,) = back_end.walls()
    assert wall.phi_rad == pytest.approx(math.pi / 2, abs=0.01)
    assert wall.spans_m[:, :, 0].max() < WALL_END_M + 0.2


def tracklet_of(shape: Array, offset_sigma_m: float) -> tuple[WallTracker, WallTracklet]:
    """Return what a wall tracker makes of ranges that miss a wall by a shape, front and rear."""
    parameters = BackEndParameters(ranges=RangeNoise(sigma_m=SIGMA_M, offset_sigma_m=0.02))
    frames = []
    for back, miss in enumerate(shape.tolist()):
        slots = []
        for radar, mount in enumerate(paper_rig().mounts[:2]):
            range_m = WALL_Y_M - mount.y_m + OFFSET_M + miss
            x = mount.x_m - back * STEP_M
            heard = [UnassignedRange(range_m, None, SIGMA_M)]
            slots.append(
                Slot(back, radar, x, mount.y_m, mount.yaw_rad, 0.0, heard, (mount.x_m, mount.y_m))
            )
        frames.append(slots)
    tracker = WallTracker(parameters, WallRule(), np.zeros(2), offset_sigma_m**2 * np.ones((2, 2)))
    return tracker, tracker.follow(np.array([math.pi / 2, WALL_Y_M + OFFSET_M]), frames)


def test_an_unknown_offset_is_one_number_and_no_noise_of_each_range() -> None:
    """A wall is found under an offset of 20 mm; ranges that scatter by half as much are none."""
    rng = np.random.default_rng(1)
    tracker, wall = tracklet_of(SIGMA_M * rng.standard_normal(40), OFFSET_M)
    assert tracker.is_wall(wall)
    assert wall.wall == pytest.approx([math.pi / 2, WALL_Y_M + OFFSET_M], abs=2e-3)
    # d is right for the offsets of the state, zero; as they are corrected, so is d.
    assert wall.by_offsets[1].sum() == pytest.approx(-1.0, abs=1e-3)
    assert wall.covariance[1, 1] < SIGMA_M**2
    tracker, none = tracklet_of(5 * SIGMA_M * rng.standard_normal(40), OFFSET_M)
    assert len(none.members) > 60
    assert not tracker.is_wall(none)

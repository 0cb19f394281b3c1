"""Radars that sample at different times while the robot moves: fixes from where each one was.

The oracle writes the plane as complex numbers and uses no geometry of the product.
"""

import cmath
import math
from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from slam.config import SampleTime, SlamConfig, TrilaterationConfig, WindowConfig
from slam.frames import Detection
from slam.geometry import Mount, Rig, mount_at, paper_rig
from slam.paper.pipeline import UwbRadarSlam
from slam.paper.trilateration import Trilaterator
from slam.results import StepResult

Array = NDArray[np.float64]

HALF_VIEW_RAD = math.radians(32.5)
STATE_NS = 3_000_000_000
# Of the four radars, as in the project's recipe: they may be up to one period of 200 ms apart.
SKEWS_NS = (0, 190_000_000, 100_000_000, 150_000_000)
STAMPS_NS = tuple(STATE_NS + skew_ns for skew_ns in SKEWS_NS)


def plane(pose: Array) -> tuple[complex, complex]:
    """Return a pose as position and unit vector of its heading."""
    return complex(pose[0], pose[1]), cmath.rect(1.0, pose[2])


def antenna(pose: Array, mount: Mount) -> tuple[complex, complex]:
    at, heading = plane(pose)
    where = at + heading * complex(mount.x_m, mount.y_m)
    return where, heading * cmath.rect(1.0, mount.yaw_rad)


def off_boresight(pose: Array, mount: Mount, target: complex) -> float:
    where, boresight = antenna(pose, mount)
    return abs(cmath.phase((target - where) / boresight))


def in_body(pose: Array, point: complex) -> complex:
    at, heading = plane(pose)
    return (point - at) / heading


def echoes(rig: Rig, poses: Mapping[int, Array], target: complex) -> list[Detection]:
    return [
        Detection(
            radar=radar,
            t_ns=stamp_ns,
            range_m=abs(target - antenna(poses[stamp_ns], mount)[0]),
            amplitude=0.01,
        )
        for radar, (mount, stamp_ns) in enumerate(zip(rig.mounts, STAMPS_NS, strict=True))
    ]


def result_of(
    rig: Rig, sample_time: SampleTime, poses: Mapping[int, Array], seen: list[Detection]
) -> StepResult:
    config = SlamConfig(
        window=WindowConfig(size=1), trilateration=TrilaterationConfig(sample_time=sample_time)
    )
    slam = UwbRadarSlam(config, rig)
    slam.step_detections((), lambda t_ns: np.array([1e3, 0.0, 0.0]), 0)  # far off: it has moved
    (result,) = slam.step_detections(seen, poses.__getitem__, STATE_NS)
    return result


@st.composite
def moments(draw: st.DrawFn, way_m: float = 0.03, turn_rad: float = 0.2) -> dict[int, Array]:
    coordinate = st.floats(-20, 20)
    start = np.array([draw(coordinate), draw(coordinate), draw(st.floats(-3.1, 3.1))])
    poses = {STATE_NS: start}
    for stamp_ns in STAMPS_NS[1:]:
        at, heading = plane(start)
        moved = at + heading * complex(
            draw(st.floats(-way_m, way_m)), draw(st.floats(-way_m, way_m))
        )
        turned = start[2] + draw(st.floats(-turn_rad, turn_rad))
        poses[stamp_ns] = np.array([moved.real, moved.imag, math.remainder(turned, math.tau)])
    return poses


@given(moments(), st.integers(0, 1), st.floats(-0.5, 0.5), st.floats(0.4, 1.4))
def test_fixes_of_skewed_samples_are_the_truth(
    poses: dict[int, Array], side: int, off_rad: float, distance_m: float
) -> None:
    rig = paper_rig()
    mounts = rig.mounts[2 * side : 2 * side + 2]
    start = poses[STATE_NS]
    where, boresight = antenna(start, mounts[0])
    target = where + distance_m * cmath.rect(1.0, off_rad) * boresight
    stamps_ns = STAMPS_NS[2 * side : 2 * side + 2]
    margins = [
        HALF_VIEW_RAD - off_boresight(poses[stamp_ns], mount, target)
        for stamp_ns, mount in zip(stamps_ns, mounts, strict=True)
    ]
    assume(min(abs(margin) for margin in margins) > 1e-7)
    seen = echoes(rig, poses, target)[2 * side : 2 * side + 2]
    result = result_of(rig, SampleTime.OWN, poses, seen)
    # Each radar's own boresight decides what it sees, at its own time.
    assert len(result.fixes) == (min(margins) > 0)
    for fix in result.fixes:
        assert abs(complex(fix.x_m, fix.y_m) - in_body(start, target)) < 1e-9
        assert (fix.pair, fix.t_ns) == (side, STATE_NS)


@given(
    moments(way_m=0.5, turn_rad=1.0), st.integers(0, 1), st.floats(-0.5, 0.5), st.floats(0.4, 1.4)
)
def test_one_radar_may_overtake_the_other(
    poses: dict[int, Array], side: int, off_rad: float, distance_m: float
) -> None:
    """Move by more than the base between two samples: whichever way it points then."""
    rig = paper_rig()
    mounts, stamps_ns = rig.mounts[2 * side : 2 * side + 2], STAMPS_NS[2 * side : 2 * side + 2]
    (first, first_looks), (second, second_looks) = (
        antenna(poses[stamp_ns], mount) for stamp_ns, mount in zip(stamps_ns, mounts, strict=True)
    )
    target = first + distance_m * cmath.rect(1.0, off_rad) * first_looks
    base = second - first
    # A base that can tell: not too short, and not along what either of the two can see.
    assume(abs(base) > 0.05)
    across = [abs(math.sin(cmath.phase(looks / base))) for looks in (first_looks, second_looks)]
    assume(min(across) > math.sin(HALF_VIEW_RAD + 0.05))
    assume((first_looks / base).imag * (second_looks / base).imag > 0)
    assume(
        all(
            off_boresight(poses[stamp_ns], mount, target) < HALF_VIEW_RAD - 1e-7
            for stamp_ns, mount in zip(stamps_ns, mounts, strict=True)
        )
    )
    seen = echoes(rig, poses, target)[2 * side : 2 * side + 2]
    (fix,) = result_of(rig, SampleTime.OWN, poses, seen).fixes
    assert abs(complex(fix.x_m, fix.y_m) - in_body(poses[STATE_NS], target)) < 1e-9


def test_a_radar_at_the_others_place_gives_no_fix() -> None:
    """Drive forward by exactly the base between two samples: there is no triangle."""
    rig = paper_rig()
    front = rig.mounts[1]
    seen = [
        Detection(radar=0, t_ns=1, range_m=0.8, amplitude=0.01),
        Detection(radar=1, t_ns=0, range_m=0.8, amplitude=0.01),
    ]
    forward = np.array([front.x_m - rig.mounts[0].x_m, 0.0, 0.0])
    trilaterator = Trilaterator(TrilaterationConfig(), rig)
    assert trilaterator.locate(seen, 0, {1: forward}) == ()
    assert len(trilaterator.locate(seen, 0)) == 1


def turning_pair() -> tuple[Rig, dict[int, Array]]:
    """Return two radars 0.1 and 0.3 m ahead of the axle, and a turn of 0.5 rad/s for 200 ms."""
    mounts = tuple(
        Mount(name=str(x_m), x_m=x_m, y_m=0.0, yaw_rad=math.pi / 2) for x_m in (0.1, 0.3)
    )
    return Rig(mounts=mounts), {0: np.zeros(3), 200_000_000: np.array([0.0, 0.0, 0.1])}


def test_nominal_time_costs_a_turning_robot_30_mm_and_8_6_degrees() -> None:
    """Paper notes, 2.1 item 17: lever 0.3 m, so 30 mm; over the base of 0.2 m 8.6 degrees."""
    rig, poses = turning_pair()
    middle, target = 0.2 + 0j, 0.2 + 1.0j  # straight ahead of the pair
    seen = [
        Detection(
            radar=radar,
            t_ns=stamp_ns,
            range_m=abs(target - antenna(poses[stamp_ns], mount)[0]),
            amplitude=0.01,
        )
        for radar, (mount, stamp_ns) in enumerate(zip(rig.mounts, poses, strict=True))
    ]
    nominal_range_m = abs(target - antenna(poses[0], rig.mounts[1])[0])
    assert abs(seen[1].range_m - nominal_range_m) == pytest.approx(0.030, abs=0.001)

    def error_deg(sample_time: SampleTime) -> tuple[float, float]:
        config = TrilaterationConfig(sample_time=sample_time)
        slam = UwbRadarSlam(SlamConfig(window=WindowConfig(size=1), trilateration=config), rig)
        slam.step_detections((), lambda t_ns: np.array([1e3, 0.0, 0.0]), 0)
        (result,) = slam.step_detections(seen, poses.__getitem__, 0)
        (fix,) = result.fixes
        found = complex(fix.x_m, fix.y_m)
        bearing = math.degrees(cmath.phase((found - middle) / (target - middle)))
        return abs(bearing), abs(found - target)

    bearing_deg, error_m = error_deg(SampleTime.NOMINAL)
    assert bearing_deg == pytest.approx(8.6, abs=0.3)
    assert error_m == pytest.approx(0.15, abs=0.01)  # 8.6 degrees at 1 m
    bearing_deg, error_m = error_deg(SampleTime.OWN)
    assert bearing_deg < 1e-9
    assert error_m < 1e-12


@given(
    st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-4, 4)),
    st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-3, 3)),
)
def test_a_mount_moves_with_the_robot(
    motion: tuple[float, float, float], place: tuple[float, float, float]
) -> None:
    """Recipe 4.3: m' = d + Rot(a) m, and the yaw turns too; a robot that stands moves nothing."""
    x_m, y_m, yaw_rad = place
    mount = Mount(name="one", x_m=x_m, y_m=y_m, yaw_rad=yaw_rad, range_offset_m=0.02)
    moved = mount_at(mount, np.array(motion))
    where = complex(motion[0], motion[1]) + cmath.rect(1.0, motion[2]) * complex(x_m, y_m)
    assert complex(moved.x_m, moved.y_m) == pytest.approx(where, abs=1e-12)
    assert moved.yaw_rad == pytest.approx(yaw_rad + motion[2], abs=1e-12)
    assert (moved.name, moved.range_offset_m) == ("one", 0.02)
    assert mount_at(mount, np.zeros(3)) == mount

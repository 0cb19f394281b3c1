"""`Slam`: what it refuses moves nothing, what it takes is taken at the right pose and place."""

from __future__ import annotations

import math
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_info, threadpool_limits

import slam as library
from hil_tests.property.examples import examples
from slam import (
    ConfigError,
    Detection,
    Mount,
    RadarFrame,
    Rig,
    Slam,
    SlamState,
    StepInputError,
    WheelNoise,
    load_map,
    load_preset,
    load_rig,
    override,
)
from slam.geometry import between, compose, transform
from slam.results import PoseAt, StepResult
from slam.robust.association import RangeScan
from slam.robust.pipeline import RobustSlam
from slam.robust.solver.one_blas_thread import one_blas_thread

TICK_NS = 200_000_000
RIG = Rig([Mount(x_m=x_m, y_m=0.2, yaw_rad=math.pi / 2) for x_m in (-0.1, 0.1)])
MIDDLE = Rig([Mount(x_m=0.0, y_m=0.0, yaw_rad=0.0)])
ANCHORS = {7: (4.0, 3.0), -2: (-3.0, 2.0), 30: (2.0, -4.0), 11: (-2.0, -3.0)}
ROD = (0.6, 1.0)
FRAME = RadarFrame(
    radar=0,
    t_ns=0,
    counter=1,
    samples=np.zeros(200, dtype=np.float32),
    range_start_m=0.2,
    bin_length_m=0.0064,
)
Pose = NDArray[np.float64]


class Rod:
    """A front end that sees a rod from where the robot is, a straight drive along x."""

    def detect(self, frame: RadarFrame, range_offset_m: float = 0.0) -> tuple[Detection, ...]:
        mount = RIG.mounts[frame.radar]
        x_m = mount.x_m + drive(frame.t_ns)[0]
        range_m = math.hypot(ROD[0] - x_m, ROD[1] - mount.y_m)
        return (Detection(radar=frame.radar, t_ns=frame.t_ns, range_m=range_m, amplitude=0.01),)

    def detect_many(
        self, frames: Sequence[RadarFrame], offsets_m: Sequence[float]
    ) -> list[tuple[Detection, ...]]:
        return [self.detect(frame) for frame in frames]


def drive(t_ns: int) -> Pose:
    return np.array([0.03 * t_ns / TICK_NS, 0.0, 0.0])


def frames(number: int, late_ns: Sequence[int] = (-30_000_000, -70_000_000)) -> list[RadarFrame]:
    return [
        replace(FRAME, radar=radar, t_ns=number * TICK_NS + late, counter=number + 1)
        for radar, late in enumerate(late_ns)
    ]


def made(preset: str = "robust", start: ArrayLike = (0.0, 0.0, 0.0)) -> Slam:
    return Slam(RIG, preset, front_end=Rod(), start=start)


def stepped(slam: Slam, number: int) -> SlamState:
    return slam.step(number * TICK_NS, drive(number * TICK_NS), frames=frames(number))


def assert_same(one: SlamState, other: SlamState) -> None:
    assert (one.t_ns, one.is_lost) == (other.t_ns, other.is_lost)
    assert one.pose.tobytes() == other.pose.tobytes()
    assert one.covariance.tobytes() == other.covariance.tobytes()
    assert len(one.results) == len(other.results)
    for mine, its in zip(one.results, other.results, strict=True):
        assert mine.t_ns == its.t_ns
        assert mine.belief.mean.tobytes() == its.belief.mean.tobytes()
        assert mine.belief.covariance.tobytes() == its.belief.covariance.tobytes()


T, P = TICK_NS, (0.5, 0.0, 0.0)
FOREIGN: Any = object()
REFUSED: dict[str, Callable[[Slam, int], object]] = {
    "stamp in seconds": lambda s, t: s.step(t / 1e9, P),  # type: ignore[arg-type]  # wrong on purpose
    "stamp of 80 bits": lambda s, t: s.step(1 << 80, P),
    "stamp that runs back": lambda s, t: s.step(t - 3 * T, P),
    "NaN heading": lambda s, t: s.step(t, (0.5, 0.0, math.nan)),
    "two numbers": lambda s, t: s.step(t, (0.5, 0.0)),
    "text": lambda s, t: s.step(t, "here"),
    "nowhere on Earth": lambda s, t: s.step(t, (1e9, 0.0, 0.0)),
    "no odometry": lambda s, t: s.step(t),
    "pose of an older time": lambda s, t: s.add_odometry(t - 2 * T, P),
    "NaN between steps": lambda s, t: s.add_odometry(t, (math.nan, 0.0, 0.0)),
    "function without a pose": lambda s, t: s.step(t, lambda _: np.zeros(2)),
    "function that fails at a frame": lambda s, t: s.step(
        t, lambda stamp: P if stamp == t else (math.inf, 0.0, 0.0), frames=frames(t // T)
    ),
    "unknown radar": lambda s, t: s.step(t, P, frames=[replace(FRAME, radar=2, t_ns=t)]),
    "two frames": lambda s, t: s.step(t, P, frames=[*frames(t // T), *frames(t // T)]),
    "range of a huge deviation": lambda s, t: s.step(t, P, ranges=[(0, 1.0, 1e200)]),
    "frame again": lambda s, t: s.step(t, P, frames=frames(t // T - 1)),
    "frame too new": lambda s, t: s.step(t, P, frames=frames(t // T, (0, T))),
    "frame older than odometry": lambda s, t: s.step(t, P, frames=frames(t // T, (0, -99 * T))),
    "infinite samples": lambda s, t: s.step(
        t, P, frames=[replace(FRAME, samples=np.full(9, np.inf, np.float32), t_ns=t)]
    ),
    "no frame": lambda s, t: s.step(t, P, frames=[FOREIGN]),
    "radar as a float": lambda s, t: s.step(t, P, ranges=[(0.0, 1.0, 0.1)]),
    "range of an unknown radar": lambda s, t: s.step(t, P, ranges=[(2, 1.0, 0.1)]),
    "negative radar": lambda s, t: s.step(t, P, ranges=[(-1, 1.0, 0.1)]),
    "NaN range": lambda s, t: s.step(t, P, ranges=[(0, math.nan, 0.1)]),
    "range of 0": lambda s, t: s.step(t, P, ranges=[(0, 0.0, 0.1)]),
    "sigma of 0": lambda s, t: s.step(t, P, ranges=[(0, 1.0, 0.1), (0, 1.0, 0.0)]),
    "too few numbers": lambda s, t: s.step(t, P, ranges=[(0, 1.0)]),
    "id that is a name": lambda s, t: s.step(t, P, ranges=[(0, 1.0, 0.1, FOREIGN)]),
    "range and frame of one": lambda s, t: s.step(
        t, P, frames=frames(t // T), ranges=[(0, 1.0, 0.1)]
    ),
    "range and point of one": lambda s, t: s.step(
        t, P, ranges=[(0, 1.0, 0.1)], points=[(0, 1.0, 0.0, 0.1, 0.1)]
    ),
    "no rows": lambda s, t: s.step(t, P, frames=None, ranges=FOREIGN),  # type: ignore[arg-type]  # wrong on purpose
    "a row that is alone": lambda s, t: s.step(t, P, ranges=(0, 1.0, 0.1)),  # type: ignore[arg-type]  # wrong on purpose
    "pose beyond floats": lambda s, t: s.step(t, (10**400, 0.0, 0.0)),
    "range beyond floats": lambda s, t: s.step(t, P, ranges=[(0, 10**400, 0.1)]),
    "bearing without sigma": lambda s, t: s.step(
        t,
        P,
        points=[(0, 1.0, 0.0, 0.1)],
    ),
}
OF_PAPER: dict[str, Callable[[Slam, int], object]] = {
    "points": lambda s, t: s.step(t, P, points=[(0, 1.0, 0.0, 0.1, 0.1)]),
    "ids": lambda s, t: s.step(t, P, ranges=[(0, 1.0, 0.1, 7)]),
    "both kinds": lambda s, t: s.step(t, P, frames=frames(t // T)[:1], ranges=[(1, 1.0, 0.1)]),
}
CASES = [("robust", name) for name in REFUSED] + [("paper", name) for name in REFUSED | OF_PAPER]


@settings(max_examples=examples(12), deadline=None)
@given(case=st.sampled_from(CASES), at=st.integers(2, 24), more=st.integers(1, 4))
def test_after_a_refused_step_all_is_as_without_it(
    case: tuple[str, str], at: int, more: int
) -> None:
    preset, name = case
    disturbed, calm = made(preset), made(preset)
    for number in range(at):
        stepped(disturbed, number), stepped(calm, number)
    refuse_all(disturbed, at, {name})
    for number in range(at, at + more):
        assert_same(stepped(disturbed, number), stepped(calm, number))


def refuse_all(slam: Slam, number: int, names: set[str]) -> None:
    before = slam.state
    for name in names:
        with pytest.raises(StepInputError):
            (REFUSED | OF_PAPER)[name](slam, number * TICK_NS)
    assert slam.state is before


@pytest.mark.parametrize("preset", ["robust", "paper"])
def test_whatever_is_refused_moves_nothing(preset: str) -> None:
    names = set(REFUSED if preset == "robust" else REFUSED | OF_PAPER)
    disturbed, calm = made(preset), made(preset)
    for number in range(20):
        assert_same(stepped(disturbed, number), stepped(calm, number))
        if number > 1:
            refuse_all(disturbed, number + 1, names)


def test_noise_of_odometry_that_falls_is_refused_and_moves_nothing() -> None:
    """The covariance of the motion would not be one."""
    falls = [False]

    def noise(t_ns: int) -> np.ndarray:
        return np.eye(3) * 1e-14 * (-t_ns if falls[0] else t_ns)

    disturbed, calm = (Slam(RIG, front_end=Rod(), odometry_noise=noise) for _ in range(2))
    for number in range(20):
        falls[0] = number > 0
        for late in (0, TICK_NS):
            if falls[0]:
                with pytest.raises(StepInputError):
                    disturbed.step(number * TICK_NS + late, P, frames=frames(number))
        falls[0] = False
        with pytest.raises(StepInputError):  # by the pipeline, at a later time than the next step
            disturbed.step((number + 1) * TICK_NS, (math.nan, 0.0, 0.0))
        assert_same(stepped(disturbed, number), stepped(calm, number))


def test_frames_have_the_poses_between_those_of_the_steps() -> None:
    """On a straight way interpolation is exact: the same as with the pose at every time."""
    between_steps, by_function, often = made(), made(), made()
    for number in range(30):
        t_ns = number * TICK_NS
        states = [
            stepped(between_steps, number),
            by_function.step(t_ns, drive, frames=frames(number)),
        ]
        for stamp_ns in range(t_ns - 4 * TICK_NS // 5, t_ns + 1, TICK_NS // 5):
            often.add_odometry(stamp_ns, drive(stamp_ns))
        states.append(often.step(t_ns, frames=frames(number)))
        for state in states[1:]:
            assert state.pose == pytest.approx(states[0].pose, abs=1e-9)
    assert len(by_function.landmarks) == 1
    assert by_function.landmarks.positions_m[0] == pytest.approx(ROD, abs=0.03)


def test_a_frame_just_behind_the_newest_pose_is_where_the_robot_goes_on_to() -> None:
    extrapolated, known = made(), made()
    for number in range(30):
        late = frames(number, (20_000_000, 40_000_000))
        t_ns = number * TICK_NS
        one = extrapolated.step(t_ns, drive(t_ns), frames=late)
        other = known.step(t_ns, drive, frames=late)
        assert one.pose == pytest.approx(other.pose, abs=1e-9)


def test_odometry_may_come_after_the_step_of_its_time() -> None:
    """A step a little ahead of odometry goes on at its velocity; late poses are taken, too."""
    slam, millisecond_ns = Slam(RIG), 1_000_000
    for stamp_ms in range(0, 1000, 20):
        slam.add_odometry(stamp_ms * millisecond_ns, drive(stamp_ms * millisecond_ns))
        if stamp_ms % 200 == 40:
            t_ns = (stamp_ms + 30) * millisecond_ns
            since_first = drive(t_ns) - drive(70 * millisecond_ns)
            assert slam.step(t_ns).pose == pytest.approx(since_first, abs=1e-9)
    for heading_rad in (7.0, 7.0 - 2 * math.tau):  # one pose
        assert slam.step(2 * 10**9, (0.3, 0.0, heading_rad)).t_ns == 2 * 10**9


def range_row(radar: int, t_ns: int) -> tuple[int, float, float]:
    mount = RIG.mounts[radar]
    x_m = mount.x_m + drive(t_ns)[0]
    return radar, math.hypot(ROD[0] - x_m, ROD[1] - mount.y_m), 0.003


@pytest.mark.parametrize("between_ns", [TICK_NS // 2, TICK_NS // 20, 0])
@pytest.mark.parametrize("preset", ["robust", "paper"])
def test_mounts_may_measure_in_turn(preset: str, between_ns: int) -> None:
    """Each in a step of its own, at the pose of then; steps in between may have no ranges."""
    slam = Slam(RIG, preset)
    for number in range(60):
        t_ns = number * TICK_NS
        for radar in (0, 1):
            slam.step(t_ns, drive, ranges=[range_row(radar, t_ns)])
            t_ns += between_ns
        slam.step(t_ns, drive)
    (landmark_m,) = slam.landmarks.positions_m
    assert landmark_m == pytest.approx(ROD, abs=0.01)


def test_a_mount_that_measures_no_more_is_waited_for_once() -> None:
    slam = Slam(RIG)

    def n_states(t_ns: int, *radars: int) -> int:
        state = slam.step(t_ns, drive, ranges=[range_row(radar, t_ns) for radar in radars])
        return len(state.results)

    half = TICK_NS // 2
    n = [n_states(k * half, k % 2) for k in range(9)]
    assert n == [0, 0, 1, 0, 1, 0, 1, 0, 1]  # the first one is the start; each has both mounts
    assert [n_states(k * half, 0) for k in range(9, 13)] == [0, 2, 1, 1]
    assert [n_states(k * half, 0, 1) for k in range(13, 16)] == [1, 1, 1]
    assert n_states(16 * half, 0) == 1  # mount 1 saw nothing beside mount 0
    assert [n_states(k * half, k % 2) for k in range(17, 20)] == [1, 0, 1]
    # A range waits for a second, and is of a state of its own then.
    assert n_states(20 * half, 0) == 0
    assert [n_states(20 * half + 250_000_000 * k) for k in range(1, 5)] == [0, 0, 0, 2]


@pytest.mark.parametrize(
    "mounts", [[(0,), (0,), (0,), (1,)], [(0,), (0,), (1,)], [(0, 1), (0,), (1,), (0,)]]
)
def test_no_range_is_lost_where_mounts_measure_unequally_often(
    mounts: list[tuple[int, ...]], monkeypatch: pytest.MonkeyPatch
) -> None:
    slam, used = Slam(RIG), list[int]()
    step_scans = RobustSlam.step_scans

    def watched(
        self: RobustSlam,
        frames: Sequence[RadarFrame],
        given: Sequence[RangeScan],
        pose_at: PoseAt,
        t_ns: int,
    ) -> tuple[StepResult, ...]:
        used.extend(scan.radar for scan in given)
        return step_scans(self, frames, given, pose_at, t_ns)

    monkeypatch.setattr(RobustSlam, "step_scans", watched)
    n_given = Counter[int]()
    for k in range(40):
        t_ns = k * TICK_NS // 2
        slam.step(t_ns, drive, ranges=[range_row(radar, t_ns) for radar in mounts[k % len(mounts)]])
        n_given.update(mounts[k % len(mounts)])
    assert n_given - Counter(used) <= Counter([0, 1])  # what waits still


def test_blas_has_one_thread_until_the_last_of_two_that_need_it_has_left() -> None:
    def n_threads() -> set[int]:
        return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}

    with threadpool_limits(limits=2, user_api="blas"):
        before = n_threads()
        one, other = one_blas_thread(), one_blas_thread()
        one.__enter__()
        other.__enter__()
        one.__exit__(None, None, None)
        assert n_threads() == {1}
        other.__exit__(None, None, None)
        assert n_threads() == before == {2}


def test_one_late_stamp_does_not_throw_the_robot_forward() -> None:
    """A pose that is stamped 60 us before the next one makes no velocity of hundreds of m/s."""
    slam = Slam(RIG)
    for k in range(20):
        t_ns = k * 50_000_000
        late_ns = 49_940_000 if k == 18 else 0
        slam.add_odometry(t_ns + late_ns, drive(t_ns))
    t_ns = 19 * 50_000_000 + 90_000_000
    slam.step(0)
    assert slam.step(t_ns).pose == pytest.approx(drive(t_ns), abs=1e-9)


def test_what_was_seen_while_the_robot_drove_unseen_is_refused() -> None:
    """No pose came for 1.1 s; a robot that stood meanwhile is where it was."""
    for way_m, is_refused in ((0.5, True), (0.0, False)):
        slam = Slam(RIG, front_end=Rod())
        slam.add_odometry(0, (0.0, 0.0, 0.0))
        slam.add_odometry(1_100_000_000, (way_m, 0.0, 0.0))
        slam.step(0)
        frame = replace(FRAME, t_ns=500_000_000)
        with (
            pytest.raises(StepInputError, match="the robot drove") if is_refused else nullcontext()
        ):
            slam.step(1_100_000_000, frames=[frame])
        assert slam.step(1_100_000_000).pose == pytest.approx([way_m, 0.0, 0.0], abs=1e-9)


def test_a_loop_that_paused_goes_on() -> None:
    """Frames just before the newest pose have a place, though none is known for seconds before."""
    slam = made()
    for number in (*range(8), *range(40, 48)):
        late = frames(number, (-30_000_000, -40_000_000))
        slam.step(number * TICK_NS, drive(number * TICK_NS), frames=late)


def test_what_is_no_radian_no_rig_or_no_noise_says_so() -> None:
    with pytest.raises(ValueError, match=r"math\.radians"):
        Rig([Mount(x_m=0.0, y_m=0.2, yaw_rad=90.0)])
    with pytest.raises(ValueError, match=r"start.*radians"):
        Slam(RIG, start=(0.0, 0.0, 90.0))
    with pytest.raises(ValueError, match="load_rig"):
        Slam("robot.toml")  # type: ignore[arg-type]  # wrong on purpose
    for wrong in (math.nan, math.inf, -0.01):
        with pytest.raises(ValueError, match="wheels: scale_sigma is"):
            WheelNoise(scale_sigma=wrong)


def test_a_restarted_source_of_odometry_changes_nothing() -> None:
    anew, whole = made(), made()
    for number in range(40):
        t_ns = number * TICK_NS
        for stamp_ns in range(t_ns - 4 * TICK_NS // 5, t_ns + 1, TICK_NS // 5):
            began_ns = 20 * TICK_NS if stamp_ns >= 20 * TICK_NS else 0
            anew.add_odometry(stamp_ns, drive(stamp_ns) - drive(began_ns))
            whole.add_odometry(stamp_ns, drive(stamp_ns))
        given = None if number % 2 else drive(t_ns) - drive(began_ns)
        state = anew.step(t_ns, given, frames=frames(number))
        assert state.pose == pytest.approx(whole.step(t_ns, frames=frames(number)).pose, abs=1e-9)
    assert anew.landmarks.positions_m == pytest.approx(whole.landmarks.positions_m, abs=1e-9)


def test_headings_need_not_be_unwrapped() -> None:
    """A frame half way between two poses on both sides of pi looks the way between them."""
    slam = Slam(RIG, front_end=Rod())
    seen: list[Pose] = []

    def spy(frames: object, given: object, poses: dict[int, Pose], t_ns: int) -> tuple[()]:
        seen.append(poses[t_ns - TICK_NS // 2])
        return ()

    slam.step(0, (0.0, 0.0, math.pi - 0.1))
    slam._stepped = spy  # type: ignore[method-assign]  # watched
    frame = replace(FRAME, t_ns=TICK_NS // 2)
    slam.step(TICK_NS, (0.0, 0.0, 3 * math.pi + 0.1 - 2 * math.tau), frames=[frame])
    assert abs(seen[0][2]) == pytest.approx(math.pi)


@pytest.mark.parametrize("preset", ["robust", "paper"])
def test_there_is_a_state_before_the_first_landmark_and_between_states(preset: str) -> None:
    slam = made(preset, start=(1.0, 2.0, math.pi / 2))
    assert slam.state.t_ns is None
    assert slam.state.pose.tolist() == [1.0, 2.0, math.pi / 2]
    assert slam.smoothed() is None
    for k, x_m in enumerate((5.0, 5.0, 5.003)):  # too little for a state
        state = slam.step(k, (x_m, 1.0, 0.0))
        assert state.t_ns == k
        assert state.results == ()
        assert state.pose == pytest.approx([1.0, 2.0 + x_m - 5.0, math.pi / 2])
    sigma_m = math.sqrt(state.covariance[1, 1])
    along_m = WheelNoise().along_m_per_sqrt_m * math.sqrt(0.003)
    assert sigma_m == pytest.approx(math.hypot(along_m, WheelNoise().scale_sigma * 0.003), rel=0.01)
    assert (len(slam.landmarks), slam.walls.shape) == (0, (0, 2, 2))


def test_the_map_lies_where_it_was_started() -> None:
    start = np.array([3.0, -1.0, 2.0])
    there, here = made(start=start), made()
    for number in range(30):
        moved, plain = stepped(there, number), stepped(here, number)
        assert moved.pose == pytest.approx(compose(start, plain.pose))
        R = np.eye(3)
        R[:2, :2] = np.array([[math.cos(2), -math.sin(2)], [math.sin(2), math.cos(2)]])
        assert moved.covariance == pytest.approx(R @ plain.covariance @ R.T)
    assert there.landmarks.positions_m == pytest.approx(
        transform(start, here.landmarks.positions_m)
    )
    one, other = there.smoothed(), here.smoothed()
    assert one is not None
    assert other is not None
    assert between(start, one.poses[-1]) == pytest.approx(other.poses[-1])


def test_ranges_of_anchors_with_ids_place_robot_and_anchors() -> None:
    """A circle of 3 m, wheels 2 % too long: ranges of 2 cm keep the robot within centimetres."""
    rng = np.random.default_rng(1)
    slam = Slam(MIDDLE)
    step = np.array([0.08, 0.0, 0.08 / 1.5])
    pose, wheels = np.zeros(3), np.zeros(3)
    for number in range(250):
        ranges = [
            (0, math.dist(at, pose[:2]) + rng.normal(0.0, 0.02), 0.02, id_)
            for id_, at in ANCHORS.items()
        ]
        state = slam.step(number * TICK_NS, wheels, ranges=ranges)
        if number < 249:
            pose = compose(pose, step)
            wheels = compose(wheels, step * np.array([1.007, 1.0, 1.0]))
    assert math.dist(state.pose[:2], pose[:2]) < 0.04
    error = between(pose, state.pose)
    assert error @ np.linalg.solve(state.covariance, error) < 16.3  # chi-square, 3 dof, 0.1 %
    marks = slam.landmarks
    assert set(marks.given_ids) == set(ANCHORS)
    for id_, at, covariance in zip(
        marks.given_ids, marks.positions_m, marks.covariances_m2, strict=True
    ):
        assert id_ is not None
        away = at - ANCHORS[id_]
        assert math.hypot(*away) < 0.1
        assert away @ np.linalg.solve(covariance, away) < 13.8  # 2 dof


def circled(slam: Slam, n: int) -> tuple[Pose, SlamState]:
    """Drive a circle of 3 m among the anchors; return the true pose and the state at its end."""
    rng = np.random.default_rng(2)
    step, pose = np.array([0.08, 0.0, 0.08 / 1.5]), np.zeros(3)
    for number in range(n):
        ranges = [
            (0, math.dist(at, pose[:2]) + rng.normal(0.0, 0.02), 0.02, id_)
            for id_, at in ANCHORS.items()
        ]
        state = slam.step(number * TICK_NS, pose, ranges=ranges)
        pose = compose(pose, step) if number < n - 1 else pose
    return pose, state


@cache
def day_one() -> Slam:
    """Return what a circle has mapped; not to be stepped on."""
    slam = Slam(MIDDLE)
    circled(slam, 150)
    return slam


def test_the_next_run_begins_on_the_saved_map_with_its_ids(tmp_path: Path) -> None:
    """Anchors keep their ids, so a robot put down 10 cm off is right after a few ranges."""
    path, first = tmp_path / "map.json", day_one()
    assert first.map_changes is None
    first.save_map(path)
    second = Slam(MIDDLE, map=path, start=(0.08, -0.06, 0.05))
    assert second.state.pose == pytest.approx([0.08, -0.06, 0.05])
    assert second.state.covariance == pytest.approx(np.diag([0.01, 0.01, 0.01]))
    pose, state = circled(second, 40)
    assert not state.is_lost
    assert math.dist(state.pose[:2], pose[:2]) < 0.05
    assert set(second.landmarks.given_ids) == set(ANCHORS)
    changes = second.map_changes
    assert changes is not None
    assert set(changes.seen) == set(first.landmarks.ids)
    assert changes.gone == changes.new == ()


def test_a_fixed_map_is_reported_and_saved_as_it_was(tmp_path: Path) -> None:
    path, again = tmp_path / "map.json", tmp_path / "again.json"
    day_one().save_map(path)
    file = load_map(path)
    fixed = Slam(MIDDLE, map=file, start=(0.0, 0.0, 0.0), localise=True)
    _, state = circled(fixed, 40)
    assert state.covariance[0, 0] < 0.05**2
    assert fixed.landmarks.positions_m.tolist() == file.map.landmarks_m.tolist()
    fixed.save_map(again)
    assert load_map(again).map == file.map


def test_on_a_map_the_robot_is_lost_until_it_has_found_its_place(tmp_path: Path) -> None:
    path = tmp_path / "map.json"
    slam = made()
    for number in range(30):
        stepped(slam, number)
    slam.save_map(path)
    placed = Slam(RIG, map=path, front_end=Rod())
    assert placed.state.is_lost
    assert stepped(placed, 0).is_lost
    assert stepped(placed, 1).is_lost


def test_what_cannot_begin_on_a_map_says_so(tmp_path: Path) -> None:
    path = tmp_path / "map.json"
    made().save_map(path)
    for options in ({"map": path, "preset": "paper"}, {"localise": True}):
        with pytest.raises(ValueError, match="map"):
            Slam(RIG, **options)
    with pytest.raises(ConfigError, match="none"):
        Slam(RIG, map=tmp_path / "none.json")
    for slam in (made("paper"), made(start=(1.0, 0.0, 0.0))):
        with pytest.raises(ValueError, match="save_map"):
            slam.save_map(tmp_path / "other.json")
    assert not (tmp_path / "other.json").exists()


def test_points_are_landmarks_at_once() -> None:
    config = override(
        load_preset("robust"), {"detection.max_range_m": 8.0, "robust.field_of_view_deg": 170}
    )
    slam = Slam(MIDDLE, config)
    places = {1: (3.0, 1.0), 2: (3.0, -1.0), None: (5.0, 0.5)}
    for number in range(25):
        pose = drive(number * TICK_NS)
        points = []
        for id_, at in places.items():
            x_m, y_m = at[0] - pose[0], at[1]
            points.append((0, math.hypot(x_m, y_m), math.atan2(y_m, x_m), 0.02, 0.01, id_))
        state = slam.step(number * TICK_NS, pose, points=points)
    assert state.pose == pytest.approx(drive(24 * TICK_NS), abs=0.02)
    found = dict(zip(slam.landmarks.given_ids, slam.landmarks.positions_m, strict=True))
    assert set(found) == set(places)
    for id_, at in places.items():
        assert found[id_] == pytest.approx(at, abs=0.06)


def test_the_noise_of_odometry_is_what_it_says() -> None:
    """Before any landmark the pose is as uncertain as odometry since the start."""
    still = WheelNoise(scale_sigma=0.0, turn_scale_sigma=0.0, curvature_sigma_rad_per_m=0.0)
    per_step = np.diag([4e-6, 9e-6, 1e-6])
    slam = Slam(RIG, wheels=still, odometry_noise=lambda t_ns: per_step * (t_ns / TICK_NS))
    for number in range(4):
        state = slam.step(number * TICK_NS, drive(number * TICK_NS))
    assert state.covariance[0, 0] == pytest.approx(3 * 4e-6, rel=0.01)
    assert state.covariance[2, 2] == pytest.approx(3 * 1e-6, rel=0.01)
    for noise in (np.zeros(3), np.full((3, 3), math.nan)):
        wrong = Slam(RIG, odometry_noise=lambda _, noise=noise: noise)  # type: ignore[misc]  # mypy infers no lambda with a default
        with pytest.raises(StepInputError):
            wrong.step(0, P)
        assert wrong.state.t_ns is None


@pytest.mark.parametrize("has_bearings", [False, pytest.param(True, marks=pytest.mark.rare)])
def test_after_a_stop_what_has_ids_makes_the_pose_sure_again(has_bearings: bool) -> None:
    """While the wheels stand the robot may be carried; what it hears then shows that it was not."""
    config = override(
        load_preset("robust"), {"detection.max_range_m": 8.0, "robust.field_of_view_deg": 170}
    )
    slam = Slam(MIDDLE, config)
    step, pose, sigmas = np.array([0.08, 0.0, 0.08 / 1.5]), np.zeros(3), list[float]()
    for number in range(330):
        ranges, points = [], []
        for id_, at in ANCHORS.items():
            ranges.append((0, math.dist(at, pose[:2]), 0.02, id_))
            away = between(pose, np.array([*at, 0.0]))
            points.append((0, ranges[-1][1], math.atan2(away[1], away[0]), 0.02, 0.02, id_))
        if has_bearings:
            state = slam.step(number * TICK_NS, pose, points=points)
        else:
            state = slam.step(number * TICK_NS, pose, ranges=ranges)
        sigmas.append(math.sqrt(state.covariance[0, 0]))
        if not 100 <= number < 115:
            pose = compose(pose, step)
    assert not state.is_lost
    assert sigmas[99] < 0.1
    assert max(sigmas[115:125]) > 0.3
    assert sigmas[-1] < 0.1


def test_a_rig_takes_a_list_and_names_its_mounts() -> None:
    assert [mount.name for mount in RIG.mounts] == ["radar0", "radar1"]
    mount = Mount(name="radar1", x_m=0.0, y_m=0.0, yaw_rad=0.0)
    for twin in (mount, replace(mount, name="")):  # the latter is called by its number
        with pytest.raises(ValueError, match="radar1, radar1"):
            Rig([mount, twin])
    with pytest.raises(ValueError, match="finite"):
        Rig([Mount(x_m=math.nan, y_m=0.0, yaw_rad=0.0)])
    with pytest.raises(ValueError, match="mount"):
        Slam(Rig([]))


def test_every_name_is_there_and_loaded_when_it_is_used() -> None:
    for module in (library, __import__("slam.live", fromlist=["live"])):
        for name in module.__all__:
            assert getattr(module, name).__name__ == name
    with pytest.raises(AttributeError):
        library.nothing  # noqa: B018 - raises
    program = "import slam, slam.live, sys; print({'numpy', 'pydantic', 'scipy'} & {*sys.modules})"
    printed = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert printed.stdout == "set()\n"


def test_a_rig_file_brings_its_wheels(tmp_path: Path) -> None:
    (file := tmp_path / "robot.toml").write_text(
        '[[radars]]\nname = "left"\nserial = "202305070101"\nx_m = 0.1\ny_m = 0.2\nyaw_deg = 90.0\n'
        "[wheels]\nscale_sigma = 0.05\n"
    )
    slam = Slam(load_rig(file))
    assert slam.rig.mounts[0].yaw_rad == math.pi / 2
    slam.step(0, (0.0, 0.0, 0.0))
    state = slam.step(T, (1.0, 0.0, 0.0))
    assert state.covariance[0, 0] > 0.05**2

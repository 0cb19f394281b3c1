"""What the pipelines are stepped with is checked before anything moves; ValueError names it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from slam.config import (
    BackEnd,
    SampleTime,
    SlamConfig,
    TrilaterationConfig,
    WheelNoise,
    WindowConfig,
)
from slam.frames import Detection, RadarFrame, StepInputError
from slam.geometry import Mount, Rig
from slam.paper.pipeline import UwbRadarSlam
from slam.results import Pipeline, PoseAt
from slam.robust.association import RangeScan
from slam.robust.back_end import RobustBackEnd
from slam.robust.parameters import BackEndParameters
from slam.robust.pipeline import RobustSlam

TICK_NS = 200_000_000
STEP_M = 0.05
TWO = Rig(
    mounts=tuple(
        Mount(name=f"radar{k}", x_m=x_m, y_m=0.2, yaw_rad=math.pi / 2)
        for k, x_m in enumerate((-0.1, 0.1))
    )
)
SEEN = Detection(radar=0, t_ns=0, range_m=0.8, amplitude=0.01)
FRAME = RadarFrame(
    radar=0,
    t_ns=0,
    counter=1,
    samples=np.zeros(200, dtype=np.float32),
    range_start_m=0.2,
    bin_length_m=0.0064,
)


class FoundElsewhere:
    """A front end that reports a range of a radar whose frame it did not get."""

    def detect(self, frame: RadarFrame, range_offset_m: float = 0.0) -> tuple[Detection, ...]:
        return (replace(SEEN, radar=1 - frame.radar, t_ns=frame.t_ns),)

    def detect_many(
        self, frames: Sequence[RadarFrame], offsets_m: Sequence[float]
    ) -> list[tuple[Detection, ...]]:
        return [self.detect(frame) for frame in frames]


def make(back_end: BackEnd, *, elsewhere: bool = False) -> Pipeline:
    config = SlamConfig(
        back_end=back_end,
        window=WindowConfig(size=1),
        trilateration=TrilaterationConfig(sample_time=SampleTime.OWN),
    )
    detector = FoundElsewhere() if elsewhere else None
    if back_end is BackEnd.ROBUST:
        return RobustSlam(config, TWO, WheelNoise(), detector)
    return UwbRadarSlam(config, TWO, detector)


def straight(t_ns: int) -> NDArray[np.float64]:
    return np.array([STEP_M * t_ns / TICK_NS, 0.0, 0.0])


def with_heading(heading_rad: float) -> PoseAt:
    return lambda t_ns: np.array([STEP_M * t_ns / TICK_NS, 0.0, heading_rad])


def bad_at(stamp_ns: int) -> PoseAt:
    return lambda t_ns: straight(t_ns) * (math.nan if t_ns == stamp_ns else 1.0)


def of(radar: int, t_ns: int) -> Detection:
    return replace(SEEN, radar=radar, t_ns=t_ns)


def frame_of(radar: int, t_ns: int) -> RadarFrame:
    return replace(FRAME, radar=radar, t_ns=t_ns)


BAD_STEPS: dict[str, Callable[[Pipeline, int], object]] = {
    "range of an unknown radar": lambda s, t: s.step_detections([of(2, t)], straight, t),
    "frame of an unknown radar": lambda s, t: s.step([frame_of(2, t)], straight, t),
    "ranges of two scans": lambda s, t: s.step_detections([of(0, t), of(0, t + 1)], straight, t),
    "two frames at a time": lambda s, t: s.step([frame_of(0, t)] * 2, straight, t),
    "two frames": lambda s, t: s.step([frame_of(1, t), frame_of(1, t + 1)], straight, t),
    "NaN heading": lambda s, t: s.step_detections([], with_heading(math.nan), t),
    "infinite heading": lambda s, t: s.step([], with_heading(math.inf), t),
    "NaN at the sample": lambda s, t: s.step_detections([of(0, t + 1)], bad_at(t + 1), t),
    "short pose": lambda s, t: s.step([], lambda _: np.array([1.0, 2.0]), t),
    "column pose": lambda s, t: s.step([], lambda _: np.ones((3, 1)), t),
    "stamp running back": lambda s, t: s.step_detections([], straight, t - 2 * TICK_NS),
}


@pytest.mark.parametrize("back_end", BackEnd)
@pytest.mark.parametrize("bad", BAD_STEPS)
def test_a_bad_step_is_a_value_error_and_moves_nothing(back_end: BackEnd, bad: str) -> None:
    slam, undisturbed = make(back_end), make(back_end)
    for t_ns in (0, TICK_NS):
        for one in (slam, undisturbed):
            one.step_detections([of(0, t_ns), of(1, t_ns)], straight, t_ns)
    with pytest.raises(StepInputError):
        BAD_STEPS[bad](slam, 2 * TICK_NS)
    results = [
        one.step_detections([of(0, 2 * TICK_NS)], straight, 2 * TICK_NS)
        for one in (slam, undisturbed)
    ]
    (after,), (without,) = results
    assert after.belief.pose[0] == pytest.approx(2 * STEP_M, abs=1e-3)
    assert np.array_equal(after.belief.mean, without.belief.mean)
    assert np.array_equal(after.belief.covariance, without.belief.covariance)


@pytest.mark.parametrize("back_end", BackEnd)
@pytest.mark.parametrize("bad", [name for name in BAD_STEPS if name != "NaN at the sample"])
def test_a_bad_first_step_leaves_the_pipeline_at_its_start(back_end: BackEnd, bad: str) -> None:
    slam = make(back_end)
    if bad != "stamp running back":  # the first stamp may be any
        with pytest.raises(StepInputError):
            BAD_STEPS[bad](slam, 0)
    assert slam.step_detections([], straight, 0) == ()
    (result,) = slam.step_detections([], straight, TICK_NS)
    assert result.belief.pose == pytest.approx([STEP_M, 0.0, 0.0], abs=1e-3)


@pytest.mark.parametrize("back_end", BackEnd)
def test_a_front_end_that_names_another_radar_moves_nothing(back_end: BackEnd) -> None:
    slam = make(back_end, elsewhere=True)
    slam.step([frame_of(0, 0)], straight, 0)
    with pytest.raises(StepInputError):
        slam.step([frame_of(0, TICK_NS)], straight, TICK_NS)
    (result,) = slam.step([], straight, TICK_NS)
    assert result.belief.pose == pytest.approx([STEP_M, 0.0, 0.0], abs=1e-3)


class CountingFrames(FoundElsewhere):
    """A front end that finds nothing, and counts its frames."""

    n_frames = 0

    def detect_many(
        self, frames: Sequence[RadarFrame], offsets_m: Sequence[float]
    ) -> list[tuple[Detection, ...]]:
        self.n_frames += len(frames)
        return [() for _ in frames]


def test_a_frame_whose_pose_is_not_finite_does_not_reach_the_front_end() -> None:
    """It has a state of its own: a step that is repeated would give it the frame twice."""
    detector = CountingFrames()
    slam = RobustSlam(SlamConfig(back_end=BackEnd.ROBUST), TWO, WheelNoise(), detector)
    slam.step([], straight, 0)
    frames = [frame_of(0, TICK_NS + 1)]
    with pytest.raises(StepInputError):
        slam.step(frames, bad_at(TICK_NS + 1), TICK_NS)
    assert detector.n_frames == 0
    assert len(slam.step(frames, straight, TICK_NS)) == 1
    assert detector.n_frames == 1


@pytest.mark.parametrize("back_end", BackEnd)
def test_a_step_of_the_same_time_is_accepted(back_end: BackEnd) -> None:
    slam = make(back_end)
    for _ in range(2):
        assert slam.step_detections([], straight, TICK_NS) == ()


@pytest.mark.parametrize(
    "changes",
    [
        {"radar": -1},
        {"sigma_m": -1.0},
        {"sigma_m": 0.0},
        {"misfit": -1.0},
        {"range_m": math.nan},
        {"range_m": math.inf},
    ],
    ids=str,
)
def test_a_detection_of_what_cannot_be_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(changes))):
        replace(SEEN, **changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"radar": -1},
        {"range_start_m": math.nan},
        {"bin_length_m": math.nan},
        {"bin_length_m": math.inf},
        {"bin_length_m": -0.01},
    ],
    ids=str,
)
def test_a_frame_without_a_range_axis_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=next(iter(changes))):
        replace(FRAME, **changes)


SCAN = RangeScan(
    radar=0,
    ranges_m=(1.0, 2.0),
    sigmas_m=(0.01, 0.02),
    moved=(0.01, 0.0, 0.1),
    blurred_m=(3.0,),
    labels=(7, None),
    bearings_rad=(0.1, 0.2),
    bearing_sigmas_rad=(0.0, 0.01),
    radii_m=(0.0, 0.1),
    radius_sigmas_m=(0.03, 0.05),
)
OTHERS = ("radar", "labels", "is_patch", "is_imaged", "faces_m", "mirrors")
NUMBERS = [each.name for each in fields(RangeScan) if each.name not in OTHERS]


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("name", NUMBERS)
def test_every_number_of_a_scan_is_finite(name: str, value: float) -> None:
    changes: dict[str, Any] = {name: (value, *getattr(SCAN, name)[1:])}
    with pytest.raises(ValueError, match=name):
        replace(SCAN, **changes)


FACES = replace(SCAN, is_patch=True, faces_m=((-0.1, 0.1), (0.0, 0.2)))


@pytest.mark.parametrize(
    "changes",
    [
        {"faces_m": ((-0.1, math.nan), (0.0, 0.2))},
        {"faces_m": ((-0.1, 0.1),)},
        {"is_patch": False},
        {"bearings_rad": None},
    ],
    ids=str,
)
def test_faces_are_finite_and_of_a_patch_with_bearings(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="faces_m"):
        replace(FACES, **changes)


@pytest.mark.parametrize("name", ["sigmas_m", "labels", "bearings_rad", "bearing_sigmas_rad"])
def test_a_scan_has_one_of_each_for_each_range(name: str) -> None:
    changes: dict[str, Any] = {name: getattr(SCAN, name)[:1]}
    with pytest.raises(ValueError, match=name):
        replace(SCAN, **changes)


@pytest.mark.parametrize("changes", [{"radar": -1}, {"sigmas_m": (0.01, -0.01)}], ids=str)
def test_a_scan_of_what_cannot_be_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="radar"):
        replace(SCAN, **changes)


@pytest.mark.parametrize("radars", [(2,), (0, 0), (0, 1, 1)])
def test_the_back_end_takes_one_scan_of_each_radar_of_its_rig(radars: tuple[int, ...]) -> None:
    back_end = RobustBackEnd(TWO, BackEndParameters())
    with pytest.raises(ValueError, match="radars"):
        back_end.update([RangeScan(radar=radar, ranges_m=()) for radar in radars])


@pytest.mark.parametrize("row", range(3))
def test_the_back_end_takes_no_increment_that_is_not_finite(row: int) -> None:
    back_end = RobustBackEnd(TWO, BackEndParameters())
    increment = np.array([0.01, 0.0, 0.1])
    increment[row] = math.nan
    with pytest.raises(ValueError, match="increment"):
        back_end.predict(increment)
    assert back_end.pose == pytest.approx(np.zeros(3))

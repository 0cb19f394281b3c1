"""The runner: each state with its counter, truth and place; link states; progress lines."""

import io
import math
import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from hil_tests.unit.slam.app.sessions import (
    FRAME_NS,
    Listener,
    NoSlam,
    scan,
    session_info,
    snapshot,
    source_of_scans,
)
from slam.app.run.output import RunProgress
from slam.app.run.runner import LinkStates, execute
from slam.config import BackEnd, SlamConfig, WheelNoise
from slam.frames import RadarFrame
from slam.geometry import paper_rig
from slam.library.slam import make_slam
from slam.live.errors import AppError
from slam.live.odometry_track import OdometryTrack, TumSample
from slam.live.session_records import LogLine
from slam.results import Belief, PoseAt, StepResult

COUNTERS = (5, 6, 8, 11, 12)
LAG = 2


class LateSlam(NoSlam):
    """Believes odometry, two scans late; what is left at the end comes from `flush`."""

    def __init__(self) -> None:
        self.waiting: list[StepResult] = []

    def step(
        self, frames: Sequence[RadarFrame], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        odometry_pose = pose_at(t_ns)
        belief = Belief(mean=odometry_pose, covariance=np.eye(3), landmark_ids=(), next_id=0)
        self.waiting.append(
            StepResult(
                t_ns=t_ns,
                odometry_pose=odometry_pose,
                belief=belief,
                detections=(),
            )
        )
        return (self.waiting.pop(0),) if len(self.waiting) > LAG else ()

    def flush(self) -> tuple[StepResult, ...]:
        return tuple(self.waiting)

    def wall_spans_m(self) -> NDArray[np.float64]:
        return np.array([[[0.0, 1.0], [2.0, 1.0]]])


def truth_at(stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    counters = stamps_ns / FRAME_NS
    return np.column_stack([counters, 100 - counters, 0.1 * counters])


def test_every_state_comes_with_its_own_counter_truth_and_place() -> None:
    ends = [
        TumSample(t_ns=counter * FRAME_NS, x_m=2.0 * counter, y_m=0.0, qz=0.0, qw=1.0)
        for counter in (0, 20)
    ]
    listener = Listener()
    source = source_of_scans(map(scan, COUNTERS), OdometryTrack(ends), LateSlam(), truth_at)
    record = execute(source, [listener])
    assert tuple(scan.counter for scan in listener.scans) == COUNTERS
    assert tuple(snapshot.counter for snapshot in listener.snapshots) == COUNTERS
    states = record.states
    assert len(states) == len(COUNTERS)
    assert states.t_ns.tolist() == [counter * FRAME_NS for counter in COUNTERS]
    np.testing.assert_allclose(record.world_from_map, [5.0, 95.0, 0.5])
    for counter, taken, truth in zip(COUNTERS, listener.snapshots, states.truth, strict=True):
        assert taken.t_ns == counter * FRAME_NS
        np.testing.assert_allclose(taken.truth, [counter, 100 - counter, 0.1 * counter])
        np.testing.assert_allclose(taken.estimate, [2.0 * counter, 0.0, 0.0])
        np.testing.assert_array_equal(taken.world_from_map, record.world_from_map)
        np.testing.assert_array_equal(truth, taken.truth)
    assert record.n_frames == 2 * len(COUNTERS)
    assert record.start_ns == COUNTERS[0] * FRAME_NS
    assert record.start_ns + record.duration_ns == COUNTERS[-1] * FRAME_NS
    assert record.last is listener.snapshots[-1]
    for taken in listener.snapshots:
        np.testing.assert_array_equal(taken.wall_spans_m, [[[0.0, 1.0], [2.0, 1.0]]])


def test_an_unused_scan_is_told_and_not_stepped() -> None:
    ends = [TumSample(t_ns=t_ns, x_m=0.0, y_m=0.0, qz=0.0, qw=1.0) for t_ns in (0, 20 * FRAME_NS)]
    listener = Listener()
    scans = [replace(scan(counter), used=counter not in (5, 8)) for counter in COUNTERS]
    record = execute(source_of_scans(scans, OdometryTrack(ends), LateSlam()), [listener])
    assert tuple(scan.counter for scan in listener.scans) == COUNTERS
    assert [snapshot.counter for snapshot in listener.snapshots] == [6, 11, 12]
    assert record.n_frames == 2 * 3
    np.testing.assert_array_equal(record.world_from_map, np.zeros(3))
    assert np.isnan(record.states.truth).all()


@pytest.mark.parametrize("back_end", BackEnd)
def test_scans_whose_times_fall_end_the_run_and_reach_the_observers(back_end: BackEnd) -> None:
    ends = [TumSample(t_ns=t_ns, x_m=0.0, y_m=0.0, qz=0.0, qw=1.0) for t_ns in (0, 20 * FRAME_NS)]
    slam = make_slam(SlamConfig(back_end=back_end), paper_rig(), WheelNoise())
    listener = Listener()
    with pytest.raises(AppError):
        execute(source_of_scans(map(scan, (5, 4)), OdometryTrack(ends), slam), [listener])
    assert [scan.counter for scan in listener.scans] == [5, 4]


def test_slam_hears_radars_less_their_gains_and_observers_as_they_are() -> None:
    """6.02 dB are a factor of two, so the limits and what lies at them stay equal."""
    heard: list[RadarFrame] = []

    class Hearing(LateSlam):
        def step(
            self, frames: Sequence[RadarFrame], pose_at: PoseAt, t_ns: int
        ) -> tuple[StepResult, ...]:
            heard.extend(frames)
            return super().step(frames, pose_at, t_ns)

    ends = [TumSample(t_ns=t_ns, x_m=0.0, y_m=0.0, qz=0.0, qw=1.0) for t_ns in (0, FRAME_NS)]
    made = scan(0)
    low, high = (
        float(limit) for limit in (made.frames[1].samples.min(), made.frames[1].samples.max())
    )
    made = replace(made, frames=(made.frames[0], replace(made.frames[1], limits=(low, high))))
    first, second = session_info().radars
    radars = (first, replace(second, gain_db=20.0 * math.log10(2.0)))
    execute(source_of_scans([made], OdometryTrack(ends), Hearing(), radars=radars))
    as_it_was, halved = heard
    assert as_it_was is made.frames[0]
    np.testing.assert_allclose(halved.samples, made.frames[1].samples / 2.0, rtol=1e-6)
    assert halved.samples.dtype == np.float32
    assert halved.limits == (float(halved.samples.min()), float(halved.samples.max()))


def line(text: str, *, warning: bool = False, radar: str = "radar0") -> LogLine:
    return LogLine(t_ns=0, radar=radar, warning=warning, text=text)


def test_counters_of_two_streams_are_no_gap() -> None:
    """A radar that restarts soon begins anew with a counter above its last one."""
    links = LinkStates(session_info(1).radars)
    for counter, stream in ((1, 0), (2, 0), (5, 1), (7, 1), (8, 2), (3, 2), (5, 2)):
        one = scan(counter, 1)
        frames = (replace(one.frames[0], stream=stream),)
        list(links.on_scan(replace(one, frames=frames)))
    assert (links.counts["radar0"].frames, links.counts["radar0"].lost) == (7, 2)
    assert links.counts["radar0"].longest_gap == 1


def test_a_gap_in_the_counters_is_a_loss_until_the_next_frame() -> None:
    links = LinkStates(session_info(1).radars)
    changes = [
        (change.t_ns // FRAME_NS, str(change.state))
        for counter in (5, 6, 9, 10)
        for change in links.on_scan(scan(counter, 1))
    ]
    assert changes == [(5, "streaming"), (9, "frames lost"), (10, "streaming")]
    count = links.counts["radar0"]
    assert (count.frames, count.lost, count.longest_gap) == (4, 2, 2)


def test_a_radar_without_a_frame_in_a_tick_is_silent_and_others_go_on() -> None:
    links = LinkStates(session_info(2).radars)
    list(links.on_scan(scan(0)))
    both = scan(1)
    (change,) = links.on_scan(replace(both, frames=both.frames[:1]))
    assert (change.radar, str(change.state), change.t_ns) == ("radar1", "silent", FRAME_NS)
    changes = {change.radar: str(change.state) for change in links.on_scan(scan(2))}
    assert changes == {"radar1": "frames lost"}


def test_late_frames_that_slam_did_not_use_make_no_other_radar_silent() -> None:
    links = LinkStates(session_info(2).radars)
    list(links.on_scan(scan(0)))
    late = scan(1)
    assert list(links.on_scan(replace(late, frames=late.frames[:1], used=False))) == []


def test_a_module_is_set_up_streams_fails_and_streams_again() -> None:
    links = LinkStates(session_info(1).radars)
    states = [
        str(change.state)
        for changes in (
            links.on_log(line("tx SetMode")),
            links.on_log(line("rx Ack")),
            links.on_scan(scan(0, 1)),
            links.on_log(line("tx Ping")),
            links.on_log(line("fault CRC", warning=True)),
            links.on_scan(scan(1, 1)),
            links.end(2 * FRAME_NS),
        )
        for change in changes
    ]
    assert states == ["setting up", "streaming", "fault", "streaming", "ended"]
    assert links.counts["radar0"].faults == 1


def test_a_line_about_something_else_changes_no_lane() -> None:
    links = LinkStates(session_info(1).radars)
    assert list(links.on_log(line("stopped", warning=True, radar="odometry"))) == []


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_the_line_has_time_rate_error_landmarks_and_losses() -> None:
    now = [0.0]
    progress = RunProgress(session_info(), lambda: 3, end_ns=100 * FRAME_NS, clock=lambda: now[0])
    for counter in range(51):
        progress.on_scan(scan(counter))
    progress.on_snapshot(snapshot(50))
    now[0] = 0.5
    # 51 frames of each radar in half a second; the made-up estimate is 10 mm off
    assert progress.line() == (
        "scene time   10.0 of 19.9 s    102 frames/s per radar"
        "  pose error   10.0 mm  2 landmarks  3 frames lost"
    )


def test_plain_lines_come_every_ten_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    now, stream = [0.0], io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    progress = RunProgress(session_info(), lambda: 0, end_ns=FRAME_NS, clock=lambda: now[0])
    for counter in range(31):
        now[0] = float(counter)
        progress.on_scan(scan(counter))
    assert len(stream.getvalue().splitlines()) == 3
    progress.close()
    assert len(stream.getvalue().splitlines()) == 4
    assert "\r" not in stream.getvalue()


def test_a_terminal_gets_one_line_rewritten(monkeypatch: pytest.MonkeyPatch) -> None:
    now, stream = [0.0], Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    progress = RunProgress(session_info(), lambda: 0, end_ns=FRAME_NS, clock=lambda: now[0])
    for counter in range(20):
        now[0] = counter / 8
        progress.on_scan(scan(counter))
    progress.close()
    assert stream.getvalue().count("\n") == 1
    # every second scan is a quarter of a second after the last line, and one at the end
    assert stream.getvalue().count("\r\x1b[K") == 10


def test_a_warning_about_a_link_is_shown_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    progress = RunProgress(session_info(), lambda: 0, end_ns=FRAME_NS)
    progress.on_log(LogLine(t_ns=0, radar="left", warning=False, text="Ping"))
    progress.on_log(LogLine(t_ns=0, radar="left", warning=True, text="checksum"))
    assert stream.getvalue() == "warning: radar left: checksum\n"

"""A recorded session played to sinks, and through SLAM again: what is compared and said of it."""

import signal
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil_tests.unit.slam.app.sessions import (
    FRAME_NS,
    Listener,
    odometry,
    scan,
    session_info,
    smoothed_run,
    snapshot,
    write_scans,
    write_session,
)
from slam.app.run.replay import Comparison, paced, play_states, recorded_source
from slam.app.session.constants import different_constants, recorded_rules, slam_constants
from slam.config import WheelNoise, load_preset
from slam.live.session.description import settings_text
from slam.live.session.reader import open_session
from slam.live.session_records import Gap, LogLine, Scan, SessionObserver, Snapshot
from slam.robust.parameters import BackEndParameters, InitialisationRule, MapRule
from slam.robust.pipeline import RobustSlam
from xethru_protocol.operating_system import StopFlag, StopRequestedError

SETTINGS: dict[str, Any] = {
    "config_json": settings_text(load_preset("robust")),
    "wheels": asdict(WheelNoise()),
}
N_SCANS = 12


class Order(SessionObserver):
    def __init__(self) -> None:
        self.events: list[str] = []

    def on_scan(self, scan: Scan) -> None:
        self.events.append(f"scan {scan.counter}")

    def on_snapshot(self, snapshot: Snapshot) -> None:
        self.events.append(f"state {snapshot.counter}")

    def on_log(self, line: LogLine) -> None:
        self.events.append(line.text)

    def close(self) -> None:
        self.events.append("closed")


def test_sinks_get_scans_lines_and_states_in_the_order_of_the_file(tmp_path: Path) -> None:
    session = open_session(write_session(tmp_path / "session.mcap", N_SCANS, odometry(20)))
    listener, order = Listener(), Order()
    record = play_states(session, [listener, order], StopFlag())
    pairs = [f"{what} {counter}" for counter in range(N_SCANS) for what in ("scan", "state")]
    assert order.events == ["Ping -> Pong", *pairs, "CRC fault", "closed"]
    for counter, taken in enumerate(listener.scans):
        for frame, made in zip(taken.frames, scan(counter).frames, strict=True):
            assert frame.samples.tobytes() == made.samples.tobytes()
    expected = [snapshot(counter) for counter in range(N_SCANS)]
    states = record.states
    assert states.t_ns.tolist() == [counter * FRAME_NS for counter in range(N_SCANS)]
    for array, name in (
        (states.truth, "truth"),
        (states.odometry, "odometry"),
        (states.estimate, "estimate"),
        (states.pose_covariances, "pose_covariance"),
    ):
        np.testing.assert_array_equal(array, [getattr(state, name) for state in expected])
    assert record.last is listener.snapshots[-1]
    assert record.n_frames == 2 * N_SCANS
    assert (record.start_ns, record.duration_ns) == (0, (N_SCANS - 1) * FRAME_NS)


def test_a_signal_ends_it_and_sinks_are_closed(tmp_path: Path) -> None:
    session = open_session(write_session(tmp_path / "session.mcap", N_SCANS))
    order, stop = Order(), StopFlag()

    class Stopper(SessionObserver):
        def on_scan(self, scan: Scan) -> None:
            if scan.counter == 3:
                stop.received = signal.SIGINT

    with pytest.raises(StopRequestedError):
        play_states(session, [order, Stopper()], stop)
    assert order.events[-2:] == ["scan 3", "closed"]


def test_a_file_without_states_gives_a_record_without_states(tmp_path: Path) -> None:
    record = play_states(open_session(write_session(tmp_path / "session.mcap", 0)), [], StopFlag())
    assert record.last is None
    assert len(record.states) == 0
    assert record.states.truth.shape == (0, 3)
    assert not record.states.has_truth


def test_lost_frames_are_those_between_counters_of_one_stream(tmp_path: Path) -> None:
    info = replace(session_info(1), **SETTINGS)
    scans = []
    for tick, (counter, stream) in enumerate(((1, 0), (3, 0), (6, 1), (7, 1), (10, 1), (1, 2))):
        one = scan(tick, 1)
        frames = (replace(one.frames[0], counter=counter, stream=stream),)
        scans.append(replace(one, frames=frames))
    path = write_scans(tmp_path / "s.mcap", scans, odometry(20), info)
    source = recorded_source(open_session(path), StopFlag())
    assert [len(one.frames) for one in source.scans] == [1] * 6
    assert source.lost_frames() == 1 + 2


GAP = Gap(
    from_ns=12_300_000_000,
    to_ns=13_100_000_000,
    n_messages=40,
    scans=(61, 64),
    frames={"left": 4, "right": 1},
)


def compared(comparison: Comparison, *, other_from: int, n_states: int = 10) -> str:
    for counter in range(n_states):
        state = snapshot(counter)
        if counter >= other_from:
            state = replace(state, estimate=state.estimate + 1e-12)
        comparison.on_snapshot(state)
    return comparison.verdict()


def expecting(comparison: Comparison, gap_at: int | None = None, n_states: int = 10) -> Comparison:
    for counter in range(n_states):
        if counter == gap_at:
            comparison.expect(GAP)
        comparison.expect(snapshot(counter))
    return comparison


def test_states_behind_a_gap_are_not_held_against_the_processor() -> None:
    verdict = compared(expecting(Comparison(), gap_at=6), other_from=6)
    assert "all 6 recorded states before the first gap came again, to the last bit" in verdict
    assert "the other 4 cannot be compared" in verdict
    assert (
        "12.30 to 13.10 s (0.80 s): scans 61 to 64, 4 frames of left, 1 frame of right" in verdict
    )
    assert "processor" not in verdict


def test_states_that_differ_before_a_gap_are_still_named() -> None:
    verdict = compared(expecting(Comparison(), gap_at=6), other_from=4)
    assert "only 4 of 6 recorded states before the first gap came again" in verdict
    assert "the first other one at 0.797 s" in verdict
    assert "processor" in verdict


def test_a_gap_that_cost_no_state_costs_no_verdict() -> None:
    verdict = compared(expecting(Comparison(), gap_at=6), other_from=99)
    assert verdict == "all 10 recorded states came again, to the last bit"


@pytest.mark.parametrize(
    ("n_again", "is_same", "verdict"),
    [
        (10, True, ", and so did the smoothed path"),
        (
            10,
            False,
            "; the smoothed path did not: another version, or another processor's arithmetic?",
        ),
        (12, False, ""),  # recorded on request, before the run was killed
    ],
)
def test_the_last_smoothed_path_is_compared_where_it_ends_at_the_same_state(
    n_again: int, is_same: bool, verdict: str
) -> None:
    comparison = expecting(Comparison())
    comparison.expect(smoothed_run(4))
    comparison.expect(smoothed_run(10))
    again = smoothed_run(n_again)
    comparison.on_smoothed(again if is_same else replace(again, poses=again.poses + 1e-13))
    same = "all 10 recorded states came again, to the last bit"
    assert compared(comparison, other_from=99) == f"{same}{verdict}"


def test_numbers_that_differ_are_the_reason() -> None:
    different = [f"slam.robust.map.N{k} {k}, here {k + 1}" for k in range(13)]
    verdict = compared(expecting(Comparison(different)), other_from=4)
    assert "only 4 of 10 recorded states came again" in verdict
    assert "slam.robust.map.N9 9, here 10" in verdict
    assert "N10" not in verdict
    assert "and 3 more" in verdict
    assert "processor" not in verdict


def test_recorded_rules_are_taken_over_and_other_numbers_compared() -> None:
    recorded = slam_constants() | {
        "slam.robust.parameters.MapRule.refused_updates": 7,
        "slam.robust.parameters.ContinuationRule.view_margin_rad": 1.5,
        "slam.robust.parameters.MapRule.gone": 7.0,
        "slam.robust.branches._IDS_APART": 9,
    }
    del recorded["slam.front_end.matched_filter._REACH"]
    rules = recorded_rules(recorded)
    assert rules.map == replace(MapRule(), refused_updates=7)
    assert rules.continuation.view_margin_rad == 1.5
    assert rules.initialisation == BackEndParameters().initialisation
    assert different_constants(recorded) == [
        "slam.front_end.matched_filter._REACH none, here 3.0",
        "slam.robust.branches._IDS_APART 9, here 1000",
        "slam.robust.parameters.MapRule.gone 7.0, here none",
    ]


def test_an_old_session_has_no_numbers_that_differ() -> None:
    assert different_constants({}) == []
    assert recorded_rules({}) == BackEndParameters()


def test_numbers_of_another_kind_are_not_taken_over() -> None:
    wrong = {"slam.robust.parameters.MapRule.refused_updates": "many"}
    assert recorded_rules(wrong) == BackEndParameters()


def test_a_replay_has_the_recorded_rules(tmp_path: Path) -> None:
    constants = {"slam.robust.parameters.InitialisationRule.window": 21}
    info = replace(session_info(), **SETTINGS, constants=constants)
    session = write_session(tmp_path / "session.mcap", 3, odometry(9), info)
    slam = recorded_source(open_session(session), StopFlag()).slam
    assert isinstance(slam, RobustSlam)
    assert slam.back_end.parameters.initialisation == InitialisationRule(window=21)
    assert slam.back_end.parameters.map == MapRule()


class VirtualTime:
    """A clock that goes on while somebody sleeps; `work` passes time otherwise."""

    def __init__(self) -> None:
        self.now_s, self.longest_s = 1000.0, 0.0

    def __call__(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.longest_s = max(self.longest_s, seconds)
        self.now_s += seconds


@pytest.mark.parametrize(
    ("rate", "stamps_s", "work_s", "due_s"),
    [
        (1.0, [5.0, 5.2, 5.4], {}, [0.0, 0.2, 0.4]),
        (4.0, [5.0, 5.2, 6.0], {}, [0.0, 0.05, 0.25]),
        (0.5, [0.0, 1.0], {}, [0.0, 2.0]),
        # late ones at once, and then in step again
        (1.0, [0.0, 1.0, 2.0, 3.0, 4.0], {1: 2.5}, [0.0, 1.0, 3.5, 3.5, 4.0]),
        # time that falls, and a gap of more than ten seconds, begin anew
        (1.0, [100.0, 101.0, 3.0, 4.0], {}, [0.0, 1.0, 1.0, 2.0]),
        (1.0, [0.0, 9.0, 1000.0, 1001.0], {}, [0.0, 9.0, 9.0, 10.0]),
        (2.0, [0.0, 19.0, 20.0], {}, [0.0, 9.5, 10.0]),
    ],
)
def test_scans_come_when_they_are_due(
    rate: float, stamps_s: list[float], work_s: dict[int, float], due_s: list[float]
) -> None:
    clock = VirtualTime()
    scans = [Scan(counter=k, t_ns=round(1e9 * t_s), frames=()) for k, t_s in enumerate(stamps_s)]
    came_s = []
    for one in paced(scans, rate, StopFlag(), clock, clock.sleep):
        came_s.append(clock.now_s - 1000.0)
        clock.now_s += work_s.get(one.counter, 0.0)
    assert came_s == pytest.approx(due_s)
    assert clock.longest_s <= 0.2  # a signal is noticed soon


def test_a_signal_ends_the_wait_for_a_scan() -> None:
    stop, clock = StopFlag(), VirtualTime()
    scans = [Scan(counter=k, t_ns=9 * k * 10**9, frames=()) for k in range(2)]
    coming = paced(scans, 1.0, stop, clock, clock.sleep)
    next(coming)
    stop.received = signal.SIGTERM
    with pytest.raises(StopRequestedError):
        next(coming)
    assert clock.now_s < 1001.0

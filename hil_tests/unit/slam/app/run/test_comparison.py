"""What `replay` says of the states that it compares with the recorded ones."""

from dataclasses import asdict, replace
from pathlib import Path

import pytest

from hil_tests.unit.slam.app.sessions import (
    odometry,
    session_info,
    smoothed_run,
    snapshot,
    write_session,
)
from slam.app.records import Gap
from slam.app.run.replay import Comparison, recorded_source
from slam.app.session.constants import different_constants, recorded_rules, slam_constants
from slam.app.session.messages import settings_text
from slam.app.session.reader import open_session
from slam.config import WheelNoise, load_preset
from slam.robust.parameters import BackEndParameters, MapRule, TrackletRule
from slam.robust.pipeline import RobustSlam
from xethru_protocol.system import StopFlag

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
            comparison.expect_gap(GAP)
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
    comparison.expect_smoothed(smoothed_run(4))
    comparison.expect_smoothed(smoothed_run(10))
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
        "slam.robust.parameters.ContinuationRule.view_sigmas": 1.5,
        "slam.robust.parameters.MapRule.gone": 7.0,
        "slam.robust.branches._IDS_APART": 9,
    }
    del recorded["slam.front_end.matched_filter._REACH"]
    rules = recorded_rules(recorded)
    assert rules.map == replace(MapRule(), refused_updates=7)
    assert rules.continuation.view_sigmas == 1.5
    assert rules.tracklets == BackEndParameters().tracklets
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
    info = replace(
        session_info(),
        config_json=settings_text(load_preset("robust")),
        wheels=asdict(WheelNoise()),
        constants={"slam.robust.parameters.TrackletRule.window": 21},
    )
    session = write_session(tmp_path / "session.mcap", 3, odometry(9), info)
    slam = recorded_source(open_session(session), StopFlag()).slam
    assert isinstance(slam, RobustSlam)
    assert slam.back_end.parameters.tracklets == TrackletRule(window=21)
    assert slam.back_end.parameters.map == MapRule()

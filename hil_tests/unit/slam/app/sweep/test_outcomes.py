"""Lost and found after a carry, confidently wrong, false landmarks: on made-up runs."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.scene.scene import ObjectSpec, Scene, TargetSpec, WallSpec, empty_room
from hil_tests.unit.slam.app.sweep.sweep_runs import run_of
from slam.app.run.runner import RunRecord, States
from slam.app.sweep.outcomes import (
    CarryOutcome,
    carry_of,
    confidently_wrong,
    distance_m,
    false_landmarks,
)
from slam.app.sweep.run import SweepRun, make_case
from slam.app.sweep.statistics import outcomes, summarise_groups
from slam.geometry import paper_rig
from slam.live.session_records import RadarInfo, SessionInfo, Snapshot

S = 1_000_000_000
DOWN_NS = 10 * S


def record_of(
    estimate: NDArray[np.float64],
    truth: NDArray[np.float64],
    lost: NDArray[np.bool_] | None = None,
) -> RunRecord:
    """Return a run of a state per second; the map frame is the world's."""
    n = len(truth)
    states = States(
        t_ns=np.arange(n) * S,
        truth=truth,
        odometry=np.zeros((n, 3)),
        estimate=estimate,
        pose_covariances=np.repeat(np.eye(3)[np.newaxis], n, axis=0),
        nis=np.zeros(n),
        nis_dof=np.zeros(n, dtype=np.int32),
        lost=np.zeros(n, dtype=bool) if lost is None else lost,
    )
    return RunRecord(states=states, last=None, n_frames=n, duration_ns=n * S, wall_s=1.0)


def info_of(landmarks_m: Sequence[tuple[float, float]]) -> SessionInfo:
    radars: tuple[RadarInfo, ...] = ()
    return SessionInfo(
        scene="a",
        preset="robust",
        seed=0,
        radars=radars,
        true_landmarks_m=np.array(landmarks_m).reshape(-1, 2),
        versions={},
    )


# the robot drives along x at 0.1 m/s; the paper's rig looks left, and a landmark 0.8 m to the left
# comes into view of 65 degrees when it is less than 0.4 m ahead of an antenna
TRUTH = np.column_stack([0.1 * np.arange(60), np.zeros(60), np.zeros(60)])
LANDMARKS = [(1.0, 1.0), (2.0, 1.0), (3.0, 1.0)]


def found(
    wrong_until: int, lost_until: int, landmarks: Sequence[tuple[float, float]]
) -> CarryOutcome:
    """Return the outcome if the estimate is 1 m off, and lost, until these states."""
    estimate = TRUTH.copy()
    estimate[:wrong_until, 1] += 1.0
    lost = np.arange(60) < lost_until
    carry = carry_of(record_of(estimate, TRUTH, lost), DOWN_NS, info_of(landmarks), paper_rig())
    assert carry is not None
    return carry


def test_a_robot_is_found_when_its_pose_is_right_and_not_reported_as_lost() -> None:
    carry = found(25, 30, LANDMARKS)
    assert carry.found_s == 20.0  # state 30, 10 s after which it was set down
    # at 2.6 m, state 26: 0.1 m ahead of the base stands the front antenna
    assert carry.three_seen_s is not None
    assert 2.4 <= 0.1 * (carry.three_seen_s + 10) <= 2.7
    assert carry.in_time is True
    late = found(48, 0, LANDMARKS)
    assert late.found_s == 38.0
    assert late.in_time is False


def test_a_place_that_is_right_for_a_moment_is_not_found() -> None:
    estimate = TRUTH.copy()
    estimate[:, 0] += 0.5
    estimate[20:24, 0] -= 0.5
    carry = carry_of(record_of(estimate, TRUTH), DOWN_NS, info_of(LANDMARKS), paper_rig())
    assert carry is not None
    assert carry.found_s is None
    assert carry.in_time is False


def test_fewer_than_three_landmarks_in_view_give_no_result() -> None:
    assert found(25, 0, LANDMARKS[:2]).in_time is None
    empty = record_of(TRUTH[:5], TRUTH[:5])
    assert carry_of(empty, DOWN_NS, info_of(LANDMARKS), paper_rig()) is None


def wrong_share(errors_m: Sequence[float], sigma_m: float, lost: Sequence[int] = ()) -> float:
    """Return the share of ten states, each off by an error across the way, that count as wrong."""
    truth = TRUTH[: len(errors_m)]
    estimate = truth + np.column_stack([np.zeros(len(errors_m)), errors_m, np.zeros(len(errors_m))])
    is_lost = np.isin(np.arange(len(errors_m)), lost)
    record = record_of(estimate, truth, is_lost)
    record.states.pose_covariances[:, :2, :2] = sigma_m**2 * np.eye(2)
    return confidently_wrong(record, None, None)


def test_a_position_is_wrong_beyond_15_cm_and_999_of_1000_errors() -> None:
    """The radius of 99.9 % of a normal error in the plane is sigma sqrt(2 ln 1000)."""
    radius = math.sqrt(2 * math.log(1000))
    errors = [0.0] * 8
    assert wrong_share([*errors, 0.16, 0.14], 0.01) == pytest.approx(0.1)
    limit = 0.1 * radius
    assert wrong_share([*errors, 1.001 * limit, 0.999 * limit], 0.1) == pytest.approx(0.1)
    assert wrong_share([*errors, 1.0, 1.0], 0.01, lost=[8]) == pytest.approx(0.1)


def test_after_a_carry_states_count_from_20_s_after_the_third_landmark() -> None:
    estimate = TRUTH + np.array([0.0, 1.0, 0.0])
    record = record_of(estimate, TRUTH)
    record.states.pose_covariances[:] = 1e-4 * np.eye(3)
    carried_ns = (8 * S, DOWN_NS)
    seen = CarryOutcome(three_seen_s=16.0, found_s=None)
    # eight states before, those from 10 + 16 + 20 = 46 s on
    share = confidently_wrong(record, carried_ns, seen)
    assert share == pytest.approx((8 + 14) / 60)
    never = CarryOutcome(three_seen_s=None, found_s=None)
    assert confidently_wrong(record, carried_ns, never) == pytest.approx(8 / 60)


RUN: SweepRun = replace(run_of(make_case("lab", "paper", 0)), ate_rmse_m=0.01)


def test_runs_that_failed_are_counted() -> None:
    carried = CarryOutcome(three_seen_s=1.0, found_s=30.0)
    runs = [
        RUN,
        replace(RUN, seed=1, ate_rmse_m=0.08, lost_share=0.1),
        replace(RUN, seed=2, lost_share=0.2, lost_at_end=True, carry=carried),
        replace(RUN, seed=3, carry=replace(carried, found_s=20.0)),
        replace(
            RUN, seed=4, carry=replace(carried, three_seen_s=None), confidently_wrong_share=0.25
        ),
    ]
    assert outcomes(runs) == {
        "runs": 5,
        "runs_below_odometry": 4,
        "runs_above_odometry": 1,
        "runs_lost": 1,
        "runs_lost_at_end": 1,
        "runs_harmed": 1,
        "runs_confidently_wrong": 1,
        "confidently_wrong_share": pytest.approx(0.05),
        "carries": 2,
        "carries_in_time": 1,
    }
    (group,) = summarise_groups(runs)
    # of 0.01 / 0.04 four times, and 2
    assert group["ratio"]["median"] == pytest.approx(0.25)
    # 95 % of means of five chi-squares of 3 dof: quantiles of 15 dof over 5, 6.262 and 27.488
    assert group["anees_band_95"] == pytest.approx([6.262 / 5, 27.488 / 5], rel=1e-3)


ROOM: Scene = empty_room().model_copy(
    update={
        "targets": (
            TargetSpec(name="rod", kind="rod", x_m=1.0, y_m=2.0),
            TargetSpec(name="pillar", kind="cylinder", x_m=-3.0, y_m=0.0, radius_m=0.5),
        ),
        "walls": (WallSpec(name="wall", from_m=(5.0, -1.0), to_m=(5.0, 1.0)),),
        "objects": (
            ObjectSpec(name="box", x_m=0.0, y_m=-4.0, width_m=2.0, depth_m=1.0, yaw_deg=90.0),
        ),
    }
)


@pytest.mark.parametrize(
    ("x_m", "y_m", "far_m"),
    [
        (1.0, 2.1, 0.1),
        (-3.0, 0.3, 0.2),
        (5.3, 0.9, 0.3),
        (5.3, 1.4, 0.5),
        # the box stands on end: 1 m wide along x, 2 m along y
        (0.6, -4.0, 0.1),
        (0.0, -2.7, 0.3),
    ],
)
def test_distance_to_what_reflects(x_m: float, y_m: float, far_m: float) -> None:
    assert distance_m(ROOM, np.array([x_m, y_m])) == pytest.approx(far_m)


def test_nothing_is_infinitely_far_in_an_empty_room() -> None:
    assert distance_m(empty_room(), np.zeros(2)) == math.inf


def state(places: list[tuple[float, float]], sigmas: list[tuple[float, float]]) -> Snapshot:
    return Snapshot(
        counter=0,
        t_ns=0,
        truth=np.zeros(3),
        odometry=np.zeros(3),
        estimate=np.zeros(3),
        world_from_map=np.array([1.0, 0.0, math.pi / 2]),
        pose_covariance=np.zeros((3, 3)),
        landmark_ids=np.arange(len(places)),
        landmarks_m=np.array(places),
        landmark_covariances_m2=np.array([np.diag(pair) ** 2 for pair in sigmas]),
        nis_per_dof=(),
    )


def test_false_ones_are_counted_in_the_world_and_by_their_worst_direction() -> None:
    # map (2, 0) is world (1, 2), where the rod stands
    places = [(2.1, 0.0), (2.2, 0.0), (2.2, 0.0), (-9.0, 9.0)]
    sigmas = [(0.01, 0.01), (0.01, 0.04), (0.01, 0.06), (0.2, 0.2)]
    assert false_landmarks(state(places, sigmas), ROOM) == (3, 1)

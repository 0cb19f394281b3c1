"""The row of a step is what its description says, and a step comes back from it."""

import math
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from hil_tests.unit.slam.app.sessions import scan, session_info, snapshot
from slam.app.session.writer import SessionLog
from slam.frames import Detection
from slam.live.errors import AppError
from slam.live.session.reader import open_session
from slam.live.session.state_rows import step_row, with_step
from slam.live.session_records import Snapshot
from slam.results import (
    Association,
    Belief,
    Fix,
    LaggedPose,
    Observation,
    PredictedRange,
    StepResult,
    UpdateReport,
)

LATE_NS = 1_700_000_000_123_456_789
"""A time of day, which float64 cannot hold to the nanosecond."""


def belief_of(state: Snapshot) -> Belief:
    covariance = np.zeros((7, 7))
    covariance[:3, :3] = state.pose_covariance
    covariance[3:5, 3:5], covariance[5:, 5:] = state.landmark_covariances_m2
    return Belief(
        mean=np.concatenate([state.estimate, state.landmarks_m.ravel()]),
        covariance=covariance,
        landmark_ids=(3, 8),
        next_id=9,
    )


def ranges(t_ns: int) -> tuple[Detection, ...]:
    return (
        Detection(radar=0, t_ns=t_ns + 5, range_m=0.5, amplitude=0.01, phase_rad=-2.0, misfit=1.5),
        Detection(radar=1, t_ns=t_ns - 7, range_m=0.75, amplitude=0.02, sigma_m=0.002),
        Detection(radar=1, t_ns=t_ns, range_m=1 / 3, amplitude=0.03, saturated=True),
    )


def robust_state(t_ns: int = 77) -> Snapshot:
    state = replace(snapshot(7), t_ns=t_ns, wall_spans_m=np.arange(8.0).reshape(2, 2, 2))
    expected = PredictedRange(
        radar=1, landmark_id=8, range_m=0.8, variance=1e-4, antenna_m=(0.1, 0.2), point_m=(1.0, 2.0)
    )
    report = UpdateReport(
        continued=((1, 0, 8), (1, 1, 3)), nis=2.5, dof=2, predicted=(expected,), lost=True
    )
    step = StepResult(
        t_ns=t_ns,
        odometry_pose=state.odometry,
        belief=belief_of(state),
        detections=ranges(t_ns),
        report=report,
        range_sigmas_m=(math.inf, 0.003, 0.004),
        lagged=tuple(
            LaggedPose(
                t_ns=t_ns - back_ns,
                pose=np.array([0.1, -0.2, 3.0]),
                covariance=np.diag([1e-6, 2e-6, 3e-6]) + 1e-7,
            )
            for back_ns in (60, 40)
        ),
    )
    return replace(state, step=step)


def papers_state(t_ns: int = 77) -> Snapshot:
    state = replace(snapshot(7), t_ns=t_ns)
    seen = ranges(t_ns)
    fixes = (
        Fix(pair=2, t_ns=t_ns + 1, x_m=0.3, y_m=0.9, detections=(seen[0], seen[1])),
        Fix(pair=2, t_ns=t_ns + 2, x_m=0.1, y_m=0.4, detections=(seen[0], seen[2])),
    )
    of_another_state = replace(fixes[0], t_ns=t_ns + 10**9)
    step = StepResult(
        t_ns=t_ns,
        odometry_pose=state.odometry,
        belief=belief_of(state),
        detections=seen,
        fixes=fixes,
        observations=(
            Observation(x_m=0.31, y_m=0.91, n_poses=5, fixes=(fixes[0], of_another_state)),
            Observation(x_m=2.0, y_m=3.0, n_poses=4, fixes=()),
        ),
        associations=(
            Association(
                landmark_id=3,
                is_new=False,
                mahalanobis_sq=np.array([1.25, math.inf]),
                candidate_ids=(3, 8),
            ),
            Association(
                landmark_id=8, is_new=True, mahalanobis_sq=np.array([50.0]), candidate_ids=(3,)
            ),
        ),
        rejected=(fixes[1],),
    )
    return replace(state, step=step)


NAN = math.nan
# fmt: off
ROBUST_ROW = [
    3, 0, 0, 0, 2, 1, 2,  1, 1, 9,  2.5, 2, 0, 1,
    0, 5, 0.5, 0.01, -2.0, NAN, 1.5, 0, math.inf,
    1, -7, 0.75, 0.02, NAN, 0.002, NAN, 0, 0.003,
    1, 0, 1 / 3, 0.03, NAN, NAN, NAN, 1, 0.004,
    1, 0, 8,  1, 1, 3,
    1, 8, 0.8, 1e-4, 0.1, 0.2, 1.0, 2.0,
    0, 1, 2, 3,  4, 5, 6, 7,
    -60, 0.1, -0.2, 3.0,  1.1e-6, 1e-7, 1e-7, 1e-7, 2.1e-6, 1e-7, 1e-7, 1e-7, 3.1e-6,
    -40, 0.1, -0.2, 3.0,  1.1e-6, 1e-7, 1e-7, 1e-7, 2.1e-6, 1e-7, 1e-7, 1e-7, 3.1e-6,
]
PAPERS_ROW = [
    3, 2, 2, 1, 0, 0, 0,  0, 0, 9,  0, 0, 0, 0,
    0, 5, 0.5, 0.01, -2.0, NAN, 1.5, 0, 0,
    1, -7, 0.75, 0.02, NAN, 0.002, NAN, 0, 0,
    1, 0, 1 / 3, 0.03, NAN, NAN, NAN, 1, 0,
    2, 1, 0.3, 0.9, 0, 1,
    2, 2, 0.1, 0.4, 0, 2,
    0.31, 0.91, 5, 3, 0, 2, 1,  3, 1.25, 8, math.inf,  0,
    2.0, 3.0, 4, 8, 1, 1, 0,  3, 50.0,
    1,
]
# fmt: on


@pytest.mark.parametrize("t_ns", [77, LATE_NS])
@pytest.mark.parametrize(
    ("make", "expected"), [(robust_state, ROBUST_ROW), (papers_state, PAPERS_ROW)]
)
def test_the_file_holds_the_row_that_is_described(
    make: Callable[[int], Snapshot], expected: list[float], t_ns: int, tmp_path: Path
) -> None:
    path = tmp_path / "s.mcap"
    state = make(t_ns)
    log = SessionLog(path, session_info(), start_ns=t_ns)
    log.on_snapshot(state)
    log.on_snapshot(replace(state, step=None, t_ns=t_ns + 10**9))
    log.close()
    with path.open("rb") as stream:
        rows = list(make_reader(stream).iter_messages(topics=["/slam/step"]))
    ((schema, _, message),) = rows
    assert schema is not None
    assert (schema.name, message.log_time) == ("std_msgs/msg/Float64MultiArray", t_ns)
    found = message.data[-8 * len(expected) :]
    np.testing.assert_array_equal(struct.unpack(f"<{len(expected)}d", found), expected)
    (count,) = struct.unpack_from("<I", message.data, len(message.data) - 8 * len(expected) - 4)
    assert count == len(expected)
    with_it, without = (r for r in open_session(path).records() if isinstance(r, Snapshot))
    assert without.step is None
    assert with_it.wall_spans_m.tolist() == state.wall_spans_m.tolist()
    assert_same_step(with_it.step, state.step)


def assert_same_step(found: StepResult | None, sent: StepResult | None) -> None:
    """Compare all but what a session lacks: other states' fixes, covariances, evidence."""
    assert found is not None
    assert sent is not None
    assert (found.t_ns, found.odometry_pose.tolist()) == (sent.t_ns, sent.odometry_pose.tolist())
    if sent.report is not None:
        sent = replace(sent, report=replace(sent.report, evidence=()))
    for name in ("detections", "fixes", "rejected", "report", "range_sigmas_m"):
        assert repr(getattr(found, name)) == repr(getattr(sent, name))  # NaN is not itself
    own = {repr(fix) for fix in sent.fixes}
    kept = tuple(
        replace(one, fixes=tuple(fix for fix in one.fixes if repr(fix) in own))
        for one in sent.observations
    )
    assert repr(found.observations) == repr(kept)
    assert repr(found.associations) == repr(sent.associations)
    assert found.belief.mean.tolist() == sent.belief.mean.tolist()
    assert found.belief.landmark_ids == sent.belief.landmark_ids
    assert found.belief.next_id == sent.belief.next_id
    assert found.belief.pose_covariance.tolist() == sent.belief.pose_covariance.tolist()
    for row in range(len(sent.belief.landmark_ids)):
        assert (
            found.belief.landmark_covariance(row).tolist()
            == sent.belief.landmark_covariance(row).tolist()
        )
    assert np.isnan(found.belief.covariance[0, 3:]).all()  # unknown, not zero


def test_the_ranges_of_a_fix_are_those_of_the_step() -> None:
    """A view draws a range as used by whether it is, itself, in an observation."""
    state = papers_state()
    assert state.step is not None
    found = with_step(replace(state, step=None), step_row(state.step, state.wall_spans_m)).step
    assert found is not None
    assert found.observations[0].fixes[0] is found.fixes[0]
    assert found.fixes[0].detections[1] is found.detections[1]
    assert found.rejected[0] is found.fixes[1]


def test_a_row_of_another_length_or_with_wrong_counts_is_an_error() -> None:
    for make, expected in ((robust_state, ROBUST_ROW), (papers_state, PAPERS_ROW)):
        state = make()
        right = np.array(expected, dtype=np.float64)
        for wrong in (right[:-1], np.append(right, 0.0), right[:5], right[:0]):
            with pytest.raises(ValueError, match="whose counts need"):
                with_step(state, wrong)
        for place, value in ((0, -1.0), (0, 0.5), (0, math.inf), (0, NAN), (2, 1e18)):
            wrong = right.copy()
            wrong[place] = value
            with pytest.raises(ValueError, match=r"count|names number"):
                with_step(state, wrong)
    wrong = np.array(PAPERS_ROW)
    wrong[-1] = 2.0  # of two fixes the third was rejected
    with pytest.raises(ValueError, match="number 2 of 2"):
        with_step(papers_state(), wrong)


def test_a_damaged_row_names_the_file_and_the_time(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    state = robust_state()
    assert state.step is not None
    beyond = replace(state.step.detections[0], radar=math.inf)  # type: ignore[arg-type]  # damage
    log = SessionLog(path, session_info())
    log.on_snapshot(replace(state, step=replace(state.step, detections=(beyond,) * 3)))
    log.close()
    with pytest.raises(AppError, match=r"s\.mcap: a message of /slam/state at 0\.000 s cannot be"):
        list(open_session(path).records())


def test_a_step_without_its_own_ranges_is_refused() -> None:
    state = papers_state()
    assert state.step is not None
    with pytest.raises(ValueError, match="not of its own ranges"):
        step_row(replace(state.step, detections=()), state.wall_spans_m)


def test_the_stream_of_every_frame_comes_back(tmp_path: Path) -> None:
    """Also in the topic, which other programs read; stream 0 needs none."""
    path = tmp_path / "s.mcap"
    streams = [(0, 0), (0, 1), (2, 1), (2, 1)]
    log = SessionLog(path, session_info())
    for tick, numbers in enumerate(streams):
        one = scan(tick)
        pairs = zip(one.frames, numbers, strict=True)
        frames = tuple(replace(frame, stream=number) for frame, number in pairs)
        log.on_scan(replace(one, frames=frames))
    log.close()
    found = [tuple(f.stream for f in one.frames) for one in open_session(path).scans()]
    assert found == streams
    with path.open("rb") as stream:
        rows = [
            (channel.topic, message.log_time, message.data[4:])
            for _, channel, message in make_reader(stream).iter_messages()
            if channel.topic.endswith("/stream")
        ]
    assert rows == [
        ("/radar/radar1/stream", scan(1).t_ns, struct.pack("<I", 1)),
        ("/radar/radar0/stream", scan(2).t_ns, struct.pack("<I", 2)),
    ]

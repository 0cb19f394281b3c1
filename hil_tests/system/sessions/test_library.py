"""A loop of your own around `Slam` makes the states of a recorded session again, bit by bit."""

from pathlib import Path

import numpy as np
import pytest

from hil_tests.system.recorded_session import record_session
from slam import Slam
from slam.live import open_session
from slam.live.session_records import Snapshot

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("preset", ["robust", pytest.param("paper", marks=pytest.mark.rare)])
def test_a_loop_of_its_own_makes_the_recorded_states_again(preset: str, tmp_path: Path) -> None:
    record = record_session(path := tmp_path / "session.mcap", preset)
    session = open_session(str(path))
    expected = [one for one in session.records() if isinstance(one, Snapshot)]
    assert len(expected) == len(record.states) > 30
    with session as scans:
        slam = Slam(session.rig, session.config, wheels=session.wheels)
        n_states = 0
        for scan in scans:
            state = slam.step(scan.t_ns, scan.odometry, frames=scan)
            assert state.t_ns == scan.t_ns
            for result in state.results:
                recorded = expected[n_states]
                n_states += 1
                assert result.t_ns == recorded.t_ns
                assert result.belief.pose.tobytes() == recorded.estimate.tobytes()
                assert result.belief.pose_covariance.tobytes() == recorded.pose_covariance.tobytes()
                if result.t_ns == scan.t_ns:
                    assert state.pose.tobytes() == recorded.estimate.tobytes()
                    assert state.covariance.tobytes() == recorded.pose_covariance.tobytes()
    assert n_states == len(expected)
    marks, last = slam.landmarks, expected[-1]
    assert marks.ids == tuple(last.landmark_ids.tolist())
    assert len(marks) > 0
    assert marks.positions_m.tobytes() == last.landmarks_m.tobytes()
    assert marks.covariances_m2.tobytes() == last.landmark_covariances_m2.tobytes()
    smoothed = slam.smoothed()
    if preset == "paper":
        assert smoothed is None
        return
    assert smoothed is not None
    assert record.smoothed is not None
    assert smoothed.poses.tobytes() == record.smoothed.poses.tobytes()
    assert np.array_equal(smoothed.t_ns, record.smoothed.t_ns)


def test_the_pose_of_a_scan_alone_is_enough(tmp_path: Path) -> None:
    """With odometry between scans only: near the same path."""
    record = record_session(path := tmp_path / "session.mcap", "robust")
    session = open_session(path)
    slam = Slam(session.rig, session.config, wheels=session.wheels)
    for scan in session:
        newest_ns = max(frame.t_ns for frame in scan)
        assert scan.odometry is not None
        state = slam.step(newest_ns, scan.odometry(newest_ns), frames=scan)
    assert record.last is not None
    assert state.pose == pytest.approx(record.last.estimate, abs=0.01)

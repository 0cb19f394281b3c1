"""Sinks get from a session what the run gave them, in the same order, and a record of it."""

import signal
from pathlib import Path

import numpy as np
import pytest

from hil_tests.unit.slam.app.sessions import (
    FRAME_NS,
    Listener,
    odometry,
    scan,
    session_info,
    snapshot,
    write_session,
)
from slam.app.records import LogLine, Scan, SessionObserver, Snapshot
from slam.app.run.recorded import play_states
from slam.app.run.runner import LostFrames
from slam.app.session.reader import open_session
from xethru_protocol.system import StopFlag, StopRequestedError

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


def test_frames_missing_between_counters_are_lost_and_a_new_stream_loses_none() -> None:
    lost = LostFrames()
    for counter in (5, 6, 9, 1, 2):
        lost.on_scan(scan(counter, len(session_info().radars), n_bins=4))
    assert lost.n_lost == 2 * 2

"""What a run keeps of every state: numbers in packed arrays, none of them of the map."""

import gc
import tracemalloc
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from numpy.typing import NDArray

from hil_tests.unit.slam.app.sessions import FRAME_NS, NoSlam, scan, session_info, source_of_scans
from slam.app.commands.report import _ReportData
from slam.app.odometry.live import LiveOdometry
from slam.app.run.runner import execute
from slam.app.session.writer import SessionLog
from slam.app.view.session_view import RerunView
from slam.frames import RadarFrame
from slam.live.arrival_clock import ClockLine
from slam.live.odometry_track import NS_PER_S, OdometryTrack, TumSample, format_tum_line
from slam.live.session_records import Scan, SessionObserver
from slam.results import Belief, PoseAt, StepResult, UpdateReport

BLOCK = 128
"""States that a view collects before it sends them."""
N_BINS = 64


class FullMap(NoSlam):
    """Estimates a state with a map of so many landmarks at every scan."""

    def __init__(self, n_landmarks: int) -> None:
        self._ids = tuple(range(n_landmarks))

    def step(
        self, frames: Sequence[RadarFrame], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        pose = pose_at(t_ns)
        size = 3 + 2 * len(self._ids)
        belief = Belief(
            mean=np.concatenate([pose, np.zeros(size - 3)]),
            covariance=1e-4 * np.eye(size),
            landmark_ids=self._ids,
            next_id=len(self._ids),
        )
        report = UpdateReport(continued=(), nis=0.0, dof=0)
        return (
            StepResult(t_ns=t_ns, odometry_pose=pose, belief=belief, detections=(), report=report),
        )


def along_x(stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    x_m = 0.05e-9 * stamps_ns
    return np.column_stack([x_m, np.zeros(len(x_m)), np.zeros(len(x_m))])


@pytest.mark.parametrize("n_landmarks", [14, pytest.param(70, marks=pytest.mark.rare)])
def test_what_a_run_keeps_of_a_state_does_not_grow_with_the_map(
    n_landmarks: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few hundred bytes of numbers, and what sinks hold back of the last states.

    The covariance alone has 8 kB with 14 landmarks and 164 kB with 70.
    """
    # Left out is what does not grow with the run: the frames of the report's picture of echoes, and
    # up to 4 MB of rows that Rerun collects before it writes them. With a tick of 0 its thread
    # would use a core until the process ends.
    monkeypatch.setattr("slam.app.commands.report._ECHO_ROWS", 2)
    monkeypatch.setattr(
        "slam.app.view.rerun_recording._FILE_BATCHES",
        rr.ChunkBatcherConfig(flush_tick=10.0, flush_num_bytes=0),
    )
    made = session_info(1)
    info = replace(made, radars=(replace(made.radars[0], n_bins=N_BINS),))
    ends = [along_x(np.array([t_ns]))[0] for t_ns in (0, 10**12)]
    track = OdometryTrack.from_lines(map(format_tum_line, (0, 10**12), ends))
    # Packed arrays, whose buffers double, grow by as many rows in between as there are states.
    first, last = BLOCK + 1, 3 * BLOCK + 1
    sizes: list[int] = []
    now_ns = [0]

    def scans() -> Iterator[Scan]:
        for counter in range(last + 1):
            now_ns[0] = counter // BLOCK * NS_PER_S  # a chunk ends with a block
            if counter == first - 8:  # so that the last state is among what is traced
                tracemalloc.start()
            if counter in (first, last):
                gc.collect()
                sizes.append(tracemalloc.get_traced_memory()[0])
            yield scan(counter, 1, N_BINS)

    log = SessionLog(
        tmp_path / "session.mcap", info, track, truth_at=along_x, clock_ns=lambda: now_ns[0]
    )
    sinks: list[SessionObserver] = [log, _ReportData(info)]
    if n_landmarks < 50:  # drawing more takes long, and keeps no more
        sinks.append(RerunView(tmp_path / "session.rrd", info))
    try:
        record = execute(source_of_scans(scans(), track, FullMap(n_landmarks), along_x), sinks)
    finally:
        # Behind the end of Rerun's threads: one that frees memory while tracing stops could end
        # the process (CPython issue 128679).
        tracemalloc.stop()
    assert len(record.states) == last + 1
    early, late = sizes
    assert late - early < 2200 * (last - first)


def test_the_odometry_of_a_live_run_is_kept_as_long_as_scans_ask_for_it() -> None:
    odometry = LiveOdometry("the test", ClockLine(origin_ns=0))
    period_ns = NS_PER_S // 50
    tracemalloc.start()
    try:
        for number in range(6_000):
            t_ns = number * period_ns
            odometry.take(format_tum_line(t_ns, along_x(np.array([t_ns]))[0]), t_ns)
            if number == 1_000:
                early, _ = tracemalloc.get_traced_memory()
            odometry.forget_before(t_ns - NS_PER_S)
        late, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert late - early < 10_000
    newest_ns = 5_999 * period_ns
    for asked_ns in (newest_ns - NS_PER_S, newest_ns - NS_PER_S // 3, newest_ns):
        assert odometry.is_known(asked_ns)
        np.testing.assert_allclose(odometry.pose_at(asked_ns), along_x(np.array([asked_ns]))[0])
    assert not odometry.is_known(newest_ns - 10 * NS_PER_S)


def test_a_sample_of_odometry_costs_six_numbers() -> None:
    """Of eight bytes each; an eighth of them waits for more to come."""
    period_ns = NS_PER_S // 50
    tracemalloc.start()
    try:
        track = OdometryTrack(
            TumSample(t_ns=number * period_ns, x_m=1e-3 * number, y_m=0.0, qz=0.0, qw=1.0)
            for number in range(20_000)
        )
        grown, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(track) == 20_000
    assert grown < 1.15 * 20_000 * 48


def test_a_parked_robot_costs_a_run_next_to_nothing() -> None:
    """SLAM estimates no state then, and the scans' counters wait for one."""
    track = OdometryTrack.from_lines([format_tum_line(t, np.zeros(3)) for t in (0, 10**13)])
    one = scan(0, 1, N_BINS)
    sizes: list[int] = []

    def scans() -> Iterator[Scan]:
        for counter in range(5_001):
            if counter in (1_000, 5_000):
                sizes.append(tracemalloc.get_traced_memory()[0])
            yield replace(one, counter=counter, t_ns=counter * FRAME_NS)

    tracemalloc.start()
    try:
        execute(source_of_scans(scans(), track, NoSlam(), along_x))
    finally:
        tracemalloc.stop()
    early, late = sizes
    assert late - early < 40 * 4_000

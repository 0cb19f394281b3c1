"""A recorded session read again: its scans for SLAM, or all of it for sinks, without SLAM."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack

import numpy as np
from numpy.typing import NDArray

from slam.app.records import LogLine, Scan, SessionObserver, Snapshot
from slam.app.run.runner import LinkLog, LostFrames, RunRecord, RunRecorder
from slam.app.session.reader import RecordedScan, RecordedSession
from slam.packed import RowsByTime
from slam.results import SmoothedRun
from xethru_protocol.system import StopFlag


class RecordedScans:
    """The scans of a session, with the truth and the log lines between them."""

    def __init__(self, session: RecordedSession, stop: StopFlag) -> None:
        self._session, self._stop = session, stop
        self._truth = RowsByTime(np.dtype(np.float64), 3)
        self.lost = LostFrames()
        self.link_log = LinkLog()

    def truth_at(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.array([self._truth.at(t_ns) for t_ns in stamps_ns.tolist()]).reshape(-1, 3)

    def __iter__(self) -> Iterator[Scan]:
        for record in self._session.played():
            self._stop.check()
            if isinstance(record, LogLine):
                self.link_log.pass_on(record)
            elif isinstance(record, RecordedScan):
                scan, truth = record.scan, record.truth
                self._truth.put(scan.t_ns, np.full(3, np.nan) if truth is None else truth)
                self.lost.on_scan(scan)
                yield scan


def play_states(
    session: RecordedSession, sinks: Sequence[SessionObserver], stop: StopFlag
) -> RunRecord:
    """Give recorded scans, log lines, states and smoothed runs to sinks in the order of the file.

    The sinks are closed in their order at the end, also after a failure. Of a file without
    `/slam/step`, states have no `step` and no walls.

    Raises
    ------
    AppError
        The file is damaged other than by being cut at its end.
    """
    recorder = RunRecorder(session.info.true_landmarks_m)
    with ExitStack() as closing:
        for sink in reversed(sinks):
            closing.enter_context(sink)
        for record in session.played():
            stop.check()
            for sink in (recorder, *sinks):
                if isinstance(record, RecordedScan):
                    sink.on_scan(record.scan)
                elif isinstance(record, Snapshot):
                    sink.on_snapshot(record)
                elif isinstance(record, SmoothedRun):
                    sink.on_smoothed(record)
                elif isinstance(record, LogLine):
                    sink.on_log(record)
    return recorder.record()

"""A recorded session given to sinks again, as its run gave them: without SLAM."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack

from slam.app.records import LogLine, SessionObserver, Snapshot
from slam.app.run.runner import RunRecord, RunRecorder
from slam.app.session.reader import RecordedScan, RecordedSession
from xethru_protocol.system import StopFlag


def play_states(
    session: RecordedSession, sinks: Sequence[SessionObserver], stop: StopFlag
) -> RunRecord:
    """Give the recorded scans, log lines and states to sinks in the order of the file.

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
                elif isinstance(record, LogLine):
                    sink.on_log(record)
    return recorder.record()

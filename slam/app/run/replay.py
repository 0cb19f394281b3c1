"""A recorded session again: all of it for sinks (`play`), or its frames through SLAM (`replay`).

For a replay, frames come with the stamps that the run used, odometry as the floats it parsed,
settings, rig and wheels as they were: every number but the speed is the run's own, to the last bit.
The states that the run recorded are compared on the way.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Unpack

import numpy as np
from numpy.typing import NDArray

from slam.app.errors import UsageError
from slam.app.publish.sinks import Publishing
from slam.app.run.maps import MapOptions, MapSaver, MapUse, map_use, recorded_use
from slam.app.run.output import RunProgress, note
from slam.app.run.result_files import SESSION, VIEW, finish, hold_folder, saying_what_is_left
from slam.app.run.runner import (
    LinkLog,
    LostFrames,
    RunRecord,
    RunRecorder,
    RunSource,
    Step,
    execute,
)
from slam.app.session.constants import different_constants, recorded_rules
from slam.frames import Detection
from slam.library.slam import make_slam
from slam.live.errors import AppError, OdometryError
from slam.live.odometry_track import NS_PER_S, OdometryTrack, TumSample
from slam.live.session.reader import RecordedSession, begins_with, open_session
from slam.live.session.state_rows import lagged_row, smoothed_row, state_row
from slam.live.session_records import Event, Gap, LogLine, Scan, SessionObserver, Snapshot
from slam.results import Pipeline, SmoothedRun
from slam.robust.solver.growing_arrays import PackedRows
from xethru_protocol.operating_system import StopFlag
from xethru_protocol.recordings.mcap import MAGIC

_END = b"FOOT"
"""Ends a finished file, with four bytes behind it."""


def session_file(given: Path, *, allow_view: bool = False) -> Path:
    """Return a file as it is, or the session of a run's folder.

    `allow_view` prefers the .rrd of a folder, which is drawn already, if it was closed.
    """
    session, view = given / SESSION, given / VIEW
    if allow_view and view.is_file() and (is_finished(view) or not session.is_file()):
        return view
    return session if session.is_file() else given


def refuse_overwriting(recorded: Path, out: Path | None) -> None:
    """Raise UsageError if a result would replace its own session or another recording."""
    if out is None or not out.is_file():
        return
    if out.samefile(recorded):
        raise UsageError(f"{out}: is the session itself; write to another file")
    if begins_with(out, MAGIC):
        raise UsageError(f"{out}: is a recording, which cannot be repeated; write to another file")


def is_finished(path: Path) -> bool:
    """Return whether a recording was closed; that of a killed program lacks its last rows."""
    with path.open("rb") as stream:
        stream.seek(max(path.stat().st_size - len(_END) - 4, 0))
        return stream.read().startswith(_END)


class RecordedScans:
    """The scans of a session, with the truth and the log lines between them."""

    def __init__(self, session: RecordedSession, stop: StopFlag) -> None:
        self._session, self._stop = session, stop
        self._stamps_ns = PackedRows(np.dtype(np.int64))
        self._truth = PackedRows(np.dtype(np.float64), 3)
        self.lost = LostFrames()
        self.link_log = LinkLog()

    def truth_at(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the truth of scans by their times, which do not fall; NaN at other times."""
        at = np.searchsorted(self._stamps_ns.rows, stamps_ns, side="right") - 1
        is_scan = self._stamps_ns.rows[at] == stamps_ns
        return np.where(is_scan[:, None], self._truth.rows[at], np.nan)

    def __iter__(self) -> Iterator[Scan]:
        for record in self._session.played():
            self._stop.check()
            if isinstance(record, LogLine):
                self.link_log.pass_on(record)
            elif isinstance(record, Scan):
                truth = record.truth
                self._stamps_ns.append(record.t_ns)
                self._truth.append(np.full(3, np.nan) if truth is None else truth)
                self.lost.on_scan(record)
                yield record


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
            if isinstance(record, Event):
                for sink in (recorder, *sinks):
                    sink.take(record)
    return recorder.record()


def play(session: RecordedSession, sinks: Sequence[SessionObserver], stop: StopFlag) -> RunRecord:
    """Give what was recorded to sinks, with a progress line.

    A session without a state, such as an imported one, goes through SLAM first.

    Raises
    ------
    AppError
        The file is damaged other than by being cut, or has no state and cannot be replayed.
    """
    lost = LostFrames()
    progress = RunProgress(session.info, lambda: lost.n_lost, end_ns=session.end_ns)
    if _has_state(session, stop):
        record = play_states(session, [lost, progress, *sinks], stop)
    else:
        note(f"{session.path} holds no state of SLAM, so SLAM runs over its frames")
        record = execute(recorded_source(session, stop), [lost, progress, *sinks])
    if session.cut_at_byte is not None:
        note(f"{session.path} was cut at byte {session.cut_at_byte}; this is what is left of it")
    return record


def _has_state(session: RecordedSession, stop: StopFlag) -> bool:
    for record in session.records():
        stop.check()
        if isinstance(record, Snapshot):
            return True
    return False


def _step_of_detections(slam: Pipeline, detections: Mapping[int, Sequence[Detection]]) -> Step:
    """Return what steps SLAM with recorded detections, by the time of the scan [ns]."""
    return lambda _, pose_at, t_ns: slam.step_detections(detections.get(t_ns, ()), pose_at, t_ns)


_LONGEST_WAIT_S = 10.0
"""Longer gaps in the time of scans, as where a clock was set, are not waited for."""
_POLL_S = 0.1


def paced(
    scans: Iterable[Scan],
    rate: float,
    stop: StopFlag,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
) -> Iterator[Scan]:
    """Yield scans when they are due, `rate` times as fast as they were taken.

    Scans that are late are yielded at once, until they are due again. Session time that falls, or
    jumps by more than ten seconds of waiting, begins the pace anew.
    """
    start_s, start_ns, last_ns = -math.inf, 0, -1
    for scan in scans:
        due_s = start_s + (scan.t_ns - start_ns) / NS_PER_S / rate
        if last_ns < 0 or scan.t_ns < last_ns or due_s - clock() > _LONGEST_WAIT_S:
            start_s = due_s = clock()
            start_ns = scan.t_ns
        last_ns = scan.t_ns
        while (rest_s := due_s - clock()) > 0.0:
            stop.check()
            sleep(min(rest_s, _POLL_S))
        yield scan


def run_replay(
    stop: StopFlag,
    *,
    session: Path,
    out: Path,
    rate: float | None = None,
    publish: Sequence[str] = (),
    **maps: Unpack[MapOptions],
) -> None:
    """Replay a session, write its results into a folder and print its table.

    `rate` is how many times as fast as it was driven; None: at full speed. With a map it is another
    run of the same frames, which is not compared with the recorded one.
    """
    with ExitStack() as held:
        hold_folder(out, held)
        publishing = held.enter_context(Publishing(publish))
        recorded = open_session(session, stop)
        comparison = Comparison(different_constants(recorded.info.constants))
        begin = map_use(recorded.config, maps)
        source = recorded_source(recorded, stop, comparison, begin)
        if rate is not None:
            source = replace(source, scans=paced(source.scans, rate, stop))
        progress = RunProgress(source.info, source.lost_frames, end_ns=recorded.end_ns)
        map_saver = MapSaver(maps.get("save_map"), source.slam, source.info)
        publishing.begin(source.info, source.link_log.log)
        record = execute(source, [publishing, comparison, progress, map_saver])
        if recorded.cut_at_byte is not None:
            note(f"{session} was cut at byte {recorded.cut_at_byte}; this is what is left of it")
        if begin.file is None:
            note(comparison.verdict())
        with saying_what_is_left(f"; {out} is not complete"):
            finish(out, source, record, stop, publishing=publishing, map_saver=map_saver)


def recorded_source(
    session: RecordedSession,
    stop: StopFlag,
    comparison: Comparison | None = None,
    begin: MapUse | None = None,
) -> RunSource:
    """Return a session as the source of a run that steps SLAM as the recorded one did.

    `comparison` gets every recorded state and smoothed run, before the replay begins; a map to
    `begin` with replaces the one that the run began with.

    Raises
    ------
    AppError
        The session cannot be replayed.
    """
    config, wheels = session.config, session.wheels
    try:
        odometry = OdometryTrack(_samples(session, stop, comparison))
    except OdometryError as error:
        raise AppError(f"{session.path}: {error}") from None
    rules = recorded_rules(session.info.constants)
    noise_at = odometry.noise_at if session.info.odometry_covariance else None
    if begin is None or begin.file is None:
        begin = recorded_use(session.info, session.path)
    slam = make_slam(
        config, session.rig, wheels, rules=rules, noise_at=noise_at, on_map=begin.on_map
    )
    scans = RecordedScans(session, stop)
    return RunSource(
        info=session.info,
        rig=session.rig,
        slam=slam,
        scans=scans,
        odometry=odometry,
        truth_at=scans.truth_at,
        lost_frames=lambda: scans.lost.n_lost,
        link_log=scans.link_log,
        map_file=begin.file,
        step=_step_of_detections(slam, session.detections())
        if session.info.has_detections
        else None,
    )


def _samples(
    session: RecordedSession, stop: StopFlag, comparison: Comparison | None
) -> Iterator[TumSample]:
    """Yield the odometry; `comparison` gets states, smoothed runs and gaps between it."""
    for record in session.records():
        stop.check()
        if isinstance(record, TumSample):
            yield record
        elif comparison is not None and isinstance(record, Snapshot | SmoothedRun | Gap):
            comparison.expect(record)


_DIGEST_BYTES = 16


class Comparison(SessionObserver):
    """Compares every state and the last smoothed run with the recorded ones, to the last bit.

    `different` are the numbers in which the recorded run and this one differ, a text each.
    """

    def __init__(self, different: Sequence[str] = ()) -> None:
        self._different = different
        # Of the recorded states the digests by time, and the times of those that came again
        self._expected: dict[int, bytes] = {}
        self._same = set[int]()
        self._gaps: list[Gap] = []
        self._n_before_gap: int | None = None
        self._first_other_ns: int | None = None
        # session time of its last state [ns], and digest, of the last one
        self._smoothed: tuple[int, bytes] | None = None
        self._smoothed_again: tuple[int, bytes] | None = None

    def expect(self, record: Snapshot | SmoothedRun | Gap) -> None:
        """Take what was recorded; what comes after a gap was recorded behind it."""
        if isinstance(record, Snapshot):
            self._expected[record.t_ns] = _state_digest(record)
        elif isinstance(record, SmoothedRun):
            self._smoothed = _smoothed_digest(record)
        else:
            self._gaps.append(record)
            if self._n_before_gap is None:
                self._n_before_gap = len(self._expected)

    def on_snapshot(self, snapshot: Snapshot) -> None:
        expected = self._expected.get(snapshot.t_ns)
        if expected is None:
            return
        # Older sessions have no lagged poses.
        digests = {_state_digest(snapshot), _digest(state_row(snapshot))}
        if expected in digests:
            self._same.add(snapshot.t_ns)
        elif self._first_other_ns is None:
            self._first_other_ns = snapshot.t_ns

    def on_smoothed(self, smoothed: SmoothedRun) -> None:
        self._smoothed_again = _smoothed_digest(smoothed)

    def verdict(self) -> str:
        """Return one line: how many states came again, and why others did not."""
        n_expected = len(self._expected)
        if not n_expected:
            return "no states are recorded, so there are none to compare with"
        if self._n_same(n_expected) == n_expected:
            states = f"all {n_expected} recorded states came again, to the last bit"
            return f"{states}{self._smoothed_verdict()}"
        if self._n_before_gap is None:
            return self._verdict_on(n_expected, "") + self._reason()
        n_before = self._n_before_gap
        n_same = self._n_same(n_before)
        gaps = "; ".join(map(str, self._gaps))
        behind = (
            f"the other {n_expected - n_before} cannot be compared, as SLAM lacks what damage "
            f"took: {gaps}"
        )
        if not n_before:
            return f"none of the {n_expected} recorded states precedes the first gap; {behind}"
        if n_same == n_before:
            return (
                f"all {n_same} recorded states before the first gap came again, to the last bit; "
                f"{behind}"
            )
        return f"{self._verdict_on(n_before, ' before the first gap')}{self._reason()}; {behind}"

    def _smoothed_verdict(self) -> str:
        expected, found = self._smoothed, self._smoothed_again
        if expected is None or found is None or expected[0] != found[0]:
            return ""  # the recorded run was killed, or has no smoothed path
        if expected == found:
            return ", and so did the smoothed path"
        return f"; the smoothed path did not: {self._reason()}"

    def _n_same(self, n_first: int) -> int:
        return sum(t_ns in self._same for t_ns in islice(self._expected, n_first))

    def _verdict_on(self, n_expected: int, which: str) -> str:
        n_same = self._n_same(n_expected)
        where = ""
        if self._first_other_ns is not None:
            where = f", the first other one at {self._first_other_ns / 1e9:.3f} s"
        return f"only {n_same} of {n_expected} recorded states{which} came again{where}; "

    def _reason(self) -> str:
        if not self._different:
            return "another version, or another processor's arithmetic?"
        shown = "; ".join(self._different[:_MOST_SHOWN])
        more = len(self._different) - _MOST_SHOWN
        rest = f"; and {more} more" if more > 0 else ""
        return f"these numbers differ from the recorded ones: {shown}{rest}"


_MOST_SHOWN = 10


def _digest(row: NDArray[np.float64]) -> bytes:
    return hashlib.blake2b(row.tobytes(), digest_size=_DIGEST_BYTES).digest()


def _state_digest(snapshot: Snapshot) -> bytes:
    """Return the digest of a state and of the lagged poses that are final with it."""
    lagged = np.zeros(0) if snapshot.step is None else lagged_row(snapshot.step)
    return _digest(np.concatenate([state_row(snapshot), lagged]))


def _smoothed_digest(smoothed: SmoothedRun) -> tuple[int, bytes]:
    return int(smoothed.t_ns[-1]), _digest(smoothed_row(smoothed))

"""Scans of radars on real ports in real time: stamps, odometry, and the log of a live run.

A run never falls behind by much. A scan that waited for SLAM longer than `MOST_WAIT_NS` since its
last frame came is recorded and not used; in the session it is marked so, and a replay leaves out
the same scans. Before each step signals, duration and odometry are looked at: when one of them ends
the run, scans that still wait are recorded and not used.

Time base `arrival`: every radar's counter is regressed on the host's clock, the odometry's stamps
likewise, so a frame's session time is what the odometry's clock showed when it was taken.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from queue import Empty
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from slam.app.odometry.live import MOST_STAMP_NS, LineSource, LiveOdometry, read_lines
from slam.app.run.runner import LinkLog, Odometry, frames_between
from slam.app.session.writer import CannotWriteError, SessionLog
from slam.live.arrival_clock import ArrivalClock
from slam.live.errors import AppError
from slam.live.frame_sources import radar_frame
from slam.live.odometry_track import NS_PER_S, TumSample
from slam.live.session_records import Event, LogLine, RadarInfo, Scan, SessionObserver
from slam.live.ticks import (
    GRACE_NS,
    MOST_EVENTS,
    MOST_WAIT_NS,
    SETTLE_S,
    Inbox,
    SourceEvent,
    TickAssembler,
)
from xethru_protocol.driver.frames import Frame
from xethru_protocol.operating_system import StopFlag, StopRequestedError
from xethru_protocol.validation import reason_of


def read_odometry(source: LineSource, inbox: Inbox, stopped: threading.Event) -> None:
    """Put the lines of a source into the inbox, and why they end."""
    trouble = ""
    try:
        for text, arrival_ns in read_lines(source, stopped.is_set):
            inbox.hand_over(("odometry line", text, arrival_ns), stopped)
    except AppError as error:
        trouble = str(error)
    except Exception as error:  # a bug, as above
        inbox.hand_over(("odometry end", f"its reader failed: {reason_of(error)}"), stopped)
        raise
    inbox.hand_over(("odometry end", trouble), stopped)


START_LIMIT_S = 15.0
UNUSED_S = 5.0
END_NS = GRACE_NS
"""How long SLAM gets the last scans of a run whose duration or odometry is over."""
_SOURCE_POLL_S = 0.05
_DRIFT_EVERY_S = 60.0
_FAR_SCANS = 5
"""Scans too far from the one before until that is logged: odometry may jump once."""


class LiveLog(LinkLog):
    """Writes a live run into its session log; keeps odometry until there is one.

    If the log cannot be written, a warning is logged once, and the run goes on without it.

    Attributes
    ----------
    failure
        Why the log is not whole; "" if it is.
    """

    def __init__(self) -> None:
        super().__init__()
        self.failure = ""
        self._log: SessionLog | None = None
        self._early: list[TumSample] | None = []

    def begin(self, log: SessionLog, start_ns: int) -> None:
        """Write to a log, first the odometry so far.

        The lines so far, and those until the first scan, get its session time: they are of another
        clock, and 0 may be decades ago.
        """
        self._log, self._t_ns = log, start_ns
        self._waiting = [replace(line, t_ns=start_ns) for line in self._waiting]
        early, self._early = self._early or [], None
        for sample in early:
            self.on_odometry(sample)

    def on_odometry(self, sample: TumSample) -> None:
        if self._early is None:
            self._write(lambda log: log.on_odometry(sample))
        else:
            self._early.append(sample)

    def on_wire(self, radar: str, way: Literal["rx", "tx"], data: bytes, host_ns: int) -> None:
        """Write raw bytes of a port; those from before `begin` are dropped."""
        self._write(lambda log: log.on_wire(radar, way, data, host_ns))

    def take(self, event: Event) -> None:
        super().take(event)
        self._write(lambda log: log.take(event))

    def pass_on(self, line: LogLine) -> None:
        if self._sinks is not None:
            self._write(lambda log: log.take(line))
        super().pass_on(line)

    def close(self) -> None:
        """Close the log; results are not lost if its last chunk cannot be written."""
        log, self._log = self._log, None
        try:
            if log is not None:
                log.close()
        except CannotWriteError as error:
            self.failure = str(error)

    def _write(self, write: Callable[[SessionLog], None]) -> None:
        if self._log is None:
            return
        try:
            write(self._log)
        except CannotWriteError as error:
            self._log = None
            self.failure = str(error)
            self.log("run", f"{error}; the run goes on and is not recorded", warning=True)


class SpacingWarning(SessionObserver):
    """Logs one warning when the robot drives too far from frame to frame for images of the room.

    Parameters
    ----------
    most_m
        Longest way between two scans, see `slam.imaging.patches.longest_spacing_m`.
    """

    def __init__(self, most_m: float, odometry: Odometry, log: LinkLog) -> None:
        self._most_m, self._odometry, self._log = most_m, odometry, log
        self._last: tuple[int, NDArray[np.float64]] | None = None
        self._n_far = 0  # scans that followed on each other

    def on_scan(self, scan: Scan) -> None:
        if not scan.used or self._n_far == _FAR_SCANS:
            return
        pose = self._odometry.pose_at(scan.t_ns)
        last, self._last = self._last, (scan.t_ns, pose)
        if last is None:
            return
        way_m = float(np.hypot(*(pose - last[1])[:2]))
        self._n_far = self._n_far + 1 if way_m > self._most_m else 0
        if self._n_far == _FAR_SCANS:
            speed_mps = way_m * NS_PER_S / (scan.t_ns - last[0])
            self._log.log(
                "run",
                f"frames are {100 * way_m:.1f} cm apart at {speed_mps:.2f} m/s: images of the room "
                f"show false echoes from {100 * self._most_m:.1f} cm on; drive slower, or ask for "
                f"--fps {math.ceil(speed_mps / self._most_m)}",
                warning=True,
            )


class LiveSource:
    """The rig as a stream of scans in real time.

    `radars` and `clocks` are in the order of the rig; `limits` are those of the sampler, see
    `RadarFrame`; `clock_ns` is the host's monotonic time, that of the drivers' arrivals. `log` gets
    everything but the scans, in this thread.

    Attributes
    ----------
    ended
        Why `scans` ended: a text if that was to be expected, else the error.
    worst_wait_s
        How long a scan waited for SLAM before it was given out, at worst.
    busy_s
        Time spent in SLAM, logs and views.
    """

    def __init__(  # noqa: PLR0917 - everything a run consists of
        self,
        radars: tuple[RadarInfo, ...],
        limits: tuple[float, float] | None,
        odometry: LiveOdometry,
        inbox: Inbox,
        log: LiveLog,
        stop: StopFlag,
        *,
        duration_s: float | None = None,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.radars, self._limits = radars, limits
        self._odometry, self._inbox, self._log = odometry, inbox, log
        self._stop, self._duration_s, self._clock_ns = stop, duration_s, clock_ns
        self._unix_ns = time.time_ns() - time.monotonic_ns()
        self._began_ns = clock_ns()
        self._last_frames: list[Frame | None] = [None] * len(radars)
        self._drift_logged_ns = self._began_ns
        self._warned_dropped = self._warned_refused = 0
        self._unused_since_ns: int | None = None
        self._unused_warned = False
        self.ticks = TickAssembler(len(radars), round(NS_PER_S / radars[0].rate_hz), odometry)
        self.clocks = tuple(ArrivalClock(radar.rate_hz) for radar in radars)
        self.ended: str | AppError | StopRequestedError | None = None
        self.worst_wait_s = self.busy_s = 0.0
        self.lost_frames = 0

    def settle(self) -> int:
        """Read until every clock is roughly known; return the session time of the first scan.

        Raises
        ------
        AppError
            A radar or the odometry sends nothing.
        StopRequestedError
            A signal arrived.
        """
        ready_ns: int | None = None
        while True:
            self._stop.check()
            self._drain(_SOURCE_POLL_S)
            now_ns = self._clock_ns()
            waited_s = (now_ns - self._began_ns) / NS_PER_S
            silent = [
                radar.name
                for radar, last in zip(self.radars, self._last_frames, strict=True)
                if last is None
            ]
            if silent and waited_s > START_LIMIT_S:
                raise AppError(f"radar {', '.join(silent)}: no frame in {START_LIMIT_S:g} s")
            if self._odometry.ended and not self._odometry:
                raise AppError(self._odometry.trouble)
            if text := self._odometry.silence(now_ns, self._began_ns):
                raise AppError(text)
            if silent or not self._odometry:
                continue
            ready_ns = now_ns if ready_ns is None else ready_ns
            if now_ns - ready_ns < SETTLE_S * NS_PER_S:
                continue
            start_ns = max(self._odometry.session_ns(now_ns), self._odometry.first_ns)
            if self._odometry.ended and not self._odometry.covers(start_ns):
                raise AppError(
                    f"odometry: its last pose is of {self._odometry.last_ns / NS_PER_S:.3f} s, and "
                    f"by its clock it is {start_ns / NS_PER_S:.3f} s: it ended before the run "
                    "could begin, or --odometry-clock is another"
                )
            if text := self._odometry.clock_mismatch(now_ns):
                raise AppError(text)
            if self._odometry.session_ns(now_ns) < NS_PER_S:
                continue  # no session holds what was before 0
            self.ticks.begin(start_ns)
            return start_ns

    def started_unix_ns(self) -> int:
        """Return the time of day at session time 0, were both clocks equally fast until now."""
        now_ns = self._clock_ns()
        return now_ns + self._unix_ns - self._odometry.session_ns(now_ns)

    def scans(self) -> Iterator[Scan]:
        """Yield scans until the run ends; `ended` is the reason then.

        Whatever waits when it ends is yielded, too, and SLAM must not use it.
        """
        while self.ended is None:
            self._drain(_SOURCE_POLL_S)
            while self._goes_on() and (scan := self._next_scan()) is not None:
                started_ns = self._clock_ns()
                yield scan
                self.busy_s += (self._clock_ns() - started_ns) / NS_PER_S
                self._odometry.forget_before(scan.t_ns)  # later scans ask for later poses
                self._drain(0.0)
        now_ns = self._odometry.session_ns(self._clock_ns())
        over_ns = min(now_ns, self._duration_end_ns, self._odometry_end_ns)
        while (scan := self.ticks.next_scan(over_ns, is_over=True)) is not None:
            yield scan
        self._log_drifts()

    def _goes_on(self) -> bool:
        """Return whether nothing ends the run: no signal, not its duration or odometry."""
        try:
            self._stop.check()
        except StopRequestedError as stopped:
            self.ended = stopped
        else:
            self._end_if_over()
        return self.ended is None

    def _next_scan(self) -> Scan | None:
        n_dropped = self.ticks.n_dropped
        scan = self.ticks.next_scan(self._odometry.session_ns(self._clock_ns()))
        if scan is None:
            return None
        if scan.t_ns >= self._duration_end_ns:
            self.ended = f"the {self._duration_s:g} s asked for are over"
            return None
        self.worst_wait_s = max(self.worst_wait_s, self.ticks.wait_ns / NS_PER_S)
        if self.ticks.n_dropped > n_dropped:
            self._warn_of_dropped()
        else:
            self._warn_of_unused(scan)
        return scan

    @property
    def _duration_end_ns(self) -> int:
        if self._duration_s is None:
            return MOST_STAMP_NS
        assert self.ticks.start_ns is not None
        return self.ticks.start_ns + round(self._duration_s * NS_PER_S)

    @property
    def _odometry_end_ns(self) -> int:
        return self._odometry.last_ns if self._odometry.ended else MOST_STAMP_NS

    def _drain(self, wait_s: float) -> None:
        """Take the events that wait, and no others; wait for the first if none does."""
        try:
            self._take(self._inbox.get(timeout=wait_s) if wait_s else self._inbox.get_nowait())
            for _ in range(MOST_EVENTS):
                self._take(self._inbox.get_nowait())
        except Empty:
            return

    def _take(self, event: SourceEvent) -> None:
        match event:
            case "frame", radar, frame:
                self._take_frame(radar, frame)
            case "odometry line", text, arrival_ns:
                sample, warning = self._odometry.take(text, arrival_ns)
                if warning:
                    self._log.log("odometry", warning, warning=True)
                if sample is not None:
                    self._log.on_odometry(sample)
            case "odometry end", trouble:
                self._odometry.end(trouble)
                self._log.log("odometry", trouble or "ended", warning=bool(trouble))
            case "lost", radar, trouble:
                self.ticks.alive.discard(radar)
                left = f"{len(self.ticks.alive)} of {len(self.radars)} radars"
                text = f"{trouble}; the run goes on with {left}"
                self._log.log(self.radars[radar].name, text, warning=True)
            case "back", radar, port:
                self.ticks.alive.add(radar)
                self._log.log(self.radars[radar].name, f"is back, at {port}", warning=True)
            case "link", name, record:
                self._log.on_record(name, record)
            case "wire", name, way, data, host_ns:
                self._log.on_wire(name, way, data, host_ns)

    def _take_frame(self, radar: int, frame: Frame) -> None:
        last = self._last_frames[radar]
        self.lost_frames += 0 if last is None else frames_between(last, frame)
        self._last_frames[radar] = frame
        taken_ns = self.clocks[radar].stamp_ns(frame.counter, frame.arrival_ns, frame.stream)
        if not self._odometry:
            return  # session time is unknown until then
        made = radar_frame(radar, frame, self._odometry.session_ns(taken_ns), limits=self._limits)
        came_ns = self._odometry.session_ns(frame.arrival_ns)
        self.ticks.take(made, frame.arrival_ns + self._unix_ns, came_ns)

    def _warn_of_dropped(self) -> None:
        """Warn at the first scan that SLAM was too slow for, and whenever they have doubled."""
        if self.ticks.n_dropped < 2 * self._warned_dropped:
            return
        self._warned_dropped = self.ticks.n_dropped
        scans = "1 scan" if self.ticks.n_dropped == 1 else f"{self.ticks.n_dropped} scans"
        self._log.log(
            "run",
            "SLAM cannot keep up with the radars: this machine is too slow, or busy with something "
            f"else; {scans} waited longer than {MOST_WAIT_NS / NS_PER_S:g} s: recorded, not used",
            warning=True,
        )

    def _warn_of_unused(self, scan: Scan) -> None:
        """Warn if SLAM has got no scan for long: a clock may have been set."""
        if scan.used:
            self._unused_since_ns = None
        elif self._unused_since_ns is None:
            self._unused_since_ns, self._unused_warned = scan.t_ns, False
        elif scan.t_ns - self._unused_since_ns > UNUSED_S * NS_PER_S and not self._unused_warned:
            self._unused_warned = True
            self._log.log(
                "run",
                f"SLAM got no scan for {UNUSED_S:g} s, as odometry does not cover their time or "
                "they came too late; they are recorded. Was a clock set?",
                warning=True,
            )

    def _end_if_over(self) -> None:
        """Log how clocks drift, and end a run that is over, or cannot go on."""
        now_ns = self._clock_ns()
        if now_ns - self._drift_logged_ns > _DRIFT_EVERY_S * NS_PER_S:
            self._drift_logged_ns = now_ns
            self._log_drifts()
        over_ns = self._odometry.session_ns(now_ns) - END_NS
        if over_ns >= self._duration_end_ns:
            self.ended = f"the {self._duration_s:g} s asked for are over"
        elif self.ticks.ended or over_ns >= self._odometry_end_ns:
            trouble = self._odometry.trouble
            self.ended = AppError(trouble) if trouble else "odometry ended"
        else:
            text = self._odometry.silence(now_ns, self._began_ns) or self.ticks.silence(now_ns)
            self.ended = AppError(text) if text else None

    def _log_drifts(self) -> None:
        for info, clock in zip(self.radars, self.clocks, strict=True):
            self._log.log(info.name, drift_text(clock), warning=False)
        if self._inbox.n_refused > self._warned_refused:
            self._warned_refused = self._inbox.n_refused
            self._log.log(
                "run",
                f"{self._warned_refused} lines about links, or pieces of raw bytes, found no room "
                "in the queue and are not recorded: this machine is too slow",
                warning=True,
            )


def drift_text(clock: ArrivalClock) -> str:
    return (
        f"clock {clock.drift_ppm:+.2f} ppm against this machine's, "
        f"+-{clock.drift_sigma_ppm:.2f} over {clock.baseline_s:.0f} s"
    )

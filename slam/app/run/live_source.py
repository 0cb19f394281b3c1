"""Scans of radars on real ports in real time: threads, ticks, stamps, and the log of a live run.

Threads put events into one queue; the main loop reads that queue only. A radar that falls silent
or vanishes is looked for until it is back or the run ends.

Ticks are frame periods of session time. A tick is complete when every radar that is not lost has
sent a frame of it or a later one, and odometry has come past it; or when waiting longer would not
make it more complete. `TickAssembler` reads no clock: time is an argument, so tests run it in
virtual time.

Time base `arrival`: every radar's counter is regressed on the host's clock, the odometry's stamps
likewise, so a frame's session time is what the odometry's clock showed when it was taken.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from queue import Empty, SimpleQueue
from typing import Literal, TypeAlias

from slam.app.errors import AppError, OdometryError
from slam.app.odometry.arrival import ArrivalClock
from slam.app.odometry.live import LineSource, LiveOdometry, read_lines
from slam.app.odometry.track import NS_PER_S, TumSample
from slam.app.records import LogLine, RadarInfo, Scan, Snapshot
from slam.app.rig.sources import RadarLink, radar_frame
from slam.app.run.runner import LinkLog
from slam.app.session.log import CannotWriteError, SessionLog
from slam.frames import RadarFrame
from xethru_protocol.driver.conversation import ProtocolRecord
from xethru_protocol.driver.frames import Frame
from xethru_protocol.system import StopFlag, StopRequestedError
from xethru_protocol.wire.errors import ResponseTimeout, XeThruError

Event: TypeAlias = (
    tuple[Literal["frame"], int, Frame]
    | tuple[Literal["lost", "back"], int, str]
    | tuple[Literal["link"], str, ProtocolRecord]
    | tuple[Literal["wire"], str, Literal["rx", "tx"], bytes, int]
    | tuple[Literal["odometry line"], str, int]
    | tuple[Literal["odometry end"], str]
)
"""What threads hand to the main loop, by its first item.

- "frame": the radar's index in the rig, and the frame;
- "lost", "back": the radar's index, and why it is lost, or its new port;
- "link": the radar's name, and a line of its protocol log;
- "wire": the radar's name, way, bytes and host time of what went over its port;
- "odometry line": its text, and the host's monotonic time of its arrival;
- "odometry end": why no more lines will come, "" if the source just ended.
"""

Inbox: TypeAlias = SimpleQueue[Event]


SILENCE_S = 3.0
"""Many frame periods; a module that sends nothing for so long has stopped streaming."""
_POLL_S = 0.2
_LOOK_S = 2.0
_LOOK_AGAIN_S = 1.0
_JOIN_S = 10.0
"""More than a look for a module takes; a thread that still reads then hangs in the system."""


@contextmanager
def reading(links: Sequence[RadarLink], source: LineSource, inbox: Inbox) -> Iterator[None]:
    """Read every radar, in the order of the rig, and the odometry, each in a thread of its own.

    The drivers belong to the threads meanwhile.
    """
    stopped = threading.Event()
    threads = [
        threading.Thread(
            target=_read_radar,
            args=(index, link, inbox, stopped),
            name=f"radar {link.mount.name}",
            daemon=True,
        )
        for index, link in enumerate(links)
    ]
    threads.append(
        threading.Thread(
            target=_read_odometry, args=(source, inbox, stopped), name="odometry", daemon=True
        )
    )
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stopped.set()
        give_up = time.monotonic() + _JOIN_S
        for thread in threads:
            thread.join(max(give_up - time.monotonic(), 0.0))


def _read_radar(radar: int, link: RadarLink, inbox: Inbox, stopped: threading.Event) -> None:
    received_s = time.monotonic()
    try:
        while not stopped.is_set():
            trouble = ""
            try:
                inbox.put(("frame", radar, link.driver.read_frame(_POLL_S)))
                received_s = time.monotonic()
            except ResponseTimeout:
                if time.monotonic() - received_s > SILENCE_S:
                    trouble = f"no frame for {SILENCE_S:g} s"
            except XeThruError as error:
                trouble = str(error)
            if trouble:
                inbox.put(("lost", radar, trouble))
                if _found_again(link, stopped):
                    inbox.put(("back", radar, link.driver.port))
                received_s = time.monotonic()
    except Exception as error:  # a bug: reported, so that no radar is lost silently
        inbox.put(("lost", radar, f"its reader failed: {error!r}"))
        raise


def _found_again(link: RadarLink, stopped: threading.Event) -> bool:
    while not stopped.is_set():
        try:
            link.driver.reconnect(_LOOK_S)
        except XeThruError:
            stopped.wait(_LOOK_AGAIN_S)
        else:
            return True
    return False


def _read_odometry(source: LineSource, inbox: Inbox, stopped: threading.Event) -> None:
    trouble = ""
    try:
        for text, arrival_ns in read_lines(source, stopped.is_set):
            inbox.put(("odometry line", text, arrival_ns))
    except OdometryError as error:
        trouble = str(error)
    except Exception as error:  # a bug, as above
        inbox.put(("odometry end", f"its reader failed: {error!r}"))
        raise
    inbox.put(("odometry end", trouble))


GRACE_NS = NS_PER_S // 2
"""How long a tick waits for a radar that has not sent its frame yet."""
ODOMETRY_WAIT_NS = NS_PER_S
"""How long a tick waits for odometry; then its frames are recorded and not used."""
MOST_LAG_NS = 10 * NS_PER_S
"""When SLAM is later than that, scans are recorded and not used until it has caught up."""
CAUGHT_UP_NS = NS_PER_S


class TickAssembler:
    """Gives out scans in the order of time.

    Parameters
    ----------
    n_radars
        Radars of the rig.
    period_ns
        Of their frames.
    odometry
        Limits which ticks are complete.

    Attributes
    ----------
    alive
        Indices of the radars that are not lost.
    start_ns
        Session time of tick 0; None before `begin`.
    lag_ns
        How long ago the newest tick given out was over.
    n_unused
        Scans given out that SLAM must not use.
    n_left_out
        Frames that came too late for SLAM, given out in scans that it must not use.
    ended
        Whether odometry ended, and the ticks have come there.
    """

    def __init__(self, n_radars: int, period_ns: int, odometry: LiveOdometry) -> None:
        self._odometry = odometry
        self._period_ns = period_ns
        # frames in session time, each with its arrival, nanoseconds since 1970
        self._waiting: list[deque[tuple[RadarFrame, int]]] = [deque() for _ in range(n_radars)]
        self._tick = 0
        self._is_late = False
        self.alive = set(range(n_radars))
        self.start_ns: int | None = None
        self.lag_ns = 0
        self.n_unused = self.n_left_out = 0
        self.ended = False

    def begin(self, start_ns: int) -> None:
        """Let tick 0 begin at a session time; frames before it are dropped."""
        self.start_ns = start_ns
        for queue in self._waiting:
            while queue and queue[0][0].t_ns < start_ns:
                queue.popleft()

    def take(self, frame: RadarFrame, host_ns: int) -> None:
        """Take a frame; the frames of one radar come in the order of time."""
        self._waiting[frame.radar].append((frame, host_ns))

    def next_scan(self, now_ns: int) -> Scan | None:
        """Return the next scan if it is complete at a session time, else None."""
        if self.start_ns is None:
            return None
        while True:
            begin_ns = self.start_ns + self._tick * self._period_ns
            end_ns = begin_ns + self._period_ns
            late = self._late(begin_ns, end_ns)
            if late:
                self.n_left_out += len(late)
                return self._scan(late, begin_ns, used=False)
            self.ended = self._odometry.ended and not self._odometry.covers(begin_ns)
            received = [q[0] for q in self._waiting if q and q[0][0].t_ns < end_ns]
            stamps_ns = [begin_ns, *(frame.t_ns for frame, _ in received)]
            if self.ended or self._may_get_more(bool(received), max(stamps_ns), end_ns, now_ns):
                return None
            if received:
                break
            # to the oldest frame, or the first tick that may still get some: there are billions of
            # empty ones if odometry's clock is set from 1970
            heads_ns = [queue[0][0].t_ns for queue in self._waiting if queue]
            next_ns = min([now_ns - GRACE_NS, *heads_ns])
            self._tick = max(self._tick + 1, (next_ns - self.start_ns) // self._period_ns)
        for frame, _ in received:
            self._waiting[frame.radar].popleft()
        self.lag_ns = now_ns - end_ns
        self._is_late = self.lag_ns > (CAUGHT_UP_NS if self._is_late else MOST_LAG_NS)
        used = not self._is_late and all(map(self._odometry.is_known, stamps_ns))
        scan = self._scan(received, begin_ns, used=used)
        self._tick += 1
        return scan

    def _may_get_more(self, has_frames: bool, needed_ns: int, end_ns: int, now_ns: int) -> bool:
        """Return whether a tick may get more frames, or odometry for them."""
        missing = not self.alive or any(not self._waiting[radar] for radar in self.alive)
        if missing and now_ns < end_ns + GRACE_NS:
            return True
        if not has_frames:
            return now_ns < end_ns
        if self._odometry.covers(needed_ns) or self._odometry.ended:
            return False
        return now_ns < needed_ns + ODOMETRY_WAIT_NS

    def _scan(self, received: Sequence[tuple[RadarFrame, int]], t_ns: int, *, used: bool) -> Scan:
        self.n_unused += not used
        return Scan(
            counter=self._tick,
            t_ns=t_ns,
            frames=tuple(frame for frame, _ in received),
            host_ns=tuple(host_ns for _, host_ns in received),
            used=used,
        )

    def _late(self, begin_ns: int, end_ns: int) -> Sequence[tuple[RadarFrame, int]]:
        """Take the oldest frame of every radar that is too old for a tick.

        Too old is by more than a whole period, or by a quarter of one if a newer frame of the tick
        is there: after a stall of a line, or once in hours if a module's clock is fast. Frames that
        are late by less, from jitter about a tick's bounds, count.
        """
        late = []
        for queue in self._waiting:
            age_ns = begin_ns - queue[0][0].t_ns if queue else 0
            has_newer = len(queue) > 1 and queue[1][0].t_ns < end_ns
            if age_ns > (self._period_ns // 4 if has_newer else self._period_ns):
                late.append(queue.popleft())
        return late


SETTLE_S = 2.0
"""How long frames and odometry are read before the first scan, so that clocks are known."""
START_LIMIT_S = 15.0
SILENT_RIG_S = 10.0
WARN_LAG_S = 2.0
UNUSED_S = 5.0
_SOURCE_POLL_S = 0.05
_DRIFT_EVERY_S = 60.0


class LiveLog(LinkLog):
    """Writes a live run into its session log; keeps odometry until there is one.

    If the log cannot be written any more, a warning is logged once, and the run goes on without it.

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

    def begin(self, log: SessionLog) -> None:
        """Write to a log, first the odometry so far."""
        self._log = log
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

    def on_scan(self, scan: Scan) -> None:
        super().on_scan(scan)
        self._write(lambda log: log.on_scan(scan))

    def on_snapshot(self, snapshot: Snapshot) -> None:
        self._write(lambda log: log.on_snapshot(snapshot))

    def pass_on(self, line: LogLine) -> None:
        if self._sinks is not None:
            self._write(lambda log: log.on_log(line))
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


class LiveSource:
    """The rig as a stream of scans in real time.

    Parameters
    ----------
    radars
        What the modules answered, in the order of the rig.
    limits
        Of the sampler, see `RadarFrame`.
    odometry
        Takes the lines.
    log
        Gets everything but the scans, in this thread.
    duration_s
        When to end; None if never.
    clock_ns
        The host's monotonic time, that of the drivers' arrivals.

    Attributes
    ----------
    ticks
        Makes scans of frames.
    clocks
        Of every radar, in the order of the rig.
    ended
        Why `scans` ended: a text if that was to be expected, else the error.
    worst_lag_s
        How long ago a tick was over when SLAM got it, at worst.
    busy_s
        Time spent in SLAM, logs and views.
    lost_frames
        Frames missing between the counters that arrived, over all radars and streams.
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
        self._all_lost_ns: int | None = None
        self._last_frames: list[Frame | None] = [None] * len(radars)
        self._drift_logged_ns = self._began_ns
        self._lag_warned_s = WARN_LAG_S
        self._unused_since_ns: int | None = None
        self._unused_warned = False
        self.ticks = TickAssembler(len(radars), round(NS_PER_S / radars[0].rate_hz), odometry)
        self.clocks = tuple(ArrivalClock(radar.rate_hz) for radar in radars)
        self.ended: str | AppError | StopRequestedError | None = None
        self.worst_lag_s = self.busy_s = 0.0
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
            if self._odometry.ended and not self._odometry.has_pose:
                raise AppError(self._odometry.trouble)
            if text := self._odometry.silence(now_ns, self._began_ns):
                raise AppError(text)
            if silent or not self._odometry.has_pose:
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

    def scans(self) -> Iterator[Scan]:
        """Yield scans until the run ends; `ended` is the reason then."""
        while self.ended is None:
            try:
                self._stop.check()
            except StopRequestedError as stopped:
                self.ended = stopped
                break
            self._drain(_SOURCE_POLL_S)
            while (scan := self._next_scan()) is not None:
                started_ns = self._clock_ns()
                yield scan
                self.busy_s += (self._clock_ns() - started_ns) / NS_PER_S
                self._drain(0.0)
            self._end_if_over()
        self._log_drifts()

    def _next_scan(self) -> Scan | None:
        if self.ended is not None:
            return None
        scan = self.ticks.next_scan(self._odometry.session_ns(self._clock_ns()))
        if scan is None:
            return None
        assert self.ticks.start_ns is not None
        elapsed_s = (scan.t_ns - self.ticks.start_ns) / NS_PER_S
        if self._duration_s is not None and elapsed_s >= self._duration_s:
            self.ended = f"the {self._duration_s:g} s asked for are over"
            return None
        self._warn_of_lag()
        self._warn_of_unused(scan)
        return scan

    def _drain(self, wait_s: float) -> None:
        """Take all events that wait; wait for the first one if there is none."""
        try:
            self._take(self._inbox.get(timeout=wait_s) if wait_s else self._inbox.get_nowait())
            while True:
                self._take(self._inbox.get_nowait())
        except Empty:
            return

    def _take(self, event: Event) -> None:
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
        if last is not None and frame.stream == last.stream and frame.counter > last.counter:
            self.lost_frames += frame.counter - last.counter - 1
        self._last_frames[radar] = frame
        taken_ns = self.clocks[radar].stamp_ns(frame.counter, frame.arrival_ns, frame.stream)
        if not self._odometry.has_pose:
            return  # session time is unknown until then
        made = radar_frame(radar, frame, self._odometry.session_ns(taken_ns), limits=self._limits)
        self.ticks.take(made, frame.arrival_ns + self._unix_ns)

    def _warn_of_lag(self) -> None:
        lag_s = self.ticks.lag_ns / NS_PER_S
        self.worst_lag_s = max(self.worst_lag_s, lag_s)
        if lag_s > self._lag_warned_s:
            self._lag_warned_s = 2.0 * lag_s
            self._log.log(
                "run",
                f"SLAM is {lag_s:.1f} s behind the radars: this machine is too slow, or busy with "
                "something else; all frames are recorded",
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
        """Log how clocks drift, and end a run that cannot go on."""
        now_ns = self._clock_ns()
        if now_ns - self._drift_logged_ns > _DRIFT_EVERY_S * NS_PER_S:
            self._drift_logged_ns = now_ns
            self._log_drifts()
        if self.ended is not None:
            return
        if self.ticks.ended:
            trouble = self._odometry.trouble
            self.ended = AppError(trouble) if trouble else "odometry ended"
        elif text := self._odometry.silence(now_ns, self._began_ns):
            self.ended = AppError(text)
        elif self.ticks.alive:
            self._all_lost_ns = None
        elif self._all_lost_ns is None:
            self._all_lost_ns = now_ns
        elif now_ns - self._all_lost_ns > SILENT_RIG_S * NS_PER_S:
            self.ended = AppError(f"no radar for {SILENT_RIG_S:g} s")

    def _log_drifts(self) -> None:
        for info, clock in zip(self.radars, self.clocks, strict=True):
            self._log.log(info.name, drift_text(clock), warning=False)


def drift_text(clock: ArrivalClock) -> str:
    return (
        f"clock {clock.drift_ppm:+.2f} ppm against this machine's, "
        f"+-{clock.drift_sigma_ppm:.2f} over {clock.baseline_s:.0f} s"
    )

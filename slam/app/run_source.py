"""Scans of radars on real ports, as they come: arrivals to stamps, silence to words.

Time base `arrival`: every radar's counter is regressed on the host's clock, the odometry's stamps
likewise, so a frame's session time is what the odometry's clock showed when it was taken. The
main loop reads its inbox only; ports are read by the threads of `run_readers`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from queue import Empty
from typing import Protocol

from slam.app.arrival import ArrivalClock
from slam.app.errors import AppError
from slam.app.odometry_live import LiveOdometry
from slam.app.run_events import (
    Event,
    FrameCame,
    LinkSaid,
    OdometryEnded,
    OdometryLine,
    RadarBack,
    RadarLost,
    WireCame,
)
from slam.app.run_ticks import ReceivedFrame, TickAssembler
from slam.app.session import RadarInfo, Scan
from slam.app.sources import radar_frame
from slam.app.stop import StopRequestedError
from slam.app.tum import NS_PER_S, TumSample
from xethru_protocol.driver import Frame

SETTLE_S = 2.0
"""For so long frames and odometry are listened to before the first scan: clocks are known then."""
START_LIMIT_S = 15.0
SILENT_RIG_S = 10.0
WARN_LAG_S = 2.0
UNUSED_S = 5.0
_POLL_S = 0.05
_DRIFT_EVERY_S = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Ended:
    """Why a run came to its end; `failed` where it should have gone on."""

    text: str
    failed: bool = False
    stopped: StopRequestedError | None = None


class EventQueue(Protocol):
    """Where events wait; a `queue.SimpleQueue` is one."""

    def get(self, *, timeout: float) -> Event:
        """Return the next event; raise `queue.Empty` if none comes in time."""
        ...

    def get_nowait(self) -> Event:
        """Return the next event; raise `queue.Empty` if none waits."""
        ...


class RunListener(Protocol):
    """Gets what a run learns beside scans."""

    def on_odometry(self, sample: TumSample) -> None:
        """Take a pose of the wheels."""

    def on_wire(self, event: WireCame) -> None:
        """Take raw bytes of a port."""

    def on_link(self, event: LinkSaid) -> None:
        """Take a line of a radar's protocol log."""

    def say(self, who: str, text: str, *, warning: bool) -> None:
        """Take what the user should know; `who` is a radar, the odometry or the run."""


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
    inbox
        Where the threads' events are.
    listener
        Gets everything beside the scans, in this thread.
    check
        Called often; may raise StopRequestedError to stop.
    duration_s
        When to end; None: never.
    clock_ns
        The host's monotonic time, that of the drivers' arrivals.

    Attributes
    ----------
    clocks
        Of every radar, in the order of the rig.
    ended
        Why `scans` came to its end.
    worst_lag_s
        How long ago a tick was over when SLAM got it, at worst.
    busy_s
        Time spent by whoever took the scans.
    lost_frames
        Frames missing between the counters that arrived, over all radars.
    """

    def __init__(  # noqa: PLR0917 - everything a run consists of
        self,
        radars: tuple[RadarInfo, ...],
        limits: tuple[float, float] | None,
        odometry: LiveOdometry,
        inbox: EventQueue,
        listener: RunListener,
        check: Callable[[], None],
        *,
        duration_s: float | None = None,
        clock_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._radars, self._limits = radars, limits
        self._odometry, self._inbox, self._listener = odometry, inbox, listener
        self._check, self._duration_s, self._clock_ns = check, duration_s, clock_ns
        self._unix_ns = time.time_ns() - time.monotonic_ns()
        self._assembler = TickAssembler(len(radars), round(NS_PER_S / radars[0].rate_hz), odometry)
        self._began_ns = clock_ns()
        self._all_lost_ns: int | None = None
        self._last_counters: list[int | None] = [None] * len(radars)
        self._drift_told_ns = self._began_ns
        self._lag_told_s = WARN_LAG_S
        self._unused_since_ns: int | None = None
        self._unused_told = False
        self.clocks = tuple(ArrivalClock(radar.rate_hz) for radar in radars)
        self.ended: Ended | None = None
        self.worst_lag_s = self.busy_s = 0.0
        self.lost_frames = 0

    @property
    def lag_s(self) -> float:
        """How long ago the newest tick given out was over."""
        return self._assembler.lag_ns / NS_PER_S

    @property
    def n_unused(self) -> int:
        """Scans recorded that SLAM did not use."""
        return self._assembler.n_unused

    @property
    def n_left_out(self) -> int:
        """Frames that came too late for SLAM and are only recorded."""
        return self._assembler.n_left_out

    @property
    def odometry_drift_ppm(self) -> float | None:
        """How fast the odometry's clock is against the host's; None where it is told otherwise."""
        return self._odometry.drift_ppm

    def settle(self) -> int:
        """Listen until every clock is known a little; return the session time of the first scan.

        Raises
        ------
        AppError
            A radar or the odometry says nothing.
        StopRequestedError
            As `check` raises it.
        """
        ready_ns: int | None = None
        while True:
            self._check()
            self._drain(_POLL_S)
            now_ns = self._clock_ns()
            waited_s = (now_ns - self._began_ns) / NS_PER_S
            silent = [
                radar.name
                for radar, last in zip(self._radars, self._last_counters, strict=True)
                if last is None
            ]
            if silent and waited_s > START_LIMIT_S:
                raise AppError(f"radar {', '.join(silent)}: no frame in {START_LIMIT_S:g} s")
            if self._odometry.ended and not self._odometry.has_pose:
                raise AppError(self._odometry.trouble)
            if text := self._odometry.dead(now_ns, self._began_ns):
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
            if text := self._odometry.is_elsewhere(now_ns):
                raise AppError(text)
            if self._odometry.session_ns(now_ns) < NS_PER_S:
                continue  # no session holds what was before 0
            self._assembler.begin(start_ns)
            return start_ns

    def scans(self) -> Iterator[Scan]:
        """Yield scans until the run ends; `ended` says why it did."""
        while self.ended is None:
            try:
                self._check()
            except StopRequestedError as stopped:
                self.ended = Ended(text=str(stopped), stopped=stopped)
                break
            self._drain(_POLL_S)
            while (scan := self._next_scan()) is not None:
                started_ns = self._clock_ns()
                yield scan
                self.busy_s += (self._clock_ns() - started_ns) / NS_PER_S
                self._drain(0.0)
            self._judge()
        self._tell_drifts()

    def _next_scan(self) -> Scan | None:
        if self.ended is not None:
            return None
        scan = self._assembler.next_scan(self._odometry.session_ns(self._clock_ns()))
        if scan is None:
            return None
        assert self._assembler.start_ns is not None
        elapsed_s = (scan.t_ns - self._assembler.start_ns) / NS_PER_S
        if self._duration_s is not None and elapsed_s >= self._duration_s:
            self.ended = Ended(text=f"the {self._duration_s:g} s asked for are over")
            return None
        self._note_lag()
        self._note_unused(scan)
        return scan

    def _drain(self, wait_s: float) -> None:
        """Take all events there are; wait for the first one if there is none."""
        try:
            self._take(self._inbox.get(timeout=wait_s) if wait_s else self._inbox.get_nowait())
            while True:
                self._take(self._inbox.get_nowait())
        except Empty:
            return

    def _take(self, event: Event) -> None:
        match event:
            case FrameCame():
                self._take_frame(event.radar, event.frame)
            case OdometryLine():
                sample, words = self._odometry.take(event.text, event.arrival_ns)
                if words:
                    self._listener.say("odometry", words, warning=True)
                if sample is not None:
                    self._listener.on_odometry(sample)
            case OdometryEnded():
                self._odometry.end(event.trouble)
                self._listener.say(
                    "odometry", event.trouble or "ended", warning=bool(event.trouble)
                )
            case RadarLost():
                self._assembler.lost(event.radar)
                left = len(self._assembler.alive)
                self._listener.say(
                    self._radars[event.radar].name,
                    f"{event.text}; the run goes on with {left} of {len(self._radars)} radars",
                    warning=True,
                )
            case RadarBack():
                self._assembler.back(event.radar)
                text = f"is back, at {event.port}"
                self._listener.say(self._radars[event.radar].name, text, warning=True)
            case LinkSaid():
                self._listener.on_link(event)
            case WireCame():
                self._listener.on_wire(event)

    def _take_frame(self, radar: int, frame: Frame) -> None:
        info = self._radars[radar]
        last = self._last_counters[radar]
        if last is not None and frame.counter > last:
            self.lost_frames += frame.counter - last - 1
        self._last_counters[radar] = frame.counter
        taken_ns = self.clocks[radar].stamp_ns(frame.counter, frame.arrival_ns)
        if not self._odometry.has_pose:
            return  # nobody knows session time yet
        made = radar_frame(radar, frame, info.rate_hz, limits=self._limits)
        self._assembler.take(
            ReceivedFrame(
                frame=replace(made, t_ns=self._odometry.session_ns(taken_ns)),
                host_ns=frame.arrival_ns + self._unix_ns,
            )
        )

    def _note_lag(self) -> None:
        lag_s = self.lag_s
        self.worst_lag_s = max(self.worst_lag_s, lag_s)
        if lag_s > self._lag_told_s:
            self._lag_told_s = 2.0 * lag_s
            self._listener.say(
                "run",
                f"SLAM is {lag_s:.1f} s behind the radars: this machine is too slow, or busy with "
                "something else; all frames are recorded",
                warning=True,
            )

    def _note_unused(self, scan: Scan) -> None:
        """Say it where SLAM has stood still for long: its clock may be another one by now."""
        if scan.used:
            self._unused_since_ns = None
        elif self._unused_since_ns is None:
            self._unused_since_ns, self._unused_told = scan.t_ns, False
        elif scan.t_ns - self._unused_since_ns > UNUSED_S * NS_PER_S and not self._unused_told:
            self._unused_told = True
            self._listener.say(
                "run",
                f"SLAM got no scan for {UNUSED_S:g} s, as odometry does not cover their time or "
                "they came too late; they are recorded. Was a clock set?",
                warning=True,
            )

    def _judge(self) -> None:
        """Say how clocks drift, and end a run that cannot go on."""
        now_ns = self._clock_ns()
        if now_ns - self._drift_told_ns > _DRIFT_EVERY_S * NS_PER_S:
            self._drift_told_ns = now_ns
            self._tell_drifts()
        if self.ended is not None:
            return
        if self._assembler.ended:
            self.ended = Ended(text=self._odometry.trouble or "odometry ended")
            if self._odometry.trouble:
                self.ended = replace(self.ended, failed=True)
        elif text := self._odometry.dead(now_ns, self._began_ns):
            self.ended = Ended(text=text, failed=True)
        elif self._assembler.alive:
            self._all_lost_ns = None
        elif self._all_lost_ns is None:
            self._all_lost_ns = now_ns
        elif now_ns - self._all_lost_ns > SILENT_RIG_S * NS_PER_S:
            self.ended = Ended(text=f"no radar for {SILENT_RIG_S:g} s", failed=True)

    def _tell_drifts(self) -> None:
        for info, clock in zip(self._radars, self.clocks, strict=True):
            self._listener.say(info.name, drift_text(clock), warning=False)


def drift_text(clock: ArrivalClock) -> str:
    """Return a clock's drift against the host's, for people."""
    return (
        f"clock {clock.drift_ppm:+.2f} ppm against this machine's, "
        f"+-{clock.drift_sigma_ppm:.2f} over {clock.baseline_s:.0f} s"
    )

"""`uwb-slam run`: SLAM on real modules, or on a running emulator, in real time."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from queue import SimpleQueue

import numpy as np

from slam.app.errors import AppError, UsageError
from slam.app.odometry.live import FixedClock, LineSource, LiveOdometry, parse_source
from slam.app.odometry.tum import NS_PER_S, TumSample
from slam.app.records import LogLine, RadarInfo, Scan, SessionInfo, SessionObserver, Snapshot
from slam.app.rig.emulated import RAW_CONFIG, versions
from slam.app.rig.files import are_emulated, load_rig, open_rig
from slam.app.rig.sources import RigSource, sampler_limits
from slam.app.run.live_source import (
    Inbox,
    LinkSaid,
    LiveSource,
    Readers,
    WireCame,
    drift_text,
    tap_wire,
)
from slam.app.run.output import Progress, Row, print_run_table
from slam.app.run.results import RESULTS, prepare_folder, write_results
from slam.app.run.runner import LinkLog, RunRecord, nobody_knows, run_slam
from slam.app.session.log import SessionLog
from slam.app.session.mcap import CannotWriteError
from slam.app.session.messages import settings_text
from slam.app.view.viewer import LiveView
from slam.config import ConfigError, load_preset
from slam.geometry import Rig
from slam.pipelines import make_slam
from xethru_protocol.system import StopFlag


class LoggingListener(SessionObserver):
    """Hands on what a run learns beside scans; keeps odometry until the log is there.

    A log that cannot be written any more is said once, and the run goes on without.

    Attributes
    ----------
    link_log
        Gets what is said about the link.
    log_trouble
        Why the log is not whole; "" where it is.
    """

    def __init__(self) -> None:
        self.link_log = LinkLog()
        self.log_trouble = ""
        self._log: SessionLog | None = None
        self._has_begun = False
        self._early: list[TumSample] = []

    def attach(self, log: SessionLog, *others: SessionObserver) -> None:
        """Begin to write; let the others hear what is said, too."""
        self._log, self._has_begun = log, True
        early, self._early = self._early, []
        for sample in early:
            self.on_odometry(sample)
        self.link_log.attach(self, *others)

    def on_odometry(self, sample: TumSample) -> None:
        """Write a pose of the wheels."""
        if self._has_begun:
            self._write(lambda log: log.on_odometry(sample))
        else:
            self._early.append(sample)

    def on_wire(self, event: WireCame) -> None:
        """Write raw bytes of a port; those that came before the log was there are not kept."""
        self._write(lambda log: log.on_wire(event.radar, event.way, event.data, event.host_ns))

    def on_link(self, event: LinkSaid) -> None:
        """Take a line of a radar's protocol log."""
        self.link_log.on_record(event.radar, event.record)

    def say(self, who: str, text: str, *, warning: bool) -> None:
        """Take what the user should know; `who` is a radar, the odometry or the run."""
        self.link_log.say(who, text, warning=warning)

    def on_scan(self, scan: Scan) -> None:
        """Write a scan."""
        self._write(lambda log: log.on_scan(scan))

    def on_snapshot(self, snapshot: Snapshot) -> None:
        """Write a state."""
        self._write(lambda log: log.on_snapshot(snapshot))

    def on_log(self, line: LogLine) -> None:
        """Write a line about the link."""
        self._write(lambda log: log.on_log(line))

    def end_log(self) -> None:
        """Close the log; that its last chunk does not fit is no reason to lose the results."""
        if self._log is None:
            return
        try:
            self._log.close()
        except CannotWriteError as error:
            self.log_trouble = str(error)
        self._log = None

    def _write(self, write: Callable[[SessionLog], None]) -> None:
        if self._log is None:
            return
        try:
            write(self._log)
        except CannotWriteError as error:
            self._log = None
            self.log_trouble = str(error)
            self.say("run", f"{error}; the run goes on and is not recorded", warning=True)


SESSION = "session.mcap"
STALE = ("session.rrd", "report.html")
"""What other commands make of a session; of an earlier one it would mislead."""
TIME_BASE = "arrival"


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """What the command line of `uwb-slam run` says; `clock` as `parse_clock` takes it."""

    rig: Path
    odometry: str
    ports: tuple[str, ...] | None
    out: Path
    preset: str
    fps: int
    clock: str
    duration_s: float | None
    wire: bool = False
    rerun: str | None = None


def run_rig(options: RunOptions, stop: StopFlag) -> None:
    """Run SLAM on a rig until odometry ends, the time is over, or a signal comes.

    Whatever ends it, what was driven until then is recorded, mapped and summed up.

    Raises
    ------
    AppError
        It could not begin, or had to end early; one line.
    StopRequestedError
        A signal ended it.
    """
    rig_file = load_rig(options.rig)
    try:
        config = load_preset(options.preset)
    except ConfigError as error:
        raise UsageError(str(error)) from None
    place = parse_source(options.odometry)
    odometry = LiveOdometry(place.name, parse_clock(options.clock, place))
    inbox: Inbox = SimpleQueue()
    with ExitStack() as held:
        if (options.out / SESSION).exists():
            raise AppError(
                f"{options.out}: holds the session of an earlier drive, which cannot be repeated; "
                "choose another --out, or move it away"
            )
        prepare_folder(options.out, (*RESULTS, *STALE), held)
        live = None
        if options.rerun is not None:
            live = held.enter_context(LiveView(options.rerun, stop.check))
        links = open_rig(
            rig_file,
            options.rig,
            options.ports,
            lambda radar, record: inbox.put(LinkSaid(radar=radar, record=record)),
            _note,
        )
        rig_source = held.enter_context(RigSource(links))
        if options.wire:
            for link in links:
                tap_wire(link, inbox)
        stop.check()
        rig_source.start(RAW_CONFIG, options.fps)
        wheels = rig_file.wheels.noise
        info = SessionInfo(
            scene=options.rig.stem,
            preset=options.preset,
            seed=None,
            radars=rig_source.radars,
            true_landmarks_m=np.empty((0, 2)),
            versions=versions(),
            config_json=settings_text(config),
            wheels=asdict(wheels),
            simulated=are_emulated(links),
            time_base=TIME_BASE,
        )
        slam = make_slam(config, rig_file.rig, wheels)
        listener = LoggingListener()
        source = LiveSource(
            rig_source.radars,
            sampler_limits(RAW_CONFIG),
            odometry,
            inbox,
            listener,
            stop.check,
            duration_s=options.duration_s,
        )
        with Readers(links, place, inbox):
            start_ns = source.settle()
            log = SessionLog(options.out / SESSION, info, start_ns=start_ns)
            held.callback(log.close)
            progress = Progress(
                info, None, lambda: source.lost_frames, also=lambda: _lag_text(source)
            )
            watchers = [live.observer(info)] if live is not None else []
            observers: list[SessionObserver] = [listener.link_log, listener, progress, *watchers]
            listener.attach(log, progress, *watchers)
            with ExitStack() as shown:
                for watcher in watchers:
                    shown.callback(watcher.close)
                shown.callback(progress.close)
                record = run_slam(
                    source.scans(),
                    odometry,
                    slam,
                    nobody_knows,
                    observers,
                    gains_db=[radar.gain_db for radar in info.radars],
                )
        listener.end_log()
        rig_source.close()  # while a page is served, others may have the modules
        _finish(options, info, record, rig_file.rig, source, listener)
        if live is not None:
            sys.stdout.flush()
            live.keep_serving()


def parse_clock(text: str, source: LineSource) -> FixedClock | None:
    """Return the odometry's clock; None where the arrival of its lines tells the time.

    Parameters
    ----------
    text
        `arrival`; `unix`, seconds since 1970; `monotonic`, this machine's CLOCK_MONOTONIC; or
        that clock's nanoseconds at stamp 0, as an emulator's ready line has it.
    source
        Where the lines come from.

    Raises
    ------
    UsageError
        It is none of these, or a file is to tell the time by its arrival.
    """
    if text == "arrival":
        if not source.is_live:
            raise UsageError(
                f"odometry from {source.name}: its lines are all there at once, so they do not "
                "tell the time; say what its stamps are with --odometry-clock"
            )
        return None
    if text == "unix":
        return FixedClock(time.monotonic_ns() - time.time_ns())
    if text == "monotonic":
        return FixedClock(0)
    if re.fullmatch(r"[0-9]{1,18}", text):  # of 63 bits
        return FixedClock(int(text))
    raise UsageError(
        f"--odometry-clock {text}: must be arrival, unix, monotonic, or the monotonic "
        "nanoseconds at stamp 0"
    )


def _finish(  # noqa: PLR0917 - everything a run ends with
    options: RunOptions,
    info: SessionInfo,
    record: RunRecord,
    rig: Rig,
    source: LiveSource,
    listener: LoggingListener,
) -> None:
    print_run_table(
        info,
        record,
        lost_frames=source.lost_frames,
        stream=sys.stdout,
        also=_rows(info.radars, record, source),
    )
    write_results(options.out, info, record, rig)
    ended = source.ended
    assert ended is not None
    kept = f"; {listener.log_trouble or f'what was recorded is in {options.out}'}"
    if ended.stopped is not None:
        raise type(ended.stopped)(ended.stopped.received, kept)
    if ended.failed:
        raise AppError(f"{ended.text}{kept}")
    if listener.log_trouble:
        raise AppError(listener.log_trouble)
    _note(f"{ended.text}{kept}")


def _rows(radars: tuple[RadarInfo, ...], record: RunRecord, source: LiveSource) -> list[Row]:
    load = source.busy_s / max(record.duration_ns / NS_PER_S, 1e-9)
    rows = [
        (
            "load",
            f"{100 * load:.0f} %",
            f"of real time spent in SLAM and logs; at worst {source.worst_lag_s:.2f} s behind",
        ),
        (
            "left out",
            f"{source.n_unused}",
            f"scans recorded without SLAM; {source.n_left_out} frames came too late",
        ),
    ]
    if (drift_ppm := source.odometry_drift_ppm) is not None:
        rows.append(("odometry", f"{drift_ppm:+.2f} ppm", "clock against this machine's"))
    for radar, clock in zip(radars, source.clocks, strict=True):
        drift, _, rest = drift_text(clock).removeprefix("clock ").partition(" against")
        rows.append((radar.name, drift, f"clock against{rest}"))
    return rows


def _lag_text(source: LiveSource) -> str:
    return f"  {source.lag_s:.1f} s behind" if source.lag_s >= 1.0 else ""


def _note(text: str) -> None:
    sys.stderr.write(f"uwb-slam: {text}\n")
    sys.stderr.flush()

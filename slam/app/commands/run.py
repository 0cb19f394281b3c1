"""`uwb-slam run`: SLAM on real modules, or on a running emulator, in real time."""

from __future__ import annotations

import atexit
import gc
import re
import signal
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from functools import partial
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Self, Unpack

import numpy as np

from slam.app.errors import UsageError
from slam.app.odometry.live import LineSource, LiveOdometry, SourceKind, parse_source
from slam.app.publish.sinks import Publishing
from slam.app.rig.emulated import RAW_CONFIG, versions, with_settings_in_use
from slam.app.rig.rig_files import load_rig
from slam.app.run.live_source import (
    LiveLog,
    LiveSource,
    SpacingWarning,
    drift_text,
    read_odometry,
)
from slam.app.run.maps import MapOptions, MapSaver, map_use
from slam.app.run.output import ResultRow, RunProgress, note
from slam.app.run.radar_image import RollingImage
from slam.app.run.result_files import (
    REPORT,
    RESULTS,
    SESSION,
    SMOOTHED,
    VIEW,
    finish,
    hold_folder,
    remove_earlier,
    write_smoothed,
)
from slam.app.run.runner import RunRecord, RunSource, StepGivenUpError, execute
from slam.app.session.constants import slam_constants
from slam.app.session.writer import SessionLog
from slam.app.view.viewer import LiveView
from slam.config import BackEnd, ConfigError, SlamConfig, load_preset
from slam.frames import RadarFrame
from slam.front_end.pulse import nominal_pulse
from slam.imaging.patches import longest_spacing_m
from slam.library.slam import make_slam
from slam.live.arrival_clock import ClockLine
from slam.live.errors import AppError
from slam.live.frame_sources import RigSource, sampler_limits
from slam.live.modules import are_emulated, open_modules
from slam.live.odometry_track import NS_PER_S
from slam.live.session.description import settings_text
from slam.live.session_records import SessionInfo, SessionObserver
from slam.live.ticks import MOST_WAIT_NS, Inbox, reading
from slam.results import Pipeline, PoseAt, SmoothedRun, StepResult
from xethru_protocol.operating_system import StopFlag, StopRequestedError

_STALE = (VIEW, REPORT)
"""Made from a session by other commands; those of an earlier session would mislead."""
_STEP_LIMIT_S = 0.3
_LATE_NS = 200_000_000
"""Where a scan waited longer for SLAM, nothing is added to the radar image."""


def run_rig(
    stop: StopFlag,
    *,
    rig: str,
    odometry: str,
    ports: list[str] | None,
    out: Path,
    preset: str,
    fps: int,
    clock: str,
    duration_s: float | None,
    settings: Sequence[tuple[str, str]] = (),
    covariance: bool = False,
    wire: bool = False,
    lean: bool = False,
    has_image: bool = True,
    rerun: str | None = None,
    publish: Sequence[str] = (),
    **maps: Unpack[MapOptions],
) -> None:
    """Run SLAM on a rig until odometry ends, the time is over, or a signal comes.

    Whatever ends it, what was driven until then is recorded, mapped and summed up.

    Raises
    ------
    AppError
        It could not begin, or had to end early; one line.
    StopRequestedError
        A signal ended it.
    """
    rig_file = load_rig(rig)
    config = _configured(preset, settings)
    if covariance and config.back_end is not BackEnd.ROBUST:
        raise UsageError("--odometry-covariance: preset paper has a noise of its own; use robust")
    begin = map_use(config, maps)
    line_source = parse_source(odometry)
    live_odometry = LiveOdometry(
        line_source.name, parse_clock(clock, line_source), has_covariance=covariance
    )
    inbox = Inbox()
    with ExitStack() as held:
        if (out / SESSION).exists():
            raise AppError(
                f"{out}: holds the session of an earlier drive, which cannot be repeated; "
                "choose another --out, or move it away"
            )
        hold_folder(out, held)
        publishing = held.enter_context(Publishing(publish))
        requests = SmoothingRequests(out)
        held.enter_context(requests.caught())
        view = held.enter_context(LiveView(rerun, stop)) if rerun is not None else None
        links = open_modules(
            rig_file,
            rig,
            None if ports is None else tuple(ports),
            lambda radar, record: inbox.offer(("link", radar, record)),
            note,
            odometry_socket=line_source.place if line_source.kind is SourceKind.UNIX else "",
        )
        rig_source = held.enter_context(RigSource(links))
        if wire:
            rig_source.listen(
                lambda radar, way, data, host_ns: inbox.offer(("wire", radar, way, data, host_ns))
            )
        stop.check()
        rig_source.start(RAW_CONFIG, fps)
        slam = make_slam(
            config,
            rig_file.rig,
            rig_file.wheels.noise,
            noise_at=live_odometry.noise_at if covariance else None,
            on_map=begin.on_map,
        )
        prompt = held.enter_context(PromptSteps(slam, stop))
        log = LiveLog()
        live = LiveSource(
            rig_source.radars,
            sampler_limits(RAW_CONFIG),
            live_odometry,
            inbox,
            log,
            stop,
            duration_s=duration_s,
        )
        with reading(links, inbox, odometry=partial(read_odometry, line_source)) as end_reading:
            _prepare_the_end()
            start_ns = live.settle()
            info = SessionInfo(
                scene=Path(rig).stem,
                preset=preset,
                seed=None,
                radars=rig_source.radars,
                true_landmarks_m=np.empty((0, 2)),
                versions=versions(),
                config_json=settings_text(config),
                constants=slam_constants(),
                wheels=asdict(rig_file.wheels.noise),
                simulated=are_emulated(links),
                time_base="arrival",
                # stamps of ROS are the time of day, or of a simulation that all programs share
                started_unix_ns=(
                    0
                    if clock == "unix" or line_source.kind is SourceKind.ROS2
                    else live.started_unix_ns()
                ),
                odometry_clock=clock,
                odometry_covariance=covariance,
                map_json=begin.text,
            )
            source = RunSource(
                info=info,
                rig=rig_file.rig,
                slam=slam,
                scans=live.scans(),
                odometry=live_odometry,
                lost_frames=lambda: live.lost_frames,
                link_log=log,
                smoothing_asked=requests.asked,
                map_file=begin.file,
                step=prompt.step,
            )
            map_saver = MapSaver(maps.get("save_map"), slam, info)
            remove_earlier(out, (*RESULTS, *_STALE))
            session_log = SessionLog(out / SESSION, info, start_ns=start_ns, drawn=not lean)
            held.callback(session_log.close)
            log.begin(session_log, start_ns)
            shown = [view.observer(info)] if view is not None else []
            image = RollingImage(
                *(info, live_odometry, [log, publishing, *shown]),
                is_late=lambda: live.ticks.wait_ns > _LATE_NS,
            )
            sinks: list[SessionObserver] = [
                publishing,  # before what takes time
                RunProgress(info, source.lost_frames, also=lambda: _dropped_text(live)),
                requests,
                map_saver,
                SpacingWarning(
                    longest_spacing_m(
                        nominal_pulse(config.matched_filter).model, info.field_of_view
                    ),
                    *(live_odometry, log),
                ),
                *([image] if has_image else []),
                *shown,
            ]
            publishing.begin(info, log.log, start_ns)
            record = execute(source, sinks)
            end_reading()  # the modules are stopped while the results are written
            # without the flag: the signal that ended the drive does not end the writing
            finish(
                out,
                source,
                record,
                StopFlag(),
                _rows(record, live, live_odometry, prompt, image),
                publishing=publishing,
                map_saver=map_saver,
            )
        rig_source.close()  # while a page is served, others may have the modules
        _report_end(live, log, out)
        if view is not None:
            view.keep_serving()


def _prepare_the_end() -> None:
    """Do early what would take most of the second after Ctrl-C.

    Matplotlib is loaded for the map; and the interpreter need not search half a million objects for
    cycles when it exits.
    """
    import_module("slam.app.run.pictures")
    atexit.register(gc.freeze)


class PromptSteps:
    """Steps SLAM, and gives up the step in hand if it takes longer than 0.3 s after a signal.

    A step may take seconds on a busy machine, and must not hold up the end of a run in real time.
    It watches the flag while it is entered, in the main thread. `step` raises StepGivenUpError.
    """

    def __init__(self, slam: Pipeline, stop: StopFlag) -> None:
        self._slam, self._stop = slam, stop
        self._in_step = False
        self.n_given_up = 0
        self._cleanup = ExitStack()

    def __enter__(self) -> Self:
        previous = signal.signal(signal.SIGALRM, self._give_up)
        self._cleanup.callback(signal.signal, signal.SIGALRM, previous)
        self._cleanup.callback(signal.setitimer, signal.ITIMER_REAL, 0.0)
        self._cleanup.callback(self._stop.detach)
        self._stop.attach(self._set_alarm)
        return self

    def __exit__(self, *_: object) -> None:
        self._cleanup.close()

    def step(
        self, frames: Sequence[RadarFrame], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        try:
            self._in_step = True
            return self._slam.step(frames, pose_at, t_ns)
        finally:
            self._in_step = False

    def _set_alarm(self) -> None:
        signal.setitimer(signal.ITIMER_REAL, _STEP_LIMIT_S)

    def _give_up(self, number: int, frame: FrameType | None) -> None:
        if self._in_step:
            self.n_given_up += 1
            raise StepGivenUpError


class SmoothingRequests(SessionObserver):
    """Answers SIGUSR1 with the path smoothed so far: `smoothed.tum` in a folder.

    Other sinks, as the session and a live view, get it, too. The scans wait for the solution.
    """

    def __init__(self, out: Path) -> None:
        self._out = out
        self._is_asked = False
        self._asked_s: float | None = None

    @contextmanager
    def caught(self) -> Iterator[None]:
        """Catch the signal in the main thread until this is left.

        That is after the sinks are closed, because results are written then.
        """
        previous = signal.signal(signal.SIGUSR1, self._ask)
        try:
            yield
        finally:
            signal.signal(signal.SIGUSR1, previous)

    def asked(self) -> bool:
        """Return whether a signal came since the last call."""
        is_asked, self._is_asked = self._is_asked, False
        if self._asked_s is not None:
            self._asked_s = None
            note("SIGUSR1: there is no smoothed path")
        if is_asked:
            self._asked_s = time.monotonic()
        return is_asked

    def on_smoothed(self, smoothed: SmoothedRun) -> None:
        if self._asked_s is None:
            return  # the end of the run: `finish` writes its results
        path, took_s = self._out / SMOOTHED, time.monotonic() - self._asked_s
        self._asked_s = None
        try:
            write_smoothed(self._out, smoothed)
        except AppError as error:
            note(str(error))
        else:
            note(f"{path} has {len(smoothed.t_ns)} states, solved for in {took_s:.2f} s")

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self._is_asked = True


def parse_clock(text: str, source: LineSource) -> ClockLine | None:
    """Return the odometry's clock; None if the arrival of its lines gives the time.

    `text` is `arrival`; `unix`, seconds since 1970; `monotonic`, this machine's CLOCK_MONOTONIC; or
    that clock's nanoseconds at stamp 0, as in an emulator's ready line.

    Raises
    ------
    UsageError
        The text is another, or the lines of a file are to give the time by their arrival.
    """
    if text == "arrival":
        if not source.is_live:
            raise UsageError(
                f"odometry from {source.name}: its lines are all there at once, so they do not "
                "tell the time; say what its stamps are with --odometry-clock"
            )
        return None
    if text == "unix":
        return ClockLine(origin_ns=time.monotonic_ns() - time.time_ns())
    if text == "monotonic":
        return ClockLine(origin_ns=0)
    if re.fullmatch(r"[0-9]{1,18}", text):  # of 63 bits
        return ClockLine(origin_ns=int(text))
    raise UsageError(
        f"--odometry-clock {text}: must be arrival, unix, monotonic, or the monotonic "
        "nanoseconds at stamp 0"
    )


def _report_end(live: LiveSource, log: LiveLog, out: Path) -> None:
    """Print why a run ended, or raise if it had to end early or was not recorded."""
    ended = live.ended
    kept = f"; {log.failure or f'what was recorded is in {out}'}"
    if isinstance(ended, StopRequestedError):
        raise StopRequestedError(ended.received, kept)
    if isinstance(ended, AppError):
        raise AppError(f"{ended}{kept}")
    if log.failure:
        raise AppError(log.failure)
    note(f"{ended}{kept}")


def _rows(
    record: RunRecord,
    live: LiveSource,
    odometry: LiveOdometry,
    prompt: PromptSteps,
    image: RollingImage,
) -> list[ResultRow]:
    left_out = live.ticks.n_unused - live.ticks.n_dropped + prompt.n_given_up
    load = live.busy_s / max(record.duration_ns / NS_PER_S, 1e-9)
    rows = [
        (
            "load",
            f"{100 * load:.0f} %",
            f"of real time spent in SLAM and logs; a scan waited {live.worst_wait_s:.2f} s at most",
        ),
        (
            "dropped",
            f"{live.ticks.n_dropped}",
            f"scans that waited longer than {MOST_WAIT_NS / NS_PER_S:g} s for SLAM: recorded, "
            "not used",
        ),
        (
            "left out",
            f"{left_out}",
            f"more scans recorded without SLAM; {live.ticks.n_left_out} frames came too late",
        ),
    ]
    if image.n_left_out:
        text = f"of the radar image, {image.n_left_out} left out while SLAM was late"
        rows.append(("patches", f"{image.n_patches}", text))
    if (drift_ppm := odometry.drift_ppm) is not None:
        rows.append(("odometry", f"{drift_ppm:+.2f} ppm", "clock against this machine's"))
    for radar, clock in zip(live.radars, live.clocks, strict=True):
        drift, _, rest = drift_text(clock).removeprefix("clock ").partition(" against")
        rows.append((radar.name, drift, f"clock against{rest}"))
    return rows


def _dropped_text(live: LiveSource) -> str:
    return f"  {live.ticks.n_dropped} scans dropped" if live.ticks.n_dropped else ""


def _configured(preset: str, settings: Sequence[tuple[str, str]]) -> SlamConfig:
    try:
        config = load_preset(preset)
    except ConfigError as error:
        raise UsageError(str(error)) from None
    return with_settings_in_use(config, settings)

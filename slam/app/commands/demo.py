"""`uwb-slam demo`: the emulated robot, its radars on serial ports, SLAM while frames arrive."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, Protocol

from emulator.scene.scene import Scene
from slam.app.errors import AppError, EmulatorError, RadarSilentError, naming
from slam.app.odometry.track import read_odometry_socket
from slam.app.records import RadarInfo, SessionInfo, SessionObserver
from slam.app.rig.emulated import (
    FRAME_RATE_HZ,
    RAW_CONFIG,
    EmulatorProcess,
    end_counter,
    open_ports,
    rig_of,
    scene_and_config,
    true_landmarks_m,
    versions,
    wheels_of,
)
from slam.app.rig.sources import RigSource
from slam.app.run.evaluation import summarise
from slam.app.run.output import Progress
from slam.app.run.output import print_summary as print_table
from slam.app.run.pictures import outlines_m
from slam.app.run.results import RESULTS, prepare_folder, saying_what_is_left, write_trajectories
from slam.app.run.runner import LinkLog, run_slam
from slam.app.session.log import SessionLog
from slam.app.session.messages import settings_text
from slam.app.view.viewer import LiveView
from slam.config import SlamConfig
from slam.pipelines import make_slam
from xethru_protocol.system import StopFlag


class WireSink(Protocol):
    """What takes the bytes; `SessionLog` does."""

    def on_wire(self, radar: str, way: Literal["rx", "tx"], data: bytes, host_ns: int) -> None:
        """Take bytes as a radar's port gave (rx) or took (tx) them, at a host time [ns]."""


class WireTap:
    """Listens at every port of a rig and keeps the bytes until somebody takes them.

    Modules answer for their settings before there is a log, which is told of these answers; the
    bytes of that time wait here.

    Parameters
    ----------
    source
        Radars whose drivers have not been used yet.
    """

    def __init__(self, source: RigSource) -> None:
        self._waiting: list[tuple[str, Literal["rx", "tx"], bytes, int]] = []
        self._sink: WireSink | None = None
        source.listen(self._on_bytes)

    def attach(self, sink: WireSink) -> None:
        """Pass on what came so far, and everything from now on."""
        self._sink = sink
        waiting, self._waiting = self._waiting, []
        for radar, way, data, host_ns in waiting:
            sink.on_wire(radar, way, data, host_ns)

    def _on_bytes(self, radar: str, way: Literal["rx", "tx"], data: bytes, host_ns: int) -> None:
        if self._sink is None:
            self._waiting.append((radar, way, data, host_ns))
        else:
            self._sink.on_wire(radar, way, data, host_ns)


OUTPUTS = ("session.mcap", "session.rrd", *RESULTS)
_STALE = ("report.html",)
"""What `uwb-slam report` made of an earlier run."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DemoOptions:
    """What the command line of `uwb-slam demo` says.

    `wire`: the ports' raw bytes are kept; `rerun`: where the run is watched live, see `LiveView`.
    """

    out: Path
    seed: int
    scene: str
    preset: str
    wire: bool = False
    rerun: str | None = None


def run_demo(options: DemoOptions, stop: StopFlag) -> None:
    """Run the emulated robot through its scene and write everything into one folder.

    The folder is this run's alone until it ends.

    Parameters
    ----------
    options
        Scene, seed, preset, folder.
    stop
        Asked between two scans, and between the steps after the last one.

    Raises
    ------
    AppError
        Something failed; one line. What was recorded until then is complete and readable.
    StopRequestedError
        A signal arrived; the same holds.
    """
    scene, config = scene_and_config(options.scene, options.preset)
    with ExitStack() as held:
        live = None
        if options.rerun is not None:  # before an earlier run's files are given up
            live = held.enter_context(LiveView(options.rerun, stop.check))
        prepare_folder(options.out, (*OUTPUTS, *_STALE), held)
        _run(options, scene, config, stop, live)
        if live is not None:
            sys.stdout.flush()
            live.keep_serving()


def _run(
    options: DemoOptions, scene: Scene, config: SlamConfig, stop: StopFlag, live: LiveView | None
) -> None:
    rig = rig_of(scene)
    trajectory = scene.trajectory()
    kept = f"; what was recorded is in {options.out}"
    with ExitStack() as stack:
        emulator = stack.enter_context(EmulatorProcess(options.scene, options.seed))
        # Half a second each, spent while the emulator starts.
        from slam.app.run.pictures import draw_map
        from slam.app.view.panels import RerunView

        emulator.wait_until_ready(stop.check)
        odometry = read_odometry_socket(emulator.odometry_socket)
        link_log = LinkLog()
        source = stack.enter_context(open_ports(emulator.devices, rig, link_log.on_record))
        tap = WireTap(source) if options.wire else None
        source.start(RAW_CONFIG, FRAME_RATE_HZ)
        info = _session_info(options, scene, config, source.radars)
        log = SessionLog(options.out / "session.mcap", info, odometry, truth_at=trajectory.poses)
        stack.callback(log.close)
        view = RerunView(options.out / "session.rrd", info)
        stack.push(_closing(view))
        watchers = [live.observer(info)] if live is not None else []
        for watcher in watchers:
            stack.callback(watcher.close)
        stack.callback(log.close)  # first: the record must not wait for the view
        progress = Progress(info, trajectory.duration_ns, lambda: source.lost_frames)
        stack.callback(progress.close)
        observers: list[SessionObserver] = [link_log, log, view, progress, *watchers]
        link_log.attach(log, view, progress, *watchers)
        if tap is not None:
            tap.attach(log)
        slam = make_slam(config, rig, wheels_of(scene))
        with saying_what_is_left(kept), source:  # closed before the logs, for its last words
            scans = source.scans(end_counter(trajectory.duration_ns), stop.check)
            try:
                record = run_slam(scans, odometry, slam, trajectory.poses, observers)
            except RadarSilentError as silent:
                cause = emulator.ended() or str(silent)
                # Ended before the drivers close: they need not wait for answers then.
                emulator.end()
                raise EmulatorError(f"{cause}{kept}") from None
    with saying_what_is_left(kept):
        stop.check()
        summary = summarise(
            record,
            scene=scene.name,
            preset=options.preset,
            seed=options.seed,
            rig=rig,
            true_landmarks_m=info.true_landmarks_m,
        )
        if summary is None:
            raise AppError(f"{options.scene}: too short for SLAM, no state was estimated{kept}")
        stop.check()
        write_trajectories(options.out, record)
        with naming(path := options.out / "summary.json"):
            path.write_text(summary.to_json() + "\n", encoding="ascii")
        stop.check()
        with naming(path := options.out / "map.png"):
            draw_map(path, info, record, summary, info.outlines_m)
        stop.check()
    print_table(
        summary,
        lag_states=config.window.size - 1,
        wall_s=record.wall_s,
        lost_frames=source.lost_frames,
        stream=sys.stdout,
    )


def _session_info(
    options: DemoOptions, scene: Scene, config: SlamConfig, radars: tuple[RadarInfo, ...]
) -> SessionInfo:
    return SessionInfo(
        scene=scene.name,
        preset=options.preset,
        seed=options.seed,
        radars=radars,
        true_landmarks_m=true_landmarks_m(scene),
        versions=versions(),
        config_json=settings_text(config),
        wheels=asdict(wheels_of(scene)),
        outlines_m=outlines_m(scene),
    )


def _closing(view: SessionObserver) -> Callable[..., bool]:
    """Close a view at the end of a run; what ended the run is told rather than what that did."""

    def close(_kind: object, error: BaseException | None, _trace: object) -> bool:
        try:
            view.close()
        except AppError:
            if error is None:
                raise
        return False

    return close

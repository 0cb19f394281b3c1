"""`uwb-slam demo`: the emulated robot, its radars on serial ports, SLAM while frames arrive."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from emulator.path_lock import PathInUseError, locked
from emulator.scene import Scene
from slam.app.emulated_rig import (
    FRAME_RATE_HZ,
    RAW_CONFIG,
    end_counter,
    open_ports,
    rig_of,
    scene_and_config,
    true_landmarks_m,
    versions,
    wheels_of,
)
from slam.app.emulator_process import EmulatorProcess
from slam.app.errors import AppError, EmulatorError, RadarSilentError, naming
from slam.app.evaluation import summarise
from slam.app.link_log import LinkLog
from slam.app.live_view import LiveView
from slam.app.odometry import read_odometry_socket
from slam.app.outlines import outlines_m
from slam.app.progress import Progress
from slam.app.report_table import print_table
from slam.app.runner import RunRecord, run_slam
from slam.app.session import RadarInfo, SessionInfo, SessionObserver
from slam.app.session_head import settings_text
from slam.app.session_log import SessionLog
from slam.app.stop import StopFlag, StopRequestedError
from slam.app.tum import Trajectory, write_tum
from slam.app.wire_tap import WireTap
from slam.config import SlamConfig
from slam.robust_pipeline import make_slam

OUTPUTS = (
    "session.mcap",
    "session.rrd",
    "map.png",
    "summary.json",
    "estimate.tum",
    "truth.tum",
    "odometry.tum",
)


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
        _prepare(options.out, held)
        live = None
        if options.rerun is not None:
            live = held.enter_context(LiveView(options.rerun, stop.check))
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
        from slam.app.map_picture import draw_map
        from slam.app.rerun_view import RerunView

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
        with _saying_what_is_left(kept), source:  # closed before the logs, for its last words
            scans = source.scans(end_counter(trajectory.duration_ns), stop.check)
            try:
                record = run_slam(scans, odometry, slam, trajectory.poses, observers)
            except RadarSilentError as silent:
                cause = emulator.ended() or str(silent)
                # Ended before the drivers close: they need not wait for answers then.
                emulator.end()
                raise EmulatorError(f"{cause}{kept}") from None
    with _saying_what_is_left(kept):
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
        _write_trajectories(options.out, record)
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


@contextmanager
def _saying_what_is_left(kept: str) -> Iterator[None]:
    """Let a stop by a signal say what was recorded until then."""
    try:
        yield
    except StopRequestedError as stopped:
        raise StopRequestedError(stopped.received, kept) from None


def _prepare(out: Path, held: ExitStack) -> None:
    """Make the folder, hold it, and remove an earlier run's files so that no two runs mix."""
    with naming(out):
        out.mkdir(parents=True, exist_ok=True)
        try:
            held.enter_context(locked(out))
        except PathInUseError:
            raise AppError(
                f"{out}: another run is writing there; wait for its end or choose another --out"
            ) from None
        for name in OUTPUTS:
            (out / name).unlink(missing_ok=True)


def _write_trajectories(out: Path, record: RunRecord) -> None:
    """Write estimate, truth and odometry at the stamps of SLAM's states."""
    stamps_ns = np.array([result.t_ns for result in record.results], dtype=np.int64)
    for name, poses in (
        ("estimate", np.array([result.belief.pose for result in record.results])),
        ("truth", record.truth),
        ("odometry", np.array([result.odometry_pose for result in record.results])),
    ):
        with naming(path := out / f"{name}.tum"):
            write_tum(path, Trajectory(stamps_ns=stamps_ns, poses=poses))

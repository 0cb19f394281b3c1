"""`uwb-slam demo`: the emulated robot, its radars on serial ports, SLAM while frames arrive."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Literal

from slam.app.errors import AppError, EmulatorError, RadarSilentError
from slam.app.odometry.track import read_odometry_socket
from slam.app.records import Scan, SessionInfo, SessionObserver
from slam.app.rig.emulated import (
    FRAME_RATE_HZ,
    RAW_CONFIG,
    EmulatorProcess,
    end_tick,
    open_ports,
    outlines_m,
    rig_of,
    scene_and_config,
    true_landmarks_m,
    versions,
    wheels_of,
)
from slam.app.rig.sources import RigSource
from slam.app.run.output import Progress
from slam.app.run.results import RESULTS, finish, prepare_folder, saying_what_is_left
from slam.app.run.runner import LinkLog, RunSource, execute, make_slam
from slam.app.session.constants import slam_constants
from slam.app.session.log import SessionLog
from slam.app.session.messages import settings_text
from slam.app.view.viewer import LiveView
from xethru_protocol.system import StopFlag

_OUTPUTS = ("session.mcap", "session.rrd", "report.html", *RESULTS)


def run_demo(
    stop: StopFlag,
    *,
    out: Path,
    seed: int,
    scene: str,
    preset: str,
    wire: bool = False,
    rerun: str | None = None,
) -> None:
    """Run the emulated robot through its scene and write everything into one folder.

    The folder is locked until the run ends. After an error or a signal, what was recorded until
    then is complete and readable.
    """
    loaded, config = scene_and_config(scene, preset)
    with ExitStack() as held:
        live = None
        if rerun is not None:  # before an earlier run's files are removed
            live = held.enter_context(LiveView(rerun, stop))
        prepare_folder(out, _OUTPUTS, held)
        kept = f"; what was recorded is in {out}"
        with ExitStack() as stack:
            emulator = stack.enter_context(EmulatorProcess(scene, seed))
            from slam.app.view.panels import RerunView  # a second, while the emulator starts

            emulator.wait_until_ready(stop)
            odometry = read_odometry_socket(emulator.odometry_socket)
            link_log = LinkLog()
            rig = rig_of(loaded)
            rig_source = stack.enter_context(
                open_ports(emulator.devices, rig, link_log.on_record, emulator.stream_begins_ns)
            )
            early_bytes: list[tuple[str, Literal["rx", "tx"], bytes, int]] = []
            if wire:  # the log needs the modules' answers before it can begin
                rig_source.listen(lambda *row: early_bytes.append(row))
            rig_source.start(RAW_CONFIG, FRAME_RATE_HZ)
            trajectory = loaded.trajectory()
            wheels = wheels_of(loaded)
            info = SessionInfo(
                scene=loaded.name,
                preset=preset,
                seed=seed,
                radars=rig_source.radars,
                true_landmarks_m=true_landmarks_m(loaded),
                versions=versions(),
                config_json=settings_text(config),
                constants=slam_constants(),
                wheels=asdict(wheels),
                outlines_m=outlines_m(loaded),
            )
            source = RunSource(
                info=info,
                rig=rig,
                slam=make_slam(config, rig, wheels),
                scans=_scans(rig_source, end_tick(trajectory.duration_ns), emulator, stop, kept),
                odometry=odometry,
                truth_at=trajectory.poses,
                lost_frames=lambda: rig_source.lost_frames,
                link_log=link_log,
                close=rig_source.close,
            )
            log = SessionLog(out / "session.mcap", info, odometry, truth_at=trajectory.poses)
            stack.callback(log.close)
            view = RerunView(out / "session.rrd", info)
            sinks: list[SessionObserver] = [
                Progress(info, trajectory.duration_ns, source.lost_frames),
                log,  # closed before the views: the record must not wait for them
                *([live.observer(info)] if live is not None else []),
                view,
            ]
            for row in early_bytes:
                log.on_wire(*row)
            if wire:
                rig_source.listen(log.on_wire)
            with saying_what_is_left(kept):
                record = execute(source, sinks)
        with saying_what_is_left(kept):
            stop.check()
            if record.last is None:
                raise AppError(f"{scene}: too short for SLAM, no state was estimated{kept}")
            finish(out, source, record, stop)
        if live is not None:
            live.keep_serving()


def _scans(
    rig_source: RigSource, end: int, emulator: EmulatorProcess, stop: StopFlag, kept: str
) -> Iterator[Scan]:
    try:
        yield from rig_source.scans(end, stop)
    except RadarSilentError as silent:
        cause = emulator.ended() or str(silent)
        emulator.end()  # before the drivers close, which then wait for no answers
        raise EmulatorError(f"{cause}{kept}") from None

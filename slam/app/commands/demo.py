"""`uwb-slam demo`: the emulated robot, its radars on serial ports, SLAM while frames arrive."""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from shlex import quote
from typing import Literal, Unpack

from slam.app.errors import EmulatorError
from slam.app.publish.sinks import Publishing
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
    with_settings_in_use,
)
from slam.app.run.maps import MapOptions, MapSaver, map_use
from slam.app.run.output import RunProgress, note, print_progress
from slam.app.run.radar_image import NoImageError, RollingImage, path_of, session_image
from slam.app.run.result_files import (
    IMAGE,
    REPORT,
    RESULTS,
    SESSION,
    VIEW,
    finish,
    hold_folder,
    remove_earlier,
)
from slam.app.run.runner import LinkLog, RunRecord, RunSource, execute
from slam.app.session.constants import slam_constants
from slam.app.session.writer import SessionLog
from slam.app.view.viewer import LiveView
from slam.config import BackEnd
from slam.front_end.numba_compilation import compile_kernels
from slam.library.slam import make_slam
from slam.live.errors import AppError, RadarSilentError
from slam.live.frame_sources import RigSource
from slam.live.odometry_track import OdometryTrack, read_odometry_socket
from slam.live.session.description import settings_text
from slam.live.session.reader import open_session
from slam.live.session_records import Scan, SessionInfo, SessionObserver
from xethru_protocol.operating_system import StopFlag, StopRequestedError
from xethru_protocol.optional_packages import install_command, what_is_missing

_PROGRAM = "uwb-slam"
_OUTPUTS = (SESSION, VIEW, REPORT, *RESULTS)


def run_demo(
    stop: StopFlag,
    *,
    out: Path,
    seed: int,
    scene: str,
    preset: str,
    settings: Sequence[tuple[str, str]] = (),
    wire: bool = False,
    lean: bool = False,
    has_image: bool = True,
    rerun: str | None = None,
    publish: Sequence[str] = (),
    **maps: Unpack[MapOptions],
) -> None:
    """Run the emulated robot through its scene and write everything into one folder.

    The folder is locked until the run ends. After a signal, or the end of the emulator, what was
    driven until then is recorded, mapped and summed up.
    """
    loaded, config = scene_and_config(scene, preset)
    config = with_settings_in_use(config, settings)
    begin = map_use(config, maps)
    with ExitStack() as held:
        hold_folder(out, held)
        publishing = held.enter_context(Publishing(publish))
        live = None
        if rerun is not None:  # before an earlier run's files are removed
            live = held.enter_context(LiveView(rerun, stop))
        kept = f"; what was recorded is in {out}"
        with ExitStack() as stack:
            emulator = stack.enter_context(EmulatorProcess(scene, seed))
            make_view = _rerun_view()  # a second, while the emulator starts

            if config.back_end is BackEnd.ROBUST:
                compile_kernels(before_each=stop.check)  # seconds the first time

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
            scans = _Scans(rig_source, end_tick(trajectory.duration_ns), emulator, stop)
            info = SessionInfo(
                scene=loaded.name,
                preset=preset,
                seed=seed,
                radars=rig_source.radars,
                true_landmarks_m=true_landmarks_m(loaded),
                versions=versions(),
                config_json=settings_text(config),
                constants=slam_constants(),
                wheels=asdict(wheels_of(loaded)),
                outlines_m=outlines_m(loaded),
                started_unix_ns=time.time_ns(),
                map_json=begin.text,
            )
            source = RunSource(
                info=info,
                rig=rig,
                slam=make_slam(config, rig, wheels_of(loaded), on_map=begin.on_map),
                scans=scans,
                odometry=odometry,
                truth_at=trajectory.poses,
                lost_frames=lambda: rig_source.lost_frames,
                link_log=link_log,
                close=rig_source.close,
                map_file=begin.file,
            )
            map_saver = MapSaver(maps.get("save_map"), source.slam, info)
            stop.check()
            remove_earlier(out, _OUTPUTS)
            log = SessionLog(
                out / SESSION, info, odometry, truth_at=trajectory.poses, drawn=not lean
            )
            stack.callback(log.close)
            shown: list[SessionObserver] = [
                log,  # closed before the views: the record must not wait for them
                publishing,
                *([live.observer(info)] if live is not None else []),
                *([make_view(out / VIEW, info)] if make_view is not None else []),
            ]
            sinks: list[SessionObserver] = [
                RunProgress(info, source.lost_frames, end_ns=trajectory.duration_ns),
                map_saver,
                *([RollingImage(info, odometry, shown)] if has_image else []),
                *shown,
            ]
            for row in early_bytes:
                log.on_wire(*row)
            if wire:
                rig_source.listen(log.on_wire)
            publishing.begin(info, link_log.log)
            record = execute(source, sinks)
        if record.last is not None:
            # without the flag: the signal that ended the drive does not end the writing
            finish(out, source, record, StopFlag(), publishing=publishing, map_saver=map_saver)
            if has_image:
                write_image(out, record, odometry)
        _require_whole(record, scene, stop, scans.failure, kept)
        name_the_next(out, has_view=make_view is not None)
        if live is not None:
            live.keep_serving()


def _require_whole(
    record: RunRecord, scene: str, stop: StopFlag, failure: str | None, kept: str
) -> None:
    """Raise what ended a drive before its end; `kept` is what is left of it."""
    if stop.received is not None:
        raise StopRequestedError(stop.received, kept)
    if failure is not None:
        raise EmulatorError(f"{failure}{kept}")
    if record.last is None:
        raise AppError(f"{scene}: too short for SLAM, no state was estimated{kept}")


def write_image(out: Path, record: RunRecord, odometry: OdometryTrack) -> None:
    """Write the image of the session in a folder along the best path that the run has."""
    # loads matplotlib, half a second
    from slam.app.run.pictures import draw_image, picture

    session = open_session(out / SESSION)
    try:
        image = session_image(session, path_of(record, odometry, session.info))
    except NoImageError as error:
        note(f"{out / IMAGE} is not written: {error}")
        return
    with picture(out / IMAGE, width_in=9.0, height_in=8.2, dpi=120) as figure:
        draw_image(figure, image, session.info)


def name_the_next(out: Path, *, has_view: bool) -> None:
    """Print the commands that show the drive, as they work where this one did."""
    called = Path(sys.argv[0])
    found = shutil.which(_PROGRAM)
    is_near = called.name == _PROGRAM and (found is None or not called.samefile(found))
    program, folder = quote(str(called) if is_near else _PROGRAM), quote(str(out))
    print_progress(f"report: {program} report {folder}")
    if has_view:
        print_progress(f"viewer: {program} view {folder}")


def _rerun_view() -> Callable[[Path, SessionInfo], SessionObserver] | None:
    """Return what makes the view of a session; None, with a note, if Rerun is not installed."""
    try:
        from slam.app.view.session_view import RerunView
    except ModuleNotFoundError as error:
        if what_is_missing(error) is None:
            raise
        note(f"without Rerun no session.rrd is written; {install_command('view')} brings it")
        return None
    return RerunView


class _Scans:
    """The scans of the emulated rig, until the scene or the emulator ends, or a signal comes.

    Attributes
    ----------
    failure
        Why the emulator sends no more; None if it does.
    """

    def __init__(
        self, rig_source: RigSource, end: int, emulator: EmulatorProcess, stop: StopFlag
    ) -> None:
        self._rig_source, self._end = rig_source, end
        self._emulator, self._stop = emulator, stop
        self.failure: str | None = None

    def __iter__(self) -> Iterator[Scan]:
        try:
            yield from self._rig_source.scans(self._end, self._stop)
        except StopRequestedError:
            return
        except RadarSilentError as silent:
            self.failure = self._emulator.ended() or str(silent)
            self._emulator.end()  # before the drivers close, which then wait for no answers

"""`uwb-slam convert`: sessions from and to the files of others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

from slam.app.convert.matlab import MAT_RIG, convert_mat
from slam.app.convert.rosbag import AUTHORS_RIG, convert_bag, write_bag
from slam.app.errors import UsageError, naming
from slam.app.rig.rig_files import load_rig
from slam.app.run.output import note, print_text
from slam.app.run.result_files import made_folder
from slam.config import ConfigError, load_preset
from slam.live.errors import AppError, refuse_pipe
from slam.live.session.reader import RecordedSession, begins_with, open_session
from xethru_protocol.operating_system import PathInUseError, StopFlag, built_aside, sync
from xethru_protocol.recordings import RecordingError, WireCapture
from xethru_protocol.recordings.mcap import MAGIC
from xethru_protocol.recordings.recorded_messages import MAT_MAGIC
from xethru_protocol.validation import shown, suffix_of


def _write_wire(session: RecordedSession, out: Path, radar: str | None, stop: StopFlag) -> str:
    """Write the bytes of a radar's port, both ways, with the times of the host's monotonic clock.

    Raises
    ------
    AppError
        The session has no such radar, or several and none is named, or no raw bytes; the file
        cannot be written.
    """
    known = [info.name for info in session.info.radars]
    names = ", ".join(known)
    if radar is None and len(known) != 1:
        raise AppError(f"{session.path}: holds several radars ({names}); choose one: --radar NAME")
    chosen = known[0] if radar is None else radar
    if chosen not in known:
        raise AppError(f"{session.path}: holds no radar {shown(chosen)}; it holds {names}")
    sizes = {"rx": 0, "tx": 0}
    try:
        with WireCapture(out, {"radar": chosen, "clock": "monotonic"}) as capture:
            for name, way, data, host_ns in session.wire():
                stop.check()
                if name == chosen:
                    capture.write(way, data, host_ns)
                    sizes[way] += len(data)
    except RecordingError as error:
        raise AppError(str(error)) from None
    if not any(sizes.values()):
        raise AppError(f"{session.path}: holds no raw bytes; record with --wire")
    return f"{out}: {sizes['rx']} bytes from the module, {sizes['tx']} to it"


_SESSION_SUFFIX, _MAT_SUFFIX, _WIRE_SUFFIX = ".mcap", ".mat", ".xtwire"
_OF_SESSION = (_WIRE_SUFFIX, ".bag")
_USES = {
    "to .xtwire": ("--radar",),
    "to a bag": (),
    "of a .mat": ("--preset", "--rig", "--rate"),
    "of a bag": ("--preset", "--rig", "--frame-area", "--truth"),
}
"""The options of each conversion."""
_RATE_HZ, _TRUTH_TOPIC = 5, "/slam_out_pose"
_PRESET = "robust"
_MAT_PRESET = "paper"  # such ranges are of its front end: they scatter by a bin, 7 mm


def run_convert(
    stop: StopFlag,
    *,
    source: Path,
    out: Path,
    rig: str | None,
    frame_area_m: Sequence[float] | None,
    truth_topic: str | None,
    rate_hz: int | None,
    preset: str | None,
    radar: str | None,
) -> None:
    """Convert a session to a bag, or a bag or MATLAB file to a session; names say which.

    Options that it does not use are refused. After an error, what was begun is removed.
    """
    given: dict[str, object] = {"--preset": preset, "--rig": rig, "--rate": rate_hz}
    given |= {"--radar": radar, "--frame-area": frame_area_m, "--truth": truth_topic}
    if out.exists():
        raise AppError(f"{out}: exists; choose another name")
    refuse_pipe(source)
    is_session = source.suffix == _SESSION_SUFFIX or begins_with(source, MAGIC)
    if is_session and suffix_of(out) not in ("", _SESSION_SUFFIX, *_OF_SESSION):
        raise UsageError(
            f"{out}: a session is not converted to {out.suffix}; name an OUT that ends in "
            f"{', '.join(_OF_SESSION)}, or a new folder for a bag of ROS 2; `xethru convert` makes "
            "tables and arrays of its frames"
        )
    warnings: list[str] = []
    if is_session and out.suffix != _SESSION_SUFFIX:
        is_wire = out.suffix == _WIRE_SUFFIX
        _refuse_unused("to .xtwire" if is_wire else "to a bag", given)
        with _whole(out) as fresh:
            session = open_session(source, stop)
            if is_wire:
                result = _write_wire(session, fresh, radar, stop)
            else:
                result = write_bag(session, fresh, stop)
    elif out.suffix != _SESSION_SUFFIX:
        raise UsageError(
            f"{out}: of a bag or MATLAB file a session is made; give a name that ends in .mcap"
        )
    elif is_session and _is_session(source, stop):
        raise UsageError(
            f"{source}: is a session already; name an OUT that ends in .xtwire or .bag, or a "
            "new folder for a bag of ROS 2"
        )
    else:
        is_mat = source.suffix == _MAT_SUFFIX or begins_with(source, MAT_MAGIC)
        _refuse_unused("of a .mat" if is_mat else "of a bag", given)
        name = preset or (_MAT_PRESET if is_mat else _PRESET)
        _check_preset(name)  # before anything is read
        given_rig = None if rig is None else load_rig(rig).rig
        with _whole(out) as fresh:
            if is_mat:
                result = convert_mat(
                    source,
                    fresh,
                    stop,
                    preset=name,
                    rig=given_rig or MAT_RIG,
                    rate_hz=rate_hz or _RATE_HZ,
                )
            else:
                result, warnings = convert_bag(
                    source,
                    fresh,
                    stop,
                    preset=name,
                    rig=given_rig or AUTHORS_RIG,
                    area_m=None if frame_area_m is None else (frame_area_m[0], frame_area_m[1]),
                    truth_topic=_TRUTH_TOPIC if truth_topic is None else truth_topic,
                )
    for line in warnings:
        note(f"{source}: {line}")
    print_text(result.replace(str(fresh), str(out)))


def _refuse_unused(conversion: str, given: Mapping[str, object]) -> None:
    for option, value in given.items():
        if value is not None and option not in _USES[conversion]:
            users = " or ".join(name for name, used in _USES.items() if option in used)
            raise UsageError(
                f"{option}: is for a conversion {users}, not {conversion}; leave it out"
            )


def _is_session(path: Path, stop: StopFlag) -> bool:
    try:
        open_session(path, stop)
    except AppError:  # the reader of bags reports what it is, or what is wrong with it
        return False
    return True


@contextmanager
def _whole(out: Path) -> Iterator[Path]:
    """Give the block a path for a file or folder, which gets its name once it is whole.

    What the block has begun is removed where it fails; what a killed one has begun, next time.
    """
    fresh = out
    try:
        with ExitStack() as held, naming(out):
            if not suffix_of(out):
                held.enter_context(made_folder(out.parent))
            with built_aside(out) as fresh:
                yield fresh
                for path in filter(Path.is_file, (fresh, *fresh.rglob("*"))):
                    sync(path)
                fresh.rename(out)
    except PathInUseError:
        raise AppError(f"{out}: another conversion is writing it; wait for its end") from None
    except AppError as error:
        raise type(error)(str(error).replace(str(fresh), str(out))) from None


def _check_preset(preset: str) -> None:
    try:
        load_preset(preset)
    except ConfigError as error:
        raise UsageError(str(error)) from None

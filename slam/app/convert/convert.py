"""`uwb-slam convert`: sessions from and to the files of others."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from slam.app.convert import rosbag as layout
from slam.app.convert.matlab import MatOptions, convert_mat, write_detections
from slam.app.convert.rosbag import BagOptions, convert_bag, write_bag
from slam.app.errors import AppError, UsageError
from slam.app.rig.files import load_rig
from slam.app.run.replay import recorded_config
from slam.app.session.messages import SlamSettings, settings_text
from slam.app.session.reader import RecordedSession, open_session
from slam.config import ConfigError, SlamConfig, WheelNoise, load_preset
from xethru_protocol.recordings import RecordingError, WireCapture


def write_wire(
    session: RecordedSession, out: Path, radar: str | None, check: Callable[[], None]
) -> str:
    """Write the bytes of a radar's port, both ways; return in words what was written.

    Their times are those of the host's own clock, whose zero means nothing.

    Raises
    ------
    AppError
        The session has no such radar, or several and none is named, or no raw bytes; the file
        exists or cannot be written.
    """
    known = [info.name for info in session.info.radars]
    names = ", ".join(known)
    if radar is None and len(known) != 1:
        raise AppError(f"{session.path}: holds several radars ({names}); choose one: --radar NAME")
    chosen = known[0] if radar is None else radar
    if chosen not in known:
        raise AppError(f"{session.path}: holds no radar {chosen!r}; it holds {names}")
    sizes = {"rx": 0, "tx": 0}
    try:
        with WireCapture(out, {"radar": chosen, "clock": "monotonic"}) as capture:
            for row in session.wire():
                check()
                if row.radar == chosen:
                    capture.write(row.way, row.data, row.host_ns)
                    sizes[row.way] += len(row.data)
    except RecordingError as error:
        raise AppError(str(error)) from None
    if not any(sizes.values()):
        out.unlink()
        raise AppError(f"{session.path}: holds no raw bytes; record with --wire")
    return f"{out}: {sizes['rx']} bytes from the module, {sizes['tx']} to it"


SESSION_SUFFIX, MAT_SUFFIX, WIRE_SUFFIX = ".mcap", ".mat", ".xtwire"
_PRESET = "robust"
_MAT_PRESET = "paper"  # whose front end such ranges are of: they scatter by a bin, 7 mm


@dataclass(frozen=True, slots=True, kw_only=True)
class ConvertOptions:
    """What the command line of `uwb-slam convert` says; None where it does not."""

    source: Path
    out: Path
    rig: Path | None
    area_m: tuple[float, float] | None
    truth_topic: str
    rate_hz: int
    preset: str | None
    radar: str | None


def run_convert(options: ConvertOptions, check: Callable[[], None]) -> None:
    """Convert a session to a bag or MATLAB file, or such a file to a session; names say which.

    Raises
    ------
    AppError
        One line; what was begun is removed.
    """
    if options.out.exists():
        raise AppError(f"{options.out}: exists; choose another name")
    out_is_session = options.out.suffix == SESSION_SUFFIX
    if options.source.suffix == SESSION_SUFFIX and not out_is_session:
        with _removing(options.out):
            said = _from_session(open_session(options.source), options, check)
        _say(said)
        return
    if not out_is_session:
        raise UsageError(
            f"{options.out}: of a bag or MATLAB file a session is made; give a name that ends in "
            ".mcap"
        )
    if options.source.suffix == SESSION_SUFFIX and _is_session(options.source):
        raise UsageError(
            f"{options.source}: is a session already; name an OUT that ends in .mat, .xtwire or "
            ".bag, or a new folder for a bag of ROS 2"
        )
    with _removing(options.out):
        said, odd = _to_session(options, check)
    for line in odd:
        print(f"uwb-slam: {options.source}: {line}", file=sys.stderr)  # noqa: T201 - a warning
    _say(said)


def _is_session(path: Path) -> bool:
    try:
        open_session(path)
    except AppError:  # what else it is, or what is wrong with it, the reader of bags tells
        return False
    return True


@contextmanager
def _removing(out: Path) -> Iterator[None]:
    """Remove a file that was begun where the block fails; a bag's folder goes with its writer."""
    try:
        yield
    except BaseException:
        if not out.is_dir():
            out.unlink(missing_ok=True)
        raise


def _from_session(
    session: RecordedSession, options: ConvertOptions, check: Callable[[], None]
) -> str:
    if options.out.suffix == WIRE_SUFFIX:
        return write_wire(session, options.out, options.radar, check)
    if options.out.suffix != MAT_SUFFIX:
        return write_bag(session, options.out, check)
    if options.preset is None and session.info.config_json:
        config = recorded_config(session)
    else:
        config = _config(options.preset or _PRESET)
    return write_detections(session, options.out, config, check)


def _to_session(options: ConvertOptions, check: Callable[[], None]) -> tuple[str, list[str]]:
    is_mat = options.source.suffix == MAT_SUFFIX
    preset = options.preset or (_MAT_PRESET if is_mat else _PRESET)
    settings = SlamSettings(
        preset=preset, config_json=settings_text(_config(preset)), wheels=asdict(WheelNoise())
    )
    if is_mat:
        of_mat = MatOptions(
            rig=None if options.rig is None else load_rig(options.rig).rig,
            rate_hz=options.rate_hz,
            settings=settings,
        )
        return convert_mat(options.source, options.out, of_mat, check), []
    of_bag = BagOptions(
        rig=layout.AUTHORS_RIG if options.rig is None else load_rig(options.rig).rig,
        area_m=options.area_m,
        truth_topic=options.truth_topic,
        settings=settings,
    )
    return convert_bag(options.source, options.out, of_bag, check)


def _config(preset: str) -> SlamConfig:
    try:
        return load_preset(preset)
    except ConfigError as error:
        raise UsageError(str(error)) from None


def _say(line: str) -> None:
    print(line)  # noqa: T201 - the result

"""The command `uwb-slam`: one table of commands with their options, and how commands end.

Nothing heavy is imported before a command runs, so `--help` answers at once.
"""

from __future__ import annotations

import argparse
import math
import signal
import sys
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

from slam.app.benchmarks import BENCHMARKS, IMAGE_BENCHMARKS
from slam.app.errors import EXIT_USAGE
from slam.app.publish import SINKS
from slam.app.sweep import FAMILIES, STRESSES
from slam.app.view import CONNECT, DEFAULT_VIEWER_URL, SERVE_WEB, SPAWN
from slam.live.errors import EXIT_FAILED, AppError
from xethru_protocol.cli.version import add_version
from xethru_protocol.operating_system import (
    STDERR,
    STDOUT,
    StopFlag,
    StopRequestedError,
    flush_streams,
    one_line,
    open_closed_streams,
)
from xethru_protocol.optional_packages import what_is_missing
from xethru_protocol.validation import Parser, number, output, recording_at, shown

_BY_A_SIGNAL = 128
"""Exit codes from here on are of signals."""

_TYPICAL_SEED = 19
"""Of seeds 0-19 in the lab, the one whose errors lie nearest the medians; see DECISIONS."""

_RUN_DESCRIPTION = """\
Opens the modules that a rig file names by their serial numbers, follows the robot's odometry, and
runs SLAM while frames arrive. Ends with the odometry, after --duration, or by Ctrl-C; writes
session, map, trajectories and numbers. SIGUSR1: writes smoothed.tum, the path smoothed so far, and
the map of --save-map.
"""

_RUN_EPILOG = """
With ROS 2, in the domain of ROS_DOMAIN_ID:

  uwb-slam run --rig robot.toml --odometry ros2:/odom --publish ros2

With an emulator in another terminal, which has both radars and odometry:

  xethru-emulator serve lab --link-dir ports
  uwb-slam run --rig lab --odometry ports/odometry.sock
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; return 0, 1 (failed), 2 (wrong usage), or 128 + n (stopped by signal n)."""
    open_closed_streams()
    exit_code = 0
    try:
        exit_code = _run(_parser().parse_args(argv))
    except KeyboardInterrupt:  # before a command took note of signals
        exit_code = _end("stopped by SIGINT", 128 + signal.SIGINT)
    finally:  # also of --help; a signal ends the wait for a stream that blocks
        flush_streams(wait=exit_code < _BY_A_SIGNAL)
    return exit_code


def _run(arguments: argparse.Namespace) -> int:
    stop = StopFlag()
    try:
        with stop:
            arguments.command(arguments, stop)
        stop.check()  # a signal that came after the command's own last check
    except AppError as error:
        return _end(str(error), error.exit_code)
    except StopRequestedError as stopped:
        return _end(str(stopped), stopped.exit_code)
    except ModuleNotFoundError as error:
        missing = what_is_missing(error, extra=arguments.extra)
        if missing is None:
            raise
        return _end(missing, EXIT_USAGE)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _end(f"{where}{error.strerror or error}", EXIT_FAILED)
    failure = STDOUT.failure
    if failure is None or isinstance(failure, BrokenPipeError):  # its reader has seen enough
        return 0
    return _end(f"standard output cannot be written: {failure.strerror}", EXIT_FAILED)


def _end(message: str, exit_code: int) -> int:
    STDERR.write_soon(f"uwb-slam: {one_line(' '.join(message.split()))}\n")
    return exit_code


class _Subcommand(NamedTuple):
    """A row of the table of commands.

    `function` is "module:name" of what runs it: the module is imported once the command starts,
    and the function gets the StopFlag, and the command's arguments by their names. `extra` is the
    extra of the distribution that it needs.
    """

    name: str
    function: str
    help: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    description: str
    epilog: str | None = None
    extra: str = "slam"

    def start(self, arguments: argparse.Namespace, stop: StopFlag) -> None:
        module, _, name = self.function.partition(":")
        of_row = {"command", "extra"}
        options: dict[str, Any] = {k: v for k, v in vars(arguments).items() if k not in of_row}
        with stop.leaving(program="uwb-slam"):  # imports take seconds
            function = getattr(import_module(module), name)
        function(stop, **options)


def _output(*suffixes: str, what: str = "a folder") -> Callable[[str], Path]:
    """Return the type of a path to write to; it must be UTF-8, which Rerun's writer requires."""
    allowed = output(*suffixes, what=what)

    def read(text: str) -> Path:
        try:
            text.encode()
        except UnicodeEncodeError:
            raise argparse.ArgumentTypeError(f"must be a UTF-8 name, not {shown(text)}") from None
        return allowed(text)

    return read


def _session(text: str) -> Path:
    """Return the path of a session, also of that in a run's folder."""
    return Path(recording_at(text))


def _whole_number(text: str, *, least: int) -> int:
    if not text.isascii() or not text.isdigit() or not least <= int(text) < 2**63:
        raise argparse.ArgumentTypeError(
            f"must be a whole number, {least} or more, not {shown(text)}"
        )
    return int(text)


_seed, _count = partial(_whole_number, least=0), partial(_whole_number, least=1)
"""Of a random generator; how many of something."""


_seconds = number(float, lambda value: 0.0 <= value < math.inf, "seconds, 0 or more")
_coordinate = number(float, math.isfinite, "a number")
_metres = number(float, lambda value: 0.0 < value < math.inf, "metres, more than 0")
_rate = number(float, lambda value: 0.0 < value < math.inf, "more than 0")


def _setting(text: str) -> tuple[str, tuple[str, ...]]:
    key, _, values = text.partition("=")
    named = tuple(value.strip() for value in values.split(","))
    if not key or not all(named):
        raise argparse.ArgumentTypeError(f"must be KEY=VALUE or KEY=V1,V2, not {shown(text)}")
    return key.strip(), named


def _one_setting(text: str) -> tuple[str, str]:
    key, _, value = (part.strip() for part in text.partition("="))
    if not key or not value:
        raise argparse.ArgumentTypeError(f"must be KEY=VALUE, not {shown(text)}")
    return key, value


def _add_session(parser: argparse.ArgumentParser) -> None:
    """Add the session that a command reads."""
    parser.add_argument(
        "session", type=_session, metavar="SESSION", help="a session.mcap, or a run's folder"
    )


def _add_json(parser: argparse.ArgumentParser) -> None:
    """Add `--json`, which prints an object instead of lines."""
    parser.add_argument("--json", dest="as_json", action="store_true", help="print one JSON object")


def _add_out(parser: argparse.ArgumentParser, default: str) -> None:
    """Add `--out` of a command that writes several files."""
    parser.add_argument(
        "--out", type=_output(), default=Path(default), help="folder for the results"
    )


def _add_preset(parser: argparse.ArgumentParser) -> None:
    """Add `--preset` and `--set` of a command that runs SLAM with one of them."""
    parser.add_argument(
        "--preset", default="robust", help="settings of SLAM (default: %(default)s)"
    )
    parser.add_argument(
        "--set",
        dest="settings",
        type=_one_setting,
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="replace a setting of the preset, like robust.patches=false; may be repeated",
    )


def _add_session_options(parser: argparse.ArgumentParser) -> None:
    """Add what a run records, and whether it is shown: `--wire`, `--lean` and `--rerun`."""
    parser.add_argument(
        "--wire", action="store_true", help="keep the raw bytes of all ports in the session, too"
    )
    parser.add_argument(
        "--lean",
        action="store_true",
        help="leave out of the session what only other viewers draw: B-scans, paths, ellipses",
    )
    parser.add_argument(
        "--no-image",
        dest="has_image",
        action="store_false",
        help="make no radar image of the room, which takes a quarter of the time of SLAM",
    )
    parser.add_argument(
        "--rerun",
        type=_rerun_target,
        metavar="WHERE",
        help="watch live: spawn (a window), serve-web (a page for a browser), connect (a viewer "
        f"at {DEFAULT_VIEWER_URL}), or the address of another viewer",
    )


def _add_publish(parser: argparse.ArgumentParser) -> None:
    """Add `--publish` of a command that runs SLAM."""
    parser.add_argument(
        "--publish",
        action="append",
        default=[],
        metavar="SINK",
        help="give the poses and the map to other programs meanwhile; may be given several times: "
        + "; ".join(kind.help for kind in SINKS.values()),
    )


def _add_map_options(parser: argparse.ArgumentParser) -> None:
    """Add the map that a run begins with, and the file for its own."""
    parser.add_argument(
        "--save-map",
        type=_output(".json", what="a map"),
        metavar="OUT.json",
        help="write the map at the end, for later runs",
    )
    parser.add_argument(
        "--map",
        dest="map_path",
        type=Path,
        metavar="MAP.json",
        help="begin with a map that --save-map has written, somewhere on it",
    )
    parser.add_argument(
        "--start",
        nargs=3,
        type=_coordinate,
        metavar=("X", "Y", "HEADING"),
        help="where the robot is at first, to about 0.1 m and 6 degrees: metres and degrees on the "
        "map (default: it finds out)",
    )
    parser.add_argument(
        "--localise",
        action="store_true",
        help="leave the map as it is; what is new serves the pose only",
    )


def _rerun_target(text: str) -> str:
    if text in {SPAWN, SERVE_WEB}:
        return text
    if text == CONNECT:
        return DEFAULT_VIEWER_URL
    if text.startswith(("rerun+http://", "rerun+https://")) and text.endswith("/proxy"):
        return text
    raise argparse.ArgumentTypeError(
        f"must be {SPAWN}, {CONNECT}, {SERVE_WEB}, or an address like {DEFAULT_VIEWER_URL}, "
        f"not {shown(text)}"
    )


def _add_demo(demo: argparse.ArgumentParser) -> None:
    _add_out(demo, "out/demo")
    demo.add_argument(
        "--seed",
        type=_seed,
        default=_TYPICAL_SEED,
        help="seed of noise and odometry drift (default: %(default)s, a typical run)",
    )
    demo.add_argument(
        "--scene", default="lab", help="name of a scene or a random room (pillars:3), or a file"
    )
    _add_preset(demo)
    _add_map_options(demo)
    _add_session_options(demo)
    _add_publish(demo)


def _add_view(view: argparse.ArgumentParser) -> None:
    view.add_argument(
        "session", type=Path, metavar="SESSION", help="a session.mcap, an .rrd, or a run's folder"
    )
    where = view.add_mutually_exclusive_group()
    where.add_argument("--web", action="store_true", help="serve a page for a browser")
    where.add_argument(
        "--out",
        type=_output(".rrd", what="a recording of Rerun"),
        metavar="FILE.rrd",
        help="write a file, show nothing",
    )
    where.add_argument(
        "--screenshot",
        type=_output(".png", what="a picture"),
        metavar="FILE.png",
        help="write a picture, no window needed",
    )
    view.add_argument(
        "--at",
        dest="at_s",
        type=_seconds,
        metavar="S",
        help="when the screenshot is taken, since the first scan (default: the end)",
    )


def _add_report(report: argparse.ArgumentParser) -> None:
    _add_session(report)
    report.add_argument(
        "--out",
        type=_output(".html", ".htm", what="a page"),
        metavar="FILE.html",
        help="(default: report.html beside the session)",
    )


def _add_run(run: argparse.ArgumentParser) -> None:
    run.formatter_class = argparse.RawDescriptionHelpFormatter
    run.add_argument(
        "--rig",
        required=True,
        metavar="RIG",
        help="a rig file, TOML, or the name of a scene that an emulator serves",
    )
    run.add_argument(
        "--odometry",
        required=True,
        metavar="SRC",
        help="TUM lines (timestamp x y z qx qy qz qw) from: - (stdin), a file or FIFO, unix:PATH, "
        "tcp://HOST:PORT, serial:PORT[@BAUD]; or ros2:TOPIC[:PARENT:CHILD], a nav_msgs/Odometry "
        "or a transform of tf",
    )
    run.add_argument(
        "--odometry-covariance",
        dest="covariance",
        action="store_true",
        help="take the noise of the wheels from the odometry: a nav_msgs/Odometry's twist, or six "
        "more numbers on a TUM line (xx xy xh yy yh hh of the velocity), not from the rig file",
    )
    run.add_argument(
        "--odometry-clock",
        dest="clock",
        default="arrival",
        metavar="CLOCK",
        help="what its stamps are: arrival (any clock, found from when lines come; the default), "
        "unix, monotonic, or the monotonic nanoseconds at stamp 0",
    )
    run.add_argument(
        "--ports",
        nargs="+",
        metavar="PORT",
        help="the modules' ports, such as /dev/ttyACM0 or tcp://HOST:PORT "
        "(default: those of the rig file, or look for them)",
    )
    _add_out(run, "out/run")
    _add_preset(run)
    run.add_argument("--fps", type=_count, default=5, help="frames/s (default: %(default)s)")
    run.add_argument(
        "--duration",
        dest="duration_s",
        type=_count,
        metavar="S",
        help="end after so many seconds",
    )
    _add_map_options(run)
    _add_session_options(run)
    _add_publish(run)


def _add_replay(replay: argparse.ArgumentParser) -> None:
    _add_session(replay)
    _add_out(replay, "out/replay")
    replay.add_argument(
        "--rate",
        type=_rate,
        metavar="R",
        help="so many times as fast as it was driven, 1 is real time (default: at full speed)",
    )
    _add_publish(replay)
    _add_map_options(replay)


def _add_evaluate(evaluate: argparse.ArgumentParser) -> None:
    evaluate.add_argument(
        "estimates",
        type=Path,
        nargs="+",
        metavar="EST",
        help="TUM file to judge, or a session or a run's folder, whose estimate is judged",
    )
    evaluate.add_argument(
        "reference",
        type=Path,
        metavar="REF",
        help="TUM file to judge by, or a session or a run's folder, whose truth it is",
    )
    evaluate.add_argument(
        "--delta",
        dest="delta_m",
        type=_metres,
        default=1.0,
        metavar="M",
        help="way that a relative error is over, metres (default: 1)",
    )
    evaluate.add_argument(
        "--out",
        type=output(".png", what="a picture"),
        metavar="FILE.png",
        help="draw paths and errors",
    )
    _add_json(evaluate)


def _add_repair(repair: argparse.ArgumentParser) -> None:
    repair.add_argument(
        "session", type=_session, metavar="SESSION", help="an MCAP file, or a run's folder"
    )
    repair.add_argument(
        "--out",
        type=output(".mcap", what="MCAP"),
        metavar="FILE",
        help="write there, touch nothing else",
    )


def _add_convert(convert: argparse.ArgumentParser) -> None:
    convert.add_argument(
        "source",
        type=_session,
        metavar="IN",
        help="session.mcap or a run's folder, *.mat, *.bag, or a folder with a rosbag2",
    )
    convert.add_argument("out", type=Path, metavar="OUT", help="must not exist")
    convert.add_argument(
        "--rig",
        metavar="RIG",
        help="rig file or scene: where the radars of a bag sit, named UWBradar1 and so on",
    )
    _add_frame_area(convert, "what the modules of a bag were asked for (default: 0.2 9.4)")
    convert.add_argument(
        "--truth",
        dest="truth_topic",
        metavar="TOPIC",
        help="default: /slam_out_pose",
    )
    convert.add_argument(
        "--rate",
        dest="rate_hz",
        metavar="RATE",
        type=_count,
        help="states/s of a .mat, which has no stamps (default: 5)",
    )
    convert.add_argument(
        "--preset",
        help="settings of SLAM (default: for a bag robust, for a .mat paper)",
    )
    convert.add_argument("--radar", metavar="NAME", help="whose raw bytes, for .xtwire")


def _add_calibrate(calibrate: argparse.ArgumentParser) -> None:
    _add_session(calibrate)
    calibrate.add_argument(
        "--reflectors", metavar="FILE", help="known places: TOML with [[reflectors]], or a scene"
    )
    calibrate.add_argument(
        "--rig", type=output(".toml", what="TOML"), metavar="OUT", help="write a rig file"
    )
    calibrate.add_argument("--truth", metavar="SCENE", help="print what this scene planted beside")
    _add_json(calibrate)


def _add_sweep(sweep: argparse.ArgumentParser) -> None:
    sweep.add_argument(
        "--scene",
        dest="scenes",
        metavar="SCENE",
        nargs="+",
        action="extend",
        help="names or files; pillars:3 is room 3 of the random rooms of family pillars, "
        "pillars:0-9 are ten of them (default: lab)",
    )
    sweep.add_argument(
        "--preset",
        dest="presets",
        metavar="PRESET",
        nargs="+",
        action="extend",
        help="settings of SLAM (default: robust)",
    )
    sweep.add_argument(
        "--seeds",
        dest="n_seeds",
        metavar="SEEDS",
        type=_count,
        default=20,
        help="number of runs of each scene, each with a seed of its own (default: %(default)s)",
    )
    sweep.add_argument(
        "--first-seed",
        type=_seed,
        default=0,
        metavar="SEED",
        help="the first of the seeds; a random room adds its number (default: %(default)s)",
    )
    sweep.add_argument(
        "--laps", type=_count, help="drive the first laps of each scene only, so many"
    )
    sweep.add_argument(
        "--fps", type=_count, default=5, help="frames/s of each radar (default: %(default)s)"
    )
    sweep.add_argument(
        "--set",
        dest="settings",
        type=_setting,
        action="append",
        default=[],
        metavar="KEY=V1,V2",
        help="replace a setting of the presets, like association.gate=0.6,9.2; several values, or "
        "several --set, make a group for every combination",
    )
    sweep.add_argument(
        "--stress",
        dest="stresses",
        nargs="+",
        action="extend",
        default=[],
        choices=tuple(STRESSES),
        metavar="STRESS",
        help="run under these hardships, too, and print how much worse it gets",
    )
    sweep.add_argument(
        "--bound",
        action="store_true",
        help="compute on each run's data what is possible with the true associations (GTSAM)",
    )
    where = sweep.add_mutually_exclusive_group()
    where.add_argument("--jobs", type=_count, help="processes (default: one per core)")
    where.add_argument("--dask", metavar="ADDRESS", help="scheduler of a Dask cluster to run on")
    sweep.add_argument(
        "--json",
        dest="out",
        type=output(".json", what="JSON"),
        required=True,
        metavar="OUT",
        help="result file",
    )


def _add_map(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(required=True, metavar="ACTION", dest="action")
    for name, text, count in (
        ("show", "print a map as a table", 1),
        ("convert", "write a map as GeoJSON, in local metres", 1),
        ("join", "make one map of two", 2),
    ):
        action = actions.add_parser(name, help=text, description=text)
        action.add_argument("files", type=Path, nargs=count, metavar="MAP", help="from --save-map")
        if name == "convert":
            action.add_argument("out", type=Path, metavar="OUT.geojson", help="to write")
        elif name == "join":
            action.add_argument(
                "--out",
                type=_output(".json", what="a map"),
                metavar="OUT",
                required=True,
                help="file to write",
            )


def _add_image(image: argparse.ArgumentParser) -> None:
    image.add_argument(
        "source",
        type=_session,
        metavar="SESSION|RECORDING",
        help="a session.mcap, a run's folder, or a recording that `xethru record` has written",
    )
    image.add_argument(
        "--path",
        type=_path_of_image,
        metavar="PATH",
        help="where the robot was: smoothed, estimate or odometry of a session, or FILE.tum "
        "(default: the first that the session has)",
    )
    image.add_argument(
        "--cell",
        dest="cell_m",
        type=_metres,
        default=0.02,
        metavar="M",
        help="length of a cell, 1 at most (default: %(default)g)",
    )
    image.add_argument(
        "--range",
        dest="reach_m",
        type=_metres,
        default=2.0,
        metavar="M",
        help="how far from the radars (default: %(default)g)",
    )
    image.add_argument(
        "--area",
        dest="area_m",
        type=_coordinate,
        nargs=4,
        metavar=("X0", "Y0", "X1", "Y1"),
        help="corners of the image, metres in the frame of the path (default: all that is seen)",
    )
    image.add_argument(
        "--mount",
        type=_coordinate,
        nargs=3,
        metavar=("X", "Y", "DEGREES"),
        help="of a recording: where its radar sits on the robot or cart, metres forward and to the "
        "left, and where it looks, counter-clockwise from forward",
    )
    image.add_argument("--rig", metavar="RIG", help="of a recording: the rig file, for --mount")
    _add_frame_area(image, "of a recording that does not say it: as the module read it back")
    _add_out(image, "out/image")


def _path_of_image(text: str) -> str:
    if text in {"smoothed", "estimate", "odometry"} or text.endswith(".tum"):
        return text
    raise argparse.ArgumentTypeError(
        f"must be smoothed, estimate, odometry or FILE.tum, not {shown(text)}"
    )


def _add_frame_area(parser: argparse.ArgumentParser, text: str) -> None:
    """Add `--frame-area` of a command that reads what does not have it."""
    parser.add_argument(
        "--frame-area",
        dest="frame_area_m",
        type=float,
        nargs=2,
        metavar=("START", "END"),
        help=f"{text}, module metres",
    )


def _add_benchmark(benchmark: argparse.ArgumentParser) -> None:
    known = {**BENCHMARKS, **IMAGE_BENCHMARKS}
    benchmark.add_argument(
        "name",
        choices=tuple(known),
        metavar="NAME",
        help="; ".join(f"{name}: {text}" for name, text in known.items()),
    )
    benchmark.add_argument(
        "--data", type=Path, required=True, metavar="DIR", help="folder with the files"
    )
    _add_out(benchmark, "out/benchmarks")
    _add_json(benchmark)


_COMMANDS = (
    _Subcommand(
        "demo",
        "slam.app.commands.demo:run_demo",
        "drive an emulated robot through a scene and map it",
        _add_demo,
        "Starts the emulator, opens its four radars through serial ports, runs SLAM "
        "while frames arrive, and writes session, map and numbers. All numbers are simulated.",
    ),
    _Subcommand(
        "view",
        "slam.app.commands.view:run_view",
        "show a session in Rerun: window, browser, file or picture",
        _add_view,
        "Shows a recorded session in Rerun, as its run saw it. Without an option a window opens.",
        extra="view",
    ),
    _Subcommand(
        "report",
        "slam.app.commands.report:run_report",
        "write a session's report as one HTML page",
        _add_report,
        "Writes map, trajectory, errors, consistency, link statistics and parameters of a "
        "recorded session into one page that any browser opens without a network.",
    ),
    _Subcommand(
        "run",
        "slam.app.commands.run:run_rig",
        "map with real modules, or a running emulator, in real time",
        _add_run,
        _RUN_DESCRIPTION,
        _RUN_EPILOG,
    ),
    _Subcommand(
        "replay",
        "slam.app.run.replay:run_replay",
        "run SLAM again on a recorded session",
        _add_replay,
        "Steps SLAM through a session.mcap as the run did, with its settings, and "
        "writes map, trajectories and numbers: the run's own, but for the speed. What is left of "
        "a cut file is replayed to its last whole scan.",
    ),
    _Subcommand(
        "evaluate",
        "slam.app.commands.evaluate:run_evaluate",
        "compare trajectories with a reference",
        _add_evaluate,
        "Errors of each EST against REF, as evo has them: poses are associated by time. Absolute "
        "error (ATE): aligned by rotation and translation, root mean square of the distances and "
        "of the headings. Relative error (RPE): of the motions over --delta metres of REF's way.",
    ),
    _Subcommand(
        "repair",
        "slam.app.session.repair:run_repair",
        "make a recording whole that was cut or damaged",
        _add_repair,
        "Writes everything that is whole of a session, or of any MCAP file, anew with "
        "an index, so that every program opens it again. The file as it was is kept as "
        "SESSION.unrepaired.",
    ),
    _Subcommand(
        "convert",
        "slam.app.convert.convert:run_convert",
        "sessions from and to rosbags, and from .mat, in the layout of the paper's data set",
        _add_convert,
        "IN is a session, then OUT is the raw bytes of one port if its name ends in .xtwire, a bag "
        "of ROS 1 if in .bag, or else a new folder with a bag of ROS 2; or IN is a bag or a .mat "
        "of detections, then OUT is a session, which replay, view and report take.",
    ),
    _Subcommand(
        "calibrate",
        "slam.app.commands.calibrate:run_calibrate",
        "estimate offsets, mounts, gains and pulses from a recorded drive",
        _add_calibrate,
        "Estimates every radar's range offset, mount position, relative gain and pulse from a "
        "session of `uwb-slam run` or `demo` past reflectors, and says what the drive cannot tell "
        "apart.",
    ),
    _Subcommand(
        "map",
        "slam.app.commands.map:run_map",
        "show, convert or join maps that --save-map has written",
        _add_map,
        "Shows a map, writes it as GeoJSON, or makes one map of two whose landmarks lie on each "
        "other in one way only.",
    ),
    _Subcommand(
        "image",
        "slam.app.commands.image:run_image",
        "make an image of the room from the raw frames of a session or a recording",
        _add_image,
        "Sums raw frames along the path of their radar, 25 cm at a time, and writes what they show "
        "of the room: image.png, arrays in image.npz, and map.yaml with map.pgm, which nav2's map "
        "server loads.",
        "With one radar on a cart that looks to the left, and poses by the clock of the recording: "
        "uwb-slam image rec --path poses.tum --mount 0.1 0.2 90",
    ),
    _Subcommand(
        "benchmark",
        "slam.app.benchmarks.command:run_benchmark",
        "run the back end of preset robust on a public data set, beside its truth",
        _add_benchmark,
        "Runs the back end of preset robust on all drives of a public data set that you have "
        "fetched, with and without the ids of landmarks where the data allow, and prints each "
        "path's error against the truth, beside dead reckoning. Of p440 it makes images instead, "
        "and prints how sharp they are. Writes paths as TUM text, a "
        "picture NAME.png and NAME.json. docs/benchmarks.md says where the data are from.",
    ),
    _Subcommand(
        "sweep",
        "slam.app.sweep.sweep:run_sweep",
        "repeat a run over scenes, presets and seeds",
        _add_sweep,
        "Runs every scene with every preset and seed in process, without ports, "
        "and writes each run's summary and the statistics of each group. Runs that are done are "
        "kept in OUT.part, and the same command goes on with them; if OUT is there already, it "
        "prints that result again. All numbers are simulated.",
        "STRESS is one of: "
        + "; ".join(f"{name}: {stress.help}" for name, stress in STRESSES.items())
        + f". The families of random rooms are {', '.join(FAMILIES)}; statistics are of families.",
    ),
)


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="uwb-slam", description="UWB-radar SLAM on X4M300 radars, emulated or real."
    )
    parser.set_defaults(extra="slam")
    add_version(parser)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for row in _COMMANDS:
        command = commands.add_parser(
            row.name, help=row.help, description=row.description, epilog=row.epilog
        )
        row.add_arguments(command)
        command.set_defaults(command=row.start, extra=row.extra)
    return parser


if __name__ == "__main__":
    sys.exit(main())

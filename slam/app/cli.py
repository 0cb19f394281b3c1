"""The command `uwb-slam`. Parses, calls, and turns what happens into one line and an exit code.

Nothing heavy is imported before a command runs, so `--help` answers at once.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from slam.app.commands.options import add_rerun, count, folder, seconds, seed
from slam.app.errors import EXIT_FAILED, AppError
from slam.app.experiments import add_experiments
from slam.app.sweep.stress import STRESSES
from xethru_protocol.system import StopFlag, StopRequestedError, flush_streams, open_closed_streams


def add_view(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `uwb-slam view`."""
    parser.add_argument(
        "session", type=Path, metavar="SESSION", help="a session.mcap, an .rrd, or a run's folder"
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--web", action="store_true", help="serve a page for a browser")
    where.add_argument("--out", type=folder, metavar="FILE.rrd", help="write a file, show nothing")
    where.add_argument(
        "--screenshot", type=folder, metavar="FILE.png", help="write a picture, no window needed"
    )
    parser.add_argument(
        "--at",
        type=seconds,
        metavar="S",
        help="when the screenshot is taken, since the first scan (default: the end)",
    )


def add_report(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `uwb-slam report`."""
    parser.add_argument(
        "session", type=Path, metavar="SESSION", help="a session.mcap, or a run's folder"
    )
    parser.add_argument(
        "--out", type=folder, metavar="FILE.html", help="(default: report.html beside the session)"
    )


CSV_TO_TUM = (
    r"s/^([0-9]+),([0-9]+),[^,]*,[^,]*,"
    + ",".join([r"([^,]*)"] * 7)
    + r",.*/\1.000000000\2 \3 \4 \5 \6 \7 \8 \9/; s/\.0*([0-9]{9}) /.\1 /"
)
"""For `sed -E`: a line of `ros2 topic echo --csv` of a nav_msgs/Odometry to a TUM line."""

_DESCRIPTION = """\
Opens the modules that a rig file names by their serial numbers, follows the robot's odometry, and
runs SLAM while frames arrive. Ends with the odometry, after --duration, or by Ctrl-C; writes
session, map, trajectories and numbers.
"""

_EPILOG = rf"""
With ROS 2, whose stamps are seconds since 1970 (sed -u passes every line on at once; awk may not):

  PYTHONUNBUFFERED=1 ros2 topic echo --csv /odom nav_msgs/msg/Odometry |
    sed -uE '{CSV_TO_TUM}' |
    uwb-slam run --rig robot.toml --odometry - --odometry-clock unix

With an emulator in another terminal, which has both radars and odometry:

  xethru-emulator serve lab --link-dir ports
  uwb-slam run --rig robot.toml --odometry ports/odometry.sock
"""


def add_run(run: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Add them, and return the parser."""
    run.formatter_class = argparse.RawDescriptionHelpFormatter
    run.description, run.epilog = _DESCRIPTION, _EPILOG
    run.add_argument("--rig", type=Path, required=True, metavar="RIG", help="a rig file, TOML")
    run.add_argument(
        "--odometry",
        required=True,
        metavar="SRC",
        help="TUM lines (timestamp x y z qx qy qz qw) from: - (stdin), a file or FIFO, unix:PATH, "
        "tcp://HOST:PORT, serial:PORT[@BAUD]",
    )
    run.add_argument(
        "--odometry-clock",
        default="arrival",
        metavar="CLOCK",
        help="what its stamps are: arrival (any clock, told by when lines come; the default), "
        "unix, monotonic, or the monotonic nanoseconds at stamp 0",
    )
    run.add_argument(
        "--ports", nargs="+", metavar="PORT", help="the modules' ports (default: look for them)"
    )
    run.add_argument("--out", type=folder, default=Path("out/run"), help="folder for the results")
    run.add_argument("--preset", default="robust", help="settings of SLAM (default: %(default)s)")
    run.add_argument("--fps", type=count, default=5, help="frames/s (default: %(default)s)")
    run.add_argument("--duration", type=count, metavar="S", help="end after so many seconds")
    run.add_argument("--wire", action="store_true", help="record every byte of the ports, too")
    add_rerun(run)
    return run


_CONVERT_DESCRIPTION = (
    "IN is a session, then OUT is a MATLAB file of detections if its name "
    "ends in .mat, the raw bytes of one port if in .xtwire, a bag of ROS 1 if in .bag, or "
    "else a new folder with a bag of ROS 2; or IN is a .mat or a bag, then OUT is a "
    "session, which replay, view and report take."
)


def add_convert(convert: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Add them, and return the parser."""
    convert.description = _CONVERT_DESCRIPTION
    convert.add_argument(
        "source", type=Path, metavar="IN", help="session.mcap, *.mat, *.bag or folder"
    )
    convert.add_argument("out", type=Path, metavar="OUT", help="must not exist")
    convert.add_argument(
        "--rig", type=Path, help="where the radars of a bag sit, named UWBradar1 and so on"
    )
    convert.add_argument(
        "--frame-area",
        type=float,
        nargs=2,
        metavar=("START", "END"),
        help="what the modules of a bag were asked for, module metres (default: 0.2 9.4)",
    )
    convert.add_argument(
        "--truth", default="/slam_out_pose", metavar="TOPIC", help="default: %(default)s"
    )
    convert.add_argument(
        "--rate", type=count, default=5, help="states/s of a .mat, which has no stamps (default: 5)"
    )
    convert.add_argument(
        "--preset",
        help="settings of SLAM (default: a session's own; for a bag robust, for a .mat paper)",
    )
    convert.add_argument("--radar", metavar="NAME", help="whose raw bytes, for .xtwire")
    return convert


_SWEEP_DESCRIPTION = (
    "Runs every scene with every preset and seed in process, without ports, "
    "and writes each run's summary and the statistics of each group. Stopped, the same "
    "command goes on where it was. All numbers are simulated."
)
_SWEEP_EPILOG = (
    "STRESS is one of: " + "; ".join(f"{row.name}: {row.help}" for row in STRESSES.values()) + "."
)


def add_sweep(sweep: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Add them, and return the parser."""
    sweep.description, sweep.epilog = _SWEEP_DESCRIPTION, _SWEEP_EPILOG
    sweep.add_argument("--scene", nargs="+", action="extend", help="names or files (default: lab)")
    sweep.add_argument(
        "--preset", nargs="+", action="extend", help="settings of SLAM (default: robust)"
    )
    sweep.add_argument("--seeds", type=count, default=20, help="number of seeds, from 0")
    sweep.add_argument(
        "--set",
        type=_setting,
        action="append",
        default=[],
        metavar="KEY=V1,V2",
        help="replace a setting of the presets, like association.gate=0.6,9.2; several values, or "
        "several --set, make a group for every combination",
    )
    sweep.add_argument(
        "--stress",
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
    where.add_argument("--jobs", type=count, help="processes (default: one per core)")
    where.add_argument("--dask", metavar="ADDRESS", help="scheduler of a Dask cluster to run on")
    sweep.add_argument("--json", type=Path, required=True, metavar="OUT", help="result file")
    return sweep


def _setting(text: str) -> tuple[str, tuple[str, ...]]:
    key, _, values = text.partition("=")
    named = tuple(value.strip() for value in values.split(","))
    if not key or not all(named):
        raise argparse.ArgumentTypeError(f"must be KEY=VALUE or KEY=V1,V2, not {text!r}")
    return key.strip(), named


_TYPICAL_SEED = 19
"""Of seeds 0-19 in the lab, the one whose errors lie nearest the medians; see DECISIONS."""

_Command = Callable[[argparse.Namespace, StopFlag], None]


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; return 0, 1 (failed), 2 (wrong usage), or 128 + n (stopped by signal n)."""
    open_closed_streams()
    try:
        return _run(_parser().parse_args(argv))
    except KeyboardInterrupt:  # before a command took note of signals
        return _end("stopped by SIGINT", 128 + signal.SIGINT)
    finally:
        flush_streams()


def _run(arguments: argparse.Namespace) -> int:
    command: _Command = arguments.command
    stop = StopFlag()
    try:
        try:
            with stop:
                command(arguments, stop)
                sys.stdout.flush()
        except OSError:
            stop.check()  # a terminal that closes sends SIGHUP and refuses what we say
            raise
        stop.check()  # a signal that came after the command's own last check
    except AppError as error:
        return _end(str(error), error.exit_code)
    except StopRequestedError as stopped:
        return _end(str(stopped), stopped.exit_code)
    except BrokenPipeError:
        return EXIT_FAILED  # whoever read our output has gone
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _end(f"{where}{error.strerror or error}", EXIT_FAILED)
    return 0


def _end(message: str, exit_code: int) -> int:
    line = " ".join(message.split())
    with contextlib.suppress(OSError):  # the terminal is gone, which may be why we end
        print(f"uwb-slam: {line}", file=sys.stderr)  # noqa: T201 - a command line speaks
    return exit_code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="uwb-slam", description="UWB-radar SLAM on X4M300 radars, emulated or real."
    )
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    demo = commands.add_parser(
        "demo",
        help="drive an emulated robot through a scene and map it",
        description="Starts the emulator, opens its four radars through serial ports, runs SLAM "
        "while frames arrive, and writes session, map and numbers. All numbers are simulated.",
    )
    demo.add_argument("--out", type=folder, default=Path("out/demo"), help="folder for the results")
    demo.add_argument(
        "--seed",
        type=seed,
        default=_TYPICAL_SEED,
        help="seed of noise and odometry drift (default: %(default)s, a typical run)",
    )
    demo.add_argument("--scene", default="lab", help="name of a scene, or a scene file")
    demo.add_argument("--preset", default="robust", help="settings of SLAM (default: %(default)s)")
    demo.add_argument(
        "--wire", action="store_true", help="keep the raw bytes of all ports in the session, too"
    )
    add_rerun(demo)
    demo.set_defaults(command=_demo)

    view = commands.add_parser(
        "view",
        help="show a session in Rerun: window, browser, file or picture",
        description="Replays a session into a Rerun view. Without an option a window opens.",
    )
    add_view(view)
    view.set_defaults(command=_view)

    report = commands.add_parser(
        "report",
        help="write a session's report as one HTML page",
        description="Replays a session and writes map, trajectory, errors, consistency, link "
        "statistics and parameters into one page that any browser opens without a network.",
    )
    add_report(report)
    report.set_defaults(command=_report)

    add_run(
        commands.add_parser(
            "run",
            help="map with real modules, or a running emulator, in real time",
        )
    ).set_defaults(command=_run_rig)

    replay = commands.add_parser(
        "replay",
        help="run SLAM again on a recorded session",
        description="Steps SLAM through a session.mcap as the run did, with its settings, and "
        "writes map, trajectories and numbers: the run's own, but for the speed. What is left of "
        "a cut file is replayed to its last whole scan.",
    )
    replay.add_argument("session", type=Path, metavar="SESSION", help="a session.mcap")
    replay.add_argument(
        "--out", type=folder, default=Path("out/replay"), help="folder for the results"
    )
    replay.set_defaults(command=_replay)

    evaluate = commands.add_parser(
        "evaluate",
        help="compare two trajectories",
        description="Absolute trajectory error of EST against REF, two TUM files: associated by "
        "time, aligned by rotation and translation, root mean square of the distance.",
    )
    evaluate.add_argument("estimate", type=Path, metavar="EST", help="TUM file to judge")
    evaluate.add_argument("reference", type=Path, metavar="REF", help="TUM file to judge by")
    evaluate.add_argument("--json", action="store_true", help="print one JSON object")
    evaluate.set_defaults(command=_evaluate)

    repair = commands.add_parser(
        "repair",
        help="make a recording whole that was cut or damaged",
        description="Writes everything that is whole of a session, or of any MCAP file, anew with "
        "an index, so that every program opens it again. The file as it was is kept as "
        "SESSION.unrepaired.",
    )
    repair.add_argument("session", type=Path, metavar="SESSION", help="an MCAP file")
    repair.add_argument("--out", type=Path, metavar="FILE", help="write there, touch nothing else")
    repair.set_defaults(command=_repair)

    add_convert(
        commands.add_parser(
            "convert",
            help="sessions from and to rosbags and .mat, in the layout of the paper's data set",
        )
    ).set_defaults(command=_convert)

    calibrate = commands.add_parser(
        "calibrate",
        help="estimate range offsets, mounts and gains from a recorded drive",
        description="Estimates every radar's range offset, mount position and relative gain from a "
        "session of `uwb-slam demo` past reflectors, and says what the drive cannot tell apart.",
    )
    calibrate.add_argument("session", type=Path, metavar="SESSION", help="a session.mcap")
    calibrate.add_argument(
        "--reflectors", metavar="FILE", help="known places: TOML with [[reflectors]], or a scene"
    )
    calibrate.add_argument("--rig", type=Path, metavar="OUT", help="write a rig file")
    calibrate.add_argument("--truth", metavar="SCENE", help="print what this scene planted beside")
    calibrate.add_argument("--json", action="store_true", help="print one JSON object")
    calibrate.set_defaults(command=_calibrate)

    add_sweep(
        commands.add_parser("sweep", help="repeat a run over scenes, presets and seeds")
    ).set_defaults(command=_sweep)

    experiment = commands.add_parser(
        "experiment",
        help="repeat an experiment of the paper, or show a limit, as picture and numbers",
        description="Runs one experiment on emulated radars; writes NAME.png and NAME.json. All "
        "numbers are simulated.",
    )
    add_experiments(experiment)
    return parser


def _demo(arguments: argparse.Namespace, stop: StopFlag) -> None:
    from slam.app.commands.demo import DemoOptions, run_demo  # heavy, see module text

    options = DemoOptions(
        out=arguments.out,
        seed=arguments.seed,
        scene=arguments.scene,
        preset=arguments.preset,
        wire=arguments.wire,
        rerun=arguments.rerun,
    )
    run_demo(options, stop)


def _run_rig(arguments: argparse.Namespace, stop: StopFlag) -> None:
    from slam.app.commands.run import RunOptions, run_rig  # heavy, see module text

    options = RunOptions(
        rig=arguments.rig,
        odometry=arguments.odometry,
        ports=tuple(arguments.ports) if arguments.ports else None,
        out=arguments.out,
        preset=arguments.preset,
        fps=arguments.fps,
        clock=arguments.odometry_clock,
        duration_s=arguments.duration,
        wire=arguments.wire,
        rerun=arguments.rerun,
    )
    run_rig(options, stop)


def _replay(arguments: argparse.Namespace, stop: StopFlag) -> None:
    from slam.app.run.replay import ReplayOptions, run_replay  # heavy, see module text

    run_replay(ReplayOptions(session=arguments.session, out=arguments.out), stop)


def _view(arguments: argparse.Namespace, stop: StopFlag) -> None:
    from slam.app.commands.view import ViewOptions, run_view  # heavy, see module text

    options = ViewOptions(
        session=arguments.session,
        web=arguments.web,
        out=arguments.out,
        screenshot=arguments.screenshot,
        at_s=arguments.at,
    )
    run_view(options, stop)


def _report(arguments: argparse.Namespace, stop: StopFlag) -> None:
    from slam.app.commands.report import ReportOptions, run_report  # heavy, see module text

    run_report(ReportOptions(session=arguments.session, out=arguments.out), stop)


def _evaluate(arguments: argparse.Namespace, stop: StopFlag) -> None:
    from slam.app.run.results import run_evaluate  # heavy, see module text

    run_evaluate(arguments.estimate, arguments.reference, as_json=arguments.json)


def _repair(arguments: argparse.Namespace, stop: StopFlag) -> None:
    from slam.app.session.repair import repair  # heavy, see module text

    print(repair(arguments.session, arguments.out, stop.check))  # noqa: T201 - the result


def _convert(arguments: argparse.Namespace, stop: StopFlag) -> None:
    from slam.app.convert.convert import ConvertOptions, run_convert  # heavy, see module text

    options = ConvertOptions(
        source=arguments.source,
        out=arguments.out,
        rig=arguments.rig,
        area_m=tuple(arguments.frame_area) if arguments.frame_area else None,
        truth_topic=arguments.truth,
        rate_hz=arguments.rate,
        preset=arguments.preset,
        radar=arguments.radar,
    )
    run_convert(options, stop.check)


def _calibrate(arguments: argparse.Namespace, stop: StopFlag) -> None:
    from slam.app.commands.calibrate import (  # heavy, see module text
        CalibrateOptions,
        run_calibrate,
    )

    options = CalibrateOptions(
        session=arguments.session,
        reflectors=arguments.reflectors,
        truth=arguments.truth,
        rig=arguments.rig,
        as_json=arguments.json,
    )
    run_calibrate(options, stop)


def _sweep(arguments: argparse.Namespace, stop: StopFlag) -> None:
    from joblib import cpu_count  # heavy, see module text

    from slam.app.sweep.sweep import SweepOptions, run_sweep

    options = SweepOptions(
        scenes=tuple(arguments.scene or ["lab"]),
        presets=tuple(arguments.preset or ["robust"]),
        n_seeds=arguments.seeds,
        jobs=arguments.jobs or cpu_count(),
        out=arguments.json,
        settings=tuple(arguments.set),
        stresses=tuple(arguments.stress),
        bound=arguments.bound,
        dask=arguments.dask,
    )
    run_sweep(options, stop)


if __name__ == "__main__":
    sys.exit(main())

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

from slam.app.arguments import folder, seed
from slam.app.convert_arguments import add_convert
from slam.app.errors import EXIT_FAILED, AppError, naming
from slam.app.experiments import EXPERIMENTS, Experiment, ExperimentModule
from slam.app.run_arguments import add_run
from slam.app.standard_streams import drop_what_cannot_be_said, open_closed_streams
from slam.app.stop import StopFlag, StopRequestedError
from slam.app.sweep_arguments import add_sweep
from slam.app.view_arguments import add_report, add_rerun, add_view

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
        drop_what_cannot_be_said()


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
    names = experiment.add_subparsers(
        required=True, metavar="NAME", dest="name", parser_class=_ExperimentParser
    )
    for row in EXPERIMENTS.values():
        parser_of_row = names.add_parser(row.name, help=row.help, description=row.help)
        parser_of_row.experiment = row
        parser_of_row.add_argument(
            "--out", type=folder, default=Path("out/experiments"), help="folder for the results"
        )
    return parser


class _ExperimentParser(argparse.ArgumentParser):
    """Imports its experiment, which adds its own options, only once it is named."""

    experiment: Experiment

    def parse_known_args(  # type: ignore[override]  # of its overloads, argparse uses this one
        self, args: Sequence[str] | None = None, namespace: None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        module = self.experiment.load()
        module.add_arguments(self)
        self.set_defaults(command=_experiment, module=module)
        return super().parse_known_args(args, namespace)


def _demo(arguments: argparse.Namespace, stop: StopFlag) -> None:
    from slam.app.demo import DemoOptions, run_demo  # heavy, see module text

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
    from slam.app.run import RunOptions, run_rig  # heavy, see module text

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
    from slam.app.replay import ReplayOptions, run_replay  # heavy, see module text

    run_replay(ReplayOptions(session=arguments.session, out=arguments.out), stop)


def _view(arguments: argparse.Namespace, stop: StopFlag) -> None:
    from slam.app.view import ViewOptions, run_view  # heavy, see module text

    options = ViewOptions(
        session=arguments.session,
        web=arguments.web,
        out=arguments.out,
        screenshot=arguments.screenshot,
        at_s=arguments.at,
    )
    run_view(options, stop)


def _report(arguments: argparse.Namespace, stop: StopFlag) -> None:
    from slam.app.report import ReportOptions, run_report  # heavy, see module text

    run_report(ReportOptions(session=arguments.session, out=arguments.out), stop)


def _evaluate(arguments: argparse.Namespace, stop: StopFlag) -> None:
    from slam.app.evaluate import run_evaluate  # heavy, see module text

    run_evaluate(arguments.estimate, arguments.reference, as_json=arguments.json)


def _repair(arguments: argparse.Namespace, stop: StopFlag) -> None:
    from slam.app.repair import repair  # heavy, see module text

    print(repair(arguments.session, arguments.out, stop.check))  # noqa: T201 - the result


def _convert(arguments: argparse.Namespace, stop: StopFlag) -> None:
    from slam.app.convert import ConvertOptions, run_convert  # heavy, see module text

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
    from slam.app.calibrate import CalibrateOptions, run_calibrate  # heavy, see module text

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

    from slam.app.sweep import SweepOptions, run_sweep

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


def _experiment(arguments: argparse.Namespace, stop: StopFlag) -> None:
    module: ExperimentModule = arguments.module
    out: Path = arguments.out
    with naming(out):
        out.mkdir(parents=True, exist_ok=True)
    module.run(arguments, stop)


if __name__ == "__main__":
    sys.exit(main())

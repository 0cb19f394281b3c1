"""Count the product files that four journeys run through: ``python -m hil_tests.bench.journeys``.

A file counts if one of its functions is called while the journey runs. Importing a file does not
count it, nor do calls made by an import. Only files of the `PRODUCT` packages count. Every journey
runs in a new process, so that no cache of an earlier one saves calls; processes that it starts
itself, such as the demo's emulator, do not count.
"""

import argparse
import contextlib
import inspect
import io
import json
import multiprocessing
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import islice
from pathlib import Path
from types import CodeType, FrameType
from typing import Self

from emulator.chip import Pace
from hil_tests.bench.virtual_time import lab_radar
from hil_tests.paths import REPOSITORY
from slam.app.cli import main as uwb_slam
from slam.app.rig.emulated import FRAME_RATE_HZ, RAW_CONFIG
from slam.app.run.runner import run_slam
from slam.app.session.writer import SessionLog
from slam.app.sweep.run import make_case, source_of
from slam.live.odometry_track import OdometryTrack

ROOT = REPOSITORY
PRODUCT = ("xethru_protocol", "emulator", "slam")
SCENE = "lab"
SEED = 0

FRAMES = 300
"""Enough for several blocks of the chip: it computes the echoes of 32 frames at once."""

MAPPED_SCANS = 20
"""Scans before the three that count: the map holds landmarks then, as in most of a run."""

DEMO_SCANS = 40

SHORT_DRIVE = """\
[path]
waypoints_m = [[0.0, 0.0], [0.58, 0.0]]
laps = ["forward"]
speed_mps = 0.2
turn_rate_deg_per_s = 90.0
"""
"""There and back in 7.8 s: `DEMO_SCANS` at 5 Hz."""


class Trace:
    """Collects the product files whose functions are called while it is entered.

    Calls count in the thread that enters it and in threads started after that.
    """

    def __init__(self) -> None:
        self._called: set[CodeType] = set()
        self._folders = tuple(f"{ROOT / package}/" for package in PRODUCT)

    def __enter__(self) -> Self:
        threading.setprofile(self._on_event)
        sys.setprofile(self._on_event)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)
        threading.setprofile(None)

    def files(self) -> list[str]:
        paths = {Path(code.co_filename).relative_to(ROOT) for code in self._called}
        return sorted(path.as_posix() for path in paths)

    def _on_event(self, frame: FrameType, event: str, argument: object) -> None:
        code = frame.f_code
        if event != "call" or code in self._called or not self._is_product_function(code):
            return
        caller: FrameType | None = frame
        while caller is not None:
            if caller.f_code.co_filename.startswith("<frozen importlib"):
                return
            caller = caller.f_back
        self._called.add(code)

    def _is_product_function(self, code: CodeType) -> bool:
        # bodies of modules and classes are not optimised, bodies of functions are
        is_function = bool(code.co_flags & inspect.CO_OPTIMIZED)
        return is_function and code.co_filename.startswith(self._folders)


def ping() -> list[str]:
    """Send one ping and read its answer, over the loopback: both ends count, not their set-up."""
    driver, _ = lab_radar(Pace.ASAP)
    with driver, Trace() as trace:
        driver.ping()
    return trace.files()


def echo_to_frame() -> list[str]:
    """Read frames of a radar that streams already: echo, chip, module, wire and driver count."""
    driver, _ = lab_radar(Pace.ASAP)
    with driver:
        driver.configure_raw(RAW_CONFIG)
        driver.start(FRAME_RATE_HZ)
        with Trace() as trace:
            for _ in driver.frames(FRAMES):
                pass
    return trace.files()


def scans_to_belief_and_log() -> list[str]:
    """Step preset ``robust`` with three scans of four frames, and log scans and states."""
    source = source_of(make_case(SCENE, "robust", SEED))
    scans = iter(source.scans)
    earlier, counted = list(islice(scans, MAPPED_SCANS)), list(islice(scans, 3))
    assert isinstance(source.odometry, OdometryTrack)
    inputs = source.odometry, source.slam, source.truth_at
    with tempfile.TemporaryDirectory() as folder, contextlib.closing(source):
        session = Path(folder) / "session.mcap"
        log = SessionLog(session, source.info, source.odometry, truth_at=source.truth_at)
        with contextlib.closing(log):
            run_slam(earlier, *inputs, [log])
            with Trace() as trace:
                record = run_slam(counted, *inputs, [log])
    if len(record.states) != len(counted):
        raise RuntimeError(f"{len(counted)} scans led to {len(record.states)} states")
    return trace.files()


def demo() -> list[str]:
    """Run `uwb-slam demo` on a drive of 40 scans, from its command line to its summary.

    Its viewer, ``--rerun``, is not asked for; the recording for Rerun is written as always.
    """
    shipped = (ROOT / "fixtures" / "scenes" / f"{SCENE}.toml").read_text(encoding="utf-8")
    before, _, path_and_after = shipped.partition("[path]\n")
    _, table, after = path_and_after.partition("\n[")
    output = io.StringIO()
    with tempfile.TemporaryDirectory() as folder:
        scene, out = Path(folder) / "short.toml", Path(folder) / "out"
        scene.write_text(before + SHORT_DRIVE + table + after, encoding="utf-8")
        command = ["demo", "--scene", str(scene), "--seed", str(SEED), "--out", str(out)]
        with (
            contextlib.redirect_stdout(output),
            contextlib.redirect_stderr(output),
            Trace() as trace,
        ):
            code = uwb_slam(command)
        if code != 0:
            raise RuntimeError(f"the demo ended with {code}:\n{output.getvalue()}")
        frames = json.loads((out / "summary.json").read_text(encoding="ascii"))["frames"]
    if frames != 4 * DEMO_SCANS:
        raise RuntimeError(f"the demo had {frames} frames, not 4 in each of {DEMO_SCANS} scans")
    return trace.files()


JOURNEYS: dict[str, Callable[[], list[str]]] = {
    "ping at both ends": ping,
    "echo to Frame": echo_to_frame,
    "3 scans to belief and log": scans_to_belief_and_log,
    "set-up and 40 scans of the demo without --rerun": demo,
}


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description="count the product files of four journeys")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args(argv)
    with ProcessPoolExecutor(
        max_workers=1, mp_context=multiprocessing.get_context("spawn"), max_tasks_per_child=1
    ) as pool:
        runs = {name: pool.submit(journey) for name, journey in JOURNEYS.items()}
        files_of = {name: run.result() for name, run in runs.items()}
    if arguments.json:
        rows = {name: {"count": len(files), "files": files} for name, files in files_of.items()}
        print(json.dumps(rows, indent=2))  # noqa: T201 - the result
        return
    for name, files in files_of.items():
        print("\n  ".join([f"{name}: {len(files)} files", *files]))  # noqa: T201 - the result


if __name__ == "__main__":
    main()

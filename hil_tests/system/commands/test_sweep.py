"""The command uwb-slam sweep: the same numbers on one process, two, or a Dask cluster."""

import contextlib
import io
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil_tests.system.recorded_session import write_shorter_scene
from hil_tests.system.short_scene import write_short_scene
from slam.app.cli import main
from slam.app.rig.emulated import end_tick
from slam.app.sweep.run import make_case, run_case

pytestmark = pytest.mark.slow


SWEEP = (sys.executable, "-m", "slam.app.cli", "sweep", "--preset", "paper", "--scene")


def sweep(scene: Path, out: Path, *options: str) -> dict[str, Any]:
    """Return the result of a command, without what depends on the clock."""
    command = [*SWEEP, str(scene), "--json", str(out), *options]
    if options[-2:] == ("--jobs", "1"):  # which starts no process; here, all is loaded already
        stdout, stderr = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(stdout), contextlib.redirect_stderr(stderr):
            code = main(command[command.index("sweep") :])
        printed, said = stdout.getvalue(), stderr.getvalue()
    else:
        run = subprocess.run(command, capture_output=True, text=True, check=False)
        code, printed, said = run.returncode, run.stdout, run.stderr
    assert code == 0, said
    assert printed.startswith("short, preset paper, ")
    result: dict[str, Any] = json.loads(out.read_text())
    assert said.count(" elapsed, ") == said.count("\n") == len(result["runs"])
    for row in (*result["runs"], *result["groups"]):
        del row["realtime_factor"]
    return result


@pytest.mark.rare
def test_one_and_two_processes_give_the_same_numbers(tmp_path: Path) -> None:
    scene = write_shorter_scene(tmp_path)
    alone = sweep(scene, tmp_path / "1.json", "--seeds", "3", "--jobs", "1")
    assert alone == sweep(scene, tmp_path / "2.json", "--seeds", "3", "--jobs", "2")
    assert [run["seed"] for run in alone["runs"]] == [0, 1, 2]
    (group,) = alone["groups"]
    errors = [run["ate_rmse_m"] for run in alone["runs"]]
    assert group["ate_rmse_m"]["median"] == sorted(errors)[1]
    assert group["ate_rmse_m"]["p90"] == pytest.approx(np.quantile(errors, 0.9))
    # chi-square with 9 degrees of freedom, 2.5 % and 97.5 % of tables, over 3 runs
    assert group["anees_band_95"] == pytest.approx([2.700 / 3, 19.023 / 3], rel=1e-3)


@pytest.mark.rare
def test_ctrl_c_while_workers_start(tmp_path: Path) -> None:
    script = tmp_path / "main.py"
    script.write_text(
        "import os, signal, joblib\n"
        "from slam.app.cli import main\n"
        "parallel = joblib.Parallel.__call__\n"
        "def interrupted(*arguments):\n"
        "    results = parallel(*arguments)\n"
        "    os.killpg(0, signal.SIGINT)\n"
        "    return results\n"
        "joblib.Parallel.__call__ = interrupted\n"
        f"out = {str(tmp_path / 'o.json')!r}\n"
        "raise SystemExit(main(['sweep', '--jobs', '2', '--json', out]))\n"
    )
    process = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, process_group=0
    )
    assert (process.returncode, process.stdout) == (130, "")
    assert process.stderr == "uwb-slam: stopped by SIGINT\n"
    assert list(tmp_path.iterdir()) == [script]


@pytest.mark.rare
def test_a_stressed_run_loses_frames_and_has_a_bound_on_what_is_left(tmp_path: Path) -> None:
    pytest.importorskip("gtsam")
    case = make_case(str(write_short_scene(tmp_path)), "paper", 0, stress="all", bound=True)
    run = run_case(case)
    whole = 4 * end_tick(case.scene.trajectory().duration_ns)
    # a tenth of the run silent, and a tenth of the other frames lost: 1180 of them, 0.9 % deviation
    assert run.frames == pytest.approx(0.81 * whole, abs=0.03 * whole)
    assert run.bound is not None
    assert [t_s for t_s, _ in run.bound.nees_pose] == [t_s for t_s, _ in run.nees_pose]
    # true associations beat wheels, and who knows the whole run beats who knows the past
    assert run.bound.smoothed_ate_rmse_m < run.bound.filtered_ate_rmse_m
    assert run.bound.filtered_ate_rmse_m < run.odometry_ate_rmse_m


QUIET = ("--no-dashboard", "--host", "127.0.0.1")


@contextmanager
def dask(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "dask", *arguments]
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    ) as (process):
        try:
            yield process
        finally:
            process.kill()


def scheduler_address(scheduler: subprocess.Popen[str]) -> str:
    assert scheduler.stderr is not None
    for line in scheduler.stderr:
        if said := re.search(r"Scheduler at: *(tcp://\S+)", line):
            return said[1]
    raise AssertionError("the scheduler ended without a word")


@pytest.mark.rare
def test_a_cluster_gives_what_one_machine_gives(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    scene, stressed = write_shorter_scene(tmp_path), ("--seeds", "1", "--stress", "dropped")
    with ExitStack() as stack:
        scheduler = stack.enter_context(dask("scheduler", *QUIET, "--port", "0"))
        address = scheduler_address(scheduler)
        worker = ("worker", address, *QUIET, "--no-nanny", "--nthreads", "2")
        for name in ("a", "b"):
            folder = str(tmp_path / name)
            stack.enter_context(dask(*worker, "--name", name, "--local-directory", folder))
        clustered = sweep(scene, tmp_path / "cluster.json", *stressed, "--dask", address)
    assert clustered == sweep(scene, tmp_path / "alone.json", *stressed, "--jobs", "1")
    assert [run["stress"] for run in clustered["runs"]] == ["clean", "dropped"]

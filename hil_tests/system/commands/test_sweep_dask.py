"""`uwb-slam sweep --dask`: a scheduler and two workers give what this machine gives alone."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from hil_tests.system.short_scene import write_short_scene

pytestmark = pytest.mark.slow

QUIET = ("--no-dashboard", "--host", "127.0.0.1")


@contextmanager
def dask(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Run `dask ...` until the block ends."""
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


def sweep(scene: Path, out: Path, where: Sequence[str]) -> dict[str, Any]:
    command = [sys.executable, "-m", "slam.app.cli", "sweep", "--scene", str(scene)]
    command += ["--preset", "paper"]
    command += ["--seeds", "1", "--stress", "dropped", "--json", str(out), *where]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stderr.count(" elapsed, ") == run.stderr.count("\n") == 2
    result: dict[str, Any] = json.loads(out.read_text())
    for row in (*result["runs"], *result["groups"]):
        del row["realtime_factor"]  # of the wall clock
    return result


def test_a_cluster_gives_what_one_machine_gives(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    scene = write_short_scene(tmp_path)
    with ExitStack() as stack:
        scheduler = stack.enter_context(dask("scheduler", *QUIET, "--port", "0"))
        address = scheduler_address(scheduler)
        worker = ("worker", address, *QUIET, "--no-nanny", "--nthreads", "2")
        for name in ("a", "b"):
            folder = str(tmp_path / name)
            stack.enter_context(dask(*worker, "--name", name, "--local-directory", folder))
        clustered = sweep(scene, tmp_path / "cluster.json", ["--dask", address])
    assert clustered == sweep(scene, tmp_path / "alone.json", ["--jobs", "1"])
    assert [run["stress"] for run in clustered["runs"]] == ["clean", "dropped"]

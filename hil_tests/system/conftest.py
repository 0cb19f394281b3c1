"""A demo that the tests of demos, of replays and of maps read."""

import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hil_tests.system.recorded_session import write_shorter_scene


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a demo in ``out``, its scene ``short.toml`` and its map ``map.json``.

    What it printed is in ``stdout`` and ``stderr``. All workers share the folder.
    """
    # the folder of a worker lies in that of the whole run
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "demo"
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (done := folder / "done").exists():
            # a third of the short scene: enough for landmarks
            options = ["--scene", str(write_shorter_scene(folder)), "--seed", "5", "--wire"]
            options += ["--save-map", str(folder / "map.json"), "--out", str(folder / "out")]
            command = [sys.executable, "-m", "slam.app.cli", "demo", *options]
            process = subprocess.run(command, capture_output=True, text=True, check=False)
            assert process.returncode == 0, process.stderr
            (folder / "stdout").write_text(process.stdout)
            (folder / "stderr").write_text(process.stderr)
            done.touch()
    return folder

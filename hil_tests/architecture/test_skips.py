"""The report has one line for all tests that are skipped because the shared data is missing."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from hil_tests.paths import REPOSITORY

RECORDINGS = REPOSITORY / "hil_tests" / "unit" / "xethru_protocol" / "recordings"
# They ask for different recordings, in fixtures and in tests.
FILES = [RECORDINGS / f"test_{name}.py" for name in ("real_recordings", "recordings_vendor")]


@pytest.mark.rare  # seconds: pytest in other processes
def test_tests_without_the_shared_data_are_one_line(tmp_path: Path) -> None:
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *FILES],
        cwd=REPOSITORY,
        env={**os.environ, "XETHRU_SHARED_DATA": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout
    (line,) = (line for line in run.stdout.splitlines() if "XETHRU_SHARED_DATA" in line)
    (n_skipped,) = re.findall(r"(\d+) skipped", run.stdout)
    assert line.startswith(f"SKIPPED [{n_skipped}] ")
    assert f"recordings of real modules are not in {tmp_path}" in line

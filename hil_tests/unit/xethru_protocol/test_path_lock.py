"""A lock on a path: one owner at a time, no trace, gone with its owner."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from xethru_protocol.system import PathInUseError, locked


def test_one_owner_at_a_time_and_no_trace(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("content")
    with locked(tmp_path), locked(file):
        with pytest.raises(PathInUseError, match="in use"), locked(tmp_path):
            pytest.fail("held twice")
        with pytest.raises(PathInUseError), locked(file):
            pytest.fail("held twice")
    with locked(tmp_path), locked(file):
        pass
    assert list(tmp_path.iterdir()) == [file]
    assert file.read_text() == "content"


def test_a_killed_owner_holds_nothing(tmp_path: Path) -> None:
    code = (
        "import pathlib, sys, time\n"
        "from xethru_protocol.system import locked\n"
        "with locked(pathlib.Path(sys.argv[1])): print(flush=True); time.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE
    ) as owner:
        assert owner.stdout is not None
        owner.stdout.readline()
        with pytest.raises(PathInUseError), locked(tmp_path):
            pytest.fail("held twice")
        owner.send_signal(signal.SIGKILL)
    with locked(tmp_path):
        pass


def test_what_is_not_there_is_the_systems_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), locked(tmp_path / "missing"):
        pytest.fail("nothing to hold")

"""``--version`` of the three programs."""

import errno
import io
import sys
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from emulator.cli import main as xethru_emulator
from slam.app.cli import main as uwb_slam
from xethru_protocol.cli import main as xethru

PROJECT = Path(__file__).parents[4] / "pyproject.toml"
PROGRAMS = (xethru, xethru_emulator, uwb_slam)


def exit_code(program: Callable[[Sequence[str]], int]) -> object:
    try:
        return program(["--version"])
    except SystemExit as end:
        return end.code


@pytest.mark.parametrize("program", PROGRAMS, ids=["xethru", "xethru-emulator", "uwb-slam"])
def test_each_program_prints_the_version_of_the_package(
    program: Callable[[Sequence[str]], int],
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert not exit_code(program)
    version = tomllib.loads(PROJECT.read_text())["project"]["version"]
    assert capsys.readouterr() == (f"xethru-hil {version}\n", "")


@pytest.mark.parametrize("program", PROGRAMS, ids=["xethru", "xethru-emulator", "uwb-slam"])
def test_a_full_disk_or_a_closed_output_is_no_traceback(
    program: Callable[[Sequence[str]], int],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    class Full(io.StringIO):
        def write(self, _: str) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(sys, "stdout", Full())
    assert exit_code(program) == 1
    assert "cannot write the version: No space left on device" in capsys.readouterr().err
    monkeypatch.setattr(sys, "stdout", None)
    exit_code(program)

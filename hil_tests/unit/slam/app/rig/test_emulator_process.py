"""The emulator process: every way it can fail to start is one line."""

import os
import stat
import sys
from pathlib import Path

import pytest

from hil_tests.patience import wait_until
from slam.app.errors import EmulatorError
from slam.app.rig import emulated as emulator_process
from slam.app.rig.emulated import EmulatorProcess


@pytest.fixture
def fake_emulator(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the file of a shell script that is started in the emulator's place."""
    script = tmp_path / "fake"
    script.touch(mode=stat.S_IRWXU)
    monkeypatch.setattr(sys, "executable", str(script))
    return script


def never() -> None:
    """Do not stop."""


@pytest.mark.parametrize(
    ("does", "said"),
    [
        ("echo 'xethru-emulator: no ptys left' >&2; exit 1", "exit code 1: .*no ptys left"),
        ("kill -9 $$", "the emulator ended by SIGKILL"),
        ("echo hello; sleep 5", "ready line is unknown: b'hello"),
        ('echo "{}"; sleep 5', "ready line is unknown"),
    ],
)
def test_a_bad_start_is_one_line(fake_emulator: Path, does: str, said: str) -> None:
    fake_emulator.write_text(f"#!/bin/sh\n{does}\n")
    with EmulatorProcess("lab", 0) as emulator, pytest.raises(EmulatorError, match=said) as caught:
        emulator.wait_until_ready(never)
    assert "\n" not in str(caught.value)


def test_no_ready_line_in_time(fake_emulator: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(emulator_process, "READY_LIMIT_S", 0.3)
    fake_emulator.write_text("#!/bin/sh\nexec sleep 20\n")
    with (
        EmulatorProcess("lab", 0) as emulator,
        pytest.raises(EmulatorError, match=r"not ready after 0\.3 s"),
    ):
        emulator.wait_until_ready(never)


def test_one_that_ignores_sigterm_is_killed(
    fake_emulator: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(emulator_process, "END_LIMIT_S", 0.3)
    pid_file = tmp_path / "pid"
    fake_emulator.write_text(
        f"#!/bin/sh\ntrap '' TERM\necho $$ > {pid_file}.new; mv {pid_file}.new {pid_file}\n"
        "while :; do sleep 0.05; done\n"
    )
    with EmulatorProcess("lab", 0):
        wait_until(pid_file.exists)
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid_file.read_text()), 0)


def test_the_arguments_are_those_of_the_emulators_command_line(
    fake_emulator: Path, tmp_path: Path
) -> None:
    said = tmp_path / "arguments"
    fake_emulator.write_text(f'#!/bin/sh\necho "$@" > {said}\n')
    with EmulatorProcess("scene.toml", 42) as emulator, pytest.raises(EmulatorError):
        emulator.wait_until_ready(never)
    assert said.read_text() == "-P -m emulator.cli serve scene.toml --pace asap --seed 42\n"

"""Usage, exit codes and clear lines of xethru-emulator, without serving anything."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from emulator.cli import main
from hil_tests.patience import seconds
from xethru_protocol.system import locked


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["dance"],
        ["serve"],
        ["serve", "lab", "--bare"],
        ["serve", "lab", "--count", "2"],
        ["serve", "--bare", "--count", "0"],
        ["serve", "--bare", "--count", "x"],
        ["serve", "lab", "--pace", "slow"],
        ["serve", "lab", "--seed", "-1"],
        ["serve", "lab", "--tcp-host", "localhost"],
        ["serve", "lab", "--tcp", "0", "--tcp-host", ""],
        ["play"],
        ["play", "x", "--rate", "-1"],
        ["play", "x", "--rate", "nan"],
    ],
)
def test_wrong_usage_exits_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        main(arguments)
    assert exit_.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "usage: xethru-emulator" in captured.err
    assert " _" not in captured.err, "names of ours say nothing to a user"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["serve", "missing.toml"], "missing.toml: cannot read the scene file"),
        (["play", "missing"], "there is no recording missing"),
        (["serve", "--bare", "--link-dir", "FILE/links"], "cannot make the link directory"),
        (["serve", "--bare", "--link-dir", "FILE"], "cannot make the link directory"),
        (["serve", "--bare", "--state-dir", "FILE"], "file: cannot keep state there: File exists"),
        (["serve", "--bare", "--state-dir", "FILE/s"], "cannot keep state there: Not a directory"),
        (["serve", "--bare", "--faults", "none.toml"], "none.toml: cannot read the scenario"),
        (["ctl", "EMPTY", "state"], "no emulator answers"),
        (["ctl", "x" * 300, "state"], "no emulator answers"),
        (["play", "EMPTY"], "holds no recording this can read"),
    ],
)
def test_what_cannot_be_served_is_one_line_and_exit_1(
    arguments: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    (tmp_path / "empty").mkdir()
    names = {"FILE": str(tmp_path / "file"), "EMPTY": str(tmp_path / "empty")}
    given = arguments
    for word, path in names.items():
        given = [argument.replace(word, path) for argument in given]
    assert main(given) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("xethru-emulator: ")
    assert captured.err.count("\n") == 1
    assert says in captured.err


def test_an_unknown_name_is_wrong_usage_while_a_missing_file_is_a_failure(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["serve", "no_such_scene"]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("xethru-emulator: no_such_scene: no such scene; known are")
    assert (captured.out, captured.err.count("\n")) == ("", 1)


def test_the_link_directory_of_a_running_emulator_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with locked(tmp_path):  # as the running one does
        assert main(["serve", "--bare", "--link-dir", str(tmp_path)]) == 1
    assert capsys.readouterr().err == (
        f"xethru-emulator: {tmp_path}: a running emulator has its links there; "
        "choose another --link-dir\n"
    )
    assert list(tmp_path.iterdir()) == []


def test_a_closed_stderr_leaves_the_exit_code() -> None:
    command = f"exec {sys.executable} -m emulator.cli serve no_such_scene 2>&-"
    run = subprocess.run(["sh", "-c", command], stdout=subprocess.PIPE, check=False)
    assert (run.returncode, run.stdout) == (2, b"")


@pytest.mark.parametrize("arguments", ["faults", "faults --json"])
def test_a_reader_of_the_list_that_left_is_no_failure(arguments: str) -> None:
    read_end, write_end = os.pipe()
    os.close(read_end)
    run = subprocess.run(
        [sys.executable, "-m", "emulator.cli", *arguments.split()],
        stdout=write_end,
        stderr=subprocess.PIPE,
        check=False,
    )
    os.close(write_end)
    assert (run.returncode, run.stderr) == (0, b"")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_one_line() -> None:
    with Path("/dev/full").open("wb") as full:
        run = subprocess.run(
            [sys.executable, "-m", "emulator.cli", "faults"],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    said = "xethru-emulator: stdout: cannot write: No space left on device\n"
    assert (run.returncode, run.stderr) == (1, said)


def test_ctrl_c_ends_a_question_that_nobody_answers(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as silent:
        silent.bind(str(tmp_path / "s"))
        silent.listen()
        command = [sys.executable, "-m", "emulator.cli", "ctl", str(tmp_path / "s"), "state"]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as asking:
            silent.settimeout(seconds(10))
            connection, _ = silent.accept()
            with connection:
                assert connection.recv(100).endswith(b"\n")
                asking.send_signal(signal.SIGINT)
                _, said = asking.communicate(timeout=seconds(5))
    assert (asking.returncode, said) == (130, "")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--from", "-1"], "-1 is not a finite number >= 0"),
        (["--from", "1e12"], "1e12 s is longer than any recording"),
        (["--only", "x-ray"], "'x-ray' is no kind of message; known are "),
    ],
)
def test_wrong_play_options_are_told(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as exit_info:
        main(["play", "recording", *arguments])
    assert exit_info.value.code == 2
    assert message in capsys.readouterr().err


def test_the_list_of_faults_shows_defaults_and_a_kind_shows_an_example(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["faults"]) == 0
    listed = capsys.readouterr().out
    assert "Bytes of a packet are lost.  [at, bytes=1]\n" in listed
    assert "None" not in listed
    assert main(["faults", "stall"]) == 0
    shown = capsys.readouterr().out
    assert "  seconds = 1.5: how long, s (at most 86400, above 0)\n" in shown
    assert '\n\n[[fault]]\nkind = "stall"\n' in shown
    assert main(["faults", "crc"]) == 2
    said = "no kind of fault is called 'crc'; `xethru-emulator faults` lists them"
    assert capsys.readouterr().err == f"xethru-emulator: {said}\n"

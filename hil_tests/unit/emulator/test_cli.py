"""Usage, exit codes and clear lines of xethru-emulator, without serving anything."""

import json
import os
import shlex
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pytest

from emulator.cli import main
from hil_tests.patience import seconds
from xethru_protocol.operating_system import locked


def test_the_link_directory_of_a_running_emulator_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with locked(tmp_path):  # as the running one does
        assert main(["serve", "--bare", "--link-dir", str(tmp_path)]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_scenario_for_another_radar_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenario = tmp_path / "wrong.toml"
    scenario.write_text('[[fault]]\nkind = "stall"\nradar = ["nose"]\n')
    assert main(["serve", "--bare", "--faults", str(scenario)]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert '"nose"' in error
    assert "radar_1" in error


def test_no_control_character_reaches_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Names of files, and what answers at a control socket."""
    hostile = "\x1b]0;owned\x07\x7f\x9b2J"
    for command in (
        ["serve", hostile],
        ["serve", "--bare", "--faults", hostile],
        ["play", str(tmp_path / hostile)],
        ["ctl", str(tmp_path / hostile), "state"],
        ["proxy", "--port", hostile],
    ):
        assert main(command) in (1, 2)
        (line,) = capsys.readouterr().err.splitlines()
        assert line.isprintable()
    path = tmp_path / "control"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()

        def answer() -> None:
            client, _ = listener.accept()
            with client:
                client.recv(4096)
                text = json.dumps({"ok": True, "name": "\x1b\x7f\x9b"}, ensure_ascii=False)
                client.sendall(text.encode() + b"\n")

        thread = threading.Thread(target=answer)
        thread.start()
        assert main(["ctl", str(path), "state"]) == 0
        thread.join()
    printed = capsys.readouterr().out
    assert printed.rstrip("\n").isprintable()
    assert json.loads(printed)["name"] == "\x1b\x7f\x9b"


def test_the_list_of_faults_is_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["faults", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert len(listed) >= 40
    assert {"kind", "layer", "parameters", "counted", "hidden", "example"} <= set(listed[0])


def test_a_closed_stderr_leaves_the_exit_code() -> None:
    command = shlex.join([sys.executable, "-m", "emulator.cli", "serve", "no_such_scene"])
    run = subprocess.run(["sh", "-c", f"exec {command} 2>&-"], stdout=subprocess.PIPE, check=False)
    assert (run.returncode, run.stdout) == (2, b"")


def run(arguments: list[str], stdout: int | IO[bytes]) -> tuple[int, str]:
    command = [sys.executable, "-m", "emulator.cli", *arguments]
    done = subprocess.run(command, stdout=stdout, stderr=subprocess.PIPE, text=True, check=False)
    return done.returncode, done.stderr


@pytest.fixture
def broken_pipe() -> Iterator[int]:
    read_end, write_end = os.pipe()
    os.close(read_end)
    yield write_end
    os.close(write_end)


@pytest.mark.parametrize(
    "arguments", [["faults"], pytest.param(["faults", "--json"], marks=pytest.mark.rare)]
)
def test_a_reader_of_the_list_that_left_is_no_failure(
    arguments: list[str], broken_pipe: int
) -> None:
    assert run(arguments, broken_pipe) == (0, "")


def test_a_reader_of_the_ready_line_that_left_ends_serving(
    tmp_path: Path, broken_pipe: int
) -> None:
    said = "xethru-emulator: stdout: cannot write the ready line: Broken pipe\n"
    serve = ["serve", "--bare", "--link-dir", str(tmp_path / "l")]
    assert run(serve, broken_pipe) == (1, said)
    assert not (tmp_path / "l").exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_one_line() -> None:
    said = "xethru-emulator: stdout: cannot write: No space left on device\n"
    with Path("/dev/full").open("wb") as full:
        assert run(["faults"], full) == (1, said)


def test_ctrl_c_ends_a_request_without_answer(tmp_path: Path) -> None:
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
    ("arguments", "allowed"),
    [
        (["proxy", "--port", "p", "--baud", "-5"], "600...10000000"),
        (["proxy", "--port", "p", "--baud", "0"], "600...10000000"),
        (["proxy", "--port", "p", "--baud", "fast"], "600...10000000"),
        (["serve", "--bare", "--serial", "5"], "12 digits"),
        (["serve", "--bare", "--serial", "-00000000001"], "12 digits"),
        (["serve", "--bare", "--serial", "9" * 12], "999999999936"),
    ],
)
def test_a_number_out_of_range_is_wrong_usage(
    arguments: list[str], allowed: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert allowed in capsys.readouterr().err

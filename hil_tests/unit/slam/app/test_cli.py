"""uwb-slam itself: help is light, wrong usage is 2, signals, and no traceback."""

import os
import shlex
import signal
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from hil_tests.unit.slam.app.sessions import session_info, write_session
from slam.app.cli import main
from slam.app.errors import EmulatorError
from slam.app.rig.emulated import EmulatorProcess
from slam.app.rig.rig_files import write_rig
from slam.app.run.output import RunProgress, note, print_table
from slam.library.rig_files import RigFile, RigRadar
from slam.live.session_records import LogLine
from xethru_protocol.operating_system import locked

THOROUGH = partial(pytest.param, marks=pytest.mark.thorough)
RARE = partial(pytest.param, marks=pytest.mark.rare)


@pytest.mark.parametrize(("command", "option"), [("demo", "--out"), ("sweep", "--json")])
def test_two_runs_into_one_place_are_refused_and_the_first_goes_on(
    command: str, option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    first = out / "summary.json" if command == "demo" else tmp_path / "out.part"
    first.parent.mkdir(exist_ok=True)
    first.write_text("of the first run")
    with locked(out if command == "demo" else first):
        assert main([command, option, str(out)]) == 1
    text = capsys.readouterr()
    assert (text.out, text.err.count("\n")) == ("", 1)
    assert first.read_text() == "of the first run"


def test_a_name_that_is_no_utf_8_is_wrong_usage() -> None:
    with pytest.raises(SystemExit) as end:
        main(["demo", "--out", os.fsdecode(b"\xff")])
    assert end.value.code == 2


HOSTILE = "\x1b]0;owned\x07\x7f\x9b2J\n"


def test_no_control_character_reaches_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Names of scenes and radars in a session, warnings of a drive, names of files."""
    info = session_info()
    radars = (replace(info.radars[0], name=f"nose{HOSTILE}", serial=HOSTILE), info.radars[1])
    info = replace(info, scene=HOSTILE, radars=radars)
    progress = RunProgress(info, lambda: 0)
    progress.on_log(LogLine(t_ns=0, radar=HOSTILE, text=HOSTILE, warning=True))
    note(HOSTILE)
    print_table(HOSTILE, None, [(HOSTILE, HOSTILE, HOSTILE)])
    session = write_session(tmp_path / "session.mcap", 20, info=info)
    for command in (
        ["replay", session, "--out", tmp_path / "replay"],
        ["repair", session, "--out", tmp_path / HOSTILE],
        ["report", session, "--out", tmp_path / f"{HOSTILE}.html"],
        ["evaluate", HOSTILE, HOSTILE],
        ["demo", "--scene", HOSTILE, "--out", tmp_path / "demo"],
        ["run", "--rig", tmp_path / HOSTILE, "--odometry", HOSTILE, "--out", tmp_path / "run"],
    ):
        main([str(part) for part in command])
    printed = capsys.readouterr()
    assert "owned" in printed.out
    assert "owned" in printed.err
    for line in (printed.out + printed.err).split("\n"):
        assert line.isprintable(), line


def trajectory(folder: Path) -> str:
    path = folder / "path.tum"
    path.write_text("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n3 1 1 0 0 0 0 1\n")
    return str(path)


@pytest.mark.parametrize(
    ("scene", "code", "closed"),
    [
        ("", 0, "<&- >&- 2>&-"),
        RARE("", 0, ">&-"),
        RARE("mars", 2, "2>&-"),
        THOROUGH("", 0, "2>&-"),
        THOROUGH("mars", 2, ">&-"),
        THOROUGH("mars", 2, "<&- >&- 2>&-"),
    ],
)
def test_a_closed_standard_stream_changes_nothing(
    closed: str, scene: str, code: int, tmp_path: Path
) -> None:
    path = trajectory(tmp_path)
    arguments = ["sweep", "--json", "o", "--scene", scene] if scene else ["evaluate", path, path]
    command = shlex.join([sys.executable, "-m", "slam.app.cli", *arguments])
    run = subprocess.run(
        ["sh", "-c", f"exec {command} {closed}"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == code
    assert "Traceback" not in run.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full (Linux)")
def test_output_that_takes_no_more_is_1_and_one_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "slam.app.cli", "evaluate", *2 * [trajectory(tmp_path)]]
    with Path("/dev/full").open("w") as full:
        run = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert (run.returncode, run.stderr) == (
        *(1, "uwb-slam: standard output cannot be written: No space left on device\n"),
    )


@pytest.mark.parametrize(("which", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_after_a_commands_last_check_counts_too(
    which: signal.Signals,
    code: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    interrupted = lambda *_, **__: os.kill(os.getpid(), which)  # noqa: E731 - used once, below
    monkeypatch.setattr("slam.app.commands.evaluate.run_evaluate", interrupted)
    assert main(["evaluate", "one.tum", "two.tum"]) == code
    assert capsys.readouterr().err == f"uwb-slam: stopped by {which.name}\n"


def test_a_signal_before_a_command_takes_note_of_signals_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("slam.app.cli._parser", interrupted)
    assert main(["run"]) == 130
    assert capsys.readouterr().err == "uwb-slam: stopped by SIGINT\n"


def test_a_run_that_cannot_begin_leaves_an_earlier_runs_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def not_started(self: EmulatorProcess) -> EmulatorProcess:
        raise EmulatorError("the emulator ended at once")

    monkeypatch.setattr(EmulatorProcess, "__enter__", not_started)
    rig = tmp_path / "robot.toml"
    radar = RigRadar(name="nose", serial="000000000001", x_m=0.1, y_m=0.0, yaw_deg=0.0)
    write_rig(rig, RigFile(radars=(radar,)))
    earlier = ("summary.json", "estimate.tum", "map.png", "report.html")
    out = tmp_path / "out"
    out.mkdir()
    for name in earlier:
        (out / name).write_text("of an earlier run")
    (lines := tmp_path / "lines.tum").write_text("0 0 0 0 0 0 0 1\n")
    drive = ["--odometry", str(lines), "--odometry-clock", "unix"]
    for command in (
        ["demo"],
        ["run", "--rig", str(rig), *drive, "--ports", str(tmp_path / "no port")],
    ):
        assert main([*command, "--out", str(out)]) == 1
        assert sorted(path.name for path in out.iterdir()) == sorted(earlier)
    assert "no port" in capsys.readouterr().err

"""`uwb-slam` itself: help is light, wrong usage is 2, nobody sees a traceback."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hil_tests.unit.slam.app.sessions import session_info
from slam.app.cli import main
from slam.app.session.log import SessionLog
from xethru_protocol.system import locked

HEAVY = {
    "numpy",
    "scipy",
    "sklearn",
    "rerun",
    "matplotlib",
    "pydantic",
    "mcap",
    "rosbags",
    "joblib",
    "rich",
    "serial",
    "emulator",
}


@pytest.mark.parametrize(
    "arguments", [["--help"], ["demo", "--help"], ["evaluate", "--help"], ["sweep", "--help"]]
)
def test_help_loads_nothing_heavy(arguments: list[str]) -> None:
    script = (
        "import sys\n"
        "from slam.app.cli import main\n"
        f"try: main({arguments!r})\n"
        "except SystemExit as end: assert end.code == 0\n"
        "print('LOADED', *{name.partition('.')[0] for name in sys.modules})\n"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert "usage: uwb-slam" in run.stdout
    loaded = set(run.stdout.partition("LOADED")[2].split())
    assert loaded & HEAVY == set()


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["fly"],
        ["demo", "--seed", "-1"],
        ["demo", "--seed", "x"],
        ["demo", "--out", os.fsdecode(b"\xff")],
        ["sweep", "--json", "o.json", "--seeds", "0"],
        ["evaluate", "one.tum"],
    ],
)
def test_wrong_usage_is_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("wrong", "code"), [("--scene mars", 2), ("--scene no/such.toml", 1), ("--preset magic", 2)]
)
@pytest.mark.parametrize("command", ["demo --out", "sweep --json"])
def test_an_unknown_name_is_2_a_missing_file_1_both_one_line(
    command: str, wrong: str, code: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    option, value = wrong.split()
    assert main([*command.split(), str(tmp_path / "out"), option, value]) == code
    text = capsys.readouterr()
    assert text.out == ""
    assert value in text.err
    assert text.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_is_1(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("in the way")
    assert main(["demo", "--out", str(tmp_path / "file" / "o")]) == 1
    assert "cannot be written: Not a directory" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "option", "said"),
    [
        ("demo", "--out", "another run is writing there"),
        ("sweep", "--json", "another sweep is writing there"),
    ],
)
def test_two_runs_into_one_place_are_refused_and_the_first_goes_on(
    command: str, option: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    first = out / "summary.json" if command == "demo" else tmp_path / "out.part"
    first.parent.mkdir(exist_ok=True)
    first.write_text("of the first run")
    with locked(out if command == "demo" else first):
        assert main([command, option, str(out)]) == 1
    text = capsys.readouterr()
    assert said in text.err
    assert (text.out, text.err.count("\n")) == ("", 1)
    assert first.read_text() == "of the first run"


def trajectory(folder: Path) -> str:
    path = folder / "path.tum"
    path.write_text("1 0 0 0 0 0 0 1\n2 1 0 0 0 0 0 1\n3 1 1 0 0 0 0 1\n")
    return str(path)


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
@pytest.mark.parametrize(("scene", "code"), [("", 0), ("mars", 2)])
def test_a_closed_standard_stream_changes_nothing(
    closed: str, scene: str, code: int, tmp_path: Path
) -> None:
    path = trajectory(tmp_path)
    arguments = f"sweep --json o --scene {scene}" if scene else f"evaluate {path} {path}"
    run = subprocess.run(
        ["sh", "-c", f"exec {sys.executable} -m slam.app.cli {arguments} {closed}"],
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
    assert (run.returncode, run.stderr) == (1, "uwb-slam: No space left on device\n")


@pytest.mark.parametrize(("which", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_after_a_commands_last_check_counts_too(
    which: signal.Signals,
    code: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    interrupted = lambda *_, **__: os.kill(os.getpid(), which)  # noqa: E731
    monkeypatch.setattr("slam.app.run.results.run_evaluate", interrupted)
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


@pytest.mark.parametrize("command", ["view", "report"])
def test_no_result_takes_the_place_of_another_recording(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = SessionLog(session := tmp_path / "session.mcap", session_info())
    log.close()
    (other := tmp_path / "other.mcap").write_bytes(session.read_bytes())
    assert main([command, str(session), "--out", str(other)]) == 2
    assert f"{other}: is a recording, which cannot be repeated" in capsys.readouterr().err
    assert other.read_bytes() == session.read_bytes()

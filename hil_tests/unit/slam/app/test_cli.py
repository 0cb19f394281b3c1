"""`uwb-slam` itself: help is light, wrong usage is 2, nobody sees a traceback."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from slam.app.cli import main

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
    "xethru_protocol",
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
    ("option", "value"), [("--scene", "mars"), ("--scene", "no/such.toml"), ("--preset", "magic")]
)
@pytest.mark.parametrize("command", ["demo --out", "sweep --json"])
def test_an_unknown_scene_or_preset_is_2_and_one_line(
    command: str, option: str, value: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command.split(), str(tmp_path / "out"), option, value]) == 2
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


@pytest.mark.parametrize(("which", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_after_a_commands_last_check_counts_too(
    which: signal.Signals,
    code: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("slam.app.cli._evaluate", lambda *_: os.kill(os.getpid(), which))
    assert main(["evaluate", "one.tum", "two.tum"]) == code
    assert capsys.readouterr().err == f"uwb-slam: stopped by {which.name}\n"

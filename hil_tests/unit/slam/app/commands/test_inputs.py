"""What commands take: a run's folder is its session; a typo and a recording of others are named."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import pytest

from emulator.scene.toml_files import shipped_names
from hil_tests.paths import FIXTURES
from hil_tests.unit.slam.app.sessions import odometry, run, session_info, write_session
from slam.app.cli import _COMMANDS, main
from slam.app.run.result_files import hold_folder
from slam.app.session.writer import SessionLog
from slam.live.errors import AppError
from xethru_protocol.cli import main as xethru

COMMANDS = {
    "view": ("--out", "OUT/view.rrd"),
    "report": ("--out", "OUT/report.html"),
    "replay": ("--out", "OUT/replayed"),
    "repair": (),
    "calibrate": (),
    "convert": ("OUT/a_bag",),
    "evaluate": ("REF",),
}
RECORDINGS = (FIXTURES / "recordings" / "single", FIXTURES / "recordings" / "float")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return the folder of a run that had no scan yet."""
    folder = tmp_path / "run"
    folder.mkdir()
    SessionLog(folder / "session.mcap", session_info(), odometry(3)).close()
    return folder


def arguments(command: str, out: Path, given: Path) -> list[str]:
    """Return a command line that takes ``given`` and writes into the folder ``out``, made here."""
    out.mkdir()
    more = [one.replace("OUT", str(out)).replace("REF", str(given)) for one in COMMANDS[command]]
    return [command, str(given), *more]


@pytest.mark.parametrize("command", COMMANDS)
def test_a_runs_folder_is_its_session(
    command: str, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = []
    for number, given in enumerate((folder, folder / "session.mcap")):
        out = tmp_path / str(number)
        code, printed, errors = run(capsys, *arguments(command, out, given))
        text = (printed + errors).replace(str(out), "OUT")
        said.append((code, text.replace(f"{folder}/session.mcap", "IN").replace(str(folder), "IN")))
    assert said[0] == said[1]
    assert "directory" not in said[0][1]


@pytest.mark.parametrize("recording", RECORDINGS, ids=lambda path: path.name)
@pytest.mark.parametrize(
    "command", [name for name in COMMANDS if name not in ("repair", "convert")]
)
def test_a_recording_of_a_module_is_pointed_to_its_program(
    command: str, recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, _, errors = run(capsys, *arguments(command, tmp_path / "out", recording))
    assert code == 1
    assert "`xethru view`" in errors
    assert str(recording) in errors


def test_the_other_program_takes_a_runs_folder(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_session(tmp_path / "session.mcap", 3, odometry(3))
    said = []
    for given in (tmp_path, tmp_path / "session.mcap"):
        assert xethru(["dump", str(given), "--radar", "radar0", "--json"]) == 0
        said.append(capsys.readouterr().out)
    assert said[0] == said[1] != ""


def test_the_other_program_points_back(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_session(tmp_path / "session.mcap", 3, odometry(3))
    (tmp_path / "session.rrd").write_bytes(b"RRF2" + bytes(100))
    for given in (tmp_path, tmp_path / "session.rrd"):
        assert xethru(["view", str(given)]) == 1
        assert "'uwb-slam view'" in capsys.readouterr().err


def test_a_run_that_fails_before_it_writes_leaves_no_folder(tmp_path: Path) -> None:
    out = tmp_path / "new" / "run"
    with ExitStack() as held:
        hold_folder(out, held)
        assert out.is_dir()
    assert list(tmp_path.iterdir()) == []


INDOOR = {
    "drive_Input.txt": "odom2diff 0 0 0 0 1 1 1 1\nodom2diff 1 0 0 0 1 1 1 1\n",
    "drive_GT.txt": "point2 0 0 0 0 0 0 0\n",
}


@pytest.mark.parametrize(
    "command",
    [
        ("run", "--rig", "lab", "--odometry", "unix:none", "--ports", "none", "--out", "NEW"),
        ("replay", "session.mcap", "--out", "NEW"),
        ("convert", "session.mcap", "NEW/bag"),
        ("benchmark", "uwb-indoor", "--data", ".", "--out", "NEW"),
    ],
    ids=lambda command: command[0],
)
def test_a_command_that_fails_leaves_no_folder(
    command: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    SessionLog(tmp_path / "session.mcap", session_info(), odometry(3)).close()
    for name, text in INDOOR.items():
        (tmp_path / name).write_text(text)
    before = sorted(tmp_path.iterdir())
    code, _, errors = run(capsys, *(each.replace("NEW", "new/deep") for each in command))
    assert code == 1
    assert len(errors.splitlines()) == 1
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("content", [None, "summary.json"])
def test_a_folder_that_was_there_or_holds_something_stays(
    tmp_path: Path, content: str | None
) -> None:
    out = tmp_path / "run"
    if content is None:
        out.mkdir()
    with ExitStack() as held:
        hold_folder(out, held)
        if content is not None:
            (out / content).touch()
        with ExitStack() as again, pytest.raises(AppError):
            hold_folder(out, again)
    assert out.is_dir()
    assert [path.name for path in out.iterdir()] == ([] if content is None else [content])


@pytest.mark.parametrize(
    ("typo", "meant", "others"),
    [
        (["veiw"], "view", ("calibrate", "benchmark")),
        (["demo", "--scene", "lap"], "lab", ("corridor", "store")),
        (["demo", "--scene", "pilars:3"], "pillars", ("corridor", "store")),
        (["demo", "--preset", "robsut"], "robust", ()),
        (["benchmark", "plasa", "--data", "."], "plaza", ()),
        (["sweep", "--stress", "outlier", "--json", "x"], "outliers", ("dropped", "skew")),
        (["sweep", "--set", "detection.mim_range_m=1", "--json", "x"], "min_range_m", ("sigma",)),
        (["demo", "--set", "robust.pathces=true"], "patches", ("sigma",)),
    ],
    ids=lambda value: value[-1] if isinstance(value, list) else "",
)
def test_a_typo_is_answered_by_what_was_meant(
    typo: list[str], meant: str, others: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        code, printed, errors = run(capsys, *typo)
    except SystemExit as ended:
        code, printed, errors = int(str(ended.code)), "", capsys.readouterr().err
    assert code == 2
    assert printed == ""
    last = errors.splitlines()[-1]
    assert f"did you mean {meant}?" in last
    assert not any(name in last for name in others)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--set", "robust.patches"], "KEY=VALUE"),
        (["--set", "=true"], "KEY=VALUE"),
        (["--set", "robust.patches= "], "KEY=VALUE"),
        (["--set", ".patches=true"], ".patches"),
        (["--set", "robust.patches=2"], "robust.patches"),
        (["--set", "detection.min_range_m=-1"], "detection.min_range_m"),
        (["--set", "window.size=1", "--set", "window.size=2"], "window.size"),
        (["--set", "robust.patches=true", "--preset", "paper"], "robust.patches"),
        (["--set", "robust.patches=true", "--set", "back_end=paper"], "robust.patches"),
        (["--set", "association.gate=1"], "association.gate"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_wrong_setting_is_refused_before_anything_is_written(
    options: list[str], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        code = main(["demo", "--out", str(tmp_path / "out"), *options])
    except SystemExit as ended:
        code = int(str(ended.code))
    printed, errors = capsys.readouterr()
    assert (code, printed) == (2, "")
    last = errors.splitlines()[-1]
    assert "--set" in last
    assert named in last
    assert not [*tmp_path.iterdir()]


def test_a_name_that_is_like_no_other_lists_all(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        run(capsys, "zzz")
    errors = capsys.readouterr().err
    assert all(row.name in errors for row in _COMMANDS)
    code, _, errors = run(capsys, "demo", "--scene", "qqq")
    assert code == 2
    assert all(name in errors for name in shipped_names("scenes"))

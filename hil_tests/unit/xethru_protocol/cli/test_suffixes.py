"""A suffix of a name to be written is honoured or refused, by every command that writes."""

import shutil
from collections.abc import Callable
from datetime import UTC
from pathlib import Path

import pytest

import emulator.cli
import slam.app.cli
import xethru_protocol.cli
from hil_tests.unit.slam.app.sessions import write_session
from hil_tests.unit.xethru_protocol.recordings.messages import MS, counters, frame
from xethru_protocol.recordings import RecordingWriter

Main = Callable[[list[str]], int]
XETHRU, EMULATOR, SLAM = xethru_protocol.cli.main, emulator.cli.main, slam.app.cli.main


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    with RecordingWriter("rec", timezone=UTC) as writer:
        writer.write(frame(3, 5), MS)
    return tmp_path


@pytest.mark.parametrize(
    ("main", "arguments"),
    [
        (XETHRU, ["record", "--port", "p", "--out", "x.csv"]),
        (XETHRU, ["record", "--port", "p", "--out", "x.xtwire"]),
        (XETHRU, ["record", "--port", "p", "--out", "x.MCAP"]),
        (XETHRU, ["record", "--port", "p", "--wire", "x.mcap"]),
        (XETHRU, ["record", "--port", "p", "--wire", "x.dat"]),
        (XETHRU, ["convert", "rec", "x.mcap", "--frame-area", "1", "2"]),
        (XETHRU, ["convert", "rec", "x", "--frames", "rf"]),
        (XETHRU, ["export", "wireshark", "--out", "x.ksy"]),
        (XETHRU, ["export", "kaitai", "--out", "x.lua"]),
        (EMULATOR, ["proxy", "--port", "p", "--wire", "x.pcap"]),
        (EMULATOR, ["proxy", "--port", "p", "--truth", "x.csv"]),
        (SLAM, ["demo", "--out", "x.mcap"]),
        (SLAM, ["run", "--rig", "lab", "--odometry", "-", "--out", "x.rrd"]),
        (SLAM, ["replay", "s.mcap", "--out", "x.mcap"]),
        (SLAM, ["view", "s.mcap", "--out", "x.mcap"]),
        (SLAM, ["view", "s.mcap", "--screenshot", "x.jpg"]),
        (SLAM, ["report", "s.mcap", "--out", "x.pdf"]),
        (SLAM, ["repair", "s.mcap", "--out", "x.bag"]),
        (SLAM, ["calibrate", "s.mcap", "--rig", "x.json"]),
        (SLAM, ["sweep", "--scene", "lab", "--seeds", "1", "--json", "x.csv"]),
    ],
)
def test_the_suffix_of_another_format_is_wrong_usage(
    main: Main, arguments: list[str], here: Path
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert [path.name for path in here.iterdir()] == ["rec"]


@pytest.mark.parametrize(
    ("main", "line", "meant"),
    [
        (XETHRU, "record --port p --out x.MCAP", ".mcap"),
        (XETHRU, "record --port p --out x.xtwire", "--wire x.xtwire"),
        (XETHRU, "record --port p --out y --fsp 3", "--fps"),
        (XETHRU, "stream --prot p", "--port"),
        (XETHRU, "view --port p rec", "rec"),
        (EMULATOR, "serve --bare --cuont 2", "--count"),
        (SLAM, "sweep --scene lab --sed 1 --json x", "--seed"),
    ],
)
def test_the_error_names_what_is_meant(
    main: Main, line: str, meant: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(line.split())
    assert ended.value.code == 2
    assert meant in capsys.readouterr().err.splitlines()[-1]
    assert [path.name for path in here.iterdir()] == ["rec"]


def test_an_argument_that_looks_like_an_option_of_another_program_is_left_to_it(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "script.py").write_text("import sys; print(sys.argv[1:])")
    assert XETHRU(["legacy", "script.py", "--prot", "--"]) == 0
    assert capsys.readouterr().out == "['--prot', '--']\n"


def test_what_is_no_recording_is_answered_with_what_there_is(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recordings = here / "recordings"
    recordings.mkdir()
    for name in ("one.mcap", "two.mcap"):
        assert XETHRU(["convert", "rec", str(recordings / name)]) == 0
    capsys.readouterr()
    for main, command in ((XETHRU, "dump"), (EMULATOR, "play")):
        assert main([command, str(recordings)]) == 1
        assert "one.mcap, two.mcap" in capsys.readouterr().err
    assert XETHRU(["view", "/dev/null"]) == 1
    assert "--port" in capsys.readouterr().err


@pytest.mark.parametrize("target", ["x.mcpa", "x.txt", "x.h5"])
def test_an_unknown_suffix_is_refused_by_convert(target: str, here: Path) -> None:
    assert XETHRU(["convert", "rec", target]) == 1
    assert not (here / target).exists()


@pytest.mark.parametrize("target", ["rec.2026-11-25", "rec.v2", "rec.1", "there.now"])
def test_a_date_or_a_version_is_not_a_suffix(target: str, here: Path) -> None:
    if target == "there.now":
        (here / target).mkdir()
    assert XETHRU(["convert", "rec", target]) == 0
    assert counters(here / target) == [3]
    assert (here / target / "xethru_recording_meta.dat").is_file()


@pytest.mark.parametrize(
    ("target", "code"), [("x.csv", 2), ("x.npz", 2), ("x.mcpa", 2), ("bag.2026-11-25", 0)]
)
def test_a_session_is_converted_to_what_the_suffix_says(target: str, code: int, here: Path) -> None:
    for name in ("session.mcap", "session.bak"):  # by its content
        write_session(here / name, 3)
        assert SLAM(["convert", name, target]) == code
        if code == 0 and name == "session.mcap":
            shutil.rmtree(here / target)
    assert (here / target / "metadata.yaml").is_file() == (code == 0)
    assert (here / target).exists() == (code == 0)

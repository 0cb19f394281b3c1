"""`uwb-slam calibrate` on what `uwb-slam demo` records: planted offsets come back."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hil_tests.paths import FIXTURES
from hil_tests.unit.slam.app.sessions import session_info
from slam.app.cli import main
from slam.app.odometry.track import OdometryTrack
from slam.app.odometry.tum import TumSample
from slam.app.rig.files import load_rig
from slam.app.session.log import SessionLog

SCENES = FIXTURES / "scenes"


def short_drive(folder: Path) -> str:
    """Write the scene with two laps of three, at twice the speed: 77 s instead of 231."""
    text = (SCENES / "calibration.toml").read_text()
    for line, other in (
        ('laps = ["forward", "backward", "forward"]', 'laps = ["forward", "backward"]'),
        ("speed_mps = 0.05", "speed_mps = 0.1"),
        ("turn_rate_deg_per_s = 28.125", "turn_rate_deg_per_s = 45.0"),
    ):
        assert text.count(line) == 1
        text = text.replace(line, other)
    path = folder / "short.toml"
    path.write_text(text)
    return str(path)


@pytest.mark.slow
def test_a_recorded_drive_gives_back_what_the_scene_planted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = short_drive(tmp_path)
    assert (
        main(["demo", "--preset", "paper", "--scene", scene, "--seed", "0", "--out", str(tmp_path)])
        == 0
    )
    capsys.readouterr()
    session, rig = str(tmp_path / "session.mcap"), tmp_path / "rig.toml"
    command = ["calibrate", session, "--truth", "calibration", "--json", "--rig", str(rig)]
    assert main(command) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["landmarks"] == 6
    assert facts["poor_drive"] == []
    for radar in facts["radars"]:
        assert abs(radar["range_offset_m"] - radar["planted_offset_m"]) < 1e-3, radar
        assert abs(radar["gain_db"] - radar["planted_gain_db"]) < 0.05, radar
        assert radar["told"]
    offsets = [mount.range_offset_m for mount in load_rig(rig).rig.mounts]
    assert offsets == [radar["range_offset_m"] for radar in facts["radars"]]


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["none.mcap"], 1, "none.mcap: cannot read"),
        (["none.mcap", "--truth", "nowhere"], 2, "nowhere: no such scene"),
        (["none.mcap", "--reflectors", "nowhere"], 2, "nowhere: no such scene"),
    ],
)
def test_what_cannot_be_used_is_one_line(
    arguments: list[str], code: int, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["calibrate", *arguments]) == code
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--rig", "{folder}/none/rig.toml"], "--rig: there is no folder {folder}/none"),
        (["--rig", "{folder}"], "--rig: {folder} is a folder"),
        (["--rig", "{session}"], "--rig: {session} is the session itself"),
        (["--truth", "visitor"], "--truth: scene visitor has no radar radar0"),
    ],
)
def test_what_will_be_refused_is_refused_before_the_work(
    arguments: list[str],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The session holds no frame: that is found out by reading it."""
    session = tmp_path / "session.mcap"
    start = TumSample(t_ns=0, x_m=0.0, y_m=0.0, qz=0.0, qw=1.0)
    log = SessionLog(session, session_info(), OdometryTrack([start]))
    log.close()
    before = session.read_bytes()
    filled = [text.format(folder=tmp_path, session=session) for text in arguments]
    assert main(["calibrate", str(session), *filled]) == 2
    error = capsys.readouterr().err
    assert said.format(folder=tmp_path, session=session) in error
    assert error.count("\n") == 1
    assert session.read_bytes() == before


def test_a_reflector_without_a_place_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "places.toml"
    file.write_text("[[reflectors]]\nx_m = 1.0\ny_m = 2\n[[reflectors]]\nx_m = true\ny_m = 0.0\n")
    assert main(["calibrate", "none.mcap", "--reflectors", str(file)]) == 1
    assert f"{file}: reflectors[1]: must be a table with x_m and y_m" in capsys.readouterr().err

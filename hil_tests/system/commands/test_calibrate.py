"""`uwb-slam calibrate` on what `uwb-slam demo` records: planted offsets come back."""

import json
from pathlib import Path

import pytest

from hil_tests.paths import FIXTURES
from slam.app.cli import main
from slam.app.rig.rig_files import load_rig

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


@pytest.mark.rare
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

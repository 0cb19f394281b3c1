"""`uwb-slam calibrate` on what `uwb-slam demo` records: planted offsets come back."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from hil_tests.paths import FIXTURES
from hil_tests.unit.slam.app.sessions import odometry, session_info, write_session
from slam.app.cli import main
from slam.app.rig.rig_files import load_rig
from slam.config import WheelNoise
from slam.library.rig_files import RigPulse

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


def test_what_a_drive_does_not_determine_stays_as_it_was(tmp_path: Path) -> None:
    """Frames of noise determine nothing."""
    info, wheels = session_info(), WheelNoise(scale_sigma=0.02, heading_rad_per_sqrt_m=0.003)
    pulse = RigPulse(
        step_m=0.0388,
        relative_error=0.02,
        real=(0.0, 0.4, 1.0, 0.5, 0.1),
        imaginary=(0.0, -0.1, 0.0, 0.2, 0.0),
    )
    radars = tuple(
        replace(radar, serial=f"{index:012}", range_offset_m=0.01, gain_db=gain_db, pulse=received)
        for index, (radar, gain_db, received) in enumerate(
            zip(info.radars, (1.5, -1.5), (pulse.received, None), strict=True)
        )
    )
    known = replace(info, radars=radars, wheels=asdict(wheels))
    session = write_session(tmp_path / "s.mcap", 6, odometry(8), known)
    assert main(["calibrate", str(session), "--rig", str(tmp_path / "rig.toml")]) == 0
    found = load_rig(tmp_path / "rig.toml")
    assert found.wheels.noise == wheels
    assert [radar.gain_db for radar in found.radars] == [1.5, -1.5]
    assert [radar.pulse for radar in found.radars] == [pulse, None]
    assert [radar.range_offset_m for radar in found.radars] == [0.01, 0.01]


def test_modules_without_serial_numbers_make_no_rig_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A session that was made of a bag or a MATLAB file has none."""
    info = session_info()
    unnamed = replace(info, radars=tuple(replace(radar, serial="") for radar in info.radars))
    session = write_session(tmp_path / "s.mcap", 6, odometry(8), unnamed)
    assert main(["calibrate", str(session), "--rig", str(tmp_path / "rig.toml")]) == 1
    assert "leave --rig out" in capsys.readouterr().err
    assert not (tmp_path / "rig.toml").exists()


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

"""Rig files: what is written comes back, and what is wrong is named."""

import math
import tomllib
from pathlib import Path

import pytest

from emulator.scene.scene import load_scene
from hil_tests.paths import FIXTURES
from slam.app.errors import UsageError
from slam.app.rig.emulated import rig_of
from slam.app.rig.rig_files import load_rig, write_rig
from slam.config import WheelNoise
from slam.geometry import ReceivedPulse
from slam.library.rig_files import RigFile, RigPulse, RigRadar, RigWheels
from slam.live.errors import AppError

RADAR = """\
[[radars]]
name = "left"
serial = "202305070101"
x_m = 0.1
y_m = 0
yaw_deg = 90
"""


def test_a_rig_comes_back_with_the_same_floats(tmp_path: Path) -> None:
    rig = RigFile(
        radars=(
            RigRadar(
                name='a "b" \\ é',
                serial="202305070101",
                x_m=-1 / 3,
                y_m=1e-17,
                yaw_deg=90.0,
                range_offset_m=0.1 + 0.2,
                phase_offset_deg=100 / 3,
                gain_db=-1.5,
                pulse=RigPulse(
                    step_m=0.0388,
                    relative_error=0.02,
                    real=(0.0, 0.3, 0.98, 0.4, 0.1),
                    imaginary=(1e-17, -0.1, 0.0, 1 / 3, 0.0),
                ),
            ),
            RigRadar(name="b", serial="202305070102", x_m=0.0, y_m=0.0, yaw_deg=0.0),
        ),
        wheels=RigWheels(scale_sigma=0.02, curvature_sigma_rad_per_m=0.001),
    )
    write_rig(tmp_path / "rig.toml", rig)
    assert load_rig(tmp_path / "rig.toml") == rig
    first, second = rig.rig.mounts
    assert first.pulse == ReceivedPulse(
        step_m=0.0388,
        relative_error=0.02,
        real=(0.0, 0.3, 0.98, 0.4, 0.1),
        imaginary=(1e-17, -0.1, 0.0, 1 / 3, 0.0),
    )
    assert second.pulse is None
    noise = rig.wheels.noise
    assert (noise.scale_sigma, noise.curvature_sigma_rad_per_m) == (0.02, 0.001)
    assert noise.turn_scale_sigma == WheelNoise().turn_scale_sigma
    (path := tmp_path / "plain.toml").write_text(RADAR)
    assert load_rig(path).wheels.noise == WheelNoise()


def test_a_rig_file_gives_mounts_in_radians(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(RADAR + "range_offset_m = 0.02\nphase_offset_deg = -45\n")
    (mount,) = load_rig(path).rig.mounts
    assert mount.yaw_rad == pytest.approx(math.pi / 2)
    assert mount.phase_offset_rad == pytest.approx(-math.pi / 4)
    assert (mount.name, mount.x_m, mount.y_m, mount.range_offset_m) == ("left", 0.1, 0.0, 0.02)


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("step_m = 0.5", r"radars\[0\]\.pulse\.step_m: .*0\.05"),
        ("relative_error = 1.0", r"radars\[0\]\.pulse\.relative_error: .*less than 1"),
        ("real = [0.0, 1.0, 0.0]", r"radars\[0\]\.pulse\.real: .*5"),
        ("real = [0.0, 0.0, 0.5, 1.0, 0.5, 0.0, 0.0]", r"pulse: .*the same odd number of samples"),
        ("real = [1.0, 0.5, 0.0, 0.0, 0.0]", r"pulse: .*middle sample must be about 1"),
        ("real = [0.0, 0.5, nan, 0.5, 0.0]", r"radars\[0\]\.pulse\.real"),
        ("samples = 3", r"pulse\.samples"),
    ],
)
def test_a_pulse_that_is_none_is_refused_by_key(tmp_path: Path, line: str, problem: str) -> None:
    lines = {
        "step_m": "step_m = 0.0388",
        "relative_error": "relative_error = 0.02",
        "real": "real = [0.0, 0.5, 1.0, 0.5, 0.0]",
        "imaginary": "imaginary = [0.0, 0.0, 0.0, 0.0, 0.0]",
    }
    lines[line.split(" ")[0]] = line
    (path := tmp_path / "rig.toml").write_text(
        RADAR + "[radars.pulse]\n" + "\n".join(lines.values()) + "\n"
    )
    with pytest.raises(AppError, match=problem) as refused:
        load_rig(path)
    assert "\n" not in str(refused.value)


def test_the_name_of_a_scene_gives_the_rig_file_that_ships_for_it() -> None:
    """What the file holds, read as plain TOML, is what stands in the scene."""
    file = FIXTURES / "rigs" / "lab.toml"
    assert load_rig("lab") == load_rig(file) == load_rig(str(file))
    rig, scene = (tomllib.loads(p.read_text()) for p in (file, FIXTURES / "scenes" / "lab.toml"))
    assert rig["radars"] == scene["radars"]
    assert rig["wheels"] | {"rate_hz": 5.0} == scene["odometry"]
    assert load_rig("lab").rig == rig_of(load_scene("lab"))


def test_a_name_that_is_no_scenes_is_refused_with_those_that_are() -> None:
    with pytest.raises(UsageError, match=r"--rig robot: no such scene, .*; known are .*lab"):
        load_rig("robot")


def test_the_file_of_a_scene_is_called_one() -> None:
    with pytest.raises(AppError, match="is a scene"):
        load_rig(FIXTURES / "scenes" / "lab.toml")


def test_two_radars_of_one_name_are_refused_in_plain_words(tmp_path: Path) -> None:
    (path := tmp_path / "rig.toml").write_text(RADAR + RADAR)
    with pytest.raises(AppError):
        load_rig(path)


def test_a_folder_that_does_not_exist_is_named(tmp_path: Path) -> None:
    with pytest.raises(AppError):
        write_rig(tmp_path / "no" / "rig.toml", load_rig("lab"))

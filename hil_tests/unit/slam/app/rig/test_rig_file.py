"""Rig files: written and read back, and each mistake is one line."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from slam.app.errors import AppError
from slam.app.rig.files import RigFile, RigRadar, RigWheels, load_rig, write_rig
from slam.config import WheelNoise

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
            ),
        )
    )
    write_rig(tmp_path / "rig.toml", rig)
    assert load_rig(tmp_path / "rig.toml") == rig


def test_wheels_come_back_and_tell_slam_how_they_err(tmp_path: Path) -> None:
    rig = RigFile(
        radars=(RigRadar(name="a", serial="000000000001", x_m=0, y_m=0, yaw_deg=0),),
        wheels=RigWheels(scale_sigma=0.02, curvature_sigma_rad_per_m=0.001),
    )
    write_rig(tmp_path / "rig.toml", rig)
    assert load_rig(tmp_path / "rig.toml") == rig
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
    ("text", "said"),
    [
        (RADAR + "[wheels]\nslip = 1\n", r"wheels.slip: unknown key; allowed are along_sigma"),
        (RADAR + "[wheels]\nscale_sigma = -1\n", r"wheels.scale_sigma: .*got -1"),
        (RADAR + "colour = 1\n", r"radars\[0\].colour: unknown key; allowed are name, serial, x_m"),
        ("radar = []\n" + RADAR, r"radar: unknown key; allowed are radars"),
        (RADAR.replace("x_m = 0.1\n", ""), r"radars\[0\].x_m: missing"),
        (RADAR.replace("0.1", '"0.1"'), r"radars\[0\].x_m: .*got '0.1'"),
        (RADAR.replace("0.1", "nan"), r"radars\[0\].x_m"),
        (RADAR.replace("0.1", "true"), r"radars\[0\].x_m"),
        (RADAR.replace("202305070101", "12"), r"radars\[0\].serial"),
        (RADAR + RADAR, r"radars.name: must be unique, 'left' is used twice"),
        ("radars = []\n", r"radars"),
        ("[[radars\n", r"not valid TOML"),
    ],
)
def test_a_mistake_is_one_line_with_file_and_key(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(text)
    with pytest.raises(AppError, match=said) as caught:
        load_rig(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_a_folder_that_does_not_exist_are_named(tmp_path: Path) -> None:
    with pytest.raises(AppError, match="cannot read the rig file: No such file"):
        load_rig(tmp_path / "none.toml")
    radar = RigRadar(name="a", serial="202305070101", x_m=0.0, y_m=0.0, yaw_deg=0.0)
    with pytest.raises(AppError, match="cannot be written"):
        write_rig(tmp_path / "no" / "rig.toml", RigFile(radars=(radar,)))


def test_what_is_endless_is_no_rig_file(tmp_path: Path) -> None:
    (deep := tmp_path / "deep.toml").write_text("a=" + "[" * 5000)
    with pytest.raises(AppError, match="brackets within brackets"):
        load_rig(deep)
    with pytest.raises(AppError, match="longer than 1 MiB"):
        load_rig(Path("/dev/zero"))

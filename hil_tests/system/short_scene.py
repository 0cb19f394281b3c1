"""A scene short enough for tests that run everything: half a metre there and back, five rods."""

from pathlib import Path

_SCENE = """\
name = "short"
environment = "lab"
description = "Half a metre along x and back, two radars on each side."

[path]
waypoints_m = [[0.0, 0.0], [0.5, 0.0]]
laps = {laps}
speed_mps = 0.05
turn_rate_deg_per_s = 28.125

[odometry]
rate_hz = 5.0
scale_sigma = 0.007
turn_scale_sigma = 0.007
curvature_sigma_rad_per_m = 0.0042
along_sigma_m_per_sqrt_m = 0.002
across_sigma_m_per_sqrt_m = 0.0006
heading_sigma_rad_per_sqrt_m = 0.0042
heading_sigma_rad_per_rad = 0.01
"""

_RADARS = {
    "front_left": (0.1, 0.2, 90.0),
    "rear_left": (-0.1, 0.2, 90.0),
    "front_right": (0.1, -0.2, -90.0),
    "rear_right": (-0.1, -0.2, -90.0),
}
_RODS = ((0.1, 0.9), (0.5, 1.3), (0.0, -1.0), (0.45, -0.8), (0.9, 0.8))


def write_short_scene(folder: Path, repeats: int = 1) -> Path:
    """Write the scene file and return its path; the drive takes 59 s of scene time each."""
    parts = [_SCENE.format(laps=["forward", "backward"] * repeats)]
    for index, (name, (x, y, yaw)) in enumerate(_RADARS.items()):
        parts.append(
            f'[[radars]]\nname = "{name}"\nserial = "00000000010{index}"\n'
            f"x_m = {x}\ny_m = {y}\nyaw_deg = {yaw}\n"
        )
    for index, (x, y) in enumerate(_RODS):
        parts.append(f'[[targets]]\nname = "rod_{index}"\nkind = "rod"\nx_m = {x}\ny_m = {y}\n')
    path = folder / "short.toml"
    path.write_text("\n".join(parts))
    return path

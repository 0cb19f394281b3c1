"""SLAM with one radar.

One module sees ranges without directions; the way of the robot gives them. So landmarks come later
than with two, and the robot must pass them on more than one way: here a module that looks to the
right on two laps of a square, one in each direction, which end where they began. It finds four of
the six rods; its path is little better than that of the wheels. It prints

```text
where it began: wheels 12 mm off, SLAM 6 mm
landmark at +1.73, +0.64
landmark at +0.71, +1.61
landmark at -0.90, +0.29
landmark at -0.23, -0.96
landmark at +1.24, -0.59
landmark at -0.64, +1.62
```
"""

import math
from pathlib import Path

from emulator import emulated_port
from slam import Mount, Rig, Slam
from slam.live import open_rig, read_odometry_socket


def main(port: Path) -> None:
    wheels = read_odometry_socket(str(port.with_name("odometry.sock")))
    right = Mount(x_m=0.1, y_m=-0.2, yaw_rad=-math.pi / 2)
    with open_rig(Rig([right]), [str(port)], time_base="counter") as rig:
        slam = Slam(rig.rig)
        for scan in rig:
            if scan.t_ns > wheels.last_ns:  # the drive is over
                break
            state = slam.step(scan.t_ns, wheels.pose_at, frames=scan)
    wheels_mm, slam_mm = (
        1000 * math.hypot(*pose[:2]) for pose in (wheels.pose_at(wheels.last_ns), state.pose)
    )
    print(f"where it began: wheels {wheels_mm:.0f} mm off, SLAM {slam_mm:.0f} mm")
    for x_m, y_m in slam.landmarks.positions_m:
        print(f"landmark at {x_m:+.2f}, {y_m:+.2f}")


if __name__ == "__main__":
    scene = Path(__file__).with_name("short_drive.toml")
    with emulated_port(scene, "--pace", "asap") as port:
        main(Path(port).with_name("right_front"))

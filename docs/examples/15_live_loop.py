"""Run SLAM on modules in a loop of your own.

`open_rig` sets up the modules of a robot and gives a scan for each frame period; `Slam.step` takes
it with the pose of the wheels, and returns where the robot is. Here both come from an emulated
robot, as fast as they are read, and frames are timed by their counters. On a robot of your own it
is `open_rig("robot.toml")`, times are those of `time.monotonic_ns`, and the poses of its wheels are
given by `slam.add_odometry(stamp_ns, pose)` before `slam.step(scan.t_ns, frames=scan)`. It prints

```text
10 s: at +0.80, +0.50 m, 6 landmarks
20 s: at -0.01, +0.80 m, 6 landmarks
30 s: at -0.00, +0.19 m, 6 landmarks
40 s: at +0.65, +0.80 m, 6 landmarks
50 s: at +0.70, +0.00 m, 6 landmarks
```
"""

import math
from pathlib import Path

from emulator import emulated_port
from slam import Mount, Rig, Slam
from slam.live import open_rig, read_odometry_socket

NAMES = ("left_rear", "left_front", "right_rear", "right_front")
RIG = Rig(
    [
        Mount(x_m=-0.1, y_m=0.2, yaw_rad=math.pi / 2),
        Mount(x_m=0.1, y_m=0.2, yaw_rad=math.pi / 2),
        Mount(x_m=-0.1, y_m=-0.2, yaw_rad=-math.pi / 2),
        Mount(x_m=0.1, y_m=-0.2, yaw_rad=-math.pi / 2),
    ]
)


def main(folder: Path) -> None:
    wheels = read_odometry_socket(str(folder / "odometry.sock"))
    ports = [str(folder / name) for name in NAMES]
    with open_rig(RIG, ports, time_base="counter") as rig:
        slam, shown_s = Slam(rig.rig), 0
        for scan in rig:
            if scan.t_ns > wheels.last_ns:  # the drive is over
                break
            state = slam.step(scan.t_ns, wheels.pose_at, frames=scan)
            if scan.t_ns >= (shown_s + 10) * 1e9:
                shown_s += 10
                x_m, y_m, _ = state.pose
                print(f"{shown_s} s: at {x_m:+.2f}, {y_m:+.2f} m, {len(slam.landmarks)} landmarks")


if __name__ == "__main__":
    scene = Path(__file__).with_name("short_drive.toml")
    with emulated_port(scene, "--pace", "asap") as port:
        main(Path(port).parent)

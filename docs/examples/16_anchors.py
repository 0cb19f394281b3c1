"""SLAM with ranges from elsewhere: UWB anchors that say who they are.

A tag on the robot measures ranges to four anchors at places that are not known. With the id of the
anchor each range says what it is of; its noise is given with it. Here tag and wheels are simulated:
ranges are off by 5 cm, the wheels by 2 % of the way. It prints

```text
after 24 m: wheels 24 cm off, SLAM 2 cm
anchor 101 at +4.0, +3.0 m
anchor 102 at -3.0, +2.0 m
anchor 103 at +2.0, -4.0 m
anchor 104 at -2.0, -3.0 m
```
"""

import math

import numpy as np

from slam import Mount, Rig, Slam, WheelNoise

ANCHORS = {101: (4.0, 3.0), 102: (-3.0, 2.0), 103: (2.0, -4.0), 104: (-2.0, -3.0)}
PERIOD_NS = 200_000_000


def main() -> None:
    random = np.random.default_rng(0)
    tag = Mount(x_m=0.0, y_m=0.0, yaw_rad=0.0)
    slam = Slam(Rig([tag]), wheels=WheelNoise(scale_sigma=0.02, curvature_sigma_rad_per_m=0.02))
    for k in range(400):
        turned_rad = 0.06 * k / 1.5  # a circle of 1.5 m, to the left
        robot_m = 1.5 * np.array([math.sin(turned_rad), 1.0 - math.cos(turned_rad)])
        wheels_rad = 1.01 * turned_rad
        wheels_m = 1.53 * np.array([math.sin(wheels_rad), 1.0 - math.cos(wheels_rad)])
        ranges = [
            (0, math.dist(robot_m, place_m) + random.normal(0.0, 0.05), 0.05, anchor)
            for anchor, place_m in ANCHORS.items()
        ]
        state = slam.step(k * PERIOD_NS, (*wheels_m, wheels_rad), ranges=ranges)
    wheels_cm, slam_cm = (
        100 * math.dist(robot_m, place_m) for place_m in (wheels_m, state.pose[:2])
    )
    print(f"after {0.06 * 400:.0f} m: wheels {wheels_cm:.0f} cm off, SLAM {slam_cm:.0f} cm")
    found = slam.landmarks
    for anchor, (x_m, y_m) in sorted(zip(found.given_ids, found.positions_m.tolist(), strict=True)):
        print(f"anchor {anchor} at {x_m:+.1f}, {y_m:+.1f} m")


if __name__ == "__main__":
    main()

"""Run SLAM on a recorded session.

`uwb-slam demo` and `uwb-slam run` record a drive into `session.mcap`: every frame, the odometry and
all settings. This program reads such a file, runs SLAM on it in a loop of its own, which makes the
same states as `uwb-slam replay`, to the last bit, and uses them: poses with covariances, and a map
of landmarks. Positions are in metres in the map's frame, which begins where the robot started, x
forward and y to the left.

Without an argument an emulated robot first drives two laps among six rods, in some seconds; for a
session of your own: `python 09_slam_on_a_session.py out/run/session.mcap`. It prints

```text
wrote drive/session.mcap
274 poses in 55 s
error of the path: wheels 10 mm, SLAM 1 mm
landmark at +0.72, +1.61, standard deviation 5 mm
landmark at -0.63, +1.63, standard deviation 6 mm
landmark at -0.23, -0.96, standard deviation 5 mm
landmark at +1.24, -0.60, standard deviation 4 mm
landmark at -0.90, +0.29, standard deviation 4 mm
landmark at +1.73, +0.63, standard deviation 5 mm
```
"""

import subprocess
import sys
from pathlib import Path

import numpy as np

from slam import Slam, ate_rmse_m
from slam.live import open_session


def main(path: str) -> None:
    with open_session(path) as session:
        slam = Slam(session.rig, session.config, wheels=session.wheels)
        states, wheels, truth = [], [], []
        for scan in session:
            state = slam.step(scan.t_ns, scan.odometry, frames=scan)
            if state.results:  # the robot has moved
                states.append(state)
                wheels.append(scan.odometry_pose)
                truth.append(scan.truth)
    if not states:
        sys.exit(f"{path}: too short, SLAM estimated no pose")

    print(f"{len(states)} poses in {states[-1].t_ns / 1e9:.0f} s")
    if session.info.simulated:
        true_m, wheels_m = np.array(truth)[:, :2], np.array(wheels)[:, :2]
        slam_m = np.array([state.pose[:2] for state in states])
        wheels_mm, slam_mm = (1000 * ate_rmse_m(path_m, true_m) for path_m in (wheels_m, slam_m))
        print(f"error of the path: wheels {wheels_mm:.0f} mm, SLAM {slam_mm:.0f} mm")
    found = slam.landmarks
    for (x_m, y_m), covariance in zip(found.positions_m, found.covariances_m2, strict=True):
        sigma_mm = 1000 * np.sqrt(np.trace(covariance) / 2)
        print(f"landmark at {x_m:+.2f}, {y_m:+.2f}, standard deviation {sigma_mm:.0f} mm")


def drive() -> str:
    scene = str(Path(__file__).with_name("short_drive.toml"))
    demo = ["demo", "--scene", scene, "--out", "drive", "--lean"]
    subprocess.run([sys.executable, "-m", "slam.app.cli", *demo], stdout=subprocess.DEVNULL)
    print("wrote drive/session.mcap")
    return "drive/session.mcap"


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else drive())

"""Run SLAM on a recorded session.

`uwb-slam demo` and `uwb-slam run` record a drive into `session.mcap`: every frame, the odometry and
all settings. This program reads such a file, runs SLAM on it as `uwb-slam replay` does, and uses
the states: poses with covariances, and a map of landmarks. Positions are in metres in the map's
frame, which begins where the robot started, x forward and y to the left.

Without an argument an emulated robot first drives two laps among six rods, in some seconds; for a
session of your own: `python 09_slam_on_a_session.py out/run/session.mcap`. It prints the table of
the emulated drive, and then

```text
...
wrote drive/session.mcap
274 poses in 55 s
error of the path: wheels 10 mm, SLAM 2 mm
landmark at -0.23, -0.96, standard deviation 6 mm
landmark at +0.72, +1.62, standard deviation 6 mm
landmark at +1.24, -0.60, standard deviation 6 mm
landmark at +1.73, +0.63, standard deviation 6 mm
landmark at -0.91, +0.29, standard deviation 6 mm
```

The front end stops at 1.5 m, and one of the six rods was too seldom so near.
"""

import sys
from pathlib import Path

import numpy as np

from slam.app.cli import main as uwb_slam
from slam.app.run.replay import recorded_source
from slam.app.run.runner import execute
from slam.evaluation import ate_rmse_m
from slam.live.session.reader import open_session
from xethru_protocol.operating_system import StopFlag


def main(path: Path) -> None:
    stop = StopFlag()
    record = execute(recorded_source(open_session(path, stop), stop))
    states, last = record.states, record.last
    if last is None:
        sys.exit(f"{path}: too short, SLAM estimated no pose")

    print(f"{len(states)} poses in {record.duration_ns / 1e9:.0f} s")
    if states.has_truth:  # of an emulated drive
        truth = states.truth[:, :2]
        wheels_mm = 1000 * ate_rmse_m(states.odometry[:, :2], truth)
        slam_mm = 1000 * ate_rmse_m(states.estimate[:, :2], truth)
        print(f"error of the path: wheels {wheels_mm:.0f} mm, SLAM {slam_mm:.0f} mm")
    for place, covariance in zip(last.landmarks_m, last.landmark_covariances_m2, strict=True):
        sigma_mm = 1000 * np.sqrt(np.trace(covariance) / 2)
        x_m, y_m = place
        print(f"landmark at {x_m:+.2f}, {y_m:+.2f}, standard deviation {sigma_mm:.0f} mm")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        scene = Path(__file__).with_name("short_drive.toml")
        uwb_slam(["demo", "--scene", str(scene), "--out", "drive", "--lean"])
        print("wrote drive/session.mcap")
        main(Path("drive/session.mcap"))

"""Run many drives on a Dask cluster.

`uwb-slam sweep` drives a scene with many seeds of noise and of the wheels' errors, and prints
medians. `--dask` gives the runs to the workers of a cluster, which need the same version of this
package and none of your files; the numbers are the same as on this machine. A sweep that was
stopped goes on where it was.

Without an argument the cluster is two processes of this machine; for a real one:
`python 12_sweep_on_dask.py tcp://scheduler:8786`. It prints a line with the medians, and then

```text
short_drive, preset robust, 2 runs (simulated): SLAM ATE median ...
wrote sweep.json
seed 0: wheels 11 mm, SLAM 3 mm
seed 1: wheels 11 mm, SLAM 3 mm
```
"""

import json
import sys
from pathlib import Path

from distributed import LocalCluster

from slam.app.cli import main as uwb_slam


def main(scheduler: str) -> None:
    scene = str(Path(__file__).with_name("short_drive.toml"))
    options = ["--scene", scene, "--seeds", "2", "--dask", scheduler, "--json", "sweep.json"]
    if uwb_slam(["sweep", *options]) != 0:
        sys.exit(1)  # it has said why
    print("wrote sweep.json")
    for run in json.loads(Path("sweep.json").read_text())["runs"]:
        wheels_mm, slam_mm = 1000 * run["odometry_ate_rmse_m"], 1000 * run["ate_rmse_m"]
        print(f"seed {run['seed']}: wheels {wheels_mm:.0f} mm, SLAM {slam_mm:.0f} mm")


if __name__ == "__main__":  # the workers import this file, too
    if len(sys.argv) > 1:
        main(sys.argv[1])
    else:
        with LocalCluster(
            n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
        ) as cluster:
            main(cluster.scheduler_address)

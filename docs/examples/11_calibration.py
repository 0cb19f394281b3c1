"""Calibrate the range offsets of a rig.

The ranges of each module are some millimetres or centimetres too long or too short, and mounts are
never quite where the drawing has them. One drive past a few metal rods, at places that need not be
known, is enough to estimate both: `uwb-slam calibrate` takes its session and writes a rig file for
`uwb-slam run --rig`.

Without an argument an emulated robot first drives two laps among six rods; `--truth` then shows
what its scene planted. With a session of your own: `python 11_calibration.py out/run/session.mcap`.
It prints

```text
wrote rig.toml
left_rear: range offset +1.9 cm
left_front: range offset -2.1 cm
right_rear: range offset +1.2 cm
right_front: range offset -0.8 cm
```
"""

import subprocess
import sys
from pathlib import Path

from slam import load_rig


def uwb_slam(*arguments: str) -> None:
    command = [sys.executable, "-m", "slam.app.cli", *arguments]
    if subprocess.run(command, stdout=subprocess.DEVNULL).returncode != 0:
        sys.exit(1)  # it has said why


def main(session: str, *options: str) -> None:
    uwb_slam("calibrate", session, "--rig", "rig.toml", *options)
    print("wrote rig.toml")
    for mount in load_rig("rig.toml").rig.mounts:
        print(f"{mount.name}: range offset {100 * mount.range_offset_m:+.1f} cm")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(sys.argv[1])
    else:
        scene = str(Path(__file__).with_name("short_drive.toml"))
        uwb_slam("demo", "--scene", scene, "--preset", "paper", "--out", "drive", "--lean")
        main("drive/session.mcap", "--truth", scene)

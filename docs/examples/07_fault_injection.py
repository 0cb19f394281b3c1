"""Damage the line, and see what the driver notices.

The emulator knows more than eighty kinds of faults; `xethru-emulator faults` lists them, and
`faults KIND` describes one. `control` adds them while it runs, as `xethru-emulator ctl` does in a
terminal. The driver goes on, and its statistics count what came damaged or not at all.

To put faults on the line of a real module, start `xethru-emulator proxy --port /dev/ttyACM0
--link-dir ports` and run `python 07_fault_injection.py ports/proxy`. The example prints

```text
missing_frames frames=2: 6 frames lost, 0 bytes of junk, 0 samples damaged
noise_between bytes=50 packet=frame: 0 frames lost, 150 bytes of junk, 0 samples damaged
off_lattice_samples samples=7: 0 frames lost, 0 bytes of junk, 21 samples damaged
injected: {'missing_frames': 3, 'noise_between': 3, 'off_lattice_samples': 3}
```
"""

import sys
from pathlib import Path

from emulator import control, emulated_port
from xethru_protocol import X4M300

FAULTS = [
    "missing_frames frames=2",
    "noise_between bytes=50 packet=frame",
    "off_lattice_samples samples=7",
]


def main(port: str) -> None:
    for fault in FAULTS:
        with X4M300.open(port) as radar:
            radar.configure_raw()
            control(port, f"fault add {fault} every=5 count=3")
            radar.start(17)
            for _ in radar.frames(20):
                pass
            seen = radar.statistics
            print(
                f"{fault}: {seen.frames_lost} frames lost, {seen.junk_bytes} bytes of junk, "
                f"{seen.off_lattice_samples} samples damaged"
            )
    injected = control(port, "state")["radars"][Path(port).name]["injected"]
    print(f"injected: {injected}")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(sys.argv[1])
    else:
        # as fast as the program reads, so that nothing is lost but by the faults
        with emulated_port("visitor", "--pace", "asap") as emulated:
            main(emulated)

"""Read frames from a radar.

`X4M300.open` opens the port of a module, `configure_raw` switches it to raw frames, and `start`
lets them come. A frame has one sample per range bin, and `ranges_m` is the range of each. The
samples are what the antenna receives, as a part of full scale; the strongest is the strongest echo.

Without an argument the example opens an emulated module, which looks along a corridor; for one of
your own: `python 01_read_frames.py /dev/ttyACM0`. At `--pace asap` the emulator waits for its
reader, so that the numbers are the same every time. It prints

```text
X4M300 202305070401, firmware 1.6.8
1431 bins of 6.4 mm from 0.20 m on, 17.05 frames per second
frame 1: the strongest sample is +0.0063 at 2.08 m
frame 2: the strongest sample is +0.0067 at 2.08 m
frame 3: the strongest sample is +0.0068 at 2.08 m
frame 4: the strongest sample is +0.0062 at 2.06 m
frame 5: the strongest sample is +0.0063 at 2.06 m
```
"""

import sys

import numpy as np

from emulator import emulated_port
from xethru_protocol import X4M300


def main(port: str) -> None:
    with X4M300.open(port) as radar:
        info = radar.info()
        print(f"X4M300 {info.serial_number}, firmware {info.version}")
        geometry = radar.configure_raw()
        frames_per_s = radar.start(17)
        print(
            f"{geometry.n_bins} bins of {1000 * geometry.bin_length_m:.1f} mm "
            f"from {geometry.range_start_m:.2f} m on, {frames_per_s:.2f} frames per second"
        )
        for frame in radar.frames(5):
            strongest = np.argmax(np.abs(frame.samples))
            print(
                f"frame {frame.counter}: the strongest sample is {frame.samples[strongest]:+.4f} "
                f"at {frame.ranges_m[strongest]:.2f} m"
            )


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(sys.argv[1])
    else:
        with emulated_port("visitor", "--pace", "asap") as emulated:
            main(emulated)

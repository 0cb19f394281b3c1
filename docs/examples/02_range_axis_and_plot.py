"""Plot echoes over range.

A module counts ranges with a speed of light of 3.0e8 m/s; `true_ranges_m` has them in metres. With
`downconversion` the module sends complex baseband samples, 181 in place of 1431, whose magnitude is
the strength of the echoes without the carrier. The mean of many frames has less noise: what stands
still stays, and noise of changing phase cancels.

The example averages two seconds, prints the strongest echoes and saves a picture. With a module of
your own: `python 02_range_axis_and_plot.py /dev/ttyACM0`. It prints

```text
echo at 2.08 m
echo at 5.17 m
wrote echoes.png
```
"""

import sys

import matplotlib.pyplot as plt
import numpy as np

from emulator import emulated_port
from xethru_protocol import X4M300, RawConfig


def main(port: str) -> None:
    with X4M300.open(port) as radar:
        geometry = radar.configure_raw(RawConfig(downconversion=True))
        radar.start(17)
        frames = np.array([frame.samples for frame in radar.frames(34)])

    ranges_m = geometry.true_ranges_m
    strengths = np.abs(frames.mean(axis=0))
    threshold = 5 * np.median(strengths)
    for k in range(1, len(strengths) - 1):
        if strengths[k] > threshold and strengths[k] == max(strengths[k - 1 : k + 2]):
            print(f"echo at {ranges_m[k]:.2f} m")

    plt.plot(ranges_m, 20 * np.log10(strengths))
    plt.axhline(20 * np.log10(threshold), linestyle="--", label="5 times the median")
    plt.xlabel("range [m]")
    plt.ylabel("strength [dB of full scale]")
    plt.legend()
    plt.savefig("echoes.png")  # plt.show() opens a window
    print("wrote echoes.png")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(sys.argv[1])
    else:
        with emulated_port("visitor", "--pace", "asap") as emulated:
            main(emulated)

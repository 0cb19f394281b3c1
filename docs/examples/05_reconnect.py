"""Survive an unplugged cable.

With `reconnect_s` the driver looks for a module that vanished, by its serial number and on every
port, sets it up again as it was, and goes on. What comes then is a new `stream`, in which the
counter begins anew; `frames_lost` counts what is missing, by the time and the frame rate.

Without an argument the example unplugs an emulated module for half a second. With one of your own,
pull its cable and plug it in again: `python 05_reconnect.py /dev/ttyACM0`. It prints

```text
stream 0, frame 1
stream 0, frame 10
the cable is pulled
stream 1, frame 1
stream 1, frame 10
1 reconnect, ... frames lost
```
"""

import sys

from emulator import control, emulated_port
from xethru_protocol import X4M300


def main(port: str, is_emulated: bool) -> None:
    with X4M300.open(port, reconnect_s=60) as radar:
        radar.configure_raw()
        radar.start(17)
        for frame in radar.frames():
            if frame.counter in (1, 10):
                print(f"stream {frame.stream}, frame {frame.counter}")
            if (frame.stream, frame.counter) == (0, 10) and is_emulated:
                print("the cable is pulled")
                control(port, "unplug 0.5")
            if (frame.stream, frame.counter) == (1, 10):
                break
        print(f"{radar.reconnects} reconnect, {radar.frames_lost} frames lost")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(sys.argv[1], is_emulated=False)
    else:
        with emulated_port("visitor") as emulated:
            main(emulated, is_emulated=True)

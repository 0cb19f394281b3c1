"""Record what a radar sends, and read it back.

A `Recorder` stores every message of a module while the program goes on using it, in the format of
the vendor's ModuleConnector: a directory with a meta file, which `xethru dump` prints, `xethru
convert` converts and `xethru-emulator play` plays at an emulated port. `read_recording` takes it,
and every other format of this package.

With a module of your own: `python 04_recording.py /dev/ttyACM0`. It prints

```text
wrote recordings/xethru_recording_...
20 frames in ... s
counters 1 to 20, an array of shape (20, 1431)
```
"""

import sys

import numpy as np

from emulator import emulated_port
from xethru_protocol import X4M300, Recorder, read_recording
from xethru_protocol.wire.messages import DataFloat


def record(port: str) -> str:
    with X4M300.open(port) as radar:
        radar.configure_raw()
        with Recorder(radar, "recordings") as recorder:
            radar.start(17)
            for _ in radar.frames(20):
                pass  # use the frame here
    return str(recorder.directory)


def main(port: str) -> None:
    directory = record(port)
    print(f"wrote {directory}")

    times_ns, counters, frames = [], [], []
    for message, time_ns in read_recording(directory):
        if isinstance(message, DataFloat):  # a raw frame, as the module sent it
            times_ns.append(time_ns)
            counters.append(message.info)
            frames.append(message.values)
    times = np.array(times_ns, "datetime64[ns]")  # UTC, of arrival
    print(f"{len(frames)} frames in {(times[-1] - times[0]) / np.timedelta64(1, 's'):.1f} s")
    print(f"counters {counters[0]} to {counters[-1]}, an array of shape {np.array(frames).shape}")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(sys.argv[1])
    else:
        with emulated_port("visitor") as emulated:
            main(emulated)

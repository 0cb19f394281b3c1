"""Load a recording as arrays.

`load` gives the frames of any recording as one array, here complex baseband, with the time and
counter of each frame and the range of each bin. The example looks for the strongest echo behind the
first metre, where the antennas hear each other. `xethru convert` writes the same arrays as `.csv`,
`.mat` or `.npz`.

With a recording of your own: `python 13_arrays.py rec`. It prints

```text
visitor.mcap: left 34 messages, .../s, 0 lost; in ... s
34 frames of 181 bins, 17.0 per second, ... s long
the strongest echo lies at 2.08 m
```
"""

import sys

import numpy as np

from emulator import emulated_port
from xethru_protocol import load
from xethru_protocol.cli import main as xethru


def main(path: str) -> None:
    recording = load(path)
    if recording.iq is None:
        raise SystemExit(f"{path} holds RF frames, which are in recording.rf")
    seconds = (recording.t_ns[-1] - recording.t_ns[0]) * 1e-9
    print(
        f"{recording.n_frames} frames of {recording.n_bins} bins, "
        f"{recording.frame_rate_hz:.1f} per second, {seconds:.1f} s long"
    )
    ranges_m = recording.true_ranges_m
    strengths = np.where(ranges_m > 1.0, np.abs(recording.iq.mean(axis=0)), 0.0)
    print(f"the strongest echo lies at {ranges_m[strengths.argmax()]:.2f} m")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(sys.argv[1])
    else:
        with emulated_port("visitor") as emulated:
            record = ["record", "--port", emulated, "--baseband", "--out", "visitor.mcap"]
            xethru([*record, "--count", "34", "--force"])
        main("visitor.mcap")

"""Test a program of your own on an emulated radar.

The package brings a plugin of pytest. A test that asks for the fixture `radar` gets a driver of an
emulated module in the same process, whose time is virtual: waiting costs nothing. With `--radar
/dev/ttyACM0` the same test runs on a real module. `measure` records a number and fails the test
beyond its limits.

Copy the functions into a file whose name begins with `test_`, and run `pytest --radar emu:visitor`,
or run this file, which does that: `python 06_emulator_in_a_test.py`, and for a module of your own
`python 06_emulator_in_a_test.py /dev/ttyACM0`. It prints

```text
...
2 passed in ...
```
"""

import subprocess
import sys

import numpy as np

from hil_tests.plugin.findings import Measure
from xethru_protocol import X4M300


def distance_m(radar: X4M300) -> float:
    """Return how far the strongest reflector is: the program under test."""
    radar.configure_raw()
    radar.start(17)
    frames = list(radar.frames(17))
    strengths = np.abs(np.mean([frame.samples for frame in frames], axis=0))
    return float(frames[0].ranges_m[np.argmax(strengths)])


def test_the_radiator_is_found(radar: X4M300, measure: Measure) -> None:
    measure("distance", distance_m(radar), unit="m", limit=(2.0, 2.2))


def test_no_frame_is_lost(radar: X4M300) -> None:
    distance_m(radar)
    assert radar.frames_lost == 0


if __name__ == "__main__":
    radar_spec = sys.argv[1] if len(sys.argv) > 1 else "emu:visitor"
    command = [sys.executable, "-m", "pytest", "-q", __file__, "--radar", radar_spec]
    sys.exit(subprocess.run(command, check=False).returncode)

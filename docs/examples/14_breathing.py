"""Hear somebody breathe.

The chest of a person at rest moves by millimetres, which turns the phase of its echo.
`BreathingMonitor` takes baseband frames as they come and answers, once a second, with the mean rate
of the newest 60 s: breaths per minute, how clear they are from 0 to 1, and at which range. It
answers None when nobody breathes there at rest. This is not a medical device.

The example listens to an emulated person asleep at 1.6 m, who takes 13 breaths a minute. With a
module of your own: `python 14_breathing.py /dev/ttyACM0`. It prints

```text
after 60 s: 13.1 breaths/min at 1.62 m, confidence 0.99
after 75 s: 13.1 breaths/min at 1.62 m, confidence 0.99
after 90 s: 12.8 breaths/min at 1.62 m, confidence 0.99
```
"""

import sys

from emulator import emulated_port
from xethru_protocol import X4M300, RawConfig
from xethru_protocol.processing.vital import BreathingMonitor


def main(port: str) -> None:
    with X4M300.open(port) as radar:
        geometry = radar.configure_raw(RawConfig(downconversion=True, frame_area_m=(0.4, 5.0)))
        frames_per_s = radar.start(17)
        monitor = BreathingMonitor(geometry.ranges_m, frames_per_s)
        every = round(15 * frames_per_s)
        for count, frame in enumerate(radar.frames(6 * every), start=1):
            found = monitor.update(frame.samples)
            if count % every == 0 and count >= 4 * every:
                answer = "nobody breathes at rest"
                if found is not None:
                    answer = (
                        f"{found.rate_bpm:.1f} breaths/min at {found.range_m:.2f} m, "
                        f"confidence {found.confidence:.2f}"
                    )
                print(f"after {count / frames_per_s:.0f} s: {answer}")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(sys.argv[1])
    else:
        with emulated_port("sleeper", "--pace", "asap") as emulated:
            main(emulated)

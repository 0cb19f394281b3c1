"""Read several radars at once with asyncio.

`AsyncX4M300` has the methods of `X4M300` as coroutines. Each module has a task that reads its
frames, and one that pings it meanwhile: any task may send commands while another one reads. There
is no thread; the event loop watches the ports.

Without arguments the example reads both modules of an emulated corridor; with modules of your own:
`python 03_asyncio.py /dev/ttyACM0 /dev/ttyACM1`. It prints

```text
left: frames 1 to 17, strongest echo at 2.08 m, XTS_SPRP_READY
right: frames 1 to 17, strongest echo at 2.34 m, XTS_SPRP_READY
```
"""

import asyncio
import sys
from pathlib import Path

import numpy as np

from emulator import emulated_port
from xethru_protocol import AsyncX4M300


async def strongest_echo(radar: AsyncX4M300) -> str:
    frames = [frame async for frame in radar.frames(17)]
    strengths = np.abs(np.mean([frame.samples for frame in frames], axis=0))
    range_m = frames[0].ranges_m[np.argmax(strengths)]
    return f"frames {frames[0].counter} to {frames[-1].counter}, strongest echo at {range_m:.2f} m"


async def watch(port: str) -> str:
    async with AsyncX4M300.open(port) as radar:
        await radar.configure_raw()
        await radar.start(17)
        echo, answer = await asyncio.gather(strongest_echo(radar), radar.ping())
    return f"{Path(port).name}: {echo}, {answer.name}"


async def main(ports: list[str]) -> None:
    for line in await asyncio.gather(*[watch(port) for port in ports]):
        print(line)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        asyncio.run(main(sys.argv[1:]))
    else:
        with emulated_port("visitor", "--pace", "asap") as left:
            right = str(Path(left).with_name("right"))
            asyncio.run(main([left, right]))

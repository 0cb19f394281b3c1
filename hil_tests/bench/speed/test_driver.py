"""Speed of both drivers on a pty, as `configure_raw` leaves them: ``make bench``.

Numbers are reported, never asserted: a timed test fails for the wrong reasons.
"""

import asyncio
import os
import pty
import subprocess
import sys
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hil_tests.bench.speed.test_protocol import FRAMES, stream_of_frames
from xethru_protocol.driver.async_radar import AsyncX4M300
from xethru_protocol.driver.frames import FrameGeometry, Lattice
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire.framing import Framing

GEOMETRY = FrameGeometry(range_start_m=0.2, bin_length_m=0.0064, n_bins=1431, downconversion=False)
_WRITER = """
import os, sys
stream = memoryview(open(sys.argv[2], "rb").read())
while True:
    rest = stream
    while rest:
        rest = rest[os.write(int(sys.argv[1]), rest[:65536]):]
"""


@pytest.fixture
def port(tmp_path: Path) -> Iterator[str]:
    """Pty into which another process writes quantised frames without end."""
    (tmp_path / "stream").write_bytes(stream_of_frames(Framing.NO_ESCAPE))
    master, slave = pty.openpty()
    tty.setraw(slave)
    command = [sys.executable, "-c", _WRITER, str(master), str(tmp_path / "stream")]
    with subprocess.Popen(command, pass_fds=[master]) as writer:
        yield os.ttyname(slave)
        writer.kill()
    os.close(master)
    os.close(slave)


def test_the_pty_alone(benchmark: Any, port: str) -> None:  # noqa: ANN401 - the plugin has no types
    """What this machine's pseudo-terminals carry, whoever reads them."""
    descriptor = os.open(port, os.O_RDONLY | os.O_NOCTTY)
    wanted = FRAMES * GEOMETRY.frame_bytes

    def read() -> int:
        missing = wanted
        while missing > 0:
            missing -= len(os.read(descriptor, 65536))
        return FRAMES

    assert benchmark(read) == FRAMES
    benchmark.extra_info["frames"] = FRAMES
    os.close(descriptor)


@pytest.mark.parametrize(
    ("lattice", "off"),
    [(RawConfig().lattice, False), (None, False), (RawConfig(iterations=15).lattice, True)],
    ids=["lattice checked", "not checked", "all samples off the lattice"],
)
def test_blocking_driver(
    benchmark: Any,  # noqa: ANN401 - the plugin has no types
    port: str,
    lattice: Lattice | None,
    off: bool,
) -> None:
    """Bar: 20 000 frames/s."""
    radar = X4M300.open(port)
    radar.geometry = GEOMETRY
    radar._link.frames.lattice = lattice
    radar.read_frame(timeout_s=10.0)
    assert benchmark(lambda: sum(1 for _ in radar.frames(FRAMES))) == FRAMES
    assert bool(radar.statistics.off_lattice_samples) == off
    benchmark.extra_info["frames"] = FRAMES
    radar.close()


def test_asynchronous_driver(benchmark: Any, port: str) -> None:  # noqa: ANN401 - the plugin has no types
    with asyncio.Runner() as runner:

        async def begin() -> AsyncX4M300:
            radar = AsyncX4M300.open(port)
            radar.geometry = GEOMETRY
            radar._link.frames.lattice = RawConfig().lattice
            await radar.read_frame(timeout_s=10.0)
            return radar

        radar = runner.run(begin())

        async def read() -> int:
            return len([None async for _ in radar.frames(FRAMES)])

        assert benchmark(lambda: runner.run(read())) == FRAMES
        benchmark.extra_info["frames"] = FRAMES
        runner.run(radar.close())

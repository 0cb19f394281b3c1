"""Speed of the receiver, the driver and the transport: ``make bench``. Bars: design, quality bars.

Numbers are reported, never asserted: a timed test fails for the wrong reasons.
"""

import os
import pty
import subprocess
import sys
import tty
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from xethru_protocol import messages as m
from xethru_protocol.codes import X4Setting
from xethru_protocol.connection import Connection, Role
from xethru_protocol.driver import X4M300
from xethru_protocol.frames import FrameGeometry
from xethru_protocol.lattice import Lattice
from xethru_protocol.packets import NEED_DATA, Framing

FRAMES = 2000
CHUNK = 65536


def _samples() -> NDArray[np.float32]:
    """Quantised noise at the vendor's working point, shape (200, 1431)."""
    counters = np.random.default_rng(0).integers(0, 729_600, (200, 1431))
    return counters.astype(np.float32) * np.float32(2.03450526e-07) - np.float32(0.07421875)


def _stream(framing: Framing) -> bytes:
    """Frames of 1431 samples."""
    samples = _samples()
    module = Connection(Role.MODULE)
    return b"".join(
        module.send(m.DataFloat(info=k, values=samples[k]), framing) for k in range(200)
    ) * (FRAMES // 200)


def _note_rate(benchmark: Any, frames: int) -> None:  # noqa: ANN401 - the plugin has no types
    if benchmark.stats is not None:  # absent under --benchmark-disable
        benchmark.extra_info["frames_per_s"] = frames / benchmark.stats["min"]


@pytest.mark.parametrize("framing", Framing)
def test_decode_1431_float_frames(benchmark: Any, framing: Framing) -> None:  # noqa: ANN401 - the plugin has no types
    """Bars: NoEscape 350 000 frames/s, Normal 57 000."""
    stream = _stream(framing)
    chunks = [stream[begin : begin + CHUNK] for begin in range(0, len(stream), CHUNK)]

    def decode() -> int:
        connection = Connection(Role.HOST)
        events = 0
        for chunk in chunks:
            connection.receive_data(chunk)
            while connection.next_event() is not NEED_DATA:
                events += 1
        return events

    assert benchmark(decode) == FRAMES
    _note_rate(benchmark, FRAMES)


_WRITER = """
import os, sys
stream = memoryview(open(sys.argv[2], "rb").read())
while True:
    rest = stream
    while rest:
        rest = rest[os.write(int(sys.argv[1]), rest[:65536]):]
"""


def test_driver_frames_from_one_pty(benchmark: Any, tmp_path: Path) -> None:  # noqa: ANN401 - the plugin has no types
    """Bar: 20 000 frames/s. Another process writes, as a module would."""
    (tmp_path / "stream").write_bytes(_stream(Framing.NO_ESCAPE))
    master, slave = pty.openpty()
    tty.setraw(slave)
    radar = X4M300.open(os.ttyname(slave))
    radar.geometry = FrameGeometry(
        range_start_m=0.2, bin_length_m=0.0064, n_bins=1431, downconversion=False
    )
    command = [sys.executable, "-c", _WRITER, str(master), str(tmp_path / "stream")]
    with subprocess.Popen(command, pass_fds=[master]) as writer:
        radar.read_frame(timeout_s=10.0)
        assert benchmark(lambda: sum(1 for _ in radar.frames(FRAMES))) == FRAMES
        writer.kill()
    _note_rate(benchmark, FRAMES)
    radar.close()
    os.close(master)
    os.close(slave)


@pytest.mark.parametrize("framing", Framing)
def test_encode_1431_float_frames(benchmark: Any, framing: Framing) -> None:  # noqa: ANN401 - the plugin has no types
    """What an emulated module does with each frame."""
    module = Connection(Role.MODULE)
    frames = [m.DataFloat(info=k, values=values) for k, values in enumerate(_samples())]

    def encode() -> int:
        return sum(len(module.send(frame, framing)) for frame in frames)

    assert benchmark(encode) >= 200 * 5747
    _note_rate(benchmark, 200)


def test_lattice_of_1431_float_frames(benchmark: Any) -> None:  # noqa: ANN401 - the plugin has no types
    """What a driver may spend on each frame to see that no sample was damaged."""
    lattice = Lattice.of(
        iterations=16,
        pulses_per_step=300,
        dac_min=949,
        dac_max=1100,
        dac_step=0,
        downconversion=False,
        tx_center_frequency=3,
    )
    samples = _samples()
    assert benchmark(lambda: sum(lattice.off_lattice(values) for values in samples)) == 0
    _note_rate(benchmark, 200)


def test_encode_commands(benchmark: Any) -> None:  # noqa: ANN401 - the plugin has no types
    host = Connection(Role.HOST)
    command = m.X4DriverSet(setting=X4Setting.FRAMEAREA, value=(0.2, 9.4))
    assert benchmark(host.send, command)

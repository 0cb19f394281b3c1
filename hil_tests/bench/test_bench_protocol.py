"""Speed of the receiver, the driver and the transport: ``make bench``. Bars: design, quality bars.

Numbers are reported, never asserted: a timed test fails for the wrong reasons.
"""

import os
import pty
import threading
import tty
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from xethru_protocol import messages as m
from xethru_protocol.codes import X4Setting
from xethru_protocol.connection import Connection, Role
from xethru_protocol.driver import X4M300
from xethru_protocol.frames import FrameGeometry
from xethru_protocol.packets import NEED_DATA, Framing

FRAMES = 2000
CHUNK = 65536


def _stream(framing: Framing) -> bytes:
    """Frames of 1431 quantised noise samples at the vendor's working point."""
    counters = np.random.default_rng(0).integers(0, 729_600, (200, 1431))
    samples = counters.astype(np.float32) * np.float32(2.03450526e-07) - np.float32(0.07421875)
    module = Connection(Role.MODULE)
    return b"".join(
        module.send(m.DataFloat(info=k, values=samples[k]), framing) for k in range(200)
    ) * (FRAMES // 200)


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
    benchmark.extra_info["frames_per_s"] = FRAMES / benchmark.stats["min"]


def _feeder(master: int, stream: bytes) -> Callable[[], None]:
    def feed() -> None:
        view = memoryview(stream)
        while view:
            view = view[os.write(master, view[:CHUNK]) :]

    return feed


def test_driver_frames_from_one_pty(benchmark: Any) -> None:  # noqa: ANN401 - the plugin has no types
    """Bar: 20 000 frames/s; the writer shares the interpreter here, which costs."""
    stream = _stream(Framing.NO_ESCAPE)
    master, slave = pty.openpty()
    tty.setraw(slave)
    with X4M300.open(os.ttyname(slave)) as radar:
        radar.geometry = FrameGeometry(
            range_start_m=0.2, bin_length_m=0.0064, n_bins=1431, downconversion=False
        )

        def read() -> int:
            writer = threading.Thread(target=_feeder(master, stream))
            writer.start()
            frames = sum(1 for _ in radar.frames(FRAMES))
            writer.join()
            return frames

        assert benchmark(read) == FRAMES
    benchmark.extra_info["frames_per_s"] = FRAMES / benchmark.stats["min"]
    os.close(master)
    os.close(slave)


def test_encode_commands(benchmark: Any) -> None:  # noqa: ANN401 - the plugin has no types
    host = Connection(Role.HOST)
    command = m.X4DriverSet(setting=X4Setting.FRAMEAREA, value=(0.2, 9.4))
    assert benchmark(host.send, command)

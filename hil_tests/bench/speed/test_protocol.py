"""Speed of receiver, encoder and lattice check: ``make bench``. Bars: design, quality bars.

Numbers are reported, never asserted: a timed test fails for the wrong reasons.
"""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from xethru_protocol.driver.frames import Lattice
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.connection import Connection, Role
from xethru_protocol.wire.framing import NEED_DATA, Framing

FRAMES = 2000
CHUNK = 65536


def quantised_noise() -> NDArray[np.float32]:
    """Quantised noise at the vendor's working point, shape (200, 1431)."""
    counters = np.random.default_rng(0).integers(0, 729_600, (200, 1431))
    return counters.astype(np.float32) * np.float32(2.03450526e-07) - np.float32(0.07421875)


def stream_of_frames(framing: Framing) -> bytes:
    samples = quantised_noise()
    module = Connection(Role.MODULE)
    return b"".join(
        module.send(m.DataFloat(info=k, values=samples[k]), framing) for k in range(200)
    ) * (FRAMES // 200)


@pytest.mark.parametrize("framing", Framing)
def test_decode_1431_float_frames(benchmark: Any, framing: Framing) -> None:  # noqa: ANN401 - the plugin has no types
    """Bars: NoEscape 350 000 frames/s, Normal 57 000."""
    stream = stream_of_frames(framing)
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
    benchmark.extra_info["frames"] = FRAMES


@pytest.mark.parametrize("framing", Framing)
def test_encode_1431_float_frames(benchmark: Any, framing: Framing) -> None:  # noqa: ANN401 - the plugin has no types
    """What an emulated module does with each frame."""
    module = Connection(Role.MODULE)
    frames = [m.DataFloat(info=k, values=values) for k, values in enumerate(quantised_noise())]

    def encode() -> int:
        return sum(len(module.send(frame, framing)) for frame in frames)

    assert benchmark(encode) >= 200 * 5747
    benchmark.extra_info["frames"] = 200


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
    samples = quantised_noise()
    assert benchmark(lambda: sum(lattice.off_lattice(values) for values in samples)) == 0
    benchmark.extra_info["frames"] = 200


def test_encode_commands(benchmark: Any) -> None:  # noqa: ANN401 - the plugin has no types
    host = Connection(Role.HOST)
    command = m.X4DriverSet(setting=X4Setting.FRAMEAREA, value=(0.2, 9.4))
    assert benchmark(host.send, command)

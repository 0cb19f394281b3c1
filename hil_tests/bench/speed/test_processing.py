"""Cost of processing a stream, per frame of 1431 RF bins."""

import numpy as np
import pytest
from numpy.typing import NDArray
from pytest_benchmark.fixture import BenchmarkFixture

from xethru_protocol.processing.clutter import METHODS, ClutterFilter, Method
from xethru_protocol.processing.downconversion import downconvert, line_bins
from xethru_protocol.processing.presence import PresenceMonitor
from xethru_protocol.processing.vital import BreathingMonitor

RATE_HZ = 17.0
FRAMES = 17
"""One second, in which each monitor answers once."""


@pytest.fixture(scope="module")
def rf() -> NDArray[np.float32]:
    """Return 62 s of a chest at 2 m that moves by 3 mm, in noise."""
    rng = np.random.default_rng(0)
    seconds = np.arange(round(62 * RATE_HZ)) / RATE_HZ
    position = (2.0 - 0.2 - 0.003 * np.sin(2 * np.pi * 0.25 * seconds)) / 0.00643
    sample = np.arange(1431) - position[:, np.newaxis]
    echo = 0.01 * np.exp(-((sample / 16) ** 2)) * np.cos(2 * np.pi * 5 / 16 * sample)
    return np.asarray(echo + 5e-4 * rng.normal(size=echo.shape), dtype=np.float32)


def test_downconversion_of_frames(benchmark: BenchmarkFixture, rf: NDArray[np.float32]) -> None:
    benchmark(lambda: [downconvert(frame) for frame in rf[:FRAMES]])
    benchmark.extra_info["frames"] = FRAMES


@pytest.mark.parametrize("method", METHODS)
def test_clutter_of_frames(
    benchmark: BenchmarkFixture, rf: NDArray[np.float32], method: Method
) -> None:
    """Of baseband, 175 bins, with the window full."""
    iq = downconvert(rf)
    clutter = ClutterFilter(method)
    clutter.update(iq[:100])
    benchmark(lambda: [clutter.update(frame) for frame in iq[:FRAMES]])
    benchmark.extra_info["frames"] = FRAMES


def test_everything_of_frames(benchmark: BenchmarkFixture, rf: NDArray[np.float32]) -> None:
    """Downconversion, exponential clutter filter, presence and breathing, each second an answer."""
    iq = downconvert(rf)
    ranges_m = 0.2 + 0.00643 * line_bins(1431)
    clutter = ClutterFilter("exponential")
    breathing = BreathingMonitor(ranges_m, RATE_HZ)
    present = PresenceMonitor(ranges_m, RATE_HZ)
    for frame in iq:
        breathing.update(frame)
        present.update(frame)
    assert breathing.breathing is not None

    def second() -> None:
        for frame in rf[:FRAMES]:
            line = downconvert(frame)
            clutter.update(line)
            breathing.update(line)
            present.update(line)

    benchmark(second)
    benchmark.extra_info["frames"] = FRAMES

"""Cost of emulated frames, synthesis only; the emulator's bar is in the design's table."""

from dataclasses import replace

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from emulator.chip.chip import CaptureSettings
from emulator.echo.echo import echo_source
from emulator.scene.philox import frame_noise_units
from emulator.scene.scene import load_scene
from emulator.scene.wheels import scene_odometry
from hil_tests.unit.emulator.rooms import PAPER

FAST = replace(PAPER, pulses_per_step=10)  # the settings of 400 frames/s
BLOCK = 32


@pytest.mark.parametrize("block", [1, 8, BLOCK])
@pytest.mark.parametrize("capture", [PAPER, FAST], ids=["paper", "400fps"])
def test_lab_frames(benchmark: BenchmarkFixture, capture: CaptureSettings, block: int) -> None:
    """Four radars x ``block`` frames of 1431 bins among 14 rods, spread over the whole course."""
    scene = load_scene("lab")
    sources = [echo_source(scene, radar, 0) for radar in range(4)]
    starts = iter(np.tile(np.arange(0, 3400, 97), 100_000).tolist())

    def frames() -> None:
        counters = np.arange(block) + next(starts)
        for source in sources:
            source.rf_counters(capture, counters, counters * 200_000_000)

    benchmark(frames)
    benchmark.extra_info["frames"] = 4 * block


def test_receiver_noise(benchmark: BenchmarkFixture) -> None:
    counters = np.arange(BLOCK)
    benchmark(frame_noise_units, counters, 1431, seed=0, stream=1)
    benchmark.extra_info["frames"] = BLOCK


def test_odometry_of_a_classroom_run(benchmark: BenchmarkFixture) -> None:
    scene = load_scene("classroom")
    benchmark(scene_odometry, scene, 0)

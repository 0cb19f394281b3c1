"""What the receiver adds: noise by working point, clutter by gain, neither by the other's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from emulator.chip.chip import CaptureSettings
from emulator.echo.receiver import Receiver, one_count
from emulator.scene.scene import ClutterSpec, NoiseSpec, RadarSpec, Scene
from hil_tests.unit.emulator.rooms import PAPER

CAPTURE = replace(PAPER, dac_min=0, dac_max=2047)
RADAR = RadarSpec(name="radar", serial="202305070101", x_m=0.0, y_m=0.0, yaw_deg=0.0)


def heard_sigma(
    capture: CaptureSettings, *, rf_sigma: float, clutter: float, gain: float = 1.0
) -> float:
    """Return the standard deviation of an empty room's frames, normalised units."""
    scene = Scene(
        name="empty",
        environment="lab",
        description="",
        radars=(RADAR,),
        noise=NoiseSpec(rf_sigma=rf_sigma, iterations=16, pulses_per_step=300),
        clutter=ClutterSpec(sigma=clutter),
    )
    counters = np.arange(60, dtype=np.int64)
    raw = Receiver(scene, RADAR, 0).counters(
        np.zeros((60, capture.n_samples)), counters, counters * 10**10, capture, gain=gain
    )
    return float(raw.std()) * one_count(capture)


@pytest.mark.parametrize(
    ("iterations", "pulses_per_step"), [(16, 300), (64, 300), (16, 75), (4, 1200), (32, 26)]
)
def test_noise_falls_with_the_root_of_all_pulses_summed(
    iterations: int, pulses_per_step: int
) -> None:
    capture = replace(CAPTURE, iterations=iterations, pulses_per_step=pulses_per_step)
    expected = 2e-3 * np.sqrt(16 * 300 / (iterations * pulses_per_step))
    heard = heard_sigma(capture, rf_sigma=2e-3, clutter=0.0)
    assert heard == pytest.approx(expected, rel=0.01)


def test_clutter_does_not_fall_with_pulses_and_noise_not_with_gain() -> None:
    few = replace(CAPTURE, iterations=8, pulses_per_step=100)
    for capture in (CAPTURE, few):
        assert heard_sigma(capture, rf_sigma=0.0, clutter=3e-3) == pytest.approx(3e-3, rel=0.05)
    assert heard_sigma(CAPTURE, rf_sigma=0.0, clutter=3e-3, gain=0.5) == pytest.approx(
        1.5e-3, rel=0.05
    )
    assert heard_sigma(CAPTURE, rf_sigma=2e-3, clutter=0.0, gain=0.5) == pytest.approx(
        2e-3, rel=0.01
    )

"""The B-scan picture of a pulse whose envelope is known."""

import numpy as np
import pytest

from slam.app.view.frames import bscan_picture

BIN_M = 0.0064255


def moving_tone(amplitude: float) -> np.ndarray:
    """Return a carrier in every second frame, so that its mean is half of it."""
    phase = 2 * np.pi * 7.29e9 * 2 * BIN_M * np.arange(400) / 299_792_458.0
    return np.array([amplitude * (row % 2) * np.cos(phase) for row in range(10)], dtype=np.float32)


def test_the_envelope_of_a_tone_is_flat_and_in_decibels() -> None:
    picture = bscan_picture(moving_tone(0.02), 0.2, BIN_M)
    # half of 0.02 is left after the mean is removed: -40 dB, so 22 of 32 dB of 255 levels
    np.testing.assert_allclose(picture, 255 * 22 / 32, atol=2)


@pytest.mark.parametrize(("amplitude", "level"), [(1.0, 255), (0.0, 0)])
def test_levels_are_clipped(amplitude: float, level: int) -> None:
    assert set(bscan_picture(moving_tone(amplitude), 0.2, BIN_M).ravel()) == {level}


def test_it_shows_three_metres_at_most() -> None:
    frames = np.zeros((4, 1431), dtype=np.float32)
    assert bscan_picture(frames, 0.2, BIN_M).shape == (4, int((3.0 - 0.2) / BIN_M) - 2)
    assert bscan_picture(frames[:, :20], 0.2, BIN_M).shape == (4, 18)

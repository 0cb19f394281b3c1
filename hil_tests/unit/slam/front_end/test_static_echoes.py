"""What all frames of a radar have in common at short range is taken out before echoes are found."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from slam.config import SlamConfig, load_preset, override
from slam.frames import RadarFrame
from slam.front_end import make_detector
from slam.geometry import Mount, Rig

Array = NDArray[np.float64]

BIN_M = 299_792_458.0 / (2 * 23.328e9)
WAVE_NUMBER = 4 * math.pi * 7.29e9 / 299_792_458.0
SIGMA_M = math.sqrt(math.log(10)) / (2 * math.pi * 0.7e9) * 299_792_458.0 / 2
RIG = Rig(mounts=(Mount(name="left", x_m=0.0, y_m=0.0, yaw_rad=0.0),))
LABELS = 0.1 + BIN_M * np.arange(1431)  # noise is estimated from the whole frame


def config_with(range_m: float) -> SlamConfig:
    return override(load_preset("robust"), {"matched_filter.static_range_m": range_m})


def pulse(range_m: float) -> Array:
    x = LABELS - range_m
    return np.asarray(np.exp(-0.5 * (x / SIGMA_M) ** 2) * np.cos(WAVE_NUMBER * x))


# A resonance: it falls to 1/e over 0.12 m, and has the frequency of the carrier.
RINGING = 0.05 * np.exp(-np.abs(LABELS - 0.15) / 0.1) * np.cos(WAVE_NUMBER * LABELS)


def frame_of(counter: int, samples: Array, limits: tuple[float, float] | None = None) -> RadarFrame:
    return RadarFrame(
        radar=0,
        t_ns=counter * 200_000_000,
        counter=counter,
        samples=samples.astype(np.float32),
        range_start_m=float(LABELS[0]),
        bin_length_m=BIN_M,
        limits=limits,
    )


def noise(seed: int) -> Array:
    return np.random.default_rng(seed).normal(scale=3e-4, size=LABELS.size)


def drive(range_m: float, n: int = 60, *, limits: tuple[float, float] | None = None) -> list[float]:
    """Return the ranges found in the last frame of a drive past a rod that ends 0.6 m away."""
    detector = make_detector(config_with(range_m), RIG)
    for counter in range(1, n + 1):
        rod = 0.02 * pulse(0.6 + 0.004 * (n - counter))
        samples = rod + RINGING + noise(counter)
        if limits is not None:
            samples = np.clip(samples, *limits)
        found = detector.detect(frame_of(counter, samples, limits))
    return [one.range_m for one in found]


def test_leakage_that_rings_hides_no_rod_and_looks_like_none() -> None:
    (range_m,) = drive(1.0)
    assert range_m == pytest.approx(0.6, abs=2e-3)


def test_without_the_setting_it_is_taken_for_echoes() -> None:
    assert len([range_m for range_m in drive(0.0) if range_m < 0.5]) > 0


def test_beyond_the_range_nothing_is_taken_out() -> None:
    detector = make_detector(config_with(0.5), RIG)
    wall = 0.02 * pulse(1.0)  # beside a straight path it stands still
    found = [detector.detect(frame_of(n, wall + RINGING + noise(n))) for n in range(1, 60)]
    (echo,) = [one for one in found[-1] if one.range_m > 0.8]
    assert echo.range_m == pytest.approx(1.0, abs=2e-3)
    assert echo.amplitude == pytest.approx(0.02, rel=0.02)


def test_until_enough_frames_are_known_short_ranges_are_not_looked_at() -> None:
    detector = make_detector(config_with(0.7), RIG)
    near, far = 0.02 * pulse(0.4), 0.02 * pulse(1.2)
    for counter in range(1, 20):
        (echo,) = detector.detect(frame_of(counter, near + far + noise(counter)))
        assert echo.range_m == pytest.approx(1.2, abs=2e-3)


def test_samples_at_a_limit_do_not_count() -> None:
    # The strongest leakage is cut off: there nothing is known, and behind it all is as before.
    (range_m,) = [one for one in drive(1.0, limits=(-0.03, 0.03)) if one > 0.35]
    assert range_m == pytest.approx(0.6, abs=2e-3)


def test_each_radar_and_each_set_of_bins_has_a_mean_of_its_own() -> None:
    detector = make_detector(config_with(1.0), RIG)
    for counter in range(1, 40):
        detector.detect(frame_of(counter, RINGING + noise(counter)))
    other = frame_of(40, (RINGING + noise(40))[:1000])
    assert detector.detect(other) == ()

"""Subtraction of what moves with the radar."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from hil_tests.property.test_detection import BIN_LENGTH_M, frame, pulse
from slam.background import LeakageFreeDetector, LeakageRemover
from slam.config import LeakageConfig, LeakageFilter, SlamConfig
from slam.detection import PaperDetector, make_detector

LEAKAGE = pulse(0.2, 0.05, 1.0)
FULL_M, LIMIT_M = 0.25, 0.35


def learnt(remover: LeakageRemover, samples: NDArray[np.float64], n_frames: int) -> None:
    for _ in range(n_frames):
        remover.remove(frame(samples))


def near_zone(samples: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the samples that are subtracted with full weight."""
    return samples[: round((FULL_M - 0.2) / BIN_LENGTH_M)]


def test_no_filter_is_the_default() -> None:
    assert isinstance(make_detector(SlamConfig()), PaperDetector)
    config = SlamConfig(leakage=LeakageConfig(filter=LeakageFilter.RUNNING_MEAN))
    assert isinstance(make_detector(config), LeakageFreeDetector)


def test_what_stays_is_gone_and_what_is_farther_stays_to_the_bit() -> None:
    remover = LeakageRemover(LeakageConfig(max_range_m=LIMIT_M))
    learnt(remover, LEAKAGE, 5)
    raw = frame(LEAKAGE + pulse(0.6, 0.02))
    left = remover.remove(raw).samples
    beyond = round((LIMIT_M - 0.2) / BIN_LENGTH_M) + 1
    assert np.abs(near_zone(raw.samples)).max() > 1e-2
    assert np.abs(near_zone(left)).max() < 1e-6
    assert np.array_equal(left[beyond:], raw.samples[beyond:])


@pytest.mark.parametrize("memory", [5.0, 20.0])
def test_old_leakage_is_forgotten_to_1_over_e_in_its_memory(memory: float) -> None:
    remover = LeakageRemover(LeakageConfig(memory_frames=memory, max_range_m=LIMIT_M))
    learnt(remover, LEAKAGE, 200)
    learnt(remover, 0 * LEAKAGE, int(memory))
    # Nothing is there any more; what is subtracted is what is still remembered.
    remembered = -near_zone(remover.remove(frame(0 * LEAKAGE)).samples)
    share = (1 - 1 / memory) ** memory
    assert remembered == pytest.approx(share * near_zone(frame(LEAKAGE).samples), abs=1e-7)


@pytest.mark.parametrize("memory", [2.0, 5.0])
def test_it_adds_the_noise_of_an_exponential_mean(memory: float) -> None:
    """Weights a (1 - a)**k, a = 1 / memory: their squares add up to a / (2 - a)."""
    rng = np.random.default_rng(3)
    remover = LeakageRemover(LeakageConfig(memory_frames=memory, max_range_m=LIMIT_M))
    left = [
        near_zone(remover.remove(frame(rng.standard_normal(LEAKAGE.size))).samples)
        for _ in range(1500)
    ]
    # 10 500 samples tell a standard deviation to 0.7 %, and neighbours in time correlate a little
    expected = np.sqrt(1 + 1 / (2 * memory - 1))
    assert np.std(left[50:]) == pytest.approx(expected, rel=0.025)


def test_radars_and_grids_are_remembered_apart() -> None:
    remover = LeakageRemover(LeakageConfig(max_range_m=LIMIT_M))
    learnt(remover, LEAKAGE, 3)
    other_radar = replace(frame(LEAKAGE), radar=1)
    assert np.isnan(near_zone(remover.remove(other_radar).samples)).all()
    other_grid = frame(LEAKAGE, range_start_m=0.21)
    assert np.isnan(near_zone(remover.remove(other_grid).samples)[:-2]).all()
    assert np.isnan(near_zone(remover.remove(frame(LEAKAGE)).samples)).all()


def test_saturated_samples_teach_nothing() -> None:
    remover = LeakageRemover(LeakageConfig(max_range_m=LIMIT_M))
    learnt(remover, LEAKAGE, 3)
    limits = (-0.06, 0.06)
    stuck = replace(frame(np.full(LEAKAGE.size, 0.06)), limits=limits)
    assert np.isnan(near_zone(remover.remove(stuck).samples)).all()
    assert np.abs(near_zone(remover.remove(frame(LEAKAGE)).samples)).max() < 1e-6

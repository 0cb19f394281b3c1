"""Bearings refined by the carrier's phase."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from hil_tests.property.test_detection import N_BINS, frame, pulse
from slam.config import DetectionConfig, FrontEnd, PairBearing, SlamConfig, TrilaterationConfig
from slam.detection import make_detector
from slam.detector import Detection
from slam.geometry import paper_rig
from slam.phase_bearing import pair_ranges_m
from slam.pulse_model import PulseModel

Array = NDArray[np.float64]

WAVELENGTH_M = PulseModel().wavelength_m
AMPLITUDE, NOISE_SIGMA = 0.015, 0.015 / 10 ** (30 / 20)


def detection(range_m: float, phase_rad: float, sigma_m: float = 5e-4) -> Detection:
    return Detection(
        radar=0, t_ns=0, range_m=range_m, amplitude=1.0, phase_rad=phase_rad, sigma_m=sigma_m
    )


def bearings_rad(ranges_m: Array, half_m: float) -> Array:
    """Return angles from the perpendicular of a pair; ranges of shape (n, 2), base 2 half_m."""
    distance_m = np.sqrt((ranges_m**2).mean(axis=1) - half_m**2)
    sines = (ranges_m[:, 0] ** 2 - ranges_m[:, 1] ** 2) / (4 * half_m * distance_m)
    angles: Array = np.arcsin(sines)
    return angles


def bearing_rms_deg(ranges_m: Array, true_m: Array, half_m: float) -> float:
    errors = bearings_rad(ranges_m, half_m) - bearings_rad(true_m, half_m)
    return math.degrees(math.sqrt(np.mean(errors**2)))


def test_printed_rule_is_the_default() -> None:
    assert TrilaterationConfig().bearing is PairBearing.RANGES


def test_bearings_of_ideal_points_at_30_db_are_right_to_a_twentieth_of_a_degree() -> None:
    rng = np.random.default_rng(7)
    half_m = paper_rig().pairs()[0].baseline_m / 2
    detector = make_detector(
        SlamConfig(detection=DetectionConfig(front_end=FrontEnd.MATCHED_FILTER))
    )
    true_m, pairs = [], []
    for _ in range(300):
        distance_m, angle = rng.uniform(0.5, 1.3), rng.uniform(-0.4, 0.4)
        phase = rng.uniform(0, math.tau)
        # Law of cosines, the angle from the perpendicular of the pair.
        ranges_m = [
            math.sqrt(distance_m**2 + half_m**2 + side * 2 * distance_m * half_m * math.sin(angle))
            for side in (1, -1)
        ]
        first, second = (
            max(
                detector.detect(
                    frame(pulse(r, AMPLITUDE, phase) + NOISE_SIGMA * rng.standard_normal(N_BINS))
                ),
                key=lambda d: d.amplitude,
            )
            for r in ranges_m
        )
        true_m.append(ranges_m)
        pairs.append((first, second))
    true = np.array(true_m)
    refined = pair_ranges_m(pairs, WAVELENGTH_M)
    plain = np.array([[a.range_m, b.range_m] for a, b in pairs])

    assert bearing_rms_deg(refined, true, half_m) <= 0.05
    assert bearing_rms_deg(plain, true, half_m) > 0.2
    assert refined.mean(axis=1) == pytest.approx(plain.mean(axis=1), abs=1e-12)


@pytest.mark.parametrize("turns", [-1, 0, 2])
def test_phase_difference_counts_modulo_whole_turns_and_less_the_constant(turns: int) -> None:
    pair = detection(1.0, 0.5 + 0.3 + math.tau * turns), detection(0.97, 0.3)
    ((first, second),) = pair_ranges_m([pair], WAVELENGTH_M, phase_constant_rad=0.2)
    correction_m = 0.3 * WAVELENGTH_M / math.tau
    assert first - second == pytest.approx(0.03 - correction_m, abs=1e-12)


@pytest.mark.parametrize(
    ("phase_rad", "sigma_m"), [(math.nan, 5e-4), (1.0, math.nan), (1.0, WAVELENGTH_M / 8)]
)
def test_pairs_that_could_wrap_wrongly_stay_as_measured(phase_rad: float, sigma_m: float) -> None:
    pair = detection(1.0, phase_rad, sigma_m), detection(0.97, 0.3)
    assert pair_ranges_m([pair], WAVELENGTH_M).tolist() == [[1.0, 0.97]]


def test_no_pairs_give_no_ranges() -> None:
    assert pair_ranges_m([], WAVELENGTH_M).shape == (0, 2)

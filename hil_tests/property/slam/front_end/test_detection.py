"""Laws of the front end, and its equality with the literal chain of library calls."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.signal import find_peaks, savgol_filter

from hil_tests.property.examples import examples
from hil_tests.unit.slam.simulation import BIN_LENGTH_M, frame_of
from slam.config import BackgroundFilter, DetectionConfig, PeakPosition
from slam.frames import RadarFrame
from slam.front_end.paper import PaperDetector, SavitzkyGolay

Array = NDArray[np.float64]

N_BINS = 1431
ENVELOPE_SIGMA_M = 0.0517  # 1.4 GHz at -10 dB, as a range
CARRIER_PERIOD_M = 299_792_458 / (2 * 7.29e9)


def pulse(range_m: float, amplitude: float, phase: float = 0.0) -> Array:
    offset = 0.2 + BIN_LENGTH_M * np.arange(N_BINS) - range_m
    envelope = amplitude * np.exp(-0.5 * (offset / ENVELOPE_SIGMA_M) ** 2)
    echo: Array = envelope * np.cos(math.tau * offset / CARRIER_PERIOD_M + phase)
    return echo


def frame(samples: Array, range_start_m: float = 0.2) -> RadarFrame:
    return frame_of(samples.astype(np.float32), range_start_m=range_start_m)


@st.composite
def scenes(draw: st.DrawFn) -> Array:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    samples = draw(st.sampled_from([0.0, 2e-4, 5e-4])) * rng.standard_normal(N_BINS)
    for _ in range(draw(st.integers(0, 4))):
        samples += pulse(rng.uniform(0.3, 8.0), rng.uniform(0.005, 0.05), rng.uniform(0, 6))
    return samples


@given(scenes())
def test_ranges_equal_the_literal_chain_of_library_calls(samples: Array) -> None:
    x = np.abs(samples.astype(np.float32).astype(np.float64))
    x[x < x.mean()] = 0
    smooth = savgol_filter(x, 15, 5)
    peaks, found = find_peaks(smooth, height=5.5e-3, prominence=3e-3)
    wanted = [
        (0.2 + k * BIN_LENGTH_M, height)
        for k, height in zip(peaks, found["peak_heights"], strict=True)
        if 0.2 <= 0.2 + k * BIN_LENGTH_M <= 1.5
    ]
    got = PaperDetector(DetectionConfig()).detect(frame(samples))
    assert [d.range_m for d in got] == pytest.approx([r for r, _ in wanted], abs=1e-12)
    assert [d.amplitude for d in got] == pytest.approx([h for _, h in wanted], abs=1e-12)


@pytest.mark.parametrize(("length", "order"), [(15, 5), (17, 5), (5, 2), (3, 0)])
@pytest.mark.parametrize("n", [17, 40, N_BINS])
def test_smoothing_equals_scipy_ends_included(length: int, order: int, n: int) -> None:
    samples = np.random.default_rng(n).standard_normal(n)
    wanted = savgol_filter(samples, length, order)
    assert SavitzkyGolay(length, order).smooth(samples) == pytest.approx(wanted, abs=1e-12)


def test_frame_shorter_than_the_filter_is_refused_with_the_remedy() -> None:
    with pytest.raises(ValueError, match="longer frame area"):
        PaperDetector(DetectionConfig()).detect(frame(np.zeros(14)))


@given(st.floats(0.5, 1.2), st.floats(0.012, 0.05), st.floats(0, 6), st.integers(1, 30))
def test_delay_of_whole_bins_moves_echoes_by_whole_bins(
    range_m: float, amplitude: float, phase: float, shift: int
) -> None:
    samples = pulse(range_m, amplitude, phase).astype(np.float32).astype(np.float64)
    detector = PaperDetector(DetectionConfig(max_range_m=3.0))
    here = detector.detect(frame(samples))
    there = detector.detect(frame(np.roll(samples, shift)))
    assert here
    assert [d.range_m + shift * BIN_LENGTH_M for d in here] == pytest.approx(
        [d.range_m for d in there], abs=1e-12
    )


@given(scenes())
def test_sign_of_the_signal_does_not_matter(samples: Array) -> None:
    detector = PaperDetector(DetectionConfig())
    assert detector.detect(frame(samples)) == detector.detect(frame(-samples))


@pytest.mark.parametrize("peak_position", list(PeakPosition))
def test_range_error_without_noise_keeps_to_the_measured_floor(peak_position: PeakPosition) -> None:
    # The carrier's ripple leaks through: 7.2 mm rms and +-18.5 mm at most (independent experiment
    # with 2000 ranges and phases), plus half a bin where the peak stays on its sample.
    rng = np.random.default_rng(5)
    detector = PaperDetector(DetectionConfig(peak_position=peak_position))
    errors = []
    for _ in range(500):
        range_m = rng.uniform(0.4, 1.3)
        detections = detector.detect(frame(pulse(range_m, 0.015, rng.uniform(0, math.tau))))
        assert len(detections) == 1
        errors.append(detections[0].range_m - range_m)
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(7.2e-3, rel=0.15)
    assert np.abs(errors).max() <= 0.0185 + BIN_LENGTH_M / 2
    assert abs(np.mean(errors)) < 1.5e-3


def test_echoes_outside_the_range_limits_are_dropped() -> None:
    samples = pulse(0.7, 0.02) + pulse(2.0, 0.02)
    detections = PaperDetector(DetectionConfig()).detect(frame(samples))
    assert len(detections) == 1
    assert detections[0].range_m == pytest.approx(0.7, abs=0.02)


def test_range_offset_is_subtracted_before_the_limits() -> None:
    samples = pulse(1.6, 0.02)
    detector = PaperDetector(DetectionConfig())
    assert detector.detect(frame(samples)) == ()
    (detection,) = detector.detect(frame(samples), range_offset_m=0.15)
    assert detection.range_m == pytest.approx(1.45, abs=0.02)


def test_leakage_raises_the_mean_only_where_the_background_filter_uses_it() -> None:
    detectors = [PaperDetector(DetectionConfig(background=b)) for b in BackgroundFilter]
    samples = pulse(0.9, 0.02)
    loud = samples + pulse(0.25, 0.5)
    far = slice(200, None)
    with_mean, without = (d.smooth(frame(loud).samples)[far] for d in detectors)
    assert with_mean.max() == 0.0 or with_mean.max() < without.max()
    assert np.array_equal(without, detectors[1].smooth(frame(samples).samples)[far])


@settings(max_examples=examples(20))
@given(st.floats(0.4, 1.3), st.floats(0, 6))
def test_least_width_removes_the_ripple_of_strong_echoes(range_m: float, phase: float) -> None:
    samples = pulse(range_m, 0.4, phase)
    wide = PaperDetector(DetectionConfig(min_peak_width_bins=10.0)).detect(frame(samples))
    assert len(wide) <= 1 < len(PaperDetector(DetectionConfig()).detect(frame(samples)))


def test_frame_of_anything_but_real_samples_is_refused() -> None:
    with pytest.raises(ValueError, match="raw RF mode"):
        frame_of(np.zeros(5, dtype=np.complex64))

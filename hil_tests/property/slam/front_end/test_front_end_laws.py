"""Laws that every front end obeys, or the two that know the pulse; frames are closed forms."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hil_tests.property.examples import examples
from hil_tests.property.slam.front_end.test_detection import N_BINS, frame, pulse
from hil_tests.unit.slam.simulation import BIN_LENGTH_M
from slam.config import DetectionConfig, FrontEnd, MatchedFilterConfig, PeakPosition, SlamConfig
from slam.frames import Detector
from slam.front_end import make_detector

Array = NDArray[np.float64]

FRONT_ENDS = list(FrontEnd)
WITH_PULSE = [FrontEnd.MATCHED_FILTER, FrontEnd.JOINT]
NOISE_SIGMA = 5e-4
DAC_WINDOW = 76 / 1024  # half of the default window of the sampler, protocol section 9.7


def front_end(
    name: FrontEnd,
    *,
    scale: float = 1.0,
    position: PeakPosition = PeakPosition.BIN,
    told_sigma: float = 0.0,
    false_alarms: float = 1e-3,
) -> Detector:
    """Return a front end for echoes anywhere in the frame, its thresholds times ``scale``."""
    return make_detector(
        SlamConfig(
            detection=DetectionConfig(
                front_end=name,
                min_range_m=0.0,
                max_range_m=9.5,
                min_peak_height=scale * 5.5e-3,
                min_peak_prominence=scale * 3e-3,
                peak_position=position,
            ),
            matched_filter=MatchedFilterConfig(
                noise_sigma=scale * told_sigma, false_alarms_per_frame=false_alarms
            ),
        )
    )


def noisy_scene(seed: int, n_bins: int = N_BINS) -> Array:
    """Return noise and up to five echoes, some of them overlapping or cut by an end."""
    rng = np.random.default_rng(seed)
    samples = NOISE_SIGMA * rng.standard_normal(N_BINS)
    for range_m in rng.uniform(0.15, 9.3, rng.integers(0, 4)):
        amplitude = rng.uniform(0.006, 0.05)
        samples += pulse(range_m, amplitude, rng.uniform(0, math.tau))
        samples += pulse(range_m + rng.uniform(0.05, 0.3), amplitude / 2, rng.uniform(0, math.tau))
    return samples[:n_bins]


@pytest.mark.parametrize("position", list(PeakPosition))
@pytest.mark.parametrize("name", FRONT_ENDS)
def test_batch_holds_the_bits_of_single_frames(name: FrontEnd, position: PeakPosition) -> None:
    lengths = [N_BINS, 700, N_BINS, N_BINS, 701, 700, N_BINS, N_BINS]
    frames = [frame(noisy_scene(seed, n)) for seed, n in enumerate(lengths, start=20)]
    # Echoes at the very ends, where one frame of a batch meets the next, and unknown samples.
    frames.append(frame(pulse(0.2, 0.05) + pulse(0.2 + (N_BINS - 1) * BIN_LENGTH_M, 0.05)))
    holed = noisy_scene(3)
    holed[40:60] = np.nan
    frames.append(frame(holed))
    offsets = [0.01 * k for k in range(len(frames))]
    detector = front_end(name, position=position)
    singles = [detector.detect(f, offset) for f, offset in zip(frames, offsets, strict=True)]
    assert sum(map(len, singles)) > len(frames)
    # The printed form tells NaN from numbers and floats to their last bit.
    assert repr(detector.detect_many(frames, offsets)) == repr(singles)
    assert detector.detect_many([], []) == []


@settings(max_examples=examples(20))
@given(st.floats(0.6, 6.0), st.floats(0.012, 0.05), st.floats(0, 6), st.integers(1, 60))
@pytest.mark.parametrize("name", WITH_PULSE)
def test_delay_of_whole_bins_moves_an_echo_by_whole_bins(
    name: FrontEnd, range_m: float, amplitude: float, phase: float, shift: int
) -> None:
    detector = front_end(name)
    samples = pulse(range_m, amplitude, phase)
    (here,) = detector.detect(frame(samples))
    (there,) = detector.detect(frame(np.roll(samples, shift)))
    assert there.range_m - here.range_m == pytest.approx(shift * BIN_LENGTH_M, abs=1e-9)
    assert math.remainder(there.phase_rad - here.phase_rad, math.tau) == pytest.approx(0, abs=1e-6)


@settings(max_examples=examples(30))
@given(st.floats(0.6, 6.0), st.floats(0.012, 0.05), st.floats(0, 6))
@pytest.mark.parametrize("name", WITH_PULSE)
def test_echo_without_noise_is_told_to_a_fraction_of_a_bin(
    name: FrontEnd, range_m: float, amplitude: float, phase: float
) -> None:
    (detection,) = front_end(name).detect(frame(pulse(range_m, amplitude, phase)))
    assert abs(detection.range_m - range_m) <= 0.2 * BIN_LENGTH_M
    assert detection.amplitude == pytest.approx(amplitude, rel=1e-3)
    assert math.remainder(detection.phase_rad - phase, math.tau) == pytest.approx(0, abs=1e-3)


@settings(max_examples=examples(15))
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.125, 0.5, 2.0, 8.0]))
@pytest.mark.parametrize("told_sigma", [0.0, NOISE_SIGMA])
@pytest.mark.parametrize("name", FRONT_ENDS)
def test_amplitude_and_thresholds_scale_together(
    name: FrontEnd, told_sigma: float, seed: int, k: float
) -> None:
    samples = noisy_scene(seed)
    here = front_end(name, told_sigma=told_sigma).detect(frame(samples))
    there = front_end(name, told_sigma=told_sigma, scale=k).detect(frame(k * samples))
    assert [d.range_m for d in there] == pytest.approx([d.range_m for d in here], abs=1e-6)
    assert [d.amplitude for d in there] == pytest.approx([k * d.amplitude for d in here], rel=1e-5)


@settings(max_examples=examples(15))
@given(st.integers(0, 2**32 - 1))
@pytest.mark.parametrize("name", WITH_PULSE)
def test_reversed_sign_turns_phases_by_half_a_turn_and_nothing_else(
    name: FrontEnd, seed: int
) -> None:
    detector, samples = front_end(name), noisy_scene(seed)
    here, there = detector.detect(frame(samples)), detector.detect(frame(-samples))
    assert [d.range_m for d in there] == pytest.approx([d.range_m for d in here], abs=1e-6)
    turns = [b.phase_rad - a.phase_rad for a, b in zip(here, there, strict=True)]
    assert [math.cos(turn) for turn in turns] == pytest.approx([-1.0] * len(turns), abs=1e-6)


@pytest.mark.parametrize("level", [0.0, 0.37, -1.0, 1e-30])
@pytest.mark.parametrize("name", FRONT_ENDS)
def test_constant_frame_holds_no_echo(name: FrontEnd, level: float) -> None:
    assert front_end(name).detect(frame(np.full(N_BINS, level))) == ()


@pytest.mark.parametrize("name", FRONT_ENDS)
def test_higher_threshold_finds_a_part_of_what_a_lower_one_finds(name: FrontEnd) -> None:
    # One weak echo: under the joint front end a group's other echoes may come and go with it.
    levels = [
        (0.3, 0.5),
        (0.5, 1e-2),
        (1.0, 1e-4),
        (1.5, 1e-8),
    ]
    counts = np.zeros(len(levels), dtype=int)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        samples = pulse(1.0, 0.007, seed) + NOISE_SIGMA * rng.standard_normal(N_BINS)
        found = [
            {d.range_m for d in front_end(name, scale=k, false_alarms=rate).detect(frame(samples))}
            for k, rate in levels
        ]
        assert all(fewer <= more for more, fewer in itertools.pairwise(found))
        counts += [len(ranges) for ranges in found]
    assert counts[0] > counts[-1]


@pytest.mark.parametrize("name", WITH_PULSE)
def test_echo_of_twice_the_samplers_window_is_ranged_without_bias(name: FrontEnd) -> None:
    rng = np.random.default_rng(8)
    detector, errors, amplitudes = front_end(name), [], []
    for _ in range(40):
        range_m = rng.uniform(0.6, 1.3)
        echo = pulse(range_m, 2 * DAC_WINDOW, rng.uniform(0, math.tau))
        samples = echo + NOISE_SIGMA * rng.standard_normal(N_BINS)
        clipped = frame(np.clip(samples, -DAC_WINDOW, DAC_WINDOW))
        (detection,) = detector.detect(replace(clipped, limits=(-DAC_WINDOW, DAC_WINDOW)))
        assert detection.saturated
        errors.append(detection.range_m - range_m)
        amplitudes.append(detection.amplitude / (2 * DAC_WINDOW))
        assert not any(d.saturated for d in detector.detect(clipped))
    # The bound without clipping is 0.09 mm; half of the samples are lost.
    assert np.sqrt(np.mean(np.square(errors))) < 0.3e-3
    assert abs(np.mean(errors)) < 4 * np.std(errors) / math.sqrt(len(errors))
    assert np.mean(amplitudes) == pytest.approx(1.0, abs=5e-3)

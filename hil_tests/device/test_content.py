"""What frames hold: noise, no constant part, nothing stuck, clipped or wild, and true ranges.

Limits are far from what sound modules showed, emulated ones and a real one: noise of 8e-5 and
5e-4, a mean below 1.4e-3, hardly an isolated sample.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from hil_tests.plugin.findings import Limit, Measure
from hil_tests.plugin.requirements import leave_out
from hil_tests.plugin.session_radars import RadarUnderTest
from xethru_protocol.driver.frames import Frame
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire.x4 import CARRIER_HZ, SAMPLING_RATE_HZ

pytestmark = pytest.mark.requires("settings")

RfFrames = NDArray[np.float64]
_BANDWIDTH_HZ = 1.4e9
_SEARCHED_M = 0.12
_WILD = 10.0  # standard deviations


def noise(samples: RfFrames) -> float:
    """Return the standard deviation from frame to frame where hardly an echo reaches."""
    far = samples[:, -samples.shape[1] // 10 :]
    return float(np.diff(far, axis=0).std() / np.sqrt(2))


def constant_part(samples: RfFrames) -> float:
    return float(np.abs(samples.mean(axis=1)).max())


def stuck(samples: RfFrames) -> float:
    """Return in what share of the frames some bin has the value of its neighbour or of before."""
    shares = [(np.diff(samples, axis=axis) == 0).mean(axis=0).max() for axis in (0, 1)]
    return float(max(shares))


def clipped(samples: RfFrames) -> float:
    """Return how many samples of a frame have its largest magnitude, in the worst one."""
    magnitude = np.abs(samples)
    return float((magnitude == magnitude.max(axis=1, keepdims=True)).sum(axis=1).max())


def isolated(samples: RfFrames) -> float:
    """Return how many samples per frame leave the course of time alone; an echo is some wide."""
    off = np.abs(samples[1:-1] - (samples[:-2] + samples[2:]) / 2)
    sigma = np.median(off) / 0.6745
    beside = np.max([np.roll(off, shift, axis=1) for shift in (-2, -1, 1, 2)], axis=0)
    return float(((off > _WILD * sigma) & (beside < off / 4)).sum(axis=1).mean())


@dataclass(frozen=True, slots=True)
class Check:
    """A number of RF frames, samples of shape (n_frames, n_bins), and what a sound module shows."""

    value: Callable[[RfFrames], float]
    limit: Limit


CHECKS = {
    "noise": Check(noise, (1e-5, 2e-3)),
    "constant_part": Check(constant_part, (None, 3e-3)),
    "stuck": Check(stuck, (None, 0.5)),
    "clipped": Check(clipped, (None, 3)),
    "isolated": Check(isolated, (None, 0.2)),
}


def range_errors_m(
    frames: Sequence[Frame], known_ranges_m: Callable[[int], Sequence[float]]
) -> list[tuple[int, float]]:
    """Return arrival time [ns] and error of each echo whose range is known."""
    ranges_m = frames[0].ranges_m
    samples = np.array([frame.samples for frame in frames], dtype=np.float64)
    spectrum = np.fft.fft(samples, axis=1)
    off_hz = np.abs(np.fft.fftfreq(samples.shape[1], 1 / SAMPLING_RATE_HZ) - CARRIER_HZ[3])
    envelopes = np.abs(np.fft.ifft(np.where(off_hz < _BANDWIDTH_HZ, spectrum, 0), axis=1))
    errors = []
    for frame, envelope in zip(frames, envelopes, strict=True):
        for known_m in known_ranges_m(frame.arrival_ns):
            near = np.flatnonzero(np.abs(ranges_m - known_m) < _SEARCHED_M)
            found_m = ranges_m[near[envelope[near].argmax()]]
            errors.append((frame.arrival_ns, float(found_m - known_m)))
    return errors


@pytest.mark.parametrize("check", CHECKS)
def test_samples_are_those_of_a_sound_receiver(
    radar: X4M300, frame_rate_hz: float, measure: Measure, check: str
) -> None:
    radar.configure_raw()
    radar.start(frame_rate_hz)
    frames = list(radar.frames(25))
    radar.stop()
    samples = np.array([frame.samples for frame in frames], dtype=np.float64)
    measure(check, CHECKS[check].value(samples), limit=CHECKS[check].limit)


@pytest.mark.requires("known_range")
@pytest.mark.slow_hw(seconds=12)
def test_reflectors_are_where_they_are_known_to_be(
    request: pytest.FixtureRequest,
    radar: X4M300,
    radar_place: RadarUnderTest,
    frame_rate_hz: float,
    measure: Measure,
) -> None:
    """In the middle and over 12 s; of a real module the range zero is that of its board."""
    radar.configure_raw()
    rate_hz = radar.start(frame_rate_hz)
    frames = list(radar.frames(round(12 * rate_hz)))
    radar.stop()
    errors = range_errors_m(frames, radar_place.place.known_ranges_m)
    if not errors:
        leave_out(request, "no reflector of known range came into view")
    t_ns, errors_mm = np.array([(t_ns, 1e3 * error) for t_ns, error in errors]).T
    most_mm = 5.0 if radar_place.spec.emulated else 100.0
    measure("range_error", float(np.median(errors_mm)), unit="mm", limit=(-most_mm, most_mm))
    begin, end = (
        np.median(errors_mm[part]) for part in (t_ns < t_ns[0] + 2e9, t_ns > t_ns[-1] - 2e9)
    )
    measure("range_drift", float(end - begin), unit="mm", limit=(-10, 10))

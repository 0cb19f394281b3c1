"""Raw radar frames: how many bins, which counters, when they come, and how they stop."""

import contextlib
import itertools

import numpy as np
import pytest

from hil_tests.plugin.findings import Measure
from hil_tests.plugin.session_radars import RadarUnderTest
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.driver.radar import X4M300
from xethru_protocol.wire.errors import ResponseTimeout

pytestmark = pytest.mark.requires("settings")

# Protocol reference 9.6: what the chip's timer makes of a rate, read back.
REAL_RATES_HZ = {1: 1.004108, 5: 5.018533, 10: 10.032053, 17: 17.049379, 34: 34.040967}


@pytest.mark.parametrize(("downconversion", "bins"), [(False, 1431), (True, 181)])
def test_raw_frames(radar: X4M300, frame_rate_hz: float, downconversion: bool, bins: int) -> None:
    """Protocol reference 9.5."""
    geometry = radar.configure_raw(RawConfig(downconversion=downconversion))
    assert geometry.n_bins == bins
    radar.start(frame_rate_hz)
    frames = list(radar.frames(8))
    radar.stop()
    counters = [frame.counter for frame in frames]
    assert counters == list(range(counters[0], counters[0] + 8))
    assert {frame.samples.shape for frame in frames} == {(bins,)}
    kind = np.complex64 if downconversion else np.float32
    assert {frame.samples.dtype for frame in frames} == {np.dtype(kind)}
    assert all(np.isfinite(frame.samples).all() for frame in frames)
    assert (radar.frames_lost, radar.fault_count) == (0, 0)
    assert radar.statistics.off_lattice_samples == 0


def test_samples_lie_on_the_quantisation_grid(radar: X4M300, frame_rate_hz: float) -> None:
    """Protocol reference 9.7: RF values are counter * 2.03450526e-07 - 0.07421875."""
    radar.configure_raw()
    radar.start(frame_rate_hz)
    values = radar.read_frame().samples.astype(np.float64)
    counters = (values + 0.07421875) / 2.03450526e-07
    assert np.abs(counters - np.rint(counters)).max() < 0.1
    assert counters.min() >= 0
    assert counters.max() <= 16 * 300 * 152


def test_frames_differ(radar: X4M300, frame_rate_hz: float) -> None:
    """A receiver has noise: a frame that comes twice is a stuck one."""
    radar.configure_raw(RawConfig(frame_area_m=(0.4, 2.0)))
    radar.start(frame_rate_hz)
    samples = [frame.samples for frame in radar.frames(4)]
    assert all((one != two).any() for one, two in itertools.pairwise(samples))


@pytest.mark.parametrize("rate_hz", REAL_RATES_HZ)
def test_rates_read_back_as_the_timer_runs(radar: X4M300, rate_hz: int) -> None:
    """Protocol reference 9.6."""
    radar.configure_raw(RawConfig(frame_area_m=(0.4, 0.6), iterations=4))  # sweeps of 12 ms
    assert radar.start(rate_hz) == pytest.approx(REAL_RATES_HZ[rate_hz], abs=1e-5)
    radar.stop()


def test_frames_keep_their_pace(
    radar: X4M300, radar_place: RadarUnderTest, measure: Measure
) -> None:
    """Protocol reference 9.6: 17 is 17.049379 Hz, 58.653 ms; short frames, so any line carries it.

    To the microsecond in virtual time. In real time a busy host is late, so the most punctual of
    ten frames count, and the best of three streams.
    """
    virtual = radar_place.place.virtual
    for _ in range(1 if virtual else 3):
        radar.configure_raw(RawConfig(frame_area_m=(0.4, 1.0)))
        rate_hz = radar.start(17.0)
        frames = list(radar.frames(41))
        radar.stop()
        arrivals_ns = np.array([frame.arrival_ns for frame in frames])
        counters = np.array([frame.counter for frame in frames])
        late_s = (arrivals_ns - arrivals_ns[0]) * 1e-9 - (counters - counters[0]) / rate_hz
        pace_error = (late_s[-10:].min() - late_s[:10].min()) * rate_hz / 31
        if abs(pace_error) < 0.05:
            break
    measure("pace_error", 100 * float(pace_error), unit="%", limit=(-5, 5))
    intervals_ms = np.diff(arrivals_ns) * 1e-6
    measure("frame_interval_p99", float(np.percentile(intervals_ms, 99)), unit="ms")
    mean_ms = float(intervals_ms.mean())
    limit = (58.652, 58.654) if virtual else (None, None)
    measure("frame_interval_mean", mean_ms, unit="ms", limit=limit)
    measure("frames_lost", radar.frames_lost, limit=(None, 0))


@pytest.mark.slow
@pytest.mark.slow_hw(seconds=60)
def test_a_minute_of_frames(radar: X4M300, frame_rate_hz: float, measure: Measure) -> None:
    """Nothing is lost, damaged or off the chip's lattice over 60 s of 1431 bins, at the rate told.

    A frame may be late, never early, so the rate is that of the most punctual frames of the first
    and of the last quarter.
    """
    radar.configure_raw()
    rate_hz = radar.start(frame_rate_hz)
    count = round(60 * rate_hz)
    frames = [(frame.counter, frame.arrival_ns) for frame in radar.frames(count)]
    radar.stop()
    counters = [counter for counter, _ in frames]
    assert counters == list(range(counters[0], counters[0] + count))
    late_s = np.array([t_ns - frames[0][1] for _, t_ns in frames]) * 1e-9
    late_s -= np.arange(count) / rate_hz
    quarter = count // 4
    drift_s = late_s[-quarter:].min() - late_s[:quarter].min()
    measure("rate_error", 100 * drift_s * rate_hz / count, unit="%", limit=(-0.5, 0.5))
    measure("frames_lost", radar.frames_lost, limit=(None, 0))
    measure("damaged_places", radar.fault_count, limit=(None, 0))
    measure("off_lattice_samples", radar.statistics.off_lattice_samples, limit=(None, 0))


def test_at_most_one_frame_comes_after_the_stop(radar: X4M300, frame_rate_hz: float) -> None:
    """Protocol reference 8.4: one may be in the pipeline; one may have come before the ACK."""
    radar.configure_raw()
    radar.start(frame_rate_hz)
    radar.read_frame()
    radar.stop()
    late = 0
    with contextlib.suppress(ResponseTimeout):
        while late < 10:
            radar.read_frame(timeout_s=0.3 + 1 / frame_rate_hz)
            late += 1
    assert late <= 2


def test_streams_begin_and_end_ten_times(radar: X4M300) -> None:
    """Each stream is whole: no frame of the one before leaks into it, none is missing."""
    radar.configure_raw(RawConfig(frame_area_m=(0.4, 1.0)))
    for _ in range(10):
        radar.start(17.0)
        counters = [frame.counter for frame in radar.frames(3)]
        assert counters == list(range(counters[0], counters[0] + 3))
        radar.stop()
    assert radar.frames_lost == 0
    assert radar.statistics.clean


def test_questions_are_answered_between_frames(radar: X4M300, frame_rate_hz: float) -> None:
    """Protocol reference 3: data can precede a reply, and neither gets lost."""
    radar.configure_raw(RawConfig(frame_area_m=(0.4, 2.0)))
    radar.start(frame_rate_hz)
    first = radar.read_frame().counter
    for _ in range(20):
        assert radar.x4.iterations == 16
    later = [frame.counter for frame in radar.frames(5)]
    radar.stop()
    assert later == list(range(first + 1, first + 6))
    assert radar.frames_lost == 0


def test_the_frame_length_follows_the_area(radar: X4M300) -> None:
    """Bins of 9.4; the driver is told of each area before it starts."""
    for area_m, bins in (((0.4, 5.0), 716), ((-0.5, 2.0), 380), ((0.0, 1.0), 156)):
        geometry = radar.configure_raw(RawConfig(frame_area_m=area_m))
        assert geometry.n_bins == bins
        radar.start(2.0)
        assert radar.read_frame().samples.shape == (bins,)
        radar.stop()


def test_init_ends_the_stream(radar: X4M300) -> None:
    """Protocol reference 8.4: FPS reads 0 after INIT."""
    radar.configure_raw(RawConfig(frame_area_m=(0.4, 1.0)))
    radar.start(17.0)
    radar.read_frame()
    radar.x4.init()
    assert radar.x4.fps == 0.0
    late = 0
    with contextlib.suppress(ResponseTimeout):
        while late < 10:
            radar.read_frame(timeout_s=0.3)
            late += 1
    assert late <= 2


def test_the_counter_begins_at_1_with_init_and_goes_on_after_a_pause(radar: X4M300) -> None:
    """Protocol reference 6.1; that the first is 1 was read in microcode, not yet on a wire."""
    radar.configure_raw(RawConfig(frame_area_m=(0.4, 1.0)))
    radar.start(17.0)
    assert [frame.counter for frame in radar.frames(3)] == [1, 2, 3]
    radar.stop()
    radar.start(17.0)
    # frames that the host did not read were swept, too
    assert radar.read_frame().counter > 3
    radar.configure_raw(RawConfig(frame_area_m=(0.4, 1.0)))
    radar.start(17.0)
    assert radar.read_frame().counter == 1
    radar.stop()


def test_a_host_that_pauses_gets_whole_frames_afterwards(
    radar: X4M300, radar_place: RadarUnderTest
) -> None:
    """What is read late is whole; what the firmware dropped meanwhile, the counters show (8.4)."""
    radar.configure_raw(RawConfig(frame_area_m=(0.4, 1.0)))
    radar.start(17.0)
    first = radar.read_frame().counter
    radar_place.place.sleep(0.5)
    frames = list(radar.frames(20))
    radar.stop()
    counters = [frame.counter for frame in frames]
    assert counters == sorted(set(counters))
    assert radar.frames_lost == counters[-1] - first - len(counters)
    assert radar.fault_count == 0
    assert radar.statistics.off_lattice_samples == 0


def test_settings_change_while_frames_come(radar: X4M300, frame_rate_hz: float) -> None:
    """Protocol reference 8.4, 9.4: bins and values of the frames that follow are the new ones."""
    radar.configure_raw(RawConfig(frame_area_m=(0.4, 2.0)))
    radar.start(frame_rate_hz)
    radar.read_frame()
    radar.x4.frame_area_m = (0.4, 5.0)
    radar.x4.iterations = 8
    changed = next(frame for frame in radar.frames(20) if frame.ranges_m[-1] > 4.9)
    radar.stop()
    assert changed.samples.shape == changed.ranges_m.shape
    assert radar.x4.frame_bin_count == changed.samples.size
    # one frame may have been on its way (8.4)
    assert radar.frames_discarded <= 1
    assert radar.statistics.off_lattice_samples <= changed.samples.size

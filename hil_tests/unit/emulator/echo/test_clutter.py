"""Clutter has the strength, the band and the memory that its page says, and no other dependence."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from emulator.chip.chip import CaptureSettings, downconvert
from emulator.echo.receiver import GRIDS, ClutterField
from emulator.scene.scene import ClutterSpec
from hil_tests.property.examples import examples
from hil_tests.unit.emulator.rooms import PAPER
from xethru_protocol.processing.downconversion import CHANNELS, TAP_COUNT
from xethru_protocol.wire.x4 import BASEBAND_DECIMATION, CARRIER_HZ, RF_BIN_M, SAMPLING_RATE_HZ

CAPTURE = PAPER
FAST = replace(PAPER, pulses_per_step=10)
CORRELATION_S = 4.8
FAR_APART_NS = 30_000_000_000
SERIAL = 202305070101
# sigma_t = sqrt(ln 10) / (pi 1.4 GHz): a Gaussian spectrum 10 dB down at +-0.7 GHz
ENVELOPE_SAMPLES = np.sqrt(np.log(10)) / (np.pi * 1.4e9) * SAMPLING_RATE_HZ


def clutter(
    times_ns: NDArray[np.int64],
    capture: CaptureSettings = CAPTURE,
    *,
    seed: int = 0,
    serial: int = SERIAL,
    sigma: float = 1.0,
    gain: float = 1.0,
) -> NDArray[np.float64]:
    field = ClutterField(
        ClutterSpec(sigma=sigma, correlation_s=CORRELATION_S), seed=seed, serial=serial
    )
    signal = np.zeros((len(times_ns), capture.n_samples))
    field.add_to(signal, times_ns, capture, gain)
    return signal


@pytest.fixture(scope="module")
def independent() -> NDArray[np.float64]:
    """Frames so far apart in time that they have nothing in common, shape (1000, 1431)."""
    return clutter(np.arange(1000, dtype=np.int64) * FAR_APART_NS)


@pytest.mark.parametrize("setting", [3, 4])
def test_its_autocorrelation_over_range_is_the_pulses(setting: int) -> None:
    frames = clutter(
        np.arange(400, dtype=np.int64) * FAR_APART_NS, replace(CAPTURE, tx_center_frequency=setting)
    )
    variance = float((frames**2).mean())
    for distance in (1, 2, 3, 5, 8, 13, 21, 34):
        product = float((frames[:, :-distance] * frames[:, distance:]).mean())
        cycles = CARRIER_HZ[setting] / SAMPLING_RATE_HZ * distance
        closed_form = np.exp(-(distance**2) / (4 * ENVELOPE_SAMPLES**2)) * np.cos(
            2 * np.pi * cycles
        )
        assert product / variance == pytest.approx(closed_form, abs=0.02)


def test_it_is_equally_strong_everywhere(independent: NDArray[np.float64]) -> None:
    power = (independent**2).mean(axis=0)
    # 0.3 % less for the straight lines between instants; 1000 draws: 4.5 % standard error
    assert power.mean() == pytest.approx(0.997, abs=0.01)
    assert power.std() < 0.07
    assert power[0::8].mean() == pytest.approx(power[4::8].mean(), rel=0.02)


def test_it_stays_in_the_transmitted_band(independent: NDArray[np.float64]) -> None:
    window = np.blackman(1431)
    power = (np.abs(np.fft.rfft(independent * window, axis=1)) ** 2).mean(axis=0)
    frequency = np.fft.rfftfreq(1431, 1 / SAMPLING_RATE_HZ)
    outside = np.abs(frequency - 7.29e9) > 2.0e9
    assert power[outside].sum() / power.sum() < 1e-5
    offset = np.abs(frequency - 7.29e9)
    edge = np.abs(offset - 0.7e9) < 0.05e9
    middle = offset < 0.1e9
    fall = 10 * np.log10(power[edge].mean() / power[middle].mean())
    closed_form = 10.0 ** -((offset / 0.7e9) ** 2)
    expected = 10 * np.log10(closed_form[edge].mean() / closed_form[middle].mean())
    assert fall == pytest.approx(expected, abs=0.4)


def test_its_memory_is_the_scenes_correlation_time() -> None:
    lag_ns = round(CORRELATION_S * 1e9)
    starts = np.arange(400, dtype=np.int64) * 4 * FAR_APART_NS
    capture = replace(CAPTURE, n_samples=400)
    products = [
        float((clutter(starts, capture, seed=s) * clutter(starts + lag_ns, capture, seed=s)).mean())
        for s in range(3)
    ]
    assert np.mean(products) == pytest.approx(np.exp(-1), abs=0.03)
    assert sum(share for _, share in GRIDS) == pytest.approx(1.0)


@settings(max_examples=examples(25), deadline=None)
@given(
    cuts=st.lists(st.integers(1, 39), max_size=6, unique=True),
    step_ns=st.sampled_from([2_500_000, 58_823_529, 200_000_000, 7_000_000_000]),
    pace=st.sampled_from([PAPER, FAST]),
)
def test_block_size_and_order_never_change_a_value(
    cuts: list[int], step_ns: int, pace: CaptureSettings
) -> None:
    times_ns = np.arange(40, dtype=np.int64) * step_ns
    capture = replace(pace, n_samples=64)
    whole = clutter(times_ns, capture)
    field = ClutterField(ClutterSpec(sigma=1.0, correlation_s=CORRELATION_S), seed=0, serial=SERIAL)
    signal = np.zeros_like(whole)
    for block in reversed(np.split(np.arange(40), sorted(cuts))):
        part = np.zeros((len(block), 64))
        field.add_to(part, times_ns[block], capture, 1.0)
        signal[block] = part
    assert signal.tobytes() == whole.tobytes()


@pytest.mark.parametrize("other", [{"seed": 1}, {"serial": SERIAL + 1}], ids=["seed", "radar"])
def test_seeds_and_radars_are_independent(
    independent: NDArray[np.float64], other: dict[str, int]
) -> None:
    times_ns = np.arange(100, dtype=np.int64) * FAR_APART_NS
    two = clutter(times_ns, seed=other.get("seed", 0), serial=other.get("serial", SERIAL))
    assert abs(float((independent[:100] * two).mean())) < 0.03


@pytest.mark.parametrize("shift", [1, 5, 8, 19])
def test_it_stands_in_the_room_and_not_in_the_frame(shift: int) -> None:
    times_ns = np.arange(3, dtype=np.int64) * FAR_APART_NS
    shifted = replace(CAPTURE, first_sample_m=CAPTURE.first_sample_m + shift * RF_BIN_M)
    np.testing.assert_allclose(
        clutter(times_ns, shifted)[:, :-shift], clutter(times_ns)[:, shift:], atol=1e-12
    )


def test_it_remembers_nothing_of_an_earlier_frame_area() -> None:
    """The host may change area and carrier between two frames."""
    field = ClutterField(ClutterSpec(sigma=1.0, correlation_s=CORRELATION_S), seed=0, serial=SERIAL)
    rows = (
        CAPTURE,
        FAST,
        replace(FAST, first_sample_m=0.8),
        replace(CAPTURE, tx_center_frequency=4),
        replace(CAPTURE, first_sample_m=0.8),
        replace(CAPTURE, n_samples=100),
    )
    for step in range(18):  # so that a change falls on an instant that is kept
        time_ns = np.array([step * 60_000_000], dtype=np.int64)
        capture = rows[step % len(rows)]
        signal = np.zeros((1, capture.n_samples))
        field.add_to(signal, time_ns, capture, 1.0)
        assert signal.tobytes() == clutter(time_ns, capture).tobytes()


def test_it_flows_without_steps() -> None:
    """In 1 ms, 1/260 of the fastest knots' spacing, it moves by less than 1 % of its strength."""
    frames = clutter(np.arange(400, dtype=np.int64) * 1_000_000)
    moves = np.sqrt((np.diff(frames, axis=0) ** 2).mean(axis=1))
    assert moves.min() > 0.0005
    assert moves.max() < 0.01


def test_strength_and_gain_are_factors_and_the_number_of_pulses_is_none() -> None:
    times_ns = np.array([0, 123_456_789], dtype=np.int64)
    np.testing.assert_allclose(
        clutter(times_ns, sigma=0.25, gain=0.5), 0.125 * clutter(times_ns), rtol=1e-12
    )
    assert not clutter(times_ns, sigma=0.0).any()
    assert not clutter(times_ns, gain=0.0).any()
    few = replace(CAPTURE, iterations=8, pulses_per_step=300)
    np.testing.assert_array_equal(clutter(times_ns, few), clutter(times_ns))


def test_frames_that_follow_fast_are_made_in_another_way_and_are_the_same() -> None:
    times_ns = np.arange(80, dtype=np.int64) * 12_500_000
    np.testing.assert_allclose(clutter(times_ns, FAST), clutter(times_ns), atol=1e-13)


def test_baseband_hears_the_share_of_it_that_its_filter_passes() -> None:
    """2.25e-4 of RF give the 1.58e-4 per component that the recording is matched with."""
    taps = CHANNELS[3]
    capture = replace(CAPTURE, n_samples=BASEBAND_DECIMATION * 53 + TAP_COUNT)
    frames = clutter(np.arange(800, dtype=np.int64) * FAR_APART_NS, capture, sigma=1.0)
    i_lines, q_lines = downconvert(np.rint(frames * 1e6).astype(np.int64), taps, 0)
    baseband = 1e-6 / taps.absolute_sum * np.stack([i_lines, q_lines])
    per_component = np.sqrt((baseband**2).mean(axis=(1, 2)))
    # closed form: the taps' autocorrelation against the clutter's
    lags = np.arange(1 - TAP_COUNT, TAP_COUNT)
    over_range = np.exp(-(lags**2) / (4 * ENVELOPE_SAMPLES**2)) * np.cos(2 * np.pi * 5 / 16 * lags)
    of_taps = np.convolve(taps.i_taps, taps.i_taps[::-1])
    expected = np.sqrt((of_taps * over_range).sum()) / taps.absolute_sum
    assert per_component == pytest.approx(expected, rel=0.02)
    assert 2.25e-4 * expected == pytest.approx(1.58e-4, rel=0.01)

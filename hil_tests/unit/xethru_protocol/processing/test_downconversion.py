"""Downconversion of RF frames: the chip's integers, a tone's closed form, what the phase means."""

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.chip.chip import Chip
from emulator.chip.chip import downconvert as chip_lines
from emulator.echo.echo import echo_source
from emulator.scene.people import PersonSpec
from emulator.scene.scene import LeakageSpec, NoiseSpec, empty_room
from hil_tests.unit.emulator.doubles import working_point
from xethru_protocol.processing.downconversion import (
    CHANNELS,
    DECIMATION,
    downconvert,
    line_bins,
)
from xethru_protocol.wire import x4
from xethru_protocol.wire.codes import X4Setting

CYCLES_PER_SAMPLE = {3: 5 / 16, 4: 3 / 8}


@pytest.mark.parametrize("setting", [3, 4])
@pytest.mark.parametrize("first_sample", [0, 3, 20])
def test_lines_are_those_of_the_chips_integers(setting: int, first_sample: int) -> None:
    """Protocol reference 9.7: I = raw n / S, Q = -raw n / S, of the same counters."""
    taps = CHANNELS[setting]
    counters = np.random.default_rng(1).integers(0, 729_600, size=(3, 400))
    quantum = 1 / (16 * 300 * 1024)
    rf = (counters * quantum - 0.07421875).astype(np.float32)
    bins = line_bins(400, tx_center_frequency=setting, first_sample=first_sample)
    lines = (bins + first_sample) // DECIMATION
    begin = int(bins[0]) - taps.lead_samples
    window = counters[:, begin : int(bins[-1]) - taps.lead_samples + 32]
    i_raw, q_raw = chip_lines(window, taps, int(lines[0]))
    expected = (i_raw - 1j * q_raw) * quantum / taps.absolute_sum
    found = downconvert(rf, tx_center_frequency=setting, first_sample=first_sample)
    assert found.dtype == np.complex64
    assert not ((bins + first_sample) % DECIMATION).any()
    # float32 samples near 0.07 are rounded by 4e-9
    np.testing.assert_allclose(found, expected, atol=5e-8)
    one = downconvert(rf[1], tx_center_frequency=setting, first_sample=first_sample)
    np.testing.assert_allclose(one, found[1], atol=1e-8)


def test_windows_lie_inside_the_frame_and_none_is_left_out() -> None:
    """Line L needs the samples 8 L - lead to 8 L - lead + 31; protocol reference 9.8."""
    for n_bins in range(40, 60):
        for setting, taps in CHANNELS.items():
            needed = [
                at
                for at in range(0, n_bins, 8)
                if at - taps.lead_samples >= 0 and at - taps.lead_samples + 31 < n_bins
            ]
            assert line_bins(n_bins, tx_center_frequency=setting).tolist() == needed
    assert DECIMATION == x4.BASEBAND_DECIMATION


@pytest.mark.parametrize(("setting", "gain"), [(3, 0.782), (4, 0.768)])
def test_tone_at_the_carrier_has_the_documented_gain_and_its_own_phase(
    setting: int, gain: float
) -> None:
    """Protocol reference 9.8; the phase of every line falls by what the tone is delayed."""

    def baseband(delay: float) -> NDArray[np.complex64]:
        samples = np.arange(1431) - delay
        tone = 0.02 * np.cos(2 * np.pi * CYCLES_PER_SAMPLE[setting] * samples)
        return downconvert(tone, tx_center_frequency=setting)

    still, later = baseband(0.0), baseband(0.4)
    np.testing.assert_allclose(np.abs(still), gain * 0.02, rtol=0.005)
    assert np.ptp(np.angle(still)) < 0.01
    turned = np.angle(later * still.conj())
    np.testing.assert_allclose(turned, -2 * np.pi * CYCLES_PER_SAMPLE[setting] * 0.4, atol=0.01)


def values_of(
    setting: int, *, downconversion: int, range_m: float
) -> tuple[NDArray[np.float32], x4.FrameArea]:
    """Return one frame of a point at a range without noise or leakage."""
    somebody = PersonSpec(name="point", waypoints_m=((range_m, 0.0),), breath_amplitude_m=0.0)
    quiet = {"noise": NoiseSpec(rf_sigma=0.0), "leakage": LeakageSpec(amplitude=0.0)}
    scene = empty_room().model_copy(update={"people": (somebody,), **quiet})
    chip = working_point(Chip(echo_source(scene, 0, 0)))
    chip.set(X4Setting.TXCENTERFREQUENCY, setting)
    chip.set(X4Setting.DOWNCONVERSION, downconversion)
    return chip.next_frame().values, chip.area


@pytest.mark.parametrize("setting", [3, 4])
def test_phase_and_ranges_are_those_of_the_modules_own_baseband(setting: int) -> None:
    rf, area = values_of(setting, downconversion=0, range_m=2.0)
    values, baseband_area = values_of(setting, downconversion=1, range_m=2.0)
    iq = values[: baseband_area.n_bins] + 1j * values[baseband_area.n_bins :]
    module_m = baseband_area.start_m + np.arange(len(iq)) * baseband_area.bin_length_m
    first = area.first_index
    found = downconvert(rf, tx_center_frequency=setting, first_sample=first)
    at = line_bins(len(rf), tx_center_frequency=setting, first_sample=first)
    ranges_m = area.start_m + at * area.bin_length_m
    same = np.rint((ranges_m - module_m[0]) / baseband_area.bin_length_m).astype(int)
    np.testing.assert_allclose(ranges_m, module_m[same], atol=1e-5)
    # each RF sample is rounded to a count of 2e-7
    np.testing.assert_allclose(found, iq[same], atol=5e-7)
    assert np.abs(found).max() > 1e-3


def test_phase_of_a_point_turns_by_twice_the_way_in_wavelengths() -> None:
    """An echo's phase is -4 pi R / wavelength; module and scene have the speed of light true."""
    wavelength_m = 299_792_458 / 7.29e9
    steps_m = np.array([0.0, 0.002, 0.004, 0.006])
    peaks = []
    for step_m in steps_m:
        rf, area = values_of(3, downconversion=0, range_m=2.0 + step_m)
        iq = downconvert(rf)
        ranges_m = area.start_m + line_bins(len(rf)) * area.bin_length_m
        peaks.append(iq[np.argmin(np.abs(ranges_m - 2.0))])
    receding = np.unwrap(np.angle(peaks))
    np.testing.assert_allclose(
        receding - receding[0], -4 * np.pi * steps_m / wavelength_m, atol=0.02
    )


@pytest.mark.parametrize(("n_bins", "setting"), [(31, 3), (1431, 5)])
def test_what_cannot_be_downconverted_raises(n_bins: int, setting: int) -> None:
    with pytest.raises(ValueError, match=r"bins|tx_center_frequency"):
        downconvert(np.zeros(n_bins), tx_center_frequency=setting)

"""The integer filter against the closed forms of the protocol reference, 9.7 and 9.8."""

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.chip.chip import Chip
from emulator.chip.downconversion import CHANNELS, downconvert
from hil_tests.unit.emulator.doubles import FormulaSource, working_point
from xethru_protocol.wire.codes import X4Setting

Samples = NDArray[np.float64]
CYCLES_PER_SAMPLE = {3: 5 / 16, 4: 3 / 8}


@pytest.mark.parametrize(("setting", "absolute_sum", "non_zero"), [(3, 306, 30), (4, 316, 28)])
def test_taps_are_those_the_reference_describes(
    setting: int, absolute_sum: int, non_zero: int
) -> None:
    taps = CHANNELS[setting].i_taps
    assert len(taps) == 32
    assert all(-32 <= tap <= 31 for tap in taps)
    assert sum(taps) == 0
    assert sum(abs(tap) for tap in taps) == CHANNELS[setting].absolute_sum == absolute_sum
    assert sum(tap != 0 for tap in taps) == non_zero


def baseband_of(setting: int, formula: FormulaSource) -> tuple[NDArray[np.complex128], Chip]:
    chip = working_point(Chip(formula))
    chip.set(X4Setting.TXCENTERFREQUENCY, setting)
    chip.set(X4Setting.DOWNCONVERSION, 1)
    values = chip.next_frame().values.astype(np.float64)
    n_bins = len(values) // 2
    return values[:n_bins] + 1j * values[n_bins:], chip


@pytest.mark.parametrize(("setting", "gain"), [(3, 0.782), (4, 0.768)])
@pytest.mark.parametrize("phase_rad", [0.0, 0.7, 1.9])
def test_tone_at_the_carrier_has_the_documented_gain_and_one_phase(
    setting: int, gain: float, phase_rad: float
) -> None:
    """Protocol reference 9.8: amplitude A gives |I + jQ| = 0.782 A; the phase is continuous."""
    amplitude, quantum = 0.05, 1 / (16 * 300 * 1024)
    cycles = CYCLES_PER_SAMPLE[setting]

    def tone(index: Samples) -> Samples:
        wave = amplitude * np.cos(2 * np.pi * cycles * index - phase_rad)
        return np.asarray((wave + 0.07421875) / quantum)

    iq, _ = baseband_of(setting, FormulaSource(tone))
    assert len(iq) == 181
    np.testing.assert_allclose(np.abs(iq), gain * amplitude, rtol=0.005)
    assert np.ptp(np.unwrap(np.angle(iq))) < 0.01


def test_phase_falls_as_range_grows() -> None:
    """Protocol reference 9.8, phase convention with Q negated."""

    def phase_of_delay(delay: float) -> float:
        def tone(n: Samples) -> Samples:
            return np.asarray(3e5 + 1e5 * np.cos(2 * np.pi * 5 / 16 * (n - delay)))

        iq, _ = baseband_of(3, FormulaSource(tone))
        return float(np.angle(iq.mean()))

    steps = np.diff(np.unwrap([phase_of_delay(delay) for delay in (0.0, 0.25, 0.5)]))
    np.testing.assert_allclose(steps, -2 * np.pi * 5 / 16 * 0.25, atol=0.01)


@pytest.mark.parametrize("line", [20, 21, 100])
@pytest.mark.parametrize("setting", [3, 4])
def test_a_target_appears_at_its_labelled_range(line: int, setting: int) -> None:
    """A short pulse centred on RF sample 8 L (the label of line L) peaks in bin L."""

    def pulse(n: Samples) -> Samples:
        centre = n - 8 * line
        carrier = np.cos(2 * np.pi * CYCLES_PER_SAMPLE[setting] * centre)
        return np.asarray(3e5 + 2e5 * np.exp(-((centre / 8) ** 2)) * carrier)

    iq, chip = baseband_of(setting, FormulaSource(pulse))
    peak = int(np.argmax(np.abs(iq)))
    label_m = chip.area.start_m + peak * chip.area.bin_length_m
    assert label_m == pytest.approx(0.18 + 8 * line * 1.5e8 / 23.328e9, abs=1e-4)


def test_filter_agrees_with_a_plain_sum() -> None:
    rng = np.random.default_rng(1)
    rf = rng.integers(0, 2**24, size=(2, 8 * 5 + 32))
    i_raw, q_raw = downconvert(rf, CHANNELS[3], first_line=3)
    taps = CHANNELS[3].i_taps
    for frame in range(2):
        for line in range(6):
            window = [int(value) for value in rf[frame, 8 * line : 8 * line + 32]]
            sign = (-1) ** (3 + line)
            assert i_raw[frame, line] == sign * sum(
                t * x for t, x in zip(taps, window, strict=True)
            )
            assert q_raw[frame, line] == sign * sum(
                t * x for t, x in zip(taps[::-1], window, strict=True)
            )

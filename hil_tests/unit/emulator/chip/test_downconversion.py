"""The integer filter against the closed forms of the protocol reference, 9.7 and 9.8."""

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.chip.chip import Chip, downconvert
from hil_tests.unit.emulator.doubles import FormulaSource, working_point
from xethru_protocol.processing.downconversion import CHANNELS
from xethru_protocol.wire.codes import X4Setting

Samples = NDArray[np.float64]
CYCLES_PER_SAMPLE = {3: 5 / 16, 4: 3 / 8}


# Protocol reference 9.8, taps 0...31 of the vendor's x4driver.c.
# fmt: off
TAPS = {
    3: (
        (1, -1, -1, 5, -3, -6, 12, -2, -16, 18, 6, -27, 16, 17, -31, 6,
         25, -25, -5, 24, -13, -10, 16, -3, -7, 6, 0, -3, 1, 0, 0, 0),
        (0, 1, -3, 0, 6, -7, -3, 16, -10, -13, 24, -5, -25, 25, 6, -31,
         17, 16, -27, 6, 18, -16, -2, 12, -6, -3, 5, -1, -1, 1, 0, 0),
    ),
    4: (
        (1, -2, 1, 3, -8, 11, -5, -8, 21, -24, 10, 12, -30, 31, -13, -12,
         29, -27, 10, 8, -17, 15, -5, -3, 5, -4, 1, 0, 0, 0, 0, 0),
        (0, 1, -4, 5, -3, -5, 15, -17, 8, 10, -27, 29, -12, -13, 31, -30,
         12, 10, -24, 21, -8, -5, 11, -8, 3, 1, -2, 1, 0, 0, 0, 0),
    ),
}
# fmt: on


@pytest.mark.parametrize(("setting", "absolute_sum"), [(3, 306), (4, 316)])
def test_taps_are_the_vendors(setting: int, absolute_sum: int) -> None:
    taps = CHANNELS[setting]
    assert (taps.i_taps, taps.q_taps) == TAPS[setting]
    assert taps.absolute_sum == absolute_sum
    assert sum(taps.i_taps) == sum(taps.q_taps) == 0


@pytest.mark.parametrize(
    ("setting", "gain", "rejection_db", "centre"), [(3, 0.782, 55, 14.5), (4, 0.768, 61, 13.5)]
)
def test_gain_image_and_delay_of_the_taps(
    setting: int, gain: float, rejection_db: float, centre: float
) -> None:
    """9.8: half of |I + jQ| at +fc, the ratio to -fc, and one delay at every frequency."""
    taps = CHANNELS[setting]
    pair = (np.array(taps.i_taps) - 1j * np.array(taps.q_taps)) / taps.absolute_sum

    def response(cycles: float) -> complex:
        return complex(np.dot(pair, np.exp(2j * np.pi * cycles * np.arange(32))))

    carrier = CYCLES_PER_SAMPLE[setting]
    wanted, image = abs(response(carrier)), abs(response(-carrier))
    assert wanted / 2 == pytest.approx(gain, abs=5e-4)
    assert 20 * np.log10(wanted / image) == pytest.approx(rejection_db, abs=0.5)
    cycles = carrier + np.linspace(-0.03, 0.03, 13)
    delayed = [response(f) * np.exp(-2j * np.pi * f * centre) for f in cycles]
    np.testing.assert_allclose(np.angle(delayed / delayed[6]), 0.0, atol=1e-9)
    assert (taps.centre, taps.lead_samples) == (centre, centre + 0.5)


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


@pytest.mark.parametrize(("setting", "alternates"), [(3, -1), (4, 1)])
def test_filter_agrees_with_a_plain_sum(setting: int, alternates: int) -> None:
    """9.8: the second set is the first one negated (setting 3) or equal (setting 4)."""
    rng = np.random.default_rng(1)
    rf = rng.integers(0, 2**24, size=(2, 8 * 5 + 32))
    i_raw, q_raw = downconvert(rf, CHANNELS[setting], first_line=3)
    i_taps, q_taps = TAPS[setting]
    for frame in range(2):
        for line in range(6):
            window = [int(value) for value in rf[frame, 8 * line : 8 * line + 32]]
            sign = alternates ** (3 + line)
            for raw, taps in ((i_raw, i_taps), (q_raw, q_taps)):
                expected = sign * sum(t * x for t, x in zip(taps, window, strict=True))
                assert raw[frame, line] == expected

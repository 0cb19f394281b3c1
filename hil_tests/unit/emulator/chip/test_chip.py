"""Settings, checks and frames of the chip against the protocol reference's tables."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from emulator.chip.chip import Chip, Refusal, Timeline
from hil_tests.unit.emulator.doubles import FormulaSource, RampSource, working_point
from xethru_protocol.wire.codes import X4Setting
from xethru_protocol.wire.messages import X4Value

# Protocol reference 4.9, column "Range / check (error)"; others are in hil_tests/device.
REFUSED: list[tuple[X4Setting, X4Value, int]] = [
    (X4Setting.FRAMEAREA, (math.inf, 1.0), 17),
    (X4Setting.TXCENTERFREQUENCY, 2, 20),
    (X4Setting.FRAMEBINCOUNT, 7, 1),
]


@pytest.mark.parametrize(("setting", "value", "code"), REFUSED)
def test_bad_value_is_refused_and_changes_nothing(
    setting: X4Setting, value: X4Value, code: int
) -> None:
    chip = Chip(RampSource())
    before = chip.settings
    with pytest.raises(Refusal) as refusal:
        chip.set(setting, value)
    assert refusal.value.code == code
    assert chip.settings == before


@pytest.mark.parametrize(
    ("setting", "value", "kept"),
    [
        (X4Setting.PULSESPERSTEP, 0x1012C, 300),
        (X4Setting.PULSESPERSTEP, 1101004800, 0),  # the document's float form of 20
        (X4Setting.ITERATIONS, 0x110, 16),
        (X4Setting.DACMIN, 0x10005, 5),
        (X4Setting.DACSTEP, 0x102, 2),
    ],
)
def test_only_the_documented_bits_are_kept(setting: X4Setting, value: int, kept: int) -> None:
    chip = Chip(RampSource())
    chip.set(setting, value)
    assert chip.get(setting) == kept


def test_enable_has_no_getter_and_off_needs_init() -> None:
    chip = Chip(RampSource())
    chip.set(X4Setting.FPS, 17.0)
    with pytest.raises(Refusal) as refusal:
        chip.get(X4Setting.ENABLE)
    assert refusal.value.code == 1
    chip.set(X4Setting.ENABLE, 0)
    assert not chip.running
    chip.set(X4Setting.ENABLE, 1)
    with pytest.raises(Refusal) as refusal:
        chip.set(X4Setting.ITERATIONS, 16)
    assert refusal.value.code == 4
    chip.init()
    chip.set(X4Setting.ITERATIONS, 16)


def test_real_frame_rate_is_read_back() -> None:
    chip = Chip(RampSource())
    for requested, read_back in (
        (17.0, 17.049379),
        (17.9, 17.049379),
        (0.5, 1.004108),
        (40.5, 40.5),
    ):
        chip.set(X4Setting.FPS, requested)
        assert chip.get(X4Setting.FPS) == pytest.approx(read_back, abs=1e-6)
    chip.set(X4Setting.FPS, -1.0)
    assert chip.get(X4Setting.FPS) == -1.0
    assert not chip.running


def test_rf_values_are_counter_times_quantum_minus_half_range_in_float32() -> None:
    """Protocol reference 9.7: n = 2.03450526e-07 and offset 0.07421875 at 16 x 300, 949-1100."""
    chip = working_point(Chip(RampSource()))
    frame = chip.next_frame()
    counters = np.arange(1431) % 1000
    expected = counters.astype(np.float32) * np.float32(2.03450526e-07) - np.float32(0.07421875)
    assert frame.values.dtype == np.float32
    np.testing.assert_array_equal(frame.values, expected)


def test_full_counter_range_spans_the_documented_output_range() -> None:
    """0 ... 16 * 300 * 152 counts are -0.07421875 ... +0.07421875."""
    top = 16 * 300 * 152
    chip = working_point(Chip(FormulaSource(lambda index: np.where(index % 2 == 0, 0.0, top))))
    values = chip.next_frame().values
    assert values.min() == np.float32(-0.07421875)
    assert values.max() == pytest.approx(0.07421875, rel=1e-6)


def test_frame_area_offset_moves_labels_and_not_echoes() -> None:
    source = RampSource()
    chip = working_point(Chip(source))
    chip.next_frame()
    # one RF bin further in both request and offset: the same samples under other labels
    step_m = 1.5e8 / 23.328e9
    chip.set(X4Setting.FRAMEAREAOFFSET, float(np.float32(0.18 + step_m)))
    chip.set(X4Setting.FRAMEAREA, (0.2 + step_m, 9.4 + step_m))
    chip.next_frame()
    before, after = source.captures
    assert after.first_sample_m == pytest.approx(before.first_sample_m, abs=1e-9)
    assert after.n_samples == before.n_samples == 1431
    # i0 = 3 of the reference's worked example: sample 0 of the frame is 3 bins behind 0.18 m
    assert before.first_sample_m == pytest.approx(0.18 + 3 * step_m, abs=1e-9)


def test_a_setting_takes_effect_with_the_next_frame() -> None:
    chip = working_point(Chip(RampSource()))
    lengths: list[int] = []
    for area in ((0.2, 9.4), (0.4, 5.0), (0.0, 1.0)):
        lengths += [len(chip.next_frame().values) for _ in range(3)]
        chip.set(X4Setting.FRAMEAREA, area)
    assert lengths == [1431] * 6 + [716] * 3


def test_counter_wraps_at_32_bits() -> None:
    chip = Chip(RampSource())
    chip.timeline.next_counter = 2**32 - 1
    assert [chip.next_frame().info for _ in range(2)] == [2**32 - 1, 0]


MIDDLE = 16 * 300 * 152 // 2
"""Counters at the middle of the DAC range at the working point: values of 0 (9.7)."""


def streaming(formula: Callable[[NDArray[np.float64]], NDArray[np.float64]], block: int) -> Chip:
    chip = working_point(Chip(FormulaSource(formula), largest_block=block))
    chip.set(X4Setting.FPS, 17.0)
    return chip


@pytest.mark.parametrize("downconversion", [0, 1])
def test_a_hundred_zero_frames_switch_the_transmitter_off(downconversion: int) -> None:
    """8.4: zero are the normalised samples; no DC passes the filters of baseband (9.8)."""
    level = MIDDLE if downconversion == 0 else 12345
    chip = streaming(lambda index: 0 * index + level, 32)
    chip.set(X4Setting.DOWNCONVERSION, downconversion)
    for _ in range(99):
        assert not chip.next_frame().values.any()
    assert chip.get(X4Setting.TXPOWER) == 2
    chip.next_frame()
    assert not chip.running
    assert chip.get(X4Setting.TXPOWER) == 0
    assert chip.get(X4Setting.FPS) == 0


def test_counters_of_zero_are_no_zero_frame() -> None:
    """8.4: they are -0.074 when normalised; this test once had them for a dead receiver."""
    chip = streaming(lambda index: 0 * index, 32)
    for _ in range(150):
        chip.next_frame()
    assert (chip.running, chip.get(X4Setting.TXPOWER)) == (True, 2)


def test_zero_frames_that_do_not_follow_each_other_switch_nothing_off() -> None:
    """Frame 50 alone is not zero: 99 zero frames behind it are allowed, and 50 before it."""
    level = MIDDLE
    chip = streaming(lambda index: 0 * index + level, 1)
    for counter in range(150):
        level = MIDDLE + int(counter == 50)
        chip.next_frame()
    assert (chip.running, chip.get(X4Setting.TXPOWER)) == (True, 2)
    chip.next_frame()
    assert (chip.running, chip.get(X4Setting.TXPOWER)) == (False, 0)


@pytest.mark.parametrize(
    ("setting", "value"),
    [(X4Setting.ITERATIONS, 0), (X4Setting.PULSESPERSTEP, 0), (X4Setting.DACMIN, 1101)],
)
@pytest.mark.parametrize("downconversion", [0, 1])
def test_settings_without_a_sweep_give_finite_frames(
    setting: X4Setting, value: int, downconversion: int
) -> None:
    chip = working_point(Chip(RampSource()))
    chip.set(X4Setting.DOWNCONVERSION, downconversion)
    chip.set(setting, value)
    assert np.isfinite(chip.next_frame().values).all()


# Protocol reference 4.9, table of X4 registers: address, byte written, and what it sets.
REGISTER_WRITES: list[tuple[int, int, X4Setting, X4Value]] = [
    (0x2C, 40, X4Setting.PRFDIV, 40),
    (0x2E, 0x02, X4Setting.PULSESPERSTEP, 0x022C),  # 300 is 012Ch
    (0x2F, 0x02, X4Setting.PULSESPERSTEP, 0x0102),
    (0x30, 0x20, X4Setting.DACMAX, 0x104),  # 1100 is 89h * 8 + 4
    (0x31, 0x03, X4Setting.DACMAX, 1099),
    (0x32, 0x20, X4Setting.DACMIN, 0x105),  # 949 is 76h * 8 + 5
    (0x33, 0x03, X4Setting.DACMIN, 947),
    (0x34, 0x22, X4Setting.DACSTEP, 2),
    (0x35, 24, X4Setting.ITERATIONS, 24),
    (0x65, 0x40, X4Setting.TXCENTERFREQUENCY, 4),
    (0x75, 0x70, X4Setting.TXPOWER, 3),
    (0x75, 0x10, X4Setting.TXPOWER, 0),
]


@pytest.mark.parametrize(("address", "byte", "setting", "value"), REGISTER_WRITES)
def test_settings_that_are_read_from_registers_show_what_was_written(
    address: int, byte: int, setting: X4Setting, value: X4Value
) -> None:
    """4.9, note on register writes."""
    chip = working_point(Chip(RampSource()))
    chip.set(X4Setting.PIFREGISTER, (address, byte))
    assert chip.get(setting) == value
    assert chip.read_register(X4Setting.PIFREGISTER, address) == byte


def test_a_register_write_does_not_change_the_drivers_own_copy() -> None:
    """4.9: downconversion, length, rate and area stay; so does normalisation until INIT.

    The chip counts 16 times as long then, so the values are 16 times as large.
    """
    chip = working_point(Chip(FormulaSource(lambda index: 0 * index + 1000)))
    chip.set(X4Setting.FPS, 17.0)
    before = {one: chip.get(one) for one in KEPT}
    for address, byte in ((0x0F, 1), (0x1B, 6), (0x35, 255), (0x42, 5)):
        chip.set(X4Setting.PIFREGISTER, (address, byte))
        assert chip.read_register(X4Setting.PIFREGISTER, address) == byte
    assert {one: chip.get(one) for one in KEPT} == before
    assert chip.get(X4Setting.ITERATIONS) == 255
    values = chip.next_frame().values
    expected = np.float32(1000) * np.float32(2.03450526e-07) - np.float32(0.07421875)
    np.testing.assert_array_equal(values, np.full(1431, expected))
    chip.set(X4Setting.DACMIN, 949)  # another SET takes nothing over
    np.testing.assert_array_equal(chip.next_frame().values, values)
    chip.init()
    assert chip.get(X4Setting.ITERATIONS) == 8


KEPT = (
    X4Setting.DOWNCONVERSION,
    X4Setting.FRAMEAREA,
    X4Setting.FRAMEAREAOFFSET,
    X4Setting.FRAMEBINCOUNT,
    X4Setting.FPS,
)


def test_the_chip_does_what_its_registers_say() -> None:
    """4.9 and 9.1: iterations, TX power, and a receive delay of 96 samples per step."""
    source = RampSource()
    chip = working_point(Chip(source))
    chip.next_frame()
    for address, byte in ((0x35, 32), (0x75, 0x30), (0x42, 3)):
        chip.set(X4Setting.PIFREGISTER, (address, byte))
    chip.next_frame()
    before, after = source.captures
    assert (before.iterations, before.tx_power) == (16, 2)
    assert (after.iterations, after.tx_power) == (32, 1)
    moved_m = after.first_sample_m - before.first_sample_m
    assert moved_m == pytest.approx(2 * 96 * 1.5e8 / 23.328e9, abs=1e-12)


def test_registers_that_follow_from_settings() -> None:
    """Protocol reference 4.9 and 9.4: bytes per counter, and rx wait = tx wait + delay steps."""
    chip = Chip(RampSource())
    pif = X4Setting.PIFREGISTER
    # (start - 0.18 m) / 0.6173 m: -0.3, 0.03 and 7.8 coarse steps
    for start_m, rx_wait in ((0.0, 0), (0.2, 1), (5.0, 8)):
        chip.set(X4Setting.FRAMEAREA, (start_m, 9.4))
        assert chip.read_register(pif, 0x42) == rx_wait
    chip.set(pif, (0x43, 3))
    chip.set(X4Setting.FRAMEAREA, (5.0, 9.4))
    assert chip.read_register(pif, 0x42) == 10
    assert chip.read_register(pif, 0x1B) == 3
    chip.set(X4Setting.DOWNCONVERSION, 1)
    assert chip.read_register(pif, 0x1B) == 6
    assert chip.read_register(pif, 0x0F) == 1


@pytest.mark.parametrize(
    ("board_offset_m", "n_bins"), [(0.18, 1467), (0.0, 1535), (0.3, 1486)], ids=str
)
def test_init_restores_the_boards_own_offset(board_offset_m: float, n_bins: int) -> None:
    """9.3; bins of 0 ... 9.8765 m as the vendor's compiled driver makes them (9.4)."""
    chip = Chip(RampSource(), board_offset_m=board_offset_m)
    for _ in range(2):
        assert chip.get(X4Setting.FRAMEAREAOFFSET) == np.float32(board_offset_m)
        assert chip.get(X4Setting.FRAMEBINCOUNT) == n_bins
        chip.set(X4Setting.FRAMEAREAOFFSET, 0.5)
        chip.init()


@pytest.mark.parametrize(
    ("fps", "runs"),
    [(1e-8, False), (-1.0, False), (math.nan, False), (65536.0, False), (65552.0, True)],
)
def test_corner_values_of_the_rate_read_back_as_they_are(fps: float, runs: bool) -> None:
    """9.6; at 65536 the timer's 16 bits are 0, and no frame comes (assumed)."""
    chip = Chip(RampSource())
    chip.set(X4Setting.FPS, 17.0)
    chip.set(X4Setting.FPS, fps)
    assert chip.running is runs
    read_back = chip.get(X4Setting.FPS)
    assert isinstance(read_back, float)
    assert read_back == np.float32(fps) or (math.isnan(fps) and math.isnan(read_back))


def test_registers_start_as_the_driver_leaves_them() -> None:
    """Protocol reference 4.9, last paragraph: after INIT."""
    chip = Chip(RampSource())
    pif = {
        47: 10,
        46: 0,
        53: 8,
        44: 16,
        45: 16,
        67: 1,
        106: 96,
        115: 16,
        73: 8,
        15: 0,
        14: 128,
        66: 0,
    }
    # 117 = 80 and 101 = 48 hold TX power 2 and centre frequency 3 of the board defaults
    pif |= {49: 7, 48: 255, 51: 0, 50: 0, 117: 80, 101: 48, 27: 3}
    for address, value in pif.items():
        assert chip.read_register(X4Setting.PIFREGISTER, address) == value, address
    spi = [chip.read_register(X4Setting.SPIREGISTER, address) for address in range(4)]
    assert spi == [0x00, 0xFF, 0x01, 0x02]
    assert chip.read_register(X4Setting.XIFREGISTER, 3) == 63
    chip.set(X4Setting.SPIREGISTER, (2, 99))
    assert chip.read_register(X4Setting.SPIREGISTER, 2) == 1
    chip.set(X4Setting.XIFREGISTER, (9, 99))
    assert chip.read_register(X4Setting.XIFREGISTER, 9) == 99
    chip.init()
    assert chip.read_register(X4Setting.XIFREGISTER, 9) == 0


def test_of_modules_in_step_few_make_a_block_at_a_time() -> None:
    """Eight neighbours: once the blocks have grown, one of them synthesises per frame."""
    sources = [RampSource() for _ in range(8)]
    chips = [Chip(source, 8, block_phase=phase) for phase, source in enumerate(sources)]
    for chip in chips:
        chip.set(X4Setting.FPS, 17.0)
    made = []
    for _ in range(64):
        before = [len(source.blocks) for source in sources]
        frames = [chip.next_frame() for chip in chips]
        made.append(sum(len(s.blocks) - n for s, n in zip(sources, before, strict=True)))
        assert all(np.array_equal(frame.values, frames[0].values) for frame in frames)
    assert made[0] == 8
    assert made[24:] == [1] * 40
    assert [source.blocks[-1] for source in sources] == [8] * 8


def test_the_same_rate_after_a_pause_continues_the_segment() -> None:
    timeline = Timeline()
    timeline.set_rate(10.0)
    timeline.next_index = 7
    timeline.set_rate(10.0)
    assert timeline.scene_time_ns(7) == 700_000_000
    assert timeline.scene_time_ns(0) == 0


@given(
    rate_hz=st.floats(1.0, 65535.0),
    start=st.integers(0, 2**33),
    ahead_ns=st.integers(-(10**9), 10**11),
)
def test_skipping_finds_the_first_frame_not_before(
    rate_hz: float, start: int, ahead_ns: int
) -> None:
    timeline = Timeline()
    timeline.set_rate(rate_hz)
    timeline.next_index = start
    target_ns = timeline.scene_time_ns(start) + ahead_ns
    timeline.skip_before(target_ns)
    assert timeline.next_index >= start
    assert timeline.next_counter - 1 == timeline.next_index - start, "the chip sweeps on"
    if timeline.next_index > start:
        assert timeline.scene_time_ns(timeline.next_index) >= target_ns
        assert timeline.scene_time_ns(timeline.next_index - 1) < target_ns
    else:
        assert timeline.scene_time_ns(start) >= target_ns

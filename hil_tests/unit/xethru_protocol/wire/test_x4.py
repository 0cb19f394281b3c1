"""X4 arithmetic against the tables of the Protocol reference, section 9."""

import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from xethru_protocol.wire import x4
from xethru_protocol.wire.errors import LocalProtocolError

# Worked table of 9.4: start, end, offset; RF bins and read-back; baseband bins and read-back.
TABLE = [
    (0.2, 9.4, 0.18, 1431, 0.199290, 9.400679, 181, 0.180000, 9.439260),
    (0.2, 9.4, 0, 1431, 0.199331, 9.400720, 181, 0.154321, 9.413580),
    (0.2, 9.4, 0.2, 1431, 0.200000, 9.401389, 180, 0.200000, 9.407819),
    (-0.5, 9.4, 0.18, 1527, -0.437284, 9.381389, 188, -0.437284, 9.182057),
    (-0.5, 9.4, 0, 1517, -0.501543, 9.252829, 186, -0.514403, 9.002057),
    (0.5, 3.0, 0.18, 390, 0.495072, 3.002788, 50, 0.488642, 3.009218),
    (0.7, 7.9, 0.18, 1121, 0.694403, 7.902479, 142, 0.694403, 7.947490),
    (0.4, 5.0, 0.18, 716, 0.398621, 5.002531, 91, 0.385761, 5.015391),
    (0.4, 5.0, 0, 716, 0.398663, 5.002572, 92, 0.360082, 5.041152),
    (0.4, 9.4, 0.18, 1400, 0.398621, 9.400679, 177, 0.385761, 9.439260),
    (-0.5, 5.0, 0.18, 846, -0.437284, 5.002531, 107, -0.437284, 5.015391),
    (-0.5, 2.0, 0.18, 380, -0.437284, 2.006132, 49, -0.437284, 2.031852),
    (0, 1.0, 0.18, 156, -0.000041, 1.003045, 21, -0.025761, 1.003045),
    (0, 9.9, 0.18, 1467, -0.000041, 9.432829, 180, -0.025761, 9.182057),
    (0, 9.9, 0, 1535, 0, 9.870113, 188, 0, 9.619342),
    (0.18, 10.1, 0.18, 1535, 0.18, 10.050113, 188, 0.18, 9.799341),
]


@pytest.mark.parametrize("row", TABLE, ids=lambda row: f"{row[0]}..{row[1]} m at {row[2]}")
@pytest.mark.parametrize("downconversion", [False, True], ids=["rf", "baseband"])
def test_frame_area_is_quantised_as_in_the_worked_table(
    row: tuple[float, ...], downconversion: bool
) -> None:
    start, end, offset = row[:3]
    bins, read_start, read_end = row[6:] if downconversion else row[3:6]
    area = x4.frame_area(start, end, offset, downconversion)
    assert area.n_bins == bins
    # the table has six digits; the area's first digits are a float32 further on
    assert area.start_m == pytest.approx(read_start, abs=5.1e-7 + abs(read_start) * 2**-24)
    assert area.end_m == pytest.approx(read_end, abs=5.1e-7 + abs(read_end) * 2**-24)


def test_read_backs_are_to_the_last_bit_those_of_real_modules() -> None:
    """9.4, table of real modules: the firmware's metres per bin are a float32."""
    start_m = x4.frame_area(0.5, 3.0, 0.18).start_m
    end_m = x4.frame_area(0.7, 7.9, 0.18).end_m
    assert start_m == np.float32(0.495072007)
    assert end_m == np.float32(7.902479172)


# Computed by the vendor's own x4driver.c, compiled with the firmware's flags (9.4): request,
# offset, downconversion; start, end and bins. In double arithmetic each differs in the last bit.
COMPILED = [
    (2.69, 4.37, 0.2, False, 2.6884258, 4.3730965, 262),
    (-0.26, 3.48, 0.0, False, -0.26363167, 3.4850821, 583),
    (0.19, 2.9, 0.2, False, 0.18713993, 2.9006171, 422),
    (3.22, 4.71, 0.2, False, 3.2156892, 4.7138886, 233),
    (3.43, 7.04, 0.18, True, 3.4207406, 7.073004, 72),
    (1.29, 3.67, 0.2, True, 1.2802469, 3.6979423, 48),
    (3.02, 8.27, 0.18, True, 3.009218, 8.307571, 104),
    (1.21, 5.41, 0.18, True, 1.2088065, 5.4269133, 83),
    # of the golden vectors
    (0.2, 9.4, 0.18, False, 0.19929012656211853, 9.400678634643555, 1431),
    (0.2, 9.4, 0.18, True, 0.18000000715255737, 9.43925952911377, 181),
]


@pytest.mark.parametrize("row", COMPILED, ids=lambda row: f"{row[0]}..{row[1]} m at {row[2]}")
def test_read_backs_are_to_the_last_bit_those_of_the_compiled_driver(
    row: tuple[float, float, float, bool, float, float, int],
) -> None:
    start, end, offset, downconversion, read_start, read_end, bins = row
    area = x4.frame_area(start, end, offset, downconversion)
    assert (area.start_m, area.end_m, area.n_bins) == (
        float(np.float32(read_start)),
        float(np.float32(read_end)),
        bins,
    )


def test_area_after_init_has_1467_bins() -> None:
    area = x4.frame_area(*x4.FULL_AREA_M)
    assert (area.n_bins, area.requested_end_m) == (1467, float(np.float32(9.8765432)))


def test_equal_limits_give_the_bins_of_the_reference() -> None:
    assert x4.frame_area(1.0, 1.0).n_bins in (0, 1)
    assert x4.frame_area(1.0, 1.0, downconversion=True).n_bins in (1, 2)


@pytest.mark.parametrize(("start", "steps"), [(160.0, 2), (0.2, 0), (-3.0, -1)])
def test_receive_delay_is_one_byte(start: float, steps: int) -> None:
    """9.4 step 4: (1 + max(floor((start - 0.18) / 0.6172839506), -1)) mod 256."""
    assert x4.frame_area(start, start + 5).rx_wait == steps + 1


@pytest.mark.parametrize(("downconversion", "longest_m"), [(False, 9.8765432), (True, 9.6707819)])
def test_an_area_that_is_too_long_is_remembered_as_the_longest(
    downconversion: bool, longest_m: float
) -> None:
    """Protocol reference 9.4, step 2."""
    start_m = float(np.float32(0.4))
    area = x4.quantised_area(start_m, 20.0, 0.18, downconversion)
    assert area.requested_end_m == float(np.float32(start_m + float(np.float32(longest_m))))


def test_limit_that_is_a_bin_but_for_rounding_is_that_bin() -> None:
    """9.4 steps 7 and 8: float32(3.325) lies 7e-6 of a bin behind a bin.

    base is 0.2 + 0.6172839506; (0.94 - base) / 0.006430041 = 19.08, (3.325 - base) / 0.006430041
    = 390.000007: 390 - 19 = 371 bins.
    """
    assert x4.frame_area(0.94, 3.325, 0.2).n_bins == 371


def test_inverted_area_is_refused() -> None:
    with pytest.raises(LocalProtocolError):
        x4.frame_area(5.0, 0.4)


@given(st.floats(-1, 12), st.floats(0, 12), st.sampled_from([0.0, 0.18, 0.2]), st.booleans())
def test_quantised_area_covers_the_request_within_one_frame(
    start: float, length: float, offset: float, downconversion: bool
) -> None:
    area = x4.frame_area(start, start + length, offset, downconversion)
    assert 0 <= area.n_bins <= (188 if downconversion else 1535)
    assert 0 <= area.rx_wait < 256
    spare = area.bin_length_m + 1e-5
    assert area.start_m <= max(start, area.base_m) + 1e-5
    assert area.start_m >= max(start, area.base_m) - spare
    assert area.first_index * area.bin_length_m + area.base_m == pytest.approx(
        area.start_m, abs=1e-6
    )


# 9.6: the chip timer's real rates, with digits enough for the exact float32.
RATES = [
    *(1.0041081, 2.0080154, 3.0120232, 4.015228, 5.018533, 6.024046, 7.0273514),
    *(8.0272455, 9.030652, 10.032053, 11.035257, 12.040869, 13.041668, 14.044873),
    *(15.055598, 16.041668, 17.04938, 18.061302, 19.055187, 20.044079, 21.052588),
    *(22.070515, 23.085253, 24.08174, 25.042606, 26.083338, 27.067616, 28.050518),
    *(29.107494, 30.066124, 31.090048, 32.08334, 33.033176, 34.040966),
]


@pytest.mark.parametrize("whole", range(1, 35))
def test_rates_below_35_are_to_the_last_bit_those_measured(whole: int) -> None:
    assert x4.frame_rate_read_back(whole) == np.float32(RATES[whole - 1])


def test_rate_of_25_is_what_a_real_module_read_back() -> None:
    assert x4.frame_rate_read_back(25.0) == 25.042606353759766


@pytest.mark.parametrize(
    ("requested", "real", "answer"),
    [
        (0.5, 1.0041081, 1.0041081),
        (17.9, 17.04938, 17.04938),
        (34.99, 34.040966, 34.040966),
        (35, 35, 35),
        (50.5, 50, 50.5),
        (200.5, 200, 200.5),
        (65535, 65535, 65535),
        (65552, 16.041668, 65552),  # the chip has 16 bits
        (65536, 0, 65536),
        (1.2e-7, 1.0041081, 1.0041081),
        (1.19e-7, 0, 1.19e-7),
        (1e-8, 0, 1e-8),
        (0, 0, 0),
        (-2.5, 0, -2.5),
        (math.inf, 65535, math.inf),
    ],
)
def test_corner_values_of_the_frame_rate(requested: float, real: float, answer: float) -> None:
    """9.6: integer part, low 16 bits, at least 1; what is not above FLT_EPSILON stops."""
    assert x4.real_frame_rate(requested) == float(np.float32(real))
    assert x4.frame_rate_read_back(requested) == float(np.float32(answer))


def test_not_a_number_stops_and_reads_back_as_such() -> None:
    assert x4.real_frame_rate(math.nan) == 0
    assert math.isnan(x4.frame_rate_read_back(math.nan))


@given(st.floats(0.0078125, 1000, width=32) | st.integers(1, 400))
def test_host_finds_the_real_rate_from_the_read_back(requested: float) -> None:
    real = x4.real_frame_rate(requested)
    assert x4.real_frame_rate(x4.frame_rate_read_back(requested)) == real
    assert int(real) == max(int(requested), 1)


@pytest.mark.parametrize("requested", range(1, 40))
def test_every_row_of_the_rate_table_survives_its_read_back(requested: int) -> None:
    real = x4.real_frame_rate(requested)
    assert x4.real_frame_rate(x4.frame_rate_read_back(requested)) == real


@pytest.mark.parametrize(
    ("iterations", "pulses", "low", "high", "recommended"),
    [
        (16, 300, 949, 1100, 19.8),
        (64, 87, 949, 1100, 17.05),
        (64, 5, 949, 1100, 296),
        (8, 10, 0, 2047, 88.1),
        (16, 26, 0, 2047, 16.9),
    ],
)
def test_fps_max_of_the_reference(
    iterations: int, pulses: int, low: int, high: int, recommended: float
) -> None:
    fps_max = x4.fps_max(iterations=iterations, pulses_per_step=pulses, dac_min=low, dac_max=high)
    assert fps_max == pytest.approx(recommended, rel=4e-3)


def test_no_frame_rate_without_a_sweep() -> None:
    with pytest.raises(LocalProtocolError):
        x4.fps_max(iterations=0, pulses_per_step=300, dac_min=949, dac_max=1100)


def test_normalisation_of_the_vendors_working_point() -> None:
    normal = x4.Normalisation.of(iterations=16, pulses_per_step=300, dac_min=949, dac_max=1100)
    assert normal.quantum == pytest.approx(2.03450526e-07, rel=1e-8)
    assert normal.dac_offset == 0.07421875
    assert normal.max_counter == 16 * 300 * 152
    top = np.float32(normal.max_counter) * np.float32(normal.quantum) - np.float32(
        normal.dac_offset
    )
    assert top == pytest.approx(0.07421875, rel=1e-6)


@pytest.mark.parametrize("step", [0, 1, 2, 3])
def test_full_scale_does_not_depend_on_the_dac_step(step: int) -> None:
    normal = x4.Normalisation.of(
        iterations=8, pulses_per_step=10, dac_min=0, dac_max=2047, dac_step=step
    )
    assert normal.max_counter * normal.quantum == pytest.approx(2.0, rel=1e-6)
    assert normal.dac_offset == 1.0


def test_bin_lengths_are_those_of_the_reference() -> None:
    """9.1; the firmware's own are float32 and its multiples."""
    assert pytest.approx(0.006430041152, abs=1e-12) == x4.SAMPLE_M
    assert x4.RF_BIN_M == 0.006430041044950485
    assert x4.BASEBAND_BIN_M == 0.05144032835960388
    assert pytest.approx(0.6172839506, abs=2e-8) == x4.COARSE_STEP_M


@given(st.integers(0, 1 << 32), st.floats(1, 400))
def test_frame_time_is_the_nearest_nanosecond(counter: int, rate: float) -> None:
    assert x4.frame_time_ns(counter, rate) == round(Fraction(counter) * 10**9 / Fraction(rate))


@pytest.mark.parametrize(("counter", "even"), [(1, 0), (3, 2), (5, 2), (7, 4)])
def test_frame_time_in_the_middle_of_two_nanoseconds_is_the_even_one(
    counter: int, even: int
) -> None:
    assert x4.frame_time_ns(counter, 2e9) == even

"""Which samples a chip can send: every counter tried, the reference's numbers, emulated frames."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.chip.chip import CaptureSettings, Chip
from xethru_protocol.driver.frames import Lattice
from xethru_protocol.driver.link import RawConfig
from xethru_protocol.wire.errors import LocalProtocolError


def lattice(**changes: Any) -> Lattice:  # noqa: ANN401 - numbers and a bool
    """Lattice of the vendor's working point, but for some settings."""
    settings: dict[str, Any] = {
        "iterations": 16,
        "pulses_per_step": 300,
        "dac_min": 949,
        "dac_max": 1100,
        "dac_step": 0,
        "downconversion": False,
        "tx_center_frequency": 3,
    }
    return Lattice.of(**settings | changes)


def float32s(*values: float) -> NDArray[np.float32]:
    return np.array(values, np.float32)


def test_numbers_of_the_reference() -> None:
    """Protocol reference 9.7: 16 x 300, step 1: n = 2.03450526e-07, offset 0.07421875 [RUN]."""
    quantum = np.float32(2.03450526e-07)
    counters = np.arange(729_601).astype(np.float32)
    samples = counters * quantum - np.float32(0.07421875)
    whole = lattice()
    assert whole.off_lattice(samples) == 0
    assert (samples[0], samples[-1]) == (np.float32(-0.07421875), np.float32(0.07421875))
    half_way = (samples[:-1].astype(np.float64) + samples[1:]) / 2
    assert whole.off_lattice(half_way.astype(np.float32)) == 729_600


def every_value(iterations: int, pulses: int, levels: int, step: int) -> set[bytes]:
    """Bit patterns of all samples, by scalar float32 arithmetic, once as the fused product."""
    quantum = np.float32(np.float32(2**step) / np.float32(iterations * pulses) / np.float32(1024))
    offset = np.float32(levels / 2048)
    values = set()
    for counter in range(iterations * pulses * levels // 2**step + 1):
        values.add((np.float32(counter) * quantum - offset).tobytes())
        values.add(np.float32(float(counter) * float(quantum) - float(offset)).tobytes())
    return values


@pytest.mark.parametrize(
    ("iterations", "pulses", "dac_min", "dac_max", "step"),
    [(1, 1, 949, 1100, 0), (3, 7, 1000, 1009, 0), (2, 5, 0, 63, 1), (2, 6, 1020, 1027, 2)],
)
def test_a_sample_is_on_the_lattice_if_a_counter_gives_it(
    iterations: int, pulses: int, dac_min: int, dac_max: int, step: int
) -> None:
    """Against every counter there is, on these values and on their nearest neighbours."""
    levels = dac_max - dac_min + 1
    values = every_value(iterations, pulses, levels, step)
    true = np.frombuffer(b"".join(sorted(values)), np.float32)
    tried = np.concatenate(
        [true, np.nextafter(true, np.float32(9)), np.nextafter(true, np.float32(-9))]
        + [true + np.float32(k / 4 * levels / 1024) for k in range(1, 5)]
    )
    where = lattice(
        iterations=iterations,
        pulses_per_step=pulses,
        dac_min=dac_min,
        dac_max=dac_max,
        dac_step=step,
    )
    assert where.off_lattice(true) == 0
    for value in tried:
        assert where.off_lattice(float32s(value)) == (value.tobytes() not in values), value


@pytest.mark.parametrize(("tx_center_frequency", "taps"), [(3, 306), (4, 316)])
def test_baseband_samples_are_sums_over_the_filter(tx_center_frequency: int, taps: int) -> None:
    where = lattice(
        iterations=1,
        pulses_per_step=1,
        dac_min=1020,
        dac_max=1027,
        downconversion=True,
        tx_center_frequency=tx_center_frequency,
    )
    factor = np.float32(1 / 1024) * (np.float32(1) / np.float32(taps))
    sums = np.arange(-8 * taps // 2, 8 * taps // 2 + 1).astype(np.float32)
    i = sums * factor
    assert where.off_lattice(i) == 0
    assert where.off_lattice(-i) == 0
    between = np.nextafter(i[i > 0], np.float32(9))
    assert where.off_lattice(between) == between.size
    # +-N/2048 = +-8/2048 is the end of the range
    assert where.off_lattice(float32s(8 / 2048, -8 / 2048)) == 0
    assert where.off_lattice((sums[-1:] + np.float32(1)) * factor) == 1


def test_what_lies_beyond_the_range_or_is_no_number_is_off_the_lattice() -> None:
    signalling = np.array([0x7F800001, 0xFF800001], np.uint32).view(np.float32)
    beyond = float32s(0.0742189, -0.0742189, 0.08, -1.0, 3e38, np.inf, -np.inf, np.nan)
    for where in (lattice(), lattice(downconversion=True)):
        assert where.off_lattice(beyond) == 8
        assert where.off_lattice(signalling) == 2
        assert where.off_lattice(float32s()) == 0
        assert where.off_lattice(float32s(0.07421875, np.nan, -0.07421875)) == 1


def test_one_damaged_sample_among_many_is_one() -> None:
    samples = np.arange(300_000, 301_431).astype(np.float32) * np.float32(
        2.03450526e-07
    ) - np.float32(0.07421875)
    damaged = samples.copy()
    damaged.view(np.uint32)[700] ^= 1 << 28
    damaged.view(np.uint32)[701] ^= 1 << 3
    assert lattice().off_lattice(damaged) == 2


def test_fused_arithmetic_is_on_the_lattice_and_its_neighbours_are_not() -> None:
    """The working point of the reference (9.7), every 50th counter; one rounding, not two."""
    counters = np.arange(0, 729_601, 50)
    quantum, offset = np.float32(2.03450526e-07), np.float32(0.07421875)
    fused = (counters * np.float64(quantum) - np.float64(offset)).astype(np.float32)
    separate = counters.astype(np.float32) * quantum - offset
    assert np.count_nonzero(fused != separate) > fused.size // 2
    assert lattice().off_lattice(fused) == 0
    beside = np.nextafter(fused, np.float32(9))
    assert lattice().off_lattice(beside) == np.count_nonzero(beside != separate)


@pytest.mark.parametrize(
    ("setting", "i", "q"),
    [
        (
            3,
            (6.64870992e-10, 8.20783225e-06, 0.000820827787, 0.0111546842),
            (-2.04115395e-07, 6.64864347e-05, 0.00508913584, -0.00997306593),
        ),
        (
            4,
            (6.43830766e-10, 7.94809057e-06, 0.000794852211, 0.0108016878),
            (-1.9765605e-07, 6.43824314e-05, 0.00492808735, -0.00965746213),
        ),
    ],
)
def test_baseband_samples_are_those_of_the_compiled_driver(
    setting: int, i: tuple[float, ...], q: tuple[float, ...]
) -> None:
    """9.7, of the counters below, by the vendor's x4driver.c compiled with its firmware's flags.

    It multiplies the quantum and 1 / S first; dividing by S last gives other last bits.
    """
    samples = float32s(*i, *q)
    counters = float32s(1, 12345, 1234567, 16777217, -307, 99999, 7654321, -15000001)
    where = lattice(downconversion=True, tx_center_frequency=setting)
    assert where.off_lattice(samples) == 0
    np.testing.assert_array_equal(where.nearest(samples), samples)
    taps = {3: 306, 4: 316}[setting]
    factor = np.float32(2.03450526e-07) * (np.float32(1) / np.float32(taps))
    np.testing.assert_array_equal(counters * factor, samples)
    beside = np.nextafter(samples[:2], np.float32(9))
    assert where.off_lattice(beside) == 2


def test_counters_beyond_float32_are_left_out_where_the_verdict_is_clear() -> None:
    """At least so many: baseband counters reach 1e8, and samples of those above 2**21 take long."""
    where = lattice(downconversion=True)
    quantum = np.float32(2.03450526e-07)
    sums = np.linspace(-(1 << 20), 1 << 20, 300).astype(np.int32).astype(np.float32)
    large = np.array([1 << 24, (1 << 24) + 2, 3 << 23], np.float32)
    on = np.concatenate([sums, large]) * (quantum * (np.float32(1) / np.float32(306)))
    assert where.off_lattice(on) == 0
    off = np.nextafter(on, np.float32(9))
    assert where.off_lattice(off[:300]) == 300
    assert 300 <= where.off_lattice(off) <= 303


class _EveryCounter:
    """An echo source whose samples run through the counters' whole range."""

    def rf_counters(
        self,
        capture: CaptureSettings,
        counters: NDArray[np.int64],
        scene_times_ns: NDArray[np.int64],
    ) -> NDArray[np.int64]:
        most = (
            capture.iterations
            * capture.pulses_per_step
            * (capture.dac_max - capture.dac_min + 1)
            // 2**capture.dac_step
        )
        rng = np.random.default_rng(int(counters[0]))
        return rng.integers(0, most + 1, (counters.size, capture.n_samples))


@pytest.mark.parametrize("downconversion", [False, True])
@pytest.mark.parametrize("tx_center_frequency", [3, 4])
@pytest.mark.parametrize(
    "sweep",
    [(16, 300, 949, 1100, 0), (8, 10, 0, 2047, 0), (16, 500, 0, 2047, 0), (64, 87, 949, 1100, 1)],
)
def test_emulated_frames_are_on_the_lattice(
    sweep: tuple[int, int, int, int, int], tx_center_frequency: int, downconversion: bool
) -> None:
    names = ("iterations", "pulses_per_step", "dac_min", "dac_max", "dac_step")
    config = RawConfig(
        **dict(zip(names, sweep, strict=True)),  # type: ignore[arg-type] # all are integer fields
        downconversion=downconversion,
        tx_center_frequency=tx_center_frequency,
    )
    chip = Chip(_EveryCounter())
    for setting, value in config.settings():
        chip.set(setting, value)
    where = config.lattice
    assert where is not None
    for _ in range(3):
        assert where.off_lattice(chip.next_frame().values) == 0


def test_settings_that_count_nothing_have_no_lattice() -> None:
    with pytest.raises(LocalProtocolError):
        lattice(iterations=0)
    with pytest.raises(LocalProtocolError):
        lattice(dac_min=5, dac_max=4)
    with pytest.raises(LocalProtocolError, match="no filter is known"):
        lattice(downconversion=True, tx_center_frequency=5)
    lattice(tx_center_frequency=5)  # RF frames pass no filter

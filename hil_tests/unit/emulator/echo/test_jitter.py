"""Phase jitter: how large, how slow, selected by what, and common to a frame's echoes."""

from dataclasses import replace

import numpy as np
import pytest

from emulator.chip.chip import downconvert
from emulator.echo.echo import echo_source
from emulator.echo.receiver import CarrierJitter
from emulator.scene.scene import JitterSpec, LeakageSpec
from hil_tests.unit.emulator.rooms import PAPER, radar_at, room, target
from xethru_protocol.processing.downconversion import CHANNELS, TAP_COUNT

SERIAL = 202305070101
BOTH = JitterSpec(white_rad=0.0056, slow_rad=0.032, slow_correlation_s=4.0)


def counters(n: int) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.arange(n, dtype=np.int64)


def test_white_part_has_its_deviation_and_no_memory() -> None:
    jitter = CarrierJitter(JitterSpec(white_rad=0.01), seed=0, serial=SERIAL)
    phases = jitter.phases_rad(counters(40_000), counters(40_000) * 58_000_000)
    assert phases.std() == pytest.approx(0.01, rel=0.015)  # 4 standard errors
    for lag in (1, 2, 5):
        assert abs(np.corrcoef(phases[:-lag], phases[lag:])[0, 1]) < 0.02


def test_slow_part_falls_to_1_over_e_after_its_correlation_time() -> None:
    jitter = CarrierJitter(JitterSpec(slow_rad=0.02, slow_correlation_s=0.5), seed=0, serial=SERIAL)
    phases = jitter.phases_rad(counters(10_000), counters(10_000) * 250_000_000)
    # 2500 s hold about 3000 independent values
    assert phases.std() == pytest.approx(0.02, rel=0.05)
    assert np.corrcoef(phases[:-2], phases[2:])[0, 1] == pytest.approx(np.exp(-1), abs=0.05)
    assert np.corrcoef(phases[:-12], phases[12:])[0, 1] == pytest.approx(0, abs=0.08)


def test_each_part_is_selected_by_its_own_clock() -> None:
    """White by the counter alone, slow by scene time alone."""
    white = CarrierJitter(JitterSpec(white_rad=0.1), seed=0, serial=SERIAL)
    slow = CarrierJitter(JitterSpec(slow_rad=0.1), seed=0, serial=SERIAL)
    times = counters(50) * 300_000_000
    assert (
        white.phases_rad(counters(50), times) == white.phases_rad(counters(50), 0 * times)
    ).all()
    assert (slow.phases_rad(counters(50), times) == slow.phases_rad(7 + counters(50), times)).all()


def test_order_and_block_size_never_change_a_value() -> None:
    times = counters(90) * 170_000_000
    whole = CarrierJitter(BOTH, seed=5, serial=SERIAL).phases_rad(counters(90), times)
    other = CarrierJitter(BOTH, seed=5, serial=SERIAL)
    for frame in np.random.default_rng(1).permutation(90).tolist():
        one = other.phases_rad(counters(90)[frame : frame + 1], times[frame : frame + 1])
        assert one.tobytes() == whole[frame : frame + 1].tobytes()


@pytest.mark.parametrize("spec", [JitterSpec(white_rad=0.1), JitterSpec(slow_rad=0.1)])
def test_seeds_and_radars_are_independent(spec: JitterSpec) -> None:
    times = counters(1000) * 40_000_000_000
    one, two, three = (
        CarrierJitter(spec, seed=seed, serial=serial).phases_rad(counters(1000), times)
        for seed, serial in ((0, SERIAL), (1, SERIAL), (0, SERIAL + 1))
    )
    assert np.abs(np.corrcoef([one, two, three]) - np.eye(3)).max() < 0.13


def test_all_echoes_of_a_frame_and_the_leakage_turn_by_the_same_phase() -> None:
    points = tuple(target(x_m, 0.0, name=f"point_{x_m:.0f}", amplitude_1m=0.05) for x_m in (1, 2))
    jitter = JitterSpec(white_rad=0.1, slow_rad=0.2)
    scene = room(radar_at(0, 0, 0, serial=str(SERIAL)), targets=points, jitter=jitter)
    scene = scene.model_copy(update={"leakage": LeakageSpec(amplitude=0.05, range_m=0.5)})
    capture = replace(PAPER, first_sample_m=0.18, n_samples=8 * 44 + TAP_COUNT)
    capture = replace(capture, iterations=255, dac_min=0, dac_max=2047)
    times = counters(40) * 900_000_000
    raw = echo_source(scene, 0, 3).rf_counters(capture, counters(40), times)
    i_lines, q_lines = downconvert(raw, CHANNELS[3], 0)
    iq = i_lines - 1j * q_lines
    given = CarrierJitter(scene.jitter, seed=3, serial=SERIAL).phases_rad(counters(40), times)
    assert given.std() > 0.1
    mean = np.abs(iq).mean(axis=0)
    for lines in (slice(2, 12), slice(12, 24), slice(30, 44)):
        strongest = lines.start + int(np.argmax(mean[lines]))
        turned = np.angle(iq[1:, strongest] / iq[0, strongest])
        np.testing.assert_allclose(turned, given[1:] - given[0], atol=4e-3)

"""Laws of the echo in any scene: shifts, blocks, linearity, radar order, independence."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from emulator.chip.chip import CaptureSettings
from emulator.echo.echo import SceneEcho, echo_source
from emulator.echo.pulse import sum_of_pulses
from emulator.scene.scene import ClutterSpec, LeakageSpec, Scene, load_scene
from hil_tests.property.examples import examples
from hil_tests.unit.emulator.rooms import PAPER

CAPTURE = replace(PAPER, n_samples=400)
LAB = load_scene("lab")
COUNT = 1 / (16 * 300) / 1024
STEP_NS = 200_000_000

settings_st = st.builds(
    lambda n_samples, iterations, setting, power: replace(
        CAPTURE,
        n_samples=n_samples,
        iterations=iterations,
        tx_center_frequency=setting,
        tx_power=power,
    ),
    st.integers(1, 600),
    st.integers(1, 64),
    st.sampled_from([3, 4]),
    st.integers(0, 3),
)


def pulses(position: NDArray[np.float64], amplitude: NDArray[np.float64]) -> NDArray[np.float64]:
    frame = np.zeros(len(position), dtype=np.int64)
    phase_rad = np.linspace(0, 6, len(position))
    return sum_of_pulses(
        frame=frame,
        position=position,
        amplitude=amplitude,
        phase_rad=phase_rad,
        tx_center_frequency=3,
        shape=(1, 600),
    )


@given(
    whole=st.lists(st.integers(100, 300), min_size=1, max_size=6),
    eighths=st.integers(0, 7),
    bins=st.integers(-50, 200),
)
def test_a_delay_by_whole_bins_shifts_the_frame_by_exactly_that(
    whole: list[int], eighths: int, bins: int
) -> None:
    # Eighths of a bin are exact in binary, so the shifted arithmetic is the same bit for bit.
    position = np.array(whole) + eighths / 8
    amplitude = np.linspace(1, 2, len(whole))
    still = pulses(position, amplitude)[0]
    moved = pulses(position + bins, amplitude)[0]
    np.testing.assert_array_equal(np.roll(still, bins), moved)


@given(
    range_m=st.floats(0.5, 1.5),
    bins=st.integers(1, 60),
)
def test_a_target_moved_by_whole_bins_moves_its_echo_by_exactly_that(
    range_m: float, bins: int
) -> None:
    """Compared after undoing the amplitude law; a bin in true metres is c / (2 fs)."""
    radar = LAB.radars[0].model_copy(update={"x_m": 0.0, "y_m": 0.0, "yaw_deg": 0.0})
    bin_m = 299_792_458 / (2 * 23.328e9)

    def frame(x_m: float) -> NDArray[np.float64]:
        target = LAB.targets[0].model_copy(update={"x_m": x_m, "y_m": 0.0, "amplitude_1m": 1.0})
        scene = LAB.model_copy(
            update={
                "radars": (radar,),
                "targets": (target,),
                "leakage": LeakageSpec(amplitude=0.0),
            }
        )
        echo: NDArray[np.float64] = SceneEcho(scene, radar, 0).echo(CAPTURE, np.array([0]))[0]
        undone: NDArray[np.float64] = echo * x_m**1.5
        return undone

    moved = frame(range_m + bins * bin_m)
    np.testing.assert_allclose(moved[bins:], frame(range_m)[:-bins], atol=1e-10)


@given(
    capture=settings_st,
    counters=st.lists(st.integers(0, 2**32 - 1), min_size=1, max_size=6),
    cuts=st.lists(st.integers(0, 6), max_size=3),
    seed=st.integers(0, 2**64 - 1),
)
def test_content_depends_on_neither_block_size_nor_order(
    capture: CaptureSettings, counters: list[int], cuts: list[int], seed: int
) -> None:
    frame_counters = np.array(counters, dtype=np.int64)
    times = (frame_counters % 3456) * STEP_NS
    whole = echo_source(LAB, 1, seed).rf_counters(capture, frame_counters, times)

    source = echo_source(LAB, 1, seed)
    edges = sorted({0, len(counters), *(cut for cut in cuts if cut < len(counters))})
    parts = [
        source.rf_counters(capture, frame_counters[a:b], times[a:b])
        for a, b in reversed(list(pairwise(edges)))
    ]
    np.testing.assert_array_equal(np.concatenate(parts[::-1]), whole)
    backwards = source.rf_counters(capture, frame_counters[::-1], times[::-1])
    np.testing.assert_array_equal(backwards[::-1], whole)


@given(factor=st.floats(0.5, 4), step=st.integers(0, 3456), radar=st.integers(0, 3))
def test_echo_is_linear_in_amplitude(factor: float, step: int, radar: int) -> None:
    louder = LAB.model_copy(
        update={
            "targets": tuple(
                target.model_copy(update={"amplitude_1m": factor * target.amplitude_1m})
                for target in LAB.targets
            ),
            "leakage": LeakageSpec(amplitude=factor * LAB.leakage.amplitude),
        }
    )
    times = np.array([step * STEP_NS])
    plain = SceneEcho(LAB, LAB.radars[radar], 0).echo(CAPTURE, times)
    loud = SceneEcho(louder, LAB.radars[radar], 0).echo(CAPTURE, times)
    # A reflection below one count is skipped, in either of the two.
    np.testing.assert_allclose(loud, factor * plain, atol=4 * COUNT * max(1, factor))


@given(step=st.integers(0, 3456), split=st.integers(0, 14))
def test_echoes_of_a_room_are_the_sum_of_its_parts(step: int, split: int) -> None:
    times = np.array([step * STEP_NS])

    def echo(scene: Scene) -> NDArray[np.float64]:
        return SceneEcho(scene, scene.radars[0], 0).echo(CAPTURE, times)

    quiet = LAB.model_copy(update={"leakage": LeakageSpec(amplitude=0.0)})
    first = LAB.model_copy(update={"targets": LAB.targets[:split]})
    rest = quiet.model_copy(update={"targets": LAB.targets[split:]})
    np.testing.assert_allclose(echo(first) + echo(rest), echo(LAB), atol=1e-15)


@settings(max_examples=examples(20, 100))
@given(order=st.permutations(range(4)), seed=st.integers(0, 2**64 - 1))
def test_the_order_of_radars_changes_nothing(order: list[int], seed: int) -> None:
    shuffled = LAB.model_copy(update={"radars": tuple(LAB.radars[index] for index in order)})
    counters = np.array([0, 17])
    for place, index in enumerate(order):
        np.testing.assert_array_equal(
            echo_source(shuffled, place, seed).rf_counters(CAPTURE, counters, counters * STEP_NS),
            echo_source(LAB, index, seed).rf_counters(CAPTURE, counters, counters * STEP_NS),
        )


@given(seed=st.integers(0, 2**32), step=st.integers(0, 3456))
def test_counters_stay_in_their_range(seed: int, step: int) -> None:
    tight = replace(CAPTURE, dac_min=1000, dac_max=1040)
    counts = echo_source(LAB, 0, seed).rf_counters(
        tight, np.array([step]), np.array([step * STEP_NS])
    )
    assert counts.min() >= 0
    assert counts.max() <= 16 * 300 * 41


@pytest.mark.parametrize(("one", "other"), [(0, 1), (0, 2), (1, 3), (2, 3)])
def test_noise_of_two_radars_is_independent(one: int, other: int) -> None:
    """Same empty scene, so anything in common would be shared noise; fixed seed."""
    # clutter is independent too, but the same in all of these frames, which are 1 ns apart
    nothing = {"targets": (), "leakage": LeakageSpec(amplitude=0.0), "clutter": ClutterSpec()}
    empty = LAB.model_copy(update=nothing)
    counters = np.arange(400)
    a, b = (
        echo_source(empty, radar, 11).rf_counters(CAPTURE, counters, counters) * COUNT - 152 / 2048
        for radar in (one, other)
    )
    correlation = (a * b).mean() / (a.std() * b.std())
    assert abs(correlation) < 4 / np.sqrt(a.size)

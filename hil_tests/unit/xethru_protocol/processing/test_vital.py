"""Breathing: closed forms of a chest's echo, and emulated people with known truth."""

from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from hil_tests.bench.breathing import (
    ERROR_BPM,
    FRAME_RATE_HZ,
    RANGES_M,
    Case,
    answer,
    at_rest,
    baseband_of,
    nobody_at_rest,
)
from xethru_protocol.processing import vital
from xethru_protocol.processing.vital import (
    LEAST_CONFIDENCE,
    BreathingMonitor,
    breathing_rate,
    breathing_rates,
    circle_centre,
    phase_at,
)

RATE_HZ = 17.0
WAVELENGTH_M = 299_792_458 / 7.29e9
RANGES = 0.4 + 0.0514 * np.arange(60)
T_S = np.arange(1020) / RATE_HZ


def echo_of(
    displacement_m: NDArray[np.float64],
    range_m: float,
    *,
    amplitude: float = 0.01,
    still: complex = 0.02 - 0.01j,
    noise: float = 1e-4,
    seed: int = 0,
) -> NDArray[np.complex64]:
    """Return frames of one chest: its displacement is towards the radar."""
    rng = np.random.default_rng(seed)
    path_m = range_m - displacement_m[:, np.newaxis]
    pulse = np.exp(-(((RANGES - path_m) / 0.1) ** 2))
    iq = amplitude * pulse * np.exp(-4j * np.pi * path_m / WAVELENGTH_M)
    iq += still * np.exp(-(((RANGES - range_m - 0.05) / 0.2) ** 2))
    iq += noise * (rng.normal(size=iq.shape) + 1j * rng.normal(size=iq.shape))
    return np.asarray(iq, dtype=np.complex64)


def breath(rate_bpm: float, amplitude_m: float) -> NDArray[np.float64]:
    return amplitude_m * np.sin(2 * np.pi * rate_bpm / 60 * T_S)


@pytest.mark.parametrize("place", np.arange(8) / 16)
@pytest.mark.parametrize("amplitude_m", [0.0005, 0.004, 0.01])
def test_rate_at_every_place_of_the_chest(place: float, amplitude_m: float) -> None:
    """One component of the signal loses or doubles the rate once in a quarter of a wavelength."""
    range_m = 2.0 + place * WAVELENGTH_M
    found = breathing_rate(echo_of(breath(13.3, amplitude_m), range_m), RANGES, RATE_HZ)
    assert found is not None
    assert found.rate_bpm == pytest.approx(13.3, abs=0.1)
    assert found.range_m == pytest.approx(2.0, abs=0.11)
    assert found.confidence > 0.95


@pytest.mark.parametrize("second", [0.3, 0.45])
def test_a_strong_second_harmonic_is_no_doubled_rate(second: float) -> None:
    """Of 45 % in displacement, it has nearly the velocity of the fundamental."""
    chest = breath(9.0, 0.003) + breath(18.0, 0.003 * second)
    found = breathing_rate(echo_of(chest, 2.0), RANGES, RATE_HZ)
    assert found is not None
    assert found.rate_bpm == pytest.approx(9.0, abs=0.1)


def test_mean_rate_of_breathing_that_gets_slower() -> None:
    """From 18 to 12 breaths a minute within the window: 15 breaths."""
    turns = (18 * T_S - 3 * T_S**2 / 60) / 60
    found = breathing_rate(echo_of(0.003 * np.sin(2 * np.pi * turns), 2.0), RANGES, RATE_HZ)
    assert found is not None
    assert found.rate_bpm == pytest.approx(15.0, abs=0.25)


@pytest.mark.parametrize(
    "displacement_m",
    [
        pytest.param(0 * T_S, id="nothing moves"),
        pytest.param(breath(75, 0.003), id="faster than breath"),
        pytest.param(breath(3, 0.003), id="slower than breath"),
        pytest.param(breath(12, 0.3), id="to and fro"),
        pytest.param(0.01 * T_S, id="creeps"),
        pytest.param(
            0.002 * np.cumsum(np.random.default_rng(3).normal(size=1020)), id="random walk"
        ),
    ],
)
def test_other_movement_is_no_breathing(displacement_m: NDArray[np.float64]) -> None:
    assert breathing_rate(echo_of(displacement_m, 2.0), RANGES, RATE_HZ) is None


def test_noise_is_no_breathing() -> None:
    rng = np.random.default_rng(1)
    for _ in range(30):
        iq = rng.normal(size=(1020, 60)) + 1j * rng.normal(size=(1020, 60))
        assert breathing_rate(iq, RANGES, RATE_HZ) is None


@pytest.mark.parametrize("seed", range(4))
def test_an_echo_fainter_than_the_noise_has_a_rate(seed: int) -> None:
    """1 mm of amplitude turns this echo by 0.3 rad: 1e-4, as much as the noise of a component."""
    found = breathing_rate(
        echo_of(breath(13.3, 0.001), 2.0, amplitude=3e-4, seed=seed), RANGES, RATE_HZ
    )
    assert found is not None
    assert found.rate_bpm == pytest.approx(13.3, abs=0.2)
    assert found.range_m == pytest.approx(2.0, abs=0.11)
    assert LEAST_CONFIDENCE <= found.confidence <= 1.0


@pytest.mark.parametrize("amplitude", [3e-4, 0.01])
@pytest.mark.parametrize("frequency_hz", [5.9, 8.3])
def test_an_alias_of_a_fan_is_no_breathing(frequency_hz: float, amplitude: float) -> None:
    """Twice 8.3 Hz and three times 5.9 Hz look like 24 and 42 a minute."""
    chest = breath(60 * frequency_hz, 0.006)
    for seed in range(4):
        iq = echo_of(chest, 2.0, amplitude=amplitude, seed=seed)
        assert breathing_rate(iq, RANGES, RATE_HZ) is None


def test_a_harmonic_of_a_faint_curtain_is_no_breathing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice 4 a minute; without the rule about other lines it would be answered."""
    iq = [echo_of(breath(4, 0.006), 2.0, amplitude=3e-4, seed=seed) for seed in range(4)]
    assert [breathing_rate(frames, RANGES, RATE_HZ) for frames in iq] == [None] * 4
    monkeypatch.setattr(vital, "_OTHER_LINES", np.inf)
    assert any(breathing_rate(frames, RANGES, RATE_HZ) for frames in iq)


@pytest.mark.parametrize(("sway", "rate_hz"), [(0.0, 0.3), (1.5, None)])
def test_a_stronger_line_just_below_the_band_is_what_moves(
    sway: float, rate_hz: float | None
) -> None:
    """A sway of 4.2 a minute is no breath, and nobody's breath is answered beside it."""
    steps = np.sin(2 * np.pi * 0.3 * T_S) + sway * np.sin(2 * np.pi * 0.07 * T_S)
    noise = np.full(4 * len(steps) + 1, 0.4)
    found = vital._periodicity_in_noise(steps, noise, RATE_HZ)
    assert (found and found[0]) == (rate_hz and pytest.approx(rate_hz, abs=0.002))


def test_slow_noise_is_no_breathing() -> None:
    """Of a time constant of 2 s, as a receiver's drift."""
    rng = np.random.default_rng(2)
    for _ in range(30):
        noise = rng.normal(size=(1020, 60)) + 1j * rng.normal(size=(1020, 60))
        for before, after in pairwise(noise):
            after += 0.97 * before
        assert breathing_rate(noise, RANGES, RATE_HZ) is None


def test_two_people_have_a_rate_each() -> None:
    iq = echo_of(breath(12, 0.003), 1.2) + echo_of(breath(19, 0.003), 2.8, amplitude=0.004)
    strongest, other = list(breathing_rates(iq, RANGES, RATE_HZ))[:2]
    assert strongest.rate_bpm == pytest.approx(12, abs=0.1)
    assert strongest.range_m == pytest.approx(1.2, abs=0.06)
    assert other.rate_bpm == pytest.approx(19, abs=0.1)
    assert other.range_m == pytest.approx(2.8, abs=0.06)


def test_phase_is_that_of_the_displacement() -> None:
    """A displacement towards the radar of d turns the phase by 4 pi d / wavelength."""
    chest = breath(12, 0.004)
    phase = phase_at(echo_of(chest, 2.0, noise=1e-5), RANGES, 2.0)
    displacement_m = phase * WAVELENGTH_M / (4 * np.pi)
    expected = chest - chest.mean()
    np.testing.assert_allclose(displacement_m - displacement_m.mean(), expected, atol=2e-4)


@pytest.mark.parametrize("arc_rad", [0.6, 2.0, 6.0])
def test_centre_of_a_circle(arc_rad: float) -> None:
    angle = np.linspace(0, arc_rad, 500)
    points = 3 - 4j + 2 * np.exp(1j * angle)
    assert circle_centre(points) == pytest.approx(3 - 4j, abs=1e-6)
    rng = np.random.default_rng(0)
    noisy = points + 0.02 * (rng.normal(size=500) + 1j * rng.normal(size=500))
    assert circle_centre(noisy) == pytest.approx(3 - 4j, abs=0.25)


def test_stream_and_batch_give_the_same_numbers() -> None:
    case = at_rest(1, 2.0, "facing")
    iq, ranges_m = baseband_of(case.scene, case.seed, case.start_ns, seconds=33)
    monitor = BreathingMonitor(ranges_m, FRAME_RATE_HZ, window_s=30, every_s=1)
    window = int(np.ceil(30 * FRAME_RATE_HZ))
    answers = 0
    for count, frame in enumerate(iq, start=1):
        found = monitor.update(frame)
        if count < window:
            assert found is None
        elif (count - window) % 17 == 0:
            expected = breathing_rate(iq[count - window : count], ranges_m, FRAME_RATE_HZ)
            assert expected is not None
            assert found is not None
            assert found.rate_bpm == pytest.approx(expected.rate_bpm, abs=1e-6)
            assert found.confidence == pytest.approx(expected.confidence, abs=1e-6)
            assert found.range_m == expected.range_m
            answers += 1
    assert answers == 4
    monitor.reset()
    assert monitor.update(iq[0]) is None


def test_baseband_of_the_module_and_of_rf_frames_have_the_same_rate() -> None:
    case = at_rest(2, 2.0, "facing")
    answers = [answer(case, rf=rf) for rf in (False, True)]
    for found in answers:
        assert found is not None
        assert found.rate_bpm == pytest.approx(case.rate_bpm, abs=ERROR_BPM)


def wrong(case: Case) -> str | None:
    """Return what is wrong about the answer to a case, None if nothing is."""
    found = answer(case)
    if case.rate_bpm is None:
        return None if found is None else f"seed {case.seed}: {found}, and nobody rests"
    if found is None or abs(found.rate_bpm - case.rate_bpm) > ERROR_BPM:
        return f"seed {case.seed}, {case.range_m} m: {found} for {case.rate_bpm}"
    return None


def test_emulated_people_at_rest_are_heard() -> None:
    cases = [at_rest(500, range_m, "facing") for range_m in RANGES_M]
    assert [text for case in cases if (text := wrong(case))] == []


@pytest.mark.parametrize("kind", ["empty room", "fan", "curtain", "walking"])
def test_emulated_rooms_without_anybody_at_rest_have_no_answer(kind: str) -> None:
    cases = [nobody_at_rest(500 + number, kind) for number in range(2)]
    assert [text for case in cases if (text := wrong(case))] == []


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize("posture", ["facing", "side", "back", "supine", "on a side"])
def test_share_of_right_answers(posture: str) -> None:
    cases = [at_rest(600 + n, range_m, posture) for range_m in RANGES_M for n in range(12)]
    assert len([case for case in cases if wrong(case)]) <= 0.05 * len(cases)


@pytest.mark.thorough
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["empty room", "fan", "curtain", "walking"])
def test_share_of_false_answers(kind: str) -> None:
    cases = [nobody_at_rest(600 + number, kind) for number in range(100)]
    assert len([case for case in cases if wrong(case)]) <= 1


@pytest.mark.parametrize(
    ("shape", "rate_hz", "match"),
    [((1020, 59), 17.0, "60 ranges"), ((300, 60), 17.0, "20 s"), ((1020, 60), 3.0, "at least 4")],
)
def test_what_has_no_rate_raises(shape: tuple[int, int], rate_hz: float, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        breathing_rate(np.ones(shape, dtype=np.complex64), RANGES, rate_hz)

"""Pulse-Doppler matrices and noise maps against closed forms of a breathing or walking point."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import jv

from hil_tests.unit.emulator.profiles.doubles import (
    BIN_M,
    FRAME_HZ,
    SECOND,
    heard_until,
    profile,
    room,
    standing,
    walking,
)
from xethru_protocol.wire import messages as m
from xethru_protocol.wire.codes import OutputFeature

C_MPS = 299_792_458.0
WAVELENGTH_M = C_MPS / 7.29e9
SLOW, FAST = 1, 2  # bits of the control; instances 0 and 1


def matrices(scene: Any, outputs: dict[int, int], end_s: float) -> list[list[Any]]:  # noqa: ANN401 - rows differ in type
    """Return complete matrices in order of arrival, each a list of messages by range."""
    stream, _ = profile(scene, outputs=outputs)
    kinds: dict[tuple[type, int], list[Any]] = {}
    complete = []
    for _, message in heard_until(stream, round(end_s * SECOND)):
        assert isinstance(
            message, m.PulseDopplerFloat | m.PulseDopplerByte | m.NoiseMapFloat | m.NoiseMapByte
        )
        rows = kinds.setdefault((type(message), message.pulsedoppler_instance), [])
        assert message.range_idx == len(rows)
        rows.append(message)
        if message.range_idx == message.range_bins - 1:
            complete.append(rows.copy())
            rows.clear()
    return complete


def frequencies(message: Any) -> NDArray[np.float64]:  # noqa: ANN401 - rows differ in type
    steps = np.arange(message.frequency_count) * message.frequency_step_hz
    return np.asarray(message.frequency_start_hz + steps, dtype=np.float64)


def test_a_breathing_person_is_a_line_spectrum_at_its_range_and_rate() -> None:
    """Phase modulation by 2 k a sin(2 pi f t) has lines at n f of power J_n(2 k a)**2."""
    breath_hz = 5 * FRAME_HZ / 4 / 85  # on a frequency of the matrix
    amplitude_m = 0.004
    person = standing(3.0, breaths_per_min=60 * breath_hz, breath_amplitude_m=amplitude_m)
    (matrix, *_) = matrices(
        room(person, quiet=True), {OutputFeature.PULSEDOPPLER_FLOAT: SLOW}, 25.5
    )
    power = np.array([row.power for row in matrix])
    steps = np.rint(frequencies(matrix[0]) / matrix[0].frequency_step_hz).astype(int)
    moving = np.abs(steps) > 1
    at_bin, at = np.unravel_index(np.argmax(np.where(moving, power, 0)), power.shape)
    assert matrix[int(at_bin)].range_m == pytest.approx(3.0 * 3.0e8 / C_MPS, abs=0.6 * BIN_M)
    assert abs(steps[at]) == 5
    assert abs(frequencies(matrix[0])[at]) == pytest.approx(breath_hz, rel=1e-5)
    lines = {step: power[at_bin, index] for index, step in enumerate(steps.tolist())}
    index_of_modulation = 4 * math.pi * amplitude_m / WAVELENGTH_M
    for n in (1, 2):
        expected = (jv(n, index_of_modulation) / jv(0, index_of_modulation)) ** 2
        for sign in (-1, 1):
            assert lines[sign * 5 * n] / lines[0] == pytest.approx(expected, rel=0.12)


@pytest.mark.parametrize(("start_m", "end_m", "sign"), [(4.0, 2.0, 1), (2.0, 4.0, -1)])
def test_a_slow_walker_shows_its_radial_speed(start_m: float, end_m: float, sign: int) -> None:
    """Doppler 2 v / wavelength, positive on approach: 0.12 m/s is 5.84 Hz."""
    person = walking(start_m, end_m, speed_mps=0.12, breath_amplitude_m=0.0)
    *_, last = matrices(room(person, quiet=True), {OutputFeature.PULSEDOPPLER_FLOAT: FAST}, 8.0)
    power = np.array([row.power for row in last])
    at_bin, at = np.unravel_index(np.argmax(power), power.shape)
    assert frequencies(last[0])[at] == pytest.approx(
        sign * 2 * 0.12 / WAVELENGTH_M, abs=last[0].frequency_step_hz
    )
    # the Hann window's centre lies a second before the newest frame
    middle_s = last[0].counter / FRAME_HZ - 17 / FRAME_HZ
    expected_m = start_m + math.copysign(0.12, end_m - start_m) * middle_s
    assert last[int(at_bin)].range_m == pytest.approx(expected_m, abs=1.5 * BIN_M)


@pytest.mark.parametrize(
    ("control", "decimation", "pulses", "first_s", "period_s"),
    [(SLOW, 4, 85, 340 / FRAME_HZ, 85 / FRAME_HZ), (FAST, 1, 34, 34 / FRAME_HZ, 17 / FRAME_HZ)],
)
def test_the_fields_of_a_matrix(
    control: int, decimation: int, pulses: int, first_s: float, period_s: float
) -> None:
    """Protocol reference 7.2; when it is full, and how often it comes."""
    stream, _ = profile(room(), outputs={OutputFeature.PULSEDOPPLER_FLOAT: control})
    heard = list(heard_until(stream, round((first_s + 2.9 * period_s) * SECOND)))
    firsts = [(due_s, one) for due_s, one in heard if getattr(one, "range_idx", 1) == 0]
    assert [due_s for due_s, _ in firsts] == pytest.approx(
        [first_s - 1 / FRAME_HZ + k * period_s for k in range(3)], abs=1e-3
    )
    message = firsts[0][1]
    assert isinstance(message, m.PulseDopplerFloat)
    assert message.pulsedoppler_instance == control - 1
    assert message.fps == pytest.approx(FRAME_HZ)
    assert message.fps_decimated == pytest.approx(FRAME_HZ / decimation)
    assert message.frequency_count == pulses == len(message.power)
    assert message.frequency_step_hz == pytest.approx(FRAME_HZ / decimation / pulses)
    assert np.abs(frequencies(message)).min() == pytest.approx(0, abs=1e-5)
    counters = [one.matrix_counter for _, one in firsts if isinstance(one, m.PulseDopplerFloat)]
    assert counters == list(range(counters[0], counters[0] + 3))


def test_a_matrix_is_spread_over_the_frames_until_the_next() -> None:
    """Protocol reference 8.4: the module's queue has 50 slots."""
    outputs = {int(OutputFeature.PULSEDOPPLER_FLOAT): SLOW | FAST}
    outputs[int(OutputFeature.NOISEMAP_BYTE)] = SLOW | FAST
    stream, _ = profile(room(), outputs=outputs)
    by_time: dict[float, int] = {}
    for due_s, _ in heard_until(stream, 30 * SECOND):
        by_time[due_s] = by_time.get(due_s, 0) + 1
    assert max(by_time.values()) <= 40


@pytest.mark.parametrize(
    ("as_float", "as_byte"),
    [
        (OutputFeature.PULSEDOPPLER_FLOAT, OutputFeature.PULSEDOPPLER_BYTE),
        (OutputFeature.NOISEMAP_FLOAT, OutputFeature.NOISEMAP_BYTE),
    ],
)
@pytest.mark.parametrize("control", [SLOW, FAST])
def test_bytes_agree_with_floats_within_half_a_step(
    as_float: OutputFeature, as_byte: OutputFeature, control: int
) -> None:
    """Protocol reference 7.2: 10**((start + byte size) / 10)."""
    scene = room(standing(2.0))
    (floats, *_) = matrices(scene, {as_float: control}, 26)
    (levels, *_) = matrices(scene, {as_byte: control}, 26)
    compared = 0
    for one, other in zip(floats, levels, strict=True):
        assert (one.counter, one.range_m) == (other.counter, other.range_m)
        half_step_db = other.byte_step_size_db / 2
        inside = np.frombuffer(other.levels, dtype=np.uint8) > 0
        difference_db = 10 * np.log10(other.power / one.power)
        assert np.abs(difference_db[inside]).max(initial=0.0) <= half_step_db * 1.001
        compared += int(inside.sum())
    assert compared > 0.9 * len(floats) * floats[0].frequency_count


def test_the_default_noise_map_is_the_receiver_noise_of_an_empty_room() -> None:
    """The map of the first tick against the mean power of that room's matrix."""
    outputs = {int(OutputFeature.NOISEMAP_FLOAT): FAST, int(OutputFeature.PULSEDOPPLER_FLOAT): FAST}
    *_, second, last = matrices(room(), outputs, 22)
    maps = last if isinstance(last[0], m.NoiseMapFloat) else second
    measured = second if maps is last else last
    far = [index for index, row in enumerate(maps) if row.range_m > 1.0]
    expected = np.mean([measured[index].power for index in far])
    assert np.mean([maps[index].power for index in far]) == pytest.approx(expected, rel=0.05)

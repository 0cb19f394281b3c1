"""Presence: its false alarms in noise, its threshold's closed form, emulated rooms."""

import numpy as np
import pytest
import scipy.stats
from numpy.typing import NDArray

from emulator.scene.people import PersonSpec
from hil_tests.bench.breathing import FRAME_RATE_HZ, baseband_of, nobody_at_rest, room, somebody
from xethru_protocol.processing.presence import PresenceMonitor, _threshold, presence

RATE_HZ = 17.0
RANGES = 0.4 + 0.0514 * np.arange(90)


def noise(rng: np.random.Generator) -> NDArray[np.complex128]:
    return np.asarray(rng.normal(size=(170, 90)) + 1j * rng.normal(size=(170, 90)))


def test_false_alarms_in_white_noise() -> None:
    """Near the nominal rate, within three standard deviations of a binomial count.

    The nominal rate is not a bound: noise that is estimated adds false alarms.
    """
    rng = np.random.default_rng(4)
    alarms = sum(
        presence(noise(rng), RANGES, RATE_HZ, false_alarm_rate=0.05).present for _ in range(400)
    )
    assert alarms == pytest.approx(400 * 0.05, abs=3 * np.sqrt(400 * 0.05))


@pytest.mark.parametrize("frequencies", [10, 80, 160])
@pytest.mark.parametrize("probability", [1e-3, 1e-6])
def test_threshold_is_a_quantile_of_the_gamma_distribution(
    frequencies: int, probability: float
) -> None:
    shape = frequencies / (1 + 2 * (4 / 9 + 1 / 36))
    expected = scipy.stats.gamma.isf(probability, shape, scale=1 / shape)
    assert _threshold(frequencies, probability) == pytest.approx(expected, rel=0.04)


def test_a_nan_is_not_nobody() -> None:
    iq = noise(np.random.default_rng(1))
    iq[7, 3] = np.nan
    with pytest.raises(ValueError, match="1 of 170 frames hold NaN"):
        presence(iq, RANGES, RATE_HZ)


def case(kind: str, number: int) -> tuple[NDArray[np.complex64], NDArray[np.float64]]:
    if kind == "empty room":
        empty = nobody_at_rest(700 + number, kind)
        return baseband_of(empty.scene, empty.seed, empty.start_ns, seconds=40)
    rng = np.random.default_rng(700 + number)
    places = [(2.5, 0.2)] if kind == "at rest" else [(1.0, -0.5), (3.5, 0.8)]
    person: PersonSpec = somebody(rng, waypoints_m=places, walk="to_and_fro")
    return baseband_of(room(rng, people=(person,)), number, seconds=40)


@pytest.mark.parametrize("number", range(3))
@pytest.mark.parametrize("kind", ["empty room", "at rest", "walking"])
def test_emulated_rooms(kind: str, number: int) -> None:
    iq, ranges_m = case(kind, number)
    for start in range(0, len(iq) - 170, 170):
        found = presence(iq[start : start + 170], ranges_m, FRAME_RATE_HZ)
        assert found.present == (kind != "empty room")
        if kind == "at rest":
            assert found.range_m == pytest.approx(2.51, abs=0.11)
            assert not found.moving
        if kind == "walking":
            assert found.moving


def test_stream_and_batch_give_the_same_numbers() -> None:
    iq, ranges_m = case("at rest", 0)
    monitor = PresenceMonitor(ranges_m, FRAME_RATE_HZ, window_s=10, every_s=2)
    for count, frame in enumerate(iq[:300], start=1):
        found = monitor.update(frame)
        if count < 171:
            assert found is None
        elif (count - 171) % 34 == 0:
            assert found == presence(iq[count - 171 : count], ranges_m, FRAME_RATE_HZ)


@pytest.mark.parametrize(
    ("shape", "rate", "match"),
    [((170, 15), 1e-3, "16 bins"), ((80, 90), 1e-3, "5 s"), ((170, 90), 1.0, "false_alarm_rate")],
)
def test_what_has_no_answer_raises(shape: tuple[int, int], rate: float, match: str) -> None:
    iq = np.ones(shape, dtype=np.complex64)
    with pytest.raises(ValueError, match=match):
        presence(iq, RANGES[: shape[1]], RATE_HZ, false_alarm_rate=rate)

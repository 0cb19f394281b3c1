"""Pulses of modules that are not synchronised: their mean over a sweep, and their drift."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from emulator.echo.echo import SceneEcho
from emulator.echo.other_modules import mean_of_drifting_pulses
from emulator.scene.scene import OtherModuleSpec
from hil_tests.unit.emulator.rooms import C_MPS, PAPER, radar_at, room
from xethru_protocol.wire.x4 import CARRIER_HZ, FRAME_SAMPLES, SAMPLING_RATE_HZ

N_SAMPLES = 400
ENVELOPE_SAMPLES = math.sqrt(math.log(10)) / (math.pi * 1.4e9) * SAMPLING_RATE_HZ
NOW = np.array([0], dtype=np.int64)


def pulse(x: NDArray[np.float64], phase_rad: float, setting: int) -> NDArray[np.float64]:
    carrier = 2 * np.pi * CARRIER_HZ[setting] / SAMPLING_RATE_HZ
    bell: NDArray[np.float64] = np.exp(-0.5 * (x / ENVELOPE_SAMPLES) ** 2)
    return bell * np.cos(carrier * x + phase_rad)


@pytest.mark.parametrize(
    ("setting", "drift"),
    [
        *((3, drift) for drift in (0.0, 0.3, -0.9, 1.1, 7.0, -40.0, 333.3)),
        (4, 1.1),
        *(pytest.param(4, d, marks=pytest.mark.rare) for d in (0.0, 0.3, -0.9, 7.0, -40.0, 333.3)),
    ],
)
@pytest.mark.parametrize("position", [150.25, 3.0, -20.0])
def test_the_mean_is_that_of_many_pulses(setting: int, drift: float, position: float) -> None:
    got = mean_of_drifting_pulses(
        position=np.array([position]),
        drift=drift,
        amplitude=np.array([0.5]),
        phase_rad=0.7,
        tx_center_frequency=setting,
        n_samples=N_SAMPLES,
    )[0]
    many = 2000 + round(60 * abs(drift))
    steps = (np.arange(many) + 0.5) / many  # of the midpoint rule
    n = np.arange(N_SAMPLES)[:, np.newaxis]
    expected = 0.5 * pulse(n - position - drift * steps, 0.7, setting).mean(axis=1)
    np.testing.assert_allclose(got, expected, atol=5e-7 * 0.5)


def test_a_long_drift_leaves_two_pulses_and_comes_in_again() -> None:
    drift = 1.25 * FRAME_SAMPLES
    got = mean_of_drifting_pulses(
        position=np.array([100.0]),
        drift=drift,
        amplitude=np.array([1.0]),
        phase_rad=0.0,
        tx_center_frequency=3,
        n_samples=FRAME_SAMPLES,
    )[0]
    ends = np.zeros(FRAME_SAMPLES, dtype=bool)
    for end in (100.0, (100.0 + drift) % FRAME_SAMPLES):
        ends |= np.abs(np.arange(FRAME_SAMPLES) - end) < 50
    assert np.abs(got[~ends]).max() < 1e-9
    # a cosine's integral is its sine over k, where the envelope varies slowly
    carrier = 2 * np.pi * CARRIER_HZ[3] / SAMPLING_RATE_HZ
    assert np.abs(got).max() == pytest.approx(1 / (carrier * drift), rel=0.1)


def centre(frame: NDArray[np.float64]) -> float:
    """Return where the energy of a frame lies, in samples."""
    return float((np.arange(len(frame)) * frame**2).sum() / (frame**2).sum())


def frames(module: OtherModuleSpec, times_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return what the radar receives of a module, without its offset and in counts' units."""
    radar = radar_at(0.0, 0.0, 0.0)
    counters = [
        SceneEcho(room(radar, other_modules=modules), radar, 0).rf_counters(
            PAPER, np.arange(len(times_ns)), times_ns
        )
        for modules in ((module,), ())
    ]
    return (counters[0] - counters[1]) / 2.0**10 / (PAPER.iterations * PAPER.pulses_per_step)


def test_its_strength_is_that_of_a_wave_that_goes_one_way() -> None:
    other = OtherModuleSpec(name="other_1", x_m=4.0, y_m=0.0, amplitude_1m=0.2)
    beside = OtherModuleSpec(
        name="other_1", x_m=4.0 * math.cos(0.5), y_m=4.0 * math.sin(0.5), amplitude_1m=0.2
    )
    straight, aside = (np.abs(frames(each, NOW)).max() for each in (other, beside))
    assert straight == pytest.approx(0.05, rel=0.03)  # the carrier's samples miss its peak a little
    exponent = math.log(math.sqrt(0.5)) / math.log(math.cos(math.radians(32.5)))
    assert aside / straight == pytest.approx(math.cos(0.5) ** (exponent / 2), rel=1e-3)


def test_it_drifts_by_the_difference_of_the_clocks_and_its_distance_counts_once() -> None:
    still = OtherModuleSpec(name="other_1", x_m=4.0, y_m=0.0, amplitude_1m=0.2)
    farther = still.model_copy(update={"x_m": 4.3})
    one, two = (centre(frames(each, NOW)[0]) for each in (still, farther))
    assert two - one == pytest.approx(0.3 / C_MPS * SAMPLING_RATE_HZ, abs=0.02)
    # 1e-5 ppm are 0.23 samples a second, and a hundredth of that in a sweep of 48 ms
    slow = still.model_copy(update={"clock_ppm": -1e-5})
    drifted = frames(slow, np.array([0, 200_000_000_000], dtype=np.int64))
    moved = centre(drifted[1]) - centre(drifted[0])
    assert moved == pytest.approx(1e-11 * 200 * SAMPLING_RATE_HZ, abs=0.1)

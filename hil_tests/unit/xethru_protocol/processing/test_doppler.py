"""Range-Doppler maps and spectrograms: closed forms of tones, scipy's spectrogram, signs."""

from collections.abc import Callable

import numpy as np
import pytest
import scipy.signal
from numpy.typing import NDArray

from xethru_protocol.processing.doppler import range_doppler, spectrogram
from xethru_protocol.processing.presence import PresenceMonitor
from xethru_protocol.processing.vital import BreathingMonitor, phase_at

RATE_HZ = 17.0
WAVELENGTH_M = 299_792_458 / 7.29e9


def test_a_tone_reads_its_amplitude_squared_at_its_frequency() -> None:
    t = np.arange(170) / RATE_HZ
    iq = np.zeros((170, 5), dtype=np.complex64)
    iq[:, 3] = 0.2 * np.exp(-2j * np.pi * 1.5 * t)
    found = range_doppler(iq, RATE_HZ)
    row, column = np.unravel_index(np.argmax(found.power), found.power.shape)
    assert column == 3
    assert found.frequencies_hz[row] == pytest.approx(-1.5)
    assert found.power[row, column] == pytest.approx(0.04, rel=1e-4)
    # the transform of a Hann window: a quarter of the power one step beside, nothing at two
    assert found.power[row + 1, column] == pytest.approx(0.01, rel=1e-4)
    assert found.power[row + 2, column] < 1e-10


def test_what_comes_nearer_has_a_positive_velocity() -> None:
    """Phase is -4 pi R / wavelength: protocol reference 9.8."""
    range_m = 2.0 - 0.05 * np.arange(128) / RATE_HZ
    iq = np.exp(-4j * np.pi * range_m / WAVELENGTH_M)[:, np.newaxis]
    found = range_doppler(iq, RATE_HZ, n_frequencies=4096)
    velocity = found.velocities_mps[np.argmax(found.power[:, 0])]
    assert velocity == pytest.approx(0.05, abs=1e-4)


def noise(n: int) -> NDArray[np.complex128]:
    rng = np.random.default_rng(3)
    return np.asarray(rng.normal(size=n) + 1j * rng.normal(size=n))


def test_spectrogram_is_scipys() -> None:
    iq = noise(300)
    found = spectrogram(iq, RATE_HZ, window=64, step=16)
    frequency, times, power = scipy.signal.spectrogram(
        iq,
        RATE_HZ,
        window="hann",
        nperseg=64,
        noverlap=48,
        detrend=False,
        return_onesided=False,
        scaling="spectrum",
    )
    np.testing.assert_allclose(found.power, np.fft.fftshift(power, axes=0).T, rtol=1e-9)
    np.testing.assert_allclose(found.frequencies_hz, np.fft.fftshift(frequency), atol=1e-12)
    np.testing.assert_allclose(found.times_s, times)


def test_what_is_too_short_raises() -> None:
    with pytest.raises(ValueError, match="63 frames"):
        spectrogram(noise(63), RATE_HZ)
    with pytest.raises(ValueError, match="at least 2"):
        range_doppler(np.ones((1, 4)), RATE_HZ)
    with pytest.raises(ValueError, match="n_frequencies 8"):
        range_doppler(np.ones((9, 4)), RATE_HZ, n_frequencies=8)


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("nan"), float("inf")])
def test_a_rate_that_is_none_raises(rate_hz: float) -> None:
    ranges_m = np.linspace(0.4, 5, 20)
    calls: list[Callable[[], object]] = [
        lambda: range_doppler(np.ones((9, 4)), rate_hz),
        lambda: spectrogram(noise(64), rate_hz),
        lambda: BreathingMonitor(ranges_m, rate_hz),
        lambda: PresenceMonitor(ranges_m, rate_hz),
    ]
    for call in calls:
        with pytest.raises(ValueError, match="frame_rate_hz"):
            call()


def test_arguments_out_of_range_are_named() -> None:
    calls: dict[str, Callable[[], object]] = {
        "window 1": lambda: spectrogram(noise(64), RATE_HZ, window=1),
        "window -1": lambda: spectrogram(noise(64), RATE_HZ, window=-1),
        "step 0": lambda: spectrogram(noise(64), RATE_HZ, step=0),
        "step -1": lambda: spectrogram(noise(64), RATE_HZ, step=-1),
        "carrier_hz 0": lambda: range_doppler(np.ones((9, 4)), RATE_HZ, carrier_hz=0),
        "n_bins": lambda: range_doppler(np.ones(9), RATE_HZ),
        "n_frames": lambda: spectrogram(np.ones((64, 2)), RATE_HZ),
        "window_s inf": lambda: PresenceMonitor(np.ones(20), RATE_HZ, window_s=float("inf")),
        "window_s 0": lambda: PresenceMonitor(np.ones(20), RATE_HZ, window_s=0),
        "every_s nan": lambda: BreathingMonitor(np.ones(20), RATE_HZ, every_s=float("nan")),
        "9 of 9 frames hold NaN": lambda: phase_at(np.full((9, 4), np.nan + 0j), np.ones(4), 1.0),
        r"\(9, 0\)": lambda: phase_at(np.ones((9, 0), complex), np.ones(0), 1.0),
    }
    for match, call in calls.items():
        with pytest.raises(ValueError, match=match):
            call()

"""Recordings by closed form: what one sphere does to complex baseband, and noise."""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FRAME_RATE_HZ = 17.0
RANGES_M = np.arange(0.4, 5.0, 0.0514)
CARRIERS_HZ = {3: 7.29e9, 4: 8.748e9}  # by TXCENTERFREQUENCY: protocol reference 9.2
PULSE_M = 0.12
NOISE = 1e-4


def target(range_m: NDArray[np.float64], tx_center_frequency: int = 3) -> NDArray[np.complex64]:
    """Echo of amplitude 0.01 at a range per frame, shape (n_frames, n_bins), and noise."""
    wavelength_m = 299_792_458 / CARRIERS_HZ[tx_center_frequency]
    away = RANGES_M[np.newaxis] - range_m[:, np.newaxis]
    phase = np.exp(-4j * np.pi * range_m[:, np.newaxis] / wavelength_m)
    echo: NDArray[np.complex128] = 0.01 * np.exp(-((away / PULSE_M) ** 2)) * phase
    return (echo + noise(len(range_m))).astype(np.complex64)


def noise(n_frames: int) -> NDArray[np.complex128]:
    random = np.random.default_rng(7)
    shape = n_frames, len(RANGES_M)
    parts: NDArray[np.complex128] = random.standard_normal((*shape, 2)).view(np.complex128)
    return NOISE * parts[..., 0]


def times_s(seconds: float) -> NDArray[np.float64]:
    return np.arange(round(seconds * FRAME_RATE_HZ)) / FRAME_RATE_HZ


def breathing(
    seconds: float, *, range_m: float = 1.5, rate_bpm: float = 15.0
) -> NDArray[np.float64]:
    """Range of a chest that moves by 8 mm."""
    return range_m + 4e-3 * np.sin(2 * np.pi * rate_bpm / 60 * times_s(seconds))


def recording(path: Path, iq: NDArray[np.complex64], tx_center_frequency: int = 3) -> Path:
    settings = json.dumps({"TXCENTERFREQUENCY": tx_center_frequency})
    np.savez(path, iq=iq, ranges_m=RANGES_M, frame_rate_hz=FRAME_RATE_HZ, settings=settings)
    return path

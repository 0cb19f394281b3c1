"""Where the echoes of a radar lie: the arc that they come from, and their envelope in range."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slam.geometry import FieldOfView
from slam.live.session_records import RadarInfo
from xethru_protocol.wire.x4 import CARRIER_HZ, SPEED_OF_LIGHT_MPS

_ARC_POINTS = 17

_CARRIER_HZ = CARRIER_HZ[3]  # as modules are switched on
_LEAST_POWER = np.float32(1e-12)  # -120 dB of full scale, far below any receiver's noise


def arcs(
    field: FieldOfView, radar: RadarInfo, ranges_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return where echoes of these ranges (n,) may come from: shape (n, 17, 2), body frame."""
    half = field.opening_rad / 2
    angles_rad = radar.yaw_rad + np.linspace(-half, half, _ARC_POINTS)
    ray = np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=-1)
    antenna = np.array([radar.x_m, radar.y_m])
    points: NDArray[np.float64] = antenna + ranges_m[:, None, None] * ray
    return points


def wedge(field: FieldOfView, radar: RadarInfo) -> NDArray[np.float64]:
    """Return the closed outline of a field of view, shape (19, 2), body frame."""
    antenna = np.array([[radar.x_m, radar.y_m]])
    (rim,) = arcs(field, radar, np.array([field.max_range_m]))
    return np.concatenate([antenna, rim, antenna])


def envelope_db(echoes: NDArray[np.float32], bin_length_m: float) -> NDArray[np.float32]:
    """Return the envelope of raw RF without its first and last bin, in decibels of full scale.

    `echoes` has shape (n_frames, n_bins), the constant part removed; the result (n_frames,
    n_bins - 2), -120 dB or more. The quadrature of the pulse comes from the central difference of
    the samples, which for a carrier of w radians per sample is its Hilbert partner times 2 sin w.
    """
    phase_step_rad = 2.0 * np.pi * _CARRIER_HZ * 2.0 * bin_length_m / SPEED_OF_LIGHT_MPS
    quadrature = (echoes[:, 2:] - echoes[:, :-2]) / np.float32(2.0 * np.sin(phase_step_rad))
    power = echoes[:, 1:-1] ** 2 + quadrature**2
    level_db: NDArray[np.float32] = np.float32(10.0) * np.log10(np.maximum(power, _LEAST_POWER))
    return level_db


# What the paper's front end looks at and a little beyond, from the receiver's noise (5.6e-4 per
# sample, so an envelope of -62 dB) to a near rod.
_SHOWN_RANGE_M = 3.0
_FLOOR_DB, _TOP_DB = -62.0, -30.0


def bscan_picture(
    frames: NDArray[np.float32], range_start_m: float, bin_length_m: float
) -> NDArray[np.uint8]:
    """Draw echoes as grey levels: constant part removed, envelope, decibels.

    `frames` is raw RF, shape (n_frames, n_bins), slow time downwards, with true metres of the first
    bin and between two bins. The result has shape (n_frames, n_shown - 2), up to 3 m of range; 0 is
    -62 dB of full scale or less, 255 is -30 dB or more.
    """
    n_shown = n_shown_bins(frames.shape[1], range_start_m, bin_length_m)
    echoes = frames[:, :n_shown] - frames[:, :n_shown].mean(axis=0)
    level_db = envelope_db(echoes, bin_length_m)
    scaled = (level_db - _FLOOR_DB) / (_TOP_DB - _FLOOR_DB)
    picture: NDArray[np.uint8] = (np.clip(scaled, 0.0, 1.0) * 255.0).astype(np.uint8)
    return picture


def n_shown_bins(n_bins: int, range_start_m: float, bin_length_m: float) -> int:
    """Return how many bins of a frame pictures show: up to 3 m of range."""
    return min(n_bins, max(int((_SHOWN_RANGE_M - range_start_m) / bin_length_m), 3))

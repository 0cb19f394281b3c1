"""B-scans: many frames of one radar as a picture, range against time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_CARRIER_HZ = 7.29e9
_LIGHT_MPS = 299_792_458.0

# What the paper's front end looks at and a little beyond, from the receiver's noise (5.6e-4 per
# sample, so an envelope of -62 dB) to a near rod.
_SHOWN_RANGE_M = 3.0
_FLOOR_DB, _TOP_DB = -62.0, -30.0


def bscan_picture(
    frames: NDArray[np.float32], range_start_m: float, bin_length_m: float
) -> NDArray[np.uint8]:
    """Draw echoes as grey levels: constant part removed, envelope, decibels.

    Parameters
    ----------
    frames
        Shape (n_frames, n_bins), raw RF, slow time downwards.
    range_start_m, bin_length_m
        True metres of the first bin and between two bins.

    Returns
    -------
    Shape (n_frames, n_shown - 2), up to 3 m of range; 0 is -62 dB of full scale or less, 255 is
    -30 dB or more. The quadrature of the pulse comes from the central difference of the samples,
    which for a carrier of w radians per sample is its Hilbert partner times 2 sin w.
    """
    n_wanted = int((_SHOWN_RANGE_M - range_start_m) / bin_length_m)
    n_shown = min(frames.shape[1], max(n_wanted, 3))
    echoes = frames[:, :n_shown] - frames[:, :n_shown].mean(axis=0)
    phase_step_rad = 2.0 * np.pi * _CARRIER_HZ * 2.0 * bin_length_m / _LIGHT_MPS
    quadrature = (echoes[:, 2:] - echoes[:, :-2]) / np.float32(2.0 * np.sin(phase_step_rad))
    power = echoes[:, 1:-1] ** 2 + quadrature**2
    level_db = 10.0 * np.log10(np.maximum(power, np.float32(1e-12)))
    scaled = (level_db - _FLOOR_DB) / (_TOP_DB - _FLOOR_DB)
    picture: NDArray[np.uint8] = (np.clip(scaled, 0.0, 1.0) * 255.0).astype(np.uint8)
    return picture

"""What back-projection does for every point and profile, compiled."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from slam.front_end.numba_compilation import kernel

Array = NDArray[np.float64]


@kernel(
    "void(complex64[:, ::1], float64, float64, float64, float64[:, ::1], float64[:, ::1], "
    "float64, float64, float64, float64[:, ::1], complex128[::1], complex128[::1], "
    "float64[::1], int64[::1])"
)
def sum_profiles(
    values: NDArray[np.complex64],
    start_m: float,
    bin_m: float,
    wave_number: float,
    antennas: Array,
    boresights: Array,
    cos_half_beam: float,
    min_m: float,
    max_m: float,
    points: Array,
    turns: NDArray[np.complex128],
    total: NDArray[np.complex128],
    power: Array,
    count: NDArray[np.int64],
) -> None:
    """Add what profiles (frames, bins) have at points to their sums; see `back_project`.

    Antennas, boresights and points have shape (n, 3); ``turns`` is exp(j x) at equal steps of one
    turn, their number a power of two.
    """
    last = values.shape[1] - 1
    per_bin = 1.0 / bin_m
    per_m = wave_number / (2.0 * math.pi) * turns.shape[0]
    mask = turns.shape[0] - 1
    for f in range(antennas.shape[0]):
        x, y, z = antennas[f, 0], antennas[f, 1], antennas[f, 2]
        bx, by, bz = boresights[f, 0], boresights[f, 1], boresights[f, 2]
        for i in range(points.shape[0]):
            dx, dy, dz = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
            square = dx * dx + dy * dy + dz * dz
            if square < min_m * min_m or square > max_m * max_m:
                continue
            range_m = math.sqrt(square)
            if dx * bx + dy * by + dz * bz < cos_half_beam * range_m:
                continue
            at = (range_m - start_m) * per_bin
            if at < 0.0 or at >= last:
                continue
            low = int(at)
            part = at - low
            value = (1.0 - part) * values[f, low] + part * values[f, low + 1]
            value *= turns[int(range_m * per_m + 0.5) & mask]
            total[i] += value
            power[i] += value.real * value.real + value.imag * value.imag
            count[i] += 1

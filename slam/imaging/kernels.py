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
    """Write the sums of profiles (frames, bins) at points; see `back_project`.

    Antennas, boresights and points have shape (n, 3); ``turns`` is exp(j x) at equal steps of one
    turn, their number a power of two.
    """
    last = values.shape[1] - 1
    per_bin = 1.0 / bin_m
    per_m = wave_number / (2.0 * math.pi) * turns.shape[0]
    mask = turns.shape[0] - 1
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        real, imag, square_sum, seen = 0.0, 0.0, 0.0, 0
        for f in range(antennas.shape[0]):
            dx, dy, dz = x - antennas[f, 0], y - antennas[f, 1], z - antennas[f, 2]
            range_m = math.sqrt(dx * dx + dy * dy + dz * dz)
            along = dx * boresights[f, 0] + dy * boresights[f, 1] + dz * boresights[f, 2]
            at = (range_m - start_m) * per_bin
            is_seen = min_m <= range_m <= max_m and along >= cos_half_beam * range_m
            if not (is_seen and 0.0 <= at < last):
                continue
            low = int(at)
            part = at - low
            near, far = values[f, low], values[f, low + 1]
            u = near.real + part * (far.real - near.real)
            v = near.imag + part * (far.imag - near.imag)
            turn = turns[int(range_m * per_m + 0.5) & mask]
            real += u * turn.real - v * turn.imag
            imag += u * turn.imag + v * turn.real
            square_sum += u * u + v * v
            seen += 1
        total[i] = complex(real, imag)
        power[i] = square_sum
        count[i] = seen

"""Autofocus: the error of a path from the phases of the brightest points of its own image.

An antenna that is taken to be at a + e, and is at a, sees a point in the direction u (unit vector)
with a phase that is off by -k u . e. Errors e_n, in x and y, are sought at knots at equal distances
along the path; between two knots they are linear, with the weight h_n(f) of knot n at profile f. Of
each of the brightest points q_i, with its echoes v_if (`echoes_at`) by way (`Aperture.metres`),

    arg sum_f h_n(f) v_if = c_i - k u_in . e_n + noise,   unwrapped from knot to knot

e_n and c_i follow by least squares, with a random walk of mean zero as the prior of e_n; points are
then looked for anew, and so on. Of all these paths the one that makes its points brightest is kept,
be it the one that was given. A shift or turn of all, which leaves images sharp, is not found.

Sources: Wahl, Eichel, Ghiglia, Jakowatz, IEEE Trans. Aerosp. Electron. Syst. 30 (1994) 827: phases
of bright points; Ash, IEEE Geosci. Remote Sens. Lett. 9 (2012) 103: sharp back-projected images.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.imaging.back_projection import Aperture, back_project, echoes_at
from slam.imaging.range_profiles import RangeProfiles

Array = NDArray[np.float64]

_PHASE_SIGMA_RAD = 0.3  # of the part of a path at a knot: other echoes at the same range
_NOISE_IMAGES = 100.0  # of so many images of noise alone, one has a point that would be used


@dataclass(frozen=True, slots=True, kw_only=True)
class FocusRule:
    """How the error of a path is looked for."""

    knots: int = 8  # at least 2
    repetitions: int = 4
    points: int = 3  # the brightest
    apart_m: float = 0.5  # least distance between two of them
    walk_m_per_sqrt_m: float = 0.01  # deviation of the path's random walk in x, and in y


def autofocus(
    profiles: RangeProfiles, aperture: Aperture, points_m: Array, rule: FocusRule | None = None
) -> Aperture:
    """Return the aperture with its antennas moved, in x and y, to where their image is sharp.

    ``points_m`` (..., 2) or (..., 3) covers the scene with cells no larger than an echo is wide. No
    antenna is moved if all stand still, or if no point that all see stands out of noise.
    """
    rule, way_m = rule or FocusRule(), aperture.length_m
    weighted = profiles.times(aperture.metres)
    points_m = _bright(weighted, aperture, points_m.reshape(-1, points_m.shape[-1]), rule)
    if not len(points_m):  # as where all antennas stand
        return aperture
    knot_m = way_m / (rule.knots - 1)
    at = (np.cumsum(aperture.metres) - aperture.metres / 2) / knot_m
    hats = np.maximum(1.0 - np.abs(at[:, None] - np.arange(rule.knots)), 0.0)
    walk_m = rule.walk_m_per_sqrt_m * math.sqrt(knot_m)
    errors, best, sharpest = np.zeros((rule.knots, 2)), aperture, -1.0
    for _ in range(1 + rule.repetitions):
        moved = replace(aperture, antennas_m=aperture.antennas_m.copy())
        moved.antennas_m[:, :2] -= hats @ errors
        points_m, sharpness = _peaks(weighted, moved, points_m)
        if sharpness > sharpest:
            best, sharpest = moved, sharpness
        errors = _errors(weighted, moved, points_m, known=errors, hats=hats, walk_m=walk_m)
    return best


def _bright(weighted: RangeProfiles, aperture: Aperture, points_m: Array, rule: FocusRule) -> Array:
    """Return the brightest of the points (n, d) that lie apart, (k, d)."""
    image, found = back_project(weighted, aperture, points_m), list[Array]()
    # Of noise alone |S1|**2 / S2 has an exponential distribution of mean 1.
    stands_out = (
        np.abs(image.total) ** 2 > math.log(_NOISE_IMAGES * max(1, len(points_m))) * image.power
    )
    stands_out &= image.count == len(aperture.antennas_m)
    left = np.where(stands_out, np.abs(image.total), 0.0)
    while len(found) < rule.points and left.any():
        found.append(points_m[left.argmax()])
        left[np.linalg.norm(points_m - found[-1], axis=1) < rule.apart_m] = 0.0
    return np.array(found)


def _peaks(weighted: RangeProfiles, aperture: Aperture, near_m: Array) -> tuple[Array, float]:
    """Return the brightest place near each point, and the sum of the powers there."""
    side_m = np.linspace(-1.5, 1.5, 25) * math.tau / weighted.wave_number_rad_per_m
    around = np.repeat(near_m[:, None], side_m.size**2, axis=1)
    around[..., :2] += np.stack(np.meshgrid(side_m, side_m), axis=-1).reshape(-1, 2)
    power = np.abs(back_project(weighted, aperture, around).total) ** 2
    return around[np.arange(len(near_m)), power.argmax(axis=1)], float(power.max(axis=1).sum())


def _errors(
    weighted: RangeProfiles,
    moved: Aperture,
    points_m: Array,
    *,
    known: Array,
    hats: Array,
    walk_m: float,
) -> Array:
    """Return the errors at the knots, (n, 2), of a path from which the ``known`` are taken off."""
    n, m = len(known), len(points_m)
    walk = np.vstack([np.diff(np.eye(n), axis=0), np.ones(n)]) / walk_m  # its mean is zero
    rows, values = [np.pad(np.kron(walk, np.eye(2)), ((0, 0), (0, m)))], [np.zeros(2 * n)]
    for constant, point in zip(np.eye(m), points_m, strict=True):
        echoes = echoes_at(weighted, moved.antennas_m, point)
        sums, sight = hats.T @ echoes, point - moved.antennas_m
        weight = np.abs(sums) / np.maximum(hats.T @ np.abs(echoes), 1e-30) / _PHASE_SIGMA_RAD
        sight /= np.linalg.norm(sight, axis=1)[:, None]
        turns = -weighted.wave_number_rad_per_m * hats.T @ sight[:, :2]
        per_m = turns / np.maximum(hats.sum(axis=0)[:, None], 1e-30)
        slopes = np.kron(np.eye(n), np.ones(2)) * np.tile(per_m, n)  # of each knot, its x and y
        rows.append(np.hstack([slopes, np.tile(constant, (n, 1))]) * weight[:, None])
        values.append((np.unwrap(np.angle(sums)) + np.sum(per_m * known, axis=1)) * weight)
    solution = np.linalg.lstsq(np.vstack(rows), np.concatenate(values), rcond=None)[0]
    return np.asarray(solution[: 2 * n].reshape(n, 2))

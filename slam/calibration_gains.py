"""Relative gain and boresight of each radar, from how loud its echoes are.

The model of an amplitude, in logarithms, is linear::

    ln a = strength of landmark + gain of radar - n ln R + B ln cos(angle) + B tan(angle) yaw

n lies between 1.5 (rod) and 2 (point), B is the exponent of the beam. A gain common to all radars
cannot be told from louder reflectors, so gains are given relative to their mean; between radars
that never see one reflector in common not even that. Yaw acts through the beam alone, weakly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.calibration import Calibration, Drive
from slam.calibration_association import BEAM_EXPONENT, UNASSIGNED
from slam.calibration_tracks import radar_poses

Array = NDArray[np.float64]

_DB_PER_NEPER = 20 / math.log(10)
_GAIN_SIGMA = 6.0 / _DB_PER_NEPER
_YAW_SIGMA_RAD = math.radians(5)
_EXPONENT, _EXPONENT_SIGMA = 1.75, 0.25
_STRENGTH_SIGMA = 10.0
# Beyond, the cosine law says little of a real antenna.
_WIDEST_RAD = math.radians(45)
_HUBER = 1.345
_ROUNDS = 8


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GainEstimate:
    """Gains relative to their mean, and boresight corrections; shapes (r,) each.

    What no echo tells has the standard deviation of its prior: 6 dB less the mean, 5 degrees.
    """

    gains_db: Array
    gain_sigmas_db: Array
    yaws_rad: Array
    yaw_sigmas_rad: Array


def estimate_gains(drive: Drive, calibration: Calibration) -> GainEstimate:
    """Estimate gains and boresights from the ranges that a calibration used."""
    rows, law, tangent, ranges_m = _sights(drive, calibration)
    n_radars, n_landmarks = len(drive.rig.mounts), len(calibration.landmarks_m)
    radar, landmark = drive.ranges.radar[rows], calibration.landmark[rows]
    # unknowns: gains, yaws, the range's exponent, strengths
    design = np.zeros((len(rows), 2 * n_radars + 1 + n_landmarks))
    every = np.arange(len(rows))
    design[every, radar] = 1.0
    design[every, n_radars + radar] = BEAM_EXPONENT * tangent
    design[:, 2 * n_radars] = -np.log(ranges_m)
    design[every, 2 * n_radars + 1 + landmark] = 1.0
    measured = np.log(drive.ranges.amplitude[rows]) - law
    means = np.zeros(design.shape[1])
    means[2 * n_radars] = _EXPONENT
    sigmas = np.repeat(
        [_GAIN_SIGMA, _YAW_SIGMA_RAD, _EXPONENT_SIGMA, _STRENGTH_SIGMA],
        [n_radars, n_radars, 1, n_landmarks],
    )
    answer, covariance = _robust(design, measured, means, sigmas)

    centre = np.eye(n_radars) - 1 / n_radars
    gains = centre @ answer[:n_radars]
    spread = centre @ covariance[:n_radars, :n_radars] @ centre.T
    yaw = slice(n_radars, 2 * n_radars)
    return GainEstimate(
        gains_db=_DB_PER_NEPER * gains,
        gain_sigmas_db=_DB_PER_NEPER * np.sqrt(np.diag(spread)),
        yaws_rad=answer[yaw],
        yaw_sigmas_rad=np.sqrt(np.diag(covariance)[yaw]),
    )


def _sights(drive: Drive, calibration: Calibration) -> tuple[NDArray[np.intp], Array, Array, Array]:
    """Return usable rows, B ln cos and tan of their angle off boresight, and their distance."""
    rows = np.flatnonzero(calibration.landmark != UNASSIGNED)
    mounts = np.array([(m.x_m, m.y_m, m.yaw_rad) for m in drive.rig.mounts])
    mounts[:, :2] += calibration.mount_shifts_m
    radar = drive.ranges.radar[rows]
    sights = radar_poses(calibration.path, mounts[radar], drive.ranges.t_ns[rows])
    away = calibration.landmarks_m[calibration.landmark[rows]] - sights[:, :2]
    angle = np.arctan2(away[:, 1], away[:, 0]) - sights[:, 2]
    angle -= math.tau * np.round(angle / math.tau)
    kept = np.abs(angle) < _WIDEST_RAD
    angle = angle[kept]
    distance = np.hypot(away[kept, 0], away[kept, 1])
    return rows[kept], BEAM_EXPONENT * np.log(np.cos(angle)), np.tan(angle), distance


def _robust(design: Array, measured: Array, means: Array, sigmas: Array) -> tuple[Array, Array]:
    """Return the answer of a linear problem with priors and its covariance, outliers held down."""
    weights, noise = np.ones(len(measured)), 0.1
    answer = means
    for _ in range(_ROUNDS):
        weighted = design * weights[:, np.newaxis] / noise**2
        information = design.T @ weighted + np.diag(sigmas**-2)
        answer = means + np.linalg.solve(information, weighted.T @ (measured - design @ means))
        residuals = measured - design @ answer
        if len(residuals):
            noise = max(float(np.median(np.abs(residuals))) / 0.6745, 1e-6)
        weights = np.minimum(1.0, _HUBER * noise / np.maximum(np.abs(residuals), 1e-12))
    covariance = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return answer, covariance

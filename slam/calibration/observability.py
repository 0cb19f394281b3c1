"""What a drive leaves open: weak directions of a calibration, gains, and drives too poor.

The model of an amplitude, in logarithms, is linear::

    ln a = strength of landmark + gain of radar - n ln R + B ln cos(angle) + B tan(angle) yaw

n lies between 1.5 (rod) and 2 (point), B is the exponent of the beam. A gain common to all radars
cannot be told from stronger reflectors, so gains are given relative to their mean; between radars
that never see one reflector in common not even that. Yaw acts through the beam alone, weakly.

Of the covariance of all offsets and mounts, a principal direction whose standard deviation exceeds
the limit is named by the unknowns that take part in it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.calibration.calibration import Calibration, Drive
from slam.calibration.tracks import BEAM_EXPONENT, UNASSIGNED, radar_poses

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

OFFSET_LIMIT_M = 1e-3
# An unknown takes part in a direction with at least this share of the largest component.
_TAKES_PART = 0.4
_STANDS_M, _STANDS_RAD = 0.02, 0.05
_KINDS = ("offset", "mount x", "mount y")
_REMEDY = {
    "mount y": "drive closer and farther past reflectors, and turn on the spot",
    "mount x": "turn on the spot among reflectors",
    "offset": "drive past more reflectors, nearer and farther",
}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GainEstimate:
    """Gains relative to their mean, and boresight corrections; shapes (r,) each.

    Without echoes the standard deviations are the prior's: 6 dB less the mean, 5 degrees.
    """

    gains_db: Array
    gain_sigmas_db: Array
    yaws_rad: Array
    yaw_sigmas_rad: Array


def estimate_gains(drive: Drive, calibration: Calibration) -> GainEstimate:
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
    """Return the solution of a linear problem with priors, Huber-weighted, and its covariance."""
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class WeakDirection:
    """A combination of offsets and mounts that the drive leaves open."""

    sigma_m: float  # standard deviation along the direction
    direction: Array  # shape (3 r,), unit vector: offset, mount x, mount y of each radar
    description: str  # which unknowns are not determined, in one sentence
    remedy: str  # a drive that would determine it


def weak_directions(calibration: Calibration, names: Sequence[str]) -> tuple[WeakDirection, ...]:
    """Return the directions that are not known to ``OFFSET_LIMIT_M``, the weakest first."""
    variances, vectors = np.linalg.eigh(calibration.covariance_m2)
    found = []
    for index in np.argsort(-variances).tolist():
        sigma_m = float(np.sqrt(max(variances[index], 0.0)))
        if sigma_m <= OFFSET_LIMIT_M:
            break
        direction: Array = vectors[:, index]
        found.append(_weak_direction(direction, names, sigma_m))
    return tuple(found)


def _weak_direction(direction: Array, names: Sequence[str], sigma_m: float) -> WeakDirection:
    share = np.abs(direction).reshape(-1, 3)
    parts = share >= _TAKES_PART * share.max()
    by_kind = {
        kind: [name for name, takes in zip(names, parts[:, column], strict=True) if takes]
        for column, kind in enumerate(_KINDS)
    }
    present = [f"{kind} of {_joined(radars)}" for kind, radars in by_kind.items() if radars]
    size = f"({1e3 * sigma_m:.1f} mm)"
    mounts = [kind for kind in ("mount y", "mount x") if by_kind[kind]]
    remedy = _REMEDY[mounts[0] if mounts else "offset"]
    if len(present) > 1:
        text = f"the drive cannot tell the {present[0]} from the {_joined(present[1:])} {size}"
    elif int(parts.sum()) == 1:
        text = f"the drive does not tell the {present[0]} {size}"
    else:
        text = f"the drive tells only combinations of the {present[0]} {size}"
    return WeakDirection(sigma_m=sigma_m, direction=direction, description=text, remedy=remedy)


def _joined(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def poor_drive(drive: Drive, calibration: Calibration) -> tuple[str, ...]:
    """Return why a drive is too poor for a calibration; empty where it is not."""
    reasons = []
    spread = np.ptp(drive.path.poses, axis=0)
    if max(spread[0], spread[1]) < _STANDS_M and spread[2] < _STANDS_RAD:
        reasons.append("the robot stood still: nothing moves a range but its noise; drive a course")
    n_landmarks = len(np.unique(calibration.landmark[calibration.landmark != UNASSIGNED]))
    if n_landmarks == 0:
        reasons.append("no reflector could be followed: put some 0.5 to 1.5 m beside the course")
    elif n_landmarks == 1:
        reasons.append("only one reflector was followed: put more around the course")
    used = drive.ranges.radar[calibration.landmark != UNASSIGNED]
    if n_landmarks:
        reasons += [
            f"{mount.name} followed no reflector: turn it towards some"
            for radar, mount in enumerate(drive.rig.mounts)
            if not np.any(used == radar)
        ]
    return tuple(reasons)


def unseen_reflectors(calibration: Calibration, n_known: int) -> tuple[str, ...]:
    """Return what is wrong with known reflectors, the first ``n_known`` landmarks."""
    seen = len(set(calibration.landmark.tolist()) & set(range(n_known)))
    if 2 * seen >= n_known:
        return ()
    return (
        f"only {seen} of {n_known} known reflectors were detected: do their places belong to this "
        "drive, in a frame in which it starts at the origin and looks along x?",
    )

"""What a drive cannot tell, in words: weak directions of a calibration and drives too poor.

The covariance of all offsets and mounts is split into its principal directions. One whose
standard deviation exceeds the limit is named by the unknowns that take part in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.calibration import Calibration, Drive
from slam.calibration_association import UNASSIGNED

Array = NDArray[np.float64]

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
class WeakDirection:
    """A combination of offsets and mounts that the drive leaves open.

    Attributes
    ----------
    sigma_m
        Standard deviation along the direction.
    direction
        Shape (3 r,), unit vector: offset, mount x, mount y of each radar.
    words
        What cannot be told from what, in one sentence.
    remedy
        A drive that would tell it.
    """

    sigma_m: float
    direction: Array
    words: str
    remedy: str


def weak_directions(
    calibration: Calibration, names: Sequence[str], limit_m: float = OFFSET_LIMIT_M
) -> tuple[WeakDirection, ...]:
    """Return the directions whose standard deviation exceeds a limit, the weakest first."""
    variances, vectors = np.linalg.eigh(calibration.covariance_m2)
    found = []
    for index in np.argsort(-variances).tolist():
        sigma_m = float(np.sqrt(max(variances[index], 0.0)))
        if sigma_m <= limit_m:
            break
        direction: Array = vectors[:, index]
        words, remedy = _words(direction, names, sigma_m)
        found.append(
            WeakDirection(sigma_m=sigma_m, direction=direction, words=words, remedy=remedy)
        )
    return tuple(found)


def _words(direction: Array, names: Sequence[str], sigma_m: float) -> tuple[str, str]:
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
    if len(present) == 1 and int(parts.sum()) == 1:
        return f"the drive does not tell the {present[0]} {size}", remedy
    if len(present) == 1:
        return f"the drive tells only combinations of the {present[0]} {size}", remedy
    words = f"the drive cannot tell the {present[0]} from the {_joined(present[1:])} {size}"
    return words, remedy


def _joined(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def poor_drive(drive: Drive, calibration: Calibration) -> tuple[str, ...]:
    """Say why a drive is too poor for a calibration; empty where it is not."""
    said = []
    spread = np.ptp(drive.path.poses, axis=0)
    if max(spread[0], spread[1]) < _STANDS_M and spread[2] < _STANDS_RAD:
        said.append("the robot stood still: nothing moves a range but its noise; drive a course")
    n_landmarks = len(np.unique(calibration.landmark[calibration.landmark != UNASSIGNED]))
    if n_landmarks == 0:
        said.append("no reflector could be followed: put some 0.5 to 1.5 m beside the course")
    elif n_landmarks == 1:
        said.append("only one reflector was followed: put more around the course")
    used = drive.ranges.radar[calibration.landmark != UNASSIGNED]
    if n_landmarks:
        said += [
            f"{mount.name} followed no reflector: turn it towards some"
            for radar, mount in enumerate(drive.rig.mounts)
            if not np.any(used == radar)
        ]
    return tuple(said)


def unseen_reflectors(calibration: Calibration, n_known: int) -> tuple[str, ...]:
    """Return what is wrong with known reflectors, the first ``n_known`` landmarks, in words."""
    seen = len(set(calibration.landmark.tolist()) & set(range(n_known)))
    if 2 * seen >= n_known:
        return ()
    return (
        f"only {seen} of {n_known} known reflectors are heard: do their places belong to this "
        "drive, in a frame in which it starts at the origin and looks along x?",
    )

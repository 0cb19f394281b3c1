"""Walls of a patch: flat faces that send an echo back to the antenna that looks at right angles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.imaging.patches import Patch
from slam.imaging.points import PointRule, in_view, stand_out
from slam.imaging.reflectors import Reflectors, separated

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PatchLine:
    """A flat face in the frame of its patch: n . x = d, from one end to the other.

    Attributes
    ----------
    normal
        Shape (2,), unit vector away from the antenna.
    distance_m
        d, from the origin of the patch.
    ends_m
        Shape (2, 2): the feet of the perpendiculars from the first and the last antenna that saw
        it; the face may go on.
    amplitude
        At 1 m: it falls as 1 / r.
    """

    normal: Array
    distance_m: float
    ends_m: Array
    amplitude: float
    snr: float
    coherence: float


def patch_lines(patch: Patch, rule: PointRule | None = None) -> tuple[PatchLine, ...]:
    """Return the walls of a patch, the nearest first."""
    rule = rule or PointRule()
    return lines_of(patch, separated(patch, rule.separation), rule)


def lines_of(patch: Patch, reflectors: Reflectors, rule: PointRule) -> tuple[PatchLine, ...]:
    """Return those of the reflectors of a patch that are walls, the nearest first."""
    aperture = patch.aperture
    assert aperture.boresights is not None
    antennas, (bx, by) = aperture.antennas_m, aperture.boresights[patch.middle]
    lines = []
    size = np.sqrt(reflectors.energy)
    is_wall = stand_out(reflectors, rule) & (reflectors.flatness > rule.flatness[2])
    is_wall &= size >= rule.least_wall_share * size.max(initial=0.0)
    for k in np.argsort(reflectors.range_m).tolist():
        if not is_wall[k]:
            continue
        c, s = np.cos(reflectors.bearing_rad[k]), np.sin(reflectors.bearing_rad[k])
        normal = np.array([c * bx - s * by, s * bx + c * by])
        distance_m = float(normal @ antennas[patch.middle] + reflectors.range_m[k])
        feet = antennas + (distance_m - antennas @ normal)[:, np.newaxis] * normal
        if in_view(patch, feet[patch.middle][np.newaxis])[0] < rule.least_in_view:
            continue
        lines.append(
            PatchLine(
                normal=normal,
                distance_m=distance_m,
                ends_m=feet[[0, -1]],
                amplitude=float(reflectors.levels[k].max() * reflectors.range_m[k]),
                snr=float(reflectors.snr[k]),
                coherence=float(reflectors.coherence[k]),
            )
        )
    return tuple(lines)

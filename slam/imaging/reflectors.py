"""A patch as the sum of a few reflectors and a rest.

With D_f the antenna of frame f seen from that in the middle of the patch, e the direction of a
reflector from there, r its range and h the curvature of its wavefront [1/m],

    R_f = r + (h |D_f|**2 - 2 e . D_f) / (1 + sqrt(1 - 2 h e . D_f + h**2 |D_f|**2))

is its range at frame f: of a point with h = 1 / r, of a plane with 0, of a cylinder of radius a
with 1 / (r + a). Its profile is a_f q(x - R_f) exp(-j k R_f), with

    a_f = c b_f (1 + g t_f)

c complex; b_f the beam, cos**n of the angle off boresight, 3 dB down at the edge of the field of
view; g real, t_f from -1 to 1 over the patch, for the law of range and what else is not known.

Search
    The cell of a polar grid where a point explains the most energy, |sum b_f v_f|**2 / sum b_f**2;
    from there to the maximum, as a point and as a plane: range by a parabola through the logarithm,
    bearing by least squares of the phase (Gauss-Newton). What explains more is subtracted, and the
    next one searched (CLEAN; Hoegbom, Astronomy and Astrophysics Supplement 15 (1974) 417).
Sweep
    Each is added again, placed anew in the absence of all others, and subtracted (RELAX; Li and
    Stoica, IEEE Trans. Signal Processing 44 (1996) 281). A second sweep gains nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.imaging import kernels
from slam.imaging.back_projection import signal_of
from slam.imaging.patches import Patch

Array = NDArray[np.float64]

_ROW_M, _CELL_RAD = 0.05, 0.042  # cells of the grid
_OFF_BORESIGHT_RAD = 0.95  # beyond the edge of the beam, where echoes are still strong
_BEYOND_M = 0.2  # echoes from there reach into the field of view
_BEAM_STEPS = 256


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reflectors:
    """The reflectors of one patch, k of them; all arrays have one row for each.

    Attributes
    ----------
    range_m, bearing_rad
        From the antenna in the middle of the patch, and off its boresight.
    flatness
        1 - h r where the curvature is free: 0 of a point, 1 of a plane.
    energy
        Sum of |a_f|**2.
    amplitude
        Largest |a_f| r**1.5: that at 1 m, under the law of a rod.
    snr
        Root of the energy over the mean of what is left in the image at ranges near it.
    levels
        Shape (k, n): |a_f|.
    """

    range_m: Array
    bearing_rad: Array
    flatness: Array
    energy: Array
    amplitude: Array
    snr: Array
    levels: Array

    @property
    def places_m(self) -> Array:
        """Return places (k, 2) from the antenna in the middle, x along its boresight."""
        directions = np.column_stack([np.cos(self.bearing_rad), np.sin(self.bearing_rad)])
        return np.asarray(self.range_m[:, np.newaxis] * directions)


@dataclass(frozen=True, slots=True, kw_only=True)
class SeparationRule:
    """How a patch is separated into reflectors."""

    most: int = 12
    # Energy of a cell over the level of the image from which on it is searched for
    least_over_level: float = 40.0
    # Amplitude under the law of a rod, over that of the strongest
    least_share: float = 0.1
    # Size over that of one that was found at a range within so much of it: less may be what is left
    # of that one
    beside_m: float = 0.12
    beside_share: float = 0.2
    # What a free curvature must explain over what a point does
    more_than_point: float = 1.1


def separated(patch: Patch, rule: SeparationRule) -> Reflectors:
    """Return the reflectors of a patch, the strongest first as they were found.

    Raises ValueError where the shape of an echo in the profiles is not known.
    """
    profiles, aperture = patch.profiles, patch.aperture
    if profiles.echo is None or aperture.boresights is None:
        raise ValueError("reflectors can be separated where echo and boresights are known")
    n, (bx, by) = len(profiles.values), aperture.boresights[patch.middle]
    turn = np.array([[bx, -by], [by, bx]])
    track = np.zeros((n, 6))
    track[:, :2] = (aperture.antennas_m - aperture.antennas_m[patch.middle]) @ turn
    track[:, 3:5] = aperture.boresights @ turn
    view = patch.view
    power = math.log(0.5) / (2 * math.log(math.cos(view.opening_rad / 2)))
    rows_m = np.arange(
        max(view.min_range_m - 2 * _ROW_M, _ROW_M), view.max_range_m + _BEYOND_M, _ROW_M
    )
    yaws = np.arctan2(track[:, 4], track[:, 3])
    bearings = np.arange(
        yaws.min() - _OFF_BORESIGHT_RAD, yaws.max() + _OFF_BORESIGHT_RAD, _CELL_RAD
    )
    directions = np.column_stack([np.cos(bearings), np.sin(bearings)])
    cells = rows_m[:, np.newaxis, np.newaxis] * directions
    signal = signal_of(profiles)
    found, models = kernels.separate(
        signal,
        track,
        np.linspace(0.0, 1.0, _BEAM_STEPS + 1) ** power,
        profiles.echo,
        cells,
        rows_m,
        bearings,
        rule.most,
        (
            rule.least_over_level,
            rule.least_share,
            rule.beside_share,
            rule.more_than_point,
            rule.beside_m,
        ),
    )
    range_m, bearing_rad, _, _, energy, curvature = found.T
    # What is left, on half as many cells
    cells = np.ascontiguousarray(cells[:, ::2])
    image = np.empty(cells.shape[:2])
    kernels.image_rows(signal, track, cells, 0, len(image), image)
    levels = np.abs(models)
    at = ((range_m - rows_m[0]) / _ROW_M).astype(np.intp)
    rest = [image[max(0, i - 2) : i + 4].mean() if 0 <= i < len(image) else math.inf for i in at]
    return Reflectors(
        range_m=range_m,
        bearing_rad=bearing_rad,
        flatness=1.0 - curvature * range_m,
        energy=energy,
        amplitude=levels.max(axis=1, initial=0.0) * range_m**1.5,
        snr=np.sqrt(energy / np.maximum(rest, 1e-300)),
        levels=levels,
    )

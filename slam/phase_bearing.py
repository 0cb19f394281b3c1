"""The difference of two ranges of a pair, refined by the carrier's phase.

The envelope of an echo tells its range to a millimetre, its carrier to some hundredths of one, but
only modulo half a wavelength (20.56 mm). An echo A e(n - u) cos(kappa (n - u) + phi) keeps its
reflection phase phi wherever it is seen from, so two radars that see one reflector find

    l1 - l2 = (m1 - m2) - Lambda / (2 pi) wrap(phi1 - phi2 - c),   Lambda = c_light / (2 f_carrier)

with m the measured ranges, phi the phases at those ranges and c what the two modules and their
antennas add to the difference. The wrap is right as long as m1 - m2 is wrong by less than
Lambda / 2. The mean of the two ranges, for which the unknown reflection phase leaves no such
help, stays as measured. (Interferometry of two receivers; Richards 2014, chapter 9.)

What has to hold, or this is worse than the ranges alone:

- One reflector with one reflection phase for both aspects. A point, a sphere, a rod do; an
  extended or composite target turns its phase with the aspect.
- One pulse: overlapping echoes pull the phase (``Detection.misfit``).
- The constant c of each pair, known to some degrees: 10 degrees are 0.6 mm. Nothing here estimates
  it: ``Mount.phase_offset_rad`` is 0 unless somebody measured it.
- The ranges' sigma: a pair whose predicted scatter could wrap wrongly is left as it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from slam.detector import Detection

Array = NDArray[np.float64]

# A pair is refined if half a wavelength is this many standard deviations of the difference.
_SAFETY = 4.0


def pair_ranges_m(
    pairs: Sequence[tuple[Detection, Detection]],
    wavelength_m: float,
    phase_constant_rad: float = 0.0,
) -> Array:
    """Return the two ranges of each pair of detections, their difference refined by the phases.

    Pairs without phases (the paper's front end) or with ranges too coarse to tell the carrier's
    periods apart come out unchanged.

    Parameters
    ----------
    pairs
        n detections of the first radar, each with one of the second.
    wavelength_m
        Lambda above, ``PulseModel.wavelength_m``.
    phase_constant_rad
        c above: phase of the first radar minus that of the second for equal paths.

    Returns
    -------
    Shape (n, 2) [m]: range from the first and from the second radar.
    """
    ranges_m = np.array([(a.range_m, b.range_m) for a, b in pairs]).reshape(-1, 2)
    turn = np.array([a.phase_rad - b.phase_rad for a, b in pairs]) - phase_constant_rad
    sigma_m = np.array([math.hypot(a.sigma_m, b.sigma_m) for a, b in pairs])
    turn -= math.tau * np.rint(turn / math.tau)
    resolved = np.isfinite(turn) & (_SAFETY * sigma_m < wavelength_m / 2)
    correction = np.where(resolved, turn, 0.0) * (wavelength_m / math.tau)
    ranges_m[:, 0] -= correction / 2
    ranges_m[:, 1] += correction / 2
    return ranges_m

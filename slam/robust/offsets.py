"""Is the rig calibrated? The range offsets that a run shows tell.

Two priors of the offsets o: a calibrated rig's, N(0, narrow^2), and any rig's, N(0, wide^2), which
the filter starts with. Given its posterior N(m, P), the evidence for the first against the second
is the mean of the priors' ratio, and with 1 / s^2 = 1 / narrow^2 - 1 / wide^2::

    B = (wide / narrow)^r (2 pi s^2)^(r/2) N(m; 0, P + s^2 I)

(a Savage-Dickey ratio, Dickey, Annals of Mathematical Statistics 42, 1971, between two Gaussians).
Where B is large, the measurement o = 0 with noise s^2 turns the posterior of the one prior into
that of the other, exactly.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from slam.robust.parameters import BackEndParameters
from slam.robust.run_log import RunLog
from slam.robust.state import State


def _between_priors(narrow_m: float, wide_m: float) -> float:
    """Return s^2 [m^2]."""
    return 1.0 / (narrow_m**-2 - wide_m**-2)


def calibrated_evidence(state: State, narrow_m: float, wide_m: float) -> float:
    """Return ln B of a state whose offsets had the wide prior."""
    at = np.arange(state.offsets.start, state.offsets.stop)
    s_sq = _between_priors(narrow_m, wide_m)
    S = state.P.block(at) + s_sq * np.eye(len(at))
    m = state.offsets_m
    volume = len(at) * (math.log(wide_m / narrow_m) + 0.5 * math.log(s_sq))
    return volume - 0.5 * float(m @ np.linalg.solve(S, m) + np.linalg.slogdet(S)[1])


def take_as_calibrated(state: State, narrow_m: float, wide_m: float) -> None:
    """Give the offsets the narrow prior in place of the wide one."""
    at = np.arange(state.offsets.start, state.offsets.stop)
    noise = np.full(len(at), _between_priors(narrow_m, wide_m))
    state.update(at, np.eye(len(at)), -state.offsets_m, noise)


def judged(state: State, log: RunLog, parameters: BackEndParameters) -> BackEndParameters:
    """Take the rig for calibrated once that is evident; return the parameters from then on.

    It is for good, and for the solution over all poses too; where the first poses are a prior
    already, which has the wide one in it, nothing changes any more.
    """
    ranges = parameters.ranges
    narrow_m, wide_m = ranges.calibrated_sigma_m, ranges.offset_sigma_m
    if narrow_m is None or not 0.0 < narrow_m < wide_m or log.n_kept < log.n_poses:
        return parameters
    if calibrated_evidence(state, narrow_m, wide_m) <= ranges.calibrated_evidence:
        return parameters
    take_as_calibrated(state, narrow_m, wide_m)
    known = replace(ranges, offset_sigma_m=narrow_m, calibrated_sigma_m=None)
    return replace(parameters, ranges=known)

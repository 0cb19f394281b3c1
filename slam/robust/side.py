"""One side of the rig and known landmarks: which ranges are theirs, which landmarks are silent."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.robust.continuation import (
    Continuation,
    SureLandmarks,
    continue_tracks,
    landmarks_in_view,
)
from slam.robust.existence import Existence
from slam.robust.expected import expected_ranges
from slam.robust.parameters import BackEndParameters
from slam.robust.ranges import Antennas, RangeScan, View
from slam.robust.reports import ExpectedRange
from slam.robust.state import State
from slam.robust.surprise import Trial, trials


@dataclass(frozen=True, slots=True, kw_only=True)
class Heard:
    """What the radars of a side heard of known landmarks.

    Attributes
    ----------
    continued
        Their ranges that continue tracks.
    expected
        The ranges that could have, as predicted before any was looked at.
    trials
        Landmarks looked for, for judging the pose.
    """

    continued: Sequence[Continuation] = ()
    expected: Sequence[ExpectedRange] = ()
    trials: Sequence[Trial] = ()


def listen(  # noqa: PLR0917 - the scans, where they were taken, and what is believed
    scans: Sequence[RangeScan],
    seen: View,
    antennas: Antennas,
    state: State,
    existence: Existence,
    parameters: BackEndParameters,
) -> Heard:
    """Find the ranges of known landmarks on one side; count hits and misses.

    Parameters
    ----------
    scans
        Of the radars of one side; those without a frame are absent.
    seen
        Landmarks and walls as all radars see them.
    antennas
        Where the radars were, body frame.
    state
        Pose and map, not changed.
    existence
        Takes the hits and misses.
    parameters
        Noise and rules.
    """
    noise, rule, limits = parameters.ranges, parameters.continuation, parameters.map
    radars = [scan.radar for scan in scans]
    near = landmarks_in_view(state, seen, radars, noise, rule) if radars else None
    if near is None:
        return Heard()
    sure = near.surer_than(rule.tight_sigmas * noise.sigma_m)
    doubts_m = state.feature_doubts_m
    near = near.doubted(doubts_m)
    tried = trials(near, seen, scans, state, parameters)
    inside = seen.inside(noise, -limits.view_inset_rad, -limits.view_inset_m)[radars]
    known = () if sure is None else sure.landmarks
    silent = np.setdiff1d(near.unanswered(scans, noise, limits.view_inset_m), known)
    _miss_unsure(silent, inside, state, existence)
    if sure is None:
        return Heard(trials=tried)
    expected = expected_ranges(state, sure, antennas)
    found = continue_tracks(sure.doubted(doubts_m), scans, noise, rule)
    _count_sure(found, sure, scans, seen, inside, state, existence)
    return Heard(continued=found, expected=expected, trials=tried)


def _miss_unsure(
    silent: NDArray[np.intp], inside: NDArray[np.bool_], state: State, existence: Existence
) -> None:
    """Count a miss of landmarks too unsure for single ranges, where nothing at all is heard."""
    for row in silent.tolist():
        if inside[:, row].all():
            existence.miss(state.feature_ids[row])


def _count_sure(  # noqa: PLR0917 - what was found, and what could have been
    found: Sequence[Continuation],
    sure: SureLandmarks,
    scans: Sequence[RangeScan],
    seen: View,
    inside: NDArray[np.bool_],
    state: State,
    existence: Existence,
) -> None:
    """Count hits of landmarks that were found, and misses of those that all radars should see."""
    ids = state.feature_ids
    count = Counter(continuation.row for continuation in found)
    for row in count:
        existence.hit(ids[row])
    expected = inside[:, sure.landmarks].all(axis=0)
    for row in sure.landmarks[expected].tolist():
        hidden = any(scan.may_hide(float(seen.ranges_m[scan.radar, row])) for scan in scans)
        if row not in count and not hidden:
            existence.miss(ids[row])
    whole = max(len(scans), 2)
    existence.seen_whole(ids[row] for row, n in count.items() if n >= whole)

"""Does the world look as the map says? If not for long, the robot was carried away.

Each landmark that a radar should see is a trial. Where the pose is right, a range lies near its
prediction with the detection probability; where it is not, by chance only: with n ranges over a
span L, with 1 - exp(-n w / L) for a gate of width w. The log likelihood ratios are summed from each
of several moments at which the robot may have been carried, and the largest sum counts (a
cumulative sum test, Page, Biometrika 41, 1954, with few moments). Landmarks mapped after that
moment were put where the robot thought it was: they are no witnesses. One landmark that was taken
away is no proof about the robot: what each may say is bounded, so that several must be missing.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from slam.robust.continuation import SureLandmarks
from slam.robust.parameters import BackEndParameters, SurpriseRule
from slam.robust.ranges import RangeScan, View
from slam.robust.state import State


@dataclass(frozen=True, slots=True)
class Trial:
    """What a landmark says, in nats: positive if the robot is not where the map has it."""

    landmark_id: int
    evidence: float


def trials(
    near: SureLandmarks,
    seen: View,
    scans: Sequence[RangeScan],
    state: State,
    parameters: BackEndParameters,
) -> list[Trial]:
    """Return one trial for each range that should be among those of some scans.

    Parameters
    ----------
    near, seen
        Landmarks that may be in view, all landmarks in view.
    scans
        Of the radars of one side.
    state
        Tells the ids of all rows, and which are points.
    parameters
        Noise of a range, detection probability; what counts.
    """
    noise, rule = parameters.ranges, parameters.surprise
    rows, ids, n_points = near.rows, state.landmark_ids, len(state.landmark_ids)
    inside = seen.inside(noise, -rule.view_inset_rad, -rule.view_inset_m)
    variances = near.prior.diagonal()
    counts = inside[rows.radars, rows.landmarks] & (variances <= rule.most_sigma_m**2)
    counts &= rows.landmarks < n_points  # a wall may end before it comes into view
    by_radar = {scan.radar: scan for scan in scans}
    detection = min(noise.detection_probability, 1.0 - 1e-3)
    span_m = noise.max_range_m - noise.min_range_m
    found = []
    for k in np.flatnonzero(counts).tolist():
        scan = by_radar[int(rows.radars[k])]
        if scan.may_hide(float(rows.predicted_m[k])):
            continue
        sigmas = np.array([scan.sigma(i, noise.sigma_m) for i in range(len(scan.ranges_m))])
        gates_m = rule.gate_sigmas * np.sqrt(float(variances[k]) + sigmas**2)
        chance = 1.0 - math.exp(-2.0 * float(gates_m.sum()) / span_m)
        chance = min(max(chance, rule.least_chance), detection)
        if np.any(np.abs(np.array(scan.ranges_m) - rows.predicted_m[k]) <= gates_m):
            evidence = math.log(chance / detection)
        else:
            evidence = math.log((1.0 - chance) / (1.0 - detection))
        found.append(Trial(ids[int(rows.landmarks[k])], evidence))
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _Hypothesis:
    """The robot was carried away before a pose: who knew its place before, and what they say."""

    first_pose: int
    witnesses: frozenset[int]
    votes: dict[int, float]

    def score(self) -> float:
        return sum(self.votes.values())

    def score_without_one(self) -> float:
        """Return the score without the landmark that says most against the pose."""
        return self.score() - max(self.votes.values(), default=0.0)


class Surprise:
    """The running evidence that the robot is not where the map has it.

    Parameters
    ----------
    rule
        Bounds.
    """

    def __init__(self, rule: SurpriseRule) -> None:
        self._rule = rule
        self._hypotheses: deque[_Hypothesis] = deque(maxlen=rule.hypotheses)

    @property
    def score(self) -> float:
        """Return the evidence in nats of the best hypothesis, zero or more."""
        return max((one.score() for one in self._hypotheses), default=0.0)

    @property
    def first_pose(self) -> int:
        """Return the first pose after the robot was carried, by the best hypothesis."""
        return max(self._hypotheses, key=_Hypothesis.score).first_pose

    @property
    def witnesses(self) -> frozenset[int]:
        """Return the landmarks that were known before that."""
        return max(self._hypotheses, key=_Hypothesis.score).witnesses

    @property
    def is_suspicious(self) -> bool:
        """Tell whether more than one landmark speaks against the pose.

        One alone may hide behind a box or be of another shape than a point: were that enough, it
        could neither be deleted nor solved for again, and would speak on.
        """
        scores = (one.score_without_one() for one in self._hypotheses)
        return max(scores, default=0.0) > self._rule.suspicious

    @property
    def is_carried(self) -> bool:
        """Tell whether the robot must be elsewhere."""
        return self.score > self._rule.carried

    def look(self, frame: Sequence[Trial], pose: int, ids: Iterable[int]) -> None:
        """Take in the trials of one frame, given its pose and the landmarks known before."""
        last = self._hypotheses[-1].first_pose if self._hypotheses else -math.inf
        if frame and pose - last >= self._rule.every:
            self._hypotheses.append(_Hypothesis(pose, frozenset(ids), {}))
        rule = self._rule
        for one in self._hypotheses:
            for trial in frame:
                if trial.landmark_id in one.witnesses:
                    vote = one.votes.get(trial.landmark_id, 0.0) + trial.evidence
                    vote = min(max(vote, -rule.most_for), rule.most_against)
                    one.votes[trial.landmark_id] = vote

    def reset(self) -> None:
        """Begin anew, without suspicion."""
        self._hypotheses.clear()

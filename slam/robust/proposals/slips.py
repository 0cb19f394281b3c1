"""Slips of the wheels, decided when they happen.

Where the wheels suddenly report another motion than that of the step before, either the robot made
it, or the wheels slipped, and the robot went on as before, or stood. The ranges at the end of the
step are compared under each of these motions. A slip that explains those of several landmarks
better by its price and `MARGIN_NATS` is believed: the pose becomes as uncertain as after a motion
that the wheels do not report (`BranchRule.hidden_m`, `BranchRule.hidden_rad`), and the ranges
correct it. If not, the solution over all poses may find it. Either way a doubt remains
(`slam.robust.proposals.doubts.Doubt`).

The limits of view are widened by the difference of the motions: all are judged by the same
landmarks.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from slam.config import WheelNoise
from slam.geometry import compose
from slam.robust.association import Known, RangeScan, View, weigh_known
from slam.robust.parameters import MARGIN_NATS, BackEndParameters
from slam.robust.state import Array, Motion, State, free_motion, predict


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Course:
    """A step as the wheels report it, and the motion of the step before."""

    pose: Array  # shape (3,), before the step, map frame
    before: Motion
    reported: Motion

    @property
    def change(self) -> tuple[float, float]:
        """Return by how much the two motions differ, [m] and [rad]."""
        away_m = self.reported.step_m - self.before.step_m
        turn_rad = abs(self.reported.turn_rad - self.before.turn_rad)
        return math.hypot(away_m[0], away_m[1]), turn_rad


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Change:
    """What the ranges say of a step in which the wheels suddenly report another motion."""

    probability: float  # that they slipped
    # If that is believed: the motion of the robot, and whose the ranges are after it
    slip: tuple[Motion, Known] | None = None


def move_anew(
    state: State, course: Course, motion: Motion, added: Motion, wheels: WheelNoise
) -> None:
    """Let a state be after another motion of the step, with so much more noise."""
    x, y, heading = compose(course.pose, np.array([*motion.step_m, motion.turn_rad])).tolist()
    state.position_m, state.heading_rad = np.array([x, y]), heading
    predict(state, added, wheels)


def judge_change(
    state: State,
    course: Course,
    scans: Sequence[RangeScan],
    parameters: BackEndParameters,
    find: Callable[[State, BackEndParameters], tuple[View, Known]],
) -> Change | None:
    """Return what ranges say of a sudden change of the wheels' motion; None if there is none.

    ``state`` is that after the reported motion, and stays as it is. ``find`` returns what a state
    lets the radars see, and which of the ranges are of which landmarks.
    """
    rule, views, noise = parameters.slips, parameters.continuation, parameters.ranges
    away_m, turn_rad = course.change
    if away_m < 2.0 * rule.steady_m and turn_rad < 2.0 * rule.steady_rad:
        return None
    wide = replace(
        parameters,
        continuation=replace(
            views,
            view_margin_rad=views.view_margin_rad + 2.0 * turn_rad,
            view_sigmas=views.view_sigmas + 2.0 * away_m / noise.sigma_m,
        ),
    )
    steady = free_motion(rule.steady_m, rule.steady_rad)
    found: list[tuple[float, Motion, Known]] = []
    for motion in (course.reported, course.before, free_motion(0.0, 0.0)):
        other = copy.deepcopy(state)
        move_anew(other, course, motion, steady, parameters.wheels)
        seen, known = find(other, wide)
        # What explains a range worse than clutter does is no evidence for it.
        evidence = np.maximum(weigh_known(other, known, seen, scans, noise).evidence, 0.0)
        found.append((float(evidence.sum()), motion, known))
    reported, *others = found
    most, motion, known = max(others, key=lambda one: one[0])
    log_odds = most - reported[0] - math.log(rule.changes_per_slip)
    # Ranges of one landmark alone may be another one's.
    is_alone = len(np.unique(known.assigned[:, 2])) <= 1
    slip = (motion, known) if log_odds > MARGIN_NATS and not is_alone else None
    return Change(probability=float(expit(log_odds)), slip=slip)

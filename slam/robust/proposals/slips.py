"""Jerks: motion that the wheels report for a step or two between steps that are alike.

A robot has inertia, so a motion that begins and ends within two steps is as likely a slip of the
wheels as its own. The ranges at its end can hardly tell: a turn changes none, until the robot has
driven on. So neither is decided. The pose stays as the wheels report it, and gets the mean square
of what it may be off by, with both equally likely: half the square of the jerk, along it. Ranges
then pull it to the one that is true, and are not refused meanwhile. The solution over all poses has
the same noise in these steps. No image holds frames of before and after.

A pause and missing frames are no jerks: a step may be any share of the motion around it, by the
time that it took.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.robust.parameters import SlipRule
from slam.robust.state import Array, Motion, quarter_turn, rotation

MOST_STEPS = 2
"""Steps of the longest jerk: a slip between two frames of different radars falls into two."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TimedStep:
    """A motion that the wheels report, and how long it took."""

    motion: Motion
    elapsed_s: float

    @property
    def vector(self) -> Array:
        """Return dx, dy [m] and turn [rad], body frame before it."""
        return np.array([*self.motion.step_m, self.motion.turn_rad])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Jerk:
    """How uncertain a jerk leaves what the wheels report.

    Attributes
    ----------
    covariances
        Of each of its steps, shape (3, 3), dx, dy [m] and turn [rad] in the body frame before it:
        to be added to the noise of the wheels.
    since
        No motion, with the noise of all of them in the pose after the step that follows, in its
        body frame.
    """

    covariances: tuple[Array, ...]
    since: Motion


class JerkDetector:
    """Finds jerks among the steps that the wheels report, one step after they ended."""

    def __init__(self, rule: SlipRule) -> None:
        self._rule = rule
        self._scales = np.array([rule.steady_m, rule.steady_m, rule.steady_rad])
        self._steps: list[TimedStep] = []

    def begin_anew(self) -> None:
        """Forget the steps so far, as after a motion that the wheels did not report."""
        self._steps = []

    def take(self, motion: Motion, elapsed_s: float) -> Jerk | None:
        """Take a step, and return the jerk that ended before it, if there was one."""
        newest = TimedStep(motion=motion, elapsed_s=elapsed_s)
        self._steps = [*self._steps[-MOST_STEPS - 1 :], newest]
        for n in range(1, len(self._steps) - 1):
            jerk = self._jerk(self._steps[-n - 2 :])
            if jerk is not None:
                self._steps = self._steps[-1:]
                return jerk
        return None

    def _jerk(self, steps: Sequence[TimedStep]) -> Jerk | None:
        """Return what all steps but the first and the last report beyond these two."""
        first, *between, last = steps
        around_s = first.elapsed_s + last.elapsed_s
        away = last.vector / last.elapsed_s - first.vector / first.elapsed_s
        if not self._is_steady(0.5 * around_s * away):
            return None
        rate = (first.vector + last.vector) / around_s
        beyond = np.array([self._beyond(step, rate) for step in between])
        whole = beyond.sum(axis=0)
        if self._is_steady(whole):
            return None
        # The same error in all of its steps: more than that of independent ones
        share = np.sum(np.square(whole / self._scales)) / np.square(beyond / self._scales).sum()
        # As the pose after the last step has it, whose body frame is turned and moved by that step
        moved = (whole[:2] + whole[2] * quarter_turn(last.motion.step_m)) @ rotation(
            last.motion.turn_rad
        )
        since = np.array([*moved, whole[2]])
        return Jerk(
            covariances=tuple([0.5 * share * np.outer(one, one) for one in beyond]),
            since=Motion(
                step_m=np.zeros(2),
                turn_rad=0.0,
                covariance=0.5 * np.outer(since, since),
                walk_variance=0.0,
            ),
        )

    def _beyond(self, step: TimedStep, rate: Array) -> Array:
        """Return what a step reports beyond the share of a motion [m/s, rad/s] that is nearest."""
        expected = rate * step.elapsed_s
        square = float(np.sum(np.square(expected / self._scales)))
        along = float(np.sum(step.vector * expected / self._scales**2))
        share = min(max(along / square, 0.0), 1.0) if square > 0.0 else 0.0
        return np.asarray(step.vector - share * expected)

    def _is_steady(self, change: Array) -> bool:
        """Return whether a change of motion, dx, dy [m] and turn [rad], is an ordinary one."""
        return (
            math.hypot(change[0], change[1]) <= self._rule.steady_m
            and abs(float(change[2])) <= self._rule.steady_rad
        )

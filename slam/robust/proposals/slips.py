"""Possible slips: motion that the wheels report for a step or two between steps that are alike.

A robot has inertia, so a motion that begins and ends within two steps is as likely a slip of the
wheels as its own. The ranges at its end can hardly tell: a turn changes none, until the robot has
driven on. So neither is decided. The pose stays as the wheels report it, and gets the mean square
of what it may be off by, with both equally likely: half the square of that motion, along it. Ranges
then pull it to the one that is true, and are not refused meanwhile. The solution over all poses has
the same noise in these steps. No image holds frames of before and after.

A pause, missing frames and times that are a little off are no slips: a step may be any share of the
motion around it, up to half as much again, by the time that it took. Nor is what the noise of the
wheels explains. Wheels that turn less than the robot moves are not seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from slam.robust.parameters import SlipRule
from slam.robust.state import Array, Motion

MOST_STEPS = 2
"""Steps of the longest slip: one between two samples of odometry falls into two."""

Vector = tuple[float, float, float]  # dx, dy [m] and turn [rad], body frame before it
_NONE: Vector = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PossibleSlip:
    """How uncertain a possible slip leaves what the wheels report.

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


class SlipDetector:
    """Finds possible slips among the steps that the wheels report, one step after they ended.

    What is less than ``outlier_sigmas`` standard deviations of the wheels' noise is none.
    """

    def __init__(self, rule: SlipRule, outlier_sigmas: float) -> None:
        self._rule, self._outlier_sigmas = rule, outlier_sigmas
        self._weights = (1.0 / rule.steady_m**2, 1.0 / rule.steady_m**2, 1.0 / rule.steady_rad**2)
        self._steps: list[tuple[Vector, float]] = []  # and how long they took [s]
        self._variances: list[Vector] = []  # of their noise

    def begin_anew(self) -> None:
        """Forget the steps so far, as after a motion that the wheels did not report."""
        self._steps, self._variances = [], []

    def take(self, motion: Motion, elapsed_s: float) -> PossibleSlip | None:
        """Take a step, which took ``elapsed_s``; return the slip that ended before it, if any."""
        if elapsed_s <= 0.0:  # no rate of such a step is known
            self.begin_anew()
            return None
        dx, dy = motion.step_m.tolist()
        self._steps = [*self._steps[-MOST_STEPS - 1 :], ((dx, dy, motion.turn_rad), elapsed_s)]
        of_x, of_y, of_turn = motion.covariance.diagonal().tolist()
        self._variances = [*self._variances[-MOST_STEPS - 1 :], (of_x, of_y, of_turn)]
        for n in range(1, len(self._steps) - 1):
            slip = self._slip(self._steps[-n - 2 :])
            if slip is not None:
                self._steps, self._variances = self._steps[-1:], self._variances[-1:]
                return slip
        return None

    def _slip(self, steps: Sequence[tuple[Vector, float]]) -> PossibleSlip | None:
        """Return what all steps but the first and the last report beyond these two."""
        (first, first_s), *between, (last, last_s) = steps
        around_s = first_s + last_s
        change = [
            0.5 * around_s * (after / last_s - before / first_s)
            for before, after in zip(first, last, strict=True)
        ]
        if not self._is_steady(change):
            return None
        rate = [(before + after) / around_s for before, after in zip(first, last, strict=True)]
        beyond = [
            self._beyond(step, [value * took_s for value in rate]) for step, took_s in between
        ]
        whole = [sum(values) for values in zip(*beyond, strict=True)]
        # The share of a step that is a little short leaves over some of its turn
        between_s = sum(took_s for _, took_s in between)
        reported = [sum(values) for values in zip(*(step for step, _ in between), strict=True)]
        change = [one - value * between_s for one, value in zip(reported, rate, strict=True)]
        if self._is_steady(whole) or self._is_steady(change):
            return None
        # All of its steps have one error: together they are more uncertain than by separate ones
        share = self._square(whole) / sum(self._square(one) for one in beyond)
        since = np.zeros(3)
        for step, one in zip([*(step for step, _ in between), last], [*beyond, _NONE], strict=True):
            since = _after(since, step, one)
        return PossibleSlip(
            covariances=tuple([0.5 * share * np.outer(one, one) for one in beyond]),
            since=Motion(
                step_m=np.zeros(2),
                turn_rad=0.0,
                covariance=0.5 * np.outer(since, since),
                walk_variance=0.0,
            ),
        )

    def _beyond(self, step: Vector, expected: Sequence[float]) -> Vector:
        """Return what a step reports beyond the share of an expected motion that is nearest."""
        square = self._square(expected)
        products = zip(self._weights, step, expected, strict=True)
        along = sum(weight * one * other for weight, one, other in products)
        share = min(max(along / square, 0.0), self._rule.most_share) if square > 0.0 else 0.0
        x, y, turn = (one - share * other for one, other in zip(step, expected, strict=True))
        return x, y, turn

    def _square(self, motion: Sequence[float]) -> float:
        return sum(weight * value**2 for weight, value in zip(self._weights, motion, strict=True))

    def _is_steady(self, change: Sequence[float]) -> bool:
        """Return whether a change, dx, dy [m] and turn [rad], is an ordinary one."""
        x, y, turn = (sum(values) for values in zip(*self._variances, strict=True))
        most_m = max(self._rule.steady_m, self._outlier_sigmas * math.sqrt(x + y))
        most_rad = max(self._rule.steady_rad, self._outlier_sigmas * math.sqrt(turn))
        return math.hypot(change[0], change[1]) <= most_m and abs(change[2]) <= most_rad


def _after(error: Array, step: Vector, more: Vector) -> Array:
    """Return the error of a pose, shape (3,), dx, dy [m] and turn [rad] in its body frame.

    ``error`` is that of the pose before a step, ``more`` that of the step; both are small.
    """
    dx, dy, turn = step
    x, y = error[0] - error[2] * dy + more[0], error[1] + error[2] * dx + more[1]
    c, s = math.cos(turn), math.sin(turn)
    return np.array([c * x + s * y, c * y - s * x, error[2] + more[2]])

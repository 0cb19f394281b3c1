"""Possible slips: motion that the wheels report for up to three steps between steady motions.

A robot has inertia, so a motion that begins and ends within so few is as likely a slip of the
wheels as its own. The ranges at its end can hardly tell: a turn changes none, until the robot has
driven on. So neither is decided. The pose stays as the wheels report it, and gets the mean square
of what it may be off by, with both equally likely: half the square of that motion, along it. Ranges
then pull it to the one that is true, and are not refused meanwhile. The solution over all poses has
the same noise in these steps. No image holds frames of before and after.

Three steps may be two slips that follow on each other, but only if none is like the next one. A
pause, missing frames and times that are a little off are no slips: a step may be any share of the
motion around it, up to half as much again, by the time that it took. Nor is what the noise of the
wheels explains, or what is like the changes from step to step just before, as where wheels count
coarsely or the heading swings. Before its first step the robot is taken to have moved as after it.
Wheels that turn less than the robot moves are not seen.

Where the motion changes, as where a turn on the spot begins, a step may be any mixture of the
motion before and the one behind it: the robot slows down from the one and comes into the other.
What goes beyond all of these is a possible slip, once both motions were kept for two steps. It may
be off by what it has beyond that of the two which it is less like.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np

from slam.robust.parameters import SlipRule
from slam.robust.state import Array, Motion

Vector = tuple[float, float, float]  # dx, dy [m] and turn [rad], body frame before it
_ZERO: Vector = (0.0, 0.0, 0.0)
_SPREAD_OF_TWO = 2 + 2**2 / 2  # variance of what two steps have beyond the mean of two others


class _Step(NamedTuple):
    """What the wheels report of a step, how long it took, and the variances of its noise."""

    motion: Vector
    took_s: float
    variances: Vector


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PossibleSlip:
    """How uncertain a possible slip leaves what the wheels report.

    Attributes
    ----------
    covariances
        Of each of its steps, shape (3, 3), dx, dy [m] and turn [rad] in the body frame before it:
        to be added to the noise of the wheels.
    n_since
        How many steps followed them.
    since
        No motion, with the noise of all of them in the pose after the steps that followed, in its
        body frame.
    """

    covariances: tuple[Array, ...]
    n_since: int
    since: Motion


class SlipDetector:
    """Finds possible slips among the steps that the wheels report, a step or two after they ended.

    What is less than ``outlier_sigmas`` standard deviations of the wheels' noise is none. Nor is
    what is less than as many times the third quartile of the latest changes from step to step. For
    white noise that quartile is 1.6 standard deviations of a step; what two steps have beyond the
    two around them has 2. The limits of more steps are higher, as the noise of their sum is.
    """

    def __init__(self, rule: SlipRule, outlier_sigmas: float) -> None:
        self._rule, self._outlier_sigmas = rule, outlier_sigmas
        self._weights = (1.0 / rule.steady_m**2, 1.0 / rule.steady_m**2, 1.0 / rule.steady_rad**2)
        # The newest steps; None stands for the one before the first, which is not known
        self._steps: list[_Step | None] = [None]
        # Changes from step to step [m] and [rad], and how large three quarters of them are at most
        nothing = [(0.0, 0.0)] * rule.recent_steps
        self._changes: deque[tuple[float, float]] = deque(nothing, rule.recent_steps)
        self._recent_m, self._recent_rad = 0.0, 0.0

    def begin_anew(self) -> None:
        """Forget the steps so far, as after a motion that the wheels did not report."""
        self._steps = []

    def take(self, motion: Motion, elapsed_s: float) -> PossibleSlip | None:
        """Take a step, which took ``elapsed_s``; return the slip that ended before it, if any."""
        if not 0.0 < elapsed_s < math.inf:  # no rate of such a step is known
            self.begin_anew()
            return None
        dx, dy = motion.step_m.tolist()
        of_x, of_y, of_turn = motion.covariance.diagonal().tolist()
        last = _Step((dx, dy, motion.turn_rad), elapsed_s, (of_x, of_y, of_turn))
        slip = None
        for first, between in self._newest():
            # Before the first step the robot is taken to have moved as after it
            slip = slip or self._slip(first or last, between, last)
        slip = slip or self._slip_at_change(last)
        if self._steps and (before := self._steps[-1]) is not None:
            self._take_change(_change(before, last, last.took_s))
        # The two before a slip and the one behind it, too
        self._steps = [last] if slip else [*self._steps[-self._rule.most_steps - 2 :], last]
        return slip

    def _take_change(self, change: Vector) -> None:
        self._changes.append((math.hypot(change[0], change[1]), abs(change[2])))
        third_quartile = 3 * len(self._changes) // 4
        self._recent_m, self._recent_rad = (
            sorted(values)[third_quartile] for values in zip(*self._changes, strict=True)
        )

    def undecided_covariance(self) -> Array:
        """Return what the newest steps add to the covariance of the pose, (3, 3), body frame.

        If the robot goes on as before them, they may be a slip. The first step of all is compared
        with nothing yet.
        """
        errors = [np.zeros(3)]
        for first, between in self._newest():
            if first is not None:
                rate = [value / first.took_s for value in first.motion]
                excess = self._excess(between, [rate], [first, *between])
                errors += [] if excess is None else [_error_after(between, excess)]
        error = max(errors, key=lambda one: self._square(one.tolist()))
        return 0.5 * np.outer(error, error)

    def _newest(self) -> Iterator[tuple[_Step | None, list[_Step]]]:
        """Yield the newest steps that may be of one slip, fewest first, and the one before them."""
        for n in range(1, min(self._rule.most_steps, len(self._steps) - 1) + 1):
            first, *between = self._steps[-n - 1 :]
            if first is not None or n == 1:  # two that are alike and then end are a motion
                yield first, [step for step in between if step is not None]

    def _slip(self, first: _Step, between: Sequence[_Step], last: _Step) -> PossibleSlip | None:
        """Return what steps report beyond the one before and the one after them."""
        steps, around_s = [first, *between, last], first.took_s + last.took_s
        change = _change(first, last, 0.5 * around_s)
        if not self._is_steady(change, steps, 2.0):
            return None
        rate = [
            (before + after) / around_s
            for before, after in zip(first.motion, last.motion, strict=True)
        ]
        excess = self._excess(between, [rate], steps)
        if excess is None:
            return None
        # Where a motion begins or ends, a step is off the mean of both by half of the change
        if self._square([2.0 * value for value in change]) > self._square(_sum(excess)):
            return None
        return self._possible_slip(between, excess, [last])

    def _slip_at_change(self, last: _Step) -> PossibleSlip | None:
        """Return what steps report beyond one of the motions before and after them.

        Each of the two was kept for two steps, they differ, and the steps are no mixture of them.
        Which of the two the robot made is not known: the one is taken that the steps are less like.
        """
        steps = [step for step in self._steps if step is not None]
        for n in range(1, min(self._rule.most_steps, len(steps) - 3) + 1):
            *before, after = steps[-n - 3 :]
            one, first, *between = before
            if not (self._is_kept(one, first) and self._is_kept(after, last)):
                continue
            if self._is_kept(first, after):
                break  # `_slip` has judged it
            rates = [[value / step.took_s for value in step.motion] for step in (first, after)]
            if self._excess(between, rates, [first, *between, after]) is not None:
                errors = [
                    [_change(kept, step, step.took_s) for step in between]
                    for kept in (first, after)
                ]
                largest = max(errors, key=lambda one: self._square(_sum(one)))
                return self._possible_slip(between, largest, [after, last])
        return None

    def _is_kept(self, before: _Step, after: _Step) -> bool:
        """Return whether two steps are of one motion."""
        change = _change(before, after, 0.5 * (before.took_s + after.took_s))
        return self._is_steady(change, [before, after], 2.0)

    def _possible_slip(
        self, slipped: Sequence[_Step], excess: Sequence[Vector], since: Sequence[_Step]
    ) -> PossibleSlip:
        """Return the slip of steps that may be off by their excess, and steps since then."""
        # All of its steps have one error: together they are more uncertain than by separate ones
        share = self._square(_sum(excess)) / sum(self._square(one) for one in excess)
        error = _error_after([*slipped, *since], [*excess, *(_ZERO for _ in since)])
        return PossibleSlip(
            covariances=tuple([0.5 * share * np.outer(one, one) for one in excess]),
            n_since=len(since),
            since=Motion(
                step_m=np.zeros(2),
                turn_rad=0.0,
                covariance=0.5 * np.outer(error, error),
                walk_variance=0.0,
            ),
        )

    def _excess(
        self, steps: Sequence[_Step], rates: Sequence[Sequence[float]], around: Sequence[_Step]
    ) -> list[Vector] | None:
        """Return what steps report beyond one or two rates of motion; None if that is ordinary.

        ``around`` are all steps that the rates are of, and these.
        """
        expected = [
            [_vector([value * step.took_s for value in rate]) for rate in rates] for step in steps
        ]
        spread = len(steps) + len(steps) ** 2 / 2  # white noise, against the mean of two others
        # By its shares a step that is a little short in all would lack some of its turn
        means = [
            [-sum(values) / len(rates) for values in zip(*one, strict=True)] for one in expected
        ]
        change = _sum([*(step.motion for step in steps), *means])
        if self._is_steady(change, around, spread):
            return None
        if len(steps) > 2 and any(
            self._is_steady(_change(one, other, other.took_s), [one, other], 2.0)
            for one, other in pairwise(steps)
        ):
            return None  # it kept its rate, as a motion does, and two slips do not
        by_most, beyond = (
            [self._off(step.motion, one, most) for step, one in zip(steps, expected, strict=True)]
            for most in (self._rule.most_share, 1.0)
        )
        if any(self._is_steady(_sum(one), around, spread) for one in (by_most, beyond)):
            return None
        return beyond

    def _off(self, step: Vector, expected: Sequence[Vector], most_share: float) -> Vector:
        """Return what a step has beyond the nearest of the ordinary motions.

        These are all mixtures of one or two expected motions, with shares that add up to
        ``most_share`` at most.
        """
        corners = [_ZERO, *(_vector([most_share * value for value in one]) for one in expected)]
        off = [self._off_line(step, one, other) for one, other in combinations(corners, 2)]
        if len(expected) == 2:
            metric = np.sqrt(self._weights)
            along = np.array(expected).T * metric[:, None]
            shares = np.linalg.lstsq(along, np.array(step) * metric)[0]
            if shares.min() >= 0.0 and shares.sum() <= most_share:
                rest = (np.array(step) * metric - along @ shares) / metric
                off.append(_vector(rest.tolist()))
        return min(off, key=self._square)

    def _off_line(self, step: Vector, begin: Vector, end: Vector) -> Vector:
        """Return what a step has beyond the nearest motion on the line from one to another."""
        line = [after - before for before, after in zip(begin, end, strict=True)]
        square = self._square(line)
        products = zip(self._weights, step, begin, line, strict=True)
        along = sum(weight * (value - origin) * other for weight, value, origin, other in products)
        share = min(max(along / square, 0.0), 1.0) if square > 0.0 else 0.0
        return _vector(
            [
                value - origin - share * other
                for value, origin, other in zip(step, begin, line, strict=True)
            ]
        )

    def _square(self, motion: Sequence[float]) -> float:
        return sum(weight * value**2 for weight, value in zip(self._weights, motion, strict=True))

    def _is_steady(self, change: Sequence[float], steps: Sequence[_Step], spread: float) -> bool:
        """Return whether a change among steps, dx, dy [m] and turn [rad], is an ordinary one.

        ``spread`` is the variance of the change over that of a step, for white noise.
        """
        x, y, turn = (spread / len(steps) * one for one in _sum([one.variances for one in steps]))
        sigmas, factor = self._outlier_sigmas, max(math.sqrt(spread / _SPREAD_OF_TWO), 1.0)
        steady_m = max(self._rule.steady_m, sigmas * self._recent_m) * factor
        steady_rad = max(self._rule.steady_rad, sigmas * self._recent_rad) * factor
        is_short = math.hypot(change[0], change[1]) <= max(steady_m, sigmas * math.sqrt(x + y))
        return is_short and abs(change[2]) <= max(steady_rad, sigmas * math.sqrt(turn))


def _vector(values: Sequence[float]) -> Vector:
    x, y, turn = values
    return x, y, turn


def _sum(motions: Sequence[Sequence[float]]) -> Vector:
    x, y, turn = (sum(values) for values in zip(*motions, strict=True))
    return x, y, turn


def _change(before: _Step, after: _Step, took_s: float) -> Vector:
    """Return by how much the motion in a time differs between two steps."""
    x, y, turn = (
        took_s * (new / after.took_s - old / before.took_s)
        for old, new in zip(before.motion, after.motion, strict=True)
    )
    return x, y, turn


def _error_after(steps: Sequence[_Step], errors: Sequence[Vector]) -> Array:
    """Return the error of the pose after steps, shape (3,), dx, dy [m] and turn [rad].

    It is in the body frame of that pose; ``errors`` are those of the steps, and small.
    """
    x, y, angle = _ZERO
    for step, more in zip(steps, errors, strict=True):
        dx, dy, turn = step.motion
        x, y = x - angle * dy + more[0], y + angle * dx + more[1]
        c, s = math.cos(turn), math.sin(turn)
        x, y, angle = c * x + s * y, c * y - s * x, angle + more[2]
    return np.array([x, y, angle])

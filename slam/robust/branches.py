"""Slips and kidnapping: alternatives to where the main back end has the robot.

Wheels slip and robots are carried. Both make the ranges of known landmarks unlikely, and are the
same question with two prices: is there a motion the wheels did not report that explains the ranges
better? The back end itself believes its odometry. Around it, ``Branches`` keep the last motions and
scans, and the evidence of each range for the pose (``UpdateReport.evidence``).

Suspicion
    The evidence since each step is summed over the landmarks known then, at most so much against
    each: a cumulative sum test (Page, Biometrika 41, 1954). The step with the largest sum against
    the pose is where the robot may have been carried. It may have slipped where the innovations
    grow beyond what they were all along.
Slip
    Copies of the main back end go back to a few steps before that, and take the motions and scans
    since once more, a slip added to the noise of one step, another one for each copy.
Recognition
    Where nothing is known that could be missed, landmarks of the last steps may yet lie on older
    ones as a constellation. If the map lets them be the same, they are merged, and a loop is
    closed; if not, the robot may have been carried before it saw the first of them.
Carry
    A back end with an empty map takes the motions and scans since. Where its landmarks lie on the
    map of the main back end as it was then is searched for (`slam.robust.constellation`). A copy of
    that back end is set down there, and takes the motions and scans since.
Decision
    Every back end is judged by the evidence of the same scans. An alternative is adopted when it
    explains more ranges than the main one and its evidence is larger by its price, and dropped
    when it has not after some steps. Nothing is forgotten before that, and the main back end goes
    on. The robot is reported as lost only while the empty map explains the scans better than the
    main one does with what it knew then, by the price of a carry, and no place for it is found.
    With fewer landmarks in a map than a placement takes there is nothing to be found, and the main
    back end goes on with new ones.

While nothing is suspicious that costs a copy of the back end now and then.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from slam.geometry import Rig
from slam.results import UpdateReport
from slam.robust.association import RangeScan
from slam.robust.back_end import RobustBackEnd
from slam.robust.constellation import constellation_of, find_placement
from slam.robust.parameters import BackEndParameters, BranchRule
from slam.robust.state import Array

# Steps between two snapshots, and how many are kept: a carry that is noticed later than that is
# dated to the oldest.
_SNAPSHOT_EVERY, _SNAPSHOTS = 50, 9
# Steps between two looks for suspicion, and how many an alternative that lags behind takes a step
_LOOK_EVERY, _CATCH_UP = 5, 10
# How many sigmas of a slip a prediction may be uncertain by after one
_SLIPPING_SIGMAS = 4.0
# After how many times `BranchRule.steps` a slip, and a place, are dropped
_SLIP_PATIENCE, _PLACE_PATIENCE = 3, 4
# How many steps after the likeliest one a slip is tried
_STARTS_AFTER = 2
# This many landmarks may give the evidence of a whole price, but not more than it
_LANDMARKS_OF_PRICE = 2.0
# How many of the newest landmarks are looked for among all others; at most one in two is new
_NEWEST, _OLD_AND_NEW = 8, 2
# A missing range counts as one three standard deviations off. How fast what is usual is forgotten
# per step, how many ranges as predicted it begins with, and by how many standard deviations of
# chi-square the innovations must be too large for a slip to be looked for
_MISSED_SQUARE, _FADING, _USUAL_COUNT, _STRAINED = 9.0, 0.998, 20.0, 4.0
# By how much the covariance of the points is enlarged by which the robot is set down
_WEAKENED = 4.0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """One motion with the scans at its end, and their evidence for the main back end's pose."""

    increment: Array
    covariance: Array | None
    scans: Sequence[RangeScan]
    next_id: int  # landmarks known before it have smaller ids
    evidence: tuple[tuple[int, float], ...]
    table: Array  # the evidence, shape (k, 2): ids and nats


class Tally:
    """The evidence of some steps for one back end."""

    def __init__(self, rule: BranchRule) -> None:
        self._rule = rule
        self._of_landmark: dict[int, float] = {}
        self._explained = 0.0  # by ranges, those missed left out

    def add(self, evidence: Sequence[tuple[int, float]]) -> None:
        for landmark_id, nats in evidence:
            share = nats / self._rule.correlated_steps
            self._of_landmark[landmark_id] = self._of_landmark.get(landmark_id, 0.0) + share
            self._explained += max(share, 0.0)

    def total(self, most: float = math.inf) -> float:
        """Return the sum over the landmarks, each between ``-most_against`` and a bound."""
        least = -self._rule.most_against
        return math.fsum(min(max(nats, least), most) for nats in self._of_landmark.values())

    def gain(self, other: Tally, most: float) -> float:
        """Return how much likelier this is than the other, each landmark counting at most so much.

        Both have the same landmarks. Nothing is likelier by explaining less: where little is
        certain, little can be missed.
        """
        mine, theirs = self._of_landmark, other._of_landmark
        differences = [
            mine.get(landmark_id, 0.0) - theirs.get(landmark_id, 0.0)
            for landmark_id in mine.keys() | theirs.keys()
        ]
        bounded = math.fsum(min(max(one, -most), most) for one in differences)
        return min(bounded, self._more(other))

    def gain_over_other_map(self, other: Tally, most: float) -> float:
        """Return what ``gain`` does where the two have no landmark in common."""
        return min(self.total(most) - other.total(most), self._more(other))

    def _more(self, other: Tally) -> float:
        return 2.0 * (self._explained - other._explained)


class Alternative:
    """A back end that takes the steps from ``since`` on, and its evidence against the main one's.

    One that ``is_new`` began with an empty map. One ``set_down`` begins at the end of the first of
    these motions, which it does not take.
    ``slipping`` is the step to whose noise a slip is added, if any.
    """

    def __init__(
        self,
        back_end: RobustBackEnd,
        since: int,
        rule: BranchRule,
        *,
        set_down: bool = False,
        slipping: int | None = None,
        is_new: bool = False,
    ) -> None:
        self.back_end = back_end
        self.since = self.next_step = since
        self.price = rule.carry_price if set_down else rule.slip_price
        self.set_down = set_down
        self._rule = rule
        self._slipping = slipping
        self._next_id = 0  # landmarks known when it began have smaller ids
        self._is_new = is_new
        self._own, self._main = Tally(rule), Tally(rule)

    @property
    def gain(self) -> float:
        """Return by how much this is likelier than the main one since it began, in nats.

        Three landmarks must be for it if that is to exceed the price, and it must be as much
        likelier than that the robot is elsewhere. A map of its own begins with nothing.
        """
        most = self.price / _LANDMARKS_OF_PRICE
        if self._is_new:
            return self._own.gain_over_other_map(self._main, most)
        return min(self._own.gain(self._main, most), self._own.total(self._rule.most_for))

    def take(self, step: Step) -> None:
        rule, back_end, number = self._rule, self.back_end, self.next_step
        if number > self.since or not self.set_down:
            covariance = step.covariance
            if number == self._slipping:
                slip = np.square([rule.slip_m, rule.slip_m, rule.slip_rad])
                covariance = back_end.step_covariance(step.increment, covariance) + np.diag(slip)
            back_end.predict(step.increment, covariance)
        begins = self._slipping is not None and number < self.since + rule.steps
        sure_m = _SLIPPING_SIGMAS * rule.slip_m if begins else None
        report = back_end.update(step.scans, sure_m=sure_m, solve=False)
        # Landmarks that the main one mapped after it went wrong explain the ranges there, too.
        if number == self.since:
            self._next_id = step.next_id
        known = math.inf if self._is_new else self._next_id
        self._own.add([one for one in report.evidence if one[0] < known])
        self._main.add([one for one in step.evidence if one[0] < self._next_id])
        self.next_step += 1


@dataclass(slots=True, kw_only=True)
class Carry:
    """The question whether, and whereto, the robot was carried before a step."""

    map: RobustBackEnd  # the main back end after the step before
    new: Alternative  # with an empty map at first
    search_from: int  # the step from which on its place is searched for


class InnovationTest:
    """Whether the innovations of the last steps are larger than they were all along."""

    def __init__(self, steps: int) -> None:
        self._last: deque[tuple[float, int]] = deque(maxlen=2 * steps)
        self._steps = steps
        self._usual_square, self._usual_count = _USUAL_COUNT, _USUAL_COUNT

    def add(self, report: UpdateReport) -> None:
        """Count the ranges of a scan; one that is missing is as bad as one far off."""
        missed = len(report.evidence) - report.dof
        self._last.append((report.nis + _MISSED_SQUARE * missed, report.dof + missed))
        square, count = self._last[0]
        if len(self._last) == self._last.maxlen:
            self._usual_square = _FADING * self._usual_square + square
            self._usual_count = _FADING * self._usual_count + count

    def restart(self) -> None:
        self._last.clear()

    def steps_ago(self) -> int | None:
        """Return how many steps ago they began to be too large; None if they are not."""
        usual = max(self._usual_square / self._usual_count, 1.0)
        total, count, most, begin = 0.0, 0, 0.0, None
        for ago, (square, n) in enumerate(reversed(self._last), start=1):
            total += square - usual * n
            count += n
            excess = total / (usual * math.sqrt(2.0 * max(count, 1)))
            if excess > most:
                most, begin = excess, ago
        return begin if most > _STRAINED else None


class Branches:
    """The main back end, its alternatives, and the decision between them.

    ``predict`` and ``update`` alternate as in ``RobustBackEnd``.
    """

    def __init__(self, rig: Rig, parameters: BackEndParameters) -> None:
        self.main = RobustBackEnd(rig, parameters)
        self._rule = parameters.branches
        self._steps: dict[int, Step] = {}  # by number, those that are needed still
        self._now = 0  # number of the next step
        self._motion: tuple[Array, Array | None] | None = None
        self._snapshots: dict[int, RobustBackEnd] = {}  # by the number of the step after it
        self._slip: Alternative | None = None
        self._placed: Alternative | None = None
        self._carry: Carry | None = None
        self._no_slip_until = self._tried_until = self._judged = 0
        self._recognised_ids: set[int] = set()  # new landmarks that were searched for
        self._innovations = InnovationTest(self._rule.steps)
        self.is_lost = False

    @property
    def map(self) -> RobustBackEnd:
        """Return the back end whose map is reported: as it was, while the robot is lost."""
        return self._carry.map if self.is_lost and self._carry is not None else self.main

    @property
    def lost_covariance(self) -> Array | None:
        """Return the covariance (3, 3) of the pose while the robot is lost, None else."""
        if not self.is_lost:
            return None
        sigma_m = self._rule.lost_position_m
        return np.diag([sigma_m**2, sigma_m**2, math.pi**2 / 3.0])

    def predict(self, increment: Array, covariance: Array | None = None) -> None:
        """Move by an odometry increment: dx, dy [m], turn [rad] in the body frame before it."""
        if self._now % _SNAPSHOT_EVERY == 0:
            self._keep_snapshot()
        self._motion = increment, covariance
        self.main.predict(increment, covariance)

    def update(self, scans: Sequence[RangeScan]) -> UpdateReport:
        """Take in the scans of one time; a radar without a frame is absent, not empty."""
        if self._motion is None:
            raise ValueError("scans without a motion before them")
        next_id = self.main.state.next_id
        report = self.main.update(scans)
        increment, covariance = self._motion
        self._steps[self._now] = Step(
            increment=increment,
            covariance=covariance,
            scans=scans,
            next_id=next_id,
            evidence=report.evidence,
            table=np.array(report.evidence).reshape(-1, 2),
        )
        self._now += 1
        if any(scan.labels is not None for scan in scans):
            return report
        self._innovations.add(report)
        was_lost = self.is_lost
        carried = self._decide()
        if self._now % _LOOK_EVERY == 0:
            self._look()
        carried |= self.is_lost and not was_lost
        return replace(report, carried=carried, lost=self.is_lost)

    def _keep_snapshot(self) -> None:
        self._snapshots[self._now] = self.main.copy()
        for old in sorted(self._snapshots)[:-_SNAPSHOTS]:
            del self._snapshots[old]
        needed = min(self._snapshots)
        if self._carry is not None:
            needed = min(needed, self._carry.new.since)
        for old in [number for number in self._steps if number < needed]:
            del self._steps[old]

    def _at(self, number: int) -> RobustBackEnd:
        """Return a copy of the main back end as it was before a step."""
        begin = max(kept for kept in self._snapshots if kept <= number)
        back_end = self._snapshots[begin].copy()
        self._lead(back_end, begin, number)
        return back_end

    def _lead(self, back_end: RobustBackEnd, begin: int, end: int) -> None:
        for number in range(begin, end):
            step = self._steps[number]
            back_end.predict(step.increment, step.covariance)
            back_end.update(step.scans, solve=False)

    def _is_up_to_date(self, other: Alternative) -> bool:
        """Let an alternative take some of its steps; return whether none is left."""
        for number in range(other.next_step, min(other.next_step + _CATCH_UP, self._now)):
            other.take(self._steps[number])
        return other.next_step == self._now

    def _decide(self) -> bool:
        """Adopt or drop alternatives; return whether the robot was carried elsewhere."""
        rule, slip, carry, placed = self._rule, self._slip, self._carry, self._placed
        if slip is not None and self._is_up_to_date(slip):
            if slip.gain > slip.price:
                self._adopt(slip)
                return False
            if self._now - slip.since > _SLIP_PATIENCE * rule.steps:
                self._slip = None
        if placed is not None and self._is_up_to_date(placed):
            if placed.gain > placed.price:
                was_lost = self.is_lost
                self._adopt(placed)
                return not was_lost
            if self._now > self._tried_until:
                self._placed = None
        if carry is not None and self._is_up_to_date(carry.new):
            gain = carry.new.gain
            self.is_lost = gain > (0.0 if self.is_lost else rule.carry_price)
            if gain < -rule.carry_price and self._placed is None:
                # The evidence against the pose until now has been judged.
                self._carry, self._judged = None, self._now
        return False

    def _adopt(self, other: Alternative) -> None:
        """Let an alternative be the main back end."""
        self.main = other.back_end
        self._slip = self._placed = self._carry = None
        self.is_lost = False
        self._snapshots = {self._now: self.main.copy()}
        self._innovations.restart()
        self._no_slip_until = self._judged = self._now

    def _look(self) -> None:
        """Look for evidence against the pose, and begin alternatives."""
        rule = self._rule
        ago = self._innovations.steps_ago() or 0
        # Some steps after it began, its begin and its effect are clearer.
        if ago > _LOOK_EVERY and not self.is_lost and self._now - ago > self._no_slip_until:
            self._begin_slip(self._now - ago)
            self._no_slip_until = self._now - _LOOK_EVERY
        if self._carry is None:
            since, against = self._evidence_of_carry()
            if against <= rule.suspicious:
                since = self._recognised()
            if since < self._now:
                self._begin_carry(since)
        elif self._placed is None and self._now >= self._carry.search_from:
            self._search(self._carry)

    def _evidence_of_carry(self) -> tuple[int, float]:
        """Return the step before which the robot may have been carried, and the evidence of that.

        More than one landmark must be against the pose: one alone may be hidden or taken away.
        """
        rule, first = self._rule, max(min(self._snapshots), self._judged)
        steps = [self._steps[number] for number in range(first, self._now)]
        lengths = [len(step.evidence) for step in steps]
        if not sum(lengths):
            return self._now, 0.0
        table = np.concatenate([step.table for step in steps])
        ids, place = np.unique(table[:, 0], return_inverse=True)
        against = np.zeros((len(steps), len(ids)))
        np.add.at(against, (np.repeat(np.arange(len(steps)), lengths), place), -table[:, 1])
        # From each step on, each landmark within its bounds, if it was known before the step
        sums = np.cumsum(against[::-1], axis=0)[::-1] / rule.correlated_steps
        sums = np.clip(sums, -rule.most_for, rule.most_against)
        known = ids < np.array([step.next_id for step in steps])[:, None]
        totals = np.where(known, sums, 0.0).sum(axis=1)
        several = totals > np.where(known, sums, -np.inf).max(axis=1)
        best = int(np.argmax(np.where(several, totals, -np.inf)[::-1]))
        best = len(steps) - 1 - best  # the latest of equals
        if not several[best] or totals[best] <= 0.0:
            return self._now, 0.0
        return first + best, float(totals[best])

    def _recognised(self) -> int:
        """Return the step before which the robot was elsewhere if new landmarks lie on older ones.

        Where the map itself lets them be the same landmarks, a loop is closed: they are merged.
        """
        main, rule, first = self.main, self._rule, max(min(self._snapshots), self._judged)
        rows, ids = main.reported_rows(), main.state.landmark_ids
        oldest_id = self._steps[first].next_id if first < self._now else main.state.next_id
        newest = sorted(rows, key=lambda row: -ids[row])[: min(_NEWEST, len(rows) // _OLD_AND_NEW)]
        new = [row for row in newest if ids[row] >= oldest_id]
        new_ids = {ids[row] for row in new}
        if new_ids <= self._recognised_ids:
            return self._now
        self._recognised_ids = new_ids
        older = [row for row in rows if ids[row] not in new_ids]
        here = constellation_of(main.state, new, rule.model_sigma_m)
        there = constellation_of(main.state, older, rule.model_sigma_m)
        placement = find_placement(here, there, rule)
        if placement is None or placement.evidence < rule.suspicious:
            return self._now
        if main.merge_if_possible([(older[row], new[own]) for row, own in placement.pairs]):
            return self._now
        oldest_new_id = min(here.ids[own] for _, own in placement.pairs)
        steps = [n for n in range(first, self._now) if self._steps[n].next_id <= oldest_new_id]
        return max(steps[-1] - rule.steps, first)

    def _begin_slip(self, since: int) -> None:
        """Go back to about a step, try a slip at each of some steps around it; keep the best."""
        width, oldest = _LOOK_EVERY, min(self._snapshots)
        back_end, tried = self._at(max(since - width, oldest)), []
        for start in range(max(since - width, oldest), min(since + _STARTS_AFTER, self._now)):
            slip = Alternative(back_end.copy(), start, self._rule, slipping=start)
            for number in range(start, self._now):
                slip.take(self._steps[number])
            tried.append(slip)
            self._lead(back_end, start, start + 1)
        self._slip = max(tried, key=lambda one: one.gain)

    def _begin_carry(self, since: int) -> None:
        before = self._at(since)
        if len(before.reported_rows()) >= self._rule.least_landmarks:
            new = Alternative(
                before.with_empty_map(), since, self._rule, set_down=True, is_new=True
            )
            self._carry = Carry(map=before, new=new, search_from=self._now)

    def _search(self, carry: Carry) -> None:
        """Search for the new map's place on the old one; set a copy of the old one down there."""
        rule, new = self._rule, carry.new.back_end
        here = constellation_of(new.state, new.reported_rows(), rule.model_sigma_m)
        there = constellation_of(carry.map.state, carry.map.reported_rows(), rule.model_sigma_m)
        placement = find_placement(here, there, rule)
        if placement is None:
            return
        points = []
        for row, own in placement.pairs:
            block = slice(2 * own, 2 * own + 2)
            # The same ranges are taken once more, so this use of them must hardly count.
            covariance = _WEAKENED * here.covariance_m2[block, block]
            points.append((there.ids[row], here.points_m[own], covariance))
        back_end = carry.map.copy()
        back_end.set_down(placement.motion, points)
        self._placed = Alternative(back_end, carry.new.since, rule, set_down=True)
        self._tried_until = carry.search_from = self._now + _PLACE_PATIENCE * rule.steps

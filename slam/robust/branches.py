"""Kidnapping: the question whether the robot was carried, and to which place.

The back end itself believes its odometry. ``Branches`` keep its last motions and scans, and the
evidence of each range for its pose (``UpdateReport.evidence``).

Suspicion
    The evidence since each step is summed over the landmarks known then, at most so much against
    each: a cumulative sum test (Page, Biometrika 41, 1954). The step with the largest sum against
    the pose is where the robot may have been carried.
Recognition
    Where nothing is known that could be missed, landmarks of the last steps may yet lie on older
    ones as a constellation. If the whole run can be solved with them merged, a loop is closed; if
    not, the robot may have been carried before it saw the first of them.
Search
    A back end with an empty map takes the motions and scans since. Where its landmarks lie on the
    map of the main back end as it was then is searched for (`slam.robust.constellation`). A copy of
    that back end is set down there, and takes the motions and scans since.
Decision
    Both are judged by the evidence of the same scans. The place is adopted when it explains more
    ranges than the main back end does and its evidence is larger by the price of a carry, and
    dropped when it has not after some steps. Nothing is forgotten before that, and the main back
    end goes on. The robot is reported as lost while the landmarks known before the carry, three or
    more of them, are against its pose by that price, and others are seen. That ends when they are
    no longer against it, or a place is adopted, or after `BranchRule.carry_steps` with no place on
    trial.

While nothing is suspicious that costs a copy of the back end now and then.

``Hypotheses`` are for detections with bearings: where it is unclear which landmark a tentative one
is, every option is followed by a back end of its own (D. B. Reid, "An Algorithm for Tracking
Multiple Targets", IEEE Transactions on Automatic Control 24(6), 1979).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slam.geometry import Rig, compose, has_moved
from slam.results import UpdateReport
from slam.robust.association import RangeScan
from slam.robust.back_end import RobustBackEnd
from slam.robust.constellation import constellation_of, find_placement
from slam.robust.initialisation import Question
from slam.robust.parameters import BackEndParameters, BranchRule
from slam.robust.state import Array

# An alternative's new landmarks get ids so far beyond the main one's: no id is used twice.
_IDS_APART = 1000


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Step:
    """One motion with the scans at its end, and their evidence for the main back end's pose."""

    increment: Array
    scans: Sequence[RangeScan]
    next_id: int  # landmarks known before it have smaller ids
    evidence: Array  # shape (k, 2): ids and nats


class Hypotheses:
    """Back ends that took unclear detections for different landmarks; the likeliest is believed.

    Each is judged by the evidence that it has gathered (`RobustBackEnd.evidence`). One is dropped
    if it is less likely than the best by `BranchRule.price_nats`, if its pose is nearer to that of
    a likelier one than two keyframes are, or if there are more than `BranchRule.snapshots`.
    """

    def __init__(self, rig: Rig, parameters: BackEndParameters) -> None:
        self._parameters = parameters
        self._back_ends = [RobustBackEnd(rig, parameters)]

    @property
    def best(self) -> RobustBackEnd:
        return self._back_ends[0]

    @property
    def pose(self) -> Array:
        """Return the mean of all poses by likelihood, [x m, y m, heading rad], map frame.

        If the evidence is right, no other position has a smaller mean square error.
        """
        poses = np.array([one.pose for one in self._back_ends])
        weights = np.exp([one.evidence - self.best.evidence for one in self._back_ends])
        weights /= weights.sum()
        x, y = weights @ poses[:, :2]
        c, s = weights @ np.cos(poses[:, 2]), weights @ np.sin(poses[:, 2])
        return np.array([x, y, math.atan2(s, c)])

    def predict(self, increment: Array) -> None:
        """Move all by an odometry increment: dx, dy [m], turn [rad] in the body frame before it."""
        for back_end in self._back_ends:
            back_end.predict(increment)

    def update(self, scans: Sequence[RangeScan]) -> None:
        """Take in the scans of one time, and follow the options of each question that is open."""
        decided: list[RobustBackEnd] = []
        for back_end in self._back_ends:
            back_end.update(scans, decide=False)
            decided += self._decided(back_end)
        rule, kept = self._parameters.relinearisation, list[RobustBackEnd]()
        for one in self._likely(decided):
            is_like = any(
                not has_moved(one.pose, other.pose, rule.key_m, rule.key_rad) for other in kept
            )
            if not is_like:
                kept.append(one)
        self._back_ends = kept[: self._parameters.branches.snapshots]

    def _decided(self, back_end: RobustBackEnd) -> list[RobustBackEnd]:
        """Return what a back end becomes by the answers to its questions: the likeliest of them."""
        asking, decided, price_nats = [back_end], list[RobustBackEnd](), self._price_nats
        while asking:
            answered: list[RobustBackEnd] = []
            for one in asking:
                question = one.question()
                if question is None:
                    decided.append(one)
                else:
                    answered += _answered(one, question, price_nats)
            asking = self._likely(answered)[: self._parameters.branches.snapshots]
        return decided

    def _likely(self, back_ends: Sequence[RobustBackEnd]) -> list[RobustBackEnd]:
        """Return the likeliest, and those that are less likely by no more than the price."""
        ranked = sorted(back_ends, key=lambda one: -one.evidence)
        return [one for one in ranked if ranked[0].evidence - one.evidence <= self._price_nats]

    @property
    def _price_nats(self) -> float:
        return self._parameters.branches.price_nats


def _answered(
    back_end: RobustBackEnd, question: Question, price_nats: float
) -> list[RobustBackEnd]:
    """Return a back end for each option of a question that is not too unlikely."""
    first = question.options[0]
    found = []
    for k, option in enumerate(question.options[1:], start=1):
        if first.evidence - option.evidence > price_nats:
            break
        child = back_end.copy()
        asked = child.question()
        assert asked is not None
        if child.answer(asked, asked.options[k]):
            found.append(child)
    return [back_end, *found] if back_end.answer(question, first) else found


def evidence_table(report: UpdateReport) -> Array:
    """Return ids and evidence [nats] of a report, shape (k, 2)."""
    return np.array(report.evidence).reshape(-1, 2)


def totals_of(tables: Iterable[Array], known_before: int, correlated_steps: float) -> Array:
    """Return ids and summed evidence [nats], (n, 2), of the landmarks below an id.

    The errors of so many steps are taken to be one.
    """
    table = np.concatenate([np.empty((0, 2)), *tables])
    table = table[table[:, 0] < known_before]
    ids, place = np.unique(table[:, 0], return_inverse=True)
    return np.column_stack([ids, np.bincount(place, table[:, 1], len(ids)) / correlated_steps])


def gain(own: Array, main: Array, rule: BranchRule) -> float:
    """Return by how much a place is likelier than the main back end's pose, in nats.

    ``own`` and ``main`` are totals of the same landmarks. ``least_landmarks`` of them must be for
    it if that is to exceed the price, and it must be as much likelier than that the robot is
    elsewhere. Nothing is likelier by explaining less: where little is certain, little can be
    missed.
    """
    ids = np.union1d(own[:, 0], main[:, 0])
    mine, theirs = np.zeros(len(ids)), np.zeros(len(ids))
    mine[np.searchsorted(ids, own[:, 0])] = own[:, 1]
    theirs[np.searchsorted(ids, main[:, 0])] = main[:, 1]
    most = rule.price_nats / (rule.least_landmarks - 1)
    return min(
        float(np.clip(mine - theirs, -most, most).sum()),
        float(np.clip(mine, -rule.most_against, rule.most_for).sum()),
        2.0 * float(np.maximum(mine, 0.0).sum() - np.maximum(theirs, 0.0).sum()),
    )


class Alternative:
    """A back end that takes the steps since a carry."""

    def __init__(self, back_end: RobustBackEnd, since: int) -> None:
        self.back_end = back_end
        self.until: int | None = None  # step at which it is dropped, once it has caught up
        self.next_step = since
        self.evidence: list[Array] = []  # of each step taken, as `evidence_table` has it

    def take(self, steps: Mapping[int, Step], end: int) -> None:
        """Take the steps before ``end``; of the very first one the motion is the carry."""
        for number in range(self.next_step, end):
            step = steps[number]
            if self.evidence:
                self.back_end.predict(step.increment)
            report = self.back_end.update(step.scans, solve=False)
            self.evidence.append(evidence_table(report))
            self.next_step = number + 1


@dataclass(slots=True, kw_only=True)
class Carry:
    """The question whether the robot was carried before a step, and to which place."""

    since: int
    next_id: int  # landmarks known before it have smaller ids
    map: RobustBackEnd  # the main back end after the step before
    new: Alternative  # with an empty map at first
    search_from: int  # the step from which on its place is searched for
    moved: Array  # shape (3,), [m, m, rad], body frame before it: odometry since
    placed: Alternative | None = None  # with the map before it, and the robot set down on that


class Branches:
    """The main back end, the question of a carry, and its decision.

    ``predict`` and ``update`` alternate as in ``RobustBackEnd``.
    """

    def __init__(self, rig: Rig, parameters: BackEndParameters) -> None:
        self.main = RobustBackEnd(rig, parameters)
        self._rule = parameters.branches
        self._look_every, self._window = parameters.map.look_every, parameters.tracklets.window
        self._steps: dict[int, Step] = {}  # by number, those that are needed still
        self._now = 0  # number of the next step
        self._increment: Array | None = None
        self._snapshots: dict[int, RobustBackEnd] = {}  # by the number of the step after it
        self._carry: Carry | None = None
        self._judged = 0  # the evidence of the steps before it has been judged
        self._recognised_ids: set[int] = set()  # new landmarks that were searched for
        self.is_lost = False

    @property
    def map(self) -> RobustBackEnd:
        """Return the back end whose map is reported: as it was, while the robot is lost."""
        return self._carry.map if self.is_lost and self._carry is not None else self.main

    @property
    def lost_pose(self) -> tuple[Array, Array] | None:
        """Return pose (3,) and covariance (3, 3) to report while the robot is lost, None else.

        The pose is that before the carry, and odometry since: [m, m, rad], map frame.
        """
        if not self.is_lost or self._carry is None:
            return None
        sigma_m = self._rule.lost_position_m
        covariance = np.diag([sigma_m**2, sigma_m**2, math.pi**2 / 3.0])
        return compose(self._carry.map.pose, self._carry.moved), covariance

    def predict(self, increment: Array) -> None:
        """Move by an odometry increment: dx, dy [m], turn [rad] in the body frame before it."""
        if self._now % self._rule.snapshot_every == 0:
            self._keep_snapshot()
        self._increment = increment
        self.main.predict(increment)
        if self._carry is not None:
            self._carry.moved = compose(self._carry.moved, increment)

    def update(self, scans: Sequence[RangeScan]) -> UpdateReport:
        """Take in the scans of one time; a radar without a frame is absent, not empty."""
        if self._increment is None:
            raise ValueError("scans without a motion before them")
        next_id = self.main.state.next_id
        report = self.main.update(scans)
        self._steps[self._now] = Step(
            increment=self._increment,
            scans=scans,
            next_id=next_id,
            evidence=evidence_table(report),
        )
        self._now += 1
        was_lost = self.is_lost
        moved = self._carry is not None and self._decide(self._carry)
        if self._now % self._look_every == 0:
            self._look()
        carried = (moved or self.is_lost) and not was_lost
        return replace(report, carried=carried, lost=self.is_lost)

    def _keep_snapshot(self) -> None:
        self._snapshots[self._now] = self.main.copy()
        for old in sorted(self._snapshots)[: -self._rule.snapshots]:
            del self._snapshots[old]
        needed = min(self._snapshots)
        if self._carry is not None:
            needed = min(needed, self._carry.since)
        for old in [number for number in self._steps if number < needed]:
            del self._steps[old]

    def _at(self, number: int) -> RobustBackEnd:
        """Return a copy of the main back end as it was before a step."""
        begin = max(kept for kept in self._snapshots if kept <= number)
        back_end = self._snapshots[begin].copy()
        for step in (self._steps[between] for between in range(begin, number)):
            back_end.predict(step.increment)
            back_end.update(step.scans, solve=False)
        return back_end

    def _decide(self, carry: Carry) -> bool:
        """Answer the question of a carry, if that can be; return whether a place is adopted."""
        rule, placed = self._rule, carry.placed
        for alternative in (carry.new, placed):
            if alternative is not None:
                end = min(alternative.next_step + rule.catch_up, self._now)
                alternative.take(self._steps, end)
        if placed is not None and placed.next_step == self._now:
            if placed.until is None:
                placed.until = self._now + rule.patience * self._window
            first = max(carry.since, self._now - rule.lost_steps)
            tables = placed.evidence[first - carry.since :]
            own = totals_of(tables, carry.next_id, rule.correlated_steps)
            if gain(own, self._totals(carry, first), rule) > rule.price_nats:
                self._adopt(placed.back_end)
                return True
            if self._now > placed.until:
                carry.placed, carry.search_from = None, self._now
        # What one landmark says is bounded: it may be hidden or gone, or others may look like it.
        first = max(carry.since, self._now - rule.lost_steps)
        of_landmarks = self._totals(carry, first)[:, 1]
        bounded = np.clip(of_landmarks, -rule.most_against, rule.most_for)
        total = float(bounded.sum())
        if self.is_lost:
            # If nothing is heard, that is no evidence for the pose.
            heard = any(len(self._steps[number].evidence) for number in range(first, self._now))
            self.is_lost = total < 0.0 or not heard
        else:
            n_against = int(np.count_nonzero(bounded < 0.0))
            is_against = total < -rule.price_nats and n_against >= rule.least_landmarks
            # Radars that hear nothing are no reason to be elsewhere.
            self.is_lost = is_against and bool(carry.new.back_end.reported_rows())
        is_answered = total > rule.price_nats or self._now - carry.since > rule.carry_steps
        if is_answered and carry.placed is None:
            self._carry, self._judged, self.is_lost = None, self._now, False
        return False

    def _totals(self, carry: Carry, first: int) -> Array:
        """Return the evidence since a step of the landmarks known before a carry, (n, 2)."""
        tables = (self._steps[number].evidence for number in range(first, self._now))
        return totals_of(tables, carry.next_id, self._rule.correlated_steps)

    def _adopt(self, back_end: RobustBackEnd) -> None:
        """Let an alternative be the main back end."""
        self.main, self._carry, self.is_lost = back_end, None, False
        self._snapshots = {self._now: self.main.copy()}
        self._judged = self._now

    def _look(self) -> None:
        """Look for evidence against the pose, or for the place that the robot was carried to."""
        if self._carry is None:
            since, against = self._evidence_of_carry()
            if against <= self._rule.most_against:
                since = self._recognised()
            if since < self._now:
                self._begin_carry(since)
        elif self._carry.placed is None and self._now >= self._carry.search_from:
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
        table = np.concatenate([step.evidence for step in steps])
        ids, place = np.unique(table[:, 0], return_inverse=True)
        against = np.zeros((len(steps), len(ids)))
        np.add.at(against, (np.repeat(np.arange(len(steps)), lengths), place), -table[:, 1])
        # From each step on, each landmark within its bounds, if it was known before the step
        sums = np.cumsum(against[::-1], axis=0)[::-1] / rule.correlated_steps
        known = ids < np.array([step.next_id for step in steps])[:, None]
        unbounded = np.where(known, sums, 0.0).sum(axis=1)
        sums = np.clip(sums, -rule.most_for, rule.most_against)
        totals = np.where(known, sums, 0.0).sum(axis=1)
        several = totals > np.where(known, sums, -np.inf).max(axis=1)
        totals = np.where(several, totals, -np.inf)
        # The earliest of equals, those with most evidence beyond the bounds
        best = int(np.argmax(np.where(totals == totals.max(), unbounded, -np.inf)))
        if not several[best] or totals[best] <= 0.0:
            return self._now, 0.0
        return first + best, float(totals[best])

    def _recognised(self) -> int:
        """Return the step before which the robot was elsewhere if new landmarks lie on older ones.

        Where the whole run lets them be the same landmarks, a loop is closed: they are merged.
        """
        main, rule, first = self.main, self._rule, max(min(self._snapshots), self._judged)
        rows, ids = main.reported_rows(), main.state.landmark_ids
        oldest_id = self._steps[first].next_id if first < self._now else main.state.next_id
        newest = sorted(rows, key=lambda row: -ids[row])[: min(rule.newest, len(rows) // 2)]
        new = [row for row in newest if ids[row] >= oldest_id]
        new_ids = {ids[row] for row in new}
        if new_ids <= self._recognised_ids:
            return self._now
        self._recognised_ids = new_ids
        older = [row for row in rows if ids[row] not in new_ids]
        here = constellation_of(main.state, new, rule.model_sigma_m)
        there = constellation_of(main.state, older, rule.model_sigma_m)
        placement = find_placement(here, there, rule)
        if placement is None or placement.evidence < rule.most_against:
            return self._now
        if main.merge_if_possible([(older[row], new[own]) for row, own in placement.pairs]):
            return self._now
        oldest_new_id = min(here.ids[own] for _, own in placement.pairs)
        steps = [n for n in range(first, self._now) if self._steps[n].next_id <= oldest_new_id]
        return max(steps[-1] - self._window, first)

    def _begin_carry(self, since: int) -> None:
        before = self._at(since)
        if len(before.reported_rows()) < self._rule.least_landmarks:
            self._judged = self._now  # no place can be found on such a map
        else:
            moved = np.zeros(3)
            for number in range(since + 1, self._now):
                moved = compose(moved, self._steps[number].increment)
            self._carry = Carry(
                since=since,
                next_id=self._steps[since].next_id,
                map=before,
                new=Alternative(before.with_empty_map(), since),
                search_from=self._now,
                moved=moved,
            )

    def _search(self, carry: Carry) -> None:
        """Search for the new map's place on the old one; set a copy of the old one down there."""
        rule, new = self._rule, carry.new.back_end
        newest = sorted(new.reported_rows(), key=lambda row: -new.state.landmark_ids[row])
        here = constellation_of(new.state, newest[: rule.newest], rule.model_sigma_m)
        there = constellation_of(carry.map.state, carry.map.reported_rows(), rule.model_sigma_m)
        placement = find_placement(here, there, rule)
        if placement is None:
            return
        points = []
        for row, own in placement.pairs:
            block = slice(2 * own, 2 * own + 2)
            # The same ranges are taken once more, so this use of them must hardly count.
            covariance = rule.weakened * here.covariance_m2[block, block]
            points.append((there.ids[row], here.points_m[own], covariance))
        back_end = carry.map.copy()
        back_end.set_down(placement.motion, points)
        back_end.state.next_id = self.main.state.next_id + _IDS_APART
        carry.placed = Alternative(back_end, carry.since)

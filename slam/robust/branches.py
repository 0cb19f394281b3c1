"""Kidnapping: the question whether the robot was carried, and to which place.

The back end itself believes its odometry. ``Branches`` keep its last motions and scans, and the
evidence of each range for its pose (``UpdateReport.evidence``).

Discontinuity
    Where the wheels stood for a second or more, the last ranges before and the first ones behind it
    must be the same. If they are not, the robot was carried, whatever the map holds.
Suspicion
    The evidence since each step is summed over the landmarks known then, at most so much against
    each: a cumulative sum test (Page, Biometrika 41, 1954). A carry has a prior, in odds per hour;
    it is asked for when that is outweighed.
Search
    A back end with an empty map takes the motions and scans since. Where its landmarks lie on the
    map of the main back end as it was then is searched for
    (`slam.robust.proposals.constellation`). A copy of that back end is set down there, and takes
    the motions and scans since.
Decision
    Four explanations of all ranges since the step are compared: that the robot stayed, that it made
    a small motion that the wheels did not report, that it is at the place, and that it is where it
    has never been. Each has its own new landmarks, at the price of a birth; since parts of the
    world look like each other, births together cost no more than the price of such a likeness, so
    that a place is never adopted for being alike alone: what should be seen must be missing without
    it. The price of a place grows with the number of places that look alike.
Revision
    The back end that stayed goes on beside the one that is adopted. When the advantage of the place
    is gone, and more is missed there, the adoption is taken back.
Doubt
    A carry that is possible during a stop, or a possible slip of the wheels, adds to the reported
    covariance until landmarks known before confirm the pose.
    Those that a possible motion lays on others of the map confirm nothing
    (`slam.robust.proposals.constellation.stands_out`), nor do they place a carried robot.

A robot that begins somewhere on the map of an earlier run (`SavedMap`) is taken to have been
carried before the first step; the map of its own that it makes meanwhile stands for the place where
it has never been.

The robot is reported as lost while the landmarks known before the carry are against its pose by
more than the price of a carry, and others are seen, or ranges have shown a carry. That ends when
several of them are seen where they should be, or a place is adopted.

Where new landmarks lie on older ones as a constellation, and the whole run can be solved with them
merged, a loop is closed.

While nothing is suspicious that costs a copy of the back end now and then.

A long run is solved for by a copy of the back end in a thread of its own, beside some scans. It
takes these afterwards, and is the main back end from then on.

``Hypotheses`` are for detections with bearings: where it is unclear which landmark a tentative one
is, every option is followed by a back end of its own (D. B. Reid, "An Algorithm for Tracking
Multiple Targets", IEEE Transactions on Automatic Control 24(6), 1979).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import expit

from slam.geometry import Rig, compose, has_moved
from slam.results import SavedMap, StartOnMap, UpdateReport
from slam.robust.association import RangeScan
from slam.robust.back_end import RobustBackEnd
from slam.robust.initialisation import Question
from slam.robust.parameters import (
    MARGIN_NATS,
    BackEndParameters,
    BranchRule,
    RangeNoise,
)
from slam.robust.proposals.constellation import (
    Constellation,
    Placement,
    constellation_of,
    find_placement,
    find_placements,
    stands_out,
)
from slam.robust.proposals.doubts import (
    Doubt,
    SeenRanges,
    covering,
    doubted_covariance,
    seen_ranges,
)
from slam.robust.solver.one_blas_thread import one_blas_thread
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
    elapsed_s: float  # how long the motion took
    # How unlikely it is that the robot was carried before it; negative where the ranges before and
    # behind a stop show that
    carry_nats: float
    covariance: Array | None = None  # shape (3, 3), noise of the increment; None: by the model


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


def discontinuity(
    before: Sequence[RangeScan], after: Sequence[RangeScan], reach_m: float, noise: RangeNoise
) -> float:
    """Return by how much the ranges of two times are likelier those of two places, in nats.

    A range that is found again within reach, as most are at one place, may be so by chance. Each
    time is compared with the other one, and half of both counts. Ranges are Bernoulli trials.
    """
    of_radar = {scan.radar: (*scan.ranges_m, *scan.blurred_m) for scan in after}
    pairs = [
        ((*scan.ranges_m, *scan.blurred_m), of_radar[scan.radar])
        for scan in before
        if scan.radar in of_radar
    ]
    found, total = noise.detection_probability, 0.0
    for given, others in [*pairs, *[(others, given) for given, others in pairs]]:
        share = 2.0 * reach_m * len(others) / (noise.max_range_m - noise.min_range_m)
        chance = min(max(share, 1.0 - found), found)
        for range_m in given:
            if any(abs(range_m - other) <= reach_m for other in others):
                total += math.log(chance / found)
            else:
                total += math.log((1.0 - chance) / (1.0 - found))
    return 0.5 * total


def totals_of(tables: Iterable[Array], known: RobustBackEnd, rule: BranchRule) -> Array:
    """Return ids and summed evidence [nats], (n, 2), of the landmarks that a back end knew.

    The errors of `BranchRule.correlated_steps` steps are taken to be one, and what one landmark
    says is bounded: it may be hidden or gone, or others may look like it.
    """
    table = np.concatenate([no_totals(), *tables])
    table = table[np.isin(table[:, 0], known.state.feature_ids)]
    ids, place = np.unique(table[:, 0], return_inverse=True)
    sums = np.bincount(place, table[:, 1], len(ids)) / rule.correlated_steps
    return np.column_stack([ids, np.clip(sums, -known.most_against(ids), rule.most_for)])


def no_totals() -> Array:
    return np.empty((0, 2))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Account:
    """What an explanation of all ranges since a step is worth."""

    totals: Array = field(default_factory=no_totals)  # as `totals_of` has them
    hits: float = 0.0  # nats of the landmarks known before that are seen
    misses: float = 0.0  # of those that should be seen and are not; not positive
    n_seen: int = 0  # how many of them are seen
    n_new: int = 0  # landmarks that it has added to the map

    @property
    def known(self) -> float:
        """Return the nats of the landmarks known before."""
        return self.hits + self.misses


def account_of(totals: Array, n_new: int) -> Account:
    """Return the account of totals (n, 2), as `totals_of` has them, and of new landmarks."""
    nats = totals[:, 1]
    hits, misses = float(nats[nats > 0.0].sum()), float(nats[nats < 0.0].sum())
    n_seen = int(np.count_nonzero(nats > 0.0))
    return Account(totals=totals, hits=hits, misses=misses, n_seen=n_seen, n_new=n_new)


def advantage(place: Account, other: Account, rule: BranchRule) -> float:
    """Return by how much a place explains all ranges better than another account, in nats.

    What a new landmark explains is worth as much as what a known one does, less the price of its
    birth.
    """
    n_more = other.n_new - place.n_new
    price = min(rule.new_landmark_nats * n_more, rule.likeness_nats)
    return place.known - other.known - rule.most_for * n_more + price


class Alternative:
    """A back end that takes the steps since a carry beside the main one.

    Where the robot may have come to, it is a copy of the back end before the carry.
    """

    def __init__(
        self,
        back_end: RobustBackEnd,
        since: int,
        price_nats: float = 0.0,
        *,
        merges: bool = False,
    ) -> None:
        self.back_end = back_end
        self.since = since
        self.price_nats = price_nats  # how unlikely it is that the robot came there
        self.merges = merges  # whether it merges landmarks, and solves for the whole run
        self.next_step = since
        self.evidence: list[Array] = []  # of each step taken, as `evidence_table` has it

    def take(self, steps: Mapping[int, Step], end: int) -> None:
        """Take the steps before ``end``; of the very first one the motion is the carry."""
        for number in range(self.next_step, end):
            step = steps[number]
            if number > self.since:
                self.back_end.predict(step.increment, step.covariance, elapsed_s=step.elapsed_s)
            report = self.back_end.update(step.scans, solve=self.merges, may_wait=True)
            self.evidence.append(evidence_table(report))
            self.next_step = number + 1


def _solved(back_end: RobustBackEnd) -> RobustBackEnd:
    with one_blas_thread():
        back_end.relinearise()
    return back_end


@dataclass(slots=True, kw_only=True)
class Solving:
    """A long run that is being solved for."""

    main: RobustBackEnd  # which goes on meanwhile
    since: int  # the step after those that are solved for
    solution: Future[RobustBackEnd]
    solved: Alternative | None = None  # which takes the steps since


@dataclass(slots=True, kw_only=True)
class Carry:
    """The question whether the robot was carried before a step, and to which place."""

    since: int
    opened: int  # the step at which it was asked, or a place adopted
    price_nats: float  # how unlikely that is
    is_start: bool = False  # the robot has not been on the map in this run
    next_id: int  # landmarks known before it have smaller ids
    map: RobustBackEnd  # the main back end after the step before
    base: RobustBackEnd  # that, moved by the steps before ``since`` that led nowhere
    new: Alternative  # with an empty map at first
    pose: Array  # shape (3,), before it: [m, m, rad], map frame
    moved: Array  # shape (3,), [m, m, rad], body frame before it: odometry since
    hidden: Alternative | None  # a motion that the wheels did not report, and no carry
    placed: list[Alternative] = field(default_factory=list)  # where the robot may be on the map
    until: int = 0  # step at which these are dropped; 0 until they have caught up
    adopted: Alternative | None = None
    stayed: Alternative | None = None  # the back end that stayed, once the place is adopted


class Branches:
    """The main back end, the question of a carry, and its decision.

    ``predict`` and ``update`` alternate as in ``RobustBackEnd``. A robot that begins on a map
    without a pose has been carried to wherever on the map it is, or beside it.
    """

    def __init__(
        self, rig: Rig, parameters: BackEndParameters, on_map: StartOnMap | None = None
    ) -> None:
        self._rule = rule = parameters.branches
        saved, start = None if on_map is None else on_map.map, None
        if on_map is not None and on_map.pose is not None:
            start = np.array(on_map.pose), np.array(rule.start_sigmas)
        self.main = RobustBackEnd(rig, parameters, saved, start)
        self._look_every, self._window = parameters.map.look_every, parameters.initialisation.window
        self._fewest = parameters.initialisation.min_frames
        self._steps: dict[int, Step] = {}  # by number, those that are needed still
        self._now = 0  # number of the next step
        self._noise, self._gate_sigmas = parameters.ranges, parameters.initialisation.gate_sigmas
        self._edge_rad = parameters.initialisation.edge_rad
        self._lever_m = max(math.hypot(mount.x_m, mount.y_m) for mount in rig.mounts)
        self._increment: Array | None = None
        self._covariance: Array | None = None  # of its noise, where that is known
        self._elapsed_s = 0.0
        self._carry_nats, self._has_stood = math.inf, False
        self._snapshots: dict[int, RobustBackEnd] = {}  # by the number of the step after it
        self._carry: Carry | None = None
        self._judged = 0  # the evidence of the steps before it has been judged
        self._recognised_ids: set[int] = set()  # new landmarks that were searched for
        self._doubts: list[Doubt] = []  # of carries
        self._slips: list[Doubt] = []
        self._solution_rule = parameters.relinearisation
        self._solving: Solving | None = None
        self._is_on_map = saved is not None
        self.is_lost = False
        if saved is not None and start is None:
            self._begin_lost(saved)

    @property
    def map(self) -> RobustBackEnd:
        """Return the back end whose map is reported: as it was, while the robot is lost."""
        return self._carry.map if self.is_lost and self._carry is not None else self.main

    @property
    def is_unplaced(self) -> bool:
        """Return whether the robot began on a map, and has not found its place there yet."""
        return self.is_lost and self._carry is not None and self._carry.is_start

    @property
    def lost_pose(self) -> tuple[Array, Array] | None:
        """Return pose (3,) and covariance (3, 3) to report while the robot is lost, None else.

        The pose is that before the carry, and odometry since: [m, m, rad], map frame.
        """
        if not self.is_lost or self._carry is None:
            return None
        moved = compose(self._carry.pose, self._carry.moved)
        return moved, np.diag(self._rule.lost_variances)

    @property
    def doubted_covariance(self) -> Array:
        """Return what doubts and undecided slips add to the covariance of the pose, (3, 3).

        The map frame is that of ``main``. Of a slip the filter has the covariance until ranges
        reduce it, which they do also where they are taken for those of another landmark.
        """
        position_m = self.main.state.position_m
        added = doubted_covariance(self._doubts, position_m) + self.main.undecided_covariance
        if self._slips:
            slips = np.sum([one.at(position_m) for one in self._slips], axis=0)
            added += covering(self.main.pose_covariance, slips)
        return added

    def predict(
        self,
        increment: Array,
        elapsed_s: float = 1.0,
        stood_s: float = 0.0,
        covariance: Array | None = None,
    ) -> None:
        """Move by an odometry increment: dx, dy [m], turn [rad] in the body frame before it.

        It took ``elapsed_s``, and for ``stood_s`` of that the wheels stood still. ``covariance``
        (3, 3) is its noise, None: by the wheels' model.
        """
        if self._now % self._rule.snapshot_every == 0:
            self._keep_snapshot()
        self._increment, self._covariance = increment, covariance
        self._has_stood = stood_s >= self._rule.stop_s
        stood_s = stood_s if self._has_stood else 0.0
        self._carry_nats = self._rule.carry_nats(elapsed_s, stood_s)
        self._elapsed_s = elapsed_s
        self.main.predict(increment, covariance, elapsed_s=elapsed_s)
        if self._carry is not None:
            self._carry.moved = compose(self._carry.moved, increment)

    def update(self, scans: Sequence[RangeScan]) -> UpdateReport:
        """Take in the scans of one time; a radar without a frame is absent, not empty."""
        if self._increment is None:
            raise ValueError("scans without a motion before them")
        next_id, carry_nats = self.main.state.next_id, self._carry_nats
        if self._has_stood and self._now - 1 in self._steps:
            before, after = (
                # ranges of beacons, and what has bearings, are of other sensors with other noise
                [scan for scan in some if scan.looks and scan.bearings_rad is None]
                for some in (self._steps[self._now - 1].scans, scans)
            )
            carry_nats -= self._shown(before, after, self._increment)
        position_m = self.main.state.position_m.copy()
        report = self.main.update(scans, may_wait=True)
        step = Step(
            increment=self._increment,
            scans=scans,
            elapsed_s=self._elapsed_s,
            next_id=next_id,
            evidence=evidence_table(report),
            carry_nats=carry_nats,
            covariance=self._covariance,
        )
        self._steps[self._now] = step
        self._doubt(step, report, position_m)
        self._now += 1
        self._solve_beside()
        was_lost = self.is_lost
        moved = self._carry is not None and self._decide(self._carry)
        if self._now % self._look_every == 0:
            self._look()
        carried = (moved or self.is_lost) and not was_lost
        return replace(report, carried=carried, lost=self.is_lost)

    def _solve_beside(self) -> None:
        """Begin to solve for a long run beside the scans, or adopt what was begun.

        That is at a scan that is fixed beforehand, so a replay does the same. A solution is dropped
        if the main back end was solved for, or replaced, meanwhile.
        """
        solving, rule = self._solving, self._solution_rule
        if solving is not None:
            age = self._now - solving.since
            if solving.main is not self.main or self.main.since_solved < rule.every + age:
                self._solving = None
            elif age >= rule.adopted_after:
                if solving.solved is None:
                    solving.solved = Alternative(solving.solution.result(), solving.since - 1)
                    solving.solved.next_step = solving.since
                solved, end = solving.solved, solving.solved.next_step + self._rule.catch_up
                solved.take(self._steps, min(end, self._now))
                if solved.next_step == self._now:
                    state = solved.back_end.state
                    state.next_id = max(state.next_id, self.main.state.next_id)
                    self.main, self._solving = solved.back_end, None
        elif self.main.awaits_solution:
            with_thread = ThreadPoolExecutor(max_workers=1, thread_name_prefix="slam-solver")
            solution = with_thread.submit(_solved, self.main.copy())
            with_thread.shutdown(wait=False)
            self._solving = Solving(main=self.main, since=self._now, solution=solution)

    def _doubt(self, step: Step, report: UpdateReport, position_m: Array) -> None:
        """Keep the doubts whether the robot was carried, or slipped, until the pose is confirmed.

        The robot may have been carried at ``position_m``.
        """
        rule, n_known, slip = self._rule, self._n_reported(0), self.main.slipped
        # Alike ranges before and behind a stop tell little where the world repeats itself.
        nats = min(step.carry_nats, self._carry_nats)
        carried = float(expit(-nats)) if self._has_stood else 0.0

        knew_few = n_known < rule.least_landmarks and not self._is_on_map

        def doubt(probability: float, motion_covariance: Array, *, is_carry: bool) -> Doubt:
            return Doubt(
                next_id=step.next_id,
                knew_few=knew_few,
                is_carry=is_carry,
                position_m=position_m,
                probability=probability,
                covariance=probability * motion_covariance,
                motion_covariance=motion_covariance,
            )

        # An empty map begins where the robot first drives.
        is_possible = carried > 0.0 and bool(n_known or self._now)
        lost = np.diag(rule.lost_variances)
        carries = [doubt(carried, lost, is_carry=True)] if is_possible else []
        slips = [] if slip is None else [doubt(1.0, slip, is_carry=False)]
        seen = None
        if self._doubts or self._slips:
            seen = seen_ranges(report, self.main.pose, rule)
        self._doubts = self._left(self._doubts, step, seen, carries)
        self._slips = self._left(self._slips, step, seen, slips)

    def _left(
        self, doubts: Sequence[Doubt], step: Step, seen: SeenRanges | None, new: Sequence[Doubt]
    ) -> list[Doubt]:
        """Return the doubts that a step leaves, and those that are new with it."""
        looks = self._now % self._look_every == 0
        left: list[Doubt] = []
        for one in doubts:
            one.take(step.evidence, self._rule)
            if seen is not None:
                one.measure(seen)
            if not looks or not (self._is_on_few(one) or self._is_confirmed(one)):
                left.append(one)
        left += new
        # Those with the same evidence end together: they are one, so a long run needs few.
        kept = left[:1]
        for one in left[1:]:
            if (one.next_id, one.nats) == (kept[-1].next_id, kept[-1].nats):
                kept[-1].add(one)
            else:
                kept.append(one)
        while len(kept) > self._rule.most_doubts:
            kept[0].join(kept.pop(1))
        return kept

    def _is_on_few(self, doubt: Doubt) -> bool:
        """Return whether a carry was doubted on too few landmarks, and there are enough since.

        They are the map then, and the robot is sure of its place among them. Where the few and the
        start lie on it may be wrong. By a slip that is unsure for good; the covariance of the
        filter says so unless it has taken a landmark for another one.
        """
        has_enough = self._n_reported(doubt.next_id) >= self._rule.least_landmarks
        return doubt.is_carry and doubt.knew_few and has_enough

    def _n_reported(self, first_id: int) -> int:
        ids = self.main.state.landmark_ids
        return sum(ids[row] >= first_id for row in self.main.reported_rows())

    def _is_confirmed(self, doubt: Doubt) -> bool:
        return doubt.is_confirmed(self._rule) and not self._is_alike_elsewhere(doubt)

    def _is_alike_elsewhere(self, doubt: Doubt) -> bool:
        """Return whether the landmarks that fit the pose may be others of the map.

        Those of them that a motion which the doubt allows lays on others confirm nothing.
        """
        named = self.main.merged_ids(np.array(list(doubt.nats), dtype=np.float64))
        ids, place = np.unique(named, return_inverse=True)
        nats = np.bincount(place, list(doubt.nats.values()), len(ids)).clip(max=self._rule.most_for)
        # A search takes long: it is repeated for other landmarks, or for as much as one more says.
        fitting = frozenset(ids[nats > 0.0].tolist()), int(nats.sum() // self._rule.most_for)
        if fitting == doubt.alike:
            return True

        def is_possible(placement: Placement) -> bool:
            return doubt.allows(placement.motion, self._rule.model_sigma_m)

        totals = np.column_stack([ids, nats])
        is_alike = not self._stand_out(self.main, totals, doubt.next_id, is_possible)
        doubt.alike = fitting if is_alike else None
        return is_alike

    def _stand_out(
        self,
        back_end: RobustBackEnd,
        totals: Array,
        next_id: int,
        is_possible: Callable[[Placement], bool],
    ) -> bool:
        """Return whether reported landmarks that could be no others say enough; totals (n, 2)."""
        state, of_ids = back_end.state, dict(totals.tolist())
        rows = [row for row in back_end.reported_rows() if state.landmark_ids[row] < next_id]
        known = constellation_of(state, rows, self._rule.model_sigma_m)
        nats = np.array([of_ids.get(id_, 0.0) for id_ in known.ids])
        return stands_out(nats, known, self._rule, is_possible)

    def _shown(
        self, before: Sequence[RangeScan], after: Sequence[RangeScan], increment: Array
    ) -> float:
        """Return the nats for a carry that the ranges before and behind a stop show.

        Between the two the wheels made an increment, (3,). A turn moves the antennas, and other
        things come into view: where it is larger than the edge of a view is wide, nothing is shown.
        """
        rule, turn_rad = self._rule, abs(float(increment[2]))
        if turn_rad > self._edge_rad / 2.0:
            return 0.0
        moved_m = math.hypot(*increment[:2].tolist()) + self._lever_m * turn_rad
        reach_m = self._gate_sigmas * rule.model_sigma_m + moved_m
        apart = discontinuity(before, after, reach_m, self._noise)
        # One range that is missed for another reason shows nothing.
        return min(max(apart - MARGIN_NATS, -rule.price_nats), rule.price_nats)

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
        for step in (self._steps[taken] for taken in range(begin, number)):
            back_end.predict(step.increment, step.covariance, elapsed_s=step.elapsed_s)
            back_end.update(step.scans, solve=False)
        return back_end

    def _decide(self, carry: Carry) -> bool:
        """Answer the question of a carry, if that can be; return whether the pose jumps."""
        rule = self._rule
        # Where ranges show a carry it was no such motion; and one that was long ago has been found.
        if carry.price_nats <= 0.0 or self._now - carry.since > rule.lost_steps:
            carry.hidden = None
        on_trial = [*carry.placed] if carry.hidden is None else [carry.hidden, *carry.placed]
        for alternative in [carry.stayed] if carry.stayed else [carry.new, *on_trial]:
            end = min(alternative.next_step + rule.catch_up, self._now)
            alternative.take(self._steps, end)
        if carry.stayed is not None and carry.adopted is not None:
            return self._is_taken_back(carry, carry.stayed, carry.adopted.price_nats)
        if on_trial and all(one.next_step == self._now for one in on_trial):
            found = self._place_of(carry, on_trial) if self._now % self._look_every == 0 else None
            if found is not None:
                self._adopt(carry, found)
                return True
            carry.until = carry.until or self._now + rule.patience * self._window
            if self._now > carry.until or not carry.placed:
                carry.placed, carry.until = [], 0
        first = max(carry.since, self._now - rule.lost_steps)
        tables = self._tables(first)
        of_landmarks = totals_of(tables, carry.map, rule)[:, 1]
        total = float(of_landmarks.sum())
        # What is new is no evidence for the pose. Radars that hear nothing are none against it.
        against = -total - carry.price_nats
        if not self.is_lost:
            is_elsewhere = carry.price_nats < 0.0 or bool(carry.new.back_end.reported_rows())
            self.is_lost = against > 0.0 and is_elsewhere
        elif self._is_over(carry):
            self._begin_again(carry)
        is_answered = total > rule.price_nats or (self._is_over(carry) and not self.is_lost)
        if is_answered and not carry.placed:
            self._end(carry)
        return False

    def _tables(self, first: int) -> list[Array]:
        """Return the evidence of the main back end in each step from one on."""
        return [self._steps[number].evidence for number in range(first, self._now)]

    def _account(self, carry: Carry, back_end: RobustBackEnd, tables: Sequence[Array]) -> Account:
        """Return what a back end with the map before a carry makes of the steps since.

        ``tables`` are its evidence. Ranges of the last frames may be of a landmark that is new, and
        is not in the map yet: they do not count. Those of a new landmark that turned out to be an
        old one do.
        """
        counted = tables[: max(self._now - self._fewest - carry.since, 0)]
        table = np.concatenate([no_totals(), *counted])
        table[:, 0] = back_end.merged_ids(table[:, 0])
        totals = totals_of([table], carry.map, self._rule)
        return account_of(totals, back_end.n_reported_since(carry.next_id))

    def _place_of(self, carry: Carry, places: Sequence[Alternative]) -> Alternative | None:
        """Return the place that the robot is at rather than where it was, or anywhere else.

        What is missed by the one that stayed must pay the price, not what looks alike, unless the
        ranges before and behind a stop show a carry; and the place must be likelier than any other
        on trial.
        """
        rule = self._rule
        stay = self._account(carry, self.main, self._tables(carry.since))
        accounts = [self._account(carry, one.back_end, one.evidence) for one in places]
        gains = [
            advantage(account, stay, rule) - one.price_nats
            for account, one in zip(accounts, places, strict=True)
        ]
        best = int(np.argmax(gains))
        account, found, pose = accounts[best], places[best], places[best].back_end.pose
        elsewhere = Account(n_new=carry.new.back_end.n_reported_since(0))
        # Between two places of the map known landmarks decide: new ones are mapped with a delay.
        margins = [
            min(gains[best] - gain, account.known - other.known)
            if found is not carry.hidden
            else gains[best] - gain
            for gain, other, one in zip(gains, accounts, places, strict=True)
            if has_moved(pose, one.back_end.pose, rule.reach_m, rule.reach_m / rule.base_m)
        ]
        # Where the map lies, most of what is seen must be known.
        fewest, is_shown = max(rule.least_landmarks, 2 * account.n_new), carry.price_nats < 0.0
        is_there = (
            account.n_seen > account.n_new
            and (found is carry.hidden or account.n_seen >= fewest)
            and (is_shown or account.misses - stay.misses > found.price_nats + MARGIN_NATS)
            and gains[best] > MARGIN_NATS
            and advantage(account, elsewhere, rule) > MARGIN_NATS
            and all(margin > rule.placement_nats for margin in margins)
        )
        return found if is_there and self._is_only_there(carry, found, account) else None

    def _is_only_there(self, carry: Carry, place: Alternative, account: Account) -> bool:
        """Return whether what fits at a place would fit nowhere else on the map.

        After a motion that the wheels did not report the robot is near, whatever is alike.
        """
        if place is carry.hidden:
            return True
        hits = account.totals[account.totals[:, 1] > 0.0]

        def is_no_chance(placement: Placement) -> bool:
            return placement.evidence > self._rule.likeness_nats

        return self._stand_out(carry.map, hits, carry.next_id, is_no_chance)

    def _adopt(self, carry: Carry, placed: Alternative) -> None:
        """Let a place be that of the main back end; the one that stayed goes on beside it."""
        carry.stayed = Alternative(self.main, carry.since)
        carry.stayed.next_step, carry.stayed.evidence = self._now, self._tables(carry.since)
        self._exchange(carry, placed)
        if carry.is_start:
            self._doubts = []  # those of before are in the frame of another map
        carry.placed, carry.adopted, carry.opened = [], placed, self._now

    def _exchange(self, carry: Carry, other: Alternative) -> None:
        """Let an alternative be the main back end, as if it always had been."""
        # Ids that were reported are of no other landmark.
        next_id = max(self.main.state.next_id, other.back_end.state.next_id)
        self.main, self.is_lost = other.back_end, False
        self.main.state.next_id = next_id
        for number, evidence in enumerate(other.evidence, start=carry.since):
            self._steps[number] = replace(self._steps[number], evidence=evidence)
        self._snapshots = {self._now: self.main.copy()}

    def _is_taken_back(self, carry: Carry, stayed: Alternative, price_nats: float) -> bool:
        """Return whether the robot is put back where it would be had it stayed.

        It is if the place is not worth its price any more, and more is missed there.
        """
        if stayed.next_step < self._now or self._now % self._look_every:
            return False
        place = self._account(carry, self.main, self._tables(carry.since))
        stay = self._account(carry, stayed.back_end, stayed.evidence)
        is_refuted = advantage(place, stay, self._rule) < price_nats
        is_refuted &= stay.misses - place.misses > MARGIN_NATS
        if is_refuted:
            self._exchange(carry, stayed)
        if is_refuted and carry.is_start:
            carry.stayed, carry.adopted, self.is_lost = None, None, True
            self._begin_again(carry)
        elif is_refuted or self._is_over(carry):
            self._end(carry)
        return is_refuted

    def _is_over(self, carry: Carry) -> bool:
        return self._now - carry.opened > self._rule.carry_steps

    def _end(self, carry: Carry) -> None:
        """End the question of a carry."""
        self._carry, self._judged, self.is_lost = None, self._now, False

    def _look(self) -> None:
        """Look for evidence against the pose, or for the place that the robot was carried to."""
        carry = self._carry
        if carry is None:
            since = self._most_suspicious()
            if since < self._now:
                self._begin_carry(since)
            else:
                self._recognise()
        elif not carry.placed and carry.stayed is None:
            self._search(carry)

    def _most_suspicious(self) -> int:
        """Return the step before which the robot may have been carried; if there is none, the next.

        The evidence against the pose must outweigh the prior of a carry, or of a motion that the
        wheels did not report.
        """
        rule, first = self._rule, max(min(self._snapshots), self._judged)
        steps = [self._steps[number] for number in range(first, self._now)]
        lengths = [len(step.evidence) for step in steps]
        if not steps:
            return self._now
        table = np.concatenate([step.evidence for step in steps])
        ids, place = np.unique(table[:, 0], return_inverse=True)
        against = np.zeros((len(steps), len(ids)))
        np.add.at(against, (np.repeat(np.arange(len(steps)), lengths), place), -table[:, 1])
        # From each step on, each landmark within its bounds, if it was known before the step
        sums = np.cumsum(against[::-1], axis=0)[::-1] / rule.correlated_steps
        known = ids < np.array([step.next_id for step in steps])[:, None]
        unbounded = np.where(known, sums, 0.0).sum(axis=1)
        sums = np.clip(sums, -rule.most_for, self.main.most_against(ids))
        totals = np.where(known, sums, 0.0).sum(axis=1)
        hidden_nats = math.log(rule.steps_per_hidden)
        totals -= np.minimum([step.carry_nats for step in steps], hidden_nats)
        # The earliest of equals, those with most evidence beyond the bounds
        best = int(np.argmax(np.where(totals == totals.max(), unbounded, -np.inf)))
        return first + best if totals[best] > 0.0 else self._now

    def _recognise(self) -> None:
        """Close a loop where new landmarks lie on older ones, if the whole run allows it."""
        main, rule, first = self.main, self._rule, max(min(self._snapshots), self._judged)
        rows, ids = main.reported_rows(), main.state.landmark_ids
        oldest_id = self._steps[first].next_id if first < self._now else main.state.next_id
        newest = sorted(rows, key=lambda row: -ids[row])[: min(rule.newest, len(rows) // 2)]
        new = [row for row in newest if ids[row] >= oldest_id]
        new_ids = {ids[row] for row in new}
        if new_ids <= self._recognised_ids:
            return
        self._recognised_ids = new_ids
        older = [row for row in rows if ids[row] not in new_ids]
        here = constellation_of(main.state, new, rule.model_sigma_m)
        there = constellation_of(main.state, older, rule.model_sigma_m)
        placement = find_placement(here, there, rule)
        if placement is not None:
            main.merge_if_possible([(older[row], new[own]) for row, own in placement.pairs])

    def _begin_carry(self, since: int) -> None:
        before, step = self._at(since), self._steps[since]
        moved = np.zeros(3)
        for number in range(since, self._now):
            moved = compose(moved, self._steps[number].increment)
        hidden = before.copy()
        hidden.predict(step.increment, np.diag(self._rule.hidden_variances), is_loose=True)
        hidden.state.next_id = self.main.state.next_id + _IDS_APART
        self._carry = Carry(
            since=since,
            opened=self._now,
            price_nats=step.carry_nats,
            next_id=step.next_id,
            map=before,
            base=before,
            new=Alternative(before.with_empty_map(), since),
            pose=before.pose,
            moved=moved,
            hidden=Alternative(hidden, since, math.log(self._rule.steps_per_hidden), merges=True),
        )

    def _begin_lost(self, saved: SavedMap) -> None:
        """Begin without a place on a map: on a map of its own, until a search finds one."""
        mapped, self.main = self.main, self.main.with_empty_map()
        self.main.state.next_id = saved.next_id
        # Where nothing is known it is about the middle of the map.
        middle_m = saved.landmarks_m.mean(axis=0) if saved.landmarks else np.zeros(2)
        self._carry = Carry(
            since=0,
            opened=0,
            price_nats=-self._rule.price_nats,
            is_start=True,
            next_id=saved.next_id,
            map=mapped,
            base=mapped,
            new=Alternative(mapped.with_empty_map(), 0),
            pose=np.append(middle_m, 0.0),
            moved=np.zeros(3),
            hidden=None,
        )
        self.is_lost = True

    def _begin_again(self, carry: Carry) -> None:
        """Search for a lost robot by what it sees from now on: what it saw has led nowhere."""
        if carry.base is carry.map:
            carry.base = carry.map.copy()
        for step in (self._steps[number] for number in range(carry.since, self._now)):
            # no pose of the run is missing
            carry.base.predict(step.increment, step.covariance, elapsed_s=step.elapsed_s)
        if carry.is_start:
            self.main, next_id = carry.map.with_empty_map(), self.main.state.next_id
            self.main.state.next_id = next_id
        carry.since = carry.opened = self._now
        carry.hidden = None
        carry.new = Alternative(carry.map.with_empty_map(), self._now)
        carry.placed, carry.until = [], 0

    def _search(self, carry: Carry) -> None:
        """Search for the new map's places on the old one, and try them.

        Where more look alike than can be tried, none is.
        """
        rule, new = self._rule, carry.new.back_end
        newest = sorted(new.reported_rows(), key=lambda row: -new.state.landmark_ids[row])
        here = constellation_of(new.state, newest[: rule.newest], rule.model_sigma_m)
        there = constellation_of(carry.map.state, carry.map.reported_rows(), rule.model_sigma_m)
        found = find_placements(here, there, rule)
        if len(found) <= rule.most_places:
            price_nats = carry.price_nats + math.log(max(len(found), 1))
            carry.placed = [self._set_down(carry, here, there, one, price_nats) for one in found]

    def _set_down(
        self,
        carry: Carry,
        here: Constellation,
        there: Constellation,
        placement: Placement,
        price_nats: float,
    ) -> Alternative:
        """Return a copy of the back end before a carry, set down at a place on its map."""
        points = []
        for row, own in placement.pairs:
            block = slice(2 * own, 2 * own + 2)
            # The same ranges are taken once more, so this use of them must hardly count.
            covariance = self._rule.weakened * here.covariance_m2[block, block]
            points.append((there.ids[row], here.points_m[own], covariance))
        back_end = carry.base.copy()
        back_end.set_down(placement.motion, points)
        back_end.state.next_id = self.main.state.next_id + _IDS_APART
        return Alternative(back_end, carry.since, price_nats)

"""The robust back end: odometry increments and ranges in, pose and landmarks out."""

from __future__ import annotations

import copy
import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray

from slam.geometry import Rig, wrap_angles
from slam.results import (
    MapChanges,
    SavedLandmark,
    SavedMap,
    SmoothedRun,
    UpdateReport,
)
from slam.robust import kernels
from slam.robust.association import (
    LONGEST_M,
    Antennas,
    Known,
    MirrorWay,
    Pairs,
    RangeScan,
    View,
    antennas_of,
    find_known,
    find_labelled,
    find_points,
    point_variances,
    point_view,
    predicted_ranges,
    ranges_predicted,
    view,
    weigh_known,
)
from slam.robust.initialisation import (
    BodyPoint,
    FeatureRows,
    FittedRanges,
    Option,
    PointDetection,
    Question,
    TentativePoint,
    TentativePoints,
    UnassignedRanges,
    body_point,
    certain_row,
    crossing,
    detections_of,
    initialise_landmark,
    match,
    options_of,
    possible_rows,
    update_with_point,
)
from slam.robust.map import (
    MERGE_SIGMA_M,
    Existence,
    Images,
    add_landmarks,
    apply_merge,
    find_merge,
    named_pairs,
    saved_map_of,
    take_map,
)
from slam.robust.parameters import BackEndParameters
from slam.robust.proposals.slips import SlipDetector
from slam.robust.solver.beacons import Waiting, initialise_beacon, is_heard_where_it_is
from slam.robust.solver.revision import (
    adopt,
    is_due,
    noisier,
    relinearise,
    solve_whole_run,
    solved_as_one,
)
from slam.robust.solver.run_log import RunLog
from slam.robust.state import (
    HEAD_SIZE,
    Array,
    Motion,
    PastPose,
    RangeErrors,
    State,
    calibrated_motion,
    free_motion,
    predict,
    turned_covariance,
)
from slam.robust.walls import WallKeeper

# Standard deviations of a step that the wheels did not measure, and far more than what is left to
# know of the pose it leads to; the latter set nothing.
_CARRIED_M, _CARRIED_RAD = 100.0, 10.0
_FREE_M, _FREE_RAD = 1.0, 1.0


def _together(one: UpdateReport, other: UpdateReport) -> UpdateReport:
    return UpdateReport(
        continued=one.continued + other.continued,
        nis=one.nis + other.nis,
        dof=one.dof + other.dof,
        predicted=one.predicted + other.predicted,
        evidence=one.evidence + other.evidence,
    )


class RobustBackEnd:
    """Range SLAM with a consistent covariance.

    ``predict`` and ``update`` alternate: one motion, then what the radars saw at its end. The map
    frame is the body frame at the start; with a map of an earlier run it is that of the map, and
    the robot is at a ``start``: pose, and standard deviations of that, (3,) each.
    """

    def __init__(
        self,
        rig: Rig,
        parameters: BackEndParameters,
        saved: SavedMap | None = None,
        start: tuple[Array, Array] | None = None,
    ) -> None:
        self.rig = rig
        self.parameters = parameters
        offsets = (parameters.ranges.offset_sigma_m,) * len(rig.mounts)
        self.state = State(
            parameters.wheels.calibration_sigmas,
            offsets,
            parameters.ranges.mount_sigma_m,
            parameters.ranges.radius_sigma_m,
        )
        self.state.range_errors = RangeErrors(variance_share=parameters.ranges.variance_share)
        self._sides = rig.sides(parameters.ranges.field_of_view)
        self._side_of = np.zeros(len(rig.mounts), dtype=np.intp)
        for number, side in enumerate(self._sides):
            self._side_of[list(side)] = number
        self._unassigned = UnassignedRanges(parameters)
        self._tentative = TentativePoints(parameters)
        # Of each side, points at which ranges cross
        self._crossings = [TentativePoints(parameters) for _ in self._sides]
        self._existence = Existence(
            parameters.map,
            parameters.initialisation.min_frames,
            parameters.ranges.detection_probability,
        )
        # Ids of landmarks of the map are smaller.
        self._first_id = 0 if saved is None else saved.next_id
        prior = None if saved is None else take_map(self.state, saved, rig, start)
        self._log = RunLog(parameters.wheels, parameters.map.gap_poses, prior)
        self._walls = WallKeeper(self.state, parameters)
        # Way of the wheels since the start: metres, and keyframes, as `RunLog` counts them; where
        # the two counts differ by rounding, `RunLog.mark_key` makes past poses keyframes
        self._way_m, self._way_keys = 0.0, 0.0
        self._keeps_pose = False  # whether the newest pose is to be a past pose
        self._past_ways_m: list[float] = []  # of the past poses of the state
        self.lagged: list[PastPose] = []
        """The past poses that became final with the newest motion, with all updates before it."""
        self._slips = SlipDetector(parameters.slips, parameters.relinearisation.outlier_sigmas)
        self.slipped: Array | None = None
        """Covariance (3, 3) of what the pose may be off by, map frame, if the wheels may have
        slipped in the steps before the newest one."""
        self._landmark_of_label: dict[int, int] = {}
        if saved is not None:
            for landmark in saved.landmarks:
                self._know(landmark.id, landmark)
            for wall in saved.walls:
                self._existence.know(wall.id, wall.hits)
                self._walls.cells.know(wall.id, wall.cells)
        # Beacons, whose ranges have labels: all labels heard, and by label those without a place
        self._heard: set[int] = set()
        self._waiting: dict[int, Waiting] = {}
        self._images = Images()
        self._n_updates = 0
        self.evidence = 0.0
        """Nats by which what detections with bearings were taken for, once a passage, and merges of
        landmarks are likelier than that all is new, less what was missed. It is not revised when
        the run is solved for, nor when a landmark is deleted."""
        # Of the newest scan with bearings: the antennas, and the ids that it held or should have
        self._antennas = antennas_of(rig, (), np.zeros(3))
        self._settled: set[int] = set()
        self._jumped = -parameters.map.gap_poses - 1  # the pose that a jump led to
        # By ids of landmarks in pairs: the update at which their merge was refused
        self._refused: dict[Pairs, int] = {}

    @property
    def pose(self) -> Array:
        """Return [x m, y m, heading rad], map frame."""
        return self.state.pose

    @property
    def pose_covariance(self) -> Array:
        return self.state.pose_covariance()

    @property
    def undecided_covariance(self) -> Array:
        """Return what the newest steps add to the covariance of the pose, (3, 3), map frame.

        They may be a slip (`slam.robust.proposals.slips`); if the next steps show that, the filter
        adds it.
        """
        return turned_covariance(self._slips.undecided_covariance(), self.state.heading_rad)

    @property
    def landmark_of_label(self) -> Mapping[int, int]:
        """Return the ids of the landmarks that have labels, by label."""
        return self._landmark_of_label

    def copy(self) -> RobustBackEnd:
        """Return a back end that goes on from here by itself; what never changes is shared."""
        rules = [getattr(self.parameters, rule.name) for rule in fields(self.parameters)]
        shared = [self.rig, self.parameters, self._log.prior, *rules]
        return copy.deepcopy(self, {id(one): one for one in shared})

    def with_empty_map(self) -> RobustBackEnd:
        """Return a back end at the origin of a map of its own, that has learned the calibration."""
        other = RobustBackEnd(self.rig, self.parameters)
        other.state.take_calibration(self.state)
        other._slips.begin_anew()  # the robot is under way
        return other

    def saved_map(self) -> SavedMap:
        """Return the map for another run, as the solution over all poses has it if there is one."""
        solved = self.copy()
        if self.state.feature_ids and self._log.n_poses > 1:
            solved.relinearise()
        return solved.map_now()

    def map_now(self) -> SavedMap:
        """Return the map for another run as the filter has it."""
        labels = {id_: label for label, id_ in self._landmark_of_label.items()}
        return saved_map_of(
            self.state,
            self.rig,
            self._existence,
            self._log.start,
            labels=labels,
            cells_of=self._walls.cells.of,
        )

    def join(self, other: SavedMap, pairs: Sequence[tuple[int, int]]) -> None:
        """Take in a map that is seen from the pose, in whose body frame it is given.

        ``pairs`` are ids of the own landmarks and of the other's that are one. Walls are taken to
        be independent of the other's landmarks.
        """
        state, known = self.state, other.full_covariance()
        row_of = {name: row for row, name in enumerate(other.unknowns)}
        added = add_landmarks(state, other, known, row_of)
        for one, row in zip(other.landmarks, added, strict=True):
            self._know(state.landmark_ids[row], one)
        rows = {one.id: row for one, row in zip(other.landmarks, added, strict=True)}
        same = tuple((state.landmark_ids.index(own), rows[its]) for own, its in pairs)
        ids = named_pairs(state, same)
        apply_merge(state, same, MERGE_SIGMA_M)
        for kept, gone in ids:
            self._existence.merge(kept, gone)
        for wall in other.walls:
            mine = [row_of[f"{axis} {wall.id}"] for axis in ("phi", "d")]
            wall_id = self._walls.place_saved(wall, known[np.ix_(mine, mine)])
            if wall_id is not None:
                self._existence.hit(wall_id, wall.hits)

    def _know(self, landmark_id: int, saved: SavedLandmark) -> None:
        self._existence.know(landmark_id, saved.hits)
        self.state.added_sigmas_m[landmark_id] = saved.added_sigma_m
        if saved.label is not None:
            self._landmark_of_label.setdefault(saved.label, landmark_id)

    def map_changes(self, saved: SavedMap) -> MapChanges:
        """Return what has been found of a map that the back end began with."""
        hits = {one.id: self._existence.hits(one.id) - one.hits for one in saved.landmarks}
        ids, known = self.state.landmark_ids, set(hits)
        present = [ids[row] for row in self.reported_rows()]
        return MapChanges(
            seen=tuple(id_ for id_ in present if hits.get(id_, 0) > 0),
            gone=tuple(sorted(known - set(ids))),
            new=tuple(id_ for id_ in present if id_ not in known),
        )

    def reported_rows(self) -> list[int]:
        """Return the rows of landmarks hit often enough."""
        ids = self.state.landmark_ids
        return [row for row, id_ in enumerate(ids) if self._existence.is_reported(id_)]

    def n_reported_since(self, first_id: int) -> int:
        """Return how many reported landmarks and walls have an id from one on."""
        ids = [id_ for id_ in self.state.feature_ids if id_ >= first_id]
        return sum(map(self._existence.is_reported, ids))

    def merged_ids(self, ids: Array) -> Array:
        """Return the ids that landmarks have after all merges, (k,); those dropped keep theirs."""
        names = {id_: self._log.name_of(int(id_)) for id_ in np.unique(ids).tolist()}
        kept = [names[id_] for id_ in ids.tolist()]
        return np.array(
            [id_ if name is None else name for id_, name in zip(ids, kept, strict=True)]
        )

    def most_against(self, ids: Array) -> Array:
        """Return the most nats that landmarks give against a pose, (k,), ids of shape (k,).

        By Laplace's rule of succession, a landmark that n frames have hit is none, or gone, with a
        probability of 1 / (n + 1).
        """
        hits = np.array([self._existence.hits(int(id_)) for id_ in ids], dtype=np.float64)
        return np.minimum(np.log1p(hits), self.parameters.branches.most_against)

    def wall_spans_m(self) -> Array:
        """Return the ends of the reported stretches of wall, (k, 2, 2) [m], map frame."""
        spans = [
            self._walls.spans_m(row)
            for row, id_ in enumerate(self.state.wall_ids)
            if self._existence.is_reported(id_)
        ]
        return np.concatenate([np.empty((0, 2, 2)), *spans])

    def smoothed(self, stamps_ns: NDArray[np.int64]) -> SmoothedRun | None:
        """Return the solution over the whole run until now; None if there is none.

        ``stamps_ns``, shape (n,), are the times of the n poses after the first one. The filter
        stays as it is.
        """
        solved = solve_whole_run(self._log, self.state, self.parameters)
        if solved is None:
            return None
        poses, pose_covariances, features, covariances_m2, constants = solved
        rows = self.reported_rows()
        return SmoothedRun(
            t_ns=stamps_ns,
            poses=poses[1:],
            pose_covariances=pose_covariances[1:],
            landmark_ids=tuple(self.state.landmark_ids[row] for row in rows),
            landmarks_m=features[rows],
            landmark_covariances_m2=covariances_m2[rows],
            constants=constants,
        )

    def predict(
        self,
        increment: Array,
        covariance: Array | None = None,
        *,
        elapsed_s: float | None = None,
        is_loose: bool = False,
    ) -> None:
        """Move by an odometry increment: dx, dy [m], turn [rad] in the body frame before it.

        ``covariance`` (3, 3) is its noise, where that is known better than from the wheels' model;
        ``elapsed_s`` is how long it took, and where that is not known, slips are not looked for.
        ``is_loose`` means that the robot moved in a way that the wheels did not report.
        """
        if not np.isfinite(increment).all():
            raise ValueError(f"increment is {increment}; dx, dy [m] and turn [rad] must be finite")
        wheels = self.parameters.wheels
        self._leave_pose(increment)
        motion = calibrated_motion(increment, self.state.calibration, wheels, covariance)
        self._log.add_motion(increment, motion, is_loose=is_loose)
        self._move(motion)
        self.slipped = None
        if is_loose or elapsed_s is None:
            self._slips.begin_anew()
        else:
            self._look_for_slip(motion, elapsed_s)

    def _move(self, motion: Motion) -> None:
        predict(self.state, motion, self.parameters.wheels)
        self._unassigned.move(motion)
        for waiting in (self._tentative, *self._crossings):
            waiting.move(motion)
        self._walls.tentative.move(motion)

    def _look_for_slip(self, motion: Motion, elapsed_s: float) -> None:
        """Let the pose be uncertain where the wheels may have slipped before the newest steps.

        Poses that were kept meanwhile are given up, and so are ranges of before that wait. Ranges
        that were assigned meanwhile are left out of the whole run: the pose was not known.
        """
        slip = self._slips.take(motion, elapsed_s)
        if slip is None:
            return
        first = self._log.n_poses - slip.n_since - len(slip.covariances)
        for pose, covariance in enumerate(slip.covariances, start=first):
            self._log.loosen(pose, covariance)
        waiting = {one.log_id for one in self._waiting.values()}
        self._log.leave_out_since(first, {*self._landmark_of_label.values(), *waiting})
        n_sure = sum(number < first for number in self.state.past_numbers)
        self._marginalise_past(slice(n_sure, None))
        self._move(slip.since)
        self.slipped = turned_covariance(slip.since.covariance, self.state.heading_rad)
        self._unassigned.clear()

    def _leave_pose(self, increment: Array) -> None:
        """Before a motion, keep the pose among the past ones if it is one of the few that are kept.

        Those that the motion leaves far enough behind are final and marginalised.
        """
        rule, keys = self.parameters.lag, self.parameters.relinearisation
        if self._keeps_pose:
            self.state.keep_pose(self._log.n_poses - 1)
            self._past_ways_m.append(self._way_m)
            self._log.mark_key()
        before = math.floor(self._way_keys / rule.every)
        step_m, turn_rad = math.hypot(increment[0], increment[1]), abs(float(increment[2]))
        self._way_m += step_m
        self._way_keys += step_m / keys.key_m + turn_rad / keys.key_rad
        self._keeps_pose = rule.most > 0 and math.floor(self._way_keys / rule.every) > before
        behind = bisect_right(self._past_ways_m, self._way_m - rule.way_m)
        n = max(behind, len(self._past_ways_m) - rule.most)
        self.lagged = [self.state.past_pose(k) for k in range(n)]
        self._marginalise_past(slice(n))

    def _marginalise_past(self, places: slice) -> None:
        """Marginalise some of the past poses."""
        if self._past_ways_m[places]:
            self.state.marginalise_past(places)
            del self._past_ways_m[places]

    def set_down(self, pose: Array, points: Sequence[tuple[int, Array, Array]]) -> None:
        """Move by a step that the wheels did not measure, to a pose that lays points on landmarks.

        ``points`` are ids of landmarks with where they lie, (2,) [m] in the body frame of the pose,
        and the covariances of that: the pose becomes as certain as they make it. Past poses are
        given up: between them and the new one the robot was lost.
        """
        self._marginalise_past(slice(None))
        self._keeps_pose = False
        increment = np.zeros(3)
        free = free_motion(_CARRIED_M, _CARRIED_RAD)
        self._log.add_motion(increment, free, is_loose=True)
        self._slips.begin_anew()
        self._unassigned.clear()
        for waiting in (self._tentative, *self._crossings):
            waiting.clear()
        self._walls.tentative.clear()
        self._images.begin_anew(self._log.n_poses)
        state = self.state
        state.set_pose(pose, np.diag([_FREE_M**2, _FREE_M**2, _FREE_RAD**2]))
        for landmark_id, point_m, covariance in points:
            by_offsets = np.zeros((2, state.n_fixed - HEAD_SIZE))
            point = BodyPoint(point_m=point_m, covariance=covariance, by_offsets=by_offsets)
            update_with_point(state, state.landmark_ids.index(landmark_id), point)
        self._log.set_causal(state.pose)

    def update(
        self,
        scans: Sequence[RangeScan],
        *,
        solve: bool = True,
        decide: bool = True,
        may_wait: bool = False,
    ) -> UpdateReport:
        """Take in the scans of one time; a radar without a frame is absent, not empty.

        Without ``solve`` merges and the solution over all poses wait for a later time. With
        ``decide`` what is unclear is taken for the likeliest; without it, questions stay open. With
        ``may_wait`` the solution of a long run is left to the caller (``awaits_solution``).
        """
        patches = [scan for scan in scans if scan.is_patch]
        scans = [scan for scan in scans if not scan.is_patch]
        self._check_radars(scans)
        looks = [scan for scan in scans if scan.looks]
        self._images.take_scans(scans, self._log.n_poses - 1)
        antennas = antennas_of(self.rig, looks, self.state.calibration, self.state.mounts_m)
        # Steps in which no radar looked do not count towards windows of frames.
        has_look = bool(antennas.has_frame.any())
        association_m = self.parameters.ranges.association_sigma_m
        added_m = math.hypot(association_m, self.state.range_errors.added_m)
        with_bearings = [scan for scan in scans if scan.bearings_rad is not None]
        scans = [scan for scan in scans if scan.bearings_rad is None]
        looks = [scan for scan in looks if scan.bearings_rad is None]
        widened = [scan.with_added_sigma(added_m) for scan in looks]
        seen = self._look(antennas)
        beacons = self._beacon_rows()
        known = find_known(
            self.state, seen, widened, self._side_of, self.parameters, beacons=beacons
        )
        predicted = predicted_ranges(self.state, seen, known, self._side_of, antennas)
        missed = self._count(known)
        report = replace(self._correct(known, seen, looks, antennas), predicted=predicted)
        used = {(radar, index) for radar, index, _ in report.continued}
        evidence_of_misses = [(id_, self._existence.unheard(id_)) for id_ in missed]
        for _, _, id_ in report.continued:
            self._existence.heard(id_)
        if any(scan.labelled for scan in scans):
            used |= {(scan.radar, index) for scan in scans for index, _ in scan.labelled}
            report = _together(report, self._take_labelled(scans, added_m))
        for scan in with_bearings:
            report = _together(report, self._take_points(scan, added_m))
        if has_look or patches:
            self._unassigned.keep(self._log.n_poses - 1, antennas, widened, used)
        of_patches = self._take_patches(patches, added_m)
        of_crossings = self._take_crossings(antennas) if has_look else []
        self._delete_vanished(solve=solve)
        self._n_updates += 1
        if solve:
            self._initialise_beacons()
            self._merge()
            may_wait = may_wait and self._is_long
            if not may_wait and is_due(self._log, self.state, self.parameters):
                self.relinearise()
        if decide:
            self._decide()
        self._log.set_causal(self.state.pose)
        evidence = (*report.evidence, *evidence_of_misses, *of_patches, *of_crossings)
        return replace(report, evidence=evidence)

    def _check_radars(self, scans: Sequence[RangeScan]) -> None:
        radars = {scan.radar for scan in scans}
        if len(radars) < len(scans) or max(radars, default=0) >= len(self.rig.mounts):
            raise ValueError(
                f"scans of radars {[scan.radar for scan in scans]}; there is at most one of each "
                f"of the {len(self.rig.mounts)} in the rig"
            )

    def _decide(self) -> None:
        """Take what is unclear for the likeliest."""
        while (question := self.question()) is not None:
            self.answer(question, question.options[0])

    @property
    def _is_long(self) -> bool:
        return self._log.n_poses > self.parameters.relinearisation.most_at_once

    @property
    def awaits_solution(self) -> bool:
        """Return whether the whole run should be solved for, which takes long."""
        return self._is_long and is_due(self._log, self.state, self.parameters)

    @property
    def since_solved(self) -> int:
        """Return how many steps ago the whole run was solved for, or that was tried."""
        return self._log.since_solved

    def relinearise(self) -> bool:
        """Solve for all poses and replace the belief; return whether that worked."""
        return relinearise(self._log, self.state, self.parameters)

    def _look(self, antennas: Antennas) -> View:
        """Return the view of all features of which single ranges may be."""
        seen, rule = self._walls.look(view(self.state, antennas), antennas), self.parameters
        if self._images.radars:
            imaged = sorted(self._images.radars)
            seen = seen.without_crowds(imaged, rule.ranges, rule.continuation.blur_m)
        self._images.bar(seen, self.state.landmark_ids)
        return seen

    def _count(self, known: Known) -> list[int]:
        """Count hits and misses; return landmarks surely in view and not heard, once per radar."""
        features, existence = self.state.feature_ids, self._existence
        ids = [features[row] for row in known.rows.tolist()]
        for place in set(known.assigned[:, 2].tolist()):
            existence.hit(ids[place])
        for place in np.flatnonzero(known.of_side[:, :, 1].any(axis=0)).tolist():
            existence.miss(ids[place])
        # A wall may end before it comes into view.
        n = len(self.state.landmark_ids)
        unheard = np.nonzero(known.unheard)[0].tolist()
        return [ids[place] for place in unheard if known.rows[place] < n]

    def _correct(
        self,
        known: Known,
        seen: View,
        scans: Sequence[RangeScan],
        antennas: Antennas,
    ) -> UpdateReport:
        """Correct the state with all ranges found at once, weighted by Huber; log them."""
        if not len(known.assigned):
            return UpdateReport(continued=(), nis=0.0, dof=0)
        state, ids = self.state, self.state.feature_ids
        weighed = weigh_known(state, known, seen, scans, self.parameters.ranges)
        continued = tuple(
            (radar, index, ids[int(known.rows[place])])
            for radar, index, place in known.assigned.tolist()
        )
        of_radar = {scan.radar: scan for scan in scans}
        for radar, index, id_ in continued:
            self._log_range(of_radar[radar], index, id_, antennas)
        state.apply(weighed.gain, weighed.weighted)
        of_ranges = zip(continued, weighed.evidence.tolist(), strict=True)
        return UpdateReport(
            continued=continued,
            nis=float(weighed.white @ weighed.white),
            dof=len(continued),
            evidence=tuple((id_, nats) for (_, _, id_), nats in of_ranges),
        )

    def _beacon_rows(self) -> list[int]:
        """Return the rows of landmarks whose ranges have labels."""
        beacons = {id_ for label, id_ in self._landmark_of_label.items() if label in self._heard}
        return [row for row, id_ in enumerate(self.state.landmark_ids) if id_ in beacons]

    def _labelled_rows(self) -> list[int]:
        """Return the rows of landmarks that have labels."""
        labelled = set(self._landmark_of_label.values())
        return [row for row, id_ in enumerate(self.state.landmark_ids) if id_ in labelled]

    def _distinct_rows(self) -> list[int]:
        """Return the rows of landmarks no two of which are one: they have labels, or are mapped."""
        ids = enumerate(self.state.landmark_ids)
        return [*self._labelled_rows(), *(row for row, id_ in ids if id_ < self._first_id)]

    def _rows_by_label(self) -> dict[int, int]:
        rows = {id_: row for row, id_ in enumerate(self.state.landmark_ids)}
        labels = self._landmark_of_label.items()
        return {label: rows[id_] for label, id_ in labels if id_ in rows}

    def _take_labelled(self, scans: Sequence[RangeScan], added_m: float) -> UpdateReport:
        """Correct the state with the ranges that have labels, and log them all.

        A range beyond the gate corrects nothing now; it is logged, too: which are outliers, the
        solution over the whole run decides. ``added_m`` is added in squares to the noise of ranges
        in the gate.
        """
        state = self.state
        antennas = antennas_of(self.rig, scans, state.calibration, state.mounts_m)
        widened = [scan.with_added_sigma(added_m) for scan in scans]
        seen, row_of_label = view(state, antennas), self._rows_by_label()
        known, refused = find_labelled(state, seen, widened, row_of_label, self.parameters)
        variances = np.sum((known.H @ state.P.block(known.at)) * known.H, axis=1).tolist()
        which = [
            (radar, int(known.rows[place]), variance)
            for (radar, _, place), variance in zip(known.assigned.tolist(), variances, strict=True)
        ]
        predicted = ranges_predicted(state, seen, antennas, which)
        ids = state.landmark_ids.copy()
        miss = math.log(1.0 - self.parameters.ranges.detection_probability)
        for row in known.rows[known.assigned[:, 2]].tolist():
            self._existence.hit(ids[row])
        for _, _, row in refused:
            self._existence.miss(ids[row])
        of_radar = {scan.radar: scan for scan in scans}
        for radar, index, row in refused:
            self._log_range(of_radar[radar], index, ids[row], antennas)
        report = self._correct(known, seen, scans, antennas)
        misses = [(ids[row], miss) for _, _, row in refused]
        for scan in scans:
            for index, label in scan.labelled:
                self._heard.add(label)
                if label not in self._landmark_of_label and 0.0 < scan.ranges_m[index] < LONGEST_M:
                    if label not in self._waiting:
                        self._waiting[label] = Waiting(state.next_id)
                        state.next_id += 1
                    waiting = self._waiting[label]
                    waiting.n_ranges += 1
                    self._log_range(scan, index, waiting.log_id, antennas)
        return replace(report, predicted=predicted, evidence=(*report.evidence, *misses))

    def _log_range(self, scan: RangeScan, index: int, id_: int, antennas: Antennas) -> None:
        x_m, y_m = antennas.nominal_m[scan.radar].tolist()
        self._log.add_range(
            self._log.n_poses - 1,
            scan.radar,
            id_,
            antenna=(x_m, y_m),
            turn_rad=float(antennas.turns_rad[scan.radar]),
            range_m=scan.ranges_m[index],
            sigma_m=scan.sigma(index, self.parameters.ranges.sigma_m),
        )

    def _initialise_beacons(self) -> None:
        """Bring the beacons into the map whose ranges have one place."""
        fewest = self.parameters.initialisation.min_frames
        share = 1.0 + self.parameters.relinearisation.run_share
        for label, waiting in list(self._waiting.items()):
            if waiting.n_ranges < max(fewest, waiting.try_at):
                continue
            waiting.try_at = math.ceil(share * waiting.n_ranges)
            landmark_id = initialise_beacon(self._log, self.state, waiting.log_id, self.parameters)
            if landmark_id is not None:
                del self._waiting[label]
                self._landmark_of_label[label] = landmark_id
                self._existence.hit(landmark_id, waiting.n_ranges)

    def _take_patches(
        self, patches: Sequence[RangeScan], added_m: float
    ) -> list[tuple[int, float]]:
        """Take in points and walls of patches one after the other; return ids and evidence."""
        found = list[tuple[int, float]]()
        for scan in patches:
            if scan.faces_m is not None:
                self._take_faces(scan, scan.faces_m)
                continue
            found += self._take_points(scan, added_m).evidence
            self._decide()
        return found

    def _take_faces(self, scan: RangeScan, faces_m: Sequence[tuple[float, float]]) -> None:
        """Correct the state with the walls that a patch shows; log them, and make new ones."""
        state, every = self.state, range(len(faces_m))
        antennas = antennas_of(self.rig, [scan], state.calibration, state.mounts_m)
        seen = detections_of(scan, every, self._log.n_poses - 1, antennas, self.parameters.ranges)
        faces = list(zip(seen, faces_m, strict=True))
        for wall_id, detections in self._walls.take(faces, antennas):
            n_frames = len(detections) * self.parameters.imaged.frames_per_patch
            self._existence.hit(wall_id, n_frames)
            self._log.add_detections(wall_id, detections)

    def _take_points(self, scan: RangeScan, added_m: float) -> UpdateReport:
        """Correct the state with a scan with bearings; log it; make landmarks of what is new.

        What is certain corrects the pose first, and is followed by what is certain then. A labelled
        detection that is too far off is logged all the same.
        """
        assert scan.bearings_rad is not None
        state, noise, ids = self.state, self.parameters.ranges, self.state.landmark_ids
        antennas = antennas_of(self.rig, [scan], state.calibration, state.mounts_m)
        wide = scan.with_added_sigma(added_m)
        free = [
            index
            for index, pair in enumerate(zip(scan.ranges_m, scan.bearings_rad, strict=True))
            if 0.0 < pair[0] < LONGEST_M and math.isfinite(pair[1])
        ]
        row_of_label, hit = self._rows_by_label(), set[int]()
        report = UpdateReport(continued=(), nis=0.0, dof=0)
        while True:
            seen = view(state, antennas)
            found = find_points(state, seen, wide, (free, hit, row_of_label), self.parameters)
            if not found.pairs:
                break
            found = found.without_mirrors(scan)
            hit.update(row for _, row in found.pairs)
            for (_, row), nats in zip(found.pairs, found.evidence, strict=True):
                if self._log.is_new_passage(ids[row]):
                    self.evidence += nats
            report = _together(report, self._correct_points(scan, seen, found.pairs, antennas))
            used = scan.with_mirrors([index for index, _ in found.pairs])
            free = [index for index in free if index not in used]
        hit_ids = {ids[row] for row in hit}
        rule = self.parameters.bearings(of_patches=scan.is_patch)
        for landmark_id in sorted(hit_ids):
            self._existence.hit(landmark_id, rule.frames_per_scan)
        refused = [(index, ids[row]) for index, row in found.refused]
        for index, landmark_id in refused:
            self._log.add_detections(
                landmark_id, detections_of(scan, [index], self._log.n_poses - 1, antennas, noise)
            )
        if scan.is_patch:
            self._take_shown(scan.radar, hit_ids, {ids[row] for row in found.missed} - hit_ids)
            found = replace(found, missed=())
        # Those that are seen rarely are missed often: half of the expected hits, at most.
        odds = noise.detection_probability / (1.0 - noise.detection_probability)
        miss = math.log(1.0 - noise.detection_probability)
        missed = {id_ for _, id_ in refused} | {ids[row] for row in found.missed}
        # What one scan misses, the next ones miss likely, too: those of a window count as one.
        self.evidence += miss * len(missed - hit_ids) / self.parameters.initialisation.window
        for landmark_id in sorted(missed - hit_ids):
            self._existence.miss(landmark_id, 0.5 * odds)
        misses = [(landmark_id, miss) for landmark_id in sorted(missed - hit_ids)]
        far = {index for index, _ in refused}
        free = [index for index in free if index not in far]
        detections = detections_of(scan, free, self._log.n_poses - 1, antennas, noise)
        points = [body_point(state, antennas, one, 1.0 - noise.common_share) for one in detections]
        self._tentative.take(detections, points)
        self._antennas, self._settled = antennas, hit_ids | missed
        if detections:
            self._place_points()
        return replace(report, evidence=(*report.evidence, *misses))

    def _take_shown(self, radar: int, shown: set[int], hidden: set[int]) -> None:
        """Take the ids that a patch shows and hides; leave out the single ranges of the latter."""
        self._existence.show(shown)
        self._existence.show(hidden, -1)
        since = self._images.take_patch(radar, shown, hidden, self._log.n_poses)
        if hidden:
            self._log.leave_out(radar, hidden, since)

    def _correct_points(
        self,
        scan: RangeScan,
        seen: View,
        pairs: Sequence[tuple[int, int]],
        antennas: Antennas,
    ) -> UpdateReport:
        """Correct the state with detections of landmarks, index and row each; log them."""
        assert scan.bearings_rad is not None
        state, noise, ids = self.state, self.parameters.ranges, self.state.landmark_ids
        indices, rows = [index for index, _ in pairs], [row for _, row in pairs]
        view_of = point_view(state, seen, scan.radar, np.array(rows, dtype=np.intp))
        H = view_of.H[:, 0]
        of_ranges = np.sum((H @ state.P.block(view_of.at)) * H, axis=1).tolist()
        which = [(scan.radar, row, value) for row, value in zip(rows, of_ranges, strict=True)]
        predicted = ranges_predicted(state, seen, antennas, which)
        measured = [(scan.ranges_m[index], scan.bearings_rad[index]) for index in indices]
        innovations = np.array(measured) - view_of.predicted
        innovations[:, 1] = wrap_angles(innovations[:, 1])
        variances = point_variances(scan, indices, noise)
        variances[:, 0] += np.square(state.feature_added_sigmas_m[rows])
        gain, weighted, white, scales = kernels.weigh(
            state.P.columns(view_of.at),
            view_of.at,
            np.ascontiguousarray(view_of.H.reshape(2 * len(pairs), -1)),
            innovations.ravel(),
            variances.ravel(),
            noise.huber_sigmas,
            state.range_errors.variance_share,
        )
        area = (noise.max_range_m - noise.min_range_m) * noise.field_of_view_rad
        clutter = max(noise.clutter_per_m / noise.field_of_view_rad, scan.n_seen / area)
        log_n = -0.5 * np.square(white) - 0.5 * math.log(math.tau) - np.log(scales)
        log_n = log_n.reshape(-1, 2).sum(axis=1) + math.log(noise.detection_probability / clutter)
        pose = self._log.n_poses - 1
        for row, detection in zip(
            rows, detections_of(scan, indices, pose, antennas, noise), strict=True
        ):
            self._log.add_detections(ids[row], [detection])
            self._existence.take_mirror(ids[row], self._way_to_mirror(detection))
        state.apply(gain, weighted)
        return UpdateReport(
            continued=tuple([(scan.radar, index, ids[row]) for index, row in pairs]),
            nis=float(white @ white),
            dof=len(white),
            predicted=predicted,
            evidence=tuple(
                (ids[row], nats) for row, nats in zip(rows, log_n.tolist(), strict=True)
            ),
        )

    def _place_points(self) -> None:
        """Let tentative landmarks be those of the map that they certainly are, or have labels of.

        Of the others it is asked which they are.
        """
        for tentative in self._tentative.take_out():
            rule = self.parameters.bearings(of_patches=tentative.is_of_patches)
            density = rule.unmapped_per_m2
            if tentative.label is None and tentative.misses:
                self._tentative.keep(tentative)  # the newest scan does not hold it
                continue
            point, row = self._common(tentative), None
            if tentative.label is None:
                found = self._possible(tentative, point)
                row = certain_row(found, density)
                if row is None:
                    self._tentative.keep(tentative)
                    continue
                certain = {row: found[row]}
                (option,) = options_of(self.state, point, certain, density)
                self._count_evidence(option)
            self._place_point(tentative, point, row)

    def _possible(self, tentative: TentativePoint, point: BodyPoint) -> dict[int, FeatureRows]:
        """Return the landmarks that a tentative one without a label may be, by row.

        Those with labels, and those of which a scan says where they are, are not it.
        """
        beside = self._log.seen_from({one.pose for one in tentative.seen})
        apart = self.parameters.bearings(of_patches=tentative.is_of_patches).fewest
        barred = {
            row
            for row, id_ in enumerate(self.state.landmark_ids)
            if id_ in self._settled or beside[id_] >= apart
        }
        barred.update(self._labelled_rows())
        return possible_rows(self.state, point, barred, self.parameters)

    def question(self) -> Question | None:
        """Return which of several options the first tentative landmark is that is unclear."""
        parameters = self.parameters
        for tentative in self._tentative.unclear():
            rule = parameters.bearings(of_patches=tentative.is_of_patches)
            if len(tentative.seen) < rule.if_unclear:
                continue
            point = self._common(tentative)
            found = self._possible(tentative, point)
            options = options_of(self.state, point, found, rule.unmapped_per_m2)
            options.append(Option(evidence=0.0))
            if self._may_have_jumped(tentative):
                rarity = math.log(parameters.branches.steps_per_jump)
                options.append(Option(evidence=-rarity, is_jump=True))
            options.sort(key=lambda one: -one.evidence)
            return Question(tentative=tentative, point=point, options=tuple(options))
        return None

    def answer(self, question: Question, option: Option) -> bool:
        """Believe one option of a question of this back end; return False if that is impossible."""
        parameters = self.parameters
        self._count_evidence(option)
        if not option.is_jump:
            self._tentative.remove(question.tentative)
            self._place_point(question.tentative, question.point, option.row)
            self._log.set_causal(self.state.pose)
            return True
        self._jumped = question.tentative.seen[0].pose
        for waiting in (self._tentative, *self._crossings):
            waiting.forget_before(self._jumped)
        self._walls.tentative.forget_before(self._jumped)
        self._settled = set()  # what was in view then was so from another pose
        sigmas = [parameters.jumps.sigma_m, parameters.jumps.sigma_m, parameters.jumps.sigma_rad]
        self._log.loosen(self._jumped, np.diag(np.square(sigmas)))
        return self.relinearise()

    def _count_evidence(self, option: Option) -> None:
        """Add the evidence of an option, that of a landmark once a passage."""
        ids = self.state.landmark_ids
        if option.row is None or self._log.is_new_passage(ids[option.row]):
            self.evidence += option.evidence

    def _may_have_jumped(self, tentative: TentativePoint) -> bool:
        """Return whether the robot may have moved unnoticed before a landmark was first seen."""
        since = tentative.seen[0].pose - self._jumped
        n_known = len(self.state.landmark_ids)
        return (
            self.parameters.jumps.sigma_rad > 0.0
            and since > self.parameters.map.gap_poses
            and n_known >= self.parameters.branches.least_landmarks
        )

    def _common(self, tentative: TentativePoint) -> BodyPoint:
        """Return a tentative point with the errors that all its detections have in common."""
        share = max(self.state.range_errors.variance_share, 1.0)
        common_share = self.parameters.ranges.common_share
        common = body_point(self.state, self._antennas, tentative.seen[-1], common_share).covariance
        return replace(tentative.point, covariance=share * tentative.point.covariance + common)

    def _place_point(self, tentative: TentativePoint, point: BodyPoint, row: int | None) -> None:
        """Update the landmark in a row with a tentative one, or add it to the map."""
        state, ranges, radius = self.state, None, None
        if state.radius_sigma_m and row is None:
            radius = tentative.radius(state.radius_sigma_m)
        if tentative.is_of_patches:
            side = self._sides[self._side_of[tentative.seen[-1].radar]]
            radius_m = (radius or (0.0,))[0] if row is None else float(state.feature_radii_m[row])
            ranges = self._unassigned.fit(tentative.point, side, state, radius_m=radius_m)
        if ranges is not None:
            point = self._as_uncertain(ranges.point)
        if row is None:
            landmark_id = initialise_landmark(state, point, radius)
            if tentative.label is not None:
                self._landmark_of_label[tentative.label] = landmark_id
        else:
            landmark_id = state.landmark_ids[row]
            update_with_point(state, row, point)
        rule = self.parameters.bearings(of_patches=tentative.is_of_patches)
        self._existence.hit(landmark_id, len(tentative.seen) * rule.frames_per_scan)
        self._existence.show([landmark_id], len(tentative.seen))
        ways = [self._way_to_mirror(detection) for detection in tentative.seen]
        if row is None:
            self._existence.begin_mirrored(landmark_id, ways)
        for way in ways:
            self._existence.take_mirror(landmark_id, way)
        self._log.add_detections(landmark_id, tentative.seen)
        if ranges is not None:
            self._use(landmark_id, ranges)

    def _way_to_mirror(self, detection: PointDetection) -> MirrorWay | None:
        """Return the way from a detection to its mirror image in the map, if it has one."""
        if detection.mirrored_rad is None:
            return None
        heading_rad = self.state.heading_rad
        if detection.pose < self._log.n_poses - 1:  # of the newest the log has the wheels' only
            heading_rad = self._log.heading_at(detection.pose)
        return detection.way_to_mirror(heading_rad, self.pose_covariance[2, 2])

    def _take_crossings(self, antennas: Antennas) -> list[tuple[int, float]]:
        """Let ranges of nothing known, of radars without images, begin landmarks where they cross.

        Points of patches lie apart from their neighbours, and show walls. Returns of each landmark
        the id, and how much likelier its ranges are than as false ones.
        """
        pose, fewest = self._log.n_poses - 1, self.parameters.initialisation.min_frames
        evidence = list[tuple[int, float]]()
        for side, waiting in zip(self._sides, self._crossings, strict=True):
            radars = [radar for radar in side if radar not in self._images.radars]
            pairs = [pair for pair in combinations(radars, 2) if antennas.has_frame[[*pair]].all()]
            found = [
                one
                for pair in pairs
                for ranges in product(*map(self._unassigned.newest, pair))
                for one in crossing(self.state, antennas, ranges, self.parameters, pose)
            ]
            waiting.take([seen for seen, _ in found], [point for _, point in found])
            for tentative in waiting.unclear():
                ranges = self._unassigned.fit(
                    tentative.point, radars, self.state, is_of_ranges=True
                )
                if ranges is None or ranges.n_frames < fewest or ranges.is_flat:
                    continue
                waiting.remove(tentative)
                nats = ranges.evidence(self.parameters.ranges)
                evidence.append((self._place_ranges(ranges), nats))
        return evidence

    def _place_ranges(self, ranges: FittedRanges) -> int:
        """Let ranges be those of the landmark that their point certainly is, or of a new one.

        Returns its id.
        """
        state, point = self.state, self._as_uncertain(ranges.point)
        row = match(state, point)
        if row is None:
            landmark_id = initialise_landmark(state, point)
        else:
            landmark_id = state.landmark_ids[row]
            update_with_point(state, row, point)
        self._use(landmark_id, ranges)
        return landmark_id

    def _as_uncertain(self, point: BodyPoint) -> BodyPoint:
        """Return a point that ranges were fitted to, as uncertain as ranges of the run are."""
        share = max(self.state.range_errors.variance_share, 1.0)
        return replace(point, covariance=share * point.covariance)

    def _use(self, landmark_id: int, ranges: FittedRanges) -> None:
        """Count and log ranges that were of nothing known as those of a landmark."""
        self._unassigned.use_up(ranges)
        self._existence.hit(landmark_id, ranges.n_frames)
        self._existence.show([landmark_id], ranges.n_frames)
        self._log.add_unassigned(landmark_id, ranges.rows)

    def _delete_vanished(self, *, solve: bool) -> None:
        """Delete landmarks that are not there any more; without ``solve``, no beacons."""
        lost, beacons = self._existence.lost(), set()
        if lost and self._heard:
            beacons = {self.state.landmark_ids[row] for row in self._beacon_rows()}
        vanished = [
            id_ for id_ in lost if id_ not in beacons or (solve and not self._is_where_it_was(id_))
        ]
        for landmark_id in vanished:
            self._walls.cells.forget(landmark_id)
            self.state.remove(self.state.feature_ids.index(landmark_id))
            self._existence.forget(landmark_id)
            self._log.drop(landmark_id)
        if vanished:
            self._images.forget(vanished)
            kept = self._landmark_of_label.items()
            self._landmark_of_label = {label: id_ for label, id_ in kept if id_ not in vanished}

    def _is_where_it_was(self, landmark_id: int) -> bool:
        """Return whether ranges beyond the gate are a beacon's after all, as the whole run has it.

        A pose that was wrong is then corrected, and the beacon begins anew with its score.
        """
        self.relinearise()
        row = self.state.landmark_ids.index(landmark_id)
        if not is_heard_where_it_is(self._log, self.state, row, self.parameters):
            return False
        self._existence.renew(landmark_id)
        return True

    def _merge(self) -> None:
        """Merge landmarks where that is certain, and the whole run allows it."""
        rule, now = self.parameters.map, self._n_updates
        if now % rule.look_every:
            return
        kept = self._refused.items()
        self._refused = {ids: at for ids, at in kept if now - at < rule.refused_updates}
        merge = find_merge(self.state, rule, self._refused, self._distinct_rows())
        if merge is not None and self._are_seen_together(*merge.pair):
            self._refused[named_pairs(self.state, (merge.pair,))] = now
        elif merge is not None and self.merge_if_possible([merge.pair]):
            self.evidence += merge.evidence

    def _are_seen_together(self, first: int, second: int) -> bool:
        """Return whether scans with bearings hold both of two landmarks, by row."""
        ids = self.state.landmark_ids
        # With images of any radar: what patches hold is most of what has bearings.
        fewest = self.parameters.bearings(of_patches=bool(self._images.radars)).fewest
        return self._log.seen_from(self._log.poses_of(ids[first]))[ids[second]] >= fewest

    def merge_if_possible(self, pairs: Sequence[tuple[int, int]]) -> bool:
        """Merge landmarks, rows of the older first, if the whole run allows it; return whether.

        Then all poses are solved for again.
        """
        state, pairs = self.state, tuple(pairs)
        ids = named_pairs(state, pairs)
        named = self._landmark_of_label.values()
        found = solved_as_one(self._log, state, pairs, self.parameters, named)
        if found is None:
            self._refused[ids] = self._n_updates
            return False
        state.added_sigmas_m |= noisier(state, {gone: kept for kept, gone in ids})
        apply_merge(state, pairs, MERGE_SIGMA_M)
        for kept, gone in ids:
            self._existence.merge(kept, gone)
            self._log.rename(gone, kept)
        merged = {gone: kept for kept, gone in ids}
        self._images.forget({*merged, *merged.values()})
        self._settled = {merged.get(id_, id_) for id_ in self._settled}
        labels = self._landmark_of_label.items()
        self._landmark_of_label = {label: merged.get(id_, id_) for label, id_ in labels}
        self._log.since_solved = 0
        self._log.leave_out_rows(found.left_out)
        adopt(self._log, state, found.problem, found.solution, self.parameters)
        return True

"""The robust back end: odometry increments and ranges in, pose and landmarks out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.geometry import Rig
from slam.results import ExpectedRange, MapLandmark, MapWall, UpdateReport
from slam.robust.initialisation import (
    Leftovers,
    Member,
    RangeBearing,
    Tracker,
    Tracklet,
    assign,
    find_tracklets,
    give_birth,
    guesses_of,
    match,
    named_rows,
    range_bearing_rows,
    update_with_point,
)
from slam.robust.kidnapping import Trial, Whereabouts, forget, merge_landmarks, trials
from slam.robust.map import Existence, Roundness
from slam.robust.matching import (
    Continuation,
    SureLandmarks,
    continue_tracks,
    expected_ranges,
    labelled,
    landmarks_in_view,
)
from slam.robust.parameters import BackEndParameters, PointRule
from slam.robust.ranges import Antennas, RangeScan, View, antennas_of, rows_of, sides_of, view
from slam.robust.run_log import RunLog
from slam.robust.smoother import is_due, relinearise
from slam.robust.state import Array, State, at_rest, calibrated_motion, predict
from slam.robust.walls import WallKeeper


def huber_weighted_sigmas_m(
    innovations_m: Array, prior_variances: Array, sigmas_m: Array, bound: float
) -> Array:
    """Return standard deviations of ranges, those of large innovations enlarged.

    With S = prior variance + sigma^2, an innovation of ``k`` standard deviations, k > bound, is
    given the variance S k / bound, so that its information falls by Huber's weight, bound / k, and
    what it moves grows no further. All shapes are (m,), with ``prior_variances`` [m^2] those of the
    predictions. Source: Huber, Annals of Mathematical Statistics 35(1), 1964.

    >>> huber_weighted_sigmas_m(np.array([1.0, 4.0]), np.zeros(2), np.ones(2), 2.0) ** 2
    array([1., 2.])
    """
    S = prior_variances + np.square(sigmas_m)
    excess = np.abs(innovations_m) / (bound * np.sqrt(S))
    return np.where(excess > 1.0, np.sqrt(np.maximum(S * excess - prior_variances, 0.0)), sigmas_m)


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


class RobustBackEnd:
    """Range SLAM that keeps track of how sure it is.

    ``predict`` and ``update`` alternate: one motion, then what the radars saw at its end. The map
    frame is the body frame at the start.

    Parameters
    ----------
    rig
        Where the radars sit.
    parameters
        Noise and rules.
    """

    def __init__(self, rig: Rig, parameters: BackEndParameters) -> None:
        self.rig = rig
        self.parameters = parameters
        offsets = (parameters.ranges.offset_sigma_m,) * len(rig.mounts)
        self.state = State(parameters.wheels.calibration_sigmas, offsets)
        self._sides = sides_of(rig)
        rule = parameters.tracklets
        scale = rule.drift_share * parameters.wheels.scale_sigma
        self._leftovers = Leftovers(
            max(rule.window, rule.single_window),
            parameters.ranges.sigma_m,
            scale,
            scale * rule.lever_m,
        )
        self._existence = Existence(parameters.map)
        window = max(rule.window, rule.single_window)
        self._log = RunLog(parameters.wheels, None if parameters.relinearisation else window)
        self._motion = at_rest()
        self._walls = WallKeeper(self.state, parameters)
        round_rule = parameters.roundness
        self._roundness = None if round_rule is None else Roundness(round_rule)
        self._silent = np.zeros(len(rig.mounts), dtype=np.intp)
        self._landmark_of_label: dict[int, int] = {}
        self._n_updates = 0
        self._expected: list[ExpectedRange] = []
        self._trials: list[Trial] = []
        self._whereabouts = Whereabouts(parameters)

    @property
    def pose(self) -> Array:
        """Return [x m, y m, heading rad], map frame, shape (3,)."""
        return self.state.pose

    @property
    def pose_covariance(self) -> Array:
        """Return the covariance of the pose, shape (3, 3)."""
        if self._whereabouts.is_lost:
            return self._whereabouts.lost_covariance
        return self.state.pose_covariance()

    def landmarks(self) -> tuple[MapLandmark, ...]:
        """Return the landmarks hit often enough to be reported."""
        state, rows = self.state, self.reported_rows()
        return tuple(
            MapLandmark(
                landmark_id=state.landmark_ids[row],
                position_m=point_m,
                covariance=state.landmark_covariance(row),
                hits=self._existence.hits(state.landmark_ids[row]),
            )
            for row, point_m in zip(rows, state.landmarks_m[rows], strict=True)
        )

    def reported_rows(self) -> list[int]:
        """Return the rows of landmarks hit often enough to be reported; of an island, none."""
        elsewhere, lost = self._whereabouts.elsewhere, self._whereabouts.is_lost
        return [
            row
            for row, id_ in enumerate(self.state.landmark_ids)
            if self._existence.is_reported(id_) and (id_ in elsewhere or not lost)
        ]

    def walls(self) -> tuple[MapWall, ...]:
        """Return the walls hit often enough to be reported."""
        return tuple(
            self._walls.reported(row, self._existence.hits(id_))
            for row, id_ in enumerate(self.state.wall_ids)
            if self._existence.is_reported(id_)
        )

    def predict(self, increment: Array, covariance: Array | None = None) -> None:
        """Move by one odometry increment.

        Parameters
        ----------
        increment
            shape (3,): dx, dy [m], turn [rad] in the body frame before it, as reported.
        covariance
            Its noise, shape (3, 3), if it is known better than the wheels' model tells.
        """
        wheels = self.parameters.wheels
        motion = calibrated_motion(increment, self.state.calibration, wheels, covariance)
        self._log.add_motion(
            increment, motion.covariance, motion.walk_variance, self.state.calibration
        )
        predict(self.state, motion, wheels)
        self._leftovers.move(motion)
        self._motion = motion

    def update(self, scans: Sequence[RangeScan]) -> UpdateReport:
        """Take in what the radars saw; a radar without a frame is absent, not empty."""
        antennas = antennas_of(self.rig, scans, self._motion, self.state.calibration)
        self._silent = np.where(antennas.heard, 0, self._silent + 1)
        self._expected, self._trials = [], []
        was_lost = self._whereabouts.is_lost
        doubted = [scan.doubted(self.parameters.ranges.doubt_m) for scan in scans]
        continued, nis = self._continue_tracks(scans, doubted, antennas)
        carried = self._whereabouts.is_carried
        if carried:
            self._whereabouts.set_down(self.state, self._existence, self._log)
            self._leftovers.clear()
        used = {(radar, index) for radar, index, _ in continued}
        self._leftovers.keep(self._log.n_poses - 1, antennas, doubted, used)
        born, seen_again = self._raise_tracklets()
        deleted = self._delete_lost()
        self._n_updates += 1
        merged = self._merge()
        lost = self._whereabouts.is_lost
        relinearised = self._give_radii()
        if relinearised or is_due(self._log, self.state, self.parameters):
            relinearised |= self.relinearise()
        self._log.set_causal(self.state.pose)
        return UpdateReport(
            continued=continued,
            born=born,
            seen_again=seen_again,
            merged=merged,
            deleted=deleted,
            nis=nis,
            dof=len(continued),
            relinearised=relinearised,
            expected=tuple(self._expected),
            carried=carried,
            lost=lost,
            relocated=was_lost and not lost,
        )

    def update_points(
        self, points: Sequence[RangeBearing], rule: PointRule | None = None
    ) -> tuple[int | None, ...]:
        """Take in ranges and bearings of points seen from the newest pose.

        Labelled points are of the landmark of that label, and new where it is. The others are
        assigned by distance.

        Returns
        -------
        landmark_ids
            One per point; None where it was in doubt and left out.
        """
        rule = rule or PointRule()
        state = self.state
        rows = named_rows(state, points, self._landmark_of_label)
        if rows is None:
            rows = assign(state, points, rule.gate, rule.new_gate, rule.reach_m)
        found: list[int | None] = []
        for point, row in zip(points, rows, strict=True):
            landmark_id = None if row is None else self._see_point(point, row)
            found.append(landmark_id)
        if is_due(self._log, self.state, self.parameters):
            self.relinearise()
        self._log.set_causal(state.pose)
        return tuple(found)

    def _see_point(self, point: RangeBearing, row: int) -> int:
        """Update the landmark in a row with a point, or give birth to it (row -1)."""
        state = self.state
        if row < 0:
            landmark_id = give_birth(state, point.body_point(len(state.offsets_m)))
            if point.label is not None:
                self._landmark_of_label[point.label] = landmark_id
        else:
            landmark_id = state.landmark_ids[row]
            rows = range_bearing_rows(state, row, point)
            state.update(rows.at, rows.H, rows.residual, point.covariance)
        self._existence.hit(landmark_id)
        self._log.add_point(landmark_id, point.values, point.covariance)
        return landmark_id

    def relinearise(self) -> bool:
        """Solve for all poses and replace the belief; tell whether that worked.

        Not while the robot is lost or something speaks against its pose: a wrong measurement
        would be spread over the whole run.
        """
        if self._whereabouts.is_lost or self._whereabouts.is_suspicious:
            return False
        return relinearise(self._log, self.state, self.parameters)

    def _give_radii(self) -> bool:
        """Give landmarks the radii that are evident; tell whether all poses were solved for."""
        if self._roundness is None or self._whereabouts.is_lost or self._whereabouts.is_suspicious:
            return False
        hits = self._existence.hits
        return self._roundness.give(self.state, self._log, self.parameters, hits)

    def _continue_tracks(
        self, scans: Sequence[RangeScan], doubted: Sequence[RangeScan], antennas: Antennas
    ) -> tuple[tuple[tuple[int, int, int], ...], float]:
        """Find the ranges of known landmarks and correct the state with all of them at once.

        They are found among the ``doubted``, and weigh as ``scans`` tell and Huber allows.
        """
        state = self.state
        if not state.feature_ids:
            return (), 0.0
        seen = self._walls.look(view(state, antennas), antennas)
        seen = self._whereabouts.seen_from_here(seen, state)
        found: list[Continuation] = []
        for side in self._sides:
            of_side = [scan for scan in doubted if scan.radar in side]
            heard = listen(of_side, seen, antennas, state, self._existence, self.parameters)
            found += heard.continued
            self._expected += heard.expected
            self._trials += heard.trials
        if any(scan.labels is not None for scan in scans):
            found = labelled(scans, state, self._landmark_of_label)
        else:
            self._whereabouts.look(self._trials, state, self._log)
        if not found or self._whereabouts.is_carried:
            return (), 0.0
        ids = state.feature_ids
        continued = tuple((c.radar, c.index, ids[c.row]) for c in found)
        of_radar, noise = {scan.radar: scan for scan in scans}, self.parameters.ranges
        z = np.array([of_radar[c.radar].ranges_m[c.index] for c in found])
        rows = rows_of(
            state,
            seen,
            np.array([c.radar for c in found], dtype=np.intp),
            np.array([c.row for c in found], dtype=np.intp),
        )
        innovations_m = z - rows.predicted_m
        sigmas = np.array([of_radar[c.radar].sigma(c.index, noise.sigma_m) for c in found])
        doubts_m = state.feature_doubts_m[[c.row for c in found]]
        by_state = rows.H @ state.P.block(rows.at)
        S = by_state @ rows.H.T + np.diag(np.square(sigmas) + np.square(doubts_m))
        nis = float(innovations_m @ np.linalg.solve(S, innovations_m))
        prior = np.vecdot(by_state, rows.H) + np.square(doubts_m)
        sigmas = huber_weighted_sigmas_m(innovations_m, prior, sigmas, noise.huber_sigmas)
        for (radar, at, landmark_id), range_m, sigma_m in zip(continued, z, sigmas, strict=True):
            x, y = antennas.position_m[radar].tolist()
            self._log.add_range(
                self._log.n_poses - 1,
                radar,
                landmark_id,
                antenna=(x, y),
                range_m=float(range_m),
                sigma_m=float(sigma_m),
                alone=of_radar[radar].is_alone(at),
            )
        variances = np.square(sigmas) + np.square(doubts_m)
        state.update(rows.at, rows.H, innovations_m, variances)
        return continued, nis

    def _raise_tracklets(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Make tracklets of what is left over; each updates a landmark or becomes one."""
        state, rule = self.state, self.parameters.tracklets
        newest = self._leftovers.newest()
        born: list[int] = []
        again: list[int] = []
        for side in self._sides:
            radars = self._alive(side)
            if not radars or not all(newest.unused[radar] for radar in radars):
                continue
            window = rule.window if len(radars) > 1 else rule.single_window
            frames = self._leftovers.slots(radars, window)
            noise = self.parameters.ranges
            guesses = guesses_of(frames[0], radars, noise, rule)
            if not guesses:
                continue
            lost = self._whereabouts.is_lost
            for wall in () if lost else self._walls.find(self._leftovers, radars):
                placed = self._walls.place(wall)
                if placed is not None:
                    self._use(placed[0], wall.members)
                    (born if placed[1] else again).append(placed[0])
            offsets = np.arange(state.offsets.start, state.offsets.stop)
            tracker = Tracker(noise, rule, state.offsets_m, state.P.block(offsets))
            n_radars = min(len(radars), 2)
            is_point = self._walls.is_point if n_radars > 1 else None
            for tracklet in find_tracklets(
                tracker, guesses, frames, n_radars, rule, is_point=is_point
            ):
                landmark_id, is_new = self._place(tracklet)
                (born if is_new else again).append(landmark_id)
        return tuple(born), tuple(again)

    def _alive(self, side: Sequence[int]) -> list[int]:
        """Return the radars of a side that may make tracklets: those heard lately."""
        limit = self.parameters.tracklets.partner_silence
        return [radar for radar in side if self._silent[radar] <= limit]

    def _place(self, tracklet: Tracklet) -> tuple[int, bool]:
        """Bring a tracklet into the map; return the landmark's id and whether it is new."""
        state = self.state
        point = tracklet.body_point()
        if tracklet.label is not None:
            known = self._landmark_of_label.get(tracklet.label)
            row = None if known is None else state.landmark_ids.index(known)
        else:
            row = match(state, point, self.parameters.map, self._whereabouts.elsewhere)
        if row is None:
            landmark_id = give_birth(state, point)
            if tracklet.label is not None:
                self._landmark_of_label[tracklet.label] = landmark_id
        else:
            landmark_id = state.landmark_ids[row]
            update_with_point(state, row, point)
        self._use(landmark_id, tracklet.members)
        return landmark_id, row is None

    def _use(self, landmark_id: int, members: Sequence[Member]) -> None:
        """Count and log the ranges of a tracklet as those of a landmark or a wall."""
        self._existence.hit(landmark_id, len({m.slot.back for m in members}))
        for member in members:
            slot = member.slot
            self._log.add_range(
                self._leftovers.pose_index(slot.back),
                slot.radar,
                landmark_id,
                antenna=slot.antenna_then,
                range_m=member.leftover.range_m,
                sigma_m=member.leftover.sigma_m,
                alone=member.leftover.alone,
            )

    def _delete_lost(self) -> tuple[int, ...]:
        if self._whereabouts.is_suspicious:
            return ()
        lost = self._existence.lost()
        for landmark_id in lost:
            self._walls.cells.forget(landmark_id)
            forget(landmark_id, self.state, self._existence, self._log)
        if lost:
            kept = self._landmark_of_label.items()
            self._landmark_of_label = {label: id_ for label, id_ in kept if id_ not in lost}
        return tuple(lost)

    def _merge(self) -> tuple[tuple[int, int], ...]:
        rule = self.parameters.map
        if self._landmark_of_label or self._n_updates % rule.merge_every:
            return ()
        whereabouts = self._whereabouts
        if whereabouts.is_lost and (
            joined := whereabouts.find(self.state, self._existence, self._log)
        ):
            self.relinearise()
            return joined
        return merge_landmarks(self.state, self._existence, self._log, rule, whereabouts.elsewhere)

"""The log of one run, and the problem of solving for all of it.

Every step and every detection of the run is kept. The problem is stated in *keyframes*, every few
centimetres or degrees: ranges from the poses between two of them are referred to the nearer one,
through odometry as the calibration corrects it. With steps (d_i, a_i) and headings h_i within a
segment of several steps, and e_i = Rot(h_i) d_i, odometry measures the segment's end in the frame
of its begin as

    rel = (sum e_i, sum a_i),   noise A_i = [Rot(h_i), J (end - q_i); 0, 1] of step i,

q_i the place after the step: a step's turn moves what comes after it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from slam.config import WheelNoise
from slam.geometry import between, compose, wrap_angle, wrap_angles
from slam.robust.initialisation import PointDetection, median_radius
from slam.robust.map import SURE, MapPrior, fixed_values
from slam.robust.parameters import BackEndParameters, RelinearisationRule
from slam.robust.solver.growing_arrays import PackedRows
from slam.robust.state import HEAD_SIZE, Array, Indices, Layout, Motion, State, quarter_turn

# Standard deviations of calibration and offsets below this are taken as this, so that information
# stays finite.
_LEAST_SIGMA = 1e-7
_LEAST_WAY_M = 1e-9
# Of a feature's place [m], and of a wall's direction [rad]
_ANYWHERE_M = 30.0
_OF_NOTHING = -1  # in place of a landmark's id


def _no_unknowns() -> Indices:
    return np.zeros(0, dtype=np.intp)


def _no_radii() -> Array:
    return np.zeros(0)


def _no_information() -> Array:
    return np.zeros((0, 0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Estimate:
    """Values of all unknowns."""

    poses: Array  # shape (k + 1, 3): x, y, heading of the keyframes
    calibration: Array  # shape (k + 1, 3) if it walks, else (1, 3): s, w, kappa
    fixed: Array  # shape (q,): offsets, mounts, landmarks and walls, in the order of the layout


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Problem:
    """All that was measured."""

    layout: Layout
    # shape (6 + q,): prior of first pose, its calibration, and what is fixed
    prior_mean: Array
    prior_sigmas: Array
    # shapes (n, 3) and (n, 3, 3): reported steps from pose to pose, and their noise
    steps: Array
    step_covariances: Array
    walks: Array  # shape (n, 3): variance each calibration error gains; all zero: constants
    keys: Indices  # shape (k + 1,): which poses are keyframes, the first and the last among them
    # shape (m,) each: which keyframe, radar and feature a range belongs to
    range_poses: Indices
    range_radars: Indices
    range_landmarks: Indices
    # shapes (m, 2) and (m,): antenna in the body frame of the keyframe, its mount being where the
    # rig has it, and the turn of the robot from the keyframe to the sample
    range_antennas: Array
    range_turns: Array
    ranges_m: Array
    range_sigmas_m: Array  # shape (m,), noise of single ranges
    # shape (m,) each, NaN for a range without one: bearing in the body frame of the sample, and its
    # noise
    range_bearings_rad: Array
    range_bearing_sigmas_rad: Array
    huber_sigmas: float = math.inf  # residuals beyond it weigh less
    # see `RangeErrors`
    variance_share: float = 1.0
    # The unknowns (k,) whose prior is that of a map, and their information; these have no sigmas
    known_at: Indices = field(default_factory=_no_unknowns)
    known_information: Array = field(default_factory=_no_information)
    # Radii of the landmarks as wavefronts show them, and their noise, inf of those not seen: (n,)
    # each, or none
    radii_m: Array = field(default_factory=_no_radii)
    radius_sigmas_m: Array = field(default_factory=_no_radii)

    @property
    def is_walking(self) -> bool:
        return bool(np.any(self.walks > 0.0))

    @property
    def with_bearing(self) -> Indices:
        """Return which ranges have a bearing."""
        return np.flatnonzero(~np.isnan(self.range_bearings_rad))


def prior_sigmas(layout: Layout, parameters: BackEndParameters) -> Array:
    """Return the prior's standard deviations of a run that starts at the origin of its own map.

    Features have next to no prior, so that one all of whose ranges are left out is unknown only.
    """
    noise = parameters.ranges
    calibration = np.maximum(parameters.wheels.calibration_sigmas, _LEAST_SIGMA)
    sigmas = np.full(layout.size, _ANYWHERE_M)
    sigmas[:3], sigmas[3:HEAD_SIZE] = SURE, calibration
    sigmas[layout.offsets] = max(noise.offset_sigma_m, _LEAST_SIGMA)
    sigmas[layout.mounts] = noise.mount_sigma_m
    if layout.has_radii:
        sigmas[layout.radii] = noise.radius_sigma_m
    return sigmas


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Chain:
    """Odometry within segments: steps d_i, a_i with calibration applied, h_i, and where it is."""

    first: Indices  # shape (k,): first step of each segment
    segment: Indices  # shape (n,): of each step
    # shapes (n, 2), (n,), (n,), (n,), (n, 2): e_i, a_i, D_i, h_i, and q_i
    moved: Array
    turns: Array
    lengths: Array
    headings: Array
    after: Array

    @property
    def ends(self) -> Array:
        """Return the motions of all segments, shape (k, 3)."""
        return np.column_stack(
            [np.add.reduceat(self.moved, self.first), np.add.reduceat(self.turns, self.first)]
        )


def chain_of(steps: Array, keys: Indices, calibration: Array) -> Chain:
    """Return odometry within segments; ``calibration`` (1, 3), or (k, 3) for each segment."""
    first = keys[:-1]
    segment = np.repeat(np.arange(len(first)), np.diff(keys))
    s, w, kappa = (calibration if len(calibration) == 1 else calibration[segment]).T
    d = steps[:, :2] / (1.0 + s)[:, None]
    lengths = np.hypot(d[:, 0], d[:, 1])
    turns = (steps[:, 2] - kappa * lengths) / (1.0 + w)
    headings = _before(turns, first, segment)
    moved = turned(d, headings)
    after = _before(moved, first, segment) + moved
    return Chain(
        first=first,
        segment=segment,
        moved=moved,
        turns=turns,
        lengths=lengths,
        headings=headings,
        after=after,
    )


def turned(points: Array, angles_rad: Array) -> Array:
    """Return points (k, 2), each turned by its own angle."""
    c, s = np.cos(angles_rad), np.sin(angles_rad)
    x, y = points.T
    return np.column_stack([c * x - s * y, s * x + c * y])


def _before(values: Array, first: Indices, segment: Indices) -> Array:
    """Return the sums of what comes before each row in its segment."""
    total = np.cumsum(values, axis=0) - values
    return np.asarray(total - total[first][segment])


def motions_by_calibration(chain: Chain, calibration: Array) -> Array:
    """Return d(motion of each segment) / d(s, w, kappa), shape (k, 3, 3)."""
    s, w, kappa = (calibration if len(calibration) == 1 else calibration[chain.segment]).T
    by = np.column_stack(
        [
            kappa * chain.lengths / ((1.0 + s) * (1.0 + w)),
            -chain.turns / (1.0 + w),
            -chain.lengths / (1.0 + w),
        ]
    )
    turned = (
        quarter_turn(chain.moved)[:, :, None] * _before(by, chain.first, chain.segment)[:, None]
    )
    turned[:, :, 0] -= chain.moved / (1.0 + s)[:, None]
    rows = np.concatenate([turned, by[:, None, :]], axis=1)
    return np.asarray(np.add.reduceat(rows, chain.first))


def motion_covariances(chain: Chain, step_covariances: Array) -> Array:
    """Return the noise of each segment's motion, shape (k, 3, 3)."""
    n = len(chain.turns)
    A = np.zeros((n, 3, 3))
    A[:, 0, 0] = A[:, 1, 1] = np.cos(chain.headings)
    A[:, 1, 0] = np.sin(chain.headings)
    A[:, 0, 1] = -A[:, 1, 0]
    ends = np.add.reduceat(chain.moved, chain.first)
    A[:, :2, 2] = quarter_turn(ends[chain.segment] - chain.after)
    A[:, 2, 2] = 1.0
    return np.asarray(np.add.reduceat(A @ step_covariances @ A.transpose(0, 2, 1), chain.first))


class RunLog:
    """Steps and used detections of a whole run, with the trajectory last solved for.

    ``prior`` is what is known of a map; without it the run starts at the origin of its own.

    Landmarks are named by id; merges rename, deletions drop what belonged to the landmark. One that
    has not been seen for more than ``gap_poses`` is in another passage when it is seen again.
    """

    def __init__(self, wheels: WheelNoise, gap_poses: int, prior: MapPrior | None = None) -> None:
        self._wheels, self._gap_poses, self.prior = wheels, gap_poses, prior
        start = np.zeros(3) if prior is None else prior.pose
        self._steps = PackedRows(np.dtype(np.float64), 3)
        self._covariances = PackedRows(np.dtype(np.float64), 3, 3)
        self._walks = PackedRows(np.dtype(np.float64))
        self._is_key = PackedRows(np.dtype(np.bool_))  # poses that must be keyframes
        self._is_key.append(True)
        self._causal = PackedRows(np.dtype(np.float64), 3)
        self._causal.append(start)
        whose = [("pose", np.int32), ("landmark", np.int32)]
        where = [("radar", np.int16), ("antenna", np.float64, 2), ("turn_rad", np.float32)]
        measured = [("range_m", np.float64), ("sigma_m", np.float32)]
        bearing = [("bearing_rad", np.float64), ("bearing_sigma_rad", np.float32)]
        radius = [("radius_m", np.float32), ("radius_sigma_m", np.float32)]
        self._ranges = PackedRows(np.dtype([*whose, *where, *measured, *bearing, *radius]))
        self._names: dict[int, int | None] = {}
        self._last_seen: dict[int, int] = {}  # by landmark, the newest pose that has a range of it
        self.since_solved = 0
        """How many steps ago the trajectory was last solved for, or that was tried."""
        self._stored_pose: Array = start

    @property
    def n_poses(self) -> int:
        return len(self._causal)

    @property
    def start(self) -> Array:
        """Return the first pose, (3,), as last solved for."""
        return np.array(self._causal.rows[0])

    def add_motion(self, increment: Array, motion: Motion, *, is_loose: bool = False) -> None:
        """Append a step as reported; ``motion`` is the step as the calibration corrects it.

        No range is referred to a keyframe through a loose step: its noise is not the wheels'.
        """
        if is_loose:
            self.mark_key()
        self._is_key.append(is_loose)
        self._steps.append(increment)
        self._covariances.append(motion.covariance)
        self._walks.append(motion.walk_variance)
        x, y, heading = self._stored_pose.tolist()
        c, s = math.cos(heading), math.sin(heading)
        dx, dy = motion.step_m.tolist()
        self._stored_pose = np.array(
            [x + c * dx - s * dy, y + s * dx + c * dy, wrap_angle(heading + motion.turn_rad)]
        )
        self._causal.append(self._stored_pose)
        self.since_solved += 1

    def heading_at(self, pose: int) -> float:
        """Return the heading [rad] of a pose as it was reported, or solved for since.

        Of the newest pose it is that of the wheels until `set_causal`.
        """
        return float(self._causal.rows[pose, 2])

    def set_causal(self, pose: Array) -> None:
        """Store the filter's newest pose, its measurements included."""
        self._causal.rows_to_write(self.n_poses - 1)[0] = pose

    def parted(self, pose: Array) -> tuple[float, float]:
        """Return how far [m], and by what angle [rad], a pose is from the stored trajectory."""
        away = pose - self._stored_pose
        return float(np.hypot(away[0], away[1])), abs(wrap_angle(float(away[2])))

    def add_range(
        self,
        pose: int,
        radar: int,
        landmark_id: int,
        *,
        antenna: tuple[float, float],
        range_m: float,
        sigma_m: float,
        turn_rad: float = 0.0,
        bearing_rad: float = math.nan,
        bearing_sigma_rad: float = math.nan,
        radius_m: float = 0.0,
        radius_sigma_m: float = math.inf,
    ) -> None:
        """Append a range used, with its bearing in the body frame of the sample if it has one.

        ``antenna`` is in the body frame of the pose, its mount being where the rig has it, and
        ``turn_rad`` the robot's from the pose to the sample.
        """
        self._last_seen[landmark_id] = max(pose, self._last_seen.get(landmark_id, pose))
        whose = (pose, landmark_id, radar)
        shape = bearing_rad, bearing_sigma_rad, radius_m, radius_sigma_m
        self._ranges.append((*whose, antenna, turn_rad, range_m, sigma_m, *shape))

    def add_detections(self, landmark_id: int, seen: Iterable[PointDetection]) -> None:
        for one in seen:
            self.add_range(
                one.pose,
                one.radar,
                landmark_id,
                antenna=one.nominal_m,
                turn_rad=one.turn_rad,
                range_m=one.range_m,
                sigma_m=one.sigma_m,
                bearing_rad=one.bearing_rad,
                bearing_sigma_rad=one.bearing_sigma_rad,
                radius_m=one.radius_m,
                radius_sigma_m=one.radius_sigma_m,
            )

    def add_unassigned(self, landmark_id: int, rows: NDArray[np.void]) -> None:
        """Append ranges that were of nothing known, in rows as `UnassignedRanges` has them."""
        for row in rows:
            x_m, y_m = row["nominal_m"].tolist()
            self.add_range(
                int(row["pose"]),
                int(row["radar"]),
                landmark_id,
                antenna=(x_m, y_m),
                turn_rad=float(row["turn_rad"]),
                range_m=float(row["range_m"]),
                sigma_m=float(row["sigma_m"]),
            )

    def is_new_passage(self, landmark_id: int) -> bool:
        """Return whether a range of a landmark now would begin a passage."""
        known = [name for name in self._all_names(landmark_id) if name in self._last_seen]
        newest = self.n_poses - 1
        return all(newest - self._last_seen[name] > self._gap_poses for name in known)

    def loosen(self, pose: int, covariance: Array) -> None:
        """Let the step that leads to a pose have so much more noise, (3, 3), from now on."""
        self._covariances.rows_to_write(pose - 1)[0] += covariance
        self._is_key.rows_to_write(pose - 1)[:2] = True

    def mark_key(self) -> None:
        """Let the newest pose be a keyframe."""
        self._is_key.rows_to_write(self.n_poses - 1)[0] = True

    def rename(self, gone: int, kept: int) -> None:
        self._names[gone] = kept

    def name_of(self, landmark_id: int) -> int | None:
        """Return the id of the landmark that one was merged into; None if it was dropped."""
        name: int | None = landmark_id
        while name is not None and name in self._names:
            name = self._names[name]
        return name

    def drop(self, landmark_id: int) -> None:
        """Leave out all of a landmark's measurements."""
        self._names[landmark_id] = None

    def leave_out(self, radar: int, landmarks: Collection[int], since: int) -> None:
        """Leave out single ranges that a radar took of landmarks from a pose on."""
        ranges = self._ranges.rows_to_write()
        named = [name for id_ in landmarks for name in self._all_names(id_)]
        bad = (ranges["radar"] == radar) & (ranges["pose"] >= since)
        bad &= np.isnan(ranges["bearing_rad"]) & np.isin(ranges["landmark"], named)
        ranges["landmark"][bad] = _OF_NOTHING

    def leave_out_since(self, pose: int, named: Collection[int]) -> None:
        """Leave out what was measured from a pose on of landmarks that were seen before it.

        Those with labels, ``named``, are known for certain.
        """
        ranges = self._ranges.rows_to_write()
        names = [name for id_ in named for name in self._all_names(id_)]
        since = ranges["pose"] >= pose
        bad = since & np.isin(ranges["landmark"], ranges["landmark"][~since])
        ranges["landmark"][bad & ~np.isin(ranges["landmark"], names)] = _OF_NOTHING

    def leave_out_rows(self, rows: Indices) -> None:
        """Leave out ranges by their rows, as `passages` has them."""
        self._ranges.rows_to_write()["landmark"][rows] = _OF_NOTHING

    def passages(
        self, state: State, same: Mapping[int, int] | None = None
    ) -> tuple[Indices, Indices]:
        """Return the row in the log of each range of `problem`, and its passage, shape (m,) each.

        Of one feature, ranges that are more than the gap apart are of two passages.
        """
        of_range = self._features_of_ranges(state, same)
        rows = np.flatnonzero(of_range >= 0)
        features, poses = of_range[rows], self._ranges.rows["pose"][rows]
        order = np.lexsort([poses, features])
        begins = np.diff(features[order], prepend=-1) != 0
        begins |= np.diff(poses[order], prepend=0) > self._gap_poses
        passages = np.empty(len(rows), dtype=np.intp)
        passages[order] = np.cumsum(begins) - 1
        return rows, passages

    def _features_of_ranges(self, state: State, same: Mapping[int, int] | None) -> Indices:
        """Return the row of each range's feature in the state, -1 of those that it has not."""
        rows = {id_: row for row, id_ in enumerate(state.feature_ids)}
        return _rows_of(self._ranges.rows["landmark"], self._names | dict(same or {}), rows)

    def seen_from(self, poses: Collection[int]) -> Counter[int]:
        """Return from how many of some poses each landmark was seen with a bearing, by its id."""
        ranges = self._ranges.rows
        first = np.isin(ranges["pose"], list(poses)) & ~np.isnan(ranges["bearing_rad"])
        found: set[tuple[int, int]] = set()
        for landmark, pose in zip(
            ranges["landmark"][first].tolist(), ranges["pose"][first].tolist(), strict=True
        ):
            name = self.name_of(landmark)
            if name not in (None, _OF_NOTHING):
                found.add((name, pose))
        return Counter(name for name, _ in found)

    def _all_names(self, landmark_id: int) -> set[int]:
        """Return the id of a landmark with those of all that were merged into it."""
        names = {landmark_id}
        while True:
            more = {gone for gone, kept in self._names.items() if kept in names} - names
            if not more:
                return names
            names |= more

    def poses_of(self, landmark_id: int) -> list[int]:
        """Return the poses from which a landmark was seen with a bearing."""
        ranges = self._ranges.rows
        names = self._all_names(landmark_id)
        mine = np.isin(ranges["landmark"], list(names)) & ~np.isnan(ranges["bearing_rad"])
        return sorted(set(ranges["pose"][mine].tolist()))

    def ranges_of(self, landmark_id: int) -> tuple[Array, Array, Array]:
        """Return ranges (k,) by the id they were added with, noise (k,) and antennas (k, 2).

        The antennas are on the trajectory last solved for, and that of the filter since, map frame.
        """
        ranges = self._ranges.rows[self._ranges.rows["landmark"] == landmark_id]
        poses = self._causal.rows[ranges["pose"]]
        antennas = poses[:, :2] + turned(ranges["antenna"], poses[:, 2])
        return ranges["range_m"].copy(), ranges["sigma_m"].astype(np.float64), antennas

    def _keys(self, rule: RelinearisationRule) -> Indices:
        """Return which poses are keyframes; as the run goes on, those that were remain."""
        steps = self._steps.rows
        way = np.hypot(steps[:, 0], steps[:, 1]) / rule.key_m + np.abs(steps[:, 2]) / rule.key_rad
        wanted = self._is_key.rows.copy()
        wanted[1:] |= np.diff(np.floor(np.cumsum(way)), prepend=0.0) > 0.0
        wanted[-1] = True
        return np.flatnonzero(wanted)

    def problem(
        self,
        state: State,
        parameters: BackEndParameters,
        same: Mapping[int, int] | None = None,
        without: Indices | None = None,
    ) -> Problem:
        """Return all measurements of the landmarks the state has now.

        ``same`` maps the id of a landmark to that of the one that it is taken for; ``without`` (k,)
        are rows of ranges, as `passages` has them, to be left out.
        """
        of_range = self._features_of_ranges(state, same)
        if without is not None:
            of_range[without] = -1
        ranges, of_range = self._ranges.rows[of_range >= 0], of_range[of_range >= 0]
        sigmas_m = ranges["sigma_m"].astype(np.float64)
        if state.added_sigmas_m:
            sigmas_m = np.hypot(sigmas_m, state.feature_added_sigmas_m[of_range])
        radii_m, radius_sigmas_m = _no_radii(), _no_radii()
        if state.layout.has_radii:
            radii_m, radius_sigmas_m = _shown_radii(ranges, of_range, len(state.landmark_ids))
        keys = self._keys(parameters.relinearisation)
        steps = self._steps.rows.copy()
        chain = chain_of(steps, keys, state.calibration[None, :])
        key, place, turn = _from_keyframes(chain, keys)
        pose = ranges["pose"]
        antennas = place[pose] + turned(ranges["antenna"], turn[pose])
        layout = replace(state.layout, n_past=0)  # past poses are keyframes
        prior_mean = np.zeros(layout.size)
        of_landmark = prior_mean[layout.landmarks].reshape(-1, layout.landmark_size)
        of_landmark[:, :2] = state.landmarks_m
        prior_mean[layout.walls] = state.walls.ravel()
        sigmas = prior_sigmas(layout, parameters)
        at, information = _no_unknowns(), _no_information()
        if self.prior is not None:
            prior_mean[:3], sigmas[:3] = self.prior.pose, self.prior.pose_sigmas
            at, prior_mean[at], information = self.prior.of(state)
            sigmas[at] = math.inf
        return Problem(
            known_at=at,
            known_information=information,
            layout=layout,
            prior_mean=prior_mean,
            prior_sigmas=sigmas,
            steps=steps,
            step_covariances=self._covariances.rows.copy(),
            walks=self._walks.rows[:, None] * np.square(self._wheels.calibration_sigmas),
            keys=keys,
            range_poses=key[pose],
            range_radars=ranges["radar"].astype(np.intp),
            range_landmarks=of_range,
            range_antennas=antennas,
            range_turns=turn[pose] + ranges["turn_rad"],
            ranges_m=ranges["range_m"].copy(),
            range_sigmas_m=sigmas_m,
            range_bearings_rad=ranges["bearing_rad"].copy(),
            range_bearing_sigmas_rad=ranges["bearing_sigma_rad"].astype(np.float64),
            radii_m=radii_m,
            radius_sigmas_m=radius_sigmas_m,
            huber_sigmas=parameters.ranges.huber_sigmas,
            variance_share=state.range_errors.variance_share,
        )

    def starts(self, state: State, problem: Problem) -> list[Estimate]:
        """Return values to start from.

        One chains all increments with the present calibration, which a closed loop has corrected
        for the whole run; the other keeps the filter's own past.
        """
        poses = self._causal.rows[problem.keys]
        whole = np.array([0, len(problem.steps)])
        chain = chain_of(problem.steps, whole, state.calibration[None, :])
        chained = np.vstack([np.zeros(3), np.column_stack([chain.after, np.cumsum(chain.turns)])])
        if self.prior is not None:  # the start is not known: it is the end that has been corrected
            first = compose(state.pose, between(chained[-1], np.zeros(3)))
            chained = np.array([compose(first, pose) for pose in chained])
        poses[-1] = state.pose
        causal = Estimate(
            poses=poses,
            calibration=np.broadcast_to(
                state.calibration, (len(poses) if problem.is_walking else 1, 3)
            ).copy(),
            fixed=fixed_values(state),
        )
        return [causal, replace(causal, poses=chained[problem.keys])]

    def solved(self, problem: Problem, estimate: Estimate) -> None:
        """Store the trajectory of a solution."""
        self._causal.rows_to_write()[:] = all_poses(problem, estimate)[0]
        self._stored_pose = estimate.poses[-1].copy()


def _shown_radii(ranges: NDArray[np.void], of_range: Indices, n: int) -> tuple[Array, Array]:
    """Return radii (n,) of landmarks as wavefronts show them, and their standard deviations."""
    radii_m, sigmas_m = np.zeros(n), np.full(n, math.inf)
    is_seen = np.isfinite(ranges["radius_sigma_m"])
    rows, seen = of_range[is_seen], ranges[["radius_m", "radius_sigma_m"]][is_seen]
    order = np.argsort(rows, kind="stable")
    of_landmark, begins = np.unique(rows[order], return_index=True)
    for row, mine in zip(of_landmark.tolist(), np.split(seen[order], begins[1:]), strict=False):
        radii_m[row], sigmas_m[row] = median_radius(mine["radius_m"], mine["radius_sigma_m"])
    return radii_m, sigmas_m


def _rows_of(
    ids: NDArray[np.int32], names: Mapping[int, int | None], rows: Mapping[int, int]
) -> Indices:
    """Return the present row of each id, shape (m,), -1 for landmarks that are gone."""
    present = np.flatnonzero(np.bincount(ids[ids != _OF_NOTHING]))
    final = np.full(int(present[-1]) + 2 if len(present) else 1, -1, dtype=np.intp)  # the last: -1
    for id_ in present.tolist():
        name: int | None = id_
        while name is not None and name in names:
            name = names[name]
        final[id_] = -1 if name is None else rows.get(name, -1)
    return final[ids]


def _from_keyframes(chain: Chain, keys: Indices) -> tuple[Indices, Array, Array]:
    """Return for each of n + 1 poses its keyframe, and place (n + 1, 2) and turn in its frame."""
    ends, n = chain.ends, len(chain.turns)
    way = _way(chain)
    whole = way[keys[1:] - 1][chain.segment]
    from_end = 2.0 * way > whole
    key, place, turn = np.zeros(n + 1, dtype=np.intp), np.zeros((n + 1, 2)), np.zeros(n + 1)
    key[1:] = chain.segment + from_end
    heading = chain.headings + chain.turns
    end = ends[chain.segment]
    back = turned(chain.after - end[:, :2], -end[:, 2])
    place[1:] = np.where(from_end[:, None], back, chain.after)
    turn[1:] = np.where(from_end, heading - end[:, 2], heading)
    return key, place, turn


def all_poses(
    problem: Problem, estimate: Estimate, covariances: Array | None = None
) -> tuple[Array, Array]:
    """Return the poses between the keyframes, too, (n + 1, 3), and covariances if those are given.

    Odometry leads from one keyframe to the next; what it misses is spread along the way.
    """
    calibration = estimate.calibration
    chain = chain_of(problem.steps, problem.keys, calibration[: len(problem.keys) - 1])
    begin, end, at = estimate.poses[:-1], estimate.poses[1:], chain.segment
    gone = end - begin
    missed = np.column_stack([turned(gone[:, :2], -begin[:, 2]), gone[:, 2]]) - chain.ends
    missed[:, 2] = wrap_angles(missed[:, 2])
    way = _way(chain)
    share = way / np.maximum(way[problem.keys[1:] - 1][at], _LEAST_WAY_M)
    within = np.column_stack([chain.after, chain.headings + chain.turns])
    within += share[:, None] * missed[at]
    poses = np.empty((len(problem.steps) + 1, 3))
    c, s = np.cos(begin[:, 2]), np.sin(begin[:, 2])
    poses[1:, 0] = begin[at, 0] + c[at] * within[:, 0] - s[at] * within[:, 1]
    poses[1:, 1] = begin[at, 1] + s[at] * within[:, 0] + c[at] * within[:, 1]
    poses[1:, 2] = wrap_angles(begin[at, 2] + within[:, 2])
    poses[problem.keys] = estimate.poses
    poses[problem.keys, 2] = wrap_angles(estimate.poses[:, 2])
    if covariances is None:
        return poses, np.zeros((0, 3, 3))
    of_poses = np.empty((len(poses), 3, 3))
    share = share[:, None, None]
    of_poses[1:] = (1.0 - share) * covariances[:-1][at] + share * covariances[1:][at]
    of_poses[problem.keys] = covariances
    return poses, of_poses


def _way(chain: Chain) -> Array:
    """Return way and turn since the begin of the segment, one number after each step."""
    gone = chain.lengths + np.abs(chain.turns)
    return _before(gone, chain.first, chain.segment) + gone

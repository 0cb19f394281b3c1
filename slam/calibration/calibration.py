"""Range offsets and mounts of a rig from one drive past reflectors.

Batch maximum a posteriori over all poses, landmarks, wheel constants, range offsets and mount
positions, from odometry steps and single ranges z = |l - p - R m| + b (`slam.calibration.batch`).
Association: single ranges are followed and placed radar by radar (`slam.calibration.tracks`), then
predicted ranges choose, with gates that narrow as the offsets become known, under a robust cost;
the last round is least squares on the ranges that are left.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from slam.calibration.batch import (
    CAUCHY_SCALE,
    BatchSolution,
    OdometryTerm,
    PriorTerm,
    RangeTerm,
    StateLayout,
    Stop,
    Term,
    minimise,
    steps_of,
)
from slam.calibration.tracks import (
    UNASSIGNED,
    PathNodes,
    RangeSet,
    Track,
    assign,
    covisible,
    follow_all,
    group_tracks,
    place,
    radar_poses,
    strengths,
    well_seen,
)
from slam.config import WheelNoise
from slam.geometry import Rig, between

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

# Samples closer than this are joined into one step.
_LEAST_STEP_NS = 100_000_000
_STAGE_NS = 40_000_000_000
_ROUGH = Stop(relative_decrease=1e-5, most_iterations=25)
_GATES_M = (0.03, 0.012)
_GATE_SIGMAS = 4.0
_LEAST_GATE_M = 1e-3
_LEAST_RANGES = 20
_ASSUMED_SIGMA_M = 5e-3
_LEAST_SIGMA_M = 1e-4
_ROUNDS_AT_LAST_GATE = 3
# Two landmarks are one if they are this close, given how well their distance is known (99.9 %).
_MERGE_CHI2 = 13.8
_MERGE_WITHIN_M = 0.3
_MERGE_FLOOR_M = 0.03
_MERGE_VETO_FRAMES = 10
_MAP_ORIGIN_SIGMA = 1e-6
# Bounds a landmark that the drive leaves open along an arc.
_SOMEWHERE_M = 30.0
# The lab's white noise; constants wide enough for a bad floor.
UNKNOWN_WHEELS = WheelNoise(
    scale_sigma=0.03, turn_scale_sigma=0.03, curvature_sigma_rad_per_m=0.02, floor_rad=1e-5
)


@dataclass(frozen=True, slots=True, kw_only=True)
class CalibrationPriors:
    """Standard deviations before the drive."""

    offset_m: float = 0.03  # range offset of a module
    mount_m: float = 0.003  # mount position in x and in y: how well the rig was measured
    reflector_m: float = 0.001  # survey of known reflectors
    # Start pose among known reflectors; without any, the start is the origin of the map
    start_m: float = 0.1
    start_rad: float = 0.1
    wheels: WheelNoise = UNKNOWN_WHEELS  # constants and white noise of the wheels


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drive:
    """A recorded drive, ready for calibration."""

    rig: Rig  # nominal mounts; their range offsets are not removed from the ranges
    path: PathNodes  # odometry frame
    # Shape (n_nodes - 1, 3), standard deviation of each step's white noise in the body frame: along
    # [m], across [m], turn [rad]
    step_sigmas: Array
    ranges: RangeSet  # all single ranges


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibration:
    """The result of a calibration."""

    # Shapes (r,) and (r, 2): offset of each radar, and how far its mount is from nominal, x and y,
    # body frame
    offsets_m: Array
    mount_shifts_m: Array
    covariance_m2: Array  # shape (3 r, 3 r), [m2]: for each radar its offset, mount x, mount y
    # Shape (k, 2), map frame: the body frame at the start, or the frame of known reflectors
    landmarks_m: Array
    path: PathNodes  # the most likely path, map frame
    wheels: Array  # shape (3,): scale, turn scale, curvature [rad/m]
    landmark: Indices  # shape (n_ranges,): the landmark each range was used for, or UNASSIGNED
    sigma_m: float  # standard deviation of a used range, as found

    @property
    def offset_sigmas_m(self) -> Array:
        return np.asarray(np.sqrt(np.diag(self.covariance_m2)[0::3]))

    @property
    def mount_sigmas_m(self) -> Array:
        return np.asarray(np.sqrt(np.diag(self.covariance_m2).reshape(-1, 3)[:, 1:]))


def make_drive(
    rig: Rig,
    stamps_ns: NDArray[np.int64],
    poses: Array,
    ranges: RangeSet,
) -> Drive:
    """Cut odometry into steps for the batch.

    ``poses`` (n, 3) are odometry samples, x [m], y [m], heading [rad] in any turn, odometry frame.
    """
    poses = poses.copy()
    poses[:, 2] = np.unwrap(poses[:, 2])
    sigmas = UNKNOWN_WHEELS.step_sigmas(steps_of(poses))
    variances = np.vstack([np.zeros(3), sigmas**2]).cumsum(axis=0)
    chosen = [0]
    for index in range(1, len(stamps_ns)):
        if stamps_ns[index] - stamps_ns[chosen[-1]] >= _LEAST_STEP_NS:
            chosen.append(index)
    if len(chosen) > 1 and chosen[-1] != len(stamps_ns) - 1:
        chosen[-1] = len(stamps_ns) - 1
    return Drive(
        rig=rig,
        path=PathNodes(t_ns=stamps_ns[chosen], poses=poses[chosen]),
        step_sigmas=np.sqrt(np.diff(variances[chosen], axis=0)),
        ranges=ranges,
    )


def calibrate(
    drive: Drive, priors: CalibrationPriors | None = None, known_m: Array | None = None
) -> Calibration:
    """Estimate offsets and mounts; those that the drive does not determine stay at their priors.

    ``known_m`` (k, 2) are places of known reflectors, in a frame in which the robot starts near the
    origin and looks along x.
    """
    known = np.zeros((0, 2)) if known_m is None else known_m
    return _Estimator(drive, priors or CalibrationPriors(), known).run()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Unknowns:
    """The unknowns, unpacked."""

    poses: Array
    landmarks: Array
    wheels: Array
    radars: Array

    def state(self) -> Array:
        parts = (self.poses, self.landmarks, self.wheels, self.radars)
        return np.concatenate([part.ravel() for part in parts])


class _Estimator:
    """One calibration: the drive, the priors, and the rounds of associating and solving."""

    def __init__(self, drive: Drive, priors: CalibrationPriors, known_m: Array) -> None:
        self._drive, self._priors, self._known_m = drive, priors, known_m
        self._mounts = np.array([(m.x_m, m.y_m) for m in drive.rig.mounts])
        reported = drive.ranges.sigma_m
        self._reported_sigma_m = np.where(np.isnan(reported), _ASSUMED_SIGMA_M, reported)
        self._sigma_scale = 1.0
        self._bend_m = np.zeros(len(drive.ranges))

    def run(self) -> Calibration:
        ranges = self._drive.ranges
        model, landmark = self._growing()
        for gate_m in _GATES_M:
            landmark = self._assign(model, landmark, np.full(len(ranges), gate_m))
            model, landmark = self._solved_and_merged(*self._without_poor(model, landmark))
        for _ in range(_ROUNDS_AT_LAST_GATE):
            gates = np.clip(_GATE_SIGMAS * self._sigmas(), _LEAST_GATE_M, _GATES_M[-1])
            landmark = self._assign(model, landmark, gates)
            model, landmark = self._without_poor(model, landmark)
            model, solution = self._solve(model, landmark, None, Stop())
        return self._result(model, landmark, solution)

    def _growing(self) -> tuple[_Unknowns, Indices]:
        """Take in followed echoes in the order of time.

        The wheels' constants are known after the first of them: later echoes are placed from a path
        that has not drifted far.
        """
        ranges, path = self._drive.ranges, _at_origin(self._drive.path)
        model = _Unknowns(
            poses=path.poses,
            landmarks=self._known_m,
            wheels=np.zeros(3),
            radars=np.column_stack([np.zeros(len(self._mounts)), self._mounts]),
        )
        landmark = np.full(len(ranges), UNASSIGNED, dtype=np.intp)
        followed = follow_all(ranges)
        if not followed:
            return model, landmark
        ends_ns = np.array([ranges.t_ns[rows[-1]] for _, rows in followed])
        until_ns = int(ranges.t_ns[0])
        while until_ns < int(ends_ns.max()):
            until_ns += _STAGE_NS
            past = [
                each for each, end_ns in zip(followed, ends_ns, strict=True) if end_ns < until_ns
            ]
            tracks = self._tracks(model, past)
            landmarks, landmark = group_tracks(tracks, ranges, self._known_m)
            model = replace(model, landmarks=landmarks)
            model, landmark = self._solved_and_merged(*self._without_poor(model, landmark))
        return model, landmark

    def _tracks(
        self, model: _Unknowns, followed: Sequence[tuple[int, Indices]]
    ) -> tuple[Track, ...]:
        sights, range_m = self._sights(model), self._drive.ranges.range_m
        tracks = []
        for radar, rows in followed:
            placed = place(sights[rows], range_m[rows] - model.radars[radar, 0])
            if placed is not None:
                tracks.append(
                    Track(radar=radar, rows=rows, point_m=placed[0], covariance_m2=placed[1])
                )
        return tuple(tracks)

    def _sigmas(self) -> Array:
        own = np.maximum(self._sigma_scale * self._reported_sigma_m, _LEAST_SIGMA_M)
        return np.hypot(own, self._bend_m)

    def _sights(self, model: _Unknowns) -> Array:
        """Return antenna position and boresight at each range, (n_ranges, 3), map frame."""
        ranges = self._drive.ranges
        path = PathNodes(t_ns=self._drive.path.t_ns, poses=model.poses)
        yaws = np.array([mount.yaw_rad for mount in self._drive.rig.mounts])
        mounts = np.column_stack([model.radars[:, 1:], yaws])
        return radar_poses(path, mounts[ranges.radar], ranges.t_ns)

    def _assign(self, model: _Unknowns, landmark: Indices, gates_m: Array) -> Indices:
        ranges, sights = self._drive.ranges, self._sights(model)
        strength = strengths(ranges, sights, model.landmarks, landmark)
        offsets_m = model.radars[ranges.radar, 0]
        landmark, self._bend_m = assign(
            ranges, sights, offsets_m, model.landmarks, gate_m=gates_m, strengths=strength
        )
        return landmark

    def _without_poor(self, model: _Unknowns, landmark: Indices) -> tuple[_Unknowns, Indices]:
        """Drop landmarks that too few ranges see; known ones stay, as first."""
        n = len(model.landmarks)
        kept = well_seen(self._drive.ranges, landmark, n) | (np.arange(n) < len(self._known_m))
        renumbered = np.where(kept, np.cumsum(kept) - 1, UNASSIGNED)
        moved = np.full_like(landmark, UNASSIGNED)
        used = landmark != UNASSIGNED
        moved[used] = renumbered[landmark[used]]
        return replace(model, landmarks=model.landmarks[kept]), moved

    def _solved_and_merged(self, model: _Unknowns, landmark: Indices) -> tuple[_Unknowns, Indices]:
        while True:
            model, solution = self._solve(model, landmark, CAUCHY_SCALE, _ROUGH)
            pair = self._same_landmark(model, landmark, solution)
            if pair is None:
                return model, landmark
            keep, drop = pair
            landmark = np.where(landmark == drop, keep, landmark)
            landmark = np.where(landmark > drop, landmark - 1, landmark)
            model = replace(model, landmarks=np.delete(model.landmarks, drop, axis=0))

    def _same_landmark(
        self, model: _Unknowns, landmark: Indices, solution: BatchSolution
    ) -> tuple[int, int] | None:
        """Return the two landmarks most clearly the same, the one to keep first."""
        near = [
            (keep, drop)
            for keep, drop in combinations(range(len(model.landmarks)), 2)
            if drop >= len(self._known_m)
            and math.dist(model.landmarks[keep], model.landmarks[drop]) <= _MERGE_WITHIN_M
            and covisible(self._drive.ranges, landmark, keep, drop) <= _MERGE_VETO_FRAMES
        ]
        if not near:
            return None
        columns = self._layout(model).landmarks
        joint = solution.covariance(np.arange(columns.start, columns.stop))
        best, found = _MERGE_CHI2, None
        for keep, drop in near:
            difference = model.landmarks[keep] - model.landmarks[drop]
            to_difference = np.zeros((2, len(joint)))
            to_difference[:, 2 * keep : 2 * keep + 2] = np.eye(2)
            to_difference[:, 2 * drop : 2 * drop + 2] = -np.eye(2)
            spread = to_difference @ joint @ to_difference.T + _MERGE_FLOOR_M**2 * np.eye(2)
            chi2 = float(difference @ np.linalg.solve(spread, difference))
            if chi2 < best:
                best, found = chi2, (keep, drop)
        return found

    def _layout(self, model: _Unknowns) -> StateLayout:
        return StateLayout(
            n_poses=len(model.poses),
            n_landmarks=len(model.landmarks),
            n_radars=len(model.radars),
        )

    def _solve(
        self, model: _Unknowns, landmark: Indices, cauchy_scale: float | None, stop: Stop
    ) -> tuple[_Unknowns, BatchSolution]:
        layout = self._layout(model)
        term = self._range_term(layout, landmark, cauchy_scale)
        solution = minimise(model.state(), [*self._fixed_terms(layout), term], stop)
        state = solution.state
        self._learn_sigma(np.abs(term.residuals(state)) * term.sigma_m, landmark != UNASSIGNED)
        solved = _Unknowns(
            poses=state[layout.poses].reshape(-1, 3),
            landmarks=state[layout.landmarks].reshape(-1, 2),
            wheels=state[layout.wheels],
            radars=state[layout.radars].reshape(-1, 3),
        )
        return solved, solution

    def _learn_sigma(self, errors_m: Array, used: NDArray[np.bool_]) -> None:
        """Scale the front end's sigmas to what its ranges show, where nothing overlaps."""
        reported, bend = self._reported_sigma_m[used], self._bend_m[used]
        clean = bend < reported * self._sigma_scale / 3
        if np.count_nonzero(clean) > _LEAST_RANGES:
            # the median of |N(0, 1)| is 0.6745
            self._sigma_scale = float(np.median(errors_m[clean] / reported[clean])) / 0.6745

    def _range_term(
        self, layout: StateLayout, landmark: Indices, cauchy_scale: float | None
    ) -> RangeTerm:
        rows = np.flatnonzero(landmark != UNASSIGNED)
        ranges = self._drive.ranges
        pose, fraction = self._drive.path.between(ranges.t_ns[rows])
        return RangeTerm(
            layout=layout,
            pose=pose,
            fraction=fraction,
            landmark=landmark[rows],
            radar=ranges.radar[rows],
            range_m=ranges.range_m[rows],
            sigma_m=self._sigmas()[rows],
            cauchy_scale=cauchy_scale,
        )

    def _fixed_terms(self, layout: StateLayout) -> Sequence[Term]:
        priors, known = self._priors, self._known_m
        if len(known):
            start = [priors.start_m, priors.start_m, priors.start_rad]
        else:
            start = [_MAP_ORIGIN_SIGMA] * 3
        n_radars = layout.n_radars
        radar_means = np.column_stack([np.zeros(n_radars), self._mounts]).ravel()
        radar_sigmas = np.tile([priors.offset_m, priors.mount_m, priors.mount_m], n_radars)
        first = layout.landmarks.start
        indices = np.concatenate([np.arange(3), np.arange(first, layout.size)]).astype(np.intp)
        found = np.zeros(2 * layout.n_landmarks - known.size)
        return (
            OdometryTerm(
                layout=layout,
                steps=steps_of(self._drive.path.poses),
                sigmas=self._drive.step_sigmas,
            ),
            PriorTerm(
                indices=indices,
                means=np.concatenate([np.zeros(3), known.ravel(), found, np.zeros(3), radar_means]),
                sigmas=np.concatenate(
                    [
                        start,
                        np.full(known.size, priors.reflector_m),
                        found + _SOMEWHERE_M,
                        priors.wheels.calibration_sigmas,
                        radar_sigmas,
                    ]
                ),
            ),
        )

    def _result(self, model: _Unknowns, landmark: Indices, solution: BatchSolution) -> Calibration:
        layout = self._layout(model)
        term = self._range_term(layout, landmark, None)
        used = term.residuals(solution.state) * term.sigma_m
        return Calibration(
            offsets_m=model.radars[:, 0],
            mount_shifts_m=model.radars[:, 1:] - self._mounts,
            covariance_m2=solution.covariance(np.arange(layout.radars.start, layout.size)),
            landmarks_m=model.landmarks,
            path=PathNodes(t_ns=self._drive.path.t_ns, poses=model.poses),
            wheels=model.wheels,
            landmark=landmark,
            sigma_m=float(np.sqrt(np.mean(used**2))) if len(used) else math.nan,
        )


def _at_origin(path: PathNodes) -> PathNodes:
    """Return the path moved so that it starts at the origin and looks along x."""
    start = path.poses[0]
    moved = np.array([between(start, pose) for pose in path.poses])
    moved[:, 2] = path.poses[:, 2] - start[2]  # continuous, as it was
    return PathNodes(t_ns=path.t_ns, poses=moved)

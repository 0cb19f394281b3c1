"""The known-association bound of one run: what is possible with the true ids, on the same data.

Each range goes to the true landmark that it fits: nearest in range, in front of the antenna, no
landmark twice in a frame, and within ``GATE_SIGMAS`` standard deviations of the true range. What
fits none is clutter to the bound. Nothing else of the truth gets in.

GTSAM solves for poses, landmarks, the wheels' calibration errors (s, w, kappa) and, where they
are unknown, the radars' range offsets, with the noise model of ``slam.robust``. ISAM2 takes one
step at a time and relinearises as it goes: the last pose after each step is the filtered path,
causal as a filter's. Levenberg-Marquardt over everything is the full smoother.

The residual of odometry between poses 0 and 1, with d = (ux, uy) / (1 + s), D = |d| and
a = (ua - kappa D) / (1 + w), is::

    r = [R0^T (p1 - p0) - d, theta1 - theta0 - a]

Derivatives are by body-frame changes of the poses (GTSAM's) and by (s, w, kappa). Plain floats:
the function runs once per step and linearisation, and arrays of three cost more than they do.

What the bound is: the best that this noise model gives on these ranges, up to ISAM2's thresholds.
A single run can be luckier: a filter with fewer ranges may end nearer to the truth.
Calibration errors that wander are one set per ``WALK_STEPS`` steps.
Source: Kaess et al., iSAM2, IJRR 31(2), 2012; GTSAM is BSD-licensed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, linear_sum_assignment

from emulator.scene.scene import Scene
from slam.app.rig.emulated import rig_of, true_landmarks_m, wheels_of
from slam.app.run.runner import RunRecord, States
from slam.app.run.summary import nees_at_ten_times
from slam.config import BackEnd, SlamConfig, WheelNoise
from slam.frames import Detection
from slam.geometry import Mount, Rig, between, mount_at, pair_of, transform, wrap_angle, wrap_angles
from slam.library.evaluation import ate_rmse_m
from slam.live.session_records import SessionObserver, Snapshot
from slam.robust.association import LONGEST_M, crossings
from slam.robust.state import calibrated_motion, quarter_turn, rotation, turned_covariance

Array = NDArray[np.float64]
Pose = tuple[float, float, float]

GATE_SIGMAS = 4.0
VIEW_HALF_ANGLE_RAD = 0.82
"""Half of the field of view, 32.5 deg, and 0.25 rad where echoes are weak."""
ALONE_RANGES = 20
"""Of a radar without a partner: so many ranges are needed to place a landmark."""
ALONE_SIGMA_M = 0.1
START_SIGMA = 1e-6
WALK_STEPS = 20
POSE_THRESHOLD, CALIBRATION_THRESHOLD, LANDMARK_THRESHOLD_M = 0.01, 0.003, 0.01
"""From which change on ISAM2 linearises a variable anew [m or rad; 1 or rad/m; m]."""
RELINEARISE_EVERY = 10
_PAPER_RANGE_SIGMA_M = 7.4e-3
"""Of the paper's front end, which predicts none: 7.1 to 8.0 mm at 30 to 44 dB, whatever the SNR."""


def wheel_residual(before: Pose, after: Pose, calibration: Pose, increment: Pose) -> Array:
    """Return r, shape (3,): [m, m, rad]; poses (x, y, heading), calibration (s, w, kappa)."""
    s, w, kappa = calibration
    ux, uy, ua = increment
    cosine, sine = math.cos(before[2]), math.sin(before[2])
    dx, dy = after[0] - before[0], after[1] - before[1]
    distance = math.hypot(ux, uy) / (1.0 + s)
    turn = (ua - kappa * distance) / (1.0 + w)
    return np.array(
        [
            cosine * dx + sine * dy - ux / (1.0 + s),
            -sine * dx + cosine * dy - uy / (1.0 + s),
            math.remainder(after[2] - before[2] - turn, math.tau),
        ]
    )


def wheel_derivatives(
    before: Pose, after: Pose, calibration: Pose, increment: Pose
) -> tuple[Array, Array, Array]:
    """Return dr / d(before), dr / d(after), dr / d(calibration), shape (3, 3) each."""
    s, w, kappa = calibration
    ux, uy, ua = increment
    cosine, sine = math.cos(before[2]), math.sin(before[2])
    dx, dy = after[0] - before[0], after[1] - before[1]
    along, across = cosine * dx + sine * dy, -sine * dx + cosine * dy
    gain, turn_gain = 1.0 / (1.0 + s), 1.0 / (1.0 + w)
    distance = math.hypot(ux, uy) * gain
    turn = (ua - kappa * distance) * turn_gain
    c, sn = math.cos(after[2] - before[2]), math.sin(after[2] - before[2])
    return (
        np.array([[-1.0, 0.0, across], [0.0, -1.0, -along], [0.0, 0.0, -1.0]]),
        np.array([[c, -sn, 0.0], [sn, c, 0.0], [0.0, 0.0, 1.0]]),
        np.array(
            [
                [ux * gain**2, 0.0, 0.0],
                [uy * gain**2, 0.0, 0.0],
                [-kappa * distance * gain * turn_gain, turn * turn_gain, distance * turn_gain],
            ]
        ),
    )


def wheel_factor(
    gtsam: Any,  # noqa: ANN401 - GTSAM's own types
    keys: tuple[int, int, int],
    increment: Array,
    sigmas: Array,
) -> Any:  # noqa: ANN401 - GTSAM's own types
    """Return the factor of one step of the wheels.

    ``keys`` are of the pose before, the pose after, and (s, w, kappa); ``increment`` and
    ``sigmas``, shape (3,), are what odometry reported [m, m, rad] and the standard deviations of r.
    """
    ux, uy, ua = (float(value) for value in increment)
    before_key, after_key, calibration_key = keys

    def error(_: object, values: Any, jacobians: Any) -> Array:  # noqa: ANN401 - GTSAM's own types
        first, second = values.atPose2(before_key), values.atPose2(after_key)
        before = (first.x(), first.y(), first.theta())
        after = (second.x(), second.y(), second.theta())
        s, w, kappa = values.atVector(calibration_key).tolist()
        step = (before, after, (s, w, kappa), (ux, uy, ua))
        if jacobians is not None:
            for row, derivative in enumerate(wheel_derivatives(*step)):
                jacobians[row] = derivative
        return wheel_residual(*step)

    return gtsam.CustomFactor(gtsam.noiseModel.Diagonal.Sigmas(sigmas), list(keys), error)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KnownRange:
    """One range of one true landmark."""

    radar: int
    landmark: int
    range_m: float
    sigma_m: float  # standard deviation of the range
    # (3,): from the pose to where the body was when the radar sampled, as odometry has it
    motion: Array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KnownRun:
    """Reported increments, shape (n, 3), each followed by the ranges measured at its end."""

    increments: Array
    ranges: tuple[tuple[KnownRange, ...], ...]


class StateRanges(SessionObserver):
    """Keeps the ranges of every state, each with its standard deviation, or () if there is none."""

    def __init__(self) -> None:
        self.of_states: list[tuple[tuple[Detection, ...], tuple[float, ...]]] = []

    def on_snapshot(self, snapshot: Snapshot) -> None:
        step = snapshot.step
        assert step is not None  # a run in this process
        self.of_states.append((step.detections, step.range_sigmas_m))


def known_run(
    states: States,
    ranges_of_states: StateRanges,
    rig: Rig,
    true_landmarks_m: Array,
    *,
    range_sigma_m: float,
    offset_sigma_m: float = 0.0,
) -> KnownRun:
    """Return the data that SLAM had, with the ids of the true landmarks, shape (n, 2), world frame.

    ``range_sigma_m`` is the standard deviation of a range in states without their own;
    ``offset_sigma_m``, that of each radar's unknown range offset, widens the gate.
    """
    stamps_ns = states.t_ns.astype(np.float64)
    odometry, truth = (
        _PosesAtStates(stamps_ns, states.odometry),
        _PosesAtStates(stamps_ns, states.truth),
    )
    increments, ranges = [], []
    last = np.zeros(3)
    for row, (detections, sigmas_m) in enumerate(ranges_of_states.of_states):
        pose = states.odometry[row]
        increments.append(between(last, pose))
        last = pose
        used = sigmas_m or (range_sigma_m,) * len(detections)
        by_frame: dict[tuple[int, int], list[tuple[Detection, float]]] = {}
        for detection, sigma in zip(detections, used, strict=True):
            if sigma < math.inf:  # else SLAM was not given it
                frame = by_frame.setdefault((detection.radar, detection.t_ns), [])
                frame.append((detection, sigma))
        of_state: list[KnownRange] = []
        for (radar, t_ns), frame in by_frame.items():
            motion = between(odometry.poses[row], odometry.at(t_ns))
            sigmas = np.array([sigma for _, sigma in frame])
            ids = true_ids(
                np.array([detection.range_m for detection, _ in frame]),
                GATE_SIGMAS * np.hypot(sigmas, offset_sigma_m),
                rig.mounts[radar],
                truth.at(t_ns),
                true_landmarks_m,
            )
            of_state += [
                KnownRange(
                    radar=radar,
                    landmark=id_,
                    range_m=detection.range_m,
                    sigma_m=sigma,
                    motion=motion,
                )
                for (detection, sigma), id_ in zip(frame, ids, strict=True)
                if id_ is not None
            ]
        ranges.append(tuple(of_state))
    return KnownRun(increments=np.array(increments).reshape(-1, 3), ranges=tuple(ranges))


def true_ids(
    ranges_m: Array, gate_m: Array, mount: Mount, true_pose: Array, landmarks_m: Array
) -> Sequence[int | None]:
    """Return for each range of one frame the row of its true landmark, None for clutter.

    ``gate_m`` says how far from the true range each may lie. ``true_pose`` (3,) is the robot's
    when the radar sampled; ``landmarks_m`` (n, 2) are in its frame.
    """
    if not len(landmarks_m):
        return [None] * len(ranges_m)
    antenna = mount_at(mount, true_pose)
    away = landmarks_m - np.array([antenna.x_m, antenna.y_m])
    off = wrap_angles(np.arctan2(away[:, 1], away[:, 0]) - antenna.yaw_rad)
    errors = np.abs(ranges_m[:, None] - np.hypot(away[:, 0], away[:, 1]))
    allowed = (errors <= gate_m[:, None]) & (np.abs(off) <= VIEW_HALF_ANGLE_RAD)
    ids: list[int | None] = [None] * len(ranges_m)
    for i, landmark in zip(*linear_sum_assignment(np.where(allowed, errors, 1e3)), strict=True):
        if allowed[i, landmark]:
            ids[i] = int(landmark)
    return ids


class _PosesAtStates:
    """Poses at the states, linear in between; a turn goes the short way round."""

    def __init__(self, stamps_ns: Array, poses: Array) -> None:
        self.poses = poses
        self._stamps_ns = stamps_ns
        self._heading = np.unwrap(poses[:, 2])

    def at(self, t_ns: int) -> Array:
        x, y, heading = (
            float(np.interp(t_ns, self._stamps_ns, values))
            for values in (self.poses[:, 0], self.poses[:, 1], self._heading)
        )
        return np.array([x, y, wrap_angle(heading)])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenFrom:
    """A range and where it was measured: step, and the antenna in the body frame of that step."""

    step: int
    known: KnownRange
    antenna: Mount


def first_position(rig: Rig, seen: Sequence[SeenFrom], poses: Sequence[Array]) -> Array | None:
    """Return a landmark's first position in the map frame, shape (2,), or None where it is early.

    ``seen`` holds all its ranges so far, those of the newest step last; ``poses`` the estimated
    pose of every step, shape (3,) each.
    """
    newest = {item.known.radar: item for item in seen if item.step == seen[-1].step}
    for pair in rig.pairs():
        if pair.first in newest and pair.second in newest:
            first, second = newest[pair.first], newest[pair.second]
            base = pair_of(pair.first, pair.second, (first.antenna, second.antenna))
            if base is None:
                continue
            point = fix_of_pair(
                np.array([first.antenna.x_m, first.antenna.y_m]),
                np.array([second.antenna.x_m, second.antenna.y_m]),
                first.known.range_m,
                second.known.range_m,
                base.ahead,
            )
            if point is not None:
                return transform(poses[first.step], point)
    if len(seen) < ALONE_RANGES or len(seen) % ALONE_RANGES:
        return None
    return _from_many(seen, poses)


def fix_of_pair(
    first_m: Array, second_m: Array, range_first_m: float, range_second_m: float, ahead: Array
) -> Array | None:
    """Return where two circles about the antennas meet on the side ``ahead``, or None.

    Body frame, shapes (2,); paper eq. 1 with the arcs' angles as arccos.
    """
    if not (0.0 < range_first_m < LONGEST_M and 0.0 < range_second_m < LONGEST_M):
        return None
    fixes = crossings(first_m.tolist(), second_m.tolist(), range_first_m, range_second_m)
    if fixes is None:
        return None
    is_left = quarter_turn(second_m - first_m) @ ahead >= 0.0
    return np.array(fixes[0] if is_left else fixes[1])


def _from_many(seen: Sequence[SeenFrom], poses: Sequence[Array]) -> Array | None:
    """Return the least-squares point of many ranges if they determine it to ``ALONE_SIGMA_M``."""
    antennas = [mount_at(item.antenna, poses[item.step]) for item in seen]
    at = np.array([[antenna.x_m, antenna.y_m] for antenna in antennas])
    ranges = np.array([item.known.range_m for item in seen])
    sigmas = np.array([item.known.sigma_m for item in seen])
    middle = antennas[len(antennas) // 2]
    ahead = np.array([math.cos(middle.yaw_rad), math.sin(middle.yaw_rad)])
    start = at[len(at) // 2] + ranges[len(ranges) // 2] * ahead

    def residual(point: Array) -> Array:
        away = point - at
        return np.asarray((np.hypot(away[:, 0], away[:, 1]) - ranges) / sigmas)

    fit = least_squares(residual, start, method="lm")
    weakest = float(np.linalg.svd(np.asarray(fit.jac), compute_uv=False)[-1])
    if weakest * ALONE_SIGMA_M < 1.0 or (fit.x - at[len(at) // 2]) @ ahead <= 0.0:
        return None
    return np.asarray(fit.x)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KnownAssociation:
    """The paths of a run with true associations, map frame, n steps."""

    filtered: Array  # (n, 3): each pose as it was known at its own time
    filtered_covariance: Array  # (n, 3, 3), of additive errors
    smoothed: Array  # (n, 3): all poses given everything
    landmark_ids: tuple[int, ...]  # rows of the true landmarks that were placed
    landmarks_m: Array  # (k, 2): where the smoother has them
    calibration: Array  # (3,): s, w, kappa of the smoother at the end


def solve_known(
    run: KnownRun, rig: Rig, wheels: WheelNoise, *, offset_sigma_m: float = 0.0
) -> KnownAssociation:
    """Return the paths of labelled data.

    ``rig`` and ``wheels`` are as SLAM knew them; ``offset_sigma_m`` is the standard deviation of
    each radar's unknown range offset, zero if they are calibrated. Raises
    ModuleNotFoundError without GTSAM.
    """
    return _FactorGraph(rig, wheels, offset_sigma_m).solve(run)


class _FactorGraph:
    """The growing factor graph."""

    def __init__(self, rig: Rig, wheels: WheelNoise, offset_sigma_m: float) -> None:
        self._gtsam = gtsam = import_module("gtsam")  # of an extra, so without types
        symbols = gtsam.symbol_shorthand
        self._X, self._L, self._C, self._B = symbols.X, symbols.L, symbols.C, symbols.B
        self._rig, self._wheels = rig, wheels
        self._has_offsets = offset_sigma_m > 0.0
        self._isam = gtsam.ISAM2(_isam_parameters(gtsam))
        self._poses = [np.zeros(3)]
        self._calibration = np.zeros(3)
        self._n_calibrations = 1
        self._walked = 0.0
        self._known: set[int] = set()
        self._waiting: dict[int, list[SeenFrom]] = {}
        self._new_graph()
        self._values.insert(self._X(0), gtsam.Pose2())
        self._graph.add(
            gtsam.PriorFactorPose2(
                self._X(0), gtsam.Pose2(), gtsam.noiseModel.Isotropic.Sigma(3, START_SIGMA)
            )
        )
        self._values.insert(self._C(0), np.zeros(3))
        self._sigmas = np.maximum(wheels.calibration_sigmas, 1e-7)
        noise = gtsam.noiseModel.Diagonal.Sigmas(self._sigmas)
        self._graph.add(gtsam.PriorFactorVector(self._C(0), np.zeros(3), noise))
        if self._has_offsets:
            for radar in range(len(rig.mounts)):
                self._values.insert(self._B(radar), 0.0)
                noise = gtsam.noiseModel.Isotropic.Sigma(1, offset_sigma_m)
                self._graph.add(gtsam.PriorFactorDouble(self._B(radar), 0.0, noise))

    def solve(self, run: KnownRun) -> KnownAssociation:
        covariances = [
            self._step(increment, ranges)
            for increment, ranges in zip(run.increments, run.ranges, strict=True)
        ]
        optimizer = self._gtsam.LevenbergMarquardtOptimizer(
            self._isam.getFactorsUnsafe(), self._isam.calculateEstimate()
        )
        values = optimizer.optimize()
        smoothed = [values.atPose2(self._X(step)) for step in range(1, len(self._poses))]
        ids = tuple(sorted(self._known))
        landmarks = [values.atPoint2(self._L(id_)) for id_ in ids]
        return KnownAssociation(
            filtered=np.array(self._poses[1:]).reshape(-1, 3),
            filtered_covariance=np.array(covariances).reshape(-1, 3, 3),
            smoothed=np.array([[p.x(), p.y(), p.theta()] for p in smoothed]).reshape(-1, 3),
            landmark_ids=ids,
            landmarks_m=np.array(landmarks).reshape(-1, 2),
            calibration=np.asarray(values.atVector(self._C(self._n_calibrations - 1))),
        )

    def _step(self, increment: Array, ranges: tuple[KnownRange, ...]) -> Array:
        """Take in one step; return the covariance of the newest pose, shape (3, 3)."""
        gtsam, step = self._gtsam, len(self._poses)
        self._walk(increment)
        calibration_key = self._C(self._n_calibrations - 1)
        motion = calibrated_motion(increment, self._calibration, self._wheels)
        self._graph.add(
            wheel_factor(
                gtsam,
                (self._X(step - 1), self._X(step), calibration_key),
                increment,
                np.sqrt(np.diag(motion.covariance)),
            )
        )
        last = self._poses[-1]
        moved = last[:2] + rotation(float(last[2])) @ motion.step_m
        pose = np.array([*moved, wrap_angle(float(last[2]) + motion.turn_rad)])
        self._poses.append(pose)
        self._values.insert(self._X(step), gtsam.Pose2(*pose))
        self._take_ranges(step, ranges)
        self._isam.update(self._graph, self._values)
        self._new_graph()
        estimate = self._isam.calculateEstimatePose2(self._X(step))
        self._calibration = self._isam.calculateEstimateVector(calibration_key)
        pose = np.array([estimate.x(), estimate.y(), estimate.theta()])
        self._poses[-1] = pose
        # GTSAM's error of a pose lies in the body frame.
        return turned_covariance(self._isam.marginalCovariance(self._X(step)), float(pose[2]))

    def _new_graph(self) -> None:
        self._graph = self._gtsam.NonlinearFactorGraph()
        self._values = self._gtsam.Values()

    def _walk(self, increment: Array) -> None:
        """Begin a new set of calibration errors where the old one has wandered for long enough."""
        distance_m = math.hypot(increment[0], increment[1])
        self._walked += self._wheels.walk_variance(distance_m, float(increment[2]))
        if self._walked == 0.0 or len(self._poses) % WALK_STEPS:
            return
        key, last = self._C(self._n_calibrations), self._C(self._n_calibrations - 1)
        noise = self._gtsam.noiseModel.Diagonal.Sigmas(math.sqrt(self._walked) * self._sigmas)
        self._values.insert(key, self._calibration)
        self._graph.add(self._gtsam.BetweenFactorVector(last, key, np.zeros(3), noise))
        self._n_calibrations += 1
        self._walked = 0.0

    def _take_ranges(self, step: int, ranges: tuple[KnownRange, ...]) -> None:
        for known in ranges:
            motion = calibrated_motion(known.motion, self._calibration, self._wheels)
            antenna = mount_at(
                self._rig.mounts[known.radar], np.array([*motion.step_m, motion.turn_rad])
            )
            seen = SeenFrom(step=step, known=known, antenna=antenna)
            if known.landmark in self._known:
                self._add_range(seen)
            else:
                self._waiting.setdefault(known.landmark, []).append(seen)
        for landmark in {known.landmark for known in ranges} - self._known:
            place = first_position(self._rig, self._waiting[landmark], self._poses)
            if place is not None:
                self._known.add(landmark)
                self._values.insert(self._L(landmark), place)
                for seen in self._waiting.pop(landmark):
                    self._add_range(seen)

    def _add_range(self, seen: SeenFrom) -> None:
        gtsam, known = self._gtsam, seen.known
        keys, kind = [self._X(seen.step), self._L(known.landmark)], gtsam.RangeFactorWithTransform2D
        if self._has_offsets:
            keys.append(self._B(known.radar))
            kind = gtsam.RangeFactorWithTransformBias2D
        noise = gtsam.noiseModel.Isotropic.Sigma(1, known.sigma_m)
        sensor = gtsam.Pose2(seen.antenna.x_m, seen.antenna.y_m, seen.antenna.yaw_rad)
        self._graph.add(kind(*keys, known.range_m, noise, sensor))


def _isam_parameters(gtsam: Any) -> Any:  # noqa: ANN401 - GTSAM's own types
    """Return ISAM2's parameters; QR, for wheels that stand still make Cholesky fail."""
    thresholds = gtsam.ISAM2ThresholdMap()
    for symbol, size, threshold in (
        ("x", 3, POSE_THRESHOLD),
        ("c", 3, CALIBRATION_THRESHOLD),
        ("l", 2, LANDMARK_THRESHOLD_M),
        ("b", 1, LANDMARK_THRESHOLD_M),
    ):
        thresholds.insert((symbol, np.full(size, threshold)))
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(thresholds)
    parameters.relinearizeSkip = RELINEARISE_EVERY
    parameters.setFactorization("QR")
    return parameters


@dataclass(frozen=True, slots=True, kw_only=True)
class BoundSummary:
    """Errors of GTSAM with true associations: ISAM2's filtered path, and the full smoother's."""

    filtered_ate_rmse_m: float  # time-associated, SE(2)-aligned, like `ate_rmse_m`
    smoothed_ate_rmse_m: float
    # at the ten times of the run's own: (time [s], NEES)
    nees_pose: tuple[tuple[float, float], ...]


def bound_of(
    record: RunRecord, ranges: StateRanges, scene: Scene, config: SlamConfig
) -> BoundSummary:
    """Return the bound of a run that has a state.

    Rig, wheels and offsets are those that SLAM knew; the truth only gives each range its landmark.
    Raises ModuleNotFoundError without GTSAM.
    """
    is_robust = config.back_end is BackEnd.ROBUST
    rig = rig_of(scene)
    offset_sigma_m = config.robust.offset_sigma_m if is_robust else 0.0
    states = record.states
    run = known_run(
        states,
        ranges,
        rig,
        true_landmarks_m(scene),
        range_sigma_m=config.robust.range_sigma_m if is_robust else _PAPER_RANGE_SIGMA_M,
        offset_sigma_m=offset_sigma_m,
    )
    paths = solve_known(run, rig, wheels_of(scene), offset_sigma_m=offset_sigma_m)
    truth = np.array([between(record.world_from_map, pose) for pose in states.truth])
    truth_xy = states.truth[:, :2]
    return BoundSummary(
        filtered_ate_rmse_m=ate_rmse_m(paths.filtered[:, :2], truth_xy),
        smoothed_ate_rmse_m=ate_rmse_m(paths.smoothed[:, :2], truth_xy),
        nees_pose=nees_at_ten_times(record, truth, paths.filtered, paths.filtered_covariance),
    )

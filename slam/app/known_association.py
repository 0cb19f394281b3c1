"""The known-association bound: what the same data gives when every range's landmark is told.

GTSAM solves for poses, landmarks, the wheels' calibration errors (s, w, kappa) and, where they
are unknown, the radars' range offsets, with the noise model of ``slam.robust``. ISAM2 takes one
step at a time and relinearises as it goes: the last pose after each step is the filtered path,
causal as a filter's. Levenberg-Marquardt over everything is the full smoother.

What the bound is: the best that this noise model gives on these ranges, up to ISAM2's thresholds.
It is no bound on luck: a filter with fewer ranges may end nearer to the truth in a single run.
Calibration errors that wander are one set per ``WALK_STEPS`` steps.
Source: Kaess et al., iSAM2, IJRR 31(2), 2012; GTSAM is BSD-licensed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.app.gtsam_door import load_gtsam
from slam.app.gtsam_motion import wheel_factor
from slam.app.known_ranges import GATE_SIGMAS, KnownRange, KnownRun, known_run
from slam.app.known_start import SeenFrom, first_position
from slam.app.runner import RunRecord
from slam.geometry import Rig, mount_at, wrap_angle
from slam.robust.motion import calibrated_motion
from slam.robust.parameters import WheelNoise
from slam.robust.state import rotation

Array = NDArray[np.float64]

PURPOSE = "the known-association bound"
START_SIGMA = 1e-6
WALK_STEPS = 20
POSE_THRESHOLD, CALIBRATION_THRESHOLD, LANDMARK_THRESHOLD_M = 0.01, 0.003, 0.01
"""From which change on ISAM2 linearises a variable anew [m or rad; 1 or rad/m; m]."""
RELINEARISE_EVERY = 10


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class KnownAssociation:
    """The paths of a run with true associations, map frame, one row per step.

    Attributes
    ----------
    filtered, filtered_covariance
        shapes (n, 3) and (n, 3, 3): each pose as it was known at its own time, additive errors.
    smoothed
        shape (n, 3): all poses given everything.
    landmark_ids, landmarks_m
        Rows of the true landmarks that were placed, and where the smoother has them, (k, 2).
    calibration
        shape (3,): s, w, kappa of the smoother at the end.
    """

    filtered: Array
    filtered_covariance: Array
    smoothed: Array
    landmark_ids: tuple[int, ...]
    landmarks_m: Array
    calibration: Array


def known_association_paths(
    record: RunRecord,
    rig: Rig,
    wheels: WheelNoise,
    true_landmarks_m: Array,
    *,
    range_sigma_m: float,
    offset_sigma_m: float = 0.0,
    gate_sigmas: float = GATE_SIGMAS,
) -> KnownAssociation:
    """Return the bound of a run, one row per result of the record.

    Parameters
    ----------
    record
        The run; its increments and detections are used, and the truth only to tell whose a range
        is (``slam.app.known_ranges``).
    rig
        The mounts as SLAM was told of them.
    wheels
        How odometry errs, by its specification.
    true_landmarks_m
        Shape (n, 2), world frame.
    range_sigma_m
        Standard deviation of a range where the results do not tell what SLAM was told of each;
        those it was not given the bound does not use either.
    offset_sigma_m
        Standard deviation of each radar's unknown range offset; zero: calibrated.
    gate_sigmas
        How far from the true range a detection of a landmark may lie.

    Raises
    ------
    AppError
        GTSAM is not installed.
    """
    run = known_run(
        record,
        rig,
        true_landmarks_m,
        range_sigma_m=range_sigma_m,
        offset_sigma_m=offset_sigma_m,
        gate_sigmas=gate_sigmas,
    )
    return solve_known(run, rig, wheels, offset_sigma_m=offset_sigma_m)


def solve_known(
    run: KnownRun, rig: Rig, wheels: WheelNoise, *, offset_sigma_m: float = 0.0
) -> KnownAssociation:
    """Return the paths of labelled data; see ``known_association_paths``."""
    estimator = _Estimator(rig, wheels, offset_sigma_m)
    filtered, covariances = [], []
    for increment, ranges in zip(run.increments, run.ranges, strict=True):
        pose, covariance = estimator.step(increment, ranges)
        filtered.append(pose)
        covariances.append(covariance)
    smoothed, ids, landmarks, calibration = estimator.smooth()
    return KnownAssociation(
        filtered=np.array(filtered).reshape(-1, 3),
        filtered_covariance=np.array(covariances).reshape(-1, 3, 3),
        smoothed=smoothed,
        landmark_ids=ids,
        landmarks_m=landmarks,
        calibration=calibration,
    )


class _Estimator:
    """The growing factor graph."""

    def __init__(self, rig: Rig, wheels: WheelNoise, offset_sigma_m: float) -> None:
        self._gtsam = gtsam = load_gtsam(PURPOSE)
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
        sigmas = np.maximum(wheels.calibration_sigmas, 1e-7)
        self._add_prior(self._C(0), np.zeros(3), sigmas)
        if self._has_offsets:
            for radar in range(len(rig.mounts)):
                self._values.insert(self._B(radar), 0.0)
                noise = gtsam.noiseModel.Isotropic.Sigma(1, offset_sigma_m)
                self._graph.add(gtsam.PriorFactorDouble(self._B(radar), 0.0, noise))

    def step(self, increment: Array, ranges: tuple[KnownRange, ...]) -> tuple[Array, Array]:
        """Take in one step; return the newest pose (3,) and its covariance (3, 3)."""
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
        turn = np.eye(3)
        turn[:2, :2] = rotation(float(pose[2]))
        # GTSAM's error of a pose lies in the body frame.
        return pose, turn @ self._isam.marginalCovariance(self._X(step)) @ turn.T

    def smooth(self) -> tuple[Array, tuple[int, ...], Array, Array]:
        """Return all poses but the first, landmark ids and positions, and calibration."""
        optimizer = self._gtsam.LevenbergMarquardtOptimizer(
            self._isam.getFactorsUnsafe(), self._isam.calculateEstimate()
        )
        values = optimizer.optimize()
        poses = [values.atPose2(self._X(step)) for step in range(1, len(self._poses))]
        ids = tuple(sorted(self._known))
        return (
            np.array([[p.x(), p.y(), p.theta()] for p in poses]).reshape(-1, 3),
            ids,
            np.array([values.atPoint2(self._L(id_)) for id_ in ids]).reshape(-1, 2),
            np.asarray(values.atVector(self._C(self._n_calibrations - 1))),
        )

    def _new_graph(self) -> None:
        self._graph = self._gtsam.NonlinearFactorGraph()
        self._values = self._gtsam.Values()

    def _add_prior(self, key: int, mean: Array, sigmas: Array) -> None:
        noise = self._gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        self._values.insert(key, mean)
        self._graph.add(self._gtsam.PriorFactorVector(key, mean, noise))

    def _walk(self, increment: Array) -> None:
        """Begin a new set of calibration errors where the old one has wandered for long enough."""
        wheels = self._wheels
        distance_m = math.hypot(increment[0], increment[1])
        self._walked += wheels.walk_variance(distance_m, float(increment[2]))
        if self._walked == 0.0 or len(self._poses) % WALK_STEPS:
            return
        key, last = self._C(self._n_calibrations), self._C(self._n_calibrations - 1)
        sigmas = math.sqrt(self._walked) * np.maximum(wheels.calibration_sigmas, 1e-7)
        noise = self._gtsam.noiseModel.Diagonal.Sigmas(sigmas)
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
        keys = [self._X(seen.step), self._L(known.landmark)]
        if self._has_offsets:
            keys.append(self._B(known.radar))
        kind = (
            gtsam.RangeFactorWithTransformBias2D
            if self._has_offsets
            else gtsam.RangeFactorWithTransform2D
        )
        noise = gtsam.noiseModel.Isotropic.Sigma(1, known.sigma_m)
        sensor = gtsam.Pose2(seen.antenna.x_m, seen.antenna.y_m, seen.antenna.yaw_rad)
        self._graph.add(kind(*keys, known.range_m, noise, sensor))


def _isam_parameters(gtsam: Any) -> Any:  # noqa: ANN401 - GTSAM's own types, see gtsam_door
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

"""Victoria Park through our back end, and through GTSAM for a reference."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam.app.gtsam_door import load_gtsam
from slam.app.victoria_park import Drive
from slam.geometry import Rig, compose, wrap_angle
from slam.robust.back_end import RobustBackEnd
from slam.robust.parameters import BackEndParameters, RelinearisationRule, WheelNoise
from slam.robust.state import CALIBRATION

Array = NDArray[np.float64]

_CALIBRATION_COLUMNS = np.arange(CALIBRATION.start, CALIBRATION.stop)

# A park is a hundred times wider than a room, and its trees are known to half a metre.
# Nothing is left out as an outlier: a tree seen twice would be left without a place.
PARK_RULE = RelinearisationRule(
    turn_rad=0.02, shift_m=0.5, every=100, most_poses=10_000, outlier_sigmas=math.inf
)

# Wheels of which nothing is known: a tenth in distance and turn, a degree per two metres.
UNKNOWN_WHEELS = WheelNoise(scale_sigma=0.1, turn_scale_sigma=0.1, curvature_sigma_rad_per_m=0.01)
PERFECT_WHEELS = WheelNoise(scale_sigma=0.0, turn_scale_sigma=0.0, curvature_sigma_rad_per_m=0.0)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ParkRun:
    """What came out of a drive.

    Attributes
    ----------
    poses
        shape (k + 1, 3): x, y [m], heading [rad]; of the causal path, each as it was known then.
    landmarks_m
        shape (n, 2).
    given
        One entry per observation: (true id, id it was given, or None where left out).
    calibration, calibration_sigmas
        shape (3,): scale, turn scale and curvature errors of the wheels at the end.
    seconds
        Processor time.
    """

    poses: Array
    landmarks_m: Array
    calibration: Array
    calibration_sigmas: Array
    given: tuple[tuple[int, int | None], ...]
    seconds: float


def drive_back_end(
    drive: Drive,
    *,
    with_ids: bool,
    wheels: WheelNoise = PERFECT_WHEELS,
    check: Callable[[], None] = lambda: None,
) -> ParkRun:
    """Run a drive through the robust back end's public interface.

    Parameters
    ----------
    drive
        The data; the noise of each step is in it.
    with_ids
        Whether the back end is told which tree each observation is of.
    wheels
        Standard deviations of the wheels' calibration errors; the reference's model has none.
    check
        Called once per step; may raise to stop.
    """
    began = time.process_time()
    back_end = RobustBackEnd(
        Rig(mounts=()), BackEndParameters(wheels=wheels, relinearisation=PARK_RULE)
    )
    given: list[tuple[int, int | None]] = []
    path = [back_end.pose]
    for step, points in enumerate(drive.seen):
        check()
        if step > 0:
            back_end.predict(drive.increments[step - 1], drive.covariances[step - 1])
        told = points if with_ids else [replace(point, label=None) for point in points]
        ids = back_end.update_points(told)
        given += [
            (point.label, id_)
            for point, id_ in zip(points, ids, strict=True)
            if point.label is not None
        ]
        if step > 0:
            path.append(back_end.pose)
    return ParkRun(
        poses=np.array(path),
        landmarks_m=back_end.state.landmarks_m.copy(),
        calibration=back_end.state.calibration.copy(),
        calibration_sigmas=np.sqrt(np.diag(back_end.state.P.block(_CALIBRATION_COLUMNS))),
        given=tuple(given),
        seconds=time.process_time() - began,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reference:
    """GTSAM's solutions with true ids.

    Attributes
    ----------
    poses
        shape (k + 1, 3), of the batch solution.
    causal
        The same of ISAM2, each pose as it was known then: what a causal path can be.
    landmarks_m, labels
        shape (n, 2), of the batch solution, and their ids.
    chi_square, dof
        Sum of squared white residuals of the batch solution, and what it should be on average.
    seconds
        Processor time.
    """

    poses: Array
    causal: Array
    landmarks_m: Array
    labels: tuple[int, ...]
    chi_square: float
    dof: int
    seconds: float


def batch_reference(drive: Drive, check: Callable[[], None] = lambda: None) -> Reference:
    """Solve for all poses and landmarks with GTSAM: ISAM2 for a start, Levenberg-Marquardt then.

    The start matters: odometry alone ends far enough away to lead into another valley.
    """
    gtsam = load_gtsam("Victoria Park")
    began = time.process_time()
    pose_key, landmark_key = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L
    isam = gtsam.ISAM2(gtsam.ISAM2Params())
    whole = gtsam.NonlinearFactorGraph()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    start = gtsam.PriorFactorPose2(
        pose_key(0), gtsam.Pose2(), gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
    )
    graph.add(start)
    whole.add(start)
    values.insert(pose_key(0), gtsam.Pose2())
    pose = np.zeros(3)
    known: set[int] = set()
    causal: list[Array] = []
    for step, points in enumerate(drive.seen):
        check()
        if step > 0:
            increment = drive.increments[step - 1]
            noise = gtsam.noiseModel.Gaussian.Covariance(drive.covariances[step - 1])
            factor = gtsam.BetweenFactorPose2(
                pose_key(step - 1), pose_key(step), gtsam.Pose2(*increment), noise
            )
            graph.add(factor)
            whole.add(factor)
            pose = compose(pose, increment)
            values.insert(pose_key(step), gtsam.Pose2(*pose))
        for point in points:
            assert point.label is not None
            if point.label not in known:
                known.add(point.label)
                place = compose(pose, np.array([*point.body_point(0).point_m, 0.0]))[:2]
                values.insert(landmark_key(point.label), place)
            # GTSAM orders bearing, range
            noise = gtsam.noiseModel.Gaussian.Covariance(point.covariance[::-1, ::-1])
            factor = gtsam.BearingRangeFactor2D(
                pose_key(step),
                landmark_key(point.label),
                gtsam.Rot2(point.bearing_rad),
                point.range_m,
                noise,
            )
            graph.add(factor)
            whole.add(factor)
        isam.update(graph, values)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose = _vector(isam.calculateEstimatePose2(pose_key(step)))
        causal.append(pose)
    solution = gtsam.LevenbergMarquardtOptimizer(whole, isam.calculateEstimate()).optimize()
    labels = tuple(sorted(known))
    return Reference(
        poses=np.array(
            [_vector(solution.atPose2(pose_key(step))) for step in range(len(drive.seen))]
        ),
        causal=np.array(causal),
        landmarks_m=np.array([solution.atPoint2(landmark_key(label)) for label in labels]).reshape(
            -1, 2
        ),
        labels=labels,
        chi_square=2.0 * whole.error(solution),
        dof=2 * drive.n_observations - 2 * len(labels),
        seconds=time.process_time() - began,
    )


def _vector(pose: Any) -> Array:  # noqa: ANN401 - GTSAM's own types, see gtsam_door
    return np.array([pose.x(), pose.y(), wrap_angle(pose.theta())])

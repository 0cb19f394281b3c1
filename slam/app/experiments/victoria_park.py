"""The robust back end on real data: Victoria Park, with and without the trees' ids.

The file has one line per odometry step and one per tree seen::

    ODOMETRY before after dx dy turn  C11 C12 C13 C22 C23 C33
    LANDMARK pose landmark x y        C11 C12 C22

in metres and radians, body frame of the earlier pose, with covariances (upper triangles). Poses
and landmarks share one sequence of ids, so poses are numbered anew here. There is no ground
truth. Source: the data of Guivant and Nebot, University of Sydney, in iSAM's format.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from slam.app.errors import AppError
from slam.app.experiments import Result, table
from slam.app.run.output import print_progress, share_text
from slam.app.run.pictures import ESTIMATE, INK, LANDMARK, ODOMETRY, TRUTH, label
from slam.app.sweep.bound import load_gtsam
from slam.config import WheelNoise
from slam.evaluation import ate_rmse_m
from slam.geometry import Rig, compose, wrap_angle
from slam.robust.back_end import RobustBackEnd
from slam.robust.initialisation import RangeBearing
from slam.robust.parameters import BackEndParameters, PointRule, RelinearisationRule
from slam.robust.state import CALIBRATION
from xethru_protocol.system import StopFlag
from xethru_protocol.validation import reason_of

Array = NDArray[np.float64]

FILE = "victoria_park.txt"

# A park is a hundred times wider than a room, and its trees are known to half a metre.
# Nothing is left out as an outlier: a tree seen twice would be left without a place.
PARK_RULE = RelinearisationRule(
    turn_rad=0.02, shift_m=0.5, every=100, outlier_sigmas=math.inf, steps_per_slip=math.inf
)
# A point may be a landmark within the 99 % quantile of chi-square, two degrees of freedom, and is a
# new one at five standard deviations from all others.
PARK_POINTS = PointRule(gate=9.21, new_gate=25.0, reach_m=20.0)

# Wheels of which nothing is known: a tenth in distance and turn, a degree per two metres.
UNKNOWN_WHEELS = WheelNoise(scale_sigma=0.1, turn_scale_sigma=0.1, curvature_sigma_rad_per_m=0.01)
PERFECT_WHEELS = WheelNoise(scale_sigma=0.0, turn_scale_sigma=0.0, curvature_sigma_rad_per_m=0.0)

_ISAM = "#2f9e44"
_MAPS = ("true ids", "unknown ids")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Drive:
    """Odometry and landmarks seen."""

    increments: Array  # (k, 3): dx, dy [m], turn [rad] in the body frame before the step
    covariances: Array  # (k, 3, 3)
    seen: tuple[tuple[RangeBearing, ...], ...]  # from each of k + 1 poses, labelled with ids

    @property
    def n_observations(self) -> int:
        return sum(len(points) for points in self.seen)

    @property
    def labels(self) -> frozenset[int]:
        return frozenset(
            point.label for points in self.seen for point in points if point.label is not None
        )

    def first(self, n_steps: int) -> Drive:
        return Drive(
            increments=self.increments[:n_steps],
            covariances=self.covariances[:n_steps],
            seen=self.seen[: n_steps + 1],
        )


def shipped_file() -> Path:
    """Return where GTSAM keeps the data; raise AppError if it is not there."""
    path = Path(load_gtsam("Victoria Park").__file__).parent / "Data" / FILE
    if not path.is_file():
        raise AppError(
            f"{path.name}: this installation of GTSAM has no such data; "
            "pip install 'gtsam>=4.3,<4.4' has"
        )
    return path


def read_drive(path: Path) -> Drive:
    """Read the file; AppError names the file, or the line that is not in the format above."""
    increments: list[list[float]] = []
    covariances: list[Array] = []
    seen: list[list[RangeBearing]] = [[]]
    pose_of: dict[int, int] = {}
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise AppError(f"{path}: cannot be read: {reason_of(error)}") from None
    for number, line in enumerate(lines, start=1):
        try:
            kind, first, second, *rest = line.split()
            before, after, values = int(first), int(second), [float(word) for word in rest]
            if not all(math.isfinite(value) for value in values):
                raise ValueError
            if kind == "ODOMETRY":
                pose_of.setdefault(before, len(seen) - 1)
                if pose_of[before] != len(seen) - 1:
                    raise ValueError
                dx, dy, turn, c11, c12, c13, c22, c23, c33 = values
                increments.append([dx, dy, turn])
                covariances.append(np.array([[c11, c12, c13], [c12, c22, c23], [c13, c23, c33]]))
                pose_of[after] = len(seen)
                seen.append([])
            elif kind == "LANDMARK":
                x, y, c11, c12, c22 = values
                covariance = np.array([[c11, c12], [c12, c22]])
                seen[pose_of[before]].append(range_bearing(x, y, covariance, label=after))
            else:
                raise ValueError
        except (ValueError, KeyError):
            raise AppError(f"{path}, line {number}: no line of a Victoria Park file") from None
    return Drive(
        increments=np.array(increments).reshape(-1, 3),
        covariances=np.array(covariances).reshape(-1, 3, 3),
        seen=tuple(tuple(points) for points in seen),
    )


def range_bearing(x_m: float, y_m: float, covariance: Array, label: int | None) -> RangeBearing:
    """Return a relative position as range and bearing, its covariance to first order.

    With r = |(x, y)| and G = d(r, bearing) / d(x, y) = [[x/r, y/r], [-y/r^2, x/r^2]] the
    covariance is G C G^T. Raises ValueError at the origin, where there is no bearing.
    """
    r = math.hypot(x_m, y_m)
    if r == 0.0:
        raise ValueError("a point at the origin has no bearing")
    G = np.array([[x_m / r, y_m / r], [-y_m / r**2, x_m / r**2]])
    return RangeBearing(
        range_m=r,
        bearing_rad=math.atan2(y_m, x_m),
        covariance=G @ covariance @ G.T,
        label=label,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ParkRun:
    """What came out of a drive."""

    poses: Array  # (k + 1, 3): x, y [m], heading [rad]; causal, each as it was known then
    landmarks_m: Array  # (n, 2)
    calibration: Array  # (3,): errors of scale, turn scale and curvature of the wheels at the end
    calibration_sigmas: Array  # (3,)
    # true id of each observation and its own; None: left out
    given: tuple[tuple[int, int | None], ...]
    seconds: float  # processor time


def drive_back_end(drive: Drive, wheels: WheelNoise, stop: StopFlag, *, with_ids: bool) -> ParkRun:
    """Run a drive through the robust back end's public interface.

    ``wheels`` says how the wheels' calibration errs; the noise of each step is in the data. With
    ``with_ids`` the back end gets the id of the tree of each observation.
    """
    began = time.process_time()
    back_end = RobustBackEnd(
        Rig(mounts=()), BackEndParameters(wheels=wheels, relinearisation=PARK_RULE)
    )
    given: list[tuple[int, int | None]] = []
    path = [back_end.pose]
    for step, points in enumerate(drive.seen):
        stop.check()
        if step > 0:
            back_end.predict(drive.increments[step - 1], drive.covariances[step - 1])
        given_points = points if with_ids else [replace(point, label=None) for point in points]
        ids = back_end.update_points(given_points, PARK_POINTS)
        given += [
            (point.label, id_)
            for point, id_ in zip(points, ids, strict=True)
            if point.label is not None
        ]
        if step > 0:
            path.append(back_end.pose)
    calibration = np.arange(CALIBRATION.start, CALIBRATION.stop)
    return ParkRun(
        poses=np.array(path),
        landmarks_m=back_end.state.landmarks_m.copy(),
        calibration=back_end.state.calibration.copy(),
        calibration_sigmas=np.sqrt(np.diag(back_end.state.P.block(calibration))),
        given=tuple(given),
        seconds=time.process_time() - began,
    )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Reference:
    """GTSAM's solutions with true ids."""

    poses: Array  # (k + 1, 3), of the batch solution
    causal: Array  # the same of ISAM2, each pose as it was known then: what a causal path can be
    landmarks_m: Array  # (n, 2), of the batch solution
    labels: tuple[int, ...]  # ids of the landmarks
    chi_square: float  # sum of squared white residuals of the batch solution
    dof: int  # what that should be on average
    seconds: float  # processor time


def batch_reference(drive: Drive, stop: StopFlag) -> Reference:
    """Solve for all poses and landmarks with GTSAM: ISAM2 for a start, Levenberg-Marquardt then.

    The start matters: odometry alone ends far enough away to lead into another valley.
    """
    gtsam = load_gtsam("Victoria Park")
    began = time.process_time()
    pose_key, landmark_key = gtsam.symbol_shorthand.X, gtsam.symbol_shorthand.L
    isam = gtsam.ISAM2(gtsam.ISAM2Params())
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    sure = gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)
    graph.add(gtsam.PriorFactorPose2(pose_key(0), gtsam.Pose2(), sure))
    values.insert(pose_key(0), gtsam.Pose2())
    pose = np.zeros(3)
    known: set[int] = set()
    causal: list[Array] = []
    for step, points in enumerate(drive.seen):
        stop.check()
        if step > 0:
            increment = drive.increments[step - 1]
            noise = gtsam.noiseModel.Gaussian.Covariance(drive.covariances[step - 1])
            keys = pose_key(step - 1), pose_key(step)
            graph.add(gtsam.BetweenFactorPose2(*keys, gtsam.Pose2(*increment), noise))
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
            keys = pose_key(step), landmark_key(point.label)
            bearing = gtsam.Rot2(point.bearing_rad)
            graph.add(gtsam.BearingRangeFactor2D(*keys, bearing, point.range_m, noise))
        isam.update(graph, values)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose = _vector(isam.calculateEstimatePose2(pose_key(step)))
        causal.append(pose)
    whole = isam.getFactorsUnsafe()
    solution = gtsam.LevenbergMarquardtOptimizer(whole, isam.calculateEstimate()).optimize()
    labels = tuple(sorted(known))
    poses = [_vector(solution.atPose2(pose_key(step))) for step in range(len(drive.seen))]
    landmarks_m = [solution.atPoint2(landmark_key(label)) for label in labels]
    return Reference(
        poses=np.array(poses),
        causal=np.array(causal),
        landmarks_m=np.array(landmarks_m).reshape(-1, 2),
        labels=labels,
        chi_square=2.0 * whole.error(solution),
        dof=2 * drive.n_observations - 2 * len(labels),
        seconds=time.process_time() - began,
    )


def _vector(pose: Any) -> Array:  # noqa: ANN401 - GTSAM's own types
    return np.array([pose.x(), pose.y(), wrap_angle(pose.theta())])


@dataclass(frozen=True, slots=True, kw_only=True)
class PathScore:
    """One path against the batch solution.

    An observation is right if its landmark is the one that its tree is mostly called, and is mostly
    called so for its tree.
    """

    name: str
    ate_m: float  # time-associated, SE(2)-aligned
    rmse_m: float  # from the same start, not aligned
    max_m: float  # largest distance, not aligned
    n_landmarks: int | None
    right_share: float | None  # of the observations taken in; None where the ids were given
    left_out: int | None  # observations that were in doubt and not taken in
    seconds: float | None  # processor time


def odometry_path(drive: Drive) -> Array:
    """Return where the increments alone lead, shape (k + 1, 3)."""
    poses = [np.zeros(3)]
    for increment in drive.increments:
        poses.append(compose(poses[-1], increment))
    return np.array(poses)


def right_share(given: Sequence[tuple[int, int | None]]) -> float | None:
    """Return how many observations that were taken in have the right landmark, of all of them.

    A tree and a landmark belong together if each is mostly the other's.

    >>> right_share([(7, 0), (7, 0), (7, 1), (8, 1), (8, 1), (9, None)])
    0.8
    """
    taken = Counter(pair for pair in given if pair[1] is not None)
    if not taken:
        return None
    landmark_of: dict[int, int | None] = {}
    tree_of: dict[int | None, int] = {}
    for (tree, landmark), _ in reversed(taken.most_common()):  # the most frequent is the last
        landmark_of[tree] = landmark
        tree_of[landmark] = tree
    right = sum(
        n
        for (tree, landmark), n in taken.items()
        if landmark_of[tree] == landmark and tree_of[landmark] == tree
    )
    return right / taken.total()


def score(
    name: str, poses: Array, reference: Reference, run: ParkRun | None = None, *, has_ids: bool
) -> PathScore:
    away = np.hypot(*(poses - reference.poses)[:, :2].T)
    return PathScore(
        name=name,
        ate_m=ate_rmse_m(poses[:, :2], reference.poses[:, :2]),
        rmse_m=float(np.sqrt(np.mean(away**2))),
        max_m=float(away.max()),
        n_landmarks=None if run is None else len(run.landmarks_m),
        right_share=None if run is None or has_ids else right_share(run.given),
        left_out=None if run is None else sum(given is None for _, given in run.given),
        seconds=None if run is None else run.seconds,
    )


def _draw(
    figure: Figure,
    odometry: Array,
    reference: Reference,
    runs: Mapping[str, ParkRun],
    rows: Sequence[PathScore],
) -> None:
    """Draw one map per run beside the batch solution, and distances to it below."""
    ate = {row.name: row.ate_m for row in rows}
    grid = figure.add_gridspec(2, 2, height_ratios=(2.4, 1.0))
    for column, name in enumerate(_MAPS):
        run = runs[name]
        axes = figure.add_subplot(grid[0, column])
        _map(axes, odometry, reference, run)
        landmarks = f"{len(run.landmarks_m)} landmarks for {len(reference.labels)} trees"
        label(axes, f"{name}: {landmarks}, ATE {ate[f'robust, {name}']:.2f} m", "x [m]", "y [m]")
        if column == 0:
            axes.legend(loc="lower left", fontsize=8, frameon=False)
    axes = figure.add_subplot(grid[1, :])
    gone_m = np.concatenate(
        [[0.0], np.cumsum(np.hypot(*np.diff(reference.poses[:, :2], axis=0).T))]
    )
    for name, poses, colour in (
        ("ISAM2, true ids", reference.causal, _ISAM),
        ("robust, true ids", runs["true ids"].poses, ESTIMATE),
        ("robust, unknown ids", runs["unknown ids"].poses, LANDMARK),
    ):
        away = np.hypot(*(poses - reference.poses)[:, :2].T)
        axes.semilogy(gone_m, np.maximum(away, 1e-3), color=colour, linewidth=0.9, label=name)
    axes.set_ylim(1e-2, None)
    axes.legend(loc="lower right", fontsize=8, frameon=False, ncols=3)
    title = "distance to the batch solution, not aligned (batch also knows what came later)"
    label(axes, title, "distance driven [m]", "distance [m]")


def _map(axes: Axes, odometry: Array, reference: Reference, run: ParkRun) -> None:
    axes.set_aspect("equal", adjustable="datalim")
    axes.plot(*odometry[:, :2].T, color=ODOMETRY, linewidth=0.6, alpha=0.8, label="odometry")
    axes.plot(
        *reference.poses[:, :2].T, color=TRUTH, linewidth=2.6, alpha=0.6, label="batch, true ids"
    )
    axes.plot(*run.poses[:, :2].T, color=ESTIMATE, linewidth=0.9, label="causal path")
    axes.plot(
        *reference.landmarks_m.T,
        "o",
        markersize=5,
        markerfacecolor="none",
        color=INK,
        markeredgewidth=0.7,
        label="tree, batch",
    )
    axes.plot(*run.landmarks_m.T, "x", markersize=4, color=LANDMARK, label="landmark")


def run(arguments: argparse.Namespace, stop: StopFlag) -> Result:
    drive = read_drive(shipped_file())
    if arguments.steps is not None:
        drive = drive.first(arguments.steps)
    print_progress("GTSAM: every step with ISAM2, then all of it in a batch")
    reference = batch_reference(drive, stop)
    odometry = odometry_path(drive)
    rows = [
        score("odometry", odometry, reference, has_ids=True),
        score("ISAM2, true ids", reference.causal, reference, has_ids=True),
    ]
    runs = {}
    for name, with_ids, wheels in (
        ("true ids, wheels as in the reference", True, PERFECT_WHEELS),
        ("true ids", True, UNKNOWN_WHEELS),
        ("unknown ids", False, UNKNOWN_WHEELS),
    ):
        print_progress(f"robust back end, {name}")
        run = drive_back_end(drive, wheels, stop, with_ids=with_ids)
        rows.append(score(f"robust, {name}", run.poses, reference, run, has_ids=with_ids))
        runs[name] = run
    return Result(
        numbers={
            "simulated": False,
            "data": "Victoria Park as in the wheel of gtsam; no ground truth",
            "reference": "GTSAM, batch, true ids",
            "steps": len(drive.increments),
            "observations": drive.n_observations,
            "landmarks": len(drive.labels),
            "reference_chi_square": reference.chi_square,
            "reference_dof": reference.dof,
            "reference_seconds": reference.seconds,
            "paths": [asdict(row) for row in rows],
            "wheel_errors": {
                name: {"mean": run.calibration.tolist(), "sigma": run.calibration_sigmas.tolist()}
                for name, run in runs.items()
            },
        },
        title="Victoria Park (real data): causal paths of the robust back end against GTSAM's "
        "batch solution",
        size_in=(11.0, 9.2),
        draw=lambda figure: _draw(figure, odometry, reference, runs, rows),
        tables=[
            table(
                f"Victoria Park, {len(drive.increments)} steps, {len(drive.labels)} trees seen "
                f"{drive.n_observations} times: causal paths against GTSAM's batch solution (real "
                "data, no ground truth)",
                {
                    "path": [row.name for row in rows],
                    "ATE": [f"{row.ate_m:.2f} m" for row in rows],
                    "unaligned": [f"{row.rmse_m:.2f} m" for row in rows],
                    "most": [f"{row.max_m:.2f} m" for row in rows],
                    "landmarks": [_or_dash(row.n_landmarks) for row in rows],
                    "right": [share_text(row.right_share) for row in rows],
                    "left out": [_or_dash(row.left_out) for row in rows],
                    "CPU time": [_or_dash(row.seconds, ".1f", " s") for row in rows],
                },
            )
        ],
    )


def _or_dash(value: float | None, form: str = "", unit: str = "") -> str:
    return "-" if value is None else f"{value:{form}}{unit}"

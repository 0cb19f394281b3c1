"""What a SLAM pipeline estimates and reports, and the protocol that every pipeline follows."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slam.config import SlamConfig
from slam.frames import Detection, RadarFrame, StepInputError
from slam.geometry import Mount, Rig

Array = NDArray[np.float64]

POSE_SIZE = 3
LANDMARK_SIZE = 2
_NIS_DOF = 2

PoseAt = Callable[[int], Array]
"""Odometry pose at a session time [ns]: shape (3,), [x m, y m, heading rad], odometry frame."""

NoiseAt = Callable[[int], Array]
"""Covariance (3, 3) of the noise that odometry has gathered at a session time [ns], in the order
and frame of its pose. Steps are independent: the noise between two times is the difference."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fix:
    """One trilaterated point, seen once."""

    pair: int  # index into the pairs of the rig
    # Session time of the pose in whose body frame the position is given; the two detections keep
    # their own times
    t_ns: int
    # Position in that body frame
    x_m: float
    y_m: float
    # The two ranges it was made of, first and second radar of the pair
    detections: tuple[Detection, Detection]


@dataclass(frozen=True, slots=True, kw_only=True)
class Observation:
    """A confirmed point, as the filter gets it: range and bearing from the base footprint."""

    # Position in the body frame of the window's first pose
    x_m: float
    y_m: float
    n_poses: int  # from how many poses the fixes of the confirming cluster are
    fixes: tuple[Fix, ...]  # the fixes whose mean this is

    @property
    def range_m(self) -> float:
        return math.hypot(self.x_m, self.y_m)

    @property
    def bearing_rad(self) -> float:
        return math.atan2(self.y_m, self.x_m)


def landmark_slice(row: int) -> slice:
    begin = POSE_SIZE + LANDMARK_SIZE * row
    return slice(begin, begin + LANDMARK_SIZE)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Belief:
    """What the filter knows: a Gaussian over pose and landmarks."""

    # shape (3 + 2 n,), [m, m, rad, m, m, ...], map frame; the heading lies in [-pi, pi)
    mean: Array
    covariance: Array  # shape (3 + 2 n, 3 + 2 n), symmetric
    landmark_ids: tuple[int, ...] = ()  # n ids in the order of the rows
    next_id: int = 0  # the id the next new landmark gets; ids are never used twice

    def __post_init__(self) -> None:
        """Check the shapes and make the fields read-only views.

        The arrays are not copied: the caller must not write to them afterwards.
        """
        size = POSE_SIZE + LANDMARK_SIZE * len(self.landmark_ids)
        if self.mean.shape != (size,) or self.covariance.shape != (size, size):
            raise ValueError(
                f"{len(self.landmark_ids)} landmarks need mean ({size},) and covariance "
                f"({size}, {size}), got {self.mean.shape} and {self.covariance.shape}"
            )
        for name, array in (("mean", self.mean), ("covariance", self.covariance)):
            view = array.view()
            view.setflags(write=False)
            object.__setattr__(self, name, view)

    @property
    def pose(self) -> Array:
        """Return [x m, y m, heading rad], map frame, shape (3,)."""
        return self.mean[:POSE_SIZE]

    @property
    def pose_covariance(self) -> Array:
        return self.covariance[:POSE_SIZE, :POSE_SIZE]

    @property
    def landmarks(self) -> Array:
        """Return the landmarks' positions, shape (n, 2) [m], map frame."""
        return self.mean[POSE_SIZE:].reshape(-1, LANDMARK_SIZE)

    def landmark_covariance(self, row: int) -> Array:
        block = landmark_slice(row)
        return self.covariance[block, block]

    def landmark_covariances(self) -> Array:
        """Return the covariance of each landmark, shape (n, 2, 2)."""
        n = len(self.landmark_ids)
        return np.array([self.landmark_covariance(row) for row in range(n)]).reshape(-1, 2, 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Association:
    """The result of one observation."""

    landmark_id: int  # the landmark it updated, or the one made from it
    is_new: bool  # true if the landmark was made from this observation
    # shape (n,): squared distance to every landmark of the map before this observation, before any
    # gate; inf for one under the robot's own position. Two degrees of freedom.
    mahalanobis_sq: Array
    candidate_ids: tuple[int, ...]  # n landmark ids belonging to ``mahalanobis_sq``

    @property
    def nis(self) -> float | None:
        """Return the normalised innovation squared (2 dof); None for a new landmark."""
        if self.is_new:
            return None
        return float(self.mahalanobis_sq[self.candidate_ids.index(self.landmark_id)])


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictedRange:
    """A range that could have continued a track, as predicted before any was looked at."""

    # Whose range of what
    radar: int
    landmark_id: int
    # Prediction, and its variance [m^2] from pose, map and offsets; the noise of the range itself
    # comes on top
    range_m: float
    variance: float
    # Body frame of the pose, x and y [m]: where the antenna was when it sampled, and where the
    # landmark is believed to be
    antenna_m: tuple[float, float]
    point_m: tuple[float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class UpdateReport:
    """The result of the ranges of one time."""

    # (radar, index of the range in its scan, landmark id)
    continued: tuple[tuple[int, int, int], ...]
    # Normalised innovation squared of the ranges that continued tracks, before Huber's weights, and
    # its degrees of freedom
    nis: float
    dof: int
    # Every range of a landmark, not of walls, that took part, measured or not
    predicted: tuple[PredictedRange, ...] = ()
    # Of each range of a landmark, and of each landmark that gave none: its id, and the logarithm of
    # the likelihood ratio [nats] of the estimated pose to any other
    evidence: tuple[tuple[int, float], ...] = ()
    # Whether a kidnapping was detected now; whether the place on the map is unknown: the pose is
    # that before it and odometry since then, and its covariance covers the map
    carried: bool = False
    lost: bool = False


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LaggedPose:
    """A pose of some metres ago, with all that was measured since: a fixed-lag smoother's.

    The covariance is the filter's; doubts of the wheels (`slam.robust.branches`) add nothing to it.
    """

    t_ns: int  # session time of its state
    pose: Array  # shape (3,), [x m, y m, heading rad], map frame; the heading lies in [-pi, pi)
    covariance: Array  # shape (3, 3), of the additive error


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StepResult:
    """One estimated state, and all that led to it."""

    # Session time of the state; under the paper's window - 1 states before the newest one
    t_ns: int
    odometry_pose: Array  # shape (3,), odometry frame
    belief: Belief  # pose and landmarks after this state's observations, map frame
    # Ranges and trilaterated points of this state
    detections: tuple[Detection, ...]
    fixes: tuple[Fix, ...] = ()
    # Points that passed the outlier filter, and the result of each
    observations: tuple[Observation, ...] = ()
    associations: tuple[Association, ...] = ()
    rejected: tuple[Fix, ...] = ()  # fixes of this state that no cluster confirmed
    # Of the robust back end, which has no fixes nor observations
    report: UpdateReport | None = None
    # Standard deviation of every detection in the robust back end; infinite for one left out
    range_sigmas_m: tuple[float, ...] = ()
    # Poses of the robust back end that are final now, in time order: at least one every 10 cm, more
    # where the robot turns; none of the time in which it was lost
    lagged: tuple[LaggedPose, ...] = ()

    @property
    def is_lost(self) -> bool:
        """Whether the robust back end reports the robot as lost."""
        return self.report is not None and self.report.lost

    @property
    def nis(self) -> tuple[float, ...]:
        """Return the normalised innovation squared (2 dof) of each landmark seen again."""
        return tuple(a.nis for a in self.associations if a.nis is not None)

    @property
    def nis_per_dof(self) -> tuple[float, ...]:
        """Return the same over its dof; of a report, that of all ranges together."""
        if self.report is not None:
            return (self.report.nis / self.report.dof,) if self.report.dof else ()
        return tuple(nis / _NIS_DOF for nis in self.nis)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SmoothedRun:
    """The solution over all states of a run: each has seen all measurements, later ones, too.

    Map frame, errors additive; the landmarks are those of the newest belief.

    Attributes
    ----------
    t_ns
        Shape (n,): session times of the states.
    poses, pose_covariances
        Shape (n, 3), [x m, y m, heading rad], the heading in [-pi, pi); and (n, 3, 3).
    landmark_ids, landmarks_m, landmark_covariances_m2
        m ids, shape (m, 2) and (m, 2, 2).
    constants
        Shape (3 + r, 2): how far the errors s, w [1] and kappa [rad/m] of the wheels at the start,
        and the range offsets [m] of r radars, are from what was stated, and the standard deviations
        stated of that; infinite where the run took none. None of a recorded run.
    """

    t_ns: NDArray[np.int64]
    poses: Array
    pose_covariances: Array
    landmark_ids: tuple[int, ...]
    landmarks_m: Array
    landmark_covariances_m2: Array
    constants: Array | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class SavedRadar:
    """A radar that made a map; [m] and [rad], body frame."""

    name: str
    # As the rig has it
    x_m: float
    y_m: float
    yaw_rad: float
    range_offset_m: float
    # What the run found beyond that: how much longer its ranges are, and where its antenna is
    offset_m: float
    moved_m: tuple[float, float]

    def is_of(self, mount: Mount) -> bool:
        """Return whether a rig has this radar at this place, with this range zero."""
        return all(getattr(self, key) == getattr(mount, key) for key in OF_MOUNT)


OF_MOUNT = ("name", "x_m", "y_m", "yaw_rad", "range_offset_m")


@dataclass(frozen=True, slots=True, kw_only=True)
class SavedLandmark:
    """A landmark of a map, map frame."""

    id: int
    x_m: float
    y_m: float
    radius_m: float
    added_sigma_m: float  # added in squares to the noise of its ranges
    hits: int  # how many frames hit it
    label: int | None = None  # id of a beacon, where its ranges have one


@dataclass(frozen=True, slots=True, kw_only=True)
class SavedWall:
    """A wall of a map: n . x = d with n = [cos phi, sin phi] away from the robot."""

    id: int
    phi_rad: float
    d_m: float
    added_sigma_m: float
    hits: int
    cells: tuple[int, ...]  # which stretches along it gave echoes, in cells of `WallRule.cell_m`


@dataclass(frozen=True, slots=True, kw_only=True)
class SavedMap:
    """What a run knows of its surroundings, for another one.

    The map frame is the body frame at the start of the first run that made it. Errors are additive.
    Radars and landmarks are correlated, and so are landmarks with each other: the covariance is of
    all of them together.
    """

    radars: tuple[SavedRadar, ...]
    landmarks: tuple[SavedLandmark, ...]
    walls: tuple[SavedWall, ...]
    # Names of the q unknowns, such as "offset left_rear", "x 3" and "phi 7", and the lower triangle
    # of their covariance: q rows of 1 to q numbers
    unknowns: tuple[str, ...]
    covariance: tuple[tuple[float, ...], ...]
    start: tuple[float, float, float]  # pose where the newest run that made it began, map frame
    next_id: int  # ids of landmarks and walls are smaller

    def full_covariance(self) -> Array:
        """Return the covariance of all unknowns, shape (q, q)."""
        q = len(self.unknowns)
        lower = np.zeros((q, q))
        lower[np.tril_indices(q)] = [value for row in self.covariance for value in row]
        return np.asarray(lower + np.tril(lower, -1).T)

    @property
    def features(self) -> tuple[SavedLandmark | SavedWall, ...]:
        """Return the landmarks, and behind them the walls."""
        return (*self.landmarks, *self.walls)

    @property
    def landmarks_m(self) -> Array:
        """Return the landmarks' places, shape (n, 2), map frame."""
        return np.array([(one.x_m, one.y_m) for one in self.landmarks]).reshape(-1, 2)

    def landmarks_covariance(self) -> Array:
        """Return the covariance of the landmarks' places, shape (2 n, 2 n)."""
        row = {name: place for place, name in enumerate(self.unknowns)}
        at = [row[f"{axis} {one.id}"] for one in self.landmarks for axis in "xy"]
        return self.full_covariance()[np.ix_(at, at)]


@dataclass(frozen=True, slots=True, kw_only=True)
class StartOnMap:
    """A map that a run begins with, and how."""

    map: SavedMap
    # Where the robot is at first, [x m, y m, heading rad], map frame; None: anywhere
    pose: tuple[float, float, float] | None = None
    is_fixed: bool = False  # the map stays as it is: what is new in it serves the pose only


@dataclass(frozen=True, slots=True, kw_only=True)
class MapChanges:
    """What a run found of the map that it was given; ids of landmarks."""

    seen: tuple[int, ...]  # where they were
    gone: tuple[int, ...]  # should have been seen, and were not
    new: tuple[int, ...]  # are not on the map


class InputCheck:
    """Checks what a pipeline is stepped with, before it changes anything; raises StepInputError."""

    def __init__(self, rig: Rig) -> None:
        self._n_radars = len(rig.mounts)
        self._last_ns: int | None = None  # time of the last step

    def begin(self, pose_at: PoseAt, t_ns: int) -> Array:
        """Return the odometry pose (3,) of a step, which may not be before the last one."""
        if self._last_ns is not None and not t_ns >= self._last_ns:
            raise StepInputError(f"t_ns is {t_ns}, before that of the last step, {self._last_ns}")
        return self.pose(pose_at, t_ns)

    def accept(self, t_ns: int) -> None:
        """Note that the step of a time is taken."""
        self._last_ns = t_ns

    def pose(self, pose_at: PoseAt, t_ns: int) -> Array:
        """Return the odometry pose at a time, shape (3,), three finite numbers."""
        pose = np.array(pose_at(t_ns), dtype=np.float64)
        if pose.shape != (POSE_SIZE,) or not all(map(math.isfinite, pose)):
            raise StepInputError(
                f"odometry at {t_ns} ns is {pose.tolist()}; a pose is three finite numbers, "
                "x [m], y [m] and heading [rad]"
            )
        return pose

    def stamps_ns(self, seen: Sequence[RadarFrame] | Sequence[Detection]) -> dict[int, int]:
        """Return the times of frames, or of detections, by radar; there is one frame of each."""
        stamps_ns: dict[int, int] = {}
        for each in seen:
            is_second = isinstance(each, RadarFrame) and each.radar in stamps_ns
            is_other = stamps_ns.setdefault(each.radar, each.t_ns) != each.t_ns
            if each.radar >= self._n_radars or is_second or is_other:
                raise StepInputError(
                    f"{type(each).__name__} of radar {each.radar} at {each.t_ns} ns: a step takes "
                    f"one frame of each of {self._n_radars} radars, numbered from 0 in the order "
                    f"of the rig's mounts, or the detections of one; times by radar: {stamps_ns}"
                )
        return stamps_ns


class Pipeline(Protocol):
    """The paper's pipeline or the robust one; the map frame is the body frame at the first pose."""

    config: SlamConfig

    def step(
        self, frames: Sequence[RadarFrame], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        """Take in the frames and odometry around one time; return the states now ready.

        There is at most one frame per radar, each with the time it was taken at; a radar whose
        frame was lost is absent. ``pose_at`` is asked for the pose at ``t_ns``, the time of the
        state, and, unless all radars are taken to have sampled then, at the times of the frames.
        Times of steps do not fall. Raises StepInputError, a ValueError, before anything has changed
        if the input is not so, or a pose is not finite.
        """
        ...

    def step_detections(
        self, detections: Sequence[Detection], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        """Do what ``step`` does, with ranges that some other front end found."""
        ...

    def flush(self) -> tuple[StepResult, ...]:
        """Return the states still held back at the end of a run."""
        ...

    def wall_spans_m(self) -> Array:
        """Return the ends of the reported stretches of wall, (k, 2, 2) [m], map frame."""
        ...

    def smoothed(self) -> SmoothedRun | None:
        """Return the solution over all states until now; None if the pipeline has none.

        What later steps return stays the same, to the last bit.
        """
        ...

    def saved_map(self) -> SavedMap | None:
        """Return what the pipeline knows of its surroundings; None if it cannot be used again."""
        ...

    def map_changes(self) -> MapChanges | None:
        """Return what was found of the map that the pipeline was given; None if it was not."""
        ...

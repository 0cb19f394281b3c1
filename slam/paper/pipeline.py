"""Algorithm 1 of the paper: radar frames and odometry in, pose and map out."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from slam.config import EndOfRun, SampleTime, SlamConfig
from slam.frames import Detection, Detector, RadarFrame
from slam.front_end.paper import make_detector
from slam.geometry import Rig, between
from slam.paper.association import Association, update_map
from slam.paper.clustering import CollectedState, Observation, filter_window, has_moved
from slam.paper.ekf import Belief, motion_noise, predict, start
from slam.paper.trilateration import NO_MOTIONS, Fix, Trilaterator
from slam.results import UpdateReport

Array = NDArray[np.float64]

_NIS_DOF = 2

PoseAt = Callable[[int], Array]
"""Odometry pose at a session time [ns]: shape (3,), [x m, y m, heading rad], odometry frame."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class StepResult:
    """One estimated state, everything that led to it included.

    Attributes
    ----------
    t_ns
        Session time of the state; under the paper's window - 1 states before the newest one.
    odometry_pose
        shape (3,), what odometry said there, odometry frame.
    belief
        Pose and landmarks after this state's observations, map frame.
    detections, fixes
        Ranges and trilaterated points of this state.
    observations, associations
        What the outlier filter let through, and what became of each.
    rejected
        Fixes of this state that no cluster confirmed.
    report
        What the robust back end made of the detections; it has no fixes nor observations.
    range_sigmas_m
        Standard deviation of every detection as the robust back end was told it; infinite for one
        that it was not given.
    """

    t_ns: int
    odometry_pose: Array
    belief: Belief
    detections: tuple[Detection, ...]
    fixes: tuple[Fix, ...] = ()
    observations: tuple[Observation, ...] = ()
    associations: tuple[Association, ...] = ()
    rejected: tuple[Fix, ...] = ()
    report: UpdateReport | None = None
    range_sigmas_m: tuple[float, ...] = ()

    @property
    def nis(self) -> tuple[float, ...]:
        """Return the normalised innovation squared (2 dof) of each landmark seen again."""
        return tuple(a.nis for a in self.associations if a.nis is not None)

    @property
    def nis_per_dof(self) -> tuple[float, ...]:
        """Return the same over its degrees of freedom; of a report, that of all ranges together."""
        if self.report is not None:
            return (self.report.nis / self.report.dof,) if self.report.dof else ()
        return tuple(nis / _NIS_DOF for nis in self.nis)


class Slam(Protocol):
    """What runs a session: the paper's pipeline or the robust one."""

    config: SlamConfig

    def step(
        self, frames: Sequence[RadarFrame], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        """Take in what sensors say around one time; return the states that became ready."""
        ...

    def step_detections(
        self, detections: Sequence[Detection], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        """Do what ``step`` does, from ranges that some other front end found."""
        ...

    def flush(self) -> tuple[StepResult, ...]:
        """Return the states still held back at the end of a run."""
        ...

    def wall_spans_m(self) -> Array:
        """Return the ends of the stretches of wall that answered, (k, 2, 2) [m], map frame."""
        ...


class UwbRadarSlam:
    """UWB radar SLAM as in the paper: fixes of two radars, DBSCAN over a window, EKF SLAM.

    The map frame is the body frame at the first odometry pose.

    Parameters
    ----------
    config
        Table I and the options around it.
    rig
        Where the radars sit.
    detector
        The front end, if not the one that the configuration names.
    """

    def __init__(self, config: SlamConfig, rig: Rig, detector: Detector | None = None) -> None:
        self.config = config
        self.rig = rig
        self.belief: Belief = start()
        sensor = config.observation
        self._Q = np.diag([sensor.sigma_range_m**2, sensor.sigma_bearing_rad**2])
        self._detector = detector or make_detector(config)
        self._trilaterator = Trilaterator(config.trilateration, rig)
        self._window: deque[CollectedState] = deque()
        self._collected_pose: Array | None = None  # odometry where the last state was collected
        self._estimated_pose: Array = np.zeros(3)  # Odom[s - 1]
        self._n_estimated = 0

    def step(
        self, frames: Sequence[RadarFrame], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        """Take in what sensors say around one time; return the state that became ready, if any.

        Parameters
        ----------
        frames
            At most one frame per radar, each with the time it was taken at; a radar whose frame
            was lost is simply absent.
        pose_at
            Odometry; asked for the pose at ``t_ns`` and, where ``trilateration.sample_time`` is
            "own", at the time of every frame with an echo.
        t_ns
            Session time of the state.
        """
        return self._take(lambda: self._detect(frames), pose_at, t_ns)

    def step_detections(
        self, detections: Sequence[Detection], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        """Do what ``step`` does, from ranges that some other front end found."""
        return self._take(lambda: tuple(detections), pose_at, t_ns)

    def flush(self) -> tuple[StepResult, ...]:
        """Return the states still in the window at the end of a run, if the preset wants them."""
        if self.config.window.end_of_run is EndOfRun.DROP:
            self._window.clear()
        return tuple(self._estimate() for _ in range(len(self._window)))

    def wall_spans_m(self) -> Array:
        """Return none: the paper's map has points only."""
        return np.empty((0, 2, 2))

    def _take(
        self, detect: Callable[[], tuple[Detection, ...]], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        """Collect a state where the robot has moved; estimate the oldest once w are there."""
        pose = np.array(pose_at(t_ns), dtype=np.float64)
        if self._collected_pose is None:  # Odom[0] <- origin
            self._collected_pose = self._estimated_pose = pose
            return ()
        if not has_moved(self._collected_pose, pose, self.config.window):
            return ()
        self._collected_pose = pose
        detections = detect()
        motions = self._motions(detections, pose, pose_at, t_ns)
        fixes = self._trilaterator.locate(detections, t_ns, motions)
        self._window.append(
            CollectedState(t_ns=t_ns, odometry_pose=pose, detections=detections, fixes=fixes)
        )
        return (self._estimate(),) if len(self._window) == self.config.window.size else ()

    def _estimate(self) -> StepResult:
        """Estimate state s from the window s .. s + w - 1 (the inner part of Algorithm 1)."""
        config, state = self.config, self._window[0]
        filtered = filter_window(tuple(self._window), config.clustering)
        observations = filtered.observations if self._is_update_due() else ()

        u = between(self._estimated_pose, state.odometry_pose)
        R = motion_noise(u, float(self.belief.pose[2]), config.motion)
        predicted = predict(self.belief, u, R)
        seen = [np.array([o.range_m, o.bearing_rad]) for o in observations]
        self.belief, associations = update_map(predicted, seen, self._Q, config.association)

        self._window.popleft()
        self._estimated_pose = state.odometry_pose
        self._n_estimated += 1
        return StepResult(
            t_ns=state.t_ns,
            odometry_pose=state.odometry_pose,
            belief=self.belief,
            detections=state.detections,
            fixes=state.fixes,
            observations=observations,
            associations=associations,
            rejected=filtered.rejected,
        )

    def _motions(
        self, detections: Sequence[Detection], pose: Array, pose_at: PoseAt, t_ns: int
    ) -> Mapping[int, Array]:
        """Return how the robot moved from the state to each detection's own time, if it counts."""
        if self.config.trilateration.sample_time is SampleTime.NOMINAL:
            return NO_MOTIONS
        stamps_ns = {detection.t_ns for detection in detections} - {t_ns}
        return {stamp_ns: between(pose, pose_at(stamp_ns)) for stamp_ns in stamps_ns}

    def _is_update_due(self) -> bool:
        return self._n_estimated % self.config.window.stride == 0

    def _detect(self, frames: Sequence[RadarFrame]) -> tuple[Detection, ...]:
        offsets_m = [self.rig.mounts[frame.radar].range_offset_m for frame in frames]
        found = self._detector.detect_many(frames, offsets_m)
        return tuple(detection for of_frame in found for detection in of_frame)

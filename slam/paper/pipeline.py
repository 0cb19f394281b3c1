"""Algorithm 1 of the paper: radar frames and odometry in, pose and map out."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from slam.config import EndOfRun, SampleTime, SlamConfig
from slam.frames import Detection, Detector, RadarFrame, detect_all
from slam.front_end import make_detector
from slam.geometry import Rig, between, has_moved
from slam.paper.association import update_map
from slam.paper.clustering import CollectedState, filter_window
from slam.paper.ekf import motion_noise, predict, start
from slam.paper.trilateration import NO_MOTIONS, Trilaterator
from slam.results import Belief, InputCheck, PoseAt, SmoothedRun, StepResult

Array = NDArray[np.float64]


class UwbRadarSlam:
    """UWB radar SLAM as in the paper: fixes of two radars, DBSCAN over a window, EKF SLAM."""

    def __init__(self, config: SlamConfig, rig: Rig, detector: Detector | None = None) -> None:
        self.config = config
        self.rig = rig
        self.belief: Belief = start()
        sensor = config.observation
        self._Q = np.diag([sensor.sigma_range_m**2, sensor.sigma_bearing_rad**2])
        self._detector = detector or make_detector(config, rig)
        self._check = InputCheck(rig)
        limits = config.detection
        self._trilaterator = Trilaterator(
            config.trilateration, rig, (limits.min_range_m, limits.max_range_m)
        )
        self._window: deque[CollectedState] = deque()
        self._collected_pose: Array | None = None  # odometry where the last state was collected
        self._estimated_pose: Array = np.zeros(3)  # Odom[s - 1]
        self._n_estimated = 0

    def step(
        self, frames: Sequence[RadarFrame], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        self._check.stamps_ns(frames)
        detect = partial(detect_all, self._detector, frames, self.rig)
        return self._take(detect, pose_at, t_ns)

    def step_detections(
        self, detections: Sequence[Detection], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        self._check.stamps_ns(detections)
        return self._take(lambda: tuple(detections), pose_at, t_ns)

    def flush(self) -> tuple[StepResult, ...]:
        if self.config.window.end_of_run is EndOfRun.DROP:
            self._window.clear()
        return tuple(self._estimate() for _ in range(len(self._window)))

    def wall_spans_m(self) -> Array:
        """Return none: the paper's map has points only."""
        return np.empty((0, 2, 2))

    def smoothed(self) -> SmoothedRun | None:
        """Return None: the paper filters only."""
        return None

    def saved_map(self) -> None:
        """Return None: the paper begins with an empty map."""

    def map_changes(self) -> None:
        """Return None, as `saved_map` does."""

    def _take(
        self, detect: Callable[[], tuple[Detection, ...]], pose_at: PoseAt, t_ns: int
    ) -> tuple[StepResult, ...]:
        """Collect a state where the robot has moved; estimate the oldest once w are there."""
        pose = self._check.begin(pose_at, t_ns)
        if self._collected_pose is None:  # Odom[0] <- origin
            self._check.accept(t_ns)
            self._collected_pose = self._estimated_pose = pose
            return ()
        window = self.config.window
        if not has_moved(self._collected_pose, pose, window.min_distance_m, window.min_turn_rad):
            self._check.accept(t_ns)
            return ()
        detections = detect()
        motions = self._motions(detections, pose, pose_at, t_ns)
        self._check.accept(t_ns)
        fixes = self._trilaterator.locate(detections, t_ns, motions)
        self._collected_pose = pose
        self._window.append(
            CollectedState(t_ns=t_ns, odometry_pose=pose, detections=detections, fixes=fixes)
        )
        return (self._estimate(),) if len(self._window) == self.config.window.size else ()

    def _estimate(self) -> StepResult:
        """Estimate state s from the window s .. s + w - 1 (the inner part of Algorithm 1)."""
        config, state = self.config, self._window[0]
        filtered = filter_window(tuple(self._window), config.clustering)
        is_update_due = self._n_estimated % config.window.stride == 0
        observations = filtered.observations if is_update_due else ()

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
        if self.config.trilateration.sample_time is SampleTime.NOMINAL:
            return NO_MOTIONS
        stamps_ns = {detection.t_ns for detection in detections} - {t_ns}
        return {
            stamp_ns: between(pose, self._check.pose(pose_at, stamp_ns)) for stamp_ns in stamps_ns
        }
